"""Calibration of a bench by its trials, with tests of the fit and a prediction."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path

import numpy as np

from capture_sim.errors import SceneError
from capture_sim.run.run import Run, checked
from capture_sim.run.touches import Touches
from capture_sim.scene.loading import as_scene
from capture_sim.scene.parts import Scene
from capture_sim.scene.paths import LAUNCH, NO_PHYSICS, field_names, get, with_values
from capture_sim.studies.compare.frame import first_poses
from capture_sim.studies.fit.descent import RESTARTS
from capture_sim.studies.fit.fitting import fit_trials
from capture_sim.studies.fit.held import held_parameters, uncertainties
from capture_sim.studies.fit.parameters import COMPUTED, parameters_of, read_weighed
from capture_sim.studies.fit.prediction import (
    Placement,
    Prediction,
    predict,
    read_placement,
)
from capture_sim.studies.fit.profiles import Profile, check_profiled, profile_of
from capture_sim.studies.fit.result import UNFINISHED, Calibration
from capture_sim.studies.fit.trial import FittedTrial, launched, resolved, trial_of
from capture_sim.studies.vary.inputs import Known

#: Number of first touches that are fitted; default standard deviations of their times, s, and
#: peak forces, N, if the recording gives none.
TOUCHES, TOUCH_NOISE = 4, (2e-4, 2.0)
#: Quantities of a force sensor.
FORCES = ("tip_force", "cone_force")
#: Trials whose targets are placed within this, m to the side and rad, are placed alike.
ALIKE = (2e-3, 0.01)
#: A weighed value of the launch is refused if it differs more from the recorded one, as a share.
_OTHER_LAUNCH = 0.05


def calibrate(
    trials: Sequence[Run],
    fit: Sequence[str] | None = None,
    *,
    weighed: Mapping[str, str | Known] | None = None,
    uncertain: Mapping[str, str | float] | None = None,
    predict: Scene | str | Path | None = None,
    placement: str | Placement | None = None,
    until: float = math.inf,
    restarts: int = RESTARTS,
    touches: int = TOUCHES,
    profile: Sequence[str] = (),
    seed: int = 0,
    report: Callable[[int, int], None] | None = None,
    executor: Executor | None = None,
) -> Calibration:
    """Fit the parameters of a bench to all of its trials, and test the fit.

    Each trial has its own start poses and release, which are fitted too.  Measurements before the
    release determine the start poses.  Measurements after the first ``launcher/hold`` that follows
    the release are not used.

    Parameters
    ----------
    trials
        Measured runs of one bench, read with :func:`capture_sim.read_run`.
    fit
        Names of the shared parameters: ``c_rr`` (of both vehicles), ``e``, ``mu``, ``c_A``, scene
        fields such as ``buffer.k_A``, and errors of sensors: ``delay.buffer``, ``delay.target``,
        ``scale.stroke``, ``scale.torsion``, ``scale.chaser``, ``scale.target``, ``scale.force``,
        ``offset.stroke``, ``offset.torsion``.  None selects the first four, both buffer
        stiffnesses, and the masses and inertias of both vehicles.
    weighed
        Independently measured values by name, e.g. ``{"chaser.mass": "22.6 +- 0.02 kg"}``.  They
        are fitted too, and their errors enter the covariance.
    uncertain
        Standard uncertainties of values that are neither fitted nor weighed, in place of the
        defaults of :mod:`capture_sim.studies.fit.held`, e.g.
        ``{"floor.tilt_x": "0.02 mrad"}``; 0 for a value that is exact.
    predict
        Scene of a future trial, its name or its file; the result then contains its ``prediction``.
    placement
        Standard deviations of the placement in the future trial, e.g. ``"0.2 mm, 1 mrad"``.
    until
        End of the measurements that are used, s since the release.
    restarts
        Number of successive restarts near the best fit that must find no better fit.
    touches
        Number of first touches of each trial whose times and strengths are fitted, as far as its
        measurements resolve them; else the impulse of the contact is.  With 0, no force is used.
    profile
        Names of fitted parameters whose standard errors are tried, see
        :mod:`capture_sim.studies.fit.profiles`.
    seed
        Seed of the restarts and of the prediction.
    report
        Function called with the number of simulations made, and the number after which no further
        way is tried; most fits need less than half.
    executor
        Executor as in ``concurrent.futures`` for the simulations; None for this process.  The
        result is the same for every executor.

    Returns
    -------
    Calibration
        Values, covariance and tests.  ``findings`` lists the reasons to reject the fit;
        ``is_found`` is True if there is none.  After Ctrl-C the result is the latest state of the
        search, with the finding ``unfinished``.

    Raises
    ------
    SceneError
        A name is unknown or given twice, the trials are of different benches, there are fewer
        measured values than parameters, or the scene cannot be simulated where the search begins.
    RecordingError
        A trial has no poses, or fails a plausibility check.

    Warnings
    --------
    Values and errors are those of the bench only if ``is_found`` is True.  Otherwise the model
    lacks something, and the errors are too small.

    See Also
    --------
    capture_sim.read_run : Reads a trial.
    capture_sim.sweep : Runs a scene over values, e.g. those of a fit within their errors.

    Examples
    --------
    >>> import capture_sim
    >>> trial = capture_sim.simulate("tilt_0")  # in place of a recording
    >>> found = capture_sim.calibrate([trial], ["c_rr"], restarts=1)
    >>> found.is_found
    True
    >>> found
    Calibration(c_rr = 0.001; found)
    """
    if not trials:
        raise SceneError("trials: must be one run or more")
    coming = None if predict is None else as_scene(predict)
    trials, doubted = zip(*map(_trusted, trials), strict=True)
    scene = trials[0].scene
    for run in trials[1:]:
        _check_same_bench(trials[0], run)
    known = {
        name: read_weighed(scene, f"{name}={given}")[1] if isinstance(given, str) else given
        for name, given in (weighed or {}).items()
    }
    placed = read_placement(placement) if isinstance(placement, str) else placement
    prepared = [
        trial_of(
            run,
            touches=_touches_of(run, touches),
            has_impulse=touches > 0,
            until=until,
            is_release_fitted=run.scene.string is not None,
        )
        for run in trials
    ]
    # the launch is as recorded, but for what was weighed: that is held, with its error
    launch = {name: known[name] for name in LAUNCH if name in known}
    recorded = {name: get(prepared[0].scene, name) for name in launch}
    prepared = [_launched_with(trial, launch) for trial in prepared]
    parameters = parameters_of(scene, fit, {k: w for k, w in known.items() if k not in launch})
    check_profiled(profile, [parameter.name for parameter in parameters])
    fitted = {path for p in parameters for path in p.paths or (p.name,)}
    scenes = [trial.scene for trial in prepared]
    sensors = set[str]().union(*(trial.sensors for trial in prepared))
    uncertain = {**(uncertain or {}), **{name: w.error for name, w in launch.items()}}
    found = fit_trials(
        prepared,
        parameters,
        restarts=restarts,
        seed=seed,
        report=report,
        held=held_parameters(scenes, uncertainties(scenes[0], fitted, uncertain, sensors)),
        executor=executor,
    )
    if coming is not None:
        found = dataclasses.replace(found, prediction=predicted(found, coming, placed, seed=seed))
    if not any(finding.kind == "unfinished" for finding in found.findings):
        try:
            found = dataclasses.replace(found, profiles=_profiles(found, profile))
        except KeyboardInterrupt:
            found = dataclasses.replace(found, findings=(*found.findings, UNFINISHED))
    held = [dataclasses.replace(h, value=recorded.get(h.name, h.value)) for h in found.held]
    found = dataclasses.replace(found, held=tuple(held))
    return dataclasses.replace(found, weighed=known, notes=_notes(trials, prepared, doubted))


def _launched_with(trial: FittedTrial, launch: Mapping[str, Known]) -> FittedTrial:
    """Return a trial with weighed values of its launch.

    Raise SceneError if a value is not within 5 % of the recorded one.
    """
    for name, weighed in launch.items():
        recorded = get(trial.scene, name)
        if recorded is None or abs(weighed.value - recorded) > _OTHER_LAUNCH * recorded:
            raise SceneError(
                f"weighed {name} = {weighed.value:g}: {trial.name} was launched with "
                f"{recorded}: must be within {_OTHER_LAUNCH:.0%} of it"
            )
    values = {name: weighed.value for name, weighed in launch.items()}
    return dataclasses.replace(trial, scene=with_values(trial.scene, values)) if values else trial


def _trusted(run: Run) -> tuple[Run, str]:
    """Return a checked run without a force that is doubted, and by which rules, or ''."""
    series = checked(run).series
    names = dict.fromkeys(doubt.rule.name for doubt in run.doubts)
    rules = [name for name in names if name.startswith("force_") and name != "force_frame_empty"]
    if rules:
        series = {name: sources for name, sources in series.items() if name not in FORCES}
    return run.replaced(series=series), ", ".join(rules)


def _notes(
    runs: Sequence[Run], trials: Sequence[FittedTrial], doubted: Sequence[str]
) -> tuple[str, ...]:
    """Return lines on what trials lack, and on what of them is not used."""
    found: dict[str, list[str]] = {}
    for run, trial, rules in zip(runs, trials, doubted, strict=True):
        if rules:
            words = f"the contact force is not used, since it is doubted ({rules})"
            found.setdefault(words, []).append(Path(trial.name).name)
        if trial.frame.is_far:
            words = f"the frame of the poses is {trial.frame.text} against the scene's: taken out"
            found.setdefault(words, []).append(Path(trial.name).name)
        missing = {"stroke", "torsion"} - {channel.name for channel in trial.channels}
        if missing:
            words = f"no {' and no '.join(sorted(missing))}: the buffer is known by poses alone"
            found.setdefault(words, []).append(Path(trial.name).name)
        if any(run.series.get(quantity) for quantity in FORCES):
            words = "of the contact force, only times and strengths of the first touches are used"
            if trial.touches is None:
                words = "of the contact force, only the impulse of the contact is used"
            if not trial.force_rows:
                words = "the contact force is not used: it shows neither touches nor an impulse"
            found.setdefault(words, []).append(Path(trial.name).name)
    placed = [_placement(poses) for run in runs if (poses := first_poses(run)) is not None]
    if len(placed) > 1 and (np.ptp(placed, axis=0) < ALIKE).all():
        words = (
            "placed alike, so that they tell parameters apart no better than one: place the target "
            "at other angles"
        )
        found.setdefault(words, [Path(trial.name).name for trial in trials])
    return tuple(f"{', '.join(names)}: {words}" for words, names in found.items())


def _placement(poses: np.ndarray) -> tuple[float, float]:
    """Return how far the target is to the side of the chaser's axis, m, and its angle to it, rad.

    ``poses`` (2, 3) are those of chaser and target.
    """
    (x, y, theta), (to_x, to_y, angle) = poses
    beside = math.cos(theta) * (to_y - y) - math.sin(theta) * (to_x - x)
    return beside, math.remainder(angle - theta, 2.0 * math.pi)


def _touches_of(run: Run, count: int) -> Touches | None:
    """Return the first touches of a run for the fit, with their standard deviations.

    None if no measurement of the run resolves its touches, see :attr:`Run.resolved_touches`.
    """
    touches, _ = run.resolved_touches
    if touches is None or not count:
        return None
    return resolved(touches.of(slice(count)).with_default_noise(*TOUCH_NOISE), launched(run))


def predicted(
    found: Calibration, scene: Scene, placement: Placement | None = None, *, seed: int = 0
) -> Prediction:
    """Return the prediction of a calibrated bench for another scene."""
    assert found.problem is not None
    assert found.linear is not None
    assert found.whole is not None
    # the launch is that of the scene, with the error of a mass that is the same; it may lack a part
    launched_with = found.problem.trials[0].scene
    chosen = [
        k
        for k, parameter in enumerate(found.problem.parameters)
        if parameter.paths
        and all(
            get(scene, path) == get(launched_with, path)
            if path in LAUNCH
            else path in COMPUTED or get(scene, path) is not None
            for path in parameter.paths
        )
    ]
    return predict(
        scene,
        [found.problem.parameters[k] for k in chosen],
        found.linear.place[chosen],
        found.whole[np.ix_(chosen, chosen)],
        placement,
        seed=seed,
    )


def _profiles(found: Calibration, names: Sequence[str]) -> tuple[Profile, ...]:
    assert found.problem is not None
    assert found.linear is not None
    return tuple(
        profile_of(found.problem, found.linear, j, float(found.values[j]), float(found.errors[j]))
        for j in map(found.names.index, names)
    )


def _check_same_bench(first: Run, other: Run) -> None:
    """Raise SceneError if two runs are trials of different benches."""
    ours, theirs = first.scene, other.scene
    names = dict.fromkeys((*field_names(ours), *field_names(theirs)))
    for name in names:
        part = name.partition(".")[0]
        if part in (*NO_PHYSICS, "initial", "name", "title"):
            continue
        if name in ("string.impact_speed", "string.hanging_mass", "string.drop_height"):
            continue
        if get(ours, name) != get(theirs, name):
            raise SceneError(
                f"{_where(other)}: {name} = {get(theirs, name)}, in {_where(first)} "
                f"{get(ours, name)}: must be trials of one bench"
            )


def _where(run: Run) -> str:
    return run.origin.path or run.name
