"""Rerun recordings: the numbers in them, and what a person sees who opens one."""

from __future__ import annotations

import ctypes.util
import io
import time
from pathlib import Path

import numpy as np
import pytest
from full_disk import file_size_limit
from matplotlib.colors import to_rgb
from matplotlib.image import imread

import capture_sim
from capture_sim.errors import RecordingError
from capture_sim.recording.offline import write_run
from capture_sim.recording.read import read_run
from capture_sim.samples import EventKind, Phase
from capture_sim.viewing import style
from capture_sim.viewing.shapes import tip_in_cone
from capture_sim.viewing.source import first_touch, in_contact, resolved

pytest.importorskip("rerun", reason="needs rerun")

from rrd import chunks, column

from capture_sim.viewing.rerun_bench import cone_mesh
from capture_sim.viewing.rerun_plots import PLOTS, phases
from capture_sim.viewing.rerun_view import save_rrd
from tools.rerun_picture import opened, settled

SHOWN = 0.18  # s after the first touch: one tip is latched, one touches, one is free


@pytest.fixture(scope="module")
def rrd(runs, tmp_path_factory):
    """The way of a user: recorded as MCAP, read back, drawn."""
    folder = tmp_path_factory.mktemp("viewing")
    recorded = [read_run(write_run(run, folder / f"{run.scene.name}.mcap")) for run in runs]
    return save_rrd(recorded, folder / "runs.rrd")


@pytest.fixture(scope="module")
def found(rrd):
    """What is in it, by entity."""
    return chunks(rrd)


def test_rrd_holds_the_numbers_of_every_run(rrd, found, runs):
    # 30 MB for three runs of 20 s at 1 kHz (benchmarks/viewing.py): 500 bytes a sample
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
        # kinetic + dissipated + elastic = what the mass gave, to the ledger's residual
        balance = samples["work_string"] + samples["energy_residual"] + samples["kinetic"][0]
        assert energy.sum(axis=1) == pytest.approx(balance * 1e3, abs=1e-9)
        _, place = column(found, f"/{name}/world/target", "translation")
        assert place[:, :2] == pytest.approx(samples["q"][:, 5:7], abs=1e-6)
        _, turn = column(found, f"/{name}/world/target", "quaternion")
        assert 2 * np.arctan2(turn[:, 2], turn[:, 3]) == pytest.approx(samples["q"][:, 7], abs=1e-6)
        _, tip = column(found, f"/{name}/close_up/tip", "positions")
        assert tip == pytest.approx(tip_in_cone(samples) * 1e3, abs=1e-4)


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
            (f"/{name}/close_up/tip", "positions"),
            (f"/plots/distance/{name}", "scalars"),
            (f"/states/{name}/phase", "state"),
        ):
            aligned, values = column(found, path, ending, "since_first_touch")
            assert aligned[0] == -100_000_000, path
            whole, others = column(found, path, ending)
            # the same rows, late by the first touch, without a gap
            late = round(first_touch(run).t * 1e9)
            start = np.searchsorted(whole, aligned[1] + late - 2)
            assert np.abs(whole[start : start + len(aligned) - 1] - late - aligned[1:]).max() <= 2
            assert np.array_equal(others[start - 1 : start - 1 + len(values)], values)
            assert aligned[-1] * 1e-9 < 1.2


def test_phases_change_when_the_events_say(runs):
    for run in runs:
        times, names = phases(run)
        assert np.all(np.diff(times) >= 0)
        contacts = [t for t, name in zip(times, names, strict=True) if name == "contact"]
        touches = [event.t for event in run.events if event.kind is EventKind.TOUCH]
        assert contacts[0] == touches[0]
        assert set(contacts) <= set(touches)
        [latched] = [event.t for event in run.events if event.kind is EventKind.LATCHED]
        [shown] = [t for t, name in zip(times, names, strict=True) if name == "latched"]
        assert 0.0 <= shown - latched <= 1e-3
        assert (
            list(dict.fromkeys(names))
            == ["held", "taut", "coast", "free", "contact", "latched"][names[0] != "held" :]
        )


def test_rrd_tells_verdict_scene_and_events(found, runs):
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
        assert any("latched" in event for event in events)
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
    found = chunks(save_rrd([resolved(runs[1], window)], tmp_path / "window.rrd"))
    drawn, _ = column(found, "/plots/axial_stroke/tilt_p10", "scalars")
    assert drawn[0] * 1e-9 >= window[0] - 1e-9
    assert drawn[-1] * 1e-9 <= window[1] + 1e-9
    assert np.diff(drawn).max() < 1000  # ns
    times = []
    for path in found:
        for chunk in found[path]:
            batch = chunk.to_record_batch()
            if "since_first_touch" in batch.schema.names:
                times += batch.column("since_first_touch").to_numpy().astype("i8").tolist()
    late = first_touch(runs[1]).t
    assert min(times) * 1e-9 == pytest.approx(window[0] - late, abs=2e-6)
    assert max(times) * 1e-9 == pytest.approx(window[1] - late, abs=2e-6)


def test_scene_without_a_string_has_no_diagram_of_its_tension(tmp_path):
    from capture_sim.viewing.rerun_layout import blueprint

    def views(scene):
        layout = blueprint([scene], ["a"], ["a"], aligned=False)
        found, pending = [], [layout.root_container]
        while pending:
            part = pending.pop()
            pending += getattr(part, "contents", []) if hasattr(part, "kind") else []
            found.append(str(part.name))
        return found

    assert "string tension, N" in views(capture_sim.load_scene("tilt_0"))
    assert "string tension, N" not in views(capture_sim.load_scene("paper_designed"))


