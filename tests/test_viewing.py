"""Pictures: the shapes in them, the numbers behind them, and what a person would see."""

from __future__ import annotations

import ctypes.util
import math
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.image import imread

import capture_sim
from capture_sim.errors import RecordingError
from capture_sim.recording import read_run, write_run
from capture_sim.samples import EventKind
from capture_sim.viewing import palette, plots
from capture_sim.viewing.bench_drawing import draw_bench
from capture_sim.viewing.bench_model import cone_mesh
from capture_sim.viewing.cone_drawing import key_moments
from capture_sim.viewing.geometry import tip_bound, tip_in_cone, tip_in_world, wall
from capture_sim.viewing.source import decided_at, headline, in_contact, time_window, verdict

NAMES = ("tilt_0", "tilt_p10", "tilt_m10")
SHOWN = 2.86  # s, of the pictured instant: some tips touch, some do not


@pytest.fixture(scope="module")
def runs():
    return [capture_sim.simulate(capture_sim.load_scene(name)) for name in NAMES]


@pytest.fixture(scope="module")
def rebound():
    return capture_sim.simulate(capture_sim.load_scene("paper_undamped"))


@pytest.fixture(scope="module")
def rrd(runs, tmp_path_factory):
    pytest.importorskip("rerun", reason="needs rerun")
    from capture_sim.viewing import save_rrd

    return save_rrd(runs, tmp_path_factory.mktemp("viewing") / "runs.rrd")


# shapes


def distance_to_segment(point, ends):
    a, b = ends
    along = np.clip(np.dot(point - a, b - a) / np.dot(b - a, b - a), 0.0, 1.0)
    return np.linalg.norm(point - (a + along * (b - a)))


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("beta", [0.3, math.pi / 4, 1.2])
def test_bound_of_the_tip_lies_one_radius_off_the_wall_on_its_inner_side(runs, side, beta):
    scene = capture_sim.load_scene("tilt_0", [f"cone.beta={beta}", "string.drop_height=0.05"])
    ends = wall(scene.cone, side)
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(scene.cone.L_c)
    assert ends[0].tolist() == [0.0, side * scene.cone.R_c]
    assert ends[1][0] < 0.0 < side * (ends[1][1] - ends[0][1])
    bound = tip_bound(scene.cone, scene.probe.tip_radius, side)
    distances = [distance_to_segment(point, ends) for point in bound]
    assert distances == pytest.approx([scene.probe.tip_radius] * len(bound))
    # it starts in the throat and ends outside of the lip
    assert bound[0] == pytest.approx([0.0, side * (scene.cone.R_c - scene.probe.tip_radius)])
    assert bound[-1][0] < ends[1][0]


def test_tip_in_cone_and_in_world_agree(runs):
    for run in runs:
        q = run.samples["q"]
        world = tip_in_world(run.scene, q)
        # into the target's frame by complex numbers
        local = (world - q[:, 5:7]) @ [1, 1j] * np.exp(-1j * q[:, 7]) + run.scene.cone.L_T
        assert tip_in_cone(run.samples) @ [1, 1j] == pytest.approx(local, abs=1e-12)


def test_touching_tip_lies_on_the_bound(rebound):
    tips = tip_in_cone(rebound.samples)[rebound.samples["walls"] == 1]
    ends = wall(rebound.scene.cone, 1)
    distances = np.array([distance_to_segment(tip, ends) for tip in tips])
    assert len(tips) > 100
    assert np.abs(distances - rebound.scene.probe.tip_radius).max() < 1e-4


def test_cone_mesh_joins_inner_edge_and_lip(runs):
    cone = runs[0].scene.cone
    vertices, triangles = cone_mesh(cone)
    radii = np.hypot(vertices[:, 1], vertices[:, 2])
    slope = (vertices[:, 0].max() - vertices[:, 0].min()) / (radii.max() - radii.min())
    assert radii.min() == pytest.approx(cone.R_c)
    assert slope == pytest.approx(1.0 / math.tan(cone.beta))
    assert triangles.min() == 0
    assert triangles.max() == len(vertices) - 1
    assert (vertices[:, 2] < 1e-9).all()  # open above


# what is told of a run


def test_headline_tells_name_verdict_and_impact(runs, rebound):
    assert headline(runs[0]) == "tilt_0: captured, impact at 0.100 m/s"
    assert headline(rebound).startswith("paper_undamped: rebound")


