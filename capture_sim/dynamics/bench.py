"""The simulated bench: integrates a scene and returns samples and events.

The offline run and the simulator node both use :class:`Bench`.  Its results do not depend on how
the run is divided into calls.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from capture_sim.base.compiled.kernels import records
from capture_sim.dynamics.engine import loop
from capture_sim.dynamics.engine.state import EVENT, Segment, StepStatus
from capture_sim.dynamics.engine.step_length import error_scale
from capture_sim.dynamics.event_log import EventLog, events_in
from capture_sim.dynamics.memory import STATE_BYTES, Memory, first_state, joined
from capture_sim.dynamics.model.contact import power_law
from capture_sim.dynamics.model.equations import hold_at_rest
from capture_sim.dynamics.model.parameters import pack
from capture_sim.dynamics.model.stiffness import stiffest_part
from capture_sim.dynamics.sample_times import check_times, to_the_end
from capture_sim.dynamics.samples import (
    EXTREME_NAMES,
    EXTREMES,
    SAMPLE,
    TOUCH,
    Event,
    EventKind,
    Extremes,
    Phase,
)
from capture_sim.errors import SceneError, SimulationError
from capture_sim.scene.launch_plan import LaunchPlan
from capture_sim.scene.laws import FrictionLaw
from capture_sim.scene.loading import check_scene
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import refuse, shown

#: Capacity of the trace buffer, samples per call into the engine; a full buffer costs a further
#: call.
_TRACE_ROOM = 1024

#: Reason why the engine cannot continue, for each status.
CAUSES = {
    StepStatus.NOT_FINITE: "the state is no longer finite",
    StepStatus.STEP_TOO_SMALL: "the step fell below 1e-15 s",
    StepStatus.TOO_MANY_STEPS: "run.max_steps integrator steps, rejected steps included, are used "
    "up",
    StepStatus.TIP_THROUGH_WALL: "the tip is pressed into a wall by more than 3/4 of its radius: "
    "the contact is too soft for this impact",
    StepStatus.PROBE_IN_HINGE: "the probe is pushed in up to its tip: the scene needs stops, "
    "or a stiffer buffer",
    StepStatus.STEP_TOO_LONG: "run.step is too long: the tip may leap over a wall or the latch, "
    "or the contact is not resolved",
    StepStatus.ENERGY_LOST: "run.step is too long: the energy ledger deviates by more than 2 %",
    StepStatus.PILE_UP: "more than 100 events fell on one instant",
}


class Statistics(NamedTuple):
    """Number of steps, rejected steps and evaluations of the equations of motion."""

    steps: int
    rejected: int
    evaluations: int


class Checkpoint(NamedTuple):
    """State of a bench, for :meth:`Bench.restore`."""

    record: np.ndarray
    n_unread: int
    last_time: float


#: Empty trace buffer, for a bench without trace.
_NO_TRACE = np.zeros(0, SAMPLE)


class Bench:
    """One run of a scene, starting at the release.

    Parameters
    ----------
    scene
        Scene of the run.
    plan
        Launch plan; None for the plan of :func:`capture_sim.scene.loading.check_scene`.
    trace
        True to record a sample of the contact at each integrator step, see :attr:`trace`;
        ``scene.run.trace`` has the same effect.
    memory
        Memory to reuse; None for new memory.  No other bench may use it at the same time, but its
        space for samples may be shared.

    See Also
    --------
    capture_sim.simulate : A whole run with detector, loads and summary.
    capture_sim.drive : The samples of a bench piece by piece.

    Examples
    --------
    >>> from capture_sim import Bench, load_scene
    >>> bench = Bench(load_scene("paper_designed"))
    >>> samples = bench.advance(bench.times(0, 100))
    >>> samples["q"].shape
    (100, 8)
    """

    def __init__(
        self,
        scene: Scene,
        plan: LaunchPlan | None = None,
        *,
        trace: bool = False,
        memory: Memory | None = None,
    ) -> None:
        self.scene = scene
        own_plan = check_scene(scene)
        self.plan = own_plan if plan is None else plan
        self._memory = Memory() if memory is None else memory
        self._workspace = self._memory.workspace
        self._workspace.view(np.uint8)[:STATE_BYTES] = first_state(scene.run.method)
        self._record = w = self._workspace[0]
        self._system, stepper = w["system"], w["stepper"]
        launch = self.plan.hanging_mass, self.plan.drop_height, self.plan.impact_speed
        par = pack(scene, *launch)[0]
        self._system["par"] = par
        q, v = scene.initial_coordinates()
        y = stepper["y"]
        y[:8], y[8:16] = q, v
        stepper["weights"] = 1.0 / error_scale(par)
        has_trace = trace or scene.run.trace
        self._trace_room = np.zeros(_TRACE_ROOM, SAMPLE) if has_trace else _NO_TRACE
        self._traced: list[np.ndarray] = []
        self._begin(par)
        self._touches: list[np.void] = []
        self._unread: list[np.ndarray] = []
        self._last_time = -math.inf  # last requested sample time, s
        self._fatal: str | None = None  # reason why the run cannot continue
        self._stepping: _Stepping | None = None
        detail = "no string"
        if scene.string is not None:
            detail = f"{self.plan.hanging_mass:.6g} kg from {self.plan.drop_height:.6g} m"
        self._events = [Event(EventKind.RELEASE, 0.0, q, v, detail=detail)]

    def _begin(self, par: np.void) -> None:
        """Write the state of rail, probe and supports at the release, and the end of the run.

        ``par`` is of dtype PARAMETERS.
        """
        scene, rail, mode = self.scene, self._record["rail"], self._system["mode"]
        chaser, target = scene.initial.chaser, scene.initial.target
        progress = self._record["progress"]
        progress["t_stop"] = progress["t_end"] = scene.run.t_end
        mode["held"], mode["thrusting"] = hold_at_rest(par), scene.thrusters is not None
        if scene.rail is not None:
            rail["on"], rail["taut"] = 1, scene.string is not None
            rail["speed"] = math.hypot(chaser.vx, chaser.vy)
        if scene.supports is not None:
            mode["rest_T"] = par["balls_T"][2].any() and not target.moves
            is_free = scene.rail is None
            mode["rest_S"] = is_free and par["balls_S"][2].any() and not chaser.moves

    def initial_workspace(self) -> np.ndarray:
        """Return a copy of the engine's record, (1,) of dtype WORKSPACE.

        Before the first :meth:`advance`, the record is the state at the release.  A program
        without Python can start a run from it.
        """
        return self._workspace.copy()

    @property
    def done(self) -> bool:
        """True if the run has ended."""
        return bool(self._record["progress"]["done"])

    @property
    def touches(self) -> np.ndarray:
        """All touches that have ended so far, (n,) of dtype TOUCH."""
        lift_off = int(EventKind.LIFT_OFF)  # NumPy is slow with an IntEnum
        ended = [raw["touch"][raw["kind"] == lift_off] for raw in self._unread]
        if len(ended) == 1 and not self._touches:
            return ended[0]
        return joined([np.array(self._touches, dtype=TOUCH), *ended])

    @property
    def trace(self) -> np.ndarray:
        """Samples of the contact so far, one per integrator step, (n,) of dtype SAMPLE.

        Empty if the bench was created without ``trace``.  The start of a touch, where the force is
        0, is not in the trace; it is in :attr:`events`.
        """
        return self.trace_since(0)

    def trace_since(self, piece: int) -> np.ndarray:
        """Return the trace from piece number ``piece`` onwards, (n,) of dtype SAMPLE.

        :attr:`trace_pieces` is the number of pieces so far.
        """
        pieces = self._traced[piece:]
        return joined(pieces) if pieces else np.zeros(0, SAMPLE)

    @property
    def trace_pieces(self) -> int:
        """Number of pieces of the trace so far; each call into the engine may add one."""
        return len(self._traced)

    @property
    def events(self) -> list[Event]:
        """Events so far, in order; the list grows as the run advances."""
        self._read_events()
        return self._events

    @property
    def event_log(self) -> EventLog:
        """Events so far, as a log that creates each event object when it is read."""
        return EventLog(self._events, self._unread)

    def times_of(self, kind: EventKind) -> np.ndarray:
        """Return the times of all events of a kind so far, (n,), s; creates no event objects."""
        read = [event.t for event in self._events if event.kind is kind]
        return np.concatenate([read, *(raw["t"][raw["kind"] == int(kind)] for raw in self._unread)])

    @property
    def event_count(self) -> int:
        """Number of events so far."""
        return len(self._events) + sum(map(len, self._unread))

    @property
    def statistics(self) -> Statistics:
        """Steps taken and rejected, and evaluations of the equations of motion."""
        totals = self._record["totals"]
        evaluations = int(self._system["evaluations"])
        return Statistics(int(totals["steps"]), int(totals["rejected"]), evaluations)

    @property
    def extremes(self) -> Extremes:
        """Peak strokes, torsion, penetrations and forces and the closest approach so far.

        Before the end of the run, they cover the time up to the start of the current step.
        """
        totals = self._record["totals"]
        values = np.empty((2, len(EXTREME_NAMES), 2))
        values[..., 0], values[..., 1] = np.abs(totals["extreme"]), totals["extreme_time"]
        before, after = values.reshape(2, -1).view(EXTREMES)[:, 0]
        return Extremes(before, after if self._system["mode"]["latched"] else None)

    def times(self, first: int, count: int) -> np.ndarray:
        """Return the times, s, of ``count`` samples from sample number ``first``.

        Times after the end of the run are left out.
        """
        rate, t_end = self.scene.run.state_rate, self.scene.run.t_end
        t: np.ndarray = np.arange(first, first + count) / rate
        return t[t <= t_end]

    def advance(self, times: np.ndarray) -> np.ndarray:
        """Continue the run and return samples.

        Parameters
        ----------
        times
            (n,) sample times, s since the release: finite, ascending, and after those of earlier
            calls.  An empty array runs to the end.

        Returns
        -------
        ndarray
            (m,) of dtype SAMPLE, m <= n; m < n if the run ends before the last time.

        Raises
        ------
        SceneError
            The times break one of these rules.
        SimulationError
            The integration stopped early.  The message names time, phase and cause, and
            ``partial`` has the samples up to then.  Every later call raises the same message,
            without samples.
        """
        times = check_times(times, self._last_time)
        if self._fatal is not None:
            raise SimulationError(self._fatal, np.zeros(0, SAMPLE))
        if times.size:
            self._last_time = float(times[-1])
        t_stop = float(self._record["progress"]["t_stop"])
        if not self.done and (times.size == 0 or times[-1] >= t_stop):
            times = to_the_end(times)
        return self._advance(times)

    def finish(self, times: np.ndarray) -> np.ndarray:
        """Run from the release to the end and return the samples, as :meth:`advance` does.

        For many runs with the same times: the times are not checked.  ``times`` must be a result of
        :func:`to_the_end`, ascending from 0 or later.
        """
        self._last_time = math.inf
        return self._advance(times)

    def _advance(self, times: np.ndarray) -> np.ndarray:
        samples = self._memory.samples(times.shape[0])  # only samples[:served] are returned
        workspace, trace = records(self._workspace), records(self._trace_room)
        progress = self._record["progress"]
        served = 0
        while True:
            progress["n_log"] = progress["n_trace"] = 0
            served += loop.advance(workspace, times[served:], records(samples[served:]), trace)
            status = StepStatus(int(progress["status"]))
            self._keep_log(status, samples[:served])
            if status is StepStatus.SERVED:
                return samples[:served]

    def _keep_log(self, status: StepStatus, samples: np.ndarray) -> None:
        """Keep the events and the trace of a call into the engine.

        SimulationError, with ``samples``, if the engine cannot continue.
        """
        progress = self._record["progress"]
        n_events, n_trace = int(progress["n_log"]), int(progress["n_trace"])
        if n_events:
            self._unread.append(joined([self._record["log"][:n_events]]))
        if n_trace:
            self._traced.append(self._trace_room[:n_trace].copy())
        if status not in (StepStatus.SERVED, StepStatus.INTERRUPTED):
            raise self._failure(status, samples)

    def start_at(self, q: np.ndarray, v: np.ndarray) -> None:
        """Start from coordinates ``q`` (8,) and rates ``v`` (8,), without rail and string.

        Call this before the first :meth:`advance`.
        """
        par, rail, mode = self._system["par"], self._record["rail"], self._system["mode"]
        self._record["stepper"]["y"][:16] = *q, *v
        mode["rest_S"] = par["balls_S"][2].any() and not np.any(v[:3])
        mode["rest_T"] = par["balls_T"][2].any() and not np.any(v[5:])
        par["m_hanging"] = par["drop_height"] = 0.0
        rail["on"] = rail["taut"] = 0
        rail["speed"] = 0.0

    def drive_tip(self, wrench: Sequence[float], until: float) -> None:
        """Apply a wrench at the tip's centre, and pause the run at the time ``until`` (s).

        ``wrench``: force (N, N) in the target's axes and torque (N m).  It acts until the latch
        closes.  ``advance([until])`` runs up to the pause; then call this method again.
        """
        mode, step = self._system["mode"], self._record["step"]
        mode["driven"], mode["wrench"] = 1, wrench
        step["equations_changed"] = 1
        self._record["progress"]["t_stop"] = until

    def thrust(
        self,
        chaser: Sequence[float],
        target: Sequence[float],
        until: float,
        *,
        timeouts: Sequence[float] = (0.0, 0.0),
    ) -> None:
        """Hold a wrench on each vehicle, and pause the run at the time ``until`` (s).

        ``chaser`` and ``target``: force (N, N) and moment (N m) in the vehicle's own axes, at its
        centre of mass.  ``advance`` runs at most up to the pause; then call this method again.
        ``timeouts`` (s), for chaser and target: the timeout that ended the vehicle's wrench, else
        0.  The event at the end of the wrench reports this timeout.

        Raises
        ------
        SceneError
            A number is not finite, the chaser is on its rail, the run is neither at its release
            nor at a pause, or ``until`` is not after the present time.
        """
        mode, step = self._system["mode"], self._record["step"]
        wrench = np.array([*chaser, *target], dtype=float)
        if not (len(chaser) == len(target) == 3 and np.isfinite(wrench).all()):
            said = [shown(value) for value in (*chaser, *target)]
            allowed = "three finite numbers each, N, N and N m, of chaser and target"
            raise SceneError(f"thrust = {', '.join(said)}: must be {allowed}")
        if self.is_on_rail:
            raise SceneError("thrust: must begin where the chaser has left its rail")
        if step["segment"] != Segment.NONE:
            raise SceneError("thrust: must begin at the release, or at a pause")
        if not until > step["t0"]:
            raise refuse("until", until, "s", f"> {step['t0']:.9g}, the present time")
        self._log_thrust(wrench, timeouts)
        if not np.array_equal(mode["thrust"], wrench) or not mode["thrusting"]:
            mode["thrusting"], mode["thrust"] = 1, wrench
            step["equations_changed"] = 1
        self.pause_at(until)

    def step(self, chaser: Sequence[float], target: Sequence[float], duration: float) -> np.void:
        """Hold a wrench on each vehicle for a duration (s), and return the sample at its end.

        For loops: as :meth:`thrust` and :meth:`advance` in one call, at a quarter of their cost.
        On the rail, or without thrusters, nothing acts.  At the end of the run the sample is that
        of the end, and a later call returns it again.

        Returns
        -------
        numpy.void
            Of dtype SAMPLE.  The next call writes into it: copy what you keep.

        Raises
        ------
        SceneError
            As :meth:`thrust`; or the duration is not above 0.
        SimulationError
            As :meth:`advance`.

        Examples
        --------
        >>> from capture_sim import Bench, load_scene
        >>> thrusters = {"chaser": {"force": "2 N", "torque": "0.2 N m"}}
        >>> bench = Bench(load_scene("paper_designed", {"thrusters": thrusters}))
        >>> while not bench.done:
        ...     sample = bench.step((0.5, 0.0, 0.0), (0.0, 0.0, 0.0), 0.01)
        >>> round(float(sample["t"]), 6) == bench.scene.run.t_end
        True
        """
        if self._fatal is not None:
            raise SimulationError(self._fatal, np.zeros(0, SAMPLE))
        if self._stepping is None:
            self._stepping = _Stepping(self)
        return self._stepping.step(chaser, target, duration)

    def pause_at(self, t: float) -> None:
        """Pause the run at a time (s), or at its end if that is earlier."""
        progress = self._record["progress"]
        progress["t_stop"] = min(t, progress["t_end"])

    @property
    def is_on_rail(self) -> bool:
        """True while the chaser is on its rail, where thrust is not permitted."""
        return bool(self._record["rail"]["on"])

    @property
    def t(self) -> float:
        """Time up to which the run has been integrated, s; at a pause, the time of the pause."""
        return float(self._record["step"]["t0"])

    def _log_thrust(self, wrench: np.ndarray, timeouts: Sequence[float]) -> None:
        """Log an event for each vehicle whose thrust begins or ends."""
        before, y = self._system["mode"]["thrust"], self._record["stepper"]["y"]
        for vehicle, timeout in enumerate(timeouts):
            own = slice(3 * vehicle, 3 * vehicle + 3)
            is_on = wrench[own].any()
            if is_on == before[own].any():
                continue
            event = np.zeros(1, EVENT)
            event["kind"] = EventKind.THRUST_ON if is_on else EventKind.THRUST_OFF
            event["t"], event["which"], event["value"] = self.t, vehicle + 1, timeout
            event["q"], event["v"] = y[:8], y[8:16]
            self._unread.append(event)

    def set_contact(
        self, stiffness: float, exponent: float, chi: float, offset: float, mu: float, v_eps: float
    ) -> None:
        """Replace the contact of both walls by F = delta^exponent (stiffness + chi delta').

        ``offset`` (m) moves the walls towards the tip, which must not touch a wall at this time.
        ``mu`` and ``v_eps`` (m/s) are parameters of the friction law "tanh".  With a ``stiffness``
        of 0 the walls do not act.
        """
        par = self._system["par"]
        par["contact"], par["chi"], par["hysteresis"] = power_law(stiffness, exponent)[0], chi, 0.0
        par["R_t"] = self.scene.probe.tip_radius + offset  # a larger tip: the gap is the same
        par["mu"], par["inverse_v_eps"] = mu, 1.0 / v_eps
        par["friction_law"] = FrictionLaw.TANH
        self._record["step"]["start_measured"] = 0

    def saved(self) -> Checkpoint:
        """Return the state, for :meth:`restore` of this bench or of another bench of this scene."""
        record = self._workspace.view(np.uint8)[:STATE_BYTES].copy()
        return Checkpoint(record, len(self._unread), self._last_time)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Return to a saved state; discard events since then that have not been read."""
        self._workspace.view(np.uint8)[:STATE_BYTES] = checkpoint.record
        del self._unread[checkpoint.n_unread :]
        self._last_time, self._fatal = checkpoint.last_time, None

    def _failure(self, status: StepStatus, partial: np.ndarray) -> SimulationError:
        phase = Phase(int(self._record["sample"]["phase"])).name.lower()
        cause = CAUSES[status]
        if status in (StepStatus.STEP_TOO_SMALL, StepStatus.TOO_MANY_STEPS):
            step, touch = self._record["step"], self._system["mode"]["touch"]
            stiffest = stiffest_part(
                self._system["par"],
                penetration=-float(step["start"]["gap"][:2].min()),
                chi=float(touch["chi"].max()),
                force=float(self._system["out"]["normal"].max()),
                y=self._record["stepper"]["y"],
                given_stiffness=self.scene.contact.stiffness is not None,
            )
            if stiffest is not None:
                part, duration = stiffest
                cause += f"; stiffest is the {part}, with a time of {duration:.2g} s"
        t = self._record["step"]["t0"]
        self._fatal = f"{self.scene.name}: stopped at t = {t:.9g} s in phase {phase}: {cause}"
        return SimulationError(self._fatal, partial)

    def _read_events(self) -> None:
        """Convert the raw events of the engine to Python objects."""
        unread, self._unread = self._unread, []
        for log in unread:
            for event in events_in(log):
                if event.touch is not None:
                    self._touches.append(event.touch)
                self._events.append(event)


class _Stepping:
    """What :meth:`Bench.step` reuses from call to call: views of the engine's record, a sample.

    NumPy is slow with the fields of a record, and fast with items of arrays of one number.
    """

    def __init__(self, bench: Bench) -> None:
        workspace = bench._workspace
        progress, step, mode = workspace["progress"], workspace["step"], workspace["system"]["mode"]
        self._bench = bench
        self._times, self._samples = to_the_end(np.zeros(1)).copy(), np.zeros(2, SAMPLE)
        self._arguments = (
            *(records(workspace), self._times, records(self._samples)),
            records(bench._trace_room),
        )
        self._n_log, self._n_trace = progress["n_log"], progress["n_trace"]
        self._status, self._done, self._t_stop = (
            progress[name] for name in ("status", "done", "t_stop")
        )
        self._t_end, self._t0 = float(progress["t_end"][0]), step["t0"]
        self._changed, self._on_rail = step["equations_changed"], workspace["rail"]["on"]
        self._thrusting, self._thrust = mode["thrusting"], mode["thrust"][0]
        self._held: tuple[float, ...] | None = None  # wrench of the step before

    def step(self, chaser: Sequence[float], target: Sequence[float], duration: float) -> np.void:
        """See :meth:`Bench.step`."""
        bench, times = self._bench, self._times
        if self._done[0]:
            return self._samples[0]
        now = self._t0.item()
        until = min(round(now + duration, 12), self._t_end)
        if not until > now:
            raise refuse("duration", duration, "s", "> 0")
        wrench = (*chaser, *target)
        if wrench != self._held and not self._on_rail[0]:
            self._hold(chaser, target, until)
            self._held = wrench
        self._t_stop[0] = bench._last_time = times[0] = until
        while True:
            self._n_log[0] = self._n_trace[0] = 0
            loop.advance(*self._arguments)
            status = self._status.item()
            if self._n_log[0] or self._n_trace[0] or status != _SERVED:
                bench._keep_log(StepStatus(status), self._samples[:0])
            if status == _SERVED:
                return self._samples[0]

    def _hold(self, chaser: Sequence[float], target: Sequence[float], until: float) -> None:
        """Let a wrench act on each vehicle from now on."""
        held, wrench = self._held, (*chaser, *target)
        if (
            held is None
            or not (len(chaser) == len(target) == 3 and all(map(math.isfinite, wrench)))
            or (any(chaser), any(target)) != (any(held[:3]), any(held[3:]))
        ):
            self._bench.thrust(chaser, target, until)  # with its checks and events
        else:
            self._thrust[:] = wrench
            self._changed[0] = 1


_SERVED = int(StepStatus.SERVED)