def test_cone_mesh_joins_inner_edge_and_lip(runs):
    cone = runs[0].scene.cone
    vertices, triangles = cone_mesh(cone)
    radii = np.hypot(vertices[:, 1], vertices[:, 2])
    slope = (vertices[:, 0].max() - vertices[:, 0].min()) / (radii.max() - radii.min())
    assert radii.min() == pytest.approx(cone.R_c)
    assert slope == pytest.approx(1.0 / np.tan(cone.half_angle))
    assert triangles.min() == 0
    assert triangles.max() == len(vertices) - 1
    assert (vertices[:, 2] < 1e-9).all()  # open above


# what a person sees


def software_vulkan():
    """Return whether Mesa's software Vulkan is there, to draw without a graphics card."""
    drivers = [*Path("/usr/share/vulkan/icd.d").glob("lvp_icd*.json")]
    return bool(drivers) and ctypes.util.find_library("vulkan") is not None


@pytest.fixture(scope="module")
def viewer(rrd):
    """A viewer without a screen that has opened the recording, and its client."""
    if not software_vulkan():
        pytest.skip("needs mesa-vulkan-drivers and libvulkan1 to draw headless")
    with opened(rrd) as client:
        yield client


def test_it_opens_paused_shortly_before_the_first_touch(viewer):
    [recording] = viewer.get_state().recordings
    assert recording.current_timeline == "since_first_touch"
    assert recording.current_time == -100_000_000
    time.sleep(0.5)
    assert viewer.get_state().recordings[0].current_time == -100_000_000
    spans = {timeline.name: timeline.end for timeline in recording.timelines}
    assert spans["sim_time"] > 6e9


def test_every_view_shows_every_run_in_its_colour(viewer, runs, tmp_path):
    views = viewer.get_state().views
    assert len(views) >= 2 * len(runs)
    assert all(not view.reports for view in views), [view.reports for view in views]
    by_title = {view.name: view for view in views}
    viewer.set_time("since_first_touch", duration=SHOWN, play_state="paused")
    settled(viewer)
    lateral, opening, touching, latched = [], [], [], []
    for run, colour in zip(runs, style.RUNS, strict=False):
        name = run.scene.name
        bench = picture(
            viewer, next(v for t, v in by_title.items() if t.startswith(f"{name}: cap"))
        )
        # the vehicles are large: both bodies together are a good part of the view
        assert grey_area(bench) > 0.12 * bench.shape[0] * bench.shape[1]
        # the tip is drawn shaded: count by hue
        assert hue_area(bench, to_rgb(colour)) > 60
        rows, columns = np.nonzero(hue_mask(bench, to_rgb(style.CONE)))
        opening.append(rows.mean() / bench.shape[0])
        assert 0.4 < columns.mean() / bench.shape[1] < 0.8
        cone = picture(viewer, by_title[f"{name}: in the cone, mm"])
        now = round((first_touch(run).t + SHOWN) * 1000)
        touches = in_contact(run)[now]
        shown = style.rgb(colour) if touches else style.light(style.rgb(colour))
        if run.samples["phase"][now] == Phase.LATCHED:
            shown = style.rgb(style.ZONE)
            latched.append(run.scene.name)
        mask = hue_mask(cone, np.array(shown) / 255)
        assert mask.sum() > 0.01 * mask.size
        lateral.append(np.nonzero(mask)[0].mean() / mask.shape[0])
        touching.append(bool(touches))
    assert 0 < sum(touching) < len(runs)
    assert latched == ["tilt_0"]
    # seen from above, +y is up: compare with where the tips really are
    k = [round((first_touch(run).t + SHOWN) * 1000) for run in runs]
    truth = [-float(run.samples["tip_lateral"][i]) for run, i in zip(runs, k, strict=True)]
    assert np.argsort(lateral).tolist() == np.argsort(truth).tolist()
    # the cones in 3D open to the left: +10 degrees further down (to -y), -10 further up
    assert opening[1] > opening[0] + 0.01 > opening[2] + 0.02
    for entity, plot in PLOTS.items():
        if entity == "string_tension":
            continue  # slack by then: behind its tab
        diagram = picture(viewer, by_title[plot.title])
        for colour in style.RUNS[:3]:
            assert hue_area(diagram, to_rgb(colour)) >= 40, plot.title
    states = picture(viewer, by_title["phase and verdict"])
    for colour in (style.CONTACT, style.ZONE):
        assert hue_area(states, to_rgb(colour)) > 300


def picture(viewer, view):
    """Of a viewer that has settled as a whole: nothing moves any more."""
    deadline = time.monotonic() + 300.0
    while True:
        try:
            return imread(io.BytesIO(viewer.take_screenshot(view.view_id)))[..., :3]
        except TimeoutError:  # the machine is busy
            assert time.monotonic() < deadline


def grey_area(image):
    """Return how many pixels are the grey of the vehicles, in any light."""
    grey = (np.ptp(image, axis=-1) < 0.02) & (image.max(axis=-1) > 0.15)
    return int((grey & (image.max(axis=-1) < 0.8)).sum())


def hue_mask(image, colour):
    """Return where a picture has a colour in any brightness from half of it up."""
    wanted = np.array(colour)
    scale = image.max(axis=-1, keepdims=True) / wanted.max()
    near = np.abs(image - scale * wanted).max(axis=-1) < 0.06
    return near & (scale[..., 0] > 0.5) & (np.ptp(image, axis=-1) > 0.12)


def hue_area(image, colour):
    return int(hue_mask(image, colour).sum())


def test_full_disk_is_a_line_and_leaves_no_file(runs, tmp_path):
    with (
        file_size_limit(20_000),
        pytest.raises(RecordingError, match=r"runs\.rrd: cannot write"),
    ):
        save_rrd(runs, tmp_path / "runs.rrd")
    assert list(tmp_path.iterdir()) == []
