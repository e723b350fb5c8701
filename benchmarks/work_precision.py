"""Error against wall time and evaluations: our integrators and SciPy's, on one scene."""

from __future__ import annotations

import functools
import math
import statistics
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.engines import own as own_runs
from benchmarks.engines import scipy_ivp as scipy_runs
from benchmarks.engines.problems import (
    CompiledProblem,
    NumpyProblem,
    Problem,
    PythonProblem,
    packed,
)
from benchmarks.reference import load_reference
from benchmarks.trial import Outcome, Progress, Trial, run_rounds, spread
from capture_sim.bench import error_scale
from capture_sim.scene.parts import METHODS, Scene

#: Right-hand sides that are handed to SciPy, by group.
PROBLEMS: dict[str, Callable[[Scene], Problem]] = {
    "compiled": CompiledProblem,
    "numpy": NumpyProblem,
    "python": PythonProblem,
}
GROUP_NAMES = {"compiled": "compiled RHS", "numpy": "NumPy RHS", "python": "tuned Python RHS"}

#: Absolute tolerances that users give to SciPy with the relative one.
ATOL = {
    "plain": "atol = rtol / 1000 for every state",
    "scaled": "our own norm: atol = rtol times each state's scale, relative part off",
}
_LEAST_RTOL = 2.5e-14  # SciPy takes none below 100 times the rounding unit


@dataclass(frozen=True)
class Plan:
    """What is tried at one horizon."""

    t_end: float  # s
    rtols: tuple[float, ...]  # of our adaptive integrators
    scipy_rtols: tuple[float, ...]  # of SciPy's, with the compiled right-hand side,
    numpy_rtols: tuple[float, ...]  # with the other two,
    python_rtols: tuple[float, ...]
    stiff_rtols: tuple[float, ...]  # and, out of these, of its implicit methods
    steps: tuple[float, ...]  # s, of our fixed-step ones
    atols: tuple[str, ...]  # out of ATOL
    scipy_methods: tuple[str, ...]
    rounds: int  # of everything quick, and of the rivals that matter
    quick: float  # s; what takes less is repeated in any case
    allowed: float  # s, of any one run; twice that with the NumPy right-hand side
    #: Group of rivals, position error (m or rad), ratio that is wanted there.
    targets: tuple[tuple[str, float, float], ...]


_DECADES = tuple(10.0**-k for k in range(3, 11))
_STEPS = (1e-4, 5e-5, 2e-5, 1e-5, 5e-6, 2e-6)

FULL = (
    Plan(
        t_end=0.35,
        rtols=_DECADES,
        scipy_rtols=_DECADES,
        numpy_rtols=_DECADES[:7],
        python_rtols=_DECADES[:6],
        stiff_rtols=_DECADES,
        steps=_STEPS,
        atols=("plain", "scaled"),
        scipy_methods=scipy_runs.METHODS,
        rounds=9,
        quick=0.06,
        allowed=3.0,
        targets=(("compiled", 1e-6, 75.0), ("numpy", 1e-6, 1000.0), ("python", 1e-6, math.nan)),
    ),
    Plan(
        t_end=1.5,
        rtols=_DECADES,
        scipy_rtols=_DECADES,
        numpy_rtols=(1e-6, 1e-8),
        python_rtols=(),
        stiff_rtols=(1e-4, 1e-6, 1e-8),
        steps=_STEPS,
        atols=("plain", "scaled"),
        scipy_methods=scipy_runs.METHODS,
        rounds=9,
        quick=0.03,
        allowed=5.0,
        targets=(("compiled", 1e-8, 60.0),),
    ),
)
QUICK = (
    Plan(
        t_end=0.35,
        rtols=(1e-4, 1e-6, 1e-8),
        scipy_rtols=(1e-4, 1e-6),
        numpy_rtols=(1e-5,),
        python_rtols=(),
        stiff_rtols=(),
        steps=(2e-5,),
        atols=("scaled",),
        scipy_methods=("DOP853", "LSODA"),
        rounds=3,
        quick=0.05,
        allowed=5.0,
        targets=FULL[0].targets[:2],
    ),
)


@dataclass(frozen=True)
class Comparison:
    """The fastest of ours against the fastest of others at the same position error."""

    t_end: float  # s
    error: float  # m or rad
    group: str  # whose right-hand side SciPy had
    own: str
    rival: str
    own_seconds: float  # medians of the interpolated wall times
    rival_seconds: float
    ratio: float  # rival's time per ours: median over rounds; NaN where one never got as exact
    low: float  # ... and quartiles
    high: float
    target: float  # NaN where none is wanted

    @property
    def met(self) -> bool:
        """Whether the wanted ratio was reached."""
        return self.ratio >= self.target