def test_short_touches_count_as_contact(rebound):
    touching = in_contact(rebound)
    t = rebound.samples["t"]
    for touch in rebound.touches:
        k = int(np.searchsorted(t, touch["start"], side="right")) - 1
        assert touching[k]
    assert touching.sum() > (rebound.samples["walls"] != 0).sum()
    # the share of the time agrees with the located touches
    shorter = (rebound.touches["end"] - rebound.touches["start"]).sum()
    assert shorter < touching.sum() * 1e-3 < shorter + 2e-3 * len(rebound.touches)


def test_moments_are_those_of_the_events(runs, rebound):
    for run in runs:
        moments = key_moments(run)
        first = next(e for e in run.events if e.kind is EventKind.TOUCH)
        latched = next(e for e in run.events if e.kind is EventKind.LATCHED)
        assert moments[0].t == first.t
        assert moments[-1].t == latched.t
        assert np.linalg.norm(moments[-1].place) == pytest.approx(run.scene.latch.radius, rel=0.02)
    assert [m.meaning.split(",")[0] for m in key_moments(rebound)][-2:] == [
        "nearest",
        "end of the run",
    ]


def test_verdict_is_marked_when_it_fell(runs):
    for run in runs:
        assert verdict(run) == run.summary["verdict"]
        final = [status.t for status in run.statuses if status.final]
        assert decided_at(run) == final[0]
        start, end = time_window(run)
        assert start < run.touches["start"].min() < final[0] < end


# figures


def test_figure_shows_walls_zone_and_forces(runs, tmp_path):
    for run in runs:
        path = plots.save_figure(run, tmp_path / "new" / f"{run.scene.name}.png")
        image = imread(path)[..., :3]
        assert image.shape[1] >= 1500
        sides = set(run.touches["wall"].tolist())
        assert area(image, palette.PLUS_WALL) > 2000
        assert area(image, palette.MINUS_WALL) > 2000
        assert area(image, palette.GREEN) > 300
        assert area(image, palette.BLACK) > 10_000
        assert sides  # each experiment touches before it is captured


def area(image, colour):
    """Return how many pixels have a colour, as near as the edges' smoothing lets them."""
    return int((np.abs(image - np.array(to_rgb(colour))).max(axis=-1) < 0.03).sum())


def test_figure_is_the_same_from_the_run_and_from_its_recording(runs, tmp_path):
    run = runs[1]
    recorded = read_run(write_run(run, tmp_path / "run.mcap"))
    first = plots.save_figure(run, tmp_path / "a.png").read_bytes()
    assert plots.save_figure(recorded, tmp_path / "b.png").read_bytes() == first


def test_plotted_forces_are_the_recorded_ones(rebound):
    figure = plots.draw_run(rebound)
    force = next(axes for axes in figure.axes if "normal force" in axes.get_ylabel())
    peaks = np.concatenate(
        [line.get_ydata() for line in force.get_lines() if "touches" in str(line.get_label())]
    )
    assert sorted(peaks) == sorted(rebound.touches["peak_force"])
    low, high = force.get_ylim()
    assert low < rebound.touches["peak_force"].max() < high
    assert force.get_yscale() == "log"


def test_every_axis_has_its_unit(runs, rebound):
    for figure in (plots.draw_run(rebound), plots.draw_overview(runs)):
        for axes in figure.axes:
            assert "[" in axes.get_ylabel()
            shared = not axes.xaxis.get_tick_params()["labelbottom"] or not axes.get_xlabel()
            assert shared or "[" in axes.get_xlabel()
            assert axes.yaxis.label.get_fontsize() >= 11


def test_target_is_drawn_turned_the_right_way(runs):
    from matplotlib.figure import Figure

    for run, degrees in zip(runs, (0.0, 10.0, -10.0), strict=True):
        axes = Figure().add_subplot()
        draw_bench(axes, run)
        edges = [
            line.get_xydata()[0]
            for line in axes.get_lines()
            if line.get_color() in (palette.PLUS_WALL, palette.MINUS_WALL)
        ]
        axis = np.mean(edges, axis=0) - (run.scene.initial.target.x, run.scene.initial.target.y)
        # BE lies on the target's -x side: turned to the left, it moves to -y
        turned = math.degrees(math.atan2(-axis[1], -axis[0]))
        assert turned == pytest.approx(degrees, abs=0.1)


def test_overview_has_a_column_for_each_run(runs, tmp_path):
    image = imread(plots.save_overview(runs, tmp_path / "overview.png"))[..., :3]
    width = image.shape[1] // len(runs)
    for i in range(len(runs)):
        column = image[:, i * width : (i + 1) * width]
        assert area(column, palette.PLUS_WALL) > 1500
        assert area(column, palette.MINUS_WALL) > 1500


