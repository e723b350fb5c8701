"""A complete run in one call, without ROS."""

from __future__ import annotations

import dataclasses
import html
import importlib
import math
import time
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from capture_sim.bench import Bench, Statistics, check_times, compile_kernels, drive, joined
from capture_sim.detection.align import Source
from capture_sim.detection.exact import CaptureStatus, ExactDetector
from capture_sim.detection.noisy import NoisyDetector
from capture_sim.errors import MissingPackageError, SceneError, SimulationError
from capture_sim.launch.plan import LaunchPlan
from capture_sim.launch.scenes import change_scene, load_scene
from capture_sim.results import heads, loads_of, summarize
from capture_sim.results import rows as rows_of
from capture_sim.samples import (
    ENERGIES,
    SAMPLE,
    Event,
    EventKind,
    Extremes,
    columns_of,
    unit_of_column,
)
from capture_sim.scene.files import Overrides
from capture_sim.scene.parts import Run, Scene
from capture_sim.sensors import SimulatedSensors

if TYPE_CHECKING:
    import pandas

#: Tables of a result.
Table = Literal["samples", "touches", "events"]


@dataclass(frozen=True)
class Check:
    """Comparison of a run with a second, more accurate run.

    The second run has a hundredth of the tolerance (with rk4, a quarter of the step).
    ``error`` is the largest difference of the two runs up to each sample time, an estimate of the
    first run's error; an angle counts by the displacement that it causes at the tip.  If
    ``same_touches`` is False, the sequence of touches depends on the tolerance, and the motion
    after the first difference is not determined.
    """

    error: np.ndarray  # (n,), m
    same_touches: bool  # True if both runs touch the same walls in the same order
    failure: str = ""  # reason why the second run stopped early; the error is infinite from there


