"""A bench driven to its end, piece by piece."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from capture_sim.dynamics.bench import Bench
from capture_sim.dynamics.samples import (
    Event,
)
from capture_sim.errors import SimulationError

#: Samples of one call into the engine; the overhead of a call is negligible.
BLOCK = 4096


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
    >>> from capture_sim.dynamics.drive import drive
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
