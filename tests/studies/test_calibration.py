"""Several trials of a bench with known parameters give them back, and a wrong fit is refused."""

from __future__ import annotations

import dataclasses
import json
import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from cases import cases
from measured_trials import NOISE, measured_trial, short_scene

import capture_sim
from capture_sim.commands.calibrate import held_lines, left_out_rows, residual_rows
from capture_sim.errors import RecordingError, SceneError
from capture_sim.run.frames import Table
from capture_sim.run.series import Series
from capture_sim.run.touches import located
from capture_sim.scene.loading import load_scene, load_scene_text
from capture_sim.scene.paths import changed, expanded, get
from capture_sim.studies.compare.frame import NO_FRAME, Frame, in_frame_of_scene
from capture_sim.studies.evaluate.executors import open_executor
from capture_sim.studies.fit.calibrate import calibrate, predicted
from capture_sim.studies.fit.checks import clustered, convergence, direction_words
from capture_sim.studies.fit.descent import EndedSearch, Found, HopelessError, grow
from capture_sim.studies.fit.files import as_data, read_calibrated, scene_text
from capture_sim.studies.fit.fitting import fit_trials
from capture_sim.studies.fit.held import held_parameters, uncertainties
from capture_sim.studies.fit.joint import Linear, Problem, inverse
from capture_sim.studies.fit.lacking import lacking_text, names_with
from capture_sim.studies.fit.new_trial import agreement_of
from capture_sim.studies.fit.parameters import SENSOR_ERRORS, parameters_of, read_weighed
from capture_sim.studies.fit.prediction import Placement, read_placement
from capture_sim.studies.fit.result import Lacking, result_of
from capture_sim.studies.fit.score_tests import FIELDS, NAMED, Score, needed, possible
from capture_sim.studies.fit.trial import (
    hold_after_release,
    residuals,
    simulate,
    trial_of,
    view,
)
from capture_sim.studies.vary.inputs import Known

TRUE = {"contact.restitution": 0.6, "friction.mu": 0.27, "buffer.k_A": 560.0}
NAMES = ("e", "mu", "buffer.k_A")
VALUES = (0.6, 0.27, 560.0)
#: Stiffness of a contact so soft that the linear estimate from the scene's is negative, N/m^1.5.
SOFT = 0.05 * short_scene().contact_stiffness


def two_trials(first=0, true=TRUE, **more):
    scenes = short_scene(0.0), short_scene(0.15)
    return [
        measured_trial(scene, true, first + k, name=f"trial {k}", **more)
        for k, scene in enumerate(scenes)
    ]


@pytest.fixture(scope="module")
def fitted():
    """The fit of two trials, made once."""
    return calibrate(two_trials(), NAMES, restarts=0)


def test_two_trials_give_their_parameters_back():
    found = calibrate(two_trials(shift=(1e-3, 8e-4, 4e-3)), NAMES)
    assert found.is_found, found.findings
    assert len(found.restarts) == 2  # each was simulated, and came back
    assert [text.get_text() for text in found.plot().axes[0].get_yticklabels()] == list(NAMES)
    assert np.abs((found.values - VALUES) / found.errors).max() < 4.0
    assert (found.errors / VALUES < (0.03, 0.03, 0.003)).all()
    for start in found.starts:  # the starts that no scene has
        off = np.array([1e-3, 8e-4, 4e-3])
        assert np.abs((start.values[3:] - start.values[:3]).size) == 3
        target = found.problem.trials[0].scene.initial.target
        assert abs(start.values[4] - target.y - off[1]) < 4.0 * start.errors[4]
    assert found.scene.buffer.k_A == pytest.approx(found.values[2])


@pytest.mark.long
def test_errors_are_the_spread_of_many_noises():
    off, exact = [], {}
    for seed in range(12):
        found = calibrate(two_trials(10 * seed), NAMES, restarts=1, uncertain=exact)
        exact = exact or {one.name: 0.0 for one in found.held}
        if seed == 0:
            found = calibrate(two_trials(0), NAMES, restarts=1, uncertain=exact)
        off.append((found.values - VALUES) / found.errors)
    # chi-square of 12 x 3 freedoms: 0.1 % quantiles at 0.43 and 1.89
    assert 0.43 < float(np.mean(np.square(off))) < 1.89


