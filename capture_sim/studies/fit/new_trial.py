"""Test whether a new trial agrees with a calibrated bench: noise, parameters and placement.

The trial's own start and release are fitted with the calibrated values.  A linear model about this
fit then gives the change of the parameters that the trial asks for, and the residuals that remain.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from capture_sim.dynamics.compilation import compile_kernels
from capture_sim.errors import SceneError
from capture_sim.run.run import Run, checked
from capture_sim.scene.parts import Scene
from capture_sim.scene.paths import LAUNCH, get, with_values
from capture_sim.studies.compare.frame import Frame
from capture_sim.studies.fit.checks import block_means, chi2_tail, reduced
from capture_sim.studies.fit.files import Calibrated
from capture_sim.studies.fit.fitting import fit_trials
from capture_sim.studies.fit.joint import Linear, Problem, inverse
from capture_sim.studies.fit.parameters import SENSOR_ERRORS, parameters_of
from capture_sim.studies.fit.prediction import Placement
from capture_sim.studies.fit.result import STARTS, Start
from capture_sim.studies.fit.trial import trial_of
from capture_sim.studies.vary.inputs import Input, Known

#: Smallest p-value of a test at which a trial agrees with the calibration.
MIN_P = 1e-3


class Comparison(NamedTuple):
    """One chi2 test of a trial against a calibration; ``p`` is the chance of a larger statistic."""

    name: str
    statistic: float  # chi2
    freedom: int
    p: float

    @property
    def agrees(self) -> bool:
        """True if the p-value is at least 0.001, so that chance can explain the difference."""
        return self.p >= MIN_P


class TrialAgreement(NamedTuple):
    """Tests of a trial against a calibration: of its noise, parameters and placement."""

    noise: Comparison
    parameters: Comparison
    placement: Comparison
    furthest: str  # parameter that the trial changes by the most of its standard errors
    start: Start
    simulations: int
    frame: Frame = Frame()  # what brings the trial's poses into the scene's frame

    @property
    def agrees(self) -> bool:
        """True if all three tests agree."""
        return self.noise.agrees and self.parameters.agrees and self.placement.agrees

    @property
    def sentence(self) -> str:
        """The result in one sentence."""
        frame = ""
        if self.frame.is_far:
            frame = f" (the cameras' frame is {self.frame.text} against the scene's: taken out)"
        if self.agrees:
            return f"the trial agrees with the calibration{frame}"
        reasons = []
        if not self.noise.agrees:
            reasons.append("its residuals are not noise, whatever the parameters are")
        if not self.parameters.agrees:
            reasons.append(f"its parameters differ, {self.furthest} most")
        if not self.placement.agrees:
            reasons.append("its vehicles were not placed to each other as the scene says")
        return f"the trial does not agree with the calibration: {'; '.join(reasons)}{frame}"


def agreement_of(run: Run, calibrated: Calibrated, placement: Placement) -> TrialAgreement:
    """Test whether a trial agrees with a calibration.

    Parameters
    ----------
    run
        The trial, with its scene.
    calibrated
        Values and covariance of the bench.
    placement
        Standard deviations with which the vehicles are placed at the start poses of the scene.

    Raises
    ------
    SceneError
        The calibration has a field that the trial's scene lacks, or the trial cannot be simulated.
    RecordingError
        The trial has no poses, or breaks a rule of plausibility.
    """
    compile_kernels()
    scene = run.scene
    for path in calibrated.fields:
        if get(scene, path) is None:
            raise SceneError(f"{calibrated.path}: {path}: the scene of the trial has no such value")
    fields, launch, sensors = _held(scene, calibrated)
    run = run.replaced(scene=with_values(scene, {**fields, **calibrated.fields}))
    run = run.replaced(series=checked(run).series)
    trial = trial_of(run, is_release_fitted=scene.string is not None)
    same = {
        path: found.value
        for path, (value, found) in launch.items()
        if get(trial.scene, path) == value  # the mass of the calibration's trials
    }
    trial = replace(trial, scene=with_values(trial.scene, same)) if same else trial
    known = _parameters(run, calibrated)
    found = fit_trials([trial], sensors, restarts=0, has_scores=False)
    assert found.problem is not None
    assert found.linear is not None
    k = len(known)
    problem = Problem(found.problem.trials, [*known, *sensors], found.simulations)
    place = np.concatenate([[p.position(p.begin) for p in known], found.linear.place])
    spread = np.zeros((problem.dimension, problem.dimension))
    slopes = np.array([p.slope(p.position(p.begin)) for p in known])
    spread[:k, :k] = calibrated.covariance / np.outer(slopes, slopes)
    spread[k:, k:] = found.linear.covariance
    at = problem.linear(place, problem.weighed(), spread)
    parameters, furthest = _parameter_test(at, spread[:k, :k], known)
    return TrialAgreement(
        _noise_test(at, problem),
        parameters,
        _placement_test(found.starts[0], trial.scene, placement),
        furthest,
        found.starts[0],
        problem.simulations,
        trial.frame,
    )


def _held(
    scene: Scene, calibrated: Calibrated
) -> tuple[dict[str, float], dict[str, tuple[float, Known]], tuple[Input, ...]]:
    """Return what a calibration found of the values that it held.

    They are fields of the scene, values of the launch, and errors of sensors.  The last are
    fitted to the trial too, because a marker frame may have been set anew.
    """
    fields, launch, sensors = {}, {}, {}
    for name, (value, found) in calibrated.held.items():
        if name in calibrated.names:
            continue
        if name in SENSOR_ERRORS:
            sensors[name] = found
        elif name in LAUNCH:
            launch[name] = value, found
        elif get(scene, name) is not None:
            fields[name] = found.value
    return fields, launch, parameters_of(scene, list(sensors), sensors) if sensors else ()


def _parameters(run: Run, calibrated: Calibrated) -> list[Input]:
    parameters = parameters_of(run.scene, calibrated.names)
    return [
        replace(parameter, begin=float(value))
        for parameter, value in zip(parameters, calibrated.values, strict=True)
    ]


def _parameter_test(
    at: Linear, covariance: np.ndarray, known: Sequence[Input]
) -> tuple[Comparison, str]:
    """Return the test that the trial's parameters are the calibrated ones.

    Also return the name of the parameter that the trial changes most.  ``covariance`` (k, k) is
    that of the calibration, in coordinates.
    """
    k = len(known)
    part = reduced(at, 0, k)
    # the trial's own estimate less the calibrated one has the sum of both covariances, which is
    # taken in the units of the calibration's errors; a parameter may be known exactly
    variances, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(variances, 0.0))
    information = root.T @ part.hessian @ root
    slope = root.T @ part.gradient
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    kept = values > 1e-6 * max(float(values[-1]), 1e-300)
    along = vectors.T @ slope
    statistic = float((along[kept] ** 2 / (values[kept] * (1.0 + values[kept]))).sum())
    # change of the parameters if calibration and trial are combined
    moved = -root @ np.linalg.solve(information + np.eye(k), slope)
    deviations = np.sqrt(np.diag(covariance).clip(0.0))
    sizes = np.divide(np.abs(moved), deviations, out=np.zeros(k), where=deviations > 0.0)
    freedom = int(kept.sum())
    test = Comparison("parameters", statistic, freedom, chi2_tail(statistic, freedom))
    return test, known[int(np.argmax(sizes))].name


def _noise_test(at: Linear, problem: Problem) -> Comparison:
    """Return the test that the residuals are noise after all parameters are fitted to the trial."""
    J, r = at.jacobians[0], at.shown[0].residuals
    moved = r - J @ (inverse(J.T @ J) @ (J.T @ r))
    left = at.shown[0]
    shown = type(left)(left.motion, left.view, moved)
    blocks = block_means(
        Linear(at.place, at.chi2, [shown], at.jacobians, at.hessian, at.gradient, at.free), problem
    )
    if not blocks:
        return Comparison("residuals", 0.0, 0, 1.0)
    statistic = sum(block.statistic for block in blocks)
    freedom = sum(block.means for block in blocks)
    least = min(min(block.p for block in blocks) * len(blocks), 1.0)
    return Comparison("residuals", statistic, freedom, min(chi2_tail(statistic, freedom), least))


def _placement_test(start: Start, scene: Scene, placement: Placement) -> Comparison:
    """Return the test that the vehicles started to each other as in the scene, in ``placement``.

    The frame of the poses is free: three of the six differences are those of a rigid motion.
    """
    expected = np.array([float(get(scene, path)) for path in STARTS])
    allowed = np.tile([placement.position, placement.position, placement.angle], 2)
    off = start.values - expected
    off[[2, 5]] = [math.remainder(angle, math.tau) for angle in off[[2, 5]]]
    motion = np.zeros((6, 3))  # of both poses by shifts along x and y and a turn about the origin
    for k in (0, 3):
        motion[k : k + 3] = [[1.0, 0.0, -expected[k + 1]], [0.0, 1.0, expected[k]], [0.0, 0.0, 1.0]]
    weights = 1.0 / np.hypot(start.errors, allowed)
    of_frame, *_ = np.linalg.lstsq(weights[:, None] * motion, weights * off)
    left = weights * (off - motion @ of_frame)
    statistic, freedom = float(left @ left), off.size - motion.shape[1]
    return Comparison("placement", statistic, freedom, chi2_tail(statistic, freedom))
