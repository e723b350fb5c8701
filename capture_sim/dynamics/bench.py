"""The simulated bench: integrates a scene and returns samples and events.

The offline run and the simulator node use the same object; its results do not depend on how the
run is divided into calls.
"""

from __future__ import annotations

import functools
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from capture_sim.base.compiled.kernels import is_compiled, records
from capture_sim.base.interrupts import in_worker
from capture_sim.dynamics.engine import loop
from capture_sim.dynamics.engine.state import N_WATCHED, WORKSPACE, Status
from capture_sim.dynamics.model.contact import FRICTION_LAWS
from capture_sim.dynamics.model.equations import hold_at_rest
from capture_sim.dynamics.model.parameters import pack
from capture_sim.dynamics.model.stiffness import stiffest_part
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
from capture_sim.dynamics.solver.pairs import PAIRS
from capture_sim.dynamics.solver.runge_kutta import set_pair
from capture_sim.errors import SceneError, SimulationError
from capture_sim.scene.launch_plan import LaunchPlan
from capture_sim.scene.loading import check_scene, load_scene
from capture_sim.scene.parts import Scene

#: Samples of one call into the engine; the overhead of a call is negligible.
BLOCK = 4096
_TRACE_ROOM = 1024
_FIRST_STEP = 1e-6  # s; the step control adjusts it
_FIRST_ERROR = 1e-4  # for the step control, as there is no earlier step

#: Why the engine cannot continue, by its status.
CAUSES = {
    Status.NOT_FINITE: "the state is no longer finite",
    Status.STEP_TOO_SMALL: "the step fell below 1e-15 s",
    Status.TOO_MANY_STEPS: "run.max_steps integrator steps, rejected steps included, are used up",
    Status.TIP_THROUGH_WALL: "the tip is pressed into a wall by more than 3/4 of its radius: "
    "the contact is too soft for this impact",
    Status.PROBE_IN_HINGE: "the probe is pushed in up to its tip: the scene needs stops, "
    "or a stiffer buffer",
    Status.STEP_TOO_LONG: "run.step is too long: the tip may leap over a wall or the latch, "
    "or the contact is not resolved",
    Status.ENERGY_LOST: "run.step is too long: the energy ledger deviates by more than 2 %",
    Status.PILE_UP: "more than 100 events fell on one instant",
}

#: The workspace up to the log, which each call begins again.
_STATE_BYTES = WORKSPACE.fields["log"][1]  # type: ignore[index]

_AT_WALL = (EventKind.TOUCH, EventKind.LIFT_OFF, EventKind.STICK, EventKind.SLIP)


@functools.cache
def compile_kernels(*, announce: bool = True) -> None:
    """Load the compiled kernels; compile them first if this version is not compiled yet.

    Compiling needs about half a minute of one core, once. Call this function before measuring
    times. Unless ``announce`` is false, lines on stderr report the start and the duration.
    """

    def run_briefly() -> None:
        bench = Bench(load_scene("paper_designed"))
        bench.advance(bench.times(0, 2))

    if is_compiled() or not announce:
        in_worker(run_briefly)
        return
    print(
        "capture_sim: compiling the kernels, once for this version: about 30 s of one core",
        file=sys.stderr,
        flush=True,
    )
    start = time.perf_counter()
    in_worker(run_briefly)
    print(f"capture_sim: compiled in {time.perf_counter() - start:.0f} s", file=sys.stderr)


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


class Memory:
    """Memory of one run at a time; a later run can have it again, as new memory costs time.

    ``samples`` (n,) of dtype SAMPLE is room for the samples of a call, which the next call
    overwrites: runs of a study that are integrated one after the other share it.  None for new room
    in each call.
    """

    def __init__(self, samples: np.ndarray | None = None) -> None:
        self.workspace = np.zeros(1, WORKSPACE)
        self._samples = np.empty(0, SAMPLE) if samples is None else samples

    def samples(self, count: int) -> np.ndarray:
        """Return room for samples, (count,) of dtype SAMPLE."""
        return self._samples[:count] if count <= self._samples.size else np.empty(count, SAMPLE)


