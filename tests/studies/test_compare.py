"""Recorded runs compared: what of them, from which series, with which sign."""

from __future__ import annotations

import json
import math

import dirty
import numpy as np
import pytest
from matplotlib.figure import Figure
from recorded_bags import BENCH_TOPICS, rewritten

import capture_sim
from capture_sim.cli import main
from capture_sim.commands import compare
from capture_sim.recording.offline import write_run
from capture_sim.recording.read import read_run
from capture_sim.run.series import Series
from capture_sim.run.touches import Touches, located
from capture_sim.studies.compare.compare import (
    SAMPLED_FORCE,
    characteristics,
    gaps,
    pair_touches,
    sides,
)
from capture_sim.studies.compare.frame import Frame
from capture_sim.viewing.studies import draw_touches, impulse_so_far


def test_runs_are_compared_by_what_the_run_itself_was(result, path, other):
    """By its loads, as both have them; of samples at 100 Hz the torsion comes out 0.5 % lower."""
    compared = sides(read_run(path), read_run(other))
    found = characteristics(compared[0])
    loads, touches = result.loads, result.touches
    for name, expected in (
        ("torsion, mrad", loads["max_torsion"] * 1e3),
        ("stroke inwards, mm", loads["max_axial_stroke_in"] * 1e3),
        ("stroke inwards, mm, until the latch", loads["max_axial_stroke_in_before_latch"] * 1e3),
        ("closest approach to BE, mm", loads["nearest_distance"] * 1e3),
        ("peak normal force, N", touches["peak_force"].max()),
        ("normal impulse, N s", touches["impulse"].sum()),
    ):
        assert found[name].value == expected, name
    assert found["torsion, mrad"].source == "integration"
    assert found["touches"].source == "bench/event"
    assert characteristics(compared[1])["stroke inwards, mm"].value > (
        found["stroke inwards, mm"].value
    )
    assert compared[0].touches.peak.tolist() == result.touches["peak_force"].tolist()


def test_both_runs_are_compared_by_a_series_that_both_hold(bench_bag, path):
    bench, run = sides(read_run(bench_bag), read_run(path))
    assert bench.sources == {
        "chaser": "chaser/odom, 100 Hz",
        "target": "target/odom, 100 Hz",
        "stroke": "bench/buffer, 100 Hz",
        "torsion": "bench/buffer, 100 Hz",
        "force": "contact/wrench, 100 Hz",
    }
    assert {name: run.sources[name] for name in bench.sources} == bench.sources
    assert run.sources["distance"] == "bench/state, 1000 Hz"  # the bench's bag has none
    assert bench.touches is None
    assert "too slow for touches of 0.348 ms as the other has" in bench.touch_source
    assert "peak normal force, N" not in characteristics(bench)  # a sample is no peak
    assert SAMPLED_FORCE in characteristics(bench, sampled=True)


def test_peaks_between_messages_come_before_samples(path, tmp_path):
    """bench/contact tells the first touch's peak at 100 Hz too; contact/wrench shows none."""
    topics = [*BENCH_TOPICS, ("/bench/contact", "capture_sim/msg/ContactState")]
    bag = read_run(rewritten(path, tmp_path / "bag", topics=topics))
    side, _ = sides(bag, read_run(path))
    assert side.touch_source == "bench/contact, 100 Hz, as long as each message counts one"
    assert side.touches.within(side.contact, 1.0).start[0] == 0.0
    located = read_run(path).touches
    assert side.touches.peak[0] == located["peak_force"][0]
    assert side.touches.start[0] == pytest.approx(located["start"][0], abs=0.01)
    assert np.isnan(side.touches.impulse).all()


def test_a_fast_bench_is_compared_by_the_fast_series_of_the_run(result, path, tmp_path):
    """The bench's encoders at 500 Hz: the run's bench/buffer at 100 Hz would be the slower."""
    fast = capture_sim.load_scene("tilt_0", ["run.rate=500"])
    recorded = write_run(capture_sim.simulate(fast), tmp_path / "fast.mcap")

    compared = sides(read_run(rewritten(recorded, tmp_path / "bag")), read_run(path))
    assert [of.sources["stroke"] for of in compared] == [
        "bench/buffer, 500 Hz",
        "bench/state, 1000 Hz",
    ]
    assert [of.sources["chaser"] for of in compared] == [
        "chaser/odom, 500 Hz",
        "bench/state, 1000 Hz",
    ]
    mine, theirs = (characteristics(of)["torsion, mrad"].value for of in compared)
    assert mine == pytest.approx(theirs, rel=1e-3)
    assert theirs == np.abs(result.samples["torsion"]).max() * 1e3


