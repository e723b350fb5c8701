"""The paper's figures: what their lines hold, and whether a person can read them."""

from __future__ import annotations

import base64
import dataclasses
import itertools
import json

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_rgba
from matplotlib.contour import QuadContourSet
from matplotlib.image import imread
from matplotlib.lines import Line2D

import capture_sim
from capture_sim.errors import CaptureSimError
from capture_sim.samples import EventKind
from capture_sim.studies.axes import Axis
from capture_sim.viewing import figures, report_figures, style
from capture_sim.viewing.canvas import save
from capture_sim.viewing.curves import PANELS, Trace, plotted_runs
from capture_sim.viewing.figures import snapshot_times, snapshots
from capture_sim.viewing.shapes import tip_in_world
from capture_sim.viewing.source import resolved, resolved_or_not
from capture_sim.viewing.sweep import draw_map


def curves(axes, colour):
    """Return the lines of a colour that span some time, by their dashes."""
    found = {"solid": [], "dashed": []}
    for line in axes.get_lines():
        if line.get_color() == colour and len(line.get_xdata()) > 10:
            found["dashed" if line.is_dashed() else "solid"].append(line.get_xydata())
    return found


def test_lines_are_solid_in_contact_and_dashed_out_of_it(undamped):
    [axes] = figures.axial_performance(undamped).axes
    found = curves(axes, style.BLUE)
    [solid], [dashed] = found["solid"], found["dashed"]
    start, end = axes.get_xlim()
    t = undamped.samples["t"]
    stroke = undamped.samples["axial_stroke"][(t >= start) & (t <= end)] * 1e3
    # together they are the whole curve, and only at their ends do they overlap
    assert np.where(np.isnan(solid[:, 1]), dashed[:, 1], solid[:, 1]) == pytest.approx(stroke)
    both = ~np.isnan(solid[:, 1]) & ~np.isnan(dashed[:, 1])
    assert 0 < both.sum() <= 4 * len(undamped.touches)
    # by the located touches, not by the samples' flags
    in_touch = np.zeros(len(solid), bool)
    for touch in undamped.touches:
        in_touch |= (solid[:, 0] >= touch["start"]) & (solid[:, 0] <= touch["end"])
    assert not np.isnan(solid[in_touch, 1]).any()
    ends = np.concatenate([undamped.touches["start"], undamped.touches["end"]])
    far = np.abs(solid[:, :1] - ends).min(axis=1) > 2e-3
    assert np.isnan(solid[~in_touch & far, 1]).all()


def test_force_reaches_every_located_peak(undamped):
    [axes] = figures.impact_force(undamped).axes
    [[curve], _] = curves(axes, style.BLUE).values()
    for touch in undamped.touches:
        at_peak = curve[curve[:, 0] == touch["peak_time"], 1]
        assert at_peak.tolist() == [touch["peak_force"]]
        assert curve[curve[:, 0] == touch["start"], 1].tolist() == [0.0]


def test_resolved_run_is_the_same_motion_with_its_touches_whole(undamped):
    fine = resolved(undamped)
    same = np.isin(fine.samples["t"], undamped.samples["t"])
    assert np.abs(fine.samples["q"][same] - undamped.samples["q"]).max() < 1e-12
    # the samples themselves now come near each peak that was located between steps
    for touch in undamped.touches:
        inside = (fine.samples["t"] >= touch["start"]) & (fine.samples["t"] <= touch["end"])
        assert inside.sum() >= 40
        force = fine.samples["normal_force"][inside].max()
        assert 0.995 * touch["peak_force"] < force <= touch["peak_force"] * (1 + 1e-6)
    # Hertz and hysteresis (eq. 1 to 4): the depth under a force is within what restitution allows
    [axes] = figures.intrusion(fine).axes
    [[depth], _] = curves(axes, style.BLUE).values()
    stiffness = undamped.scene.contact_stiffness
    hertz = (undamped.touches["peak_force"].max() / stiffness) ** (2 / 3) * 1e6
    assert 0.8 * hertz < depth[:, 1].max() < 1.05 * hertz