def test_run_without_a_touch_is_drawn_too(tmp_path):
    run = capture_sim.simulate(capture_sim.load_scene("tilt_0"), t_end=1.0)
    assert "no touch" in headline(run)
    assert plots.save_figure(run, tmp_path / "x.png").stat().st_size > 10_000
    pytest.importorskip("rerun", reason="needs rerun")
    from capture_sim.viewing import save_rrd

    assert save_rrd([run], tmp_path / "x.rrd").stat().st_size > 10_000


def test_unwritable_folder_is_refused_in_one_line(runs, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="cannot write"):
        plots.save_figure(runs[0], tmp_path / "file" / "x.png")
    pytest.importorskip("rerun", reason="needs rerun")
    from capture_sim.viewing import save_rrd

    with pytest.raises(RecordingError, match="cannot write"):
        save_rrd(runs, tmp_path / "file" / "x.rrd")


def test_colours_of_runs_differ_also_for_the_colour_blind():
    # simulated by the matrices of Vienot, Brettel and Mollon (1999), linear light
    protan = np.array([[0.11238, 0.88762, 0.0], [0.11238, 0.88762, 0.0], [0.00401, -0.00401, 1.0]])
    deutan = np.array([[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]])
    colours = np.array([to_rgb(colour) for colour in palette.RUNS[:3]]) ** 2.2
    for matrix in (np.eye(3), protan, deutan):
        seen = (colours @ matrix.T).clip(0.0, 1.0) ** (1 / 2.2)
        for i in range(3):
            for j in range(i):
                assert np.abs(seen[i] - seen[j]).max() > 0.15


# rerun


def chunks(rrd):
    from rerun.chunk import RrdReader

    by_path = {}
    for chunk in RrdReader(rrd).stream():
        by_path.setdefault(str(chunk.entity_path), []).append(chunk)
    return by_path


def column(found, path, ending):
    """Return times (s) and values of a component, by time."""
    times, values = [], []
    for chunk in found[path]:
        batch = chunk.to_record_batch()
        names = [n for n in batch.schema.names if n.endswith(ending)]
        if chunk.is_static or not names:
            continue
        index = batch.column("sim_time")
        times += [
            v.value * 1e-9 if hasattr(v, "value") else v for v in index.to_numpy().astype("i8")
        ]
        values += [row[0] for row in batch.column(names[0]).to_pylist()]
    order = np.argsort(times, kind="stable")
    return np.array(times)[order], np.array(values)[order]


def test_rrd_holds_the_numbers_of_every_run(rrd, runs):
    found = chunks(rrd)
    for run in runs:
        name, samples = run.scene.name, run.samples
        for plot, expected in (
            ("axial_stroke", samples["axial_stroke"] * 1e3),
            ("distance", samples["tip_distance"] * 1e3),
            ("string_tension", samples["string_tension"]),
        ):
            times, values = column(found, f"/plots/{plot}/{name}", "scalars")
            assert values.tolist() == expected.tolist()
            assert times * 1e-9 == pytest.approx(samples["t"], abs=1e-9)
        _, force = column(found, f"/plots/contact_force/{name}", "scalars")
        assert force.max() == run.touches["peak_force"].max()
        _, place = column(found, f"/{name}/world/target", "translation")
        assert place[:, :2] == pytest.approx(samples["q"][:, 5:7], abs=1e-6)
        _, turn = column(found, f"/{name}/world/target", "quaternion")
        assert 2 * np.arctan2(turn[:, 2], turn[:, 3]) == pytest.approx(samples["q"][:, 7], abs=1e-6)
        _, tip = column(found, f"/{name}/close_up/tip", "positions")
        assert tip == pytest.approx(tip_in_cone(samples) * 1e3, abs=1e-4)


def test_rrd_of_three_runs_is_made_in_two_seconds_and_small(rrd, runs, tmp_path):
    from capture_sim.viewing import save_rrd

    began = time.perf_counter()
    path = save_rrd(runs, tmp_path / "again.rrd")
    assert time.perf_counter() - began < 2.0
    assert path.stat().st_size < 15e6


def test_rrd_tells_verdict_and_scene(rrd, runs):
    found = chunks(rrd)
    properties = [path for path in found if "properties" in path]
    texts = " ".join(
        str(chunk.to_record_batch().to_pylist()) for path in properties for chunk in found[path]
    )
    for run in runs:
        assert f"/__properties/{run.scene.name}" in properties
    assert texts.count("captured") >= len(runs)
    assert "drop_height" in texts