def test_with_motion_capture_the_true_path_is_taken_where_both_hold_it(path, tmp_path):
    scene = capture_sim.load_scene("tilt_0", ["sensors.motion_capture.rate=100"])
    seen = capture_sim.simulate(scene)
    noisy = write_run(seen, tmp_path / "noisy.mcap")
    found = characteristics(sides(read_run(noisy), read_run(path))[0])["closest approach to BE, mm"]
    assert found == (seen.loads["nearest_distance"] * 1e3, "integration")
    # a bench knows it by its detector alone, and so it is taken of both
    topics = [*BENCH_TOPICS, ("/capture/status", "capture_sim/msg/CaptureStatus")]

    bag = rewritten(path, tmp_path / "bag", topics=topics)
    compared = sides(read_run(noisy), read_run(bag))
    assert [of.sources["distance"] for of in compared] == ["capture/status, 100 Hz"] * 2


def test_load_cell_alone_shows_when_the_contact_was(path, tmp_path, capsys):
    scene = capture_sim.load_scene(
        "tilt_0", ["sensors.motion_capture.rate=100", "sensors.load_cell.force_noise=0.5"]
    )
    recorded = write_run(capture_sim.simulate(scene), tmp_path / "run.mcap")
    topics = [
        ("/motion_capture/chaser", "geometry_msgs/msg/PoseStamped"),
        ("/motion_capture/target", "geometry_msgs/msg/PoseStamped"),
        ("/bench/buffer", "capture_sim/msg/BufferState"),
        ("/load_cell/wrench", "geometry_msgs/msg/WrenchStamped"),
    ]

    bag = rewritten(recorded, tmp_path / "bag", topics=topics)
    assert read_run(bag).first_contact.t == pytest.approx(read_run(path).first_contact.t, abs=0.01)
    assert main(["compare", str(bag), str(path), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "load_cell/wrench, 1000 Hz" in said
    assert "nan" not in said


@pytest.mark.parametrize(
    "a, b, said",
    [
        (2.0, 3.0, "+50.00%"),
        (-4e-16, 8.0, "-"),  # a stroke of rounding errors
        (4e-5, 4.4e-5, "-"),  # 0.0000 in the table
        (0.0008, 1.7150, "-"),  # 2000 times as much
        (1.0, 1.0 - 1e-9, "+0.00%"),
        (math.nan, 1.0, "-"),
    ],
)
def test_percentages_are_written_where_they_say_something(a, b, said):
    assert compare._percent(a, b, 1e-4, 2) == said


def test_gaps_of_known_series():
    """Each run counts from its own contact, and what both hold is compared, by the coarser one."""
    t, coarse = np.linspace(0.0, 3.0, 301), np.linspace(0.5, 1.98, 75)
    a = {"stroke": Series(t, np.sin(t))}
    b = {"stroke": Series(coarse + 0.25, np.sin(coarse) + 0.1)}  # later, and 0.1 larger
    for one, other, sign in ((a, b, 1.0), (b, a, -1.0)):
        (gap,) = gaps(one, other, *((1.0, 1.25) if sign > 0.0 else (1.25, 1.0)), 1.5)
        assert gap.rms == pytest.approx(0.1)
        assert gap.largest == pytest.approx(sign * 0.1)  # second less first, as in the table
        assert (gap.begin, gap.end) == pytest.approx((0.0, 0.98))


def located_at(*touches):
    """Touches of (start in ms, wall)."""
    start, wall = np.array(touches, dtype=float).reshape(-1, 2).T
    n = len(start)
    return Touches(start * 1e-3, np.ones(n), np.ones(n), start * 1e-3, np.ones(n), wall)


@pytest.mark.parametrize(
    "a, b, pairs",
    [
        (
            # a chatter of one touch more, and a second contact: no later row is one off
            [(0, 1), (2, 1), (5, 1), (411, -1), (415, -1)],
            [(0, 1), (2.1, 1), (5.3, 1), (8, 1), (430, -1), (434, -1)],
            [(0, 0), (1, 1), (2, 2), (None, 3), (3, 4), (4, 5)],
        ),
        ([(0, 1)], [(0, -1)], [(0, None), (None, 0)]),
        ([(0, 1), (100, 1)], [(0, 0), (130, 1)], [(0, 0), (1, 1)]),
        ([(0, 1), (100, 1)], [(0, 0), (1000, 1)], [(0, 0), (1, None), (None, 1)]),
        ([], [(0, 1)], [(None, 0)]),
    ],
    ids=["one more", "other wall", "later", "too far", "none"],
)
def test_touches_are_paired_by_wall_and_time(a, b, pairs):
    found = [pair[:2] for pair in pair_touches(located_at(*a), located_at(*b))]
    assert found == pairs
    swapped = [pair[:2] for pair in pair_touches(located_at(*b), located_at(*a))]
    assert sorted(map(str, swapped)) == sorted(str((k, i)) for i, k in pairs)


def test_a_softer_buffer_has_the_same_touches_in_the_same_order():
    """Paired by time alone, its peaks seemed 45 to 58 % lower; they are up to 28 % lower."""
    scenes = (["run.t_end=3.2"], ["run.t_end=3.2", "buffer.k_A=400", "buffer.c_A=20"])
    runs = [capture_sim.simulate("tilt_p10", changes) for changes in scenes]
    touches = [located(run.touches) for run in runs]
    of_each = [each.later(-each.start[0]) for each in touches]
    pairs = pair_touches(*of_each)
    first_wall = [pair for pair in pairs if pair.a is not None and touches[0].wall[pair.a] > 0]
    assert [(pair.a, pair.b) for pair in first_wall] == [(k, k) for k in range(7)]
    assert not any(pair.is_ambiguous for pair in first_wall)
    shares = [touches[1].peak[k] / touches[0].peak[k] - 1.0 for k in range(7)]
    assert max(shares) < 0.01
    assert min(shares) > -0.3


def test_a_comparison_can_be_read_by_a_program(path, other, capsys):
    assert main(["compare", str(path), str(other), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    figures = data["figures"]["first contact, s"]
    assert {letter: figures[letter]["source"] for letter in "ab"} == dict.fromkeys(
        "ab", "bench/event"
    )
    assert data["touches"][0]["a"]["wall"] == data["touches"][0]["b"]["wall"]
    assert {gap["series"] for gap in data["differences"]} >= {"chaser", "stroke"}
    assert main(["compare", str(path), "--simulated", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["bit_identical"] is True


def test_poses_in_another_frame_are_compared_in_one(tmp_path, capsys):
    """The same trial, with the world of the cameras turned by 0.5 rad."""
    frame = Frame(0.5, 0.1, -0.2)

    def turn(message, _):
        p, o = message.pose.position, message.pose.orientation
        theta = 2.0 * math.atan2(o.z, o.w)
        ((p.x, p.y, theta),) = frame.applied(np.array([[p.x, p.y, theta]]))
        o.z, o.w = math.sin(0.5 * theta), math.cos(0.5 * theta)

    records = dirty.clean()
    paths = []
    for name, each in (("a", records), ("b", dirty.changed(records, dirty.BODIES, turn))):
        paths.append(str(dirty.write_mcap(tmp_path / f"{name}.mcap", each)))
    assert main(["compare", *paths, "--scene", "tilt_p10", "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert max(abs(gap["largest"]) for gap in data["differences"]) < 1e-3  # means of noisy headings
    assert main(["compare", *paths, "--scene", "tilt_p10", f"--out={tmp_path}"]) == 0
    assert "poses of B turned by -28.6 deg: its frame is not that of A" in capsys.readouterr().out


def test_touches_that_could_be_paired_otherwise_are_said_to_be():
    one, two = located_at((0, 1), (10, 1)), located_at((0, 1), (9, 1), (11, 1))
    assert [pair.is_ambiguous for pair in pair_touches(one, two) if pair.a is not None] == [
        False,
        True,
    ]


def test_compare_command(path, other, bench_bag, tmp_path, capsys, drawn):
    assert main(["compare", str(path), str(other), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "peak force of first contact, N" in said
    assert "stroke mm" in said.split("B - A over 1 s")[1]
    assert "force" not in said.split("B - A over 1 s")[1]  # of samples it says nothing
    # touch by touch: the first row is the first touch of both
    row = next(line.split() for line in said.splitlines() if line.startswith("1 "))
    first = [read_run(file).touches[0] for file in (path, other)]
    assert row[1:5] == ["-" if first[0]["wall"] < 0 else "+"] * 2 + ["0.000"] * 2
    assert [float(cell) for cell in row[6:8]] == pytest.approx(
        [touch["peak_force"] for touch in first], abs=0.005
    )
    assert [float(cell) for cell in row[11:13]] == pytest.approx(
        [touch["impulse"] for touch in first], abs=5.01e-6
    )
    (picture,) = tmp_path.glob("*.png")
    assert picture.stat().st_size > 20_000
    assert "is aligned at" not in said
    assert "identical" not in said
    assert main(["compare", str(path), str(path), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    table, series = said.split("B - A over 1 s")
    assert table.count("identical") == table.count("integration") + table.count("bench/event") - 1
    assert series.count("identical") == 8
    assert main(["compare", str(bench_bag), str(path), "--out", str(tmp_path)]) == 0
    assert "A is aligned at the first force in contact/wrench" in capsys.readouterr().out
    far = capture_sim.simulate(capture_sim.load_scene("tilt_0", ["run.t_end=1.0"]))
    untouched = write_run(far, tmp_path / "far.mcap")
    capsys.readouterr()
    assert main(["compare", str(path), str(untouched), "--out", str(tmp_path)]) == 2
    assert "contains no contact to align it by" in capsys.readouterr().err


@pytest.mark.parametrize("window", ["0.0001", "0"])
def test_window_without_samples_is_refused(window, path, other, bench_bag, tmp_path, capsys):
    command = ["compare", str(path), "--out", str(tmp_path), "--window", window]
    for theirs, least in ((other, "0.004 s (4 samples"), (bench_bag, "0.04 s (4 samples")):
        assert main([*command, str(theirs)]) == 2
        said = capsys.readouterr().err
        assert f"--window {float(window):g} s: must be {least}" in said
        assert said.count("\n") == 1


def test_what_two_runs_really_share_is_said(result, path, tmp_path, capsys):
    end = read_run(path).first_contact.t + 0.05
    short = capture_sim.simulate(capture_sim.load_scene("tilt_0", [f"run.t_end={end:.3f}"]))
    file = write_run(short, tmp_path / "short.mcap")
    assert main(["compare", str(path), str(file), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "B - A over 0.05" in said
    assert "--window is 1 s" in said
    scene = capture_sim.load_scene("tilt_0", [f"run.t_end={end - 0.048:.3f}"])
    file = write_run(capture_sim.simulate(scene), tmp_path / "touched.mcap")
    assert main(["compare", str(path), str(file), "--out", str(tmp_path)]) == 2
    assert "in common, with fewer than 4 samples" in capsys.readouterr().err


def test_diagram_shows_the_peak_of_every_touch(result, path, tmp_path):
    """Read off the figure's own markers."""
    compared = sides(read_run(path), read_run(path))
    told = compared[0].touches.within(compared[0].contact, 1.0)
    assert told.peak.max() == result.touches["peak_force"].max()
    axes = Figure().subplots()
    draw_touches(axes, told, "A", "blue", "o")
    (marks,) = axes.lines
    assert marks.get_ydata().tolist() == told.peak.tolist()
    for bar, impulse in zip(axes.patches, told.impulse, strict=True):
        assert bar.get_width() * bar.get_height() == pytest.approx(impulse)
    t, total = impulse_so_far(told, 1.0)
    assert total[-1] == pytest.approx(result.touches["impulse"].sum())
    assert (np.diff(total) >= 0.0).all()
    assert t[-1] == 1.0
