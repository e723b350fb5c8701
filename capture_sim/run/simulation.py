"""Simulation of a complete run in one call, :func:`simulate`, without ROS."""

from __future__ import annotations

import math
import time
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from capture_sim.detection.criteria import CaptureStatus
from capture_sim.detection.exact import Statuses
from capture_sim.dynamics.bench import Bench
from capture_sim.dynamics.compilation import compile_kernels
from capture_sim.dynamics.drive import Control
from capture_sim.dynamics.sample_times import check_times
from capture_sim.dynamics.samples import EventKind
from capture_sim.dynamics.thrust import Commands
from capture_sim.errors import SceneError, SimulationError
from capture_sim.run.given import Given, Integrated
from capture_sim.run.integration import Integration, check_memory, kept
from capture_sim.run.lazy import LazyMapping
from capture_sim.run.run import Check, ExactRun, Run
from capture_sim.run.sensors import sensor_series
from capture_sim.run.series import QUANTITIES, STATE, Series, SeriesBySource, series_in
from capture_sim.scene.files import Overrides
from capture_sim.scene.loading import as_scene
from capture_sim.scene.parts import RunSettings, Scene
from capture_sim.scene.quantities import replaced


class RunError(SimulationError):
    """Error if :func:`simulate` stops early; ``result`` is the run up to the stop."""

    def __init__(self, message: str, partial: np.ndarray, result: Run) -> None:
        super().__init__(message, partial)
        self.result = result

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (*self.args, self.partial, self.result)


def simulate(
    scene: Scene | str | Path,
    overrides: Overrides = (),
    *,
    t_end: float | None = None,
    t_eval: ArrayLike | None = None,
    rtol: float | None = None,
    check: bool = False,
    trace: bool = False,
    control: Control | None = None,
) -> Run:
    """Simulate a scene from the release to the end of the run.

    Parameters
    ----------
    scene
        Scene, or the name or path of a scene for :func:`capture_sim.load_scene`.
    overrides
        Changed values as for :func:`capture_sim.load_scene`, e.g. ``{"buffer.c_A": 20}``,
        ``["buffer.c_A=20"]`` or a row of a pandas table.
    t_end
        Longest duration of the run, s; None for ``scene.run.t_end``.
    t_eval
        (n,) sample times, s: finite, ascending, from 0 to ``t_end``; None for the grid of
        ``scene.run.state_rate``, which a second integration samples when they are first read.
        There are no samples after the end of the run, which a latch may bring forward.
    rtol
        Relative error tolerance; None for ``scene.run.rtol``.
    check
        True to run a second time with a smaller tolerance and compare; see :class:`Check`.
    trace
        True to keep the contact at the integrator's own steps, as with ``scene.run.trace``.
    control
        Controller of the scene's thrusters, see :class:`capture_sim.dynamics.drive.Control`.
        ``t_eval`` must then be None.

    Returns
    -------
    Run
        Samples, touches and events with times in s since the release, the detector's verdict,
        loads and summary.  :func:`capture_sim.read_run` returns such a run from a recording.

    Raises
    ------
    SceneError
        A value is out of its range, or the samples need more than
        :data:`capture_sim.run.integration.MAX_MEMORY`, or ``t_eval`` and ``control`` are both set.
    RunError
        The integration stopped early; the message names time, phase and cause, and ``result`` has
        the run up to then.  It is a SimulationError.

    Warnings
    --------
    After tens of impacts, a motion can depend on rounding.  ``check=True`` shows from which time
    on: its error grows there to the size of the motion.

    See Also
    --------
    capture_sim.read_run : The run of a recording, of the same kind.
    capture_sim.sweep : Many runs of a scene, a row each.
    capture_sim.Bench : A run that is advanced step by step.

    Examples
    --------
    >>> from capture_sim import simulate
    >>> run = simulate("tilt_0", {"friction.mu": 0.2})
    >>> run
    Run(tilt_0: captured after 3.11 s, 7 touches, peak 131.8 N, 5927 samples to 5.92606 s)
    >>> round(1e3 * run.loads["max_axial_stroke_in_before_latch"], 2)  # mm
    4.92
    """
    scene = as_scene(scene, overrides)
    run = scene.run
    changes = {"t_end": t_end, "rtol": rtol, "trace": trace or None}
    if changes := {name: value for name, value in changes.items() if value is not None}:
        run = replaced(run, changes)
        scene = _with_run(scene, run)
    times = None if t_eval is None else check_times(t_eval, t_end=run.t_end)
    check_memory(run, run.t_end * run.state_rate if times is None else times.size)
    if control is not None and times is not None:
        raise SceneError("t_eval: must be None with a controller")
    compile_kernels()
    (memory,) = kept.memories(1) if control is None and times is None else (None,)
    integration = Integration(scene, memory)
    start = time.perf_counter()
    samples: np.ndarray | None = None
    judged: _Judged | None = None
    if control is not None:
        samples, statuses = integration.controlled(control)
        judged = _judged_as(integration, statuses)
    elif times is None:
        judged = _judged(integration)
    else:
        samples = integration.sample(times)
    wall_time = time.perf_counter() - start
    result = ExactRun(
        scene.name,
        GivenByIntegration(scene, integration.bench, samples, judged, is_on_grid=times is None),
        wall_time=wall_time,
        statistics=integration.bench.statistics,
        failure=integration.failure,
    )
    if result.failure:
        raise RunError(result.failure, result.samples, result)
    if not check:
        return result
    try:
        same: dict[str, Any] = {"t_eval": result.t} if control is None else {"control": control}
        finer = simulate(_with_run(scene, run.refined(100.0, 4.0)), **same)
    except RunError as error:
        finer = error.result
    return result.replaced(check=_compare(result, finer))


