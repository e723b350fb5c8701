"""The data that plots, report and rerun are given: curves, touches, moments, shapes, colours."""

from __future__ import annotations

import math

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

import capture_sim
from capture_sim.dynamics.samples import EventKind
from capture_sim.errors import CaptureSimError
from capture_sim.viewing import style
from capture_sim.viewing.curves import (
    DISTANCE,
    FORCE,
    HOLDS,
    LAYERS,
    PENETRATION,
    STROKE,
    TORSION,
    VELOCITIES,
    are_many,
    energy_layers,
    envelope,
    marked_points,
    plotted_runs,
    split,
)
from capture_sim.viewing.drawing import _draw_enlarged, draw_trajectory
from capture_sim.viewing.figures import load_stroke, snapshot_times, state_at
from capture_sim.viewing.plots import key_moments
from capture_sim.viewing.shapes import (
    state_shapes,
    tip_bound,
    tip_in_cone,
    tip_in_world,
    wall,
)
from capture_sim.viewing.source import (
    decided_at,
    headline,
    in_contact,
    resolved,
    resolved_or_not,
    time_window,
)

# quantities


@pytest.mark.parametrize(
    "quantity, expected",
    [
        (STROKE, lambda s: s["axial_stroke"] * 1e3),
        (TORSION, lambda s: s["torsion"] * 1e3),
        (DISTANCE, lambda s: s["tip_distance"] * 1e3),
        (VELOCITIES[0][0], lambda s: s["v"][:, 0] * 1e3),
        (VELOCITIES[1][1], lambda s: s["v"][:, 6] * 1e3),
        (VELOCITIES[2][1], lambda s: s["v"][:, 7] * 1e3),
    ],
    ids=["stroke", "torsion", "distance", "chaser x", "target y", "target theta"],
)
def test_curves_are_the_samples_in_their_unit(runs, quantity, expected):
    t, values = quantity.curve(runs[1])
    assert t.tolist() == runs[1].samples["t"].tolist()
    assert values.tolist() == expected(runs[1].samples).tolist()
    assert quantity.unit in quantity.axis


def test_force_has_the_start_peak_and_end_of_every_touch(undamped):
    t, force = FORCE.curve(undamped)
    for touch in undamped.touches:
        assert force[t == touch["peak_time"]].tolist() == [touch["peak_force"]]
        assert force[t == touch["start"]].tolist() == [0.0]
        assert force[t == touch["end"]].tolist() == [0.0]
    assert force.max() == undamped.touches["peak_force"].max()


def test_stops_and_zone_are_limits_of_their_curves():
    stops = "stops={compression: 0.009, extension: 0.012, stiffness: 1.0e+5, damping: 50.0}"
    scene = capture_sim.load_scene("tilt_0", [stops])
    assert [limit.value for limit in STROKE.limits(scene)] == pytest.approx([-9.0, 12.0])
    assert [limit.value for limit in DISTANCE.limits(scene)] == [5.0]
    assert TORSION.limits(scene) == ()


def test_a_resolved_run_is_the_same_motion_with_samples_in_every_touch(undamped):
    fine = resolved(undamped)
    same = np.isin(fine.samples["t"], undamped.samples["t"])
    assert np.abs(fine.samples["q"][same] - undamped.samples["q"]).max() < 1e-12
    for touch in undamped.touches:
        inside = (fine.samples["t"] >= touch["start"]) & (fine.samples["t"] <= touch["end"])
        assert inside.sum() >= 40
        force = fine.samples["normal_force"][inside].max()
        assert 0.995 * touch["peak_force"] < force <= touch["peak_force"] * (1 + 1e-6)
    # Hertz and hysteresis (eq. 1 to 4): the depth under a force is within what restitution allows
    _, depth = PENETRATION.curve(fine)
    largest = undamped.touches["peak_force"].max()
    hertz = (largest / undamped.scene.contact_stiffness) ** (2 / 3) * 1e6
    assert 0.8 * hertz < depth.max() < 1.05 * hertz


def test_a_run_of_other_touches_is_not_resolved_but_drawn_as_it_was_sampled(undamped):
    altered = undamped.touches.copy()
    altered["start"][3] += 1e-3
    other = undamped.replaced(touches=altered)
    with pytest.raises(CaptureSimError, match="other touches"):
        resolved(other)
    assert resolved_or_not(other) is other


def test_a_latched_tip_is_in_no_wall(runs):
    t, depth = PENETRATION.curve(runs[0])
    assert (depth[t > runs[0].touches["end"].max()] == 0.0).all()
    assert depth.max() > 0.0