@pytest.mark.long
def test_a_trial_of_a_changed_bench_is_named():
    trials = two_trials()
    other = {**TRUE, "buffer.k_A": 561.5}
    trials.append(measured_trial(short_scene(-0.1), other, 7, name="the third"))
    found = calibrate(trials, NAMES, restarts=0)
    kinds = {finding.kind: finding.text for finding in found.findings}
    assert "the third is furthest" in kinds["trials"]
    assert found.verdict == "not found"
    assert "as if by another buffer.k_A there (+0." in kinds["trials"]  # 0.27 % by this trial alone


@pytest.mark.parametrize(
    "name, more, true",
    [
        ("buffer.friction", {"true": {**TRUE, "buffer.friction": 0.02}}, 0.02),
        pytest.param(
            "drag",
            {"true": {**TRUE, "chaser.drag": 0.5, "target.drag": 0.5}},
            0.5,
            marks=pytest.mark.long,
        ),
        pytest.param(
            "buffer.c_A_rebound",
            {"true": {**TRUE, "buffer.c_A_rebound": 13.5}},
            13.5,
            marks=pytest.mark.long,
        ),
        pytest.param(
            "contact.stiffness",
            {"true": {**TRUE, "contact.stiffness": SOFT}},
            SOFT,
            marks=pytest.mark.long,
            id="contact.stiffness",
        ),
    ],
)
def test_what_the_model_lacks_is_named_with_its_size(name, more, true):
    found = calibrate(two_trials(**more), NAMES, restarts=0)
    named = {one.score.name: one for one in found.lacking}
    assert not found.is_found
    assert name in named
    assert abs(named[name].estimate - true) < max(5.0 * named[name].error, 0.02 * true)
    lacks = [finding for finding in found.findings if finding.kind == "lacks"]
    assert not any("no candidate, e.g." in finding.advice for finding in lacks)


@pytest.mark.parametrize("name", [field.name for field in FIELDS if "stops" not in field.name])
def test_what_is_advised_can_be_carried_out(name):
    """Also if the scene leaves the value to be computed, or a short name has been fitted."""
    scene = load_scene("tilt_0")
    parameters = parameters_of(scene, (*NAMES, "c_rr"))
    again = parameters_of(scene, names_with(name, parameters))
    paths = {path for parameter in again for path in parameter.paths}
    assert paths == {path for p in parameters for path in p.paths} | set(expanded(name))


@pytest.mark.parametrize(
    "name, more, true",
    [
        ("delay.buffer", {"delays": {"stroke": 12e-3, "torsion": 12e-3}}, 12e-3),
        pytest.param("scale.stroke", {"scales": {"stroke": 1.04}}, 1.04, marks=pytest.mark.long),
        pytest.param("scale.torsion", {"scales": {"torsion": 0.97}}, 0.97, marks=pytest.mark.long),
    ],
)
def test_an_encoder_that_is_late_or_reads_too_much_is_held_and_found(name, more, true):
    """No encoder is exact: its error is known at the end, and the fit is one of the bench."""
    found = calibrate(two_trials(**more), NAMES, restarts=0)
    held = {one.name: one for one in found.held}[name]
    assert found.is_found, found.findings
    assert abs(held.fitted - true) < 4.0 * held.known_to
    assert held.known_to < 0.5 * held.error
    is_far = abs(true - held.value) > 3.5 * held.error
    assert any(f"held, {name} = " in line for line in held_lines(found)) or not is_far
    assert (np.abs(found.values - VALUES) < 4.0 * found.errors).all()


@pytest.mark.long
def test_a_held_value_that_explains_the_residuals_is_scored_with_its_size():
    """It is fitted from the start where it does not join otherwise."""
    true = {**TRUE, "cone.half_angle": math.radians(45.0) + 3e-3}
    trials = [trial_of(trial) for trial in two_trials(true=true)]
    scene = trials[0].scene
    found = fit_trials(trials, parameters_of(scene, NAMES), restarts=0, has_scores=False)
    held = held_parameters([scene], uncertainties(scene, NAMES))
    gains = {
        each.name: score
        for each in held
        if each.paths and (score := needed(found.linear, found.problem, each)) is not None
    }
    best = max(gains.values(), key=lambda score: score.gain)
    assert best.name == "cone.half_angle"
    assert best.gain > NAMED
    assert best.estimate == pytest.approx(true["cone.half_angle"], abs=1e-3)