def test_runs_of_one_name_are_kept_apart(runs, tmp_path):
    pytest.importorskip("rerun", reason="needs rerun")
    from capture_sim.viewing import save_rrd

    found = chunks(save_rrd([runs[0], runs[0]], tmp_path / "twice.rrd"))
    assert {"/plots/distance/tilt_0_1", "/plots/distance/tilt_0_2"} <= set(found)


def software_vulkan():
    """Return whether Mesa's software Vulkan is there, to draw without a graphics card."""
    drivers = [*Path("/usr/share/vulkan/icd.d").glob("lvp_icd*.json")]
    return bool(drivers) and ctypes.util.find_library("vulkan") is not None


@pytest.mark.skipif(
    not software_vulkan(), reason="needs mesa-vulkan-drivers and libvulkan1 to draw headless"
)
def test_picture_of_the_rrd_as_a_person_sees_it(rrd, runs, tmp_path):
    experimental = pytest.importorskip("rerun.experimental", reason="needs rerun")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "rerun", str(rrd), "--headless", "--bind", "127.0.0.1"]
    command += ["--port", str(port), "--window-size", "1600x900"]
    command += ["--hide-welcome-screen", "--renderer", "vulkan"]
    viewer = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        client = connected(experimental, port)
        views = wait_for_views(client, 3 * len(runs) - 3 + 5)
        assert all(not view.reports for view in views), [view.reports for view in views]
        client.set_time("sim_time", duration=SHOWN, play_state="paused")
        image = settled_picture(client, tmp_path / "shot.png")
    finally:
        viewer.terminate()
        viewer.wait(10)
    third = image.shape[1] // 3
    upper, middle = (
        image[: image.shape[0] // 3],
        image[image.shape[0] // 3 : 2 * image.shape[0] // 3],
    )
    shown_colours = []
    for i, colour in enumerate(palette.RUNS[:3]):
        columns = slice(i * third, (i + 1) * third)
        # the tip is drawn shaded: count by hue
        assert hue_area(upper[:, columns], to_rgb(colour)) > 60
        touching = in_contact(runs[i])[round(SHOWN * 1000)]
        shown = palette.rgb(colour) if touching else palette.light(palette.rgb(colour))
        shown_colours.append(np.array(shown) / 255)
        assert hue_area(middle[:, columns], shown_colours[i]) > 1500
    assert 0 < sum(in_contact(run)[round(SHOWN * 1000)] for run in runs) < len(runs)
    # seen from above, +y is up: the run at +10 degrees has its tip above the axis then
    rows = [
        np.mean(np.nonzero(hue_mask(middle[:, i * third : (i + 1) * third], colour))[0])
        for i, colour in enumerate(shown_colours)
    ]
    laterals = [run.samples["tip_lateral"][round(SHOWN * 1000)] for run in runs]
    assert laterals[1] > 5e-3
    assert laterals[2] < -5e-3
    assert rows[1] < rows[0] - 5 < rows[2] - 10
    # the cones in 3D open to the left: +10 degrees further down (to -y), -10 further up
    heights = [
        np.mean(np.nonzero(hue_mask(upper[:, i * third : (i + 1) * third], to_rgb(palette.SKY)))[0])
        for i in range(3)
    ]
    assert heights[1] > heights[0] + 2 > heights[2] + 4


def connected(experimental, port):
    for _ in range(120):
        try:
            return experimental.ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
        except Exception:
            time.sleep(0.25)
    raise AssertionError("the viewer does not answer")


def wait_for_views(client, count):
    for _ in range(80):
        views = client.get_state().views
        if len(views) >= count:
            return views
        time.sleep(0.25)
    raise AssertionError(f"{len(views)} views instead of {count}")


def settled_picture(client, path):
    """Take pictures until two in a row are equal."""
    before = b""
    for _ in range(40):
        time.sleep(0.5)
        now = client.take_screenshot()
        if now == before:
            break
        before = now
    path.write_bytes(now)
    return imread(path)[..., :3]


def hue_mask(image, colour):
    """Return where a picture has a colour in any brightness from half of it up."""
    wanted = np.array(colour)
    scale = image.max(axis=-1, keepdims=True) / wanted.max()
    near = np.abs(image - scale * wanted).max(axis=-1) < 0.06
    return near & (scale[..., 0] > 0.5) & (np.ptp(image, axis=-1) > 0.12)


def hue_area(image, colour):
    return int(hue_mask(image, colour).sum())