def test_pieces_of_a_curve_are_solid_in_located_touches_and_together_all_of_it(undamped):
    [plotted] = plotted_runs(undamped)
    t, stroke = STROKE.curve(undamped)
    pieces = split(stroke, plotted.holds)
    assert set(pieces) == {"free", "in contact"}
    solid, dashed = pieces["in contact"], pieces["free"]
    assert np.where(np.isnan(solid), dashed, solid).tolist() == stroke.tolist()
    touches = undamped.touches
    starts, ends = np.sort(touches["start"]), np.sort(touches["end"])
    inside = np.searchsorted(starts, t, "right") > np.searchsorted(ends, t, "left")
    assert not np.isnan(solid[inside]).any()
    far = np.abs(t[:, None] - np.append(starts, ends)).min(axis=1) > 2e-3
    assert np.isnan(solid[~inside & far]).all()


def test_touches_shorter_than_a_sample_period_count_as_contact(undamped):
    touching, t = in_contact(undamped), undamped.samples["t"]
    touches = undamped.touches
    assert touching[np.searchsorted(t, touches["start"], side="right") - 1].all()
    lasting = (touches["end"] - touches["start"]).sum()
    assert lasting < touching.sum() * 1e-3 < lasting + 2e-3 * len(touches)


def test_from_the_latch_on_the_tip_is_latched(runs):
    for run, plotted in zip(runs, plotted_runs(runs), strict=True):
        closed = next(event.t for event in run.events if event.kind is EventKind.LATCHED)
        latched = plotted.holds == HOLDS.index("latched")
        assert latched.any()
        assert (run.samples["t"][latched] >= closed).all()


def test_aligned_runs_begin_together_at_their_first_touch(runs):
    for plotted in plotted_runs(runs, aligned=True):
        t, force = FORCE.curve(plotted.run)
        first = np.argmax(force > 0.0) - 1
        assert t[first] - plotted.origin == pytest.approx(0.0, abs=1e-12)


def test_layers_of_energy_are_the_energy_put_in(runs):
    for run in runs:
        _, put_in, layers = energy_layers(run.samples)
        total = np.sum([layer for *_, layer in layers], axis=0)
        # layers too thin to be seen are left out
        assert total == pytest.approx(put_in, abs=len(LAYERS) * 1e-3 * put_in.max())


def test_layers_of_energy_in_a_window_are_the_energy_put_in(runs):
    """What was put in before the window is counted once."""
    for run in runs:
        touch = run.touches["start"][0]
        inside = run.samples[np.abs(run.samples["t"] - touch) < 0.2]
        t, put_in, layers = energy_layers(inside)
        whole_t, whole, _ = energy_layers(run.samples)
        total = np.sum([layer for *_, layer in layers], axis=0)
        assert total == pytest.approx(put_in, abs=len(LAYERS) * 1e-3 * put_in.max())
        assert put_in == pytest.approx(np.interp(t, whole_t, whole), rel=1e-3)


@pytest.mark.parametrize("end", [(3.0, 0.0), (-3.3, 1.0), (2.0, -2.2), (-1.0, 0.5)])
def test_the_end_is_within_the_enlarged_drawing(end, runs):
    """It goes as far behind BE as an end that counts as near; ``end`` in capture radii."""
    [plotted] = plotted_runs(runs[0])
    zone = runs[0].scene.detector.capture_radius * 1e3
    axes = Figure().subplots()
    close = _draw_enlarged(axes, plotted, np.array(end) * zone)
    for (low, high), value in zip((close.get_xlim(), close.get_ylim()), end, strict=True):
        assert low + 0.3 * zone < value * zone < high - 0.3 * zone
        assert low <= 0.0 <= high  # the centre of BE
        assert high - low == pytest.approx(4.4 * zone)


def test_each_capture_zone_is_drawn(runs):
    wide = capture_sim.simulate("tilt_0", {"detector.capture_radius": 0.01}, t_end=0.1)
    narrow = capture_sim.simulate("tilt_0", t_end=0.1)
    one, both = (Figure().subplots() for _ in range(2))
    draw_trajectory(one, plotted_runs([narrow, narrow]))
    draw_trajectory(both, plotted_runs([narrow, wide]))
    assert len(both.get_children()) > len(one.get_children())


# many runs