def test_a_weighed_hanging_mass_is_held_with_its_error():
    """The launch's own number is 1 % wrong: the fit takes the scales' value."""
    trials = [measured_trial(load_scene("tilt_0", {"run.t_end": 3.2}), TRUE, 1)]
    mass = get(trial_of(trials[0]).scene, "string.hanging_mass")
    weighed = {"string.hanging_mass": f"{1.01 * mass} +- 0.3 %"}
    found = calibrate(trials, NAMES, restarts=0, weighed=weighed)
    held = {one.name: one for one in found.held}["string.hanging_mass"]
    assert held.value == mass  # as recorded
    assert held.error == pytest.approx(0.003 * 1.01 * mass)
    assert abs(held.fitted - mass) < 4.0 * held.known_to
    with pytest.raises(SceneError, match="must be within 5% of it"):
        calibrate(trials, NAMES, weighed={"string.hanging_mass": f"{1.1 * mass} +- 0.3 %"})


@pytest.mark.long
def test_what_trials_lack_and_what_is_not_used_is_said():
    trials = two_trials()
    series = {name: by for name, by in trials[1].series.items() if name != "torsion"}
    found = calibrate([trials[0], trials[1].replaced(series=series)], NAMES, restarts=0)
    assert any("trial 1: no torsion: " in note for note in found.notes)
    assert not any("placed alike" in note for note in found.notes)
    twice = [measured_trial(short_scene(), {}, seed, name=f"trial {seed}") for seed in range(2)]
    assert "trial 0, trial 1: placed alike, " in calibrate(twice, ["c_rr"], restarts=0).notes[-1]


def test_candidates_that_trials_do_not_tell_apart_are_named_together():
    """A floor tilted by 0.05 mrad, which no candidate stands for, has two of about equal gain."""
    score = Score("latch.damping", "damping of the latch", 36.2, 79.2, 0.13, "N s/m")
    alone = Lacking(score, 79.24, 0.13, 34.1)
    assert lacking_text(alone).startswith("the model lacks latch.damping = 79.24 +- 0.13 N s/m")
    text = lacking_text(alone._replace(rivals=("latch.stiffness",)))
    assert "lacks one of latch.damping, latch.stiffness, which these trials do not tell" in text


def test_a_fit_whose_restarts_cannot_be_simulated_is_not_found():
    """Else a fit would be called found that nothing has tried to better."""
    problem = Problem([trial_of(run) for run in two_trials()], parameters_of(short_scene(), NAMES))
    place = np.zeros(problem.dimension)
    flat = np.zeros((problem.dimension, problem.dimension))
    at = Linear(place, 1.0, [], [], flat, place, np.zeros(problem.dimension, bool))
    for made, said in ((0, "only 0 of 4"), (1, "only 1 of 4"), (4, "")):
        found = Found(EndedSearch(at, 0), [(0.1, 0.1)] * made, asked=4)
        assert convergence(found)[0].startswith(said)
    assert convergence(Found(EndedSearch(at, 0)))[0] == ""


def test_numbers_without_information_take_no_variance():
    """A release that is known: rounding errors over its zero would be a variance of 1e136."""
    hessian = np.array([[4.0, 1.0, 1e-17], [1.0, 2.0, 0.0], [1e-17, 0.0, 0.0]])
    covariance = inverse(hessian)
    assert covariance[:2, :2] == pytest.approx(np.linalg.inv(hessian[:2, :2]))
    assert not covariance[2].any()


def test_differences_are_one_standard_error_long():
    """Shorter ones take the roughness of the chatter for information: errors get too small."""
    problem = Problem([trial_of(run) for run in two_trials()], parameters_of(short_scene(), NAMES))
    spread = np.array([[4e-5, 1e-5, 0.0], [1e-5, 9e-5, 2e-5], [0.0, 2e-5, 1e-4]])
    covariance = np.eye(problem.dimension)
    covariance[:3, :3] = spread
    axes = problem._axes(covariance)
    assert axes @ axes.T == pytest.approx(spread)


def test_a_force_whose_delay_is_not_known_shows_only_the_time_between_its_touches():
    scene = short_scene()
    met = located(capture_sim.simulate(scene).touches).of(slice(3)).with_default_noise(1e-4, 1.0)
    size = 2 * met.start.size
    for is_known, late, factor in ((False, 2e-3, 0.0), (True, 2e-3, 1.0)):
        touches = dataclasses.replace(met.later(late), is_delay_known=is_known)
        trial = trial_of(measured_trial(scene, {}, 1), touches=touches)
        own = np.zeros(7)
        motion = simulate(trial, {}, own, {})
        found = residuals(trial, motion, view(trial, motion, own, {}), 0.0)[-size:]
        expected = np.repeat([factor * late / 1e-4, 0.0], met.start.size)
        assert found == pytest.approx(expected, abs=0.1)