@dataclass(frozen=True)
class WorkPrecision:
    """All trials at one horizon, and what they come to."""

    plan: Plan
    trials: list[Trial]
    comparisons: list[Comparison]


def measure(scene: Scene, plan: Plan, progress: Progress) -> WorkPrecision:
    """Run everything in a plan."""
    truth = load_reference(scene.name, scene).at(plan.t_end)
    scene = own_runs.with_run(scene, t_end=plan.t_end)
    stage = f"work and precision to {plan.t_end:g} s"
    own = list(own_trials(scene, plan))
    rivals = list(scipy_trials(scene, plan))
    for trial in own:  # once to warm up: branch predictors, caches, clock
        trial.prepare()()()
    _try_once(own + rivals, truth, progress, stage)
    again = [trial for trial in own if trial.seconds]
    again += _worth_repeating(rivals, plan)
    run_rounds(again, truth, plan.rounds - 1, progress, stage + ", again")
    comparisons = [
        compare(own, [r for r in rivals if r.group == group], plan.t_end, error, target)
        for group, error, target in plan.targets
        if any(r.group == group for r in rivals)
    ]
    return WorkPrecision(plan, own + rivals, comparisons)


def own_trials(scene: Scene, plan: Plan) -> Iterator[Trial]:
    """Yield our integrators at the settings of a plan, loose to tight."""
    for method in METHODS:
        fixed = own_runs.has_fixed_steps(scene, method)
        for value in plan.steps if fixed else plan.rtols:
            change = {"step": value} if fixed else {"rtol": value}
            setting = f"step {value:g} s" if fixed else f"rtol {value:.0e}"
            changed = own_runs.with_run(scene, method=method, **change)
            yield Trial(method, setting, functools.partial(own_runs.prepare, changed), "own")


def scipy_trials(scene: Scene, plan: Plan) -> Iterator[Trial]:
    """Yield SciPy's integrators at the settings of a plan, loose to tight."""
    q, v = scene.initial_coordinates()
    y_0 = np.concatenate([q, v])
    parameters = packed(scene)
    scale = error_scale(parameters[0])[:16] / float(parameters[0]["rtol"])
    sweeps = {
        "compiled": plan.scipy_rtols,
        "numpy": plan.numpy_rtols,
        "python": plan.python_rtols,
    }
    for group, rtols in sweeps.items():
        for method in plan.scipy_methods:
            implicit = method in ("BDF", "Radau")
            if group == "python" and implicit:
                continue  # hopeless with either other right-hand side
            allowed = plan.allowed * (2.0 if group == "numpy" else 1.0)
            for form in plan.atols if group == "compiled" else ("scaled",):
                for rtol in rtols:
                    if implicit and rtol not in plan.stiff_rtols:
                        continue
                    job = _ScipyJob(scene, y_0, scale, group, method, form, rtol, allowed)
                    name = f"SciPy {method}, {GROUP_NAMES[group]}"
                    yield Trial(name, f"rtol {rtol:.0e} {form}", job, group)


@dataclass(frozen=True)
class _ScipyJob:
    """Makes SciPy's run ready; forces are read in a second run that is not timed."""

    scene: Scene
    y_0: np.ndarray
    scale: np.ndarray
    group: str
    method: str
    form: str
    rtol: float
    allowed: float

    def __call__(self) -> Callable[[], Callable[[], Outcome]]:
        problem = PROBLEMS[self.group](self.scene)

        def run() -> Callable[[], Outcome]:
            result = self._solve(problem, dense=False)
            return lambda: self._read(result, problem)

        return run

    def _solve(self, problem: Problem, dense: bool) -> scipy_runs.ScipyRun:
        plain = self.form == "plain"
        return scipy_runs.solve(
            problem,
            self.y_0,
            self.scene.run.t_end,
            self.method,
            self.rtol if plain else _LEAST_RTOL,
            np.full(16, 1e-3 * self.rtol) if plain else self.rtol * self.scale,
            self.allowed,
            dense,
        )

    def _read(self, result: scipy_runs.ScipyRun, problem: Problem) -> Outcome:
        if self.group == "compiled" and not result.failure:
            again = CompiledProblem(self.scene)
            dense = self._solve(again, dense=True)
            if not dense.failure:
                scipy_runs.read_forces(dense, again)
                again.evaluations = problem.evaluations
                return scipy_runs.outcome(dense, again)
        return scipy_runs.outcome(result, problem)