def test_latched_tip_is_in_no_wall(runs):
    [axes] = figures.intrusion(runs[0]).axes
    [[depth], _] = curves(axes, style.BLUE).values()
    last = runs[0].touches["end"].max()
    assert (depth[depth[:, 0] > last, 1] == 0.0).all()
    assert depth[:, 1].max() > 0.0


def test_run_of_other_touches_is_not_resolved_but_drawn_as_it_was_sampled(undamped):
    altered = undamped.touches.copy()
    altered["start"][3] += 1e-3
    other = dataclasses.replace(undamped, touches=altered)
    with pytest.raises(CaptureSimError, match="other touches"):
        resolved(other)
    assert resolved_or_not(other) is other
    assert len(resolved_or_not(undamped).samples) > len(undamped.samples)


def test_distance_and_velocities_are_the_samples(runs):
    run = runs[1]
    figure = figures.velocities(run, window=(2.5, 3.3))
    t = run.samples["t"]
    inside = (t >= 2.5) & (t <= 3.3)
    for axes, index in zip(figure.axes, (0, 5, 1, 6, 2, 7), strict=True):
        found = curves(axes, style.BLUE)
        [in_contact], [free, latched] = found["solid"], found["dashed"]
        drawn = [line[:, 1] for line in (in_contact, free, latched)]
        assert np.nanmax(drawn, axis=0) == pytest.approx(run.samples["v"][inside, index] * 1e3)
        # from the latch on the tip is neither free nor in contact
        closed = next(event.t for event in run.events if event.kind is EventKind.LATCHED)
        later = t[inside] > closed
        assert later.any()
        assert np.isfinite(drawn[2][later]).all()
        assert np.isnan(drawn[0][later][1:]).all()
        assert np.isnan(drawn[1][later][1:]).all()


def test_overlaid_runs_start_together_at_their_first_touch(runs):
    [axes] = figures.impact_force(runs, aligned=True).axes
    for run, colour in zip(runs, style.RUNS, strict=False):
        [curve], _ = curves(axes, colour).values()
        assert curve[np.argmax(curve[:, 1] > 0.0) - 1, 0] == pytest.approx(0.0, abs=1e-12)
        assert curve[:, 1].max() == run.touches["peak_force"].max()
    assert "first touch" in axes.get_xlabel()
    names = [text.get_text() for text in axes.get_legend().get_texts()]
    assert names[:3] == ["tilt_0", "tilt_p10", "tilt_m10"]


@pytest.fixture(scope="module")
def many(runs, undamped):
    """Ten runs."""
    return [*runs, *runs, *runs, undamped]


def test_ten_overlaid_runs_are_told_apart(many):
    """Each has a colour and marker of its own on its curves and in the legend."""
    for figure in (figures.distance(many), figures.load_stroke(many), figures.velocities(many)):
        entries = figure.legends[0].legend_handles
        lines = [entry for entry in entries if isinstance(entry, Line2D)]
        looks = {(e.get_color(), e.get_marker()) for e in lines if e.get_marker() != "None"}
        assert len(looks) == 10
        assert len({colour for colour, _ in looks}) == 10
        for axes in figure.axes:
            marked = {
                (line.get_color(), line.get_marker()): len(line.get_xdata())
                for line in axes.get_lines()
                if line.get_marker() != "None" and len(line.get_xdata())
            }
            assert set(marked) == looks
            assert all(3 <= count <= 6 for count in marked.values())


def test_markers_lie_on_the_curves(many):
    [axes] = figures.distance(many, aligned=True).axes
    run = many[1]
    [marks] = [
        line.get_xydata()
        for line in axes.get_lines()
        if line.get_color() == style.RUNS[1] and line.get_linestyle() == "None"
    ]
    t = run.samples["t"] - run.touches["start"].min()
    expected = np.interp(marks[:, 0], t, run.samples["tip_distance"] * 1e3)
    assert marks[:, 1] == pytest.approx(expected, abs=1e-9)


def test_strips_and_cones_of_many_runs_wrap(many):
    strips = snapshots(many[:5], count=2)
    assert strips.get_figwidth() < 20.0
    drawn = [axes for axes in strips.axes if axes.axison]
    assert len(drawn) == 10
    # the lowest of each column is numbered
    assert sum(bool(axes.get_xlabel()) for axes in drawn) == 3
    cones = figures.trajectories(many[:5])
    assert cones.get_figwidth() < 20.0
    assert sum(axes.axison for axes in cones.axes) == 5


