"""Rerun recordings: the numbers in them, and what a person sees who opens one."""

from __future__ import annotations

import ctypes.util
import io
from pathlib import Path

import numpy as np
import pytest
from full_disk import file_size_limit
from matplotlib.image import imread

import capture_sim
from capture_sim.dynamics.samples import EventKind
from capture_sim.errors import RecordingError
from capture_sim.recording.offline import write_run
from capture_sim.recording.read import read_run
from capture_sim.run.first_contact import first_touch
from capture_sim.viewing import style
from capture_sim.viewing.shapes import tip_in_cone
from capture_sim.viewing.source import resolved

pytest.importorskip("rerun", reason="needs rerun")

from rrd import chunks, column

from capture_sim.viewing.rerun_bench import cone_mesh
from capture_sim.viewing.rerun_layout import blueprint, labelled, ticked
from capture_sim.viewing.rerun_plots import phases
from capture_sim.viewing.rerun_view import save_rrd
from tools.rerun_picture import opened, settled

AXIS_HEIGHT, LABEL_GAP = 16, 12  # pixels
SHOWN = 0.18  # s after the first touch: one tip is latched, one touches, one is free


@pytest.fixture(scope="module")
def rrd(runs, tmp_path_factory):
    """The flow of a user: recorded as MCAP, read back, drawn."""
    folder = tmp_path_factory.mktemp("viewing")
    recorded = [read_run(write_run(run, folder / f"{run.scene.name}.mcap")) for run in runs]
    return save_rrd(recorded, folder / "runs.rrd")


@pytest.fixture(scope="module")
def found(rrd):
    """What is in it, by entity."""
    return chunks(rrd)


def test_rrd_holds_the_numbers_of_every_run(rrd, found, runs):
    # docs/evidence/node_suite.md: 500 bytes a sample
    assert rrd.stat().st_size < 500 * sum(len(run.samples) for run in runs)
    for run in runs:
        name, samples = run.scene.name, run.samples
        for plot, expected in (
            ("axial_stroke", samples["axial_stroke"] * 1e3),
            ("torsion", samples["torsion"] * 1e3),
            ("distance", samples["tip_distance"] * 1e3),
            ("string_tension", samples["string_tension"]),
        ):
            times, values = column(found, f"/plots/{plot}/{name}", "scalars")
            assert values.tolist() == expected.tolist()
            assert times * 1e-9 == pytest.approx(samples["t"], abs=1e-9)
        _, speeds = column(found, f"/plots/speed/{name}", "scalars")
        v = samples["v"]
        assert speeds[:, 0] == pytest.approx(np.hypot(v[:, 0], v[:, 1]) * 1e3)
        assert speeds[:, 1] == pytest.approx(np.hypot(v[:, 5], v[:, 6]) * 1e3)
        _, energy = column(found, f"/plots/energy/{name}", "scalars")
        # kinetic + dissipated + elastic = work of the mass, to the ledger's residual
        balance = samples["work_string"] + samples["energy_residual"] + samples["kinetic"][0]
        assert energy.sum(axis=1) == pytest.approx(balance * 1e3, abs=1e-9)
        _, place = column(found, f"/{name}/world/target", "translation")
        assert place[:, :2] == pytest.approx(samples["q"][:, 5:7], abs=1e-6)
        _, turn = column(found, f"/{name}/world/target", "quaternion")
        assert 2 * np.arctan2(turn[:, 2], turn[:, 3]) == pytest.approx(samples["q"][:, 7], abs=1e-6)
        _, tip = column(found, f"/{name}/close_up/tip", "positions")
        assert tip == pytest.approx(tip_in_cone(samples) * 1e3, abs=1e-4)


def test_an_arrow_of_force_is_bounded(found, runs):
    """3 mm for 1 N, and 0.12 m for 40 N and more."""
    for run in runs:
        _, vectors = column(found, f"/{run.scene.name}/world/contact_force", "vectors")
        lengths = np.linalg.norm(vectors, axis=1)
        force = np.linalg.norm(run.samples["contact_force"], axis=1)
        assert lengths == pytest.approx(np.minimum(3e-3 * force, 0.12), abs=1e-6)
        assert force.max() > 40.0


def test_every_touch_is_in_the_curve_and_marked(found, runs):
    for run in runs:
        path = f"/plots/contact_force/{run.scene.name}"
        times, force = column(found, path, "scalars")
        marked, peaks = column(found, f"{path}/touches", "scalars")
        assert sorted(peaks) == sorted(run.touches["peak_force"])
        for touch in run.touches:
            when = round(float(touch["peak_time"]) * 1e9)
            assert force[np.abs(times - when).argmin()] == touch["peak_force"]
            assert np.abs(marked - when).min() <= 1


