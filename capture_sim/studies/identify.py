"""Fitting parameters of the bench to measurements, with standard errors.

Weighted least squares on the simulator itself: the residuals are what was measured less what
is simulated, each divided by its noise; scipy's trust-region method (Branch, Coleman and Li,
1999) keeps the parameters within their ranges.  The covariance is that of the linearised
problem, (J^T J)^-1, widened where the residuals are larger than the noise explains.

Poses, stroke and torsion depend on the parameters smoothly, through all chatter of the tip.
A sampled contact force does not: a touch lasts half a millisecond, so samples hit or miss
it.  Instead of it the first touches serve, by the time of their start and their impulse, in a
second stage when the fit is near enough for the touches to correspond.  Touches that were not found
in a sampled force, e.g. those of a simulation, serve by their peak force.  A load cell's filter and
clock delay all touches by the same unknown time, which is fitted with the rest: it would change
rolling resistance by several of its standard errors, and the other parameters hardly depend on it.

On a real bench the release is seldom known as well as a touch is measured, and a millisecond of it
moves other parameters by many of their standard errors, in fits that look good
(docs/node_suite.md): so it can be fitted along with the rest.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from capture_sim.dynamics.bench import Bench
from capture_sim.dynamics.compilation import compile_kernels
from capture_sim.errors import SceneError, SimulationError
from capture_sim.run.run import Run
from capture_sim.run.series import PARTS, Series, series_in
from capture_sim.run.touches import Touches
from capture_sim.scene.parts import Scene
from capture_sim.scene.paths import changed, get, paths_of, range_of, usual_size

#: Name of a parameter that is in no scene: the actual time of the release, s after the
#: time that is taken for it.
RELEASE = "release"
#: Its scale, s.
_RELEASE_SIZE = 0.01
#: Searches that begin round the best place found, to see whether it is the best there.
_NEARBY = 4
#: Step of the numerical derivatives, of a parameter's scale.
_STEP = 3e-3
#: Longest step that the errors are taken over.
_LONGEST_STEP = 0.3
#: Residual, in units of noise, that stands for a simulation that failed or a missing touch.
_FAILED = 1e3


@dataclass(frozen=True)
class Fit:
    """Result of a fit, in the units of the scene's fields."""

    names: tuple[str, ...]  # of the parameters
    values: np.ndarray  # (k,)
    errors: np.ndarray  # (k,), standard errors
    correlation: np.ndarray  # (k, k), of the errors
    chi2: float  # per degree of freedom: 1 when the model explains all but the noise
    freedom: int  # degrees of freedom: residuals less parameters
    at_bound: tuple[str, ...]  # parameters at a bound of their range: their errors mean nothing
    evaluations: int  # simulations
    scene: Scene = field(repr=False)  # with the fitted values
    touches: int = 0  # number that was used

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Parameters that the measurements do not depend on."""
        return tuple(
            n for n, e in zip(self.names, self.errors, strict=True) if not math.isfinite(e)
        )


def identify(
    scene: Scene,
    run: Run,
    names: Sequence[str],
    *,
    touches: Touches | None = None,
    noise: Mapping[str, Sequence[float]] | None = None,
    until: float = math.inf,
    starts: int = 10,
    seed: int = 0,
) -> Fit:
    """Fit parameters of a scene to the measurements of one run.

    Parameters
    ----------
    scene
        Scene with the initial values of the search.
    run
        The measured run.  Its sampled force is not used: samples hit or miss a touch by chance.
        The simulated launch is the commanded one, for all parameters; without a recorded command
        it is the launch of the scene.
    names
        ``c_rr`` (of both vehicles), ``e``, ``mu``, ``c_A``, or fields, e.g. ``buffer.k_A``; also
        :data:`RELEASE` if the release time is not known exactly.
    touches
        The first touches; None to fit without touches.  Touches from a force that is sampled too
        slowly for the touches of the scene are not used.
    noise
        Standard deviations by series, one for each of its parts; a missing one is estimated from
        the noise of the series.
    until
        End of the measurements that are used, s.
    starts
        Maximum number of searches; the best one counts, and some start near it in the end.  The
        first search begins at the scene's values.  If its residuals exceed the noise floor,
        further searches begin within a factor of two of these values.
    seed
        Seed of the starting points of further searches.

    Raises
    ------
    SceneError
        A name is unknown or given twice, nothing was measured, or a noise is not positive.
    SimulationError
        The scene cannot be simulated with the initial values.
    """
    compile_kernels()
    if touches is not None:
        if min(touches.start_noise, touches.peak_noise) <= 0.0:
            raise SceneError(
                f"noise of touches = {touches.start_noise:g} s, {touches.peak_noise:g} N: "
                "must be > 0"
            )
        touches = touches.of(touches.start <= until)
    problem = _Problem(scene, run, names, noise or {}, until)
    _, expected = problem.simulate(problem.begin)  # raises what is wrong with the scene
    if touches is not None:
        first = expected[np.argsort(expected["start"], kind="stable")][: touches.start.size]
        if touches.may_miss(first["end"] - first["start"]):
            touches = None
    rng = np.random.default_rng(seed)

    def search(begin: np.ndarray) -> Any:
        found = problem.solve(begin, None)
        return found if touches is None else problem.solve(found.x, touches)

    best = search(problem.begin)
    for _ in range(starts - 1):
        if is_explained(problem.result(best, touches)):
            break
        away = problem.begin * 2.0 ** rng.uniform(-1.0, 1.0, problem.begin.size)
        found = search(np.where(problem.in_scene, away, best.x))
        best = min(best, found, key=lambda result: result.cost)
    # the chatter puts kinks into the way, and a kink may hold a search close to its aim
    for _ in range(_NEARBY if starts > 1 else 0):
        off = 0.1 * rng.standard_normal(best.x.size)
        near = best.x + off * np.where(problem.in_scene, best.x, 1.0)
        best = min(best, problem.solve(near, touches), key=lambda result: result.cost)
    return problem.result(best, touches)


def is_explained(fit: Fit) -> bool:
    """True if the residuals are no larger than the noise floor."""
    # chi2 of so many freedoms scatters by sqrt(2 / freedom); noise is known to some 10 %
    return fit.chi2 < 1.2 + 5.0 * math.sqrt(2.0 / fit.freedom)


class _Problem:
    """Residuals as a function of the scaled parameters."""

    def __init__(
        self,
        scene: Scene,
        run: Run,
        names: Sequence[str],
        noise: Mapping[str, Sequence[float]],
        until: float,
    ) -> None:
        self._names = tuple(names)
        self._paths = [() if name == RELEASE else paths_of(scene, name) for name in names]
        self.in_scene = np.array([name != RELEASE for name in names])
        if not names or len(set(names)) != len(names):
            raise SceneError(f"parameters {', '.join(names)!r}: must be names, each once")
        self._scene = scene
        self._plan = run.plan or Bench(scene).plan
        self.evaluations = 0
        self._series: list[tuple[str, Series, np.ndarray]] = []
        for name in PARTS:
            series = run.measured(name)
            kept = (series.t <= min(until, scene.run.t_end)) & (series.t >= 0.0)
            if kept.any():
                cut = Series(series.t[kept], series.values[kept])
                sigma = np.asarray(noise.get(name) or scatter(cut), dtype=float)
                self._series.append(
                    (name, cut, np.maximum(sigma, [part.noise for part in PARTS[name]]))
                )
        if not self._series:
            raise SceneError(
                "nothing to fit to: the run holds no poses, stroke or torsion of the time asked for"
            )
        self._times = np.unique(np.concatenate([series.t for _, series, _ in self._series]))
        if self._times.size < 2:
            raise SceneError("measurements of one instant: must be of two or more")
        last = self._times[-1]
        rows = []
        for name, paths in zip(names, self._paths, strict=True):
            if not paths:
                rows.append((0.0, _RELEASE_SIZE, -last, last))
                continue
            value = get(scene, paths[0])  # of which zero has no scale of its own
            rows.append((value, abs(value) or usual_size(name), *range_of(scene, paths[0])))
        begin, self._scale, low, high = np.array(rows).T
        self.begin, self._low, self._high = (x / self._scale for x in (begin, low, high))

    def scene_at(self, x: np.ndarray) -> Scene:
        """Return the scene with these scaled parameters."""
        scene = self._scene
        for value, paths in zip(x * self._scale, self._paths, strict=True):
            for path in paths:
                scene = changed(scene, path, float(value))
        if scene.string is not None:  # what hangs there does not follow the parameters
            string = dataclasses.replace(
                scene.string,
                impact_speed=None,
                hanging_mass=self._plan.hanging_mass,
                drop_height=self._plan.drop_height,
            )
            scene = dataclasses.replace(scene, string=string)
        return scene

    def simulate(self, x: np.ndarray) -> tuple[dict[str, Series], np.ndarray]:
        """Return predicted measurements and touches; times are s since the release at x."""
        self.evaluations += 1
        scene = self.scene_at(x)
        times = np.unique(self._since_release(self._times, x))
        if not np.isfinite(times[-1]):  # a search among residuals too large for its numbers
            raise SceneError(f"{RELEASE} = {self._released(x)} s: must be finite")
        if times[-1] > scene.run.t_end:
            scene = changed(scene, "run.t_end", float(times[-1]))
        bench = Bench(scene)
        samples = bench.advance(times)
        return series_in(samples), bench.touches

    def _released(self, x: np.ndarray) -> float:
        """Return when the release was, s after the time that was taken for it."""
        return float((x * self._scale)[~self.in_scene].sum())

    def _since_release(self, t: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return times of the measurements as those of the simulation: before, all is at rest."""
        return np.maximum(t - self._released(x), 0.0)

    def residuals(self, x: np.ndarray, touches: Touches | None) -> np.ndarray:
        """Return measured less simulated, in units of noise."""
        try:
            simulated, touched = self.simulate(x)
        except (SimulationError, SceneError):  # that far off the bench does not work
            size = sum(series.values.size for _, series, _ in self._series)
            return np.full(size + (0 if touches is None else 2 * touches.start.size), _FAILED)
        parts = []
        for name, series, sigma in self._series:
            own = simulated[name]
            # where the run ended before, it stays where it is
            last = np.searchsorted(own.t, self._since_release(series.t, x), side="right") - 1
            values = own.values[np.maximum(last, 0)]
            parts.append(((series.values - values) / sigma).ravel())
        if touches is not None:
            touched = touched[touched["peak_force"] >= touches.threshold]
            touched = touched[np.argsort(touched["start"], kind="stable")]
            n = min(touches.start.size, touched.size)
            missing = np.full(touches.start.size - n, _FAILED)
            began = touches.start[:n] - self._released(x)
            late = began - touched["start"][:n]
            if n and not touches.is_delay_known:
                late -= late.mean()  # the delay that fits best
            start = late / touches.start_noise
            expected = touched["impulse" if touches.strength == "impulse" else "peak_force"][:n]
            measured = getattr(touches, touches.strength)[:n]
            strength = (measured - expected) / touches.strength_noise[:n]
            parts += [start, missing, strength, missing]
        return np.concatenate(parts)

    def jacobian(
        self, x: np.ndarray, touches: Touches | None, steps: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the derivatives of the residuals, by central differences."""
        columns = []
        for k, step in enumerate(np.full(x.size, _STEP) if steps is None else steps):
            ahead, back = x.copy(), x.copy()
            ahead[k] = min(x[k] + step, self._high[k])
            back[k] = max(x[k] - step, self._low[k])
            change = self.residuals(ahead, touches) - self.residuals(back, touches)
            columns.append(change / (ahead[k] - back[k]))
        return np.stack(columns, axis=1)

    def solve(self, begin: np.ndarray, touches: Touches | None) -> Any:
        """Return scipy's result of a search from there."""
        margin = 1e-6  # strictly within the ranges, as the search wants it
        return least_squares(
            lambda x: self.residuals(x, touches),
            np.clip(begin, self._low + margin, self._high - margin),
            jac=lambda x: self.jacobian(x, touches),
            bounds=(self._low, self._high),
            xtol=1e-8,
            ftol=1e-8,
            max_nfev=60,
        )

    def result(self, found: Any, touches: Touches | None) -> Fit:
        """Return the fit of a search that has ended."""
        n_delays = 0 if touches is None or touches.is_delay_known else 1
        freedom = max(found.fun.size - found.x.size - n_delays, 1)
        chi2 = float(2.0 * found.cost / freedom)
        variance, covariance = spread(self.jacobian(found.x, touches))
        # Where the dependence has kinks, the slope at the very minimum may be steep: an error
        # counts that is confirmed by differences over its own size.
        steps = np.clip(np.sqrt(variance), _STEP / 30.0, _LONGEST_STEP)
        wide, _ = spread(self.jacobian(found.x, touches, steps))
        variance = np.maximum(variance, wide)
        scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        near = np.minimum(found.x - self._low, self._high - found.x) < 1e-4
        return Fit(
            names=self._names,
            values=found.x * self._scale,
            errors=np.sqrt(variance * max(1.0, chi2)) * self._scale,
            correlation=covariance / np.outer(scale, scale),
            chi2=chi2,
            freedom=freedom,
            at_bound=tuple(n for n, at in zip(self._names, near, strict=True) if at),
            evaluations=self.evaluations,
            scene=self.scene_at(found.x),
            touches=0 if touches is None else touches.start.size,
        )


def spread(J: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the variances (k,) of least-squares parameters, and their covariances (k, k).

    ``J`` (n, k) has the derivatives of residuals of unit variance.  The variance is infinite for
    what the data do not determine; the covariance leaves it out.
    """
    _, singular, right = np.linalg.svd(J, full_matrices=False)
    tiny = singular <= 1e-10 * singular.max(initial=1e-300)
    loads = right.T**2
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(tiny, np.inf, singular**-2.0)
        variance = np.where(loads > 1e-12, loads * inverse, 0.0).sum(axis=1)
    return variance, (right.T * np.where(tiny, 0.0, inverse)) @ right


def scatter(series: Series) -> np.ndarray:
    """Return the noise of each part of a smooth, evenly spaced series: standard deviations (m,).

    The third difference of white noise has 20 times its variance, that of a smooth motion
    is small; the median keeps bends at touches from counting.
    """
    values = series.values.reshape(len(series.t), -1)
    if len(values) < 5:
        return np.zeros(values.shape[1])
    rough = np.abs(np.diff(values, n=3, axis=0))
    return np.asarray(np.median(rough, axis=0) / 0.6745 / math.sqrt(20.0))