def _try_once(trials: Sequence[Trial], truth: Outcome, progress: Progress, stage: str) -> None:
    """Run each trial once; where two took too long, the rest of their kind is not tried."""
    late: dict[Any, list[str]] = {}
    for number, trial in enumerate(trials):
        progress.at(stage, number, len(trials), f"{trial.family}, {trial.setting}")
        before = late.setdefault((trial.family, trial.setting.rpartition(" ")[2]), [])
        if len(before) >= 2:
            trial.skipped = f"not tried: {' and '.join(before)} were not done in time"
            continue
        trial.run(truth)
        if trial.failure.startswith("not done"):
            before.append(trial.setting)


def _worth_repeating(rivals: Sequence[Trial], plan: Plan) -> list[Trial]:
    """Return the rivals that are quick, or that stand near a target."""
    wanted = {id(r) for r in rivals if r.seconds and r.median < plan.quick}
    for group, error, _ in plan.targets:
        of_group = [r for r in rivals if r.group == group]
        best = time_at(of_group, error, 0)
        for family in families(of_group):
            # whatever bears on a curve that comes within a factor of two of the best
            if time_at(family, error, 0) <= 2.0 * best:
                wanted |= {id(r) for r in around(family, error) if r.median < 4.0 * best}
    return [r for r in rivals if id(r) in wanted]


def families(trials: Iterable[Trial]) -> list[list[Trial]]:
    """Return trials that did not fail, by curve: family and kind of setting."""
    curves: dict[Any, list[Trial]] = {}
    for trial in trials:
        if trial.seconds:
            form = trial.setting.rpartition(" ")[2]
            key = (trial.family, form if form in ATOL else "")
            curves.setdefault(key, []).append(trial)
    return list(curves.values())


def sure_errors(family: Sequence[Trial]) -> list[float]:
    """Return each trial's position error, or that of a tighter one if that is larger.

    An error may pass through zero by luck; settings come from loose to tight.
    """
    worst = 0.0
    sure = []
    for trial in reversed(family):
        worst = max(worst, trial.errors.position)
        sure.append(worst)
    return sure[::-1]


def around(family: Sequence[Trial], error: float) -> list[Trial]:
    """Return the loosest trial that meets an error, and the one before it."""
    sure = sure_errors(family)
    for k, trial in enumerate(family):
        if sure[k] <= error:
            return [*family[max(k - 1, 0) : k], trial]
    return []


def time_at(trials: Iterable[Trial], error: float, round_: int | None = None) -> float:
    """Return the least wall time (s) for a position error, over all curves; inf if none meets it.

    Between two settings it is interpolated on logarithmic axes.  ``round_`` takes the times of
    one round, None the medians.
    """
    return min((_time_on(family, error, round_) for family in families(trials)), default=math.inf)


def _time_on(family: Sequence[Trial], error: float, round_: int | None) -> float:
    def seconds(trial: Trial) -> float:
        if round_ is None:
            return trial.median
        return trial.seconds[min(round_, len(trial.seconds) - 1)]

    met = around(family, error)
    if not met:
        return math.inf
    sure = sure_errors(family)
    k = family.index(met[-1])
    exact = min(seconds(trial) for trial in family[k:])
    if len(met) == 1 or sure[k] <= 0.0:
        return exact
    loose, tight = math.log(sure[k - 1]), math.log(sure[k])
    share = (loose - math.log(error)) / (loose - tight)
    between = (1.0 - share) * math.log(seconds(met[0])) + share * math.log(seconds(met[-1]))
    return min(exact, math.exp(between))


def compare(
    own: Sequence[Trial],
    rivals: Sequence[Trial],
    t_end: float,
    error: float,
    target: float = math.nan,
) -> Comparison:
    """Compare the best of either side at the same error, round by round."""
    rounds = max((len(trial.seconds) for trial in own), default=0)
    ours = [time_at(own, error, k) for k in range(rounds)]
    theirs = [time_at(rivals, error, k) for k in range(rounds)]
    ratios = [b / a for a, b in zip(ours, theirs, strict=True) if math.isfinite(a + b)]
    low, high = spread(ratios) if ratios else (math.nan, math.nan)
    return Comparison(
        t_end=t_end,
        error=error,
        group=rivals[0].group if rivals else "",
        own=_fastest(own, error),
        rival=_fastest(rivals, error),
        own_seconds=statistics.median(ours) if ours else math.inf,
        rival_seconds=statistics.median(theirs) if theirs else math.inf,
        ratio=statistics.median(ratios) if ratios else math.nan,
        low=low,
        high=high,
        target=target,
    )


def _fastest(trials: Sequence[Trial], error: float) -> str:
    best = min(families(trials), key=lambda family: _time_on(family, error, None), default=[])
    met = around(best, error)
    return f"{met[-1].family} near {met[-1].setting}" if met else "none"