def applied_again(run: Run) -> Control | None:
    """Return a controller that repeats the thrust of an exact run; None if it had no thrust.

    The wrenches are taken from the samples at ``run.state_rate``, so a change between two samples
    takes effect at the earlier of the two.
    """
    thrust = run.samples["thrust"]
    if run.scene.thrusters is None or not thrust.any():
        return None
    rate = run.scene.run.state_rate

    def command(sample: np.void) -> Commands:
        # a sample has the wrench that was applied up to its time
        applied = thrust[min(round(float(sample["t"]) * rate) + 1, len(thrust) - 1)]
        return applied[:3], applied[3:]

    return Control(command, rate, as_applied=True)


def _compare(coarse: Run, fine: Run) -> Check:
    """Return the comparison of a run with a more accurate run of the same scene.

    The error is infinite at times that the second run did not reach.
    """
    n = min(coarse.t.size, fine.t.size)
    difference = np.abs(coarse.q[:n] - fine.q[:n])
    arm = coarse.scene.buffer.hinge_offset + coarse.scene.rest_length
    at_target = coarse.scene.cone.L_T + coarse.scene.cone.R_c
    difference *= np.array([1.0, 1.0, arm, arm, 1.0, 1.0, 1.0, at_target])
    error = np.full(coarse.t.size, np.inf)
    error[:n] = np.maximum.accumulate(difference.max(axis=1, initial=0.0))
    return Check(error, _touch_sequence(coarse) == _touch_sequence(fine), fine.failure)


def _touch_sequence(result: Run) -> list[tuple[str, int]]:
    return [
        (event.kind.label, event.wall)
        for event in result.events
        if event.kind in (EventKind.TOUCH, EventKind.LIFT_OFF)
    ]


class _Judged(NamedTuple):
    """Statuses of a run's detector, and end and energy residual of the run at ``run.rate``."""

    statuses: Statuses
    integrated: Integrated


def _judged(integration: Integration) -> _Judged:
    return _judged_as(integration, integration.statuses())


def _judged_as(integration: Integration, statuses: Statuses) -> _Judged:
    return _Judged(statuses, Integrated(integration.t_end, integration.energy_residual))


def _untraced(scene: Scene) -> Scene:
    if not scene.run.trace:
        return scene
    return _with_run(scene, replaced(scene.run, {"trace": False}))


def _with_run(scene: Scene, run: RunSettings) -> Scene:
    changed: Scene = replaced(scene, {"run": run})
    return changed