def test_aligned_time_begins_a_tenth_before_the_first_touch(found, runs):
    for run in runs:
        name = run.scene.name
        for path, ending in (
            (f"/{name}/world/chaser", "translation"),
            (f"/plots/distance/{name}", "scalars"),
            (f"/states/{name}/phase", "state"),
        ):
            aligned, values = column(found, path, ending, "since_first_touch")
            assert aligned[0] == -100_000_000, path
            assert aligned[-1] * 1e-9 < 1.2
            whole, others = column(found, path, ending)
            # the same rows without a gap, earlier by the time of the first touch
            late = round(first_touch(run.events).t * 1e9)
            start = np.searchsorted(whole, aligned[1] + late - 2)
            assert np.abs(whole[start : start + len(aligned) - 1] - late - aligned[1:]).max() <= 2
            assert np.array_equal(others[start - 1 : start - 1 + len(values)], values)


def test_phases_begin_at_their_events(runs):
    for run in runs:
        times, names = phases(run, run.samples)
        assert np.all(np.diff(times) >= 0)
        contacts = [t for t, name in zip(times, names, strict=True) if name == "contact"]
        touches = [event.t for event in run.events if event.kind is EventKind.TOUCH]
        assert contacts[0] == touches[0]
        assert set(contacts) <= set(touches)
        [latched] = [event.t for event in run.events if event.kind is EventKind.LATCHED]
        assert 0.0 <= times[names.index("latched")] - latched <= 1e-3
        order = ["held", "taut", "coast", "free", "contact", "latched"]
        assert list(dict.fromkeys(names)) == order[names[0] != "held" :]


def test_the_lane_of_phases_ends_in_the_touch_that_is_in_progress():
    touch = capture_sim.simulate("tilt_0").touches[-1]
    cut = capture_sim.simulate("tilt_0", t_end=0.5 * float(touch["start"] + touch["end"]))
    times, names = phases(cut, cut.samples)
    assert names[-1] == "contact"
    assert times[-1] == pytest.approx(touch["start"], abs=1e-6)


def test_rrd_has_verdict_scene_and_events(found, runs):
    for run in runs:
        name = run.scene.name
        [chunk] = found[f"/__properties/{name}"]
        text = str(chunk.to_record_batch().to_pylist())
        assert "captured" in text
        assert "drop_height" in text
        _, verdicts = column(found, f"/states/{name}/verdict", "state")
        assert verdicts.tolist() == ["approach", "contact", "captured"]
        _, events = column(found, f"/events/{name}", "text")
        assert len(events) == len(run.events)
        assert f"/{name}/scene" in found


def test_two_runs_of_one_name_without_a_touch_and_with_stops(tmp_path):
    stops = ["stops={compression: 0.009, extension: 0.012, stiffness: 1.0e+5, damping: 50.0}"]
    run = capture_sim.simulate(capture_sim.load_scene("tilt_0", stops), t_end=1.0)
    found = chunks(save_rrd([run, run], tmp_path / "stops.rrd"))
    for name in ("tilt_0_1", "tilt_0_2"):
        assert len(column(found, f"/plots/distance/{name}", "scalars")[0]) == len(run.samples)
        assert f"/{name}/world/chaser/cylinder/stop_extension" in found
    assert set(column(found, "/plots/axial_stroke/stop_inwards", "scalars")[1]) == {-9.0}


def test_window_is_drawn_finely_and_opens_at_its_first_sample(runs, tmp_path):
    touch = runs[1].touches[0]
    window = (float(touch["start"]) - 2e-4, float(touch["end"]) + 2e-4)
    found = chunks(save_rrd([resolved(runs[1], window)], tmp_path / "window.rrd", window=window))
    drawn, _ = column(found, "/plots/axial_stroke/tilt_p10", "scalars")
    assert drawn[[0, -1]] * 1e-9 == pytest.approx(window, abs=2e-6)
    assert np.diff(drawn).max() < 1000  # ns
    aligned, _ = column(found, "/plots/axial_stroke/tilt_p10", "scalars", "since_first_touch")
    late = first_touch(runs[1].events).t
    assert aligned[[0, -1]] * 1e-9 == pytest.approx(np.subtract(window, late), abs=2e-6)