@dataclass(frozen=True, repr=False, eq=False)
class Result:
    """Result of a run.

    Attributes
    ----------
    scene, plan
        Scene and launch plan of the run.
    samples : ndarray (n,) of dtype SAMPLE
        Full state at the sample times; units as in msg/BenchState.msg.
    touches : ndarray (m,) of dtype TOUCH
        Touches of a wall, each from its located start to its located end.
    events : list of Event
        Events in order, each with time and state.
    extremes : Extremes
        Peak strokes, torsion, penetration and forces and the closest approach, before and after
        the latch closes.  They come from the integrator's own steps and do not depend on the
        samples.  ``loads`` has them by name.
    statistics : Statistics
        Steps, rejected steps and evaluations of the equations of motion.
    wall_time : float
        Wall time of the integration, s.
    failure : str
        Reason why the run stopped early; empty for a complete run.
    check : Check or None
        Comparison with a more accurate run; None without ``check=True``.
    trace : ndarray (k,) of dtype SAMPLE or None
        Samples at the ends of the integrator's steps while a wall is touched; None without
        ``trace=True``.  A recording of the run contains them.
    on_grid : bool
        True for samples at ``run.state_rate``, False for samples at ``t_eval``.

    Examples
    --------
    >>> from capture_sim import simulate
    >>> simulate("paper_designed", {"buffer.c_A": 20}, t_end=0.5)
    Result(paper_designed: undecided after 0.5 s, 6 touches, peak 131.6 N, 501 samples)
    """

    scene: Scene
    plan: LaunchPlan
    samples: np.ndarray
    touches: np.ndarray
    events: list[Event]
    extremes: Extremes
    statistics: Statistics
    wall_time: float
    failure: str = ""
    check: Check | None = None
    trace: np.ndarray | None = None
    on_grid: bool = True

    @property
    def problems(self) -> tuple[str, ...]:
        """Reasons why the run is incomplete, one line each; empty if it is complete."""
        return (self.failure,) if self.failure else ()

    @property
    def t(self) -> np.ndarray:
        """Sample times (n,), s since the release."""
        return np.asarray(self.samples["t"])

    @property
    def q(self) -> np.ndarray:
        """Coordinates (n, 8): x_S, y_S, theta_S, theta_P, h, x_T, y_T, theta_T; m and rad."""
        return np.asarray(self.samples["q"])

    @property
    def v(self) -> np.ndarray:
        """Rates of ``q`` (n, 8), m/s and rad/s."""
        return np.asarray(self.samples["v"])

    @property
    def energy(self) -> dict[str, np.ndarray]:
        """Energies of the ledger by name, each (n,), J."""
        return {name: np.asarray(self.samples[name]) for name in ENERGIES}

    @cached_property
    def watched(self) -> np.ndarray:
        """Samples at ``run.state_rate``, of dtype SAMPLE, which the detector evaluates.

        A run with ``t_eval`` is repeated for them at the first access.
        """
        if self.on_grid:
            return self.samples
        try:
            return simulate(self.scene).samples
        except SimulationError as error:
            if error.result is None:
                raise
            return error.result.samples

    @cached_property
    def statuses(self) -> list[CaptureStatus]:
        """Statuses of the detector at ``run.rate``; the last one has the verdict.

        With motion capture, there is one status for each measured pose.
        """
        return _judge(self.scene, self.watched, cut=bool(self.failure))

    @property
    def verdict(self) -> str:
        """Verdict of the detector: captured, rebound, missed, stuck or undecided."""
        return self.statuses[-1].state.label

    @cached_property
    def loads(self) -> dict[str, Any]:
        """Loads of the whole run and of the time before the latch closes, by name, SI units.

        Examples of names are ``max_torsion`` and ``max_torsion_before_latch``; with the ending
        ``_time``, the time of that load.  :data:`capture_sim.results.LOADS` lists names and units.
        """
        return loads_of(self.extremes, self.touches)

    @cached_property
    def summary(self) -> dict[str, Any]:
        """Main results of the run, SI units; keys as in results.json."""
        return summarize(
            self.scene,
            self.samples,
            self.touches,
            self.events,
            self.statuses[-1],
            self.wall_time,
            self.extremes,
            self.problems,
        )

    def __repr__(self) -> str:
        end = self.events[-1].t
        peak = self.touches["peak_force"].max(initial=0.0)
        text = (
            f"{self.scene.name}: {self.statuses[-1].label} after {end:.6g} s, "
            f"{self.touches.size} touches, peak {peak:.1f} N, {self.samples.size} samples"
        )
        return f"Result({text}{'; ' + self.failure if self.failure else ''})"

    def _repr_html_(self) -> str:
        """The summary as a table, for a notebook."""
        head = f"<caption>{html.escape(self.scene.title)}</caption>"
        # a second column of values where a latch closed
        columns = rows_of([self.summary])
        lines = (
            f"<tr><th>{' '.join(filter(None, (group, name)))}</th>"
            f"{''.join(f'<td>{html.escape(cell)}</td>' for cell in cells)}<td>{unit}</td></tr>"
            for (group, name, unit), *cells in zip(heads(), *columns, strict=True)
        )
        return f"<table>{head}{''.join(lines)}</table>"

    def to_dataframe(self, table: Table = "samples") -> pandas.DataFrame:
        """Return samples, touches or events as a pandas table with one row each.

        Parameters
        ----------
        table
            ``samples``: one column for each number, indexed by time ``t``; the name of a component
            contains that of its field, e.g. ``q.x_S``, ``v.theta_P``, ``penetration.+y``.
            ``touches``: numbered from 0.  ``events``: kind, wall, detail and state, indexed by
            ``t``.

        Returns
        -------
        pandas.DataFrame
            The table; ``attrs["units"]`` has the unit of each column and of the index, empty
            without one.

        Raises
        ------
        MissingPackageError
            pandas is not installed.
        ValueError
            There is no such table.
        """
        if table not in get_args(Table):
            tables = " or ".join(map(repr, get_args(Table)))
            raise ValueError(f"table = {table!r}: must be {tables}; loads are in result.loads")
        try:
            import pandas
        except ImportError:
            raise MissingPackageError(
                "to_dataframe() needs pandas: pip install 'capture_sim[study]'"
            ) from None
        columns: dict[str, Any]
        if table == "touches":
            columns = columns_of(self.touches)
            frame = pandas.DataFrame(columns).rename_axis("touch")
        elif table == "samples":
            columns = columns_of(self.samples)
            frame = pandas.DataFrame(columns).set_index("t")
        else:
            events = self.events
            state = {name: np.array([getattr(event, name) for event in events]) for name in "qv"}
            columns = {
                "t": [event.t for event in events],
                "kind": [event.kind.label for event in events],
                "wall": [event.wall for event in events],
                "detail": [event.detail for event in events],
                **columns_of(state),
            }
            frame = pandas.DataFrame(columns).set_index("t")
        frame.attrs["units"] = {name: unit_of_column(name) for name in columns}
        return frame

    def plot(self) -> Any:
        """Return a matplotlib figure of the run; see :func:`capture_sim.plot`.

        Raises
        ------
        MissingPackageError
            matplotlib is not installed.
        """
        # imported by name: viewing is in a layer above this one
        return importlib.import_module("capture_sim").plot(self)