def test_an_envelope_holds_every_run_and_every_peak(runs):
    many = plotted_runs([run for run in runs for _ in range(4)], aligned=True)
    assert are_many(many)
    assert not are_many(many[:10])
    for quantity in (DISTANCE, FORCE):
        t, bounds = envelope(quantity, many, (-0.1, 0.6))
        assert (np.diff(bounds, axis=1) >= 0.0).all()
        for plotted in many[::4]:
            times, values = quantity.curve(plotted.run)
            at = np.interp(t, times - plotted.origin, values)
            assert (bounds[:, 0] <= at + 1e-9).all() or quantity is FORCE
            assert (bounds[:, 4] >= at - 1e-9).all()
    _, force = envelope(FORCE, many, (-0.1, 0.6))
    early = [r.touches[r.touches["start"] < r.touches["start"].min() + 0.6] for r in runs]
    assert force.max() == max(touches["peak_force"].max() for touches in early)


def test_markers_of_runs_on_one_curve_do_not_coincide():
    t = np.linspace(0.0, 1.0, 1001)
    marked = [set(marked_points(t, number, 10).tolist()) for number in range(10)]
    assert all(3 <= len(points) <= 6 for points in marked)
    assert len(set.union(*marked)) == sum(map(len, marked))


def test_a_window_restricts_what_is_drawn_and_leaves_the_run_whole(runs):
    run = runs[1]
    window = float(run.touches["start"].min()), float(run.touches["end"].max())
    [plotted] = plotted_runs(run, window=window)
    assert len(plotted.samples) == len(plotted.touching) == len(plotted.holds)
    assert (
        0
        < len(plotted.samples)
        < len(run.samples)
        == round(run.scene.run.state_rate * run.t[-1]) + 1
    )
    for quantity in (STROKE, FORCE):
        t, values = plotted.curve(quantity)
        assert window[0] <= t.min() < t.max() <= window[1]
        whole_t, whole = quantity.curve(run)
        assert values.tolist() == whole[np.isin(whole_t, t)].tolist()
    with pytest.raises(CaptureSimError, match="no sample from 90 to 91 s"):
        plotted_runs(run, window=(90.0, 91.0))


def test_a_run_of_the_loop_is_in_the_legend(undamped):
    """Matplotlib leaves out labels with an underscore in front, as the loop's scene has."""
    [legend] = load_stroke(undamped, labels=["_loop"]).legends
    assert legend.get_texts()[0].get_text().startswith("loop: ")


def test_labels_must_fit_the_runs(runs):
    for labels in ([], ["a", "b"]):
        with pytest.raises(ValueError, match=f"{len(labels)} labels for 1 runs"):
            capture_sim.plot(runs[0], labels=labels)
    with pytest.raises(ValueError, match="2 labels for 3 runs"):
        plotted_runs(runs, ["a", "b"])
    with pytest.raises(ValueError, match="no run"):
        plotted_runs([])


# what is reported of a run


def test_headline_has_name_verdict_and_impact(runs, undamped):
    assert headline(runs[0]) == "tilt_0: captured, impact at 0.100 m/s"
    assert headline(undamped).startswith("paper_undamped: rebound")


def test_moments_are_those_of_the_events(runs, undamped):
    for run in runs:
        moments = key_moments(run)
        times = {kind: [e.t for e in run.events if e.kind is kind] for kind in EventKind}
        assert moments[0].t == times[EventKind.TOUCH][0]
        assert moments[-1].t == times[EventKind.LATCHED][0]
        assert np.linalg.norm(moments[-1].place) == pytest.approx(run.scene.latch.radius, rel=0.02)
    meanings = [moment.meaning.partition(",")[0] for moment in key_moments(undamped)]
    assert meanings[-2:] == ["closest", "end of the run"]


def test_the_window_has_the_contact_and_the_verdict(runs):
    for run in runs:
        final = [status.t for status in run.statuses if status.final]
        assert decided_at(run) == final[0]
        start, end = time_window(run)
        assert start < run.touches["start"].min() < final[0] < end
        # ... and what the titles name
        for load in ("max_axial_stroke_in", "max_axial_stroke_out", "max_torsion"):
            at = run.loads[f"{load}_time"]
            assert at is None or start < at < end


def test_a_run_that_swings_on_for_long_does_not_make_its_touches_a_line():
    run = capture_sim.simulate("tilt_0", {"buffer.c_A": 0.0, "run.t_end": 40.0})
    start, end = time_window(run)
    assert end - start < 8.0 * (decided_at(run) - run.touches["start"].min())


def test_snapshots_show_start_and_first_touch_in_the_state_of_the_run(runs):
    for run in runs:
        times = snapshot_times(run, 6)
        assert times[:2].tolist() == [0.0, run.touches["start"].min()]
        k = round(times[3] * 1000)
        assert state_at(run, k * 1e-3) == pytest.approx(run.samples["q"][k], abs=1e-9)