@pytest.mark.parametrize("name", ["axial_performance", "distance", "impact_force"])
def test_curves_of_the_report_are_those_of_the_samples(undamped, name):
    """Points are left out where a line through the rest shows the same."""
    [plotted] = plotted_runs(undamped)
    page = json.loads(report_figures.over_time(name, [plotted]).data)
    quantity = PANELS[name]
    t, values = quantity.curve(undamped)
    lines = [curve for curve in page["data"] if curve["mode"] == "lines"]
    points = [np.stack([numbers(line["x"]), numbers(line["y"])]) for line in lines]
    start, end = page["layout"]["xaxis"]["range"]
    seen = (t >= start) & (t <= end)
    extent = np.array([end - start, np.ptp(np.append(values[seen], 0.0))])
    samples = np.stack([t[seen], values[seen]], axis=-1) / extent
    nearest = np.full(len(samples), np.inf)
    for x, y in points:
        line = np.stack([x, y], axis=-1) / extent
        for a, b in itertools.pairwise(line[np.isfinite(line).all(axis=1)]):
            along = np.clip((samples - a) @ (b - a) / max((b - a) @ (b - a), 1e-30), 0.0, 1.0)
            offset = samples - a - along[:, None] * (b - a)
            nearest = np.minimum(nearest, np.hypot(*offset.T))
    assert nearest.max() < 1e-3  # a third of a pixel
    assert sum(x.size for x, _ in points) < 0.7 * seen.sum()
    highest = max(np.nanmax(y) for _, y in points)
    assert highest == pytest.approx(values[seen].max(), rel=1e-3)


def numbers(axis):
    """Return the numbers of a curve as plotly stores them."""
    return np.frombuffer(base64.b64decode(axis["bdata"]), dtype=axis["dtype"])


def test_stops_are_drawn_in_pictures_and_report(runs):
    stops = "stops={compression: 0.009, extension: 0.012, stiffness: 1.0e+5, damping: 50.0}"
    run = dataclasses.replace(runs[0], scene=capture_sim.load_scene("tilt_0", [stops]))
    [axes] = figures.axial_performance(run).axes
    dotted = [line for line in axes.get_lines() if line.get_linestyle() == ":"]
    assert [line.get_ydata()[0] for line in dotted] == pytest.approx([-9.0, 12.0])
    page = json.loads(report_figures.over_time("axial_performance", plotted_runs(run)).data)
    levels = sorted(shape["y0"] for shape in page["layout"]["shapes"])
    assert levels == pytest.approx([-9.0, 12.0])


def test_legend_leaves_the_curves_free(undamped, runs):
    """Of the loops, which are everywhere, and of many runs."""
    many = figures.distance([*runs, *runs], aligned=True)
    for figure in (figures.load_stroke(undamped), figures.load_stroke(runs), many):
        figure.draw_without_rendering()
        [legend] = figure.legends
        box = legend.get_window_extent()
        assert not box.overlaps(figure.axes[0].bbox)
        assert 0.0 <= box.x0 < box.x1 <= figure.bbox.width
    assert "capture zone, 5 mm" in [text.get_text() for text in legend.get_texts()]


def test_curves_from_elsewhere_are_drawn_over_the_run(undamped):
    t, v = undamped.samples["t"], undamped.samples["v"]
    figure = figures.velocities(undamped, traces=[Trace("other engine", t, v)])
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "other engine" in legend
    for axes, index in zip(figure.axes, (0, 5, 1, 6, 2, 7), strict=True):
        [points] = [line.get_xydata() for line in axes.get_lines() if line.get_marker() == "o"][:1]
        assert 25 <= len(points) <= 65
        expected = np.interp(points[:, 0], t, v[:, index] * 1e3)
        assert points[:, 1] == pytest.approx(expected, abs=1e-9)