def simulate(
    scene: Scene | str | Path,
    overrides: Overrides = (),
    *,
    t_end: float | None = None,
    t_eval: ArrayLike | None = None,
    rtol: float | None = None,
    check: bool = False,
    trace: bool = False,
) -> Result:
    """Run a scene from the release to its end.

    Parameters
    ----------
    scene
        Scene, or the name or path of a scene for :func:`capture_sim.load_scene`.
    overrides
        Changed values as for :func:`capture_sim.load_scene`, e.g. ``{"buffer.c_A": 20}`` or
        ``["buffer.c_A=20"]``.
    t_end
        Longest duration of the run, s; None for ``scene.run.t_end``.
    t_eval
        (n,) sample times, s: finite, ascending, from 0 to ``t_end``; None for the grid of
        ``scene.run.state_rate``.  There are no samples after the end of the run, which a latch
        may bring forward.
    rtol
        Relative error tolerance; None for ``scene.run.rtol``.
    check
        True to run a second time with a smaller tolerance and compare; see :class:`Check`.
    trace
        True to keep the contact at the integrator's own steps, as with ``scene.run.trace``.

    Returns
    -------
    Result

    Raises
    ------
    SceneError
        A value is out of its range, or the samples need more than :data:`MAX_MEMORY`.
    SimulationError
        The integration stopped early; the message names time, phase and cause, and ``result`` has
        the run up to then.
    """
    if not isinstance(scene, Scene):
        scene = load_scene(scene, overrides)
    elif overrides:
        scene = change_scene(scene, overrides)
    run = scene.run
    if t_end is not None:
        run = dataclasses.replace(run, t_end=t_end)
    if rtol is not None:
        run = dataclasses.replace(run, rtol=rtol)
    if trace:
        run = dataclasses.replace(run, trace=True)
    scene = dataclasses.replace(scene, run=run)
    bench = Bench(scene)
    times = None if t_eval is None else check_times(t_eval, t_end=run.t_end)
    check_memory(run, run.t_end * run.state_rate if times is None else times.size)
    compile_kernels()
    start = time.perf_counter()
    if times is None:
        times = bench.times(0, math.floor(run.t_end * run.state_rate) + 2)
    pieces = list(drive(bench, times))
    failure = pieces[-1].failure
    samples = joined([piece.samples for piece in pieces])
    result = Result(
        scene=scene,
        plan=bench.plan,
        samples=samples,
        touches=bench.touches,
        events=bench.events,
        extremes=bench.extremes,
        statistics=bench.statistics,
        wall_time=time.perf_counter() - start,
        failure="" if failure is None else str(failure),
        trace=bench.trace if run.trace else None,
        on_grid=t_eval is None,
    )
    if failure is not None:
        failure.result = result
        raise failure
    if not check:
        return result
    try:
        finer = simulate(_finer(scene), t_eval=result.t)
    except SimulationError as error:
        if error.result is None:
            raise
        finer = error.result
    return dataclasses.replace(result, check=_compare(result, finer))