# shapes


def distance_to_segment(point, ends):
    a, b = ends
    along = np.clip(np.dot(point - a, b - a) / np.dot(b - a, b - a), 0.0, 1.0)
    return np.linalg.norm(point - (a + along * (b - a)))


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("beta", [0.3, math.pi / 4, 1.2])
def test_bound_of_the_tip_lies_one_radius_off_the_wall_on_its_inner_side(side, beta):
    scene = capture_sim.load_scene("tilt_0", [f"cone.half_angle={beta}", "string.drop_height=0.05"])
    ends, radius = wall(scene.cone, side), scene.probe.tip_radius
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(scene.cone.L_c)
    assert ends[0].tolist() == [0.0, side * scene.cone.R_c]
    assert ends[1][0] < 0.0 < side * (ends[1][1] - ends[0][1])
    bound = tip_bound(scene.cone, radius, side)
    distances = [distance_to_segment(point, ends) for point in bound]
    assert distances == pytest.approx([radius] * len(bound))
    # it starts in the throat and ends outside of the lip
    assert bound[0] == pytest.approx([0.0, side * (scene.cone.R_c - radius)])
    assert bound[-1][0] < ends[1][0]


def test_tip_in_cone_in_world_and_on_its_bound_agree(runs, undamped):
    for run in runs:
        q = run.samples["q"]
        # into the target's frame by complex numbers
        local = (tip_in_world(run.scene, q) - q[:, 5:7]) @ [1, 1j] * np.exp(-1j * q[:, 7])
        expected = tip_in_cone(run.samples) @ [1, 1j]
        assert local + run.scene.cone.L_T == pytest.approx(expected, abs=1e-12)
    tips = tip_in_cone(undamped.samples)[undamped.samples["walls"] == 1]
    ends = wall(undamped.scene.cone, 1)
    distances = np.array([distance_to_segment(tip, ends) for tip in tips])
    assert np.abs(distances - undamped.scene.probe.tip_radius).max() < 1e-4


def test_a_turned_target_is_drawn_counterclockwise(runs):
    for run, degrees in zip(runs, (0.0, 10.0, -10.0), strict=True):
        shapes = state_shapes(run.scene, run.samples["q"][0], style.BLUE)
        edges = [shape.points[0] for shape in shapes if shape.line == style.DARK]
        axis = np.mean(edges, axis=0) - run.samples["q"][0, 5:7]
        # BE lies on the target's -x side: turned to the left, it moves to -y
        turned = math.degrees(math.atan2(-axis[1], -axis[0]))
        assert turned == pytest.approx(degrees, abs=0.1)


# colours


# simulated by the matrices of Vienot, Brettel and Mollon (1999), linear light
VISIONS = {
    "normal": np.eye(3),
    "protan": [[0.11238, 0.88762, 0.0], [0.11238, 0.88762, 0.0], [0.00401, -0.00401, 1.0]],
    "deutan": [[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]],
}
NEIGHBOURS = {
    "runs": style.RUNS[: style.COLOURS_ALONE],
    "verdicts": [look.colour for look in style.VERDICTS.values()],
    "phases": [*style.PHASES.values()],
    "states": [*style.STATES.values()],
    **{f"layers {i}": (LAYERS[i][1], LAYERS[i + 1][1]) for i in range(len(LAYERS) - 1)},
}


@pytest.mark.parametrize("vision", VISIONS)
@pytest.mark.parametrize("group", NEIGHBOURS)
def test_colours_differ_also_for_the_colour_blind(group, vision):
    colours = np.array([to_rgb(colour) for colour in NEIGHBOURS[group]]) ** 2.2
    seen = (colours @ np.transpose(VISIONS[vision])).clip(0.0, 1.0) ** (1 / 2.2)
    least = 0.14 if group in ("phases", "states") else 0.2  # lanes have names too
    for i in range(len(seen)):
        assert (np.abs(seen[i] - seen[:i]).max(axis=1, initial=0.0) > least).all() or i == 0


def test_ten_runs_have_colours_and_markers_that_mean_nothing_else():
    colours = np.array([to_rgb(style.run_colour(i)) for i in range(10)])
    for i in range(1, 10):
        assert (np.abs(colours[i] - colours[:i]).max(axis=1) > 0.2).all()
    markers = {style.run_marker(i) for i in range(10)}
    assert len(markers) == 10
    assert not markers & {marker for marker, _ in style.WALLS.values()}
    meanings = {*style.PHASES.values(), *style.STATES.values(), style.CONTACT, style.ZONE}
    assert not meanings & set(style.RUNS)
