"""Pictures: the shapes in them, the numbers behind them, and what a person would see."""

from __future__ import annotations

import dataclasses
import math
import warnings

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.image import imread
from matplotlib.text import Text
from matplotlib.transforms import Bbox

import capture_sim
from capture_sim.errors import RecordingError
from capture_sim.recording.measured_run import MeasuredRun
from capture_sim.recording.offline import write_run
from capture_sim.recording.read import read_run
from capture_sim.samples import EventKind
from capture_sim.viewing import plots, style
from capture_sim.viewing.canvas import save
from capture_sim.viewing.curves import LAYERS, plotted_runs
from capture_sim.viewing.plots import draw_bench, key_moments
from capture_sim.viewing.shapes import tip_bound, tip_in_cone, tip_in_world, wall
from capture_sim.viewing.source import (
    decided_at,
    every_touch,
    headline,
    in_contact,
    time_window,
    verdict,
)


@pytest.fixture(scope="module")
def papers(undamped):
    names = ("designed", "case_1", "case_2", "case_3", "clamped")
    scenes = [capture_sim.load_scene(f"paper_{name}") for name in names]
    return [undamped, *map(capture_sim.simulate, scenes)]


@pytest.fixture(scope="module")
def interrupted(runs):
    """A run as its recording holds it after Ctrl-C: in a touch, with nothing decided."""
    run = runs[0]
    longest = run.touches[np.argmax(run.touches["end"] - run.touches["start"])]
    until = 0.5 * (longest["start"] + longest["end"])
    return MeasuredRun(
        run.scene,
        run.samples[run.samples["t"] <= until],
        run.touches[run.touches["end"] <= until],
        [event for event in run.events if event.t <= until],
        [status for status in run.statuses if status.t <= until],
    )


@pytest.fixture(scope="module")
def drawn(runs, papers, interrupted):
    """Each run and its picture: the first touches nothing, the last was broken off."""
    untouched = capture_sim.simulate(runs[0].scene, t_end=1.0)
    several = (untouched, *runs, *papers[:2], interrupted)
    return [(run, laid_out(plots.draw_run(run))) for run in several]


@pytest.fixture(scope="module")
def overviews(runs, papers):
    """Runs and their overview, with names as long as they get."""
    groups = (runs, papers)
    names = [[f"{run.scene.name}_12" for run in group] for group in groups]
    return [(g, laid_out(plots.draw_overview(g, n))) for g, n in zip(groups, names, strict=True)]


def laid_out(figure):
    figure.draw_without_rendering()
    return figure


# shapes


def distance_to_segment(point, ends):
    a, b = ends
    along = np.clip(np.dot(point - a, b - a) / np.dot(b - a, b - a), 0.0, 1.0)
    return np.linalg.norm(point - (a + along * (b - a)))


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("beta", [0.3, math.pi / 4, 1.2])
def test_bound_of_the_tip_lies_one_radius_off_the_wall_on_its_inner_side(runs, side, beta):
    scene = capture_sim.load_scene("tilt_0", [f"cone.half_angle={beta}", "string.drop_height=0.05"])
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


def test_touching_tip_lies_on_the_bound(undamped):
    tips = tip_in_cone(undamped.samples)[undamped.samples["walls"] == 1]
    ends = wall(undamped.scene.cone, 1)
    distances = np.array([distance_to_segment(tip, ends) for tip in tips])
    assert len(tips) > 100
    assert np.abs(distances - undamped.scene.probe.tip_radius).max() < 1e-4


# what is told of a run


def test_headline_tells_name_verdict_and_impact(runs, undamped, drawn):
    assert headline(runs[0]) == "tilt_0: captured, impact at 0.100 m/s"
    assert headline(undamped).startswith("paper_undamped: rebound")
    assert "no touch" in drawn[0][1].get_suptitle()


def test_short_touches_count_as_contact(undamped):
    touching = in_contact(undamped)
    t = undamped.samples["t"]
    assert touching[np.searchsorted(t, undamped.touches["start"], side="right") - 1].all()
    assert touching.sum() > (undamped.samples["walls"] != 0).sum()
    # the share of the time agrees with the located touches
    shorter = (undamped.touches["end"] - undamped.touches["start"]).sum()
    assert shorter < touching.sum() * 1e-3 < shorter + 2e-3 * len(undamped.touches)