@pytest.mark.long
def test_what_was_weighed_enters_values_and_errors():
    trials = two_trials(true={"friction.mu": 0.27, "buffer.k_A": 560.0})
    free = calibrate(trials, ("mu", "buffer.k_A"), restarts=0)
    error = 0.3 * float(free.errors[1])
    known = calibrate(trials, ("mu",), weighed={"buffer.k_A": Known(560.0, error)}, restarts=0)
    assert known.names == ("mu", "buffer.k_A")
    # two independent measurements of one number
    assert known.errors[1] == pytest.approx((free.errors[1] ** -2 + error**-2) ** -0.5, rel=0.1)


def test_directions_without_information_are_said_in_words():
    names = ("chaser.mass", "target.mass", "buffer.k_A", "mu")
    parameters = parameters_of(short_scene(), names)
    text, advice = direction_words(parameters, np.array([0.58, 0.58, 0.57, 0.01]))
    assert text.startswith("only the ratios of chaser.mass, target.mass and buffer.k_A")
    assert "--weighed chaser.mass=" in advice
    text, _ = direction_words(parameters, np.array([0.0, 0.02, 0.0, 1.0]))
    assert text == "mu: the measurements do not depend on it"
    # no touch, no friction: the fit itself says so
    launch = load_scene("tilt_0", {"run.t_end": 1.2})
    found = calibrate([measured_trial(launch, {}, 1)], ("c_rr", "mu"), restarts=0)
    assert any(finding.kind == "undetermined" for finding in found.findings)
    assert np.isfinite(found.errors[0])
    assert np.isinf(found.errors[1])


def test_a_value_at_the_end_of_its_range_is_refused():
    found = calibrate(
        two_trials(true={**TRUE, "buffer.c_A": 12.98}), (*NAMES, "buffer.friction"), restarts=0
    )
    texts = [finding.text for finding in found.findings if finding.kind == "bound"]
    assert texts == ["buffer.friction = 0 N is at the end of its range"]


def same_fit(a, b):
    return [repr(x) for x in (a.values, a.errors, a.reduced_chi2, a.simulations, a.scores)] == [
        repr(x) for x in (b.values, b.errors, b.reduced_chi2, b.simulations, b.scores)
    ]


@pytest.mark.long
def test_a_fit_is_the_same_in_threads_and_by_processes():
    """Two threads shared one memory, and a simulation that one spoiled counted as impossible."""
    trials, names = two_trials()[:1], ("mu", "buffer.k_A")
    alone = calibrate(trials, names, restarts=1)
    with ThreadPoolExecutor(2) as threads:
        fits = [threads.submit(calibrate, trials, names, restarts=1) for _ in range(2)]
        assert all(same_fit(alone, fit.result()) for fit in fits)
    with open_executor(2) as executor:
        assert same_fit(alone, calibrate(trials, names, restarts=1, executor=executor))


def test_an_interrupted_fit_is_the_state_so_far_and_says_so():
    def interrupt(done, expected):
        if done == 60:
            raise KeyboardInterrupt

    found = calibrate(two_trials(), NAMES, report=interrupt)
    assert not found.is_found
    assert [finding.kind for finding in found.findings] == ["unfinished"]
    data = as_data(found, {})
    assert data["is_found"] is False


@pytest.mark.parametrize(
    "trials, fit, said",
    [
        (lambda t: t, ("mu", "mu"), "parameter mu: given twice"),
        (lambda t: t, ("c_A", "buffer.c_A"), "is also fitted as c_A"),
        (lambda t: t, ("friction.nu",), "friction.nu"),
        (lambda t: t, ("initial.chaser.y",), "is of one trial, and always fitted"),
        (lambda t: [], None, "trials: must be one run or more"),
        (
            lambda t: [t[0], t[1].replaced(scene=changed(t[1].scene, "cone.R_c", 0.016))],
            None,
            "trial 1: cone.R_c = 0.016, in trial 0 0.015: must be trials of one bench",
        ),
        (
            lambda t: [
                t[0].replaced(series={k: v for k, v in t[0].series.items() if k != "target"})
            ],
            None,
            "contains no pose of the target",
        ),
    ],
)
def test_bad_input_is_one_line(trials, fit, said):
    with pytest.raises((SceneError, RecordingError), match=said) as caught:
        calibrate(trials(two_trials()), fit)
    assert "\n" not in str(caught.value)


def test_fewer_measurements_than_parameters_are_refused():
    series = {
        name: {source: Series(s.t[:2], s.values[:2]) for source, s in sources.items()}
        for name, sources in two_trials()[0].series.items()
        if name in ("chaser", "target")
    }
    run = two_trials()[0].replaced(series=series)
    with pytest.raises(SceneError, match="12 measured values for 17 parameters"):
        calibrate([run])


