"""Bags of a real bench: the standard topics only, no scene, stamps of the wall clock."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from bags import STANDARD, copied, later, of_a_bench

import capture_sim
from capture_sim.cli import main
from capture_sim.detection.measurements import Counts, Reason, Source
from capture_sim.errors import RecordingError, SceneError
from capture_sim.messages.convert import Messages, rejected
from capture_sim.messages.telemetry import DetectorTelemetry
from capture_sim.recording.bag import read_bag
from capture_sim.recording.export import tables_of
from capture_sim.recording.offline import write_run
from capture_sim.recording.playback import Playback
from capture_sim.recording.read import read_run
from capture_sim.run.first_contact import first_touch, impact_speed
from capture_sim.run.run import detect
from capture_sim.run.summary_table import table
from capture_sim.studies.compare.compare import sides
from capture_sim.viewing import plots
from capture_sim.viewing.source import (
    decided_at,
    every_touch,
    has_force,
    in_contact,
    strongest,
    verdict,
)

#: Quantities of a touch that no sensor measures.
UNMEASURED = ("approach_speed", "dissipated", "rate_ratio")


@pytest.fixture(scope="module")
def run():
    return capture_sim.simulate(capture_sim.load_scene("tilt_p10"))


@pytest.fixture(scope="module")
def recorded(run, tmp_path_factory):
    return write_run(run, tmp_path_factory.mktemp("bag") / "tilt_p10.mcap")


def as_drawn(path, scene, **options):
    run = read_run(path, scene=capture_sim.load_scene(scene), **options)
    return run.replaced(scene=run.drawn_scene)


@pytest.mark.parametrize(
    "topics",
    [
        STANDARD,
        (*STANDARD, "/bench/buffer", "/bench/contact", "/bench/string", "/launcher/command"),
        (*STANDARD, "/capture/status"),
    ],
    ids=["standard", "all of a bench", "judged"],
)
def test_bag_without_a_scene_is_the_run_it_was(run, recorded, tmp_path, topics):
    bag = of_a_bench(recorded, tmp_path / "trial_7.mcap", topics)
    with pytest.raises(SceneError, match="contains no scene: give it with --scene"):
        _ = read_run(bag).scene
    seen = as_drawn(bag, "tilt_0")
    every = run.samples[::10]
    assert seen.scene.name == "trial_7"
    assert seen.samples["t"] == pytest.approx(every["t"], abs=1e-6)
    assert seen.samples["q"] == pytest.approx(every["q"], abs=1e-9)
    assert seen.samples["v"] == pytest.approx(every["v"], abs=1e-9)
    for name in ("tip_axial", "tip_lateral", "tip_distance", "axial_stroke", "torsion"):
        assert seen.samples[name] == pytest.approx(every[name], abs=1e-9)
    # of the bag, though the scene's geometry is of another experiment
    assert math.degrees(seen.scene.initial.target.theta) == pytest.approx(10.0)
    before = every["t"] < first_touch(run.events).t
    gap = seen.samples["penetration"][before]
    assert gap == pytest.approx(every["penetration"][before], abs=1e-9)
    whole = every["contact_force"] + every["latch_force"]
    assert seen.samples["contact_force"] == pytest.approx(whole, abs=1e-6)
    assert np.isnan(seen.samples["kinetic"]).all()
    # the gap's threshold, or the last sample before, is all that the first touch can be off by
    assert first_touch(seen.events).t == pytest.approx(first_touch(run.events).t, abs=0.011)
    assert verdict(seen) == "captured"
    assert decided_at(seen) == pytest.approx(decided_at(run), abs=1e-6)
    if "/bench/contact" in topics:
        assert seen.samples["walls"].tolist() == every["walls"].tolist()
        assert seen.touches["wall"][0] == run.touches["wall"][0] == 1
        peak = seen.touches["peak_force"].max()
        assert peak == pytest.approx(run.touches["peak_force"].max())
        assert seen.samples["string_tension"] == pytest.approx(every["string_tension"])
    assert len(seen.touches)
    assert all(np.isnan(seen.touches[name]).all() for name in UNMEASURED)


@pytest.mark.parametrize(
    "poses",
    [("/chaser/odom", "/target/odom"), ("/motion_capture/chaser", "/motion_capture/target")],
)
@pytest.mark.parametrize("lost", [0, 1], ids=["chaser lost", "target lost"])
def test_a_gap_of_the_poses_over_the_contact_leaves_the_impact_speed_unmeasured(
    tmp_path, poses, lost
):
    """0.4 s at 0.1 m/s are 40 mm; half of it before the touch is 20 mm, the limit."""
    sensors = "sensors.motion_capture={position_noise: 0, heading_noise: 0}"
    run = capture_sim.simulate("tilt_p10", [sensors])
    recorded = write_run(run, tmp_path / "run.mcap")
    touch, speed = first_touch(run.events), impact_speed(run.events)

    def bag(begin, end):
        def change(topic, data):
            sec, nanosec = struct.unpack_from("<iI", data, 4)
            since = sec - 1 + nanosec / 1e9 - touch.t
            if topic != poses[lost] or not begin < since < end:
                yield from later(topic, data)

        topics = (*poses, "/joint_states", "/contact/wrench")
        path = copied(recorded, tmp_path / f"{end}.mcap", topics=topics, change=change)
        return read_run(path, scene=run.scene, release=0.0)

    near, far = bag(-0.05, 0.3), bag(-0.3, 0.1)
    assert near.summary["impact_speed"] == pytest.approx(speed, rel=0.02)
    assert near.summary["impact_speed_missing"] == ""
    assert math.isnan(impact_speed(far.events))
    assert far.summary["impact_speed"] is None
    assert "impact speed not measured: no poses in the last" in table([far.summary])
    plots.plot(far)


@pytest.mark.parametrize("noise, within", [(0.0, 1.5e-3), (1e-3, 0.02)])
def test_bag_of_motion_capture_alone_is_drawn(tmp_path, noise, within):
    seen_by = f"sensors.motion_capture={{position_noise: {noise}, heading_noise: 0}}"
    run = capture_sim.simulate(capture_sim.load_scene("tilt_p10", [seen_by]))
    recorded = write_run(run, tmp_path / "run.mcap")
    cameras = ("/motion_capture/chaser", "/motion_capture/target", "/joint_states")
    bag = of_a_bench(recorded, tmp_path / "x.mcap", cameras)
    seen = as_drawn(bag, "tilt_0")
    every = run.samples[::10]
    assert seen.samples["t"] == pytest.approx(every["t"], abs=1e-6)
    assert seen.samples["q"] == pytest.approx(every["q"], abs=1e-9 + 6.0 * noise)
    # means of 0.2 s, away from the jumps of a touch; where the mass lands, the acceleration jumps
    # by 0.057 m/s^2 and a mean is off by an eighth of that times 0.2 s
    free = (every["t"] > 0.1) & (every["t"] < first_touch(run.events).t - 0.1)
    assert seen.samples["v"][free] == pytest.approx(every["v"][free], abs=within)
    assert impact_speed(seen.events) == pytest.approx(impact_speed(run.events), abs=within)
    assert verdict(seen) == "captured"


def test_bench_with_a_clock_of_its_own_counts_from_the_arrival_of_the_release(
    run, recorded, tmp_path, capsys
):
    """The launcher's stamp is of the trial; the first second of the chaser's poses is missing."""

    def change(topic, data):
        if topic == "/launcher/command":
            yield topic, "cdr", data
        elif topic != "/chaser/odom" or data[4] != 1:  # of the stamp's second
            yield from later(topic, data)

    topics = (*STANDARD, "/launcher/command", "/capture/status")
    path = copied(recorded, tmp_path / "own.mcap", topics=topics, change=change)
    bag = read_bag(path)
    t = run.samples["t"][1000::10]
    assert tables_of(bag)["/chaser/odom"].fields["t"] == pytest.approx(t, abs=1e-6)
    assert tables_of(bag)["/launcher/command"].fields["t"].tolist() == [0.0, 0.0]
    seen = as_drawn(path, "tilt_0")
    assert seen.samples["t"] == pytest.approx(t, abs=1e-6)
    assert decided_at(seen) == pytest.approx(decided_at(run), abs=1e-6)
    assert main(["detect", str(path), "--scene", "tilt_p10"]) == 0
    told = capsys.readouterr().out
    (line,) = (line for line in told.splitlines() if line.startswith("verdict"))
    assert line.startswith(f"verdict: captured since {decided_at(run):.3f} s; ")
    assert "closest approach in the samples" in line
    assert told.rstrip().endswith("the same")


def test_measurements_after_the_detectors_end_change_no_verdict(run, recorded, tmp_path):
    """The recorder hears of a trial's end later than the detector, and then of a contact.

    The counts of measurements that were not used are read from the last status.
    """
    counts = Counts()
    counts.reject(Source.CHASER, Reason.OUTLIER, 3)
    scene = capture_sim.load_scene("tilt_p10")
    end = first_touch(run.events).t - 0.05

    def until(last, statuses):
        telemetry = DetectorTelemetry(Messages(), "")
        left = list(statuses)

        def change(topic, data):
            seconds, nanoseconds = struct.unpack_from("<iI", data, 4)
            t = seconds - 1 + nanoseconds * 1e-9
            if topic == "/capture/status":
                if left and t > left[0].t - 1e-6:
                    (sent, *_) = telemetry.status(left[0].t, left.pop(0), **rejected(counts))
                    yield topic, "cdr", sent.data
            elif t < last:
                yield topic, "cdr", data

        return change

    topics = (*STANDARD, "/capture/status")
    cut = copied(recorded, tmp_path / "cut.mcap", topics=topics, change=until(end, ()))
    live = detect(read_run(cut), scene)
    assert (live[-1].label, live[-1].final) == ("undecided", True)
    longer = copied(recorded, tmp_path / "on.mcap", topics=topics, change=until(end + 0.5, live))
    again = detect(read_run(longer), scene)
    reported = read_run(longer).given.statuses[-1]
    # the live detector was told of the trial's end, which the first file lacks
    assert live[-1].reason.startswith("the recording was cut, with the tip 49")
    assert again[-1].reason.startswith("run ended before any contact, tip 49")
    assert again[-1]._replace(not_used="chaser: 3 outlier", reason=reported.reason) == reported


@pytest.mark.parametrize("wall", [1, -1, 0])
def test_touches_are_those_that_the_load_cell_shows_everywhere(recorded, tmp_path, wall):
    """A push of 0.1 s on the cone; the tip stays near the wall long after it."""
    begin, lasted, peak = 2.85, 0.1, 50.0

    def pushed(topic, data):
        if topic == "/contact/wrench":
            seconds, nanoseconds = struct.unpack_from("<iI", data, 4)
            phase = (seconds - 1 + nanoseconds * 1e-9 - begin) / lasted
            size = peak * math.sin(math.pi * phase) if 0.0 < phase < 1.0 else 0.0
            force = struct.pack("<6d", 0.8 * size, 0.6 * wall * size, 0.0, 0.0, 0.0, 0.0)
            # of the same size with the padding behind it
            head = data[:-48].replace(b"\x0b\0\0\0chaser/tip\0\0", b"\x0c\0\0\0target/cone\0")
            assert b"target/cone" in head
            topic, data = "/load_cell/wrench", head + force
        yield topic, "cdr", data

    path = copied(recorded, tmp_path / "rig.mcap", topics=STANDARD, change=pushed)
    seen = as_drawn(path, "tilt_p10")
    [touch] = every_touch(seen)
    assert touch["start"] == pytest.approx(begin, abs=0.011)
    assert touch["end"] - touch["start"] == pytest.approx(lasted, abs=0.021)
    assert touch["wall"] == first_touch(seen.events).wall == wall
    assert all(np.isnan(touch[name]) for name in UNMEASURED)
    # the normal force that the axis names, not the magnitude
    half_angle = seen.scene.cone.half_angle
    normal = 0.8 * math.sin(half_angle) + 0.6 * abs(wall) * math.cos(half_angle)
    assert strongest(seen)[1] == pytest.approx(peak * normal, rel=0.01)
    assert seen.samples["normal_force"].max() == pytest.approx(peak * normal, rel=0.02)
    touching = seen.samples["t"][in_contact(seen)]
    assert begin - 0.011 < touching[0] < touching[-1] < begin + lasted + 0.011
    compared, _ = sides(seen, seen)
    of_both = compared.touches
    assert [of_both.start[0], of_both.lasted[0], of_both.peak[0], of_both.wall[0]] == pytest.approx(
        [touch["start"], touch["end"] - touch["start"], touch["peak_force"], wall]
    )


def test_long_title_takes_no_room_from_the_axes_below(run):
    margins = []
    for label in ("short", "long " * 40):
        figure = plots.draw_run(run, label)
        bottom = figure.axes[-1].get_position().y0
        margins.append(bottom * figure.get_figheight())  # inches
    assert margins[1] == pytest.approx(margins[0])


def test_force_without_a_sensor_is_not_measured(recorded, tmp_path):
    topics = [topic for topic in STANDARD if topic != "/contact/wrench"]
    seen = as_drawn(of_a_bench(recorded, tmp_path / "rig.mcap", topics), "tilt_p10")
    summary = seen.summary
    assert summary["touches"] > 0
    assert not has_force(seen)
    for name in ("first_contact_peak_force", "max_normal_force", "normal_impulse"):
        assert summary[name] is None, name
    drawn = plots.draw_run(seen).axes
    assert "Contact force: not measured" in [axes.get_title() for axes in drawn]
    assert "shaded: the tip within" in drawn[-1].get_xlabel()  # that is all that is known


def test_poses_of_another_type_do_not_hinder_the_export_of_what_else_is_there(recorded, tmp_path):
    def change(topic, data):
        yield {"/joint_states": "/motion_capture/chaser"}.get(topic, topic), "cdr", data

    topics = ("/joint_states", "/target/odom", "/launcher/command")
    path = copied(recorded, tmp_path / "odd.mcap", topics=topics, change=change)
    with pytest.raises(RecordingError, match="motion_capture/chaser"):
        as_drawn(path, "tilt_0")
    assert main(["export", str(path), "--to", "csv", "--out", str(tmp_path)]) == 0
    assert (tmp_path / "target_odom.csv").is_file()


def test_release_that_no_message_tells_is_given(run, recorded, tmp_path):
    bag = of_a_bench(recorded, tmp_path / "x.mcap", (*STANDARD, "/capture/status"))
    seen = as_drawn(bag, "tilt_0", release=0.5)
    assert seen.samples["t"] == pytest.approx(run.samples["t"][::10] - 0.5, abs=1e-6)
    assert decided_at(seen) == pytest.approx(decided_at(run) - 0.5, abs=1e-6)
    with pytest.raises(RecordingError, match=r"release = 60 s: must be 0 to [0-9.]+ s"):
        as_drawn(bag, "tilt_0", release=60.0)


def test_messages_of_another_encoding_are_left_out_with_a_word(recorded, tmp_path, capsys):
    """As a bridge writes JSON under the type's name, of a topic of its own and beside CDR."""

    def beside_json(topic, data):
        yield topic, "cdr", data
        if topic in ("/contact/wrench", "/chaser/odom"):
            name = topic if topic == "/contact/wrench" else "/bench/state"
            yield name, "json", b'{"x": 1}'

    bare = of_a_bench(recorded, tmp_path / "bare.mcap")
    path = copied(bare, tmp_path / "json.mcap", change=beside_json)
    told, plain = read_bag(path), read_bag(bare)
    assert told.topics == plain.topics
    assert told.damage == ()
    assert [line.split(":")[0] for line in told.left_out] == ["/bench/state", "/contact/wrench"]
    for topic in STANDARD:
        assert told.raw(topic) == plain.raw(topic)
        assert told.columns(topic).keys() == plain.columns(topic).keys()
    assert set(Playback(path).types) == set(STANDARD)
    assert main(["export", str(path), "--to", "npz", "--out", str(tmp_path)]) == 0
    assert "/bench/state: left out: messages are encoded as 'json'" in capsys.readouterr().err


def test_missing_topic_is_named(recorded, tmp_path):
    bag = of_a_bench(recorded, tmp_path / "x.mcap", STANDARD[:2])
    with pytest.raises(RecordingError, match="neither /bench/buffer nor /joint_states"):
        as_drawn(bag, "tilt_0")
    bag = of_a_bench(recorded, tmp_path / "y.mcap", STANDARD[1:])
    with pytest.raises(
        RecordingError,
        match=r"y.mcap: contains no finite pose of the chaser \(/motion_capture/chaser or /chaser",
    ):
        as_drawn(bag, "tilt_0")
