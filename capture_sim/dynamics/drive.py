"""Run a bench to its end, piece by piece, with or without a controller of its thrusters."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from capture_sim.dynamics.bench import Bench
from capture_sim.dynamics.memory import joined
from capture_sim.dynamics.samples import SAMPLE, Event
from capture_sim.dynamics.thrust import NO_THRUST, Actuation, Commands
from capture_sim.errors import SceneError, SimulationError
from capture_sim.scene.parts import Thruster, Thrusters
from capture_sim.scene.quantities import LARGEST, refuse

#: Samples per call into the engine; with this number the overhead of a call is negligible.
BLOCK = 4096


@dataclass(frozen=True)
class Block:
    """One piece of a run: the samples, trace and events since the previous piece."""

    samples: np.ndarray  # (n,) of dtype SAMPLE
    trace: np.ndarray  # (k,) of dtype SAMPLE, empty without trace
    failure: SimulationError | None  # in the last piece of a run that stopped early
    _bench: Bench
    _events: slice

    @property
    def events(self) -> list[Event]:
        """Events of the piece, in order."""
        return self._bench.events[self._events]


@dataclass(frozen=True)
class Control:
    """A controller of the thrusters.

    Attributes
    ----------
    command
        Function called at each control instant with the sample at this instant, of dtype SAMPLE.
        It returns force (N, N) and moment (N m) for the chaser and for the target; None for either
        vehicle means no new command.
    rate
        Rate of the calls, Hz: ``run.state_rate`` divided by a whole number; None for ``run.rate``.
    as_applied
        True to apply every wrench as it is, without limits, delay, pulses and timeout.  Use it to
        repeat wrenches that thrusters have applied before.
    watch
        Function called with all samples since the last call, (n,) of dtype SAMPLE, before
        ``command``; None: none.

    Examples
    --------
    >>> from capture_sim.dynamics.drive import Control
    >>> brake = Control(lambda sample: ((-5.0 * sample["v"][0], 0.0, 0.0), None), rate=10.0)
    """

    command: Callable[[np.void], Commands]
    rate: float | None = None
    as_applied: bool = False
    watch: Callable[[np.ndarray], None] | None = None


#: Thrusters that apply every wrench unchanged.
_IDEAL = Thrusters(Thruster(LARGEST, LARGEST), Thruster(LARGEST, LARGEST), timeout=1e6)


class _Controlled:
    """A bench with a controller that commands its thrusters at the control instants."""

    def __init__(self, bench: Bench, control: Control) -> None:
        scene = bench.scene
        if scene.thrusters is None:
            raise SceneError("thrusters: must be in the scene for a controller")
        rate = scene.run.rate if control.rate is None else control.rate
        ratio = scene.run.state_rate / rate if rate > 0.0 else math.nan
        if not (ratio >= 1.0 and abs(ratio - round(ratio)) <= 1e-9 * ratio):
            allowed = f"run.state_rate ({scene.run.state_rate:g} Hz) divided by a whole number"
            raise refuse("rate of the controller", rate, "Hz", allowed)
        self._bench, self._command, self._watch = bench, control.command, control.watch
        self._every = round(ratio)
        self._actuation = Actuation(_IDEAL if control.as_applied else scene.thrusters)
        self._last: np.void | None = None
        self._count = 0  # samples so far
        self._has_warned = False

    def size(self, first: int) -> int:
        """Return the number of samples from ``first`` up to and including the next instant."""
        return 1 if first == 0 else self._every

    def advance(self, times: np.ndarray) -> np.ndarray:
        """Continue the run with the commands for the last sample; return samples.

        Arguments, result and errors are those of :meth:`Bench.advance`.
        """
        bench, actuation = self._bench, self._actuation
        if self._last is not None and (self._count - 1) % self._every == 0:
            actuation.command(float(self._last["t"]), self._commands())
        end = float(times[-1]) if times.size else math.inf
        if bench.is_on_rail or self._last is None:
            bench.pause_at(end)
            samples = bench.advance(times)
        else:
            parts: list[np.ndarray] = []
            try:
                while not bench.done and bench.t < end:
                    parts.append(self._up_to(end, times))
            except SimulationError as error:
                partial = joined([*parts, error.partial])
                raise SimulationError(str(error), partial) from None
            samples = joined(parts) if parts else bench.advance(times)
        if samples.size:
            if self._watch is not None:
                self._watch(samples)
            self._last, self._count = samples[-1].copy(), self._count + samples.size
        return samples

    def _commands(self) -> Commands:
        """Ask the controller; a command that is none gives no thrust, and one warning a run.

        SimulationError if the controller raises an error.
        """
        sample = self._last
        assert sample is not None
        try:
            commands = self._command(sample)
        except Exception as error:
            text = f"controller at {float(sample['t']):.6g} s: {type(error).__name__}: {error}"
            raise SimulationError(text, np.zeros(0, SAMPLE)) from error
        if _are_commands(commands):
            return commands
        if not self._has_warned:
            self._has_warned = True
            warnings.warn(
                f"command of the controller at {float(sample['t']):.6g} s: {commands!r:.200}: for "
                "chaser and target, each must be finite numbers, N, N and N m, or None; the "
                "vehicles coast",
                RuntimeWarning,
                stacklevel=2,
            )
        return NO_THRUST, NO_THRUST

    def _up_to(self, end: float, times: np.ndarray) -> np.ndarray:
        """Run with the present wrenches until their next change, at most to ``end`` (s)."""
        bench, actuation = self._bench, self._actuation
        begin = bench.t
        actuation.go_to(begin)
        until = min(actuation.next_change(), end)
        bench.thrust(*actuation.applied, until, timeouts=actuation.timeouts)
        chosen = times[(times > begin) & (times <= until)]
        samples = bench.advance(chosen).copy()
        if chosen.size and chosen[-1] < until and not bench.done:
            bench.advance(times[:0])
        return samples


def _are_commands(commands: object) -> bool:
    """Return True if a controller has returned three finite numbers or None for each vehicle."""
    if not isinstance(commands, (tuple, list)) or len(commands) != 2:
        return False
    try:
        return all(
            wrench is None or (len(wrench) == 3 and all(map(math.isfinite, wrench)))
            for wrench in commands
        )
    except TypeError:
        return False


def drive(
    bench: Bench,
    times: np.ndarray | None = None,
    *,
    block: int | Callable[[], int] = BLOCK,
    control: Control | None = None,
) -> Iterator[Block]:
    """Run a bench to its end piece by piece.

    Parameters
    ----------
    bench
        Bench at its release.
    times
        (n,) ascending sample times, s; None for the grid of ``scene.run.state_rate``.
    block
        Number of samples of a piece, or a function that returns this number, called before each
        piece.
    control
        Controller of the scene's thrusters.  Pieces then end at its instants, and it is called with
        the last sample of a piece before the next one starts.  ``times`` must be the grid of
        ``scene.run.state_rate``.

    Yields
    ------
    Block
        The next piece.  It is computed when it is requested, so you can leave the loop at any
        piece.

    Examples
    --------
    Run until the tip is within 10 mm of the centre of BE:

    >>> from capture_sim import Bench, load_scene
    >>> from capture_sim.dynamics.drive import drive
    >>> for piece in drive(Bench(load_scene("tilt_0")), block=100):
    ...     if piece.samples["tip_distance"].min() < 0.01:
    ...         break
    """
    n_samples = n_events = n_trace = 0
    controlled = None if control is None else _Controlled(bench, control)
    while not bench.done:
        size = block if isinstance(block, int) else block()
        if controlled is not None:
            size = controlled.size(n_samples)
        piece_times = (
            bench.times(n_samples, size) if times is None else times[n_samples : n_samples + size]
        )
        failure = None
        try:
            samples = (bench if controlled is None else controlled).advance(piece_times)
        except SimulationError as error:
            samples, failure = error.partial, error
        n_samples += size
        events = slice(n_events, bench.event_count)
        n_events = bench.event_count
        trace, n_trace = bench.trace_since(n_trace), bench.trace_pieces
        yield Block(samples, trace, failure, bench, events)
        if failure is not None:
            return
