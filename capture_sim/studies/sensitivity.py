"""How force, strokes and verdict change with each parameter of a scene.

Near the scene, by central differences; over the whole spread, one parameter at a time (the
tornado) or all at once (Morris' or Sobol's method, by SALib).  A run has corners where a touch
more or less decides: a difference quotient that does not converge as its step shrinks, or whose
two runs do not have the same touches, is flagged.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from capture_sim.errors import SceneError
from capture_sim.launch.scenes import check_scene
from capture_sim.scene import paths
from capture_sim.scene.parts import Scene
from capture_sim.studies.approach import approach_of, placed
from capture_sim.studies.executors import answers
from capture_sim.studies.outcome import run_first_contact, run_to_verdict


class Quantity(NamedTuple):
    """What is computed, SI, and how it is displayed: ``factor`` from SI to ``unit``."""

    name: str
    title: str
    unit: str
    factor: float


#: Force, strokes and duration are of the first contact, nearest is until the verdict, captured
#: 1 or 0.
QUANTITIES = (
    Quantity("peak_force", "peak force of the first contact", "N", 1.0),
    Quantity("axial_stroke", "axial stroke of the first contact", "mm", 1e3),
    Quantity("torsion", "torsion of the first contact", "mrad", 1e3),
    Quantity("duration", "duration of the first contact", "ms", 1e3),
    Quantity("nearest", "nearest to the centre of BE", "mm", 1e3),
    Quantity("captured", "captured", "1", 1.0),
)
#: Those that have derivatives: all but the verdict.
SMOOTH = QUANTITIES[:-1]

#: Steps of the difference quotients, of the parameter's spread.
STEPS = (0.1, 0.03, 0.01, 0.003, 0.001)

#: A derivative that changes by more than this part of itself from step to step is flagged.
CONVERGED = 0.1

_APPROACH = ("approach.angle", "approach.offset", "approach.speed")
_RUN_UP = 1e-3  # m


@dataclass(frozen=True)
class Parameter:
    """A parameter and how far it may be off.

    ``name`` is a field of the scene (``buffer.k_A``) or ``approach.speed``, ``.offset`` or
    ``.angle``; ``spread`` to either side, as part of the value if ``relative``, else in SI
    units.
    """

    name: str
    unit: str
    spread: float
    relative: bool = True

    def reach(self, value: float) -> float:
        """Return the spread about a value, SI."""
        return self.spread * abs(value) if self.relative else self.spread

    @property
    def displayed_spread(self) -> str:
        """The spread in the units of the commands: per cent, deg, mm."""
        if self.relative:
            return f"{100 * self.spread:.3g} %"
        factor, unit = {"rad": (180.0 / math.pi, "deg"), "m": (1e3, "mm")}.get(
            self.unit, (1.0, self.unit)
        )
        return f"{factor * self.spread:.3g} {unit}"


def default_parameters(part: float = 0.1) -> tuple[Parameter, ...]:
    """Return what may be off in a bench, each by ``part`` of itself if nothing else is natural.

    Raises
    ------
    SceneError
        ``part`` is out of its range.
    """
    if not 0.0 < part <= 0.5:
        raise SceneError(f"spread = {part!r}: must be > 0 and <= 0.5")
    return (
        Parameter("approach.speed", "m/s", part),
        Parameter("approach.offset", "m", 2e-3, relative=False),
        Parameter("approach.angle", "rad", math.radians(1.0), relative=False),
        Parameter("buffer.k_A", "N/m", part),
        Parameter("buffer.k_T", "N m/rad", part),
        Parameter("buffer.c_A", "N s/m", part),
        Parameter("chaser.mass", "kg", part),
        Parameter("chaser.inertia", "kg m^2", part),
        Parameter("target.mass", "kg", part),
        Parameter("target.inertia", "kg m^2", part),
        Parameter("cylinder.mass", "kg", part),
        Parameter("probe.density", "kg/m^3", part),
        Parameter("cone.half_angle", "rad", math.radians(1.0), relative=False),
        Parameter("contact.restitution", "1", part),
        Parameter("friction.mu", "1", part),
        Parameter("friction.slip_regularization_speed", "m/s", part),
    )


@dataclass(frozen=True)
class Derivative:
    """How a quantity changes with a parameter, at the scene.

    Attributes
    ----------
    value : float
        Change of the quantity (SI) for a parameter that is off by its spread, were it linear.
    error : float
        Change of ``value`` from the step before to the one taken.
    step : float
        The step that was taken, of the spread.
    converged : bool
        The quotient converges as the step shrinks, and both runs have the same touches: without
        that the value is not to be trusted.
    """

    value: float
    error: float
    step: float
    converged: bool


@dataclass(frozen=True)
class Local:
    """Derivatives and the tornado.

    ``derivatives[p][q]`` is for parameter p and quantity q (the verdict has none), ``low`` and
    ``high`` (p, q) are the quantities with the parameter off by its spread, ``base`` (q,)
    without.
    """

    parameters: tuple[Parameter, ...]
    base: np.ndarray
    derivatives: list[list[Derivative]]
    low: np.ndarray
    high: np.ndarray


@dataclass(frozen=True)
class Global:
    """Indices of Morris or Sobol, all parameters varied at once.

    ``first`` and ``total`` (p, q): Sobol's S_1 and S_T; with Morris the mean of the elementary
    effects' magnitudes mu* (in ``total``) and their scatter sigma (in ``first``), in units of
    the quantity.  ``confidence`` (p, q) is that of ``total`` (95 %).  NaN where a quantity
    does not vary.
    """

    method: str
    parameters: tuple[Parameter, ...]
    first: np.ndarray
    total: np.ndarray
    confidence: np.ndarray
    runs: int
    captured: float


def value_of(scene: Scene, parameter: Parameter) -> float:
    """Return a parameter's value in a scene, SI.

    Raises
    ------
    SceneError
        The scene has no such number.
    """
    name = parameter.name
    if name in _APPROACH:
        return approach_of(scene)[_APPROACH.index(name)]
    value = paths.get(scene, name)
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        raise SceneError(f"{name}: must be a number of the scene that it has")
    return float(value)


def changed(scene: Scene, parameters: Sequence[Parameter], values: Sequence[float]) -> Scene:
    """Return a scene with parameters at ``values`` (SI), just before its first touch.

    Raises
    ------
    SceneError
        A value is out of its range, or the chaser misses the cone.
    """
    approach = dict(zip(_APPROACH, approach_of(scene), strict=True))
    start = scene.initial
    # out of the way while sizes change: it is placed anew
    far = replace(start.chaser, x=start.target.x - 10.0, y=start.target.y, theta=0.0)
    scene = replace(scene, initial=replace(start, chaser=far), rail=None, string=None)
    for parameter, value in zip(parameters, values, strict=True):
        if parameter.name in approach:
            approach[parameter.name] = value
        else:
            scene = paths.changed(scene, parameter.name, value)
    angle, offset, speed = approach.values()
    near = placed(scene, angle, offset, speed, _RUN_UP)
    if near is None:
        raise SceneError(f"{scene.name}: with {approach} the chaser misses the cone")
    return near


def respond(task: tuple[Scene, tuple[Parameter, ...], tuple[float, ...]]) -> tuple[Any, int]:
    """Return the quantities (q,) of a changed scene, and the touches of its first contact."""
    scene = changed(*task)
    contact, outcome = run_first_contact(scene), run_to_verdict(scene)
    values = [getattr(contact, quantity.name) for quantity in QUANTITIES[:4]]
    return np.array(
        [*values, outcome.loads["nearest_distance"], float(outcome.captured)]
    ), contact.touches


def local_sensitivity(
    scene: Scene,
    parameters: tuple[Parameter, ...],
    executor: Executor,
    report: Callable[[int, int], None] | None = None,
) -> Local:
    """Find the derivatives at a scene, and what each parameter does over its spread.

    Takes ``1 + 2 len(parameters) (1 + len(STEPS))`` runs; ``report`` is called with how many of
    how many are done.

    Raises
    ------
    SceneError
        A parameter is not in the scene, or out of its range within its spread.
    """
    at_scene, reach = _spread(scene, parameters)
    shares = (1.0, *STEPS)
    off = np.tile(at_scene, (len(parameters), len(shares), 2, 1))
    for number, far in enumerate(reach):
        off[number, :, :, number] += np.outer(shares, (-1.0, 1.0)) * far
    points = [at_scene, *off.reshape(-1, len(parameters))]
    tasks = [(scene, parameters, tuple(point.tolist())) for point in points]
    for _, _, values in tasks:
        # says what is out of range before anything runs
        check_scene(changed(scene, parameters, values))
    (base, _), *found = answers(executor, respond, tasks, report)
    at = np.array([values for values, _ in found]).reshape(*off.shape[:3], len(QUANTITIES))
    touches = np.array([count for _, count in found]).reshape(off.shape[:3])
    derivatives = [
        [_converge(at[p, 1:, :, q], touches[p, 1:], float(base[q])) for q in range(len(SMOOTH))]
        for p in range(len(parameters))
    ]
    return Local(parameters, base, derivatives, at[:, 0, 0], at[:, 0, 1])


def _spread(scene: Scene, parameters: Sequence[Parameter]) -> tuple[np.ndarray, np.ndarray]:
    """Return the parameters' values in a scene (p,) and how far they may be off (p,), SI."""
    values = [value_of(scene, parameter) for parameter in parameters]
    reach = [parameter.reach(v) for parameter, v in zip(parameters, values, strict=True)]
    return np.array(values), np.array(reach)