def test_a_scene_that_fails_at_the_start_is_refused():
    run = two_trials()[0]
    broken = run.replaced(scene=changed(run.scene, "run.max_steps", 100))
    with pytest.raises(SceneError, match="trial 0: cannot be simulated at the start"):
        calibrate([broken], NAMES)


def test_the_first_hold_after_the_release_ends_a_trial():
    """Its log time is mapped to stamps by the poses near it, not by those of the start-up."""
    run = two_trials()[0]
    t = np.arange(-0.5, 5.0, 0.01)
    late = np.where(t < 0.3, 0.08, 0.002)  # the recorder was slow while it started
    chaser = Series(t, np.zeros((t.size, 3)), t + late)
    held = np.array([True, True, False, False, True, True])
    logged = np.array([-0.2, -0.1, 0.08, 2.0, 4.002, 4.1])
    tables = {"/launcher/hold": Table({"t": logged, "data": held}, {})}
    run = run.replaced(series={**run.series, "chaser": {"mocap": chaser}}, tables=tables)
    assert hold_after_release(run) == pytest.approx(4.0 - 0.01, abs=1e-6)
    never = run.replaced(tables={"/launcher/hold": Table({"t": logged[:4], "data": held[:4]}, {})})
    assert hold_after_release(never) == math.inf


@pytest.mark.parametrize(
    "text, value, error",
    [
        ("chaser.mass=22.6 +- 0.02 kg", 22.6, 0.02),
        ("chaser.mass=22600 g +- 20 g", 22.6, 0.02),
        ("chaser.mass=22.6 +- 0.1%", 22.6, 0.0226),
        ("buffer.k_A=0.64 +- 0.01 N/mm", 640.0, 10.0),
        ("chaser.inertia=4.68e-1 +- 1e-3", 0.468, 1e-3),
        ("string.hanging_mass=412 +- 1 g", 0.412, 1e-3),
    ],
)
def test_weighed_values_are_read_with_units(text, value, error):
    _, weighed = read_weighed(load_scene("tilt_0"), text)
    assert weighed.value == pytest.approx(value)
    assert weighed.error == pytest.approx(error)


@pytest.mark.parametrize("low, high", [(0.0, math.inf), (0.0, 1.0), (-math.inf, 1.0)])
@pytest.mark.parametrize("estimate", [-1e9, -0.3, 0.0, 0.2, 0.6, 1.0, 40.0])
def test_an_estimate_of_a_linear_model_is_one_that_the_bench_could_have(low, high, estimate):
    """A softer contact is estimated with a negative stiffness: the search begins at a small one."""
    found = possible(0.5, estimate, low, high)
    assert low < found < high
    assert (found < 0.5) == (estimate < 0.5)
    if low < estimate < high:
        assert found == estimate


@pytest.mark.parametrize("text", ["chaser.mass=22.6", "chaser.mass", "chaser.mass=a +- b kg"])
def test_weighed_values_that_are_none_are_refused(text):
    with pytest.raises(SceneError, match=r"chaser.mass.* must be "):
        read_weighed(short_scene(), text)


def test_placement_is_read_with_units():
    assert read_placement("0.2 mm, 1 mrad").position == pytest.approx(2e-4)
    with pytest.raises(SceneError, match="placement 1: must be a length and an angle"):
        read_placement("1")


def test_a_prediction_has_the_spread_of_its_parameters(fitted):
    """Its figures are those of the true bench within the errors that it says."""
    by_name = {figure.name: figure for figure in predicted(fitted, short_scene(0.08)).figures}
    stroke = by_name["max_axial_stroke_in"]
    true = calibrate_free(short_scene(0.08))
    assert abs(stroke.value - true) < 4.0 * stroke.error + 1e-9
    assert stroke.low < stroke.value < stroke.high


def calibrate_free(scene):
    from capture_sim.run.simulation import simulate
    from capture_sim.scene.paths import with_values

    return simulate(with_values(scene, TRUE)).loads["max_axial_stroke_in"]


def test_the_calibrated_scene_can_be_loaded(tmp_path):
    """It is the bench that the fit found, with what it found of held values too."""
    found = calibrate(two_trials(true={**TRUE, "floor.tilt_x": 4e-5}), NAMES, restarts=0)
    known = {one.name: one.fitted for one in found.held if one.name not in SENSOR_ERRORS}
    assert "floor.tilt_x" in known
    file = tmp_path / "calibrated.yaml"
    file.write_text(scene_text(found, short_scene(), "tilt_0", "calibrated"))
    for scene in (load_scene(file), load_scene_text(found.scene.to_yaml())):
        for path, value in {**known, **found.fields_of(scene)}.items():
            assert get(scene, path) == pytest.approx(value)