def test_snapshots_show_the_tip_where_it_was(runs):
    for run in runs:
        figure = snapshots(run, count=6)
        when = snapshot_times(run, 6)
        touch = next(event for event in run.events if event.kind is EventKind.TOUCH)
        assert when[0] == 0.0
        assert when[1] == touch.t
        assert len(figure.axes) == 6
        for axes, t in zip(figure.axes, when, strict=True):
            [tip] = filled(axes, style.BLUE)
            k = round(t * 1000)
            near = tip_in_world(run.scene, run.samples["q"][k : k + 1])[0]
            centre = tip[:-1].mean(axis=0)
            assert centre == pytest.approx(near, abs=1.5e-4)  # 1 ms at 0.15 m/s
            left, right = axes.get_xlim()
            assert left < centre[0] < right


def filled(axes, colour):
    """Return the outlines that are filled with a colour."""
    return [
        path.vertices
        for collection in axes.collections
        for path, face in zip(collection.get_paths(), collection.get_facecolors(), strict=False)
        if np.allclose(face, to_rgba(colour))
    ]


def test_figures_can_be_read_at_half_size(undamped, runs, tmp_path):
    drawn = [figure(one) for figure in figures.FIGURES.values() for one in (undamped, runs)]
    drawn += [figures.undamped_results(undamped), figures.buffer_results(runs, aligned=True)]
    drawn += [figures.trajectories(runs), snapshots(runs), snapshots(undamped)]
    for figure in drawn:
        for axes in figure.axes:
            for axis in (axes.xaxis, axes.yaxis):
                shown = axis.get_label().get_text()
                assert not shown or "[" in shown, shown
            # pixels of the line height in a PNG that is shown at half its size
            assert all(size * style.DPI / 72 / 2 >= 9.0 for size in size_of(axes))
        # every row and column of panels says what it shows
        assert any(axes.get_xlabel() for axes in figure.axes)
        assert any(axes.get_ylabel() for axes in figure.axes)


def size_of(axes):
    texts = [axes.xaxis.label, axes.yaxis.label, axes.title, *axes.texts]
    texts += axes.get_xticklabels() + axes.get_yticklabels()
    legend = axes.get_legend()
    texts += [] if legend is None else legend.get_texts()
    return [text.get_fontsize() for text in texts if text.get_text()]


@pytest.mark.parametrize("window", [(0.2, 0.4), (5.5, 5.6)])
def test_window_without_the_contact_is_drawn_too(runs, window):
    for name in figures.OVER_TIME:
        figures.FIGURES[name](runs[0], window=window).draw_without_rendering()


def test_files_are_the_same_every_time(undamped, tmp_path):
    first, again = ([tmp_path / f"{n}{ending}" for ending in (".svg", ".png")] for n in "ab")
    for paths in (first, again):
        assert save(figures.trajectory(undamped), *paths) == paths[-1]
    for one, other in zip(first, again, strict=True):
        assert one.read_bytes() == other.read_bytes()
    assert first[0].stat().st_size < 200_000
    image = imread(first[1])[..., :3]
    assert (np.abs(image - 1.0).max(axis=-1) > 0.1).mean() > 0.02


def test_labels_must_fit_the_runs(runs, tmp_path):
    with pytest.raises(ValueError, match="2 labels for 3 runs"):
        figures.distance(runs, labels=["a", "b"])
    with pytest.raises(ValueError, match="no run"):
        figures.distance([])
    assert save(figures.distance(runs, labels=["a", "b", "c"]), tmp_path / "x.png").is_file()


def test_a_map_has_no_contours_around_single_runs():
    """A plane of forces with a spike and a corner without touches: only lines across the plane."""
    at = np.arange(12.0)
    table = pd.DataFrame([{"a": a, "b": b} for a in at for b in at])
    table["max_normal_force"] = 100.0 + 10.0 * table["a"]
    table.loc[(table["a"] == 5.0) & (table["b"] == 5.0), "max_normal_force"] = 500.0
    table.loc[(table["a"] > 8.0) & (table["b"] > 8.0), "max_normal_force"] = 0.0
    table["verdict"] = "captured"
    axes = [Axis(name, "1", tuple(at)) for name in ("a", "b")]
    [panel] = draw_map(table, axes, "plane").axes
    [lines] = [drawn for drawn in panel.collections if isinstance(drawn, QuadContourSet)]
    pieces = [piece for path in lines.get_paths() for piece in path.to_polygons(closed_only=False)]
    assert pieces
    assert all(np.ptp(piece, axis=0).max() > 2.0 for piece in pieces)