def _converge(ends: np.ndarray, touches: np.ndarray, base: float) -> Derivative:
    """Choose among difference quotients the one that changes least from step to step.

    ``ends`` (steps, 2) are the quantity's values below and above, ``touches`` likewise.
    """
    quotients = (ends[:, 1] - ends[:, 0]) / (2.0 * np.array(STEPS))
    changes = np.abs(np.diff(quotients))
    best = int(np.argmin(changes)) + 1
    value, error = float(quotients[best]), float(changes[best - 1])
    same = bool(touches[best, 0] == touches[best, 1])
    small = error <= 1e-4 * abs(base)  # nothing changes: no need to converge
    converged = same and (error <= CONVERGED * abs(value) or small)
    return Derivative(value, error, STEPS[best], converged)


def check_method(method: str, samples: int) -> None:
    """Check the method, the number of its samples, and that SALib is there.

    Raises
    ------
    SceneError
        It is none of them, or out of its range.
    ImportError
        SALib is not installed.
    """
    if method not in ("morris", "sobol"):
        raise SceneError(f"method = {method!r}: must be morris or sobol")
    if not 4 <= samples <= 65536 or (method == "sobol" and samples & (samples - 1)):
        raise SceneError(f"samples = {samples!r}: must be >= 4, with sobol a power of 2")
    import SALib  # noqa: F401