#: Largest memory for the samples of one run, bytes.
MAX_MEMORY = 4_000_000_000


def check_memory(
    run: Run, count: float, rate: Literal["state_rate", "rate"] = "state_rate"
) -> None:
    """Raise SceneError if the samples at one of the run's rates would fill the memory."""
    # in pieces as they are computed, then joined
    needed = 2.0 * count * SAMPLE.itemsize
    if needed > MAX_MEMORY:
        raise SceneError(
            f"run.t_end = {run.t_end:g} s at run.{rate} = {getattr(run, rate):g} Hz: {count:.3g} "
            f"samples need {needed / 1e9:.3g} GB of memory: must be "
            f"at most {MAX_MEMORY / 1e9:g} GB"
        )


#: Smallest tolerance above round-off error.
_MIN_RTOL = 1e-13


def _finer(scene: Scene) -> Scene:
    """Return the scene with a smaller tolerance, a shorter step or another method."""
    run = scene.run
    if run.method == "rk4":
        run = dataclasses.replace(run, step=run.step / 4.0)
    elif run.rtol > 10.0 * _MIN_RTOL:
        run = dataclasses.replace(run, rtol=max(run.rtol / 100.0, _MIN_RTOL))
    else:
        # no smaller tolerance is possible: another method has other errors
        run = dataclasses.replace(run, method="dopri5" if run.method == "dop853" else "dop853")
    return dataclasses.replace(scene, run=run)


def _compare(coarse: Result, fine: Result) -> Check:
    """Return the comparison of two runs of one scene, at the times that both have."""
    n = min(coarse.t.size, fine.t.size)
    difference = np.abs(coarse.q[:n] - fine.q[:n])
    arm = coarse.scene.buffer.hinge_offset + coarse.scene.rest_length
    at_target = coarse.scene.cone.L_T + coarse.scene.cone.R_c
    difference *= np.array([1.0, 1.0, arm, arm, 1.0, 1.0, 1.0, at_target])
    error = np.full(coarse.t.size, np.inf)
    error[:n] = np.maximum.accumulate(difference.max(axis=1, initial=0.0))
    return Check(error, _touch_sequence(coarse) == _touch_sequence(fine), fine.failure)


def _touch_sequence(result: Result) -> list[tuple[str, int]]:
    return [
        (event.kind.label, event.wall)
        for event in result.events
        if event.kind in (EventKind.TOUCH, EventKind.LIFT_OFF)
    ]


def _judge(scene: Scene, samples: np.ndarray, *, cut: bool) -> list[CaptureStatus]:
    """Return the detector's statuses for samples at ``run.state_rate``, verdict last."""
    every = round(scene.run.state_rate / scene.run.rate)
    if scene.sensors is None or scene.sensors.motion_capture is None:
        exact = ExactDetector(scene)
        return [*exact.update(samples[::every]), exact.finish(cut=cut)]
    detector, sensors = NoisyDetector(scene), SimulatedSensors(scene)
    statuses: list[CaptureStatus] = []
    for k, sample in enumerate(samples):
        t, v = float(sample["t"]), sample["v"].tolist()
        if k % every == 0:
            buffer = (float(sample["axial_stroke"]), float(sample["torsion"]))
            statuses += detector.measure(Source.BUFFER, t, (*buffer, v[4], v[3] - v[2]))
        reading = sensors.read(sample)
        if reading.chaser is not None and reading.target is not None:
            statuses += detector.measure(Source.CHASER, t, reading.chaser)
            statuses += detector.measure(Source.TARGET, t, reading.target)
    return [*statuses, *detector.finish(cut=cut)]
