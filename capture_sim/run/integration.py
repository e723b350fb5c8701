"""The integration of a run, which :func:`capture_sim.simulate` and all studies share.

Samples are taken at ``run.rate``, the rate of the detector.  Further samples are computed only if
they are read.
"""

from __future__ import annotations

import math
import threading
from functools import lru_cache
from typing import Literal

import numpy as np

from capture_sim.detection.criteria import CaptureStatus
from capture_sim.detection.exact import ExactDetector, Statuses
from capture_sim.dynamics.bench import Bench
from capture_sim.dynamics.drive import Control, drive
from capture_sim.dynamics.memory import Memory, joined
from capture_sim.dynamics.sample_times import to_the_end
from capture_sim.dynamics.samples import SAMPLE
from capture_sim.errors import SceneError, SimulationError
from capture_sim.scene.parts import RunSettings, Scene

#: Largest memory for the samples of one run, bytes.
MAX_MEMORY = 4_000_000_000
#: Measurements of the detector per call into the engine: more would run on too far after a
#: verdict, fewer cost calls.
_BLOCK = 20
#: Samples that the runs of a thread have room for; those of longer runs take new memory.
_ROOM = 4096


def check_memory(
    run: RunSettings, count: float, rate: Literal["state_rate", "rate"] = "state_rate"
) -> None:
    """Raise SceneError if the samples at one of the run's rates would fill the memory."""
    # as they are computed, and as they are returned
    needed = 2.0 * count * SAMPLE.itemsize
    if needed > MAX_MEMORY:
        raise SceneError(
            f"run.t_end = {run.t_end:g} s at run.{rate} = {getattr(run, rate):g} Hz: {count:.3g} "
            f"samples need {needed / 1e9:.3g} GB of memory: must be "
            f"at most {MAX_MEMORY / 1e9:g} GB"
        )


class _Kept(threading.local):
    """Memory of the runs of a call, kept for the next one; each thread has its own.

    All runs of a call share the room for samples.
    """

    def __init__(self) -> None:
        self._samples = np.empty(_ROOM, SAMPLE)
        self._memories: list[Memory] = []

    def memories(self, count: int) -> list[Memory]:
        """Return ``count`` memories; the next call returns the same ones again."""
        missing = count - len(self._memories)
        self._memories += [Memory(self._samples) for _ in range(missing)]
        return self._memories[:count]


#: Memory of the runs of this thread.
kept = _Kept()


class Integration:
    """A run that is prepared, integrated and evaluated in three steps.

    A study of many runs takes each step for several of them in a row: a kernel displaces Python's
    code from the processor's caches, after which it is three times as slow.

    Parameters
    ----------
    scene
        Scene of the run; SceneError if it breaks a rule.
    memory
        As for :class:`capture_sim.dynamics.bench.Bench`.

    Attributes
    ----------
    bench : Bench
        The bench, after the integration at its end.
    t_end : float
        Time of the last sample at ``run.rate``, s.
    energy_residual : float
        Largest residual of the energy ledger at ``run.rate``, J.
    failure : str
        Why the integration had to stop; empty for a complete run.
    """

    def __init__(self, scene: Scene, memory: Memory | None = None) -> None:
        run = scene.run
        check_memory(run, run.t_end * run.rate, "rate")
        self.bench, self._detector = Bench(scene, memory=memory), ExactDetector(scene)
        self._times = _measured_at(run.t_end, run.rate)
        self.t_end = self.energy_residual = 0.0
        self.failure = ""

    def integrate(self) -> None:
        """Run to the end; :meth:`finish` has the verdict."""
        samples = self._integrated(self._times)
        self._note(samples)
        self._detector.to_end(samples)

    def statuses(self) -> Statuses:
        """Run to the end, and return the detector's statuses, the last one with the verdict."""
        samples = self._integrated(self._times)
        self._note(samples)
        return self._detector.statuses(samples, cut=bool(self.failure))

    def sample(self, times: np.ndarray) -> np.ndarray:
        """Run to the end, and return the samples at times, (n,), s, in place of the detector's."""
        return self._integrated(to_the_end(times))

    def controlled(self, control: Control) -> tuple[np.ndarray, Statuses]:
        """Run to the end with a controller; return samples at ``run.state_rate``, and statuses."""
        run = self.bench.scene.run
        pieces = list(drive(self.bench, control=control))
        self.failure = str(pieces[-1].failure or "")
        samples = joined([piece.samples for piece in pieces])
        measured = samples[:: round(run.state_rate / run.rate)]
        self._note(measured)
        return samples, self._detector.statuses(measured, cut=bool(self.failure))

    def _integrated(self, times: np.ndarray) -> np.ndarray:
        try:
            return self.bench.finish(times)
        except SimulationError as error:
            self.failure = str(error)
            return error.partial

    def integrate_to_verdict(self) -> None:
        """Run to the verdict, or to the end."""
        for piece in drive(self.bench, self._times[:-1], block=_BLOCK):
            self.failure = str(piece.failure or "")
            self._note(piece.samples)
            self._detector.until_verdict(piece.samples)
            if self._detector.final:
                return

    def _note(self, samples: np.ndarray) -> None:
        if samples.size:
            self.t_end = float(samples["t"][-1])
            residual = np.abs(samples["energy_residual"]).max()
            self.energy_residual = max(self.energy_residual, float(residual))

    def finish(self) -> CaptureStatus:
        """Return the final status of a run that was integrated."""
        return self._detector.finish(cut=bool(self.failure))

    @property
    def since(self) -> float:
        """When the detector's last state began, s since the release."""
        return self._detector.since

    @property
    def behind(self) -> float:
        """Return how far the tip's centre is behind BE at the end, m; 0 within the capture radius.

        A tip may pass through BE.  No scene describes the inside of the target, behind BE.
        """
        behind = -self._detector.axial
        return behind if behind > self.bench.scene.detector.capture_radius else 0.0


@lru_cache(maxsize=4)
def _measured_at(t_end: float, rate: float) -> np.ndarray:
    """Return the times of the detector's measurements, s, and the result of :func:`to_the_end`.

    Most runs of a study have equal times, so the result is cached.
    """
    times: np.ndarray = np.arange(math.floor(t_end * rate) + 2) / rate
    return to_the_end(times[times <= t_end])