@pytest.mark.long
def test_a_trial_agrees_with_a_calibration_that_held_values_wrong(tmp_path):
    """The floor that the calibration found tilted is tilted in the next trial, too."""
    true = {**TRUE, "floor.tilt_x": 9e-5, "latch.stiffness": 0.9 * short_scene().latch.stiffness}
    found = calibrate(two_trials(true=true), (*NAMES, "c_rr"), restarts=1)
    (tmp_path / "calibration.json").write_text(json.dumps(as_data(found, {})))
    calibrated = read_calibrated(tmp_path)
    coming = measured_trial(short_scene(0.1), true, 9)
    agreement = agreement_of(coming, calibrated, Placement(2e-4, 1e-3))
    assert agreement.agrees, agreement.sentence


def test_a_target_at_another_angle_is_no_frame():
    """Before, a target of a trial that stood at -13 degrees turned 'the frame' by 4.3 degrees."""
    trial = capture_sim.simulate("tilt_p10", "sensors.motion_capture={}")
    assert in_frame_of_scene(trial, load_scene("tilt_m10"))[1] == NO_FRAME


@pytest.mark.parametrize("frame", [Frame(0.0, 0.1, 0.0), Frame(0.5), Frame(2.5, 0.3, -0.2)])
def test_a_trial_in_another_frame_of_the_cameras_is_the_same_trial(frame, fitted, tmp_path):
    """Before, 0.1 m or 0.5 rad made a chi2 of 1e7, without a word of the frame."""
    (tmp_path / "calibration.json").write_text(json.dumps(as_data(fitted, {})))
    coming = measured_trial(short_scene(0.1), TRUE, 9)
    series = dict(coming.series)
    for name in ("chaser", "target"):
        series[name] = {
            topic: Series(each.t, frame.applied(each.values))
            for topic, each in series[name].items()
        }
    agreements = [
        agreement_of(run, read_calibrated(tmp_path), Placement(2e-4, 1e-3))
        for run in (coming, coming.replaced(series=series))
    ]
    assert all(each.agrees for each in agreements), agreements[1].sentence
    assert agreements[1].parameters.statistic == pytest.approx(
        agreements[0].parameters.statistic, rel=0.02
    )
    assert "the cameras' frame is turned by" in agreements[1].sentence
    assert "frame" not in agreements[0].sentence


# what is held


HELD_WRONG = {
    "nothing": {},
    "a tilted floor": {"floor.tilt_x": 4e-5},
    "another latch": {"latch.stiffness": 0.93 * short_scene().latch.stiffness},
    "another hinge": {"buffer.hinge_offset": short_scene().buffer.hinge_offset + 1.5e-4},
}


@pytest.mark.parametrize("wrong", cases(few=list(HELD_WRONG)[1:2], all=list(HELD_WRONG)))
def test_values_that_are_held_wrong_are_in_the_errors(wrong):
    """Within their uncertainty; as exact values they were refused, or found 5 errors off."""
    true = {**TRUE, **HELD_WRONG[wrong]}
    names, values = (*NAMES, "c_rr"), np.array([*VALUES, short_scene().supports.chaser.c_rr])
    found = calibrate(two_trials(true=true), names, restarts=1)
    assert found.is_found, found.findings
    assert np.abs((found.values - values) / found.errors).max() < 3.0
    held = {one.name: one for one in found.held}
    assert not set(held) & {"supports.chaser.c_rr", "contact.restitution", "buffer.k_A"}
    for name, value in HELD_WRONG[wrong].items():
        assert abs(held[name].fitted - value) < 4.0 * held[name].known_to
        assert held[name].known_to <= held[name].error
    data = as_data(found, {})
    assert [one["name"] for one in data["held"]] == list(held)
    assert data["held"][0]["moves"].keys() == set(names)


def trials_with_a_wave(size):
    """Two trials whose stroke has a wave that no model of the bench or its sensors has."""
    runs = two_trials()
    for run in runs:
        (stroke,) = run.series["stroke"].values()
        wave = size * NOISE["stroke"] * np.sin(stroke.t * 18.0)
        run.series["stroke"]["a sensor"] = stroke._replace(values=stroke.values + wave)
    return runs