def _grid(scene: Scene, end: float) -> np.ndarray:
    """Return the sample times at ``run.state_rate`` of a run, (n,), s.

    ``end`` is the time of its last sample at ``run.rate``, s.  The run itself may end up to one
    period of ``run.rate`` later, so the times go on for one more period.
    """
    run = scene.run
    count = math.floor((end + 1.0 / run.rate) * run.state_rate) + 2
    times: np.ndarray = np.arange(count) / run.state_rate
    return times[times <= run.t_end]


def _grid_samples(scene: Scene, end: float) -> np.ndarray:
    """Integrate a run and return its samples at ``run.state_rate``; ``end`` as in :func:`_grid`."""
    return Integration(_untraced(scene)).sample(_grid(scene, end))


class GivenByIntegration(Given):
    """The data of a simulated run; samples, series and sensor readings are computed when read.

    ``samples`` are the samples that the caller asked for, and ``is_on_grid`` is True if they are at
    ``run.state_rate``.  ``judged`` has the detector's statuses.  Either may be None; a second
    integration then computes it when it is read.
    """

    def __init__(
        self,
        scene: Scene,
        bench: Bench,
        samples: np.ndarray | None,
        judged: _Judged | None,
        *,
        is_on_grid: bool,
    ) -> None:
        super().__init__(
            scene=scene,
            touches=bench.touches,
            events=bench.event_log,
            extremes=bench.extremes,
            trace=bench.trace,
            plan=bench.plan,
        )
        self._scene = scene
        self._asked_for = samples
        if samples is not None and is_on_grid:
            vars(self)["_grid"] = samples
        if judged is not None:
            vars(self)["_judged"] = judged

    @cached_property
    def samples(self) -> np.ndarray:
        """Samples at the times that the caller asked for, else at ``run.state_rate``."""
        return self._grid if self._asked_for is None else self._asked_for

    @cached_property
    def _grid(self) -> np.ndarray:
        """Samples at ``run.state_rate``, whatever times the caller asked for."""
        judged: _Judged | None = vars(self).get("_judged")
        end = self._scene.run.t_end if judged is None else judged.integrated.t_end
        return _grid_samples(self._scene, end)

    @cached_property
    def _judged(self) -> _Judged:
        (memory,) = kept.memories(1)
        return _judged(Integration(_untraced(self._scene), memory))

    @cached_property
    def statuses(self) -> Statuses | tuple[CaptureStatus, ...]:
        """Statuses of the detector of exact samples.

        They are empty if the scene has motion capture, because the detector must then evaluate the
        noisy poses.
        """
        sensors = self._scene.sensors
        is_noisy = sensors is not None and sensors.motion_capture is not None
        return () if is_noisy else self._judged.statuses

    @cached_property
    def integrated(self) -> Integrated:
        """End of the run, s, and largest residual of its energy ledger, J."""
        return self._judged.integrated

    @cached_property
    def series(self) -> SeriesBySource:
        """Series of the exact samples, and readings of the scene's sensors.

        The exact series are at the samples' times.  The sensors read the samples at
        ``run.state_rate``.
        """
        made = {
            quantity: {STATE: partial(self._made, "_exact", quantity)} for quantity in QUANTITIES
        }
        sensors = self._scene.sensors
        if sensors is not None:
            for quantity in ("stroke", "torsion", "stroke_rate", "torsion_rate"):
                made[quantity]["bench/buffer"] = partial(self._made, "_periodic", quantity)
            if sensors.motion_capture is not None:
                for name in ("chaser", "target"):
                    made[name][f"motion_capture/{name}"] = partial(self._made, "_sensed", name)
            if sensors.load_cell is not None:
                cell = partial(self._made, "_sensed", "cone_force")
                made.setdefault("cone_force", {})["load_cell/wrench"] = cell
        return {quantity: LazyMapping(sources) for quantity, sources in made.items()}

    def _made(self, name: str, quantity: str) -> Series:
        found: Series = getattr(self, name)[quantity]
        return found

    @cached_property
    def _exact(self) -> dict[str, Series]:
        return series_in(self._grid if self._asked_for is None else self._asked_for)

    @cached_property
    def _sensed(self) -> dict[str, Series]:
        return sensor_series(self._scene, self._grid)

    @cached_property
    def _periodic(self) -> dict[str, Series]:
        """Series of the exact samples at ``run.rate``, by quantity."""
        run = self._scene.run
        return series_in(self._grid[:: round(run.state_rate / run.rate)])