@functools.lru_cache(maxsize=len(PAIRS))
def _first_state(method: str) -> np.ndarray:
    """Return the bytes of a workspace up to its log, with what all runs of a method begin with."""
    workspace = np.zeros(1, WORKSPACE)
    set_pair(workspace[0]["stepper"], PAIRS[method]())
    step = workspace[0]["step"]
    step["h_next"], step["error"] = _FIRST_STEP, _FIRST_ERROR
    step["equations_changed"] = 1
    return workspace.view(np.uint8)[:_STATE_BYTES]


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
        True to keep the contact at the integrator's own steps, see :attr:`trace`;
        ``scene.run.trace`` does the same.
    memory
        Memory for this bench alone as long as it is used; its space for samples may be shared.
        None for new memory.

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
        self._workspace.view(np.uint8)[:_STATE_BYTES] = _first_state(scene.run.method)
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
        detail = "no string"
        if scene.string is not None:
            detail = f"{self.plan.hanging_mass:.6g} kg from {self.plan.drop_height:.6g} m"
        self._events = [Event(EventKind.RELEASE, 0.0, q, v, detail=detail)]

    def _begin(self, par: np.void) -> None:
        """Write what holds the bench at the release; ``par`` is of dtype PARAMETERS."""
        scene, rail, mode = self.scene, self._record["rail"], self._system["mode"]
        chaser, target = scene.initial.chaser, scene.initial.target
        self._record["progress"]["t_stop"] = scene.run.t_end
        mode["held"] = hold_at_rest(par)
        if scene.rail is not None:
            rail["on"], rail["taut"] = 1, scene.string is not None
            rail["speed"] = math.hypot(chaser.vx, chaser.vy)
        if scene.supports is not None:
            if not (target.vx or target.vy or target.omega):
                mode["rest_T"] = par["balls_T"][:, 2].any()
            if scene.rail is None and not (chaser.vx or chaser.vy or chaser.omega):
                mode["rest_S"] = par["balls_S"][:, 2].any()

    def initial_workspace(self) -> np.ndarray:
        """Return a copy of the engine's record, (1,) of dtype WORKSPACE.

        It is the state at the release if the run has not advanced yet, for programs without Python.
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

        Empty without ``trace``.  The start of a touch, where the force is 0, is an event.
        """
        return self.trace_since(0)

    def trace_since(self, piece: int) -> np.ndarray:
        """Return the trace from a piece on, (n,) of dtype SAMPLE; see :attr:`trace_pieces`."""
        pieces = self._traced[piece:]
        return joined(pieces) if pieces else np.zeros(0, SAMPLE)

    @property
    def trace_pieces(self) -> int:
        """Number of pieces of the trace so far."""
        return len(self._traced)

    @property
    def events(self) -> list[Event]:
        """Events so far, in order; the list grows as the run advances."""
        self._read_events()
        return self._events

    def times_of(self, kind: EventKind) -> np.ndarray:
        """Return the times of the events of a kind so far, (n,), s, without creating the events."""
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
        """Return the times, s, of ``count`` samples from number ``first``, up to the end."""
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
            The integration stopped early; the message names time, phase and cause, and ``partial``
            has the samples up to then.  Every later call raises it again, without samples.
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
        """Run from the release to the end; as :meth:`advance`, for many runs with the same times.

        ``times`` are those of :func:`to_the_end`, and ascend from 0 or later; this is not checked.
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
            n_events, n_trace = int(progress["n_log"]), int(progress["n_trace"])
            if n_events:
                self._unread.append(joined([self._record["log"][:n_events]]))
            if n_trace:
                self._traced.append(self._trace_room[:n_trace].copy())
            if progress["status"] == Status.SERVED:
                return samples[:served]
            if progress["status"] != Status.INTERRUPTED:
                raise self._failure(Status(int(progress["status"])), samples[:served])

    def start_at(self, q: np.ndarray, v: np.ndarray) -> None:
        """Begin at rates ``v`` (8,) in coordinates ``q`` (8,), free of rail and string.

        Call this before the first :meth:`advance`.
        """
        par, rail = self._system["par"], self._record["rail"]
        self._record["stepper"]["y"][:16] = *q, *v
        par["m_hanging"] = par["drop_height"] = 0.0
        rail["on"] = rail["taut"] = 0
        rail["speed"] = 0.0

    def drive_tip(self, wrench: Sequence[float], until: float) -> None:
        """Apply a wrench to the tip, about its centre, and pause the run at a time (s).

        ``wrench``: force (N) in the target's axes and torque (N m).  It acts until the latch
        closes.  ``advance([until])`` goes up to the pause; then call this method again.
        """
        mode, step = self._system["mode"], self._record["step"]
        mode["driven"], mode["wrench"] = 1, wrench
        step["equations_changed"] = 1
        self._record["progress"]["t_stop"] = until

    def set_contact(
        self, stiffness: float, exponent: float, chi: float, offset: float, mu: float, v_eps: float
    ) -> None:
        """Replace the contact of both walls by F = delta^exponent (stiffness + chi delta').

        ``offset`` (m) moves the walls towards the tip, which must not touch them now.  ``mu`` and
        ``v_eps`` (m/s) are parameters of the friction law "tanh".  Without stiffness nothing acts.
        """
        par = self._system["par"]
        par["K"], par["exponent"], par["chi"], par["hysteresis"] = stiffness, exponent, chi, 0.0
        par["R_t"] = self.scene.probe.tip_radius + offset  # the same gap
        par["mu"], par["inverse_v_eps"] = mu, 1.0 / v_eps
        par["friction_law"] = FRICTION_LAWS["tanh"]
        self._record["step"]["start_measured"] = 0

    def saved(self) -> Checkpoint:
        """Return the state, for :meth:`restore` of this bench or of another one of this scene."""
        record = self._workspace.view(np.uint8)[:_STATE_BYTES].copy()
        return Checkpoint(record, len(self._unread), self._last_time)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go back to a saved state; events since then that were not read are forgotten."""
        self._workspace.view(np.uint8)[:_STATE_BYTES] = checkpoint.record
        del self._unread[checkpoint.n_unread :]
        self._last_time, self._fatal = checkpoint.last_time, None

    def _failure(self, status: Status, partial: np.ndarray) -> SimulationError:
        phase = Phase(int(self._record["sample"]["phase"])).name.lower()
        cause = CAUSES[status]
        if status in (Status.STEP_TOO_SMALL, Status.TOO_MANY_STEPS):
            step, touch = self._record["step"], self._system["mode"]["touch"]
            stiffest = stiffest_part(
                self._system["par"],
                penetration=-float(step["start"]["gap"][:2].min()),
                chi=float(touch["chi"].max()),
                force=float(self._system["out"]["normal"].max()),
                y=self._record["stepper"]["y"],
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
        for batch in unread:
            columns = (batch[name].tolist() for name in ("kind", "t", "which", "value"))
            for number, (code, t, which, value) in enumerate(zip(*columns, strict=True)):
                kind, touch = EventKind(code), None
                if kind is EventKind.LIFT_OFF:
                    touch = batch["touch"][number]
                    self._touches.append(touch)
                q, v = batch["q"][number], batch["v"][number]
                wall, detail = which if kind in _AT_WALL else 0, _detail(kind, which, value)
                self._events.append(Event(kind, t, q, v, wall, detail, touch))


def joined(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Return a copy of arrays of records of one type, one after the other."""
    # as bytes: field by field, NumPy needs eight times as long
    raw = [np.ascontiguousarray(part).view(f"V{part.itemsize}") for part in parts]
    return np.concatenate(raw).view(parts[0].dtype)


def to_the_end(times: np.ndarray) -> np.ndarray:
    """Return sample times (n,) and one more, that no run reaches, (n + 1,): up to it a run ends."""
    return np.append(times, np.inf)


def check_times(
    times: ArrayLike, after: float = -math.inf, t_end: float = sys.float_info.max
) -> np.ndarray:
    """Return sample times, s since the release, as an array (n,).

    SceneError if they are not finite and ascending, greater than ``after`` and at most ``t_end``.
    """
    try:
        t = np.ascontiguousarray(times, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise SceneError("sample times: must be numbers, s") from None
    if t.ndim != 1:
        raise SceneError(f"sample times of shape {t.shape}: must be (n,)")
    if t.size and not (after < t[0] >= 0.0 and t[-1] <= t_end and (t[1:] > t[:-1]).all()):
        before = np.concatenate([[after], t[:-1]])
        k = int(np.argmin((t > before) & (t >= 0.0) & (t <= t_end)))
        lower_text = f"> {before[k]:.9g}" if before[k] >= 0.0 else ">= 0"
        upper_text = "" if t_end == sys.float_info.max else f" and <= {t_end:.9g}"
        raise SceneError(
            f"sample time number {k} = {t[k]:.9g} s: must be {lower_text}{upper_text}, finite and "
            "ascending"
        )
    return t


@dataclass(frozen=True)
class Block:
    """One piece of a run: the samples, trace and events since the piece before."""

    samples: np.ndarray  # (n,) of dtype SAMPLE
    trace: np.ndarray  # (k,) of dtype SAMPLE, empty without trace
    failure: SimulationError | None  # if the run stopped early, in its last piece
    _bench: Bench
    _events: slice

    @property
    def events(self) -> list[Event]:
        """Events of the piece, in order."""
        return self._bench.events[self._events]


def drive(
    bench: Bench, times: np.ndarray | None = None, *, block: int | Callable[[], int] = BLOCK
) -> Iterator[Block]:
    """Run a bench to its end piece by piece.

    Parameters
    ----------
    bench
        Bench at its release.
    times
        (n,) ascending sample times, s; None for the grid of ``scene.run.state_rate``.
    block
        Number of samples of a piece, or a function that returns it before each piece.

    Yields
    ------
    Block
        The next piece.  Nothing is computed ahead, so you can leave the loop at any piece.

    Examples
    --------
    Until the tip is within 10 mm of the centre of BE:

    >>> from capture_sim import Bench, load_scene
    >>> from capture_sim.dynamics.bench import drive
    >>> for piece in drive(Bench(load_scene("tilt_0")), block=100):
    ...     if piece.samples["tip_distance"].min() < 0.01:
    ...         break
    """
    n_samples = n_events = n_trace = 0
    while not bench.done:
        size = block if isinstance(block, int) else block()
        piece_times = (
            bench.times(n_samples, size) if times is None else times[n_samples : n_samples + size]
        )
        failure = None
        try:
            samples = bench.advance(piece_times)
        except SimulationError as error:
            samples, failure = error.partial, error
        n_samples += size
        events = slice(n_events, bench.event_count)
        n_events = bench.event_count
        trace, n_trace = bench.trace_since(n_trace), bench.trace_pieces
        yield Block(samples, trace, failure, bench, events)
        if failure is not None:
            return


def _detail(kind: EventKind, which: int, value: float) -> str:
    """Return an event in words; ``which`` is its wall, vehicle or stop."""
    wall = "+y wall" if which > 0 else "-y wall"
    stop = "compressed" if which < 0 else "extended"
    if kind is EventKind.LANDED:
        return f"hanging mass down, chaser at {value:.6g} m/s"
    if kind is EventKind.RAIL_END:
        return f"chaser free at {value:.6g} m/s"
    if kind is EventKind.TOUCH:
        return f"{wall} at {value:.6g} m/s"
    if kind is EventKind.LIFT_OFF:
        return f"{wall} after a peak of {value:.6g} N"
    if kind in (EventKind.AT_REST, EventKind.MOVING):
        return "chaser" if which == 1 else "target"
    if kind in (EventKind.STOP_HIT, EventKind.STOP_LEFT):
        return f"{stop} at {value:.6g} m/s"
    if kind is EventKind.SEATED:
        return f"probe back on its seat at {value:.6g} m/s"
    if kind is EventKind.UNSEATED:
        return f"probe leaves its seat at {value:.6g} N"
    if kind is EventKind.SLIP and math.isinf(value):
        return f"{wall}, after the impact on the seat"
    if kind in (EventKind.STICK, EventKind.SLIP):
        place = wall if which else "probe in its slide"
        return f"{place}, friction {value:.6g} N to hold"
    if kind is EventKind.LATCHED:
        return f"tip caught {value * 1e3:.6g} mm from the centre of BE"
    return ""


def error_scale(par: np.void) -> np.ndarray:
    """Return the permitted error per step of each coordinate and rate: rtol times its scale.

    The scale is a length (the tip's radius) and a speed (of the approach), not the state's
    present value, so the weight of an error does not depend on the bench's place on the floor.
    An angle counts by the displacement that it causes at the tip.  ``par`` is of dtype PARAMETERS.
    """
    arm, at_target = float(par["a"] + par["h_0"]), float(par["L_T"] + par["R_c"])
    levers = (1.0, 1.0, arm, arm, 1.0, 1.0, 1.0, at_target)
    rtol, speed, length = float(par["rtol"]), float(par["speed_scale"]), float(par["length_scale"])
    lengths = [rtol * (length / lever) for lever in levers]
    speeds = [rtol * (speed / lever) for lever in levers]
    energy = rtol * float(par["m_P"]) * speed**2
    return np.array([*lengths, *speeds, *(N_WATCHED - 16) * [energy]])