@pytest.mark.long
def test_what_does_not_explain_the_residuals_is_not_advised():
    found = calibrate(trials_with_a_wave(2.0), NAMES, restarts=0)
    assert found.verdict == "not found"
    lacks = [finding for finding in found.findings if finding.kind == "lacks"]
    assert lacks
    for finding in lacks:
        assert "may be another, which has no candidate" in finding.advice
        assert "--fit" not in finding.advice


@pytest.mark.long
def test_a_fit_with_a_small_wave_in_its_residuals_is_usable_with_larger_errors():
    found = calibrate(trials_with_a_wave(0.4), NAMES, restarts=0)
    assert found.verdict == "usable", found.findings
    assert {finding.kind for finding in found.findings} <= {"residuals", "lacks"}
    assert "usable" in repr(found)
    assert as_data(found, {})["verdict"] == "usable"
    assert (found.errors > found.noise_errors).all()
    assert np.abs((found.values - VALUES) / found.errors).max() < 4.0


SMALL_FAULTS = {
    "friction": lambda: two_trials(true={**TRUE, "buffer.friction": 0.007}),
    "rebound": lambda: two_trials(true={**TRUE, "buffer.c_A_rebound": 13.22}),
    "wave": lambda: trials_with_a_wave(0.6),
}


@pytest.mark.long
@pytest.mark.parametrize("fault", SMALL_FAULTS)
def test_values_of_a_usable_fit_are_within_its_errors(fault):
    found = calibrate(SMALL_FAULTS[fault](), NAMES, restarts=0)
    assert found.verdict == "usable", found.findings
    assert np.abs((found.values - VALUES) / found.errors).max() < 4.0
    # what is predicted of another trial has these errors, not those of independent noise
    spread = predicted(found, short_scene(-0.1)).figures[0].error
    exact = dataclasses.replace(found, whole=found.linear.covariance)
    assert spread > predicted(exact, short_scene(-0.1)).figures[0].error


def test_clusters_of_residuals_widen_errors_by_what_they_share(fitted):
    """Of independent noise by little, of residuals that all pull alike by their number."""
    at, problem = fitted.linear, fitted.problem
    noise = clustered(at, problem)[2, 2] / at.covariance[2, 2]
    assert 1.0 < noise < 4.0
    shown = [
        dataclasses.replace(one, residuals=one.residuals + 0.5 * np.sign(J[:, 2]))
        for one, J in zip(at.shown, at.jacobians, strict=True)
    ]
    alike = dataclasses.replace(at, shown=shown)
    assert clustered(alike, problem)[2, 2] / at.covariance[2, 2] > 3.0 * noise


@pytest.mark.long
def test_an_exact_value_is_not_held():
    trials = two_trials()
    found = calibrate(trials, NAMES, restarts=0, uncertain={"floor.tilt_x": 0, "cone.L_T": "1 mm"})
    held = {one.name: one for one in found.held}
    assert "floor.tilt_x" not in held
    assert held["cone.L_T"].error == pytest.approx(1e-3)


@pytest.mark.parametrize("drag", cases(few=[0.0], all=[0.0, 0.15]))
def test_a_held_value_may_be_at_the_end_of_its_range(drag):
    """A drag of 0 is no reason to refuse a fit; one that the bench has is in the errors."""
    true = {**TRUE, "chaser.drag": drag, "target.drag": drag}
    found = calibrate(two_trials(true=true), NAMES, restarts=0, uncertain={"drag": "0.1 N s/m"})
    assert found.is_found, found.findings
    assert np.abs((found.values - VALUES) / found.errors).max() < 4.0
    held = {one.name: one for one in found.held}
    assert abs(held["chaser.drag"].fitted - drag) < 4.0 * held["chaser.drag"].known_to


@pytest.mark.parametrize(
    "given, says",
    [
        ({"buffer.k_A": "1 %"}, "uncertain buffer.k_A: is fitted"),
        ({"floor.tilt_x": "-1 mrad"}, "uncertain floor.tilt_x = -1 mrad: must be a number in rad"),
        ({"floor.tilt_x": "flat"}, "must be a number in rad or %, >= 0"),
        ({"floor.level": 1e-5}, "floor.level: no number of tilt_0; "),
    ],
)
def test_wrong_uncertainties_are_refused_before_anything_runs(given, says):
    with pytest.raises(SceneError, match=says):
        calibrate(two_trials(), NAMES, uncertain=given)


