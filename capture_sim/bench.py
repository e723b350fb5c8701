"""The bench: a scene in, samples and events out.

The same object serves the offline run and the simulator node; what it hands out does not
depend on how the time is cut into calls.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from capture_sim.engine import loop, notebook
from capture_sim.engine.steps import N_WATCHED
from capture_sim.errors import SceneError, SimulationError
from capture_sim.interrupts import do_apart
from capture_sim.launch.plan import LaunchPlan
from capture_sim.launch.scenes import check_scene, load_scene
from capture_sim.model.equations import MODE, N_SCRATCH, N_STATE, N_TOTAL
from capture_sim.model.parameters import pack
from capture_sim.samples import SAMPLE, TOUCH, Event, EventKind, Phase
from capture_sim.scene.parts import Scene
from capture_sim.solver.pairs import PAIRS
from capture_sim.solver.radau import make_work

#: Samples per call into the engine; large enough to make the call's own cost vanish.
BLOCK = 4096
_EVENT_ROOM = 256
_TRACE_ROOM = 1024

_CAUSES = {
    notebook.NOT_FINITE: "the state is not finite any more",
    notebook.STEP_TOO_SMALL: "the step fell below 1e-15 s: run.rtol is too small for this scene",
    notebook.TOO_MANY_STEPS: "run.max_steps integrator steps are used up",
    notebook.TIP_THROUGH_WALL: "the tip is pressed into a wall by more than 3/4 of its radius: "
    "the contact is too soft for this impact",
    notebook.PROBE_IN_HINGE: "the probe is pushed in up to its tip: the scene needs stops, "
    "or a stiffer buffer",
    notebook.STEP_TOO_LONG: "run.step is too long: the tip may leap over a wall or the latch, "
    "or the contact is not resolved",
    notebook.PILE_UP: "more than 100 events fell on one instant",
}


_AT_WALL = (EventKind.TOUCH, EventKind.LIFT_OFF, EventKind.STICK, EventKind.SLIP)
_compiled = False


def compile_kernels() -> None:
    """Load the compiled kernels, or compile them where this source has not run before.

    Takes some ten seconds the first time; called on its own it keeps that out of timings.
    """
    global _compiled
    if not _compiled:
        do_apart(_use_kernels)
        _compiled = True


def _use_kernels() -> None:
    bench = Bench(load_scene("paper_designed"))
    bench.advance(bench.times(0, 2))


class Statistics(NamedTuple):
    """What a run has cost."""

    steps: int
    rejected: int
    evaluations: int


class Bench:
    """One run of a scene, from the release on.

    Parameters
    ----------
    scene
        What is on the bench.
    plan
        How it is launched; None lets :func:`capture_sim.launch.scenes.check_scene` decide.
    trace
        Keep the contact at the integrator's own resolution, see :attr:`trace`; also where
        ``scene.run.trace`` asks for it.

    Examples
    --------
    >>> from capture_sim import Bench, load_scene
    >>> bench = Bench(load_scene("paper_designed"))
    >>> samples = bench.advance(bench.times(0, 100))
    >>> samples["q"].shape
    (100, 8)
    """

    def __init__(
        self, scene: Scene, plan: LaunchPlan | None = None, *, trace: bool = False
    ) -> None:
        self.scene = scene
        own_plan = check_scene(scene)
        self.plan = own_plan if plan is None else plan
        self._par = pack(scene, self.plan.hanging_mass, self.plan.drop_height)
        self._pair = PAIRS[scene.run.method]()
        q, v = scene.initial_coordinates()
        self._y = np.concatenate([q, v, np.zeros(N_TOTAL - 16)])
        sizes = (N_TOTAL, N_STATE, N_TOTAL, N_TOTAL, N_WATCHED, N_WATCHED)
        self._work = [np.zeros(size) for size in sizes]
        self._K = np.zeros((len(self._pair.C), N_TOTAL))
        self._F = np.zeros((self._pair.G.shape[0], N_TOTAL))
        self._scratch = np.zeros(N_SCRATCH)
        self._implicit = make_work(8, N_TOTAL)
        self._mode = np.zeros(1, MODE)
        self._run = np.zeros(1, notebook.RUN)
        self._event_room = np.zeros(_EVENT_ROOM, notebook.EVENT)
        self._trace_room = np.zeros(_TRACE_ROOM if trace or scene.run.trace else 0, SAMPLE)
        self._traced: list[np.ndarray] = []
        self._begin()
        self._touches: list[np.void] = []
        self._events: list[Event] = []
        self._unread: list[np.ndarray] = []
        self._asked = -math.inf  # last sample time asked for, s
        self._log(EventKind.RELEASE, 0.0, q, v, detail=self._describe_release())

    def _begin(self) -> None:
        run, mode, par = self._run[0], self._mode[0], self._par[0]
        run["t_stop"] = self.scene.run.t_end
        run["h_next"] = 1e-6
        run["error"] = 1e-4
        run["fresh"] = 1
        run["on_rail"] = self.scene.rail is not None
        run["taut"] = self.scene.string is not None
        run["speed"] = math.hypot(self._y[8], self._y[9]) if run["on_rail"] else 0.0
        if par["has_supports"]:
            still = not np.any(self._y[13:16])
            mode["rest_T"] = int(still and par["balls_T"][:, 2].sum() > 0.0)
            still = not np.any(self._y[8:11]) and not run["on_rail"]
            mode["rest_S"] = int(still and par["balls_S"][:, 2].sum() > 0.0)
        run["energy_0"] = loop.energy_at_release(
            self._par, self._mode, self._run, self._y, self._scratch, np.zeros(1, SAMPLE)
        )
        self._weights = 1.0 / error_scale(self._par, float(run["energy_0"]))

    def _describe_release(self) -> str:
        if self.scene.string is None:
            return "no string"
        return f"{self.plan.hanging_mass:.6g} kg from {self.plan.drop_height:.6g} m"

    @property
    def done(self) -> bool:
        """Whether the run is over."""
        return bool(self._run[0]["done"])

    @property
    def touches(self) -> np.ndarray:
        """All touches that have ended so far, (n,) of dtype TOUCH."""
        self._read_events()
        return np.array(self._touches, dtype=TOUCH)

    @property
    def trace(self) -> np.ndarray:
        """The contact so far at the ends of the integrator's steps, (n,) of dtype SAMPLE.

        Empty unless asked for.  A touch's own start, with no force yet, is an event.
        """
        if len(self._traced) != 1:
            self._traced = [np.concatenate([np.zeros(0, SAMPLE), *self._traced])]
        return self._traced[0]

    @property
    def events(self) -> list[Event]:
        """What has happened so far, in order; the same list, longer, after more of the run."""
        self._read_events()
        return self._events

    @property
    def event_count(self) -> int:
        """How many events there are so far."""
        return len(self._events) + sum(map(len, self._unread))

    @property
    def statistics(self) -> Statistics:
        """Steps taken and rejected, and evaluations of the equations of motion."""
        run = self._run[0]
        return Statistics(int(run["steps"]), int(run["rejected"]), int(run["evaluations"]))

    def times(self, first: int, count: int) -> np.ndarray:
        """Return the times (s) of ``count`` samples from number ``first`` on, up to the end."""
        rate, t_end = self.scene.run.state_rate, self.scene.run.t_end
        t: np.ndarray = np.arange(first, first + count) / rate
        return t[t <= t_end]

    def advance(self, times: np.ndarray) -> np.ndarray:
        """Run on and sample.

        Parameters
        ----------
        times
            (n,) finite, ascending, s since the release, all after the last one asked for; none
            at all runs to the end.

        Returns
        -------
        ndarray
            (m,) of dtype SAMPLE, m <= n; fewer than asked when the run is over.

        Raises
        ------
        SceneError
            The times are not so.
        SimulationError
            Names time, phase and cause; ``partial`` holds the samples up to there.
        """
        times = check_times(times, self._asked)
        if times.size:
            self._asked = float(times[-1])
        if not self.done and (times.size == 0 or times[-1] >= self.scene.run.t_end):
            # nothing lies beyond: a time that is never reached runs to the end
            times = np.append(times, np.inf)
        samples = np.zeros(times.shape[0], SAMPLE)
        served = 0
        y_new, y_stage, y_at, y_end, e_5, e_3 = self._work
        while True:
            self._run[0]["n_events"] = 0
            self._run[0]["n_trace"] = 0
            status, count = loop.advance(
                self._par,
                self._mode,
                self._run,
                tuple(self._pair),
                self._y,
                y_new,
                y_stage,
                y_at,
                y_end,
                e_5,
                e_3,
                self._K,
                self._F,
                self._weights,
                self._scratch,
                tuple(self._implicit),
                times[served:],
                samples[served:],
                self._event_room,
                self._trace_room,
            )
            served += count
            happened = int(self._run[0]["n_events"])
            if happened:
                self._unread.append(self._event_room[:happened].copy())
            traced = int(self._run[0]["n_trace"])
            if traced:
                self._traced.append(self._trace_room[:traced].copy())
            if status == notebook.EVENTS_FULL:
                continue
            if status != notebook.SERVED:
                raise self._failure(int(status), samples[:served])
            return samples[:served]

    def _failure(self, status: int, partial: np.ndarray) -> SimulationError:
        run = self._run[0]
        sample = np.zeros(1, SAMPLE)
        loop.energy_at_release(self._par, self._mode, self._run, self._y, self._scratch, sample)
        phase = Phase(int(sample[0]["phase"])).name.lower()
        return SimulationError(
            f"{self.scene.name}: stopped at t = {run['t0']:.9g} s in phase {phase}: "
            f"{_CAUSES[status]}",
            partial,
        )

    def _read_events(self) -> None:
        """Turn the loop's raw events into Python's, when somebody asks for them."""
        unread, self._unread = self._unread, []
        for raw in (event for batch in unread for event in batch):
            kind = EventKind(int(raw["kind"]))
            touch = None
            if kind is EventKind.LIFT_OFF:
                touch = raw["touch"].copy()
                self._touches.append(touch)
            wall = int(raw["wall"]) if kind in _AT_WALL else 0
            self._log(
                kind,
                float(raw["t"]),
                raw["q"].copy(),
                raw["v"].copy(),
                wall,
                _detail(kind, raw),
                touch,
            )

    def _log(
        self,
        kind: EventKind,
        t: float,
        q: np.ndarray,
        v: np.ndarray,
        wall: int = 0,
        detail: str = "",
        touch: np.void | None = None,
    ) -> None:
        self._events.append(Event(kind, t, q, v, wall, detail, touch))


def check_times(
    times: ArrayLike, after: float = -math.inf, t_end: float = sys.float_info.max
) -> np.ndarray:
    """Return sample times as an array (n,), s.

    Parameters
    ----------
    times
        s since the release.
    after, t_end
        Allowed are times after ``after`` and up to ``t_end``, s.

    Raises
    ------
    SceneError
        They are not finite, not ascending or not within the run.
    """
    try:
        t = np.ascontiguousarray(times, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise SceneError("sample times: allowed are numbers, s") from None
    if t.ndim != 1:
        raise SceneError(f"sample times of shape {t.shape}: allowed is (n,)")
    if t.size and not (after < t[0] >= 0.0 and t[-1] <= t_end and np.all(np.diff(t) > 0.0)):
        before = np.concatenate([[after], t[:-1]])
        k = int(np.argmin((t > before) & (t >= 0.0) & (t <= t_end)))
        least = f"> {before[k]:.9g}" if before[k] >= 0.0 else ">= 0"
        most = "" if t_end == sys.float_info.max else f" and <= {t_end:.9g}"
        raise SceneError(
            f"sample time number {k} = {t[k]:.9g} s: allowed is {least}{most}, finite and ascending"
        )
    return t


@dataclass(frozen=True)
class Block:
    """A piece of a run: what is new since the piece before."""

    samples: np.ndarray  # (n,) of dtype SAMPLE
    trace: np.ndarray  # (k,) of dtype SAMPLE, empty unless asked for
    failure: SimulationError | None  # why the run had to stop; then this is its last piece
    _bench: Bench
    _events: slice

    @property
    def events(self) -> list[Event]:
        """What happened in it, in order; made where it is asked for."""
        return self._bench.events[self._events]


def drive(
    bench: Bench, times: np.ndarray | None = None, *, block: int | Callable[[], int] = BLOCK
) -> Iterator[Block]:
    """Run a bench to its end piece by piece.

    Parameters
    ----------
    bench
        At its release.
    times
        (n,) ascending sample times, s; None takes the grid of ``scene.run.state_rate``.
    block
        Samples of a piece, or what is asked for them before each piece.

    Yields
    ------
    Block
        Who has seen enough leaves the loop: nothing is computed ahead.

    Examples
    --------
    Until the tip is within 10 mm of the centre of BE:

    >>> from capture_sim import Bench, load_scene
    >>> from capture_sim.bench import drive
    >>> for piece in drive(Bench(load_scene("tilt_0")), block=100):
    ...     if piece.samples["tip_distance"].min() < 0.01:
    ...         break
    """
    served = seen = traced = 0
    while not bench.done:
        size = block if isinstance(block, int) else block()
        wanted = bench.times(served, size) if times is None else times[served : served + size]
        failure = None
        try:
            samples = bench.advance(wanted)
        except SimulationError as error:
            samples, failure = error.partial, error
        served += size
        first, seen = seen, bench.event_count
        trace, traced = bench.trace[traced:], len(bench.trace)
        yield Block(samples, trace, failure, bench, slice(first, seen))
        if failure is not None:
            return


def _detail(kind: EventKind, raw: np.void) -> str:
    value = float(raw["value"])
    if kind is EventKind.LANDED:
        return f"hanging mass down, chaser at {value:.6g} m/s"
    if kind is EventKind.RAIL_END:
        return f"chaser free at {value:.6g} m/s"
    if kind is EventKind.TOUCH:
        return f"{'+y' if raw['wall'] > 0 else '-y'} wall at {value:.6g} m/s"
    if kind is EventKind.LIFT_OFF:
        return f"{'+y' if raw['wall'] > 0 else '-y'} wall after a peak of {value:.6g} N"
    if kind in (EventKind.AT_REST, EventKind.MOVING):
        return "chaser" if raw["wall"] == 1 else "target"
    if kind in (EventKind.STOP_HIT, EventKind.STOP_LEFT):
        return f"{'compressed' if raw['wall'] < 0 else 'extended'} at {value:.6g} m/s"
    if kind in (EventKind.STICK, EventKind.SLIP):
        return f"{'+y' if raw['wall'] > 0 else '-y'} wall, friction {value:.6g} N to hold"
    if kind is EventKind.LATCHED:
        return f"tip caught {value * 1e3:.6g} mm from the centre of BE"
    return ""


def error_scale(par: np.ndarray, kinetic: float = 0.0) -> np.ndarray:
    """Return the error allowed per step of each state (16,): rtol of the scene's own scale.

    The scale is a length (the tip's radius) and a speed (of the approach), not the state's
    present value: the same error counts the same wherever on the floor the bench stands.
    Angles count by what they move the tip.
    """
    p = par[0]
    arm = float(p["a"] + p["h_0"])
    length, speed = float(p["length_scale"]), float(p["speed_scale"])
    places = np.array([length, length, length / arm, length / arm, length] + [length] * 3)
    rates = np.array([speed, speed, speed / arm, speed / arm, speed] + [speed] * 3)
    places[7], rates[7] = length / float(p["L_T"] + p["R_c"]), speed / float(p["L_T"] + p["R_c"])
    energy = float(p["rtol"] * p["m_P"]) * speed**2
    # rounding of what is dissipated in all must not be taken for an error
    energies = np.full(N_WATCHED - 16, max(energy, 1e-15 * kinetic))
    scale = np.concatenate([float(p["rtol"]) * np.concatenate([places, rates]), energies])
    return scale