def test_scene_without_a_string_has_no_plot_of_its_tension():
    def views(scene):
        found, pending = [], [blueprint([scene], ["a"], ["a"], aligned=False).root_container]
        while pending:
            part = pending.pop()
            pending += getattr(part, "contents", []) if hasattr(part, "kind") else []
            found.append(str(part.name))
        return found

    assert "string tension, N" in views(capture_sim.load_scene("tilt_0"))
    assert "string tension, N" not in views(capture_sim.load_scene("paper_designed"))


@pytest.mark.parametrize(
    "values, expected",
    [
        ((-8.8, 8.0), (-10, 10)),
        ((-0.1, 0.99), (0, 1)),
        ((0.5, 118.0), (0, 100)),
        ((0, 54), (0, 50)),
    ],
)
def test_axes_have_two_labels_at_least(values, expected):
    low, high = ticked(*values)
    assert low <= values[0] < values[1] <= high
    assert low <= expected[0] < expected[1] <= high
    assert high - low < 1.3 * (values[1] - values[0])


@pytest.mark.parametrize("end", [2e-3, 0.3, 0.85, 1.0, 1.3, 1.7, 2.9, 12.0])
def test_a_time_axis_has_three_labels_at_least(end):
    """Labels are at multiples of a power of ten of seconds, where they have room for their text."""
    low, high = labelled(-0.1 * end, end)
    assert (low, high >= end) == (-0.1 * end, True)
    steps = [10.0**k for k in range(-6, 3) if 10.0**k >= 0.08 * (high - low)]
    assert np.floor(high / steps[0]) - np.ceil(low / steps[0]) >= 2
    assert high - low < 2.1 * 1.1 * end


def test_cone_mesh_joins_inner_edge_and_lip(runs):
    cone = runs[0].scene.cone
    vertices, triangles = cone_mesh(cone)
    radii = np.hypot(vertices[:, 1], vertices[:, 2])
    slope = np.ptp(vertices[:, 0]) / np.ptp(radii)
    assert radii.min() == pytest.approx(cone.R_c)
    assert slope == pytest.approx(1.0 / np.tan(cone.half_angle))
    assert (triangles.min(), triangles.max()) == (0, len(vertices) - 1)
    assert (vertices[:, 2] < 1e-9).all()  # open above


def test_full_disk_and_a_file_for_a_folder_are_one_line(runs, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="cannot write"):
        save_rrd(runs, tmp_path / "file" / "x.rrd")
    match = r"runs\.rrd: cannot write"
    with file_size_limit(20_000), pytest.raises(RecordingError, match=match):
        save_rrd(runs, tmp_path / "runs.rrd")
    assert not (tmp_path / "runs.rrd").exists()


# what a person sees


def software_vulkan():
    """Return whether Mesa's software Vulkan is there, to draw without a graphics card."""
    drivers = [*Path("/usr/share/vulkan/icd.d").glob("lvp_icd*.json")]
    return bool(drivers) and ctypes.util.find_library("vulkan") is not None


def labels_of_time(diagram):
    """Return the number of labels below a diagram: bright columns, a dark gap between labels."""
    [bright] = np.nonzero((diagram[-AXIS_HEIGHT:, :, :3].min(axis=-1) > 0.5).any(axis=0))
    return 1 + int((np.diff(bright) > LABEL_GAP).sum())


@pytest.mark.long
@pytest.mark.skipif(not software_vulkan(), reason="needs mesa-vulkan-drivers and libvulkan1")
def test_it_opens_paused_before_the_first_touch_with_every_run_in_its_colour(rrd, runs):
    with opened(rrd) as viewer:
        [recording] = viewer.get_state().recordings
        assert recording.current_timeline == "since_first_touch"
        assert recording.current_time == -100_000_000
        viewer.set_time("since_first_touch", duration=SHOWN, play_state="paused")
        views = viewer.get_state().views
        assert len(views) >= 2 * len(runs)
        assert all(not view.reports for view in views), [view.reports for view in views]
        image = imread(io.BytesIO(settled(viewer)))[..., :3] * 255
        for name in ("contact_force", "torsion"):
            [view] = [view for view in views if view.origin == f"/plots/{name}"]
            # every 0.1 s: two labels at the ends of 1 s do not show when a touch was
            assert labels_of_time(imread(io.BytesIO(settled(viewer, view.view_id)))) >= 8
    columns = image.shape[1] // 2
    for i, colour in enumerate(style.RUNS[: len(runs)]):
        near = np.abs(image - style.rgb(colour)).max(axis=-1) < 12
        assert near[:, columns:].sum() > 100  # its curves
        row = near[image.shape[0] * i // len(runs) : image.shape[0] * (i + 1) // len(runs)]
        assert row[:, :columns].sum() > 20  # its tip or path, in its own row