def test_moments_are_those_of_the_events(runs, undamped):
    for run in runs:
        moments = key_moments(run)
        first = next(e for e in run.events if e.kind is EventKind.TOUCH)
        latched = next(e for e in run.events if e.kind is EventKind.LATCHED)
        assert moments[0].t == first.t
        assert moments[-1].t == latched.t
        assert np.linalg.norm(moments[-1].place) == pytest.approx(run.scene.latch.radius, rel=0.02)
    assert [m.meaning.split(",")[0] for m in key_moments(undamped)][-2:] == [
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


def area(image, colour):
    """Return how many pixels have a colour, as near as the edges' smoothing lets them."""
    return int((np.abs(image - np.array(to_rgb(colour))).max(axis=-1) < 0.03).sum())


def test_figure_is_the_same_from_the_run_and_from_its_recording(runs, tmp_path):
    run = runs[1]
    recorded = read_run(write_run(run, tmp_path / "run.mcap"))
    first = save(plots.draw_run(run), tmp_path / "a.png").read_bytes()
    assert save(plots.draw_run(recorded), tmp_path / "b.png").read_bytes() == first


def test_plotted_forces_are_the_recorded_ones(undamped, drawn):
    figure = next(figure for run, figure in drawn if run is undamped)
    force = next(axes for axes in figure.axes if "normal force" in axes.get_ylabel())
    peaks = np.concatenate(
        [line.get_ydata() for line in force.get_lines() if "touches" in str(line.get_label())]
    )
    assert sorted(peaks) == sorted(undamped.touches["peak_force"])
    low, high = force.get_ylim()
    assert low < undamped.touches["peak_force"].max() < high
    assert force.get_yscale() == "log"


def test_every_axis_has_its_unit(drawn, overviews):
    for _, figure in (*drawn, *overviews):
        for axes in figure.axes:
            assert "[" in axes.get_ylabel()
            shared = not axes.xaxis.get_tick_params()["labelbottom"] or not axes.get_xlabel()
            assert shared or "[" in axes.get_xlabel()
            assert axes.yaxis.label.get_fontsize() >= 11


def test_target_is_drawn_turned_the_right_way(runs):
    from matplotlib.figure import Figure

    for run, degrees in zip(runs, (0.0, 10.0, -10.0), strict=True):
        axes = Figure().add_subplot()
        draw_bench(axes, *plotted_runs(run))
        edges = [
            path.vertices[0]
            for collection in axes.collections
            for path, edge in zip(collection.get_paths(), collection.get_edgecolors(), strict=False)
            if np.allclose(edge[:3], to_rgb(style.DARK))
        ]
        assert len(edges) == 2
        axis = np.mean(edges, axis=0) - (run.scene.initial.target.x, run.scene.initial.target.y)
        # BE lies on the target's -x side: turned to the left, it moves to -y
        turned = math.degrees(math.atan2(-axis[1], -axis[0]))
        assert turned == pytest.approx(degrees, abs=0.1)


def test_no_name_lies_under_a_box_or_another(drawn, overviews):
    """Names of the walls and letters of the moments against legend and list of moments."""
    for _, figure in (*drawn, *overviews):
        for axes in figure.axes:
            if "cone's frame" not in axes.get_ylabel():
                continue
            *names, moments = axes.texts
            assert "s  " in moments.get_text()
            boxes = [axes.get_legend().get_window_extent(), moments.get_bbox_patch()]
            for box in (boxes[0], boxes[1].get_window_extent()):
                for name in names:
                    assert not box.overlaps(name.get_window_extent()), name.get_text()
            letters = [name for name in names if len(name.get_text()) == 1]
            assert len(letters) == len(moments.get_text().splitlines())
            for i, letter in enumerate(letters):
                for other in letters[:i]:
                    assert not extent(letter).overlaps(extent(other)), moments.get_text()


def extent(text):
    """Return where a text's letters are; what it points at may be far away."""
    return Text.get_window_extent(text)


def test_headings_stay_within_their_panels_and_columns(overviews):
    for _, figure in overviews:
        width = figure.bbox.width / 3
        for i, axes in enumerate(figure.axes):
            heading = axes.title.get_window_extent()
            if "impact" in axes.get_title():  # of the whole column
                column = i // 4 % 3
                assert column * width <= heading.x0
                assert heading.x1 <= (column + 1) * width
            else:
                assert axes.bbox.x0 <= heading.x0
                assert heading.x1 <= axes.bbox.x1


def test_overview_wraps_and_no_run_covers_another(overviews):
    """At most three abreast: a page is read, not a banner."""
    for runs, figure in overviews:
        assert figure.get_figwidth() == 18.0
        blocks = [figure.axes[4 * i : 4 * i + 4] for i in range(len(runs))]
        assert 4 * len(blocks) == len(figure.axes)
        boxes = [Bbox.union([axes.get_tightbbox() for axes in block]) for block in blocks]
        for i, box in enumerate(boxes):
            assert 0.0 <= box.y0 < box.y1 <= figure.bbox.height
            assert not any(box.overlaps(other) for other in boxes[:i])


def test_no_line_runs_through_a_text(drawn):
    for _, figure in drawn:
        axes = figure.axes[-1]
        assert "zone: 5 mm" in axes.get_title()
        for line in axes.get_lines():
            x = line.get_xdata()
            if len(x) == 2 and x[0] == x[1]:  # an instant's
                at = axes.transData.transform((x[0], 0.0))[0]
                assert not any(extent(text).x0 <= at <= extent(text).x1 for text in axes.texts)


def test_touch_that_was_broken_off_is_seen_to_its_end(runs, interrupted, drawn):
    last = interrupted.samples["t"][-1]
    begun = runs[0].touches["start"][runs[0].touches["start"] < last].max()
    broken_off = every_touch(interrupted)[-1]
    assert broken_off[["start", "end", "wall"]].tolist() == (begun, last, 1)
    force = interrupted.samples["normal_force"][interrupted.samples["t"] >= begun, 0]
    assert broken_off["peak_force"] == force.max() > 0.0
    assert time_window(interrupted)[1] == last
    figure = drawn[-1][1]
    force, stroke = figure.axes[2:4]
    shaded = force.collections[-1].get_paths()[-1].get_extents()
    assert (shaded.x0, shaded.x1) == pytest.approx((begun, last))
    # the extremes that the headings tell are in sight
    lowest = np.nanmin(np.concatenate([line.get_ydata() for line in stroke.get_lines()]))
    assert f"whole run {-lowest:.2f} mm in" in stroke.get_title()
    assert stroke.get_xlim()[1] == last
    count = (runs[0].touches["start"] < last).sum()
    assert f"+y wall: {count} touches" in [line.get_label() for line in force.get_lines()]
    assert all(len(every_touch(run)) == len(run.touches) for run in runs)
    # a window that ends in an earlier touch, which is known whole
    earlier = interrupted.samples["t"] < begun
    k = np.flatnonzero(interrupted.samples["walls"][earlier])[-1]
    cut = dataclasses.replace(interrupted, samples=interrupted.samples[: k + 1])
    assert len(every_touch(cut)) == len(cut.touches)


def test_zone_as_large_as_allowed_is_drawn_without_a_warning(tmp_path):
    """The verdict then falls before the first touch."""
    run = capture_sim.simulate(capture_sim.load_scene("tilt_0", ["detector.capture_radius=1"]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure = plots.draw_run(run)
        save(figure, tmp_path / "x.png")
    start, end = time_window(run)
    assert start < decided_at(run) < run.touches["start"].min() < end
    axes = figure.axes[-1]
    assert "captured" in [text.get_text() for text in axes.texts]


def test_overview_has_a_column_for_each_run(overviews, tmp_path):
    """Each in its own colour alone; walls and zone in theirs."""
    runs, figure = overviews[0]
    path = save(figure, tmp_path / "new" / "overview.png")
    image = imread(path)[..., :3]
    assert area(image, style.DARK) > 4000
    assert area(image, style.ZONE) > 300
    width = image.shape[1] // len(runs)
    for i in range(len(runs)):
        column = image[:, i * width : (i + 1) * width]
        assert area(column, style.RUNS[i]) > 1500
        assert all(area(column, other) == 0 for other in style.RUNS[:i] + style.RUNS[i + 1 :])


def test_unwritable_folder_is_refused_in_one_line(runs, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="cannot write"):
        save(plots.draw_run(runs[0]), tmp_path / "file" / "x.png")
    pytest.importorskip("rerun", reason="needs rerun")
    from capture_sim.viewing.rerun_view import save_rrd

    with pytest.raises(RecordingError, match="cannot write"):
        save_rrd(runs, tmp_path / "file" / "x.rrd")


# simulated by the matrices of Vienot, Brettel and Mollon (1999), linear light
NORMAL = np.eye(3)
PROTAN = np.array([[0.11238, 0.88762, 0.0], [0.11238, 0.88762, 0.0], [0.00401, -0.00401, 1.0]])
DEUTAN = np.array([[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]])
BESIDE_EACH_OTHER = {
    "runs": style.RUNS[: style.COLOURS_ALONE],
    "verdicts": [look.colour for look in style.VERDICTS.values()],
    "phases": [*style.PHASES.values()],
    "states": [*style.STATES.values()],
    **{f"layers {i}": (LAYERS[i][1], LAYERS[i + 1][1]) for i in range(len(LAYERS) - 1)},
}


@pytest.mark.parametrize("matrix", [NORMAL, PROTAN, DEUTAN], ids=["normal", "protan", "deutan"])
@pytest.mark.parametrize("what", BESIDE_EACH_OTHER)
def test_colours_differ_also_for_the_colour_blind(what, matrix):
    colours = np.array([to_rgb(colour) for colour in BESIDE_EACH_OTHER[what]]) ** 2.2
    seen = (colours @ matrix.T).clip(0.0, 1.0) ** (1 / 2.2)
    least = 0.14 if what in ("phases", "states") else 0.2  # names stand in the lanes as well
    for i in range(len(seen)):
        for j in range(i):
            assert np.abs(seen[i] - seen[j]).max() > least, (what, i, j)


def test_ten_runs_have_colours_and_markers_of_their_own():
    """Without a colour-blind eye all ten colours differ; with one, the markers do."""
    colours = np.array([to_rgb(style.run_colour(i)) for i in range(10)])
    for i in range(10):
        assert (np.abs(colours[i] - colours[:i]).max(axis=1) > 0.2).all()
    for which in (0, 1):
        markers = {style.run_marker(i)[which] for i in range(10)}
        assert len(markers) == 10
        assert not markers & {wall[which] for wall in style.WALLS.values()}


def test_nothing_but_a_run_has_a_runs_colour():
    meant = {look.colour for look in style.VERDICTS.values()} | {style.CONTACT, style.ZONE}
    meant |= {*style.PHASES.values(), *style.STATES.values()}
    assert not meant & set(style.RUNS)
    assert len({marker for marker, *_ in style.WALLS.values()}) == 2