def global_sensitivity(
    scene: Scene,
    parameters: tuple[Parameter, ...],
    executor: Executor,
    method: str = "morris",
    samples: int = 32,
    seed: int = 1,
    report: Callable[[int, int], None] | None = None,
) -> Global:
    """Vary all parameters at once, evenly over their spreads.

    Parameters
    ----------
    method
        ``"morris"``: ``samples`` trajectories of ``len(parameters) + 1`` runs; ``"sobol"``:
        ``samples`` (a power of 2) times ``len(parameters) + 2`` runs.
    seed
        Of the samples.
    report
        Called with how many of how many runs are done.

    Raises
    ------
    SceneError
        A value is out of its range.
    """
    from SALib.analyze import morris as morris_analysis
    from SALib.analyze import sobol as sobol_analysis
    from SALib.sample import morris as morris_sample
    from SALib.sample import sobol as sobol_sample

    check_method(method, samples)
    base, reach = _spread(scene, parameters)
    problem = {
        "num_vars": len(parameters),
        "names": [parameter.name for parameter in parameters],
        "bounds": np.column_stack([base - reach, base + reach]).tolist(),
    }
    if method == "morris":
        points = morris_sample.sample(problem, samples, seed=seed)
        analyze = partial(morris_analysis.analyze, problem, points, seed=seed)
        names = ("sigma", "mu_star", "mu_star_conf")
    else:
        points = sobol_sample.sample(problem, samples, calc_second_order=False, seed=seed)
        analyze = partial(sobol_analysis.analyze, problem, calc_second_order=False, seed=seed)
        names = ("S1", "ST", "ST_conf")
    tasks = [(scene, parameters, tuple(point)) for point in points.tolist()]
    found = np.array([values for values, _ in answers(executor, respond, tasks, report)])
    first, total, confidence = np.full((3, len(parameters), len(QUANTITIES)), math.nan)
    for q in np.flatnonzero(np.ptp(found, axis=0)):
        indices = analyze(found[:, q])
        first[:, q], total[:, q], confidence[:, q] = (indices[name] for name in names)
    captured = float(np.mean(found[:, -1]))
    return Global(method, parameters, first, total, confidence, len(tasks), captured)
