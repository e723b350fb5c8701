"""Joint fit of the parameters of one bench to its trials, tests of the fit, and predictions."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from capture_sim.base.notebook import drawn, html_table
from capture_sim.dynamics.bench import Bench
from capture_sim.dynamics.compilation import compile_kernels
from capture_sim.errors import SceneError, SimulationError
from capture_sim.run.run import Run, checked
from capture_sim.run.touches import Touches
from capture_sim.scene.loading import as_scene
from capture_sim.scene.parts import Scene
from capture_sim.scene.paths import LAUNCH, NO_PHYSICS, expanded, field_names, get, with_values
from capture_sim.studies.calibration.candidates import NAMED, Score, differing, needed, scores
from capture_sim.studies.calibration.checks import (
    ALARM_BLOCKS,
    ALARM_TRIALS,
    AS_LOW,
    LEFT,
    Agreeing,
    BlockMean,
    Finding,
    at_bounds,
    block_means,
    clustered,
    convergence,
    direction_words,
    left_out,
    trials_agree,
    undetermined,
)
from capture_sim.studies.calibration.descent import (
    HOPELESS,
    RESTARTS,
    EndedSearch,
    Found,
    HopelessError,
    apart,
    descend,
    grow,
    renoised,
    restart,
    sigma_of,
    step_covariance,
)
from capture_sim.studies.calibration.frame import first_poses
from capture_sim.studies.calibration.held import Held, held_of, held_parameters, uncertainties
from capture_sim.studies.calibration.joint import Linear, Problem, inverse
from capture_sim.studies.calibration.parameters import (
    COMPUTED,
    SENSOR_ERRORS,
    Parameter,
    Weighed,
    begins,
    begun_at,
    parameters_of,
    read_weighed,
)
from capture_sim.studies.calibration.prediction import (
    Placement,
    Prediction,
    predict,
    read_placement,
)
from capture_sim.studies.calibration.profiles import Profile, check_profiled, profile_of
from capture_sim.studies.calibration.trial import (
    OWN_SIZE,
    FittedTrial,
    launched,
    resolved,
    trial_of,
)
from capture_sim.studies.executors import InProcess

#: Names of a trial's start poses.
STARTS = tuple(f"initial.{v}.{name}" for v in ("chaser", "target") for name in ("x", "y", "theta"))
#: Number of first touches that are fitted; default standard deviations of their times, s, and
#: peak forces, N, if the recording gives none.
TOUCHES, TOUCH_NOISE = 4, (2e-4, 2.0)
#: Trials whose targets are placed within this, m to the side and rad, are placed alike.
ALIKE = (2e-3, 0.01)
#: Two parameters are hard to separate if their errors are correlated more than this.
INSEPARABLE = 0.95
#: Largest number of lacking parameters, which are added one at a time, and largest number of
#: candidates that are tried for each.
_MAX_ADDED, _MAX_TRIED = 3, 2
#: A further candidate is tried only if its gain exceeds this share of the best gain.
_ALIKE = 0.3
#: A candidate whose gain is this share of the best gain is not told from the best.
_RIVAL = 0.7
#: Largest number of search steps after a candidate is added.
_ADDED_STEPS = 6
#: Largest number of search steps after the held values have joined.
_HELD_STEPS = 12
#: Predicted decrease of chi2 below which a search with the held values ends: its 50 and more
#: numbers each gain a little in the roughness of chi2, of about one unit.
_HELD_ENOUGH = 1.0
#: Number of times that the search is begun again with the axes of its own last model.
_HELD_TRIES = 4
#: A held value that is fitted from the start must lower chi2 to this share, or end a bad fit.
_PROGRESS = 0.5
#: Number of held values that are fitted from the start if the others do not join otherwise.
_HELD_GROWN = 2
#: Number of simulations of each trial after which no further way is tried.
_MOST_SIMULATIONS = 20_000
#: A weighed value of the launch is refused if it differs more from the recorded one, as a share.
_OTHER_LAUNCH = 0.05
#: Step of the first derivatives by a held value, as a share of its uncertainty.
_HELD_SHARE = 0.05
#: A fit is bad if chi2 per measured value is above this.
_BAD = 1.5
#: A fit that fails only tests of these kinds is usable, with larger errors, if chi2 per degree of
#: freedom is at most this.  tests/studies/test_calibration.py tries it with small faults of sensors
#: and buffers (test_values_of_a_usable_fit_are_within_its_errors).
_USABLE, _USABLE_CHI2 = frozenset({"residuals", "lacks"}), 1.1
#: A bad fit is repeated once from another start.  Standard deviation of the new start from the
#: first one, in coordinates.
_ELSEWHERE = 0.15


#: What is said of a fit that Ctrl-C has ended.
_UNFINISHED = Finding(
    "unfinished",
    "unfinished: interrupted before the search and its tests had ended",
    "start it again",
)


class Start(NamedTuple):
    """Start poses and release of a trial, with standard errors; SI."""

    trial: str
    values: np.ndarray  # (6,), of STARTS
    errors: np.ndarray
    release: float  # s after the assumed release
    release_error: float
    is_release_fitted: bool
    slopes: np.ndarray  # (7, d), derivatives of values and release by the search vector
    end: float  # s, end of the measurements used
    cut: float  # s, hold that ended the trial; infinite if there is none
    noise: Mapping[str, np.ndarray]  # standard deviations by series


class Lacking(NamedTuple):
    """A parameter that the model lacks.

    Its estimate is from a fit with all other parameters, or from the score test if it cannot be
    fitted.
    """

    score: Score
    estimate: float  # SI
    error: float
    gain: float  # decrease of chi2
    rivals: tuple[str, ...] = ()  # other candidates with about this gain, the largest first


@dataclass(frozen=True, repr=False)
class Calibration:
    """Parameters of a bench, their errors, and the tests of both; SI units."""

    names: tuple[str, ...]  # names of the shared parameters
    values: np.ndarray  # (k,)
    # (k,), standard errors by noise and by the held values; infinite if not determined
    errors: np.ndarray
    units: tuple[str, ...]
    begun: np.ndarray  # (k,), values at which the search began
    covariance: np.ndarray  # (k, k)
    starts: tuple[Start, ...]  # of each trial
    chi2: float  # of all residuals and weighed values
    freedom: int  # residuals less parameters
    # predicted distance to the minimum, standard errors; of the fitted values if others are held
    left: float
    # of each search but the best: chi2 above the best, and distance from it in standard errors
    restarts: tuple[tuple[float, float], ...]
    agreement: Agreeing  # of all trials
    agreements: tuple[Agreeing, ...]  # of each trial with all other trials
    blocks: tuple[BlockMean, ...]  # means of residuals
    scores: tuple[Score, ...]  # candidates for parameters that the model lacks
    lacking: tuple[Lacking, ...]
    findings: tuple[Finding, ...]  # reasons to reject the fit; empty if there is none
    simulations: int
    scene: Scene = field(repr=False)  # of the first trial, with the fitted values
    weighed: Mapping[str, Weighed] = field(default_factory=dict)
    held: tuple[Held, ...] = ()  # values that were not asked for, with their uncertainties
    noise_errors: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (k,), with these exact
    notes: tuple[str, ...] = ()  # what of the trials was missing or not used
    profiles: tuple[Profile, ...] = ()
    prediction: Prediction | None = field(default=None, repr=False)
    problem: Problem | None = field(default=None, repr=False)
    linear: Linear | None = field(default=None, repr=False)
    #: Covariance (d, d) of the place of ``linear``, with those of the trials' own numbers.
    whole: np.ndarray | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        """Return the values and whether the fit was found valid, in one line."""
        values = (f"{n} = {v:.6g}" for n, v in zip(self.names, self.values, strict=True))
        return f"Calibration({', '.join(values)}; {self.verdict})"

    def plot(self) -> Any:
        """Return a matplotlib figure; see :func:`capture_sim.plot`.

        Raises
        ------
        MissingPackageError
            matplotlib is not installed.
        """
        return drawn(self)

    def _repr_html_(self) -> str:
        """Return the values with their standard errors for a notebook, and the findings."""
        columns = zip(self.names, self.values, self.errors, self.units, strict=True)
        rows = ((n, f"{v:.6g}", f"+- {e:.2g}", "" if u == "1" else u) for n, v, e, u in columns)
        lines = [f"{self.verdict}: {finding.line}" for finding in self.findings]
        return html_table(f"calibration: {self.verdict}", rows, lines)

    @property
    def is_found(self) -> bool:
        """True if every test of the fit was passed."""
        return not self.findings

    @property
    def is_usable(self) -> bool:
        """True if the fit is found, or if its residuals are noise but for a small part.

        In the second case the errors contain what the residuals of each measured quantity in each
        phase of a trial pull the values by, see :func:`checks.clustered`.
        """
        return self.is_found or _only_widens(self.findings, self.reduced_chi2)

    @property
    def verdict(self) -> str:
        """``found``, ``usable`` or ``not found``."""
        return "found" if self.is_found else "usable" if self.is_usable else "not found"

    @property
    def reduced_chi2(self) -> float:
        """chi2 per degree of freedom."""
        return self.chi2 / self.freedom

    @property
    def correlation(self) -> np.ndarray:
        """Correlations (k, k) of the errors."""
        scale = np.sqrt(np.maximum(np.diag(self.covariance), 1e-300))
        return np.asarray(self.covariance / np.outer(scale, scale))

    @property
    def left_out(self) -> np.ndarray:
        """Change (n, k) of the values, SI, if each of n trials were left out; of a linear model."""
        assert self.problem is not None
        assert self.linear is not None
        k = len(self.names)
        parameters = zip(self.problem.parameters[:k], self.linear.place[:k], strict=True)
        slopes = [parameter.slope(float(x)) for parameter, x in parameters]
        return left_out(self.linear, self.problem)[:, :k] * slopes

    def fields_of(self, scene: Scene) -> dict[str, float]:
        """Return the values that the fit found for fields of a scene by path, SI.

        Held values are among them, because the fitted ones belong to them; hanging mass and drop
        height only where the scene gives them as numbers.
        """
        assert self.problem is not None
        assert self.linear is not None
        return {
            path: parameter.value(float(x))
            for parameter, x in zip(
                self.problem.parameters, self.linear.place[: self.problem.shared], strict=True
            )
            for path in parameter.paths
            if path not in LAUNCH or get(scene, path) is not None
        }


def calibrate(
    trials: Sequence[Run],
    fit: Sequence[str] | None = None,
    *,
    weighed: Mapping[str, str | Weighed] | None = None,
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
        defaults of :mod:`capture_sim.studies.calibration.held`, e.g.
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
        :mod:`capture_sim.studies.calibration.profiles`.
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
    trials = [run.replaced(series=checked(run).series) for run in trials]
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
            found = dataclasses.replace(found, findings=(*found.findings, _UNFINISHED))
    held = [dataclasses.replace(h, value=recorded.get(h.name, h.value)) for h in found.held]
    found = dataclasses.replace(found, held=tuple(held))
    return dataclasses.replace(found, weighed=known, notes=_notes(trials, prepared))


def _launched_with(trial: FittedTrial, launch: Mapping[str, Weighed]) -> FittedTrial:
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


def _notes(runs: Sequence[Run], trials: Sequence[FittedTrial]) -> tuple[str, ...]:
    """Return lines on what trials lack, and on what of them is not used."""
    found: dict[str, list[str]] = {}
    for run, trial in zip(runs, trials, strict=True):
        if trial.frame.is_far:
            words = f"the frame of the poses is {trial.frame.text} against the scene's: taken out"
            found.setdefault(words, []).append(Path(trial.name).name)
        missing = {"stroke", "torsion"} - {channel.name for channel in trial.channels}
        if missing:
            words = f"no {' and no '.join(sorted(missing))}: the buffer is known by poses alone"
            found.setdefault(words, []).append(Path(trial.name).name)
        if any(run.series.get(quantity) for quantity in ("tip_force", "cone_force")):
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


class _Progress:
    """Counts simulations and reports their number."""

    def __init__(self, most: int, report: Callable[[int, int], None] | None) -> None:
        self.done, self.most, self._report = 0, most, report

    def __call__(self) -> None:
        self.done += 1
        if self._report is not None:
            self._report(self.done, self.most)


def fit_trials(
    trials: Sequence[FittedTrial],
    parameters: Sequence[Parameter],
    *,
    restarts: int = RESTARTS,
    seed: int = 0,
    report: Callable[[int, int], None] | None = None,
    has_scores: bool = True,
    held: Sequence[Parameter] = (),
    executor: Executor | None = None,
) -> Calibration:
    """Fit parameters to trials and test the fit; see :func:`calibrate`.

    ``has_scores``: True to search also for parameters that the model lacks.
    ``held``: weighed parameters that are not asked for.  Errors of sensors are fitted from the
    start, since their derivatives need no simulation; values of the scene join the fit at its end.
    ``executor`` as in :func:`calibrate`.
    """
    compile_kernels()
    sensors = [parameter for parameter in held if not parameter.paths]
    joining = [parameter for parameter in held if parameter.paths]
    counted = _Progress(_MOST_SIMULATIONS * len(trials), report)
    fitted, parameters = len(parameters), [*parameters, *sensors]
    problem = Problem(trials, parameters, tick=counted, executor=executor or InProcess())
    unknown = problem.dimension - len(sensors)
    if problem.rows < unknown:
        raise SceneError(
            f"{problem.rows} measured values for {unknown} parameters (with seven of "
            "each trial): must be more values than parameters"
        )
    begin = begins(parameters)
    _check_start(problem, begin)
    fitting = _Fitting(problem, fitted)
    try:
        fitting.run(begin, seed)
        if not fitting.joins(joining):
            is_another = restarts > 0 and fitting.begins_elsewhere(begin, seed)
            if not (is_another and fitting.joins(joining)):
                fitting.join_one_by_one(joining)
        fitting.confirm(restarts, seed)
        found = _tested(fitting, has_scores=has_scores)
    except HopelessError as no_way:
        found = _hopeless(no_way, fitted)
    except KeyboardInterrupt:
        if fitting.latest is None:
            raise
        found = fitting.unfinished()
    return dataclasses.replace(found, simulations=counted.done)


def _hopeless(no_way: HopelessError, fitted: int) -> Calibration:
    """Return the result of a search that has ended early."""
    part, at, after = no_way.part, no_way.at, no_way.after
    when = f"{1e3 * after:.3g} ms after" if after > 0.0 else "before"
    finding = Finding(
        "convergence",
        f"not converged: the search has ended {when} the first contact, where chi2 is "
        f"{at.chi2 / part.rows:.4g} per measured value: the scene's bench does not move so",
        "look for wrong units, axes or values of the scene, or for another scene",
    )
    blocks = block_means(at, part)
    worst = _block_finding(blocks, part)
    findings = [finding, *([worst] if worst is not None else [])]
    return _result(part, Found(EndedSearch(at, 0)), findings, blocks=blocks, fitted=fitted)


def _check_start(problem: Problem, begin: np.ndarray) -> None:
    """Raise SceneError if a trial cannot be simulated where the search begins."""
    place = np.zeros(problem.dimension)
    place[: problem.shared] = begin
    fields, _ = problem.values(place)
    for trial in problem.trials:
        try:
            bench = Bench(with_values(trial.scene, fields))
            bench.advance(np.array([min(max(trial.end, 0.01), trial.scene.run.t_end)]))
        except (SceneError, SimulationError) as error:
            raise SceneError(f"{trial.name}: cannot be simulated at the start: {error}") from None


class _Fitting:
    """A fit in progress; its latest state is available at any time."""

    def __init__(self, problem: Problem, fitted: int) -> None:
        self.problem = problem
        self.latest: tuple[Problem, Linear] | None = None
        self.found: Found | None = None
        self.joined: EndedSearch | None = None  # the search with the held values, if they joined
        self.is_cut_off = False  # True if they should have joined, but no search had them
        self.whole = problem  # counts the simulations of all others
        self.is_ended_early = False  # True if something was not tried for want of simulations
        self.fitted = fitted  # number of parameters, without held ones
        self.noise: np.ndarray | None = None  # their covariance with held ones exact

    def may_go_on(self) -> bool:
        """Return False, and remember it, if as many simulations were made as a fit may have."""
        is_left = self.whole.simulations < _MOST_SIMULATIONS * len(self.whole.trials)
        self.is_ended_early = self.is_ended_early or not is_left
        return is_left

    def run(self, begin: np.ndarray, seed: int) -> None:
        """Fit over a growing horizon, then with the noise of the residuals."""
        rng = np.random.default_rng(seed)
        search = self._grown(self.problem, begin, rng)
        search = self._renoised(search)
        self.found = Found(search)
        self._keep(self.found.best.linear)

    def begins_elsewhere(self, begin: np.ndarray, seed: int) -> bool:
        """Repeat a bad fit from another start: chatter may have trapped it in a false minimum.

        Return True if that fit is better.
        """
        assert self.found is not None
        before, first = self.problem, self.found.best
        if first.linear.chi2 <= _BAD * before.rows or not self.may_go_on():
            return False
        rng = np.random.default_rng([seed, 2])
        low, high = (limits[: begin.size] for limits in before.limits)
        there = np.clip(begin + _ELSEWHERE * rng.standard_normal(begin.size), low, high)
        search = self._grown(before, there, rng)
        if search.linear.chi2 >= first.linear.chi2:
            self.problem = before
            return False
        self.found = Found(self._renoised(search))
        self._keep(self.found.best.linear)
        return True

    def confirm(self, restarts: int, seed: int) -> None:
        """Restart a fit that may count."""
        assert self.found is not None
        best = self.joined or self.found.best
        if not _may_count(self.problem, best.linear):
            return
        rng = np.random.default_rng([seed, 1])
        enough = {"enough": _HELD_ENOUGH} if self.joined else {}
        self.found = restart(self.problem, best, rng, restarts, **enough)
        if self.joined:
            self.joined = self.found.best
        self._keep(self.found.best.linear)

    def join_one_by_one(self, held: Sequence[Parameter]) -> None:
        """Fit the held value that explains most of the residuals from the start; others join then.

        A fit that began with wrong values of them may have ended where they do not help.
        """
        assert self.found is not None
        for _ in range(_HELD_GROWN):
            at = self.found.best.linear
            if at.chi2 > HOPELESS * self.problem.rows or not self.may_go_on():
                return
            ranked = [(needed(at, self.problem, each), each) for each in held]
            best, needy = max(
                ((score, each) for score, each in ranked if score is not None),
                key=lambda pair: pair[0].gain,
                default=(None, None),
            )
            if best is None or needy is None or best.gain < NAMED:
                return
            tried = _with(self.problem, at, best, needy, grown=True)
            if tried is None:
                return
            if tried[2].chi2 >= max(_PROGRESS * at.chi2, min(at.chi2, _BAD * self.problem.rows)):
                return
            _, self.problem, at = tried
            self.found = Found(EndedSearch(at, 0))
            self._keep(at)
            held = [each for each in held if each is not needy]
            if self.joins(held):
                return

    def joins(self, held: Sequence[Parameter]) -> bool:
        """Let held values join the fit as weighed parameters, and go on for a few steps.

        Return False if no search from here explains the trials.
        """
        assert self.found is not None
        if not held:
            return True
        if self.found.best.linear.chi2 > HOPELESS * self.problem.rows:
            return False
        self.is_cut_off = False
        narrow, at = self.problem, self.found.best.linear
        k, n = narrow.shared, len(held)
        covariance = step_covariance(at, narrow)
        wide = narrow.replaced(narrow.trials, [*narrow.parameters, *held])
        prior = wide.weighed()
        place = np.insert(at.place, k, prior.centre[k : k + n])
        wider = np.zeros((wide.dimension, wide.dimension))
        kept = [*range(k), *range(k + n, wide.dimension)]
        wider[np.ix_(kept, kept)] = covariance
        # the trials know most of them better than that: with longer steps, touches would be others
        wider[range(k, k + n), range(k, k + n)] = (_HELD_SHARE * prior.error[k : k + n]) ** 2
        least = math.inf
        for _ in range(_HELD_TRIES):
            search = descend(wide, place, prior, wider, most=_HELD_STEPS, enough=_HELD_ENOUGH)
            if search is None or search.linear.decrease < LEFT:
                break
            if search.linear.chi2 > least - _HELD_ENOUGH:
                break  # the other axes were no better
            least = search.linear.chi2
            if search.linear.chi2 > _BAD * wide.rows:
                return False  # they are not why, either
            # the axes of the derivatives were wrong: those of this model are better
            place, wider = search.linear.place, step_covariance(search.linear, wide)
        if search is None:
            self.is_cut_off = True
            return False
        if not (_is_noise(narrow, at) or _may_count(wide, search.linear)):
            return False  # they would hide a part of what the model lacks
        self.problem, self.joined = wide, search
        self.noise = _given_the_rest(covariance[:k, :k], self.fitted)
        self._keep(search.linear)
        return True

    def _grown(self, problem: Problem, begin: np.ndarray, rng: np.random.Generator) -> EndedSearch:
        place, covariance = grow(problem, begin, rng, self._keep_early)
        return self._search(problem, place, covariance)

    def _renoised(self, search: EndedSearch) -> EndedSearch:
        """Repeat the search with the noise estimated from the residuals."""
        problem = renoised(self.problem, sigma_of(self.problem, search.linear))
        at = search.linear
        return self._search(problem, at.place, step_covariance(at, problem))

    def _search(
        self, problem: Problem, place: np.ndarray, covariance: np.ndarray | None
    ) -> EndedSearch:
        self.problem = problem
        search = descend(problem, place, problem.weighed(), covariance, keep=self._keep)
        if search is None:
            raise SceneError(
                "the search left the range in which the bench works: begin nearer to the bench"
            )
        return search

    def _keep_early(self, part: Problem, at: Linear) -> None:
        self.latest = part, at

    def _keep(self, at: Linear) -> None:
        self.latest = self.problem, at

    def unfinished(self) -> Calibration:
        """Return the latest state as a calibration with the finding ``unfinished``."""
        assert self.latest is not None
        problem, at = self.latest
        self.noise = None
        fitted = min(self.fitted, problem.shared)
        return _result(problem, Found(EndedSearch(at, 0)), [_UNFINISHED], fitted=fitted)


def _tested(fitting: _Fitting, *, has_scores: bool) -> Calibration:
    """Test a fit and return it as a calibration."""
    assert fitting.found is not None
    problem, found = fitting.problem, fitting.found
    findings: list[Finding] = []
    left = None
    if fitting.joined is not None:
        # what a restart is off by counts in errors that have the held values
        fitted = fitting.fitted
        wide = step_covariance(fitting.joined.linear, problem)[:fitted, :fitted]
        ends = [apart(found.best, end, wide) for end in found.others]
        found = dataclasses.replace(found, best=fitting.joined, restarts=ends)
        left = _left_of_fitted(fitting.joined.linear, problem, fitting.fitted)
    reason, _ = convergence(found, left)
    if fitting.is_cut_off:
        reason = "with the held values, the search left the range in which the bench works"
    at = found.best.linear
    if reason:
        findings.append(
            Finding(
                "convergence",
                f"not converged: {reason}",
                "fit fewer parameters, weigh one, or start nearer to the bench",
            )
        )
    whole, each = trials_agree(at, problem)
    if whole.p < ALARM_TRIALS:
        worst = int(np.argmax([one.statistic for one in each]))
        findings.append(
            Finding(
                "trials",
                f"the trials do not agree (chi2 {whole.statistic:.4g} for {whole.freedom}): "
                f"{problem.trials[worst].name} is furthest from the others "
                f"({each[worst].statistic:.4g} for {each[worst].freedom}), "
                f"{_differs_in(at, problem, worst, fitting.fitted)}",
                "leave it out, or look for what changed on the bench",
            )
        )
    blocks = block_means(at, problem)
    if (finding := _block_finding(blocks, problem)) is not None:
        findings.append(finding)
    candidates = scores(at, problem) if has_scores else []
    lacking: list[Lacking] = []
    is_enough = True
    if candidates and candidates[0].gain > NAMED:
        lacking, is_enough = _what_lacks(problem, at, candidates, fitting.may_go_on)
    if fitting.is_ended_early:
        text = f"the search ended after {fitting.whole.simulations} simulations, with ways untried"
        findings.append(Finding("budget", text, "start nearer to the bench, or fit fewer trials"))
    for one in lacking:
        if not is_enough:
            advice = (
                "with all that is named the residuals are still not noise, so the cause may be "
                "another, which has no candidate, e.g. a hysteresis"
            )
        elif one.rivals:
            advice = "measure them apart: the cause may also have no candidate"
        elif one.score.can_be_fitted:
            names = " ".join(_fit_with(one.score.name, problem.parameters[: fitting.fitted]))
            advice = f"if the bench can have it, fit it too: --fit {names}"
        else:
            advice = "add it to the scene, if the bench can have it"
        if one.score.name in SENSOR_ERRORS and one.score.name.startswith("delay"):
            advice += ", or set the clock right"
        findings.append(Finding("lacks", lacking_text(one), advice))
    for parameter in at_bounds(at.place, problem):
        value = parameter.value(float(at.place[list(problem.parameters).index(parameter)]))
        findings.append(
            Finding(
                "bound",
                f"{parameter.name} = {value:.6g} {parameter.unit}".rstrip()
                + " is at the end of its range",
                "the model lacks something, or the scene's other values are wrong",
            )
        )
    for direction, _ in undetermined(at, fitting.fitted):
        findings.append(Finding("undetermined", *direction_words(problem.parameters, direction)))
    tests = whole, each, blocks, candidates, lacking
    return _result(problem, found, findings, *tests, fitted=fitting.fitted, noise=fitting.noise)


def _differs_in(at: Linear, problem: Problem, number: int, fitted: int) -> str:
    """Return in words which parameter a trial may have another value of."""
    ranked = differing(at, problem, number, fitted)
    (best, change), *others = ranked
    rivals = [score.name for score, _ in others if score.gain > _RIVAL * best.gain]
    if rivals:
        return f"as if by another value of one of {', '.join((best.name, *rivals))}"
    size = f" ({change:+.2%})" if math.isfinite(change) else ""
    return f"as if by another {best.name} there{size}"


def _fit_with(name: str, parameters: Sequence[Parameter]) -> list[str]:
    """Return names of a fit with one more; a short name that has its path gives way to paths."""
    paths = expanded(name)
    found: list[str] = []
    for parameter in parameters:
        if set(parameter.paths) & set(paths):
            found += parameter.paths
        else:
            found.append(parameter.name)
    return found if name in found else [*found, name]


def _left_of_fitted(at: Linear, problem: Problem, fitted: int) -> float:
    """Return the distance of the fitted parameters from the aim of a search, in standard errors.

    The other parameters of the search are held values; where they go does not matter by itself.
    """
    covariance = step_covariance(at, problem)[:fitted, :fitted]
    move = _aim(at)[:fitted]
    return math.sqrt(max(float(move @ np.linalg.pinv(covariance) @ move), 0.0))


def _aim(at: Linear) -> np.ndarray:
    """Return the move (d,) to the minimum of a linear model, of the numbers that are free."""
    move, free = np.zeros(at.place.size), at.free
    move[free] = -inverse(at.hessian[np.ix_(free, free)]) @ at.gradient[free]
    return move


def lacking_text(one: Lacking) -> str:
    """Return a sentence on a parameter that the model lacks."""
    value = (
        f"{one.estimate:.4g} +- {one.error:.2g}"
        if math.isfinite(one.error)
        else (f"about {one.estimate:.3g}")
    )
    unit = "" if one.score.unit == "1" else f" {one.score.unit}"
    if one.rivals:
        names = ", ".join((one.score.name, *one.rivals))
        return (
            f"the model lacks one of {names}, which these trials do not tell apart: chi2 falls by "
            f"{one.gain:.4g} with {one.score.name} = {value}{unit}"
        )
    return (
        f"the model lacks {one.score.name} = {value}{unit} ({one.score.words}): "
        f"chi2 falls by {one.gain:.4g} with it"
    )


def _is_noise(problem: Problem, at: Linear) -> bool:
    """Return True if noise explains the means of the residuals."""
    return _block_finding(block_means(at, problem), problem) is None


def _may_count(problem: Problem, at: Linear) -> bool:
    """Return True if a fit may be found or usable, as far as its residuals go."""
    return at.chi2 <= _USABLE_CHI2 * problem.rows or _is_noise(problem, at)


def _block_finding(blocks: Sequence[BlockMean], problem: Problem) -> Finding | None:
    """Return the finding on the block means of residuals; None if noise explains them."""
    if not blocks:
        return None
    worst = min(blocks, key=lambda block: (block.p, -block.statistic / block.means))
    if worst.p * len(blocks) >= ALARM_BLOCKS:
        return None
    parts = {3: ("x", "y", "theta"), 1: ("",)}
    trial = problem.trials[worst.trial]
    width = next(c.values.shape[1] for c in trial.channels if c.name == worst.channel)
    name = f"{worst.channel} {parts[width][worst.part]}".strip()
    return Finding(
        "residuals",
        f"the residuals are not noise: means over 30 ms of {name} in phase {worst.phase} of "
        f"{trial.name} have chi2 {worst.statistic:.4g} for {worst.means}",
        "see what the model lacks, leave the trial out, or start nearer to the bench",
    )


def _likely(candidates: Sequence[Score]) -> list[Score]:
    """Return the candidates with gains above NAMED."""
    return [score for score in candidates if score.gain > NAMED]


def _what_lacks(
    problem: Problem,
    at: Linear,
    candidates: Sequence[Score],
    may_go_on: Callable[[], bool],
) -> tuple[list[Lacking], bool]:
    """Add the parameters that the model lacks, one at a time, and return them.

    The first is added in any case, others while ``may_go_on``.  Also return whether they are
    enough: with them the residuals are noise, and the trials agree.
    """
    found: list[Lacking] = []
    most = 1 if at.chi2 > HOPELESS * problem.rows else _MAX_ADDED
    for _ in range(most):
        likely = _likely(candidates)
        likely = [s for s in likely if s.gain > _ALIKE * likely[0].gain][:_MAX_TRIED]
        if not likely or (found and not may_go_on()):
            break
        best: tuple[Lacking, Problem, Linear] | None = None
        for score in likely:
            tried = _with(problem, at, score)
            if tried is not None and (best is None or tried[0].gain > best[0].gain):
                best = tried
        if best is None:
            one = likely[0]
            found.append(Lacking(one, one.estimate, one.error, one.gain))
            break
        if _BAD * problem.rows < at.chi2 < HOPELESS * problem.rows and may_go_on():
            best = _with(problem, at, best[0].score, grown=True) or best
        rivals = tuple(
            each.name
            for each in _likely(candidates)
            if each.name != best[0].score.name and each.gain > _RIVAL * best[0].score.gain
        )
        found.append(best[0]._replace(rivals=rivals))
        problem, at = best[1:]
        candidates = scores(at, problem)
    if any(not one.score.can_be_fitted for one in found):
        return found, True  # not tried
    return found, _is_noise(problem, at) and trials_agree(at, problem)[0].p >= ALARM_TRIALS


def _with(
    problem: Problem,
    at: Linear,
    score: Score,
    added: Parameter | None = None,
    *,
    grown: bool = False,
) -> tuple[Lacking, Problem, Linear] | None:
    """Return a fit with one more parameter, started at its estimate; None if it is impossible.

    ``added``: the parameter; None for the one of the score's name.
    """
    if not score.can_be_fitted:
        return None
    if added is None:
        (added,) = parameters_of(problem.trials[0].scene, [score.name])
    low, high = added.limits
    start = (
        added.coordinate(score.estimate)
        if not added.is_log
        else (
            added.coordinate(added.begin)
            + float(np.clip(score.estimate / added.begin - 1.0, -0.7, 0.7))
        )
    )
    if not math.isfinite(start):
        return None
    start = float(np.clip(start, low, high))
    # an existing parameter that sets the added field too, e.g. c_rr of both vehicles, stays
    wider = problem.replaced(problem.trials, [*problem.parameters, begun_at(added, score.estimate)])
    place = np.insert(at.place, problem.shared, start)
    prior = wider.weighed()
    d = wider.dimension
    covariance = np.zeros((d, d))
    kept = [i for i in range(d) if i != problem.shared]
    covariance[np.ix_(kept, kept)] = step_covariance(at, problem)
    size = added.slope(start)
    covariance[problem.shared, problem.shared] = min((score.error / size) ** 2, 1e-2)
    search = descend(wider, place, prior, covariance, most=_ADDED_STEPS)
    if grown and at.chi2 > _BAD * problem.rows:
        # a wrong model has biased the other parameters: restart all of them
        begin = begins(wider.parameters)
        begin[-1] = start
        there, spread_there = grow(wider, begin, np.random.default_rng(0))
        again = descend(wider, there, prior, spread_there, most=_ADDED_STEPS)
        if search is None or (again is not None and again.linear.chi2 < search.linear.chi2):
            search = again
    if search is None:
        return None
    end = search.linear
    value = added.value(float(end.place[problem.shared]))
    spread = math.sqrt(max(end.covariance[problem.shared, problem.shared], 0.0))
    error = spread * added.slope(float(end.place[problem.shared]))
    return Lacking(score, value, error, at.chi2 - end.chi2), wider, end


def _only_widens(findings: Sequence[Finding], reduced_chi2: float) -> bool:
    """Return True if findings leave a fit usable, with larger errors."""
    kinds = {finding.kind for finding in findings}
    return bool(kinds) and kinds <= _USABLE and reduced_chi2 <= _USABLE_CHI2


def _freedom(problem: Problem) -> int:
    return max(problem.rows - problem.dimension + int(problem.fixed.sum()), 1)


def _given_the_rest(covariance: np.ndarray, count: int) -> np.ndarray:
    """Return the covariance (count, count) of the first numbers where all others are exact."""
    others = covariance[:count, count:]
    known = others @ np.linalg.pinv(covariance[count:, count:]) @ others.T
    return np.asarray(covariance[:count, :count] - known)


def _covariance(at: Linear, problem: Problem, findings: Sequence[Finding]) -> np.ndarray:
    """Return the covariance (d, d) of a fit, for its errors and its predictions."""
    covariance = step_covariance(at, problem)
    if _only_widens(findings, at.chi2 / _freedom(problem)):
        covariance = covariance + clustered(at, problem) - at.covariance
    return covariance


def _result(
    problem: Problem,
    found: Found,
    findings: Sequence[Finding],
    whole: Agreeing | None = None,
    each: Sequence[Agreeing] = (),
    blocks: Sequence[BlockMean] = (),
    candidates: Sequence[Score] = (),
    lacking: Sequence[Lacking] = (),
    *,
    fitted: int | None = None,
    noise: np.ndarray | None = None,
) -> Calibration:
    """Return a fit as a Calibration, in SI units.

    ``fitted``: number of parameters without the held ones; None if there are none.  ``noise``:
    their covariance with the held ones exact.
    """
    at, shared_count = found.best.linear, problem.shared
    k = shared_count if fitted is None else fitted
    parameters = problem.parameters[:k]
    covariance = _covariance(at, problem, findings)
    slopes = np.array([p.slope(float(x)) for p, x in zip(parameters, at.place[:k], strict=True)])
    values = np.array([p.value(float(x)) for p, x in zip(parameters, at.place[:k], strict=True)])
    known = covariance[:shared_count, :shared_count]
    if k < shared_count:
        # where chatter is rough, a search may end before its aim, and each elsewhere
        aim = _aim(at)
        covariance = covariance + np.outer(aim, aim)
        as_low = [end.linear.place for end in found.others if end.linear.chi2 < at.chi2 + AS_LOW]
        for place in as_low:
            covariance += np.outer(place - at.place, place - at.place) / len(as_low)
    shared = covariance[:k, :k] * np.outer(slopes, slopes)
    errors = np.sqrt(np.maximum(np.diag(shared), 0.0))
    for direction, error in undetermined(at, k):
        if not math.isfinite(error):
            errors[np.abs(direction) > 1e-3] = math.inf
    fields, _ = problem.values(at.place)
    first = problem.trials[0].scene
    return Calibration(
        names=tuple(p.name for p in parameters),
        values=values,
        errors=errors,
        units=tuple(p.unit for p in parameters),
        begun=np.array([p.begin for p in parameters]),
        covariance=shared,
        starts=tuple(_start_of(problem, at, n, covariance) for n in range(len(problem.trials))),
        chi2=at.chi2,
        freedom=_freedom(problem),
        left=found.best.left if noise is None else _left_of_fitted(at, problem, k),
        restarts=tuple(found.restarts),
        agreement=whole or Agreeing(0.0, 0, 1.0),
        agreements=tuple(each),
        blocks=tuple(blocks),
        scores=tuple(candidates),
        lacking=tuple(lacking),
        held=held_of(problem.parameters, at.place[:shared_count], known, k),
        noise_errors=errors
        if noise is None
        else np.sqrt(np.maximum(np.diag(noise), 0.0)) * np.abs(slopes),
        findings=tuple(findings),
        simulations=problem.simulations,
        scene=with_values(first, fields),
        problem=problem,
        linear=at,
        whole=covariance,
    )


def _start_of(problem: Problem, at: Linear, number: int, covariance: np.ndarray) -> Start:
    """Return the start poses and release of a trial, with standard errors."""
    trial, own = problem.trials[number], problem.own(number)

    def poses(coordinates: np.ndarray) -> np.ndarray:
        along, across, turned, x, y, theta, _ = coordinates * OWN_SIZE
        initial = trial.scene.initial
        c, s = math.cos(theta), math.sin(theta)
        away = np.array([initial.target.x + along, initial.target.y + across])
        away -= [initial.chaser.x, initial.chaser.y]
        chaser = np.array([initial.chaser.x + x, initial.chaser.y + y])
        target = chaser + np.array([[c, -s], [s, c]]) @ away
        angles = initial.chaser.theta + theta, initial.target.theta + turned + theta
        return np.array([*chaser, angles[0], *target, angles[1]])

    place = at.place[own]
    slopes = np.stack(
        [(poses(place + d) - poses(place - d)) / 2e-3 for d in 1e-3 * np.eye(len(place))], axis=1
    )
    full = np.zeros((len(STARTS) + 1, problem.dimension))
    full[:-1, own] = slopes
    full[-1, own.stop - 1] = OWN_SIZE[-1]
    errors = np.sqrt(np.maximum(np.diag(full @ covariance @ full.T), 0.0))
    return Start(
        trial=trial.name,
        values=poses(place),
        errors=errors[:-1],
        release=float(place[-1] * OWN_SIZE[-1]),
        release_error=float(errors[-1]),
        is_release_fitted=trial.is_release_fitted,
        slopes=full,
        end=trial.end,
        cut=trial.cut,
        noise={channel.name: channel.sigma for channel in trial.channels},
    )