def test_a_prediction_has_the_held_values(fitted):
    """Each draw has its own: a latch of which nothing is known makes its own load uncertain."""
    exact, coming = {one.name: 0 for one in fitted.held}, short_scene(0.08)
    narrow = calibrate(two_trials(), NAMES, restarts=0, predict=coming, uncertain=exact)
    assert not narrow.held
    wide = predicted(fitted, coming)
    for one, other in zip(wide.figures, narrow.prediction.figures, strict=True):
        assert one.spread > 0.5 * other.spread
    assert wide.failed == 0


def test_errors_contain_where_restarts_end(fitted):
    """In the roughness of chi2 the end of a search is as uncertain as where others end."""
    at, k = fitted.linear, len(NAMES)
    off = np.zeros(at.place.size)
    off[0] = 3.0 * fitted.errors[0] / abs(fitted.problem.parameters[0].slope(float(at.place[0])))
    there = EndedSearch(dataclasses.replace(at, place=at.place + off), 0)
    far = dataclasses.replace(at, place=at.place - 9.0 * off, chi2=at.chi2 + 20.0)
    both = Found(EndedSearch(at, 0), others=[there, EndedSearch(far, 0)])
    wider = result_of(fitted.problem, both, [], fitted=k).errors / fitted.errors
    assert wider[0] == pytest.approx(math.sqrt(10.0))
    assert wider[1:] == pytest.approx(np.ones(k - 1))


def test_what_a_trial_moves_is_what_a_fit_without_it_gives(fitted):
    """The linear model against fits of the trials that are left."""
    trials = [*two_trials(), measured_trial(short_scene(-0.12), TRUE, 7, name="trial 2")]
    found = calibrate(trials, NAMES, restarts=0)
    for number, others in ((0, calibrate(trials[1:], NAMES, restarts=0)), (2, fitted)):
        off = (found.left_out[number] - (others.values - found.values)) / found.errors
        # chi2 is rough, and the noise is estimated anew
        assert np.abs(off).max() < 1.0
    rows = residual_rows(found)
    assert [row[:2] for row in rows[:4]] == [
        ["trial 0", "chaser x"],
        ["trial 0", "chaser y"],
        ["trial 0", "chaser theta"],
        ["trial 0", "target x"],
    ]
    assert len(rows) == 3 * 8
    assert not any("*" in cell for row in rows for cell in row)
    assert all(abs(float(row[-1])) < 0.4 for row in rows)
    assert len(left_out_rows(found)) == len(NAMES)


def test_a_path_in_wrong_units_ends_the_search_before_the_contact():
    """A path that is 1.3 times too long: no bench moves so, and that takes 44 simulations."""
    scene = load_scene("tilt_0", {"run.t_end": 3.6})
    run = measured_trial(scene, {}, 1, scales={"chaser": 1.3})
    found = calibrate([run], ["e", "mu"])
    assert not found.is_usable
    assert found.findings[0].text.startswith(
        "not converged: the search has ended before the first contact, where chi2 is "
    )
    assert "of chaser x in phase approach of trial" in found.findings[1].text
    assert found.simulations < 500


@pytest.mark.long
def test_a_further_way_that_is_hopeless_leaves_what_was_found(monkeypatch):
    """A second start, or one with a candidate, replaced the result of the first by its own end."""
    trials = two_trials(true={"friction.mu": 0.27, "buffer.friction": 0.3})[:1]
    calls = []

    def first_only(problem, *rest):
        calls.append(problem)
        place, covariance = grow(problem, *rest)
        if len(calls) == 1:
            return place, covariance
        raise HopelessError(problem, problem.linear(place, problem.weighed(), covariance), 0.1)

    for room in ("fitting", "lacking"):
        monkeypatch.setattr(f"capture_sim.studies.fit.{room}.grow", first_only)
    found = calibrate(trials, ["mu"], restarts=1)
    assert len(calls) > 2
    assert not any("the search has ended" in finding.text for finding in found.findings)
    assert any(finding.kind == "lacks" for finding in found.findings)


def test_a_fit_that_has_had_its_simulations_tries_no_further_way(monkeypatch):
    """Else a bench that lacks several things is searched without an end."""
    trials = two_trials(true={"friction.mu": 0.27, "buffer.friction": 0.3})[:1]
    monkeypatch.setattr("capture_sim.studies.fit.fitting.MOST_SIMULATIONS", 50)
    found = calibrate(trials, ["mu"], restarts=1)
    assert not found.is_usable
    (text,) = [finding.text for finding in found.findings if finding.kind == "budget"]
    assert text.startswith("the search ended after ")
    assert len(found.lacking) == 1
