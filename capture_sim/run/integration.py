"""The integration of a run, used by :func:`capture_sim.simulate` and all studies.

By default samples are computed only at ``run.rate``, the rate of the detector.
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
#: Detector samples per call into the engine.  With more the run goes on too long after a verdict;
#: with fewer the calls take too much time.
_BLOCK = 20
#: Length of the array of samples that the runs of a thread reuse.  A longer run allocates an array.
_ROOM = 4096


def check_memory(
    run: RunSettings, count: float, rate: Literal["state_rate", "rate"] = "state_rate"
) -> None:
    """Raise SceneError if ``count`` samples would need more memory than MAX_MEMORY.

    ``rate`` names the setting of ``run`` that the message shows as the rate of the samples.
    """
    # twice: while they are computed, and as they are returned
    needed = 2.0 * count * SAMPLE.itemsize
    if needed > MAX_MEMORY:
        raise SceneError(
            f"run.t_end = {run.t_end:g} s at run.{rate} = {getattr(run, rate):g} Hz: {count:.3g} "
            f"samples need {needed / 1e9:.3g} GB of memory: must be "
            f"at most {MAX_MEMORY / 1e9:g} GB"
        )


class _Kept(threading.local):
    """Pool of memories that simulated runs reuse; each thread has its own pool.

    All memories of a pool share one array of samples, because runs are integrated one at a time.
    """

    def __init__(self) -> None:
        self._samples = np.empty(_ROOM, SAMPLE)
        self._memories: list[Memory] = []

    def memories(self, count: int) -> list[Memory]:
        """Return the first ``count`` memories of the pool; later calls return the same objects."""
        missing = count - len(self._memories)
        self._memories += [Memory(self._samples) for _ in range(missing)]
        return self._memories[:count]


#: Memories for the runs of the calling thread.
kept = _Kept()


class Integration:
    """A run that is prepared, integrated and evaluated in separate calls.

    A study of many runs prepares several runs, then integrates them all, then evaluates them all.
    This is faster than run by run: a compiled kernel displaces Python's code from the processor's
    caches, and the Python code after it then takes three times as long.

    Parameters
    ----------
    scene
        Scene of the run; SceneError if it breaks a rule.
    memory
        Memory to reuse, as for :class:`capture_sim.dynamics.bench.Bench`; None for new memory.
    control
        Controller of the thrusters for :meth:`integrate`.

    Attributes
    ----------
    bench : Bench
        The bench that is integrated; it has the touches, events and peak loads of the run.
    t_end : float
        Time of the last sample at ``run.rate``, s.
    energy_residual : float
        Largest magnitude of the energy ledger's residual in the samples at ``run.rate``, J.
    failure : str
        Reason why the integration stopped early; empty for a complete run.
    """

    def __init__(
        self, scene: Scene, memory: Memory | None = None, control: Control | None = None
    ) -> None:
        run = scene.run
        self._control = control
        check_memory(run, run.t_end * run.rate, "rate")
        self.bench, self._detector = Bench(scene, memory=memory), ExactDetector(scene)
        self._times = _measured_at(run.t_end, run.rate)
        self.t_end = self.energy_residual = 0.0
        self.failure = ""

    def integrate(self) -> None:
        """Run to the end and evaluate the samples; :meth:`finish` then returns the final status."""
        if self._control is not None:
            self._detector.to_end(self._flown(self._control)[1])
            return
        samples = self._integrated(self._times)
        self._note(samples)
        self._detector.to_end(samples)

    def statuses(self) -> Statuses:
        """Run to the end and return the detector's statuses, the last of which has the verdict."""
        samples = self._integrated(self._times)
        self._note(samples)
        return self._detector.statuses(samples, cut=bool(self.failure))

    def sample(self, times: np.ndarray) -> np.ndarray:
        """Run to the end and return the samples at ``times``, (n,), s, without using the detector.

        There are no samples after the end of the run.
        """
        return self._integrated(to_the_end(times))

    def controlled(self, control: Control) -> tuple[np.ndarray, Statuses]:
        """Run to the end with a controller of the thrusters.

        Return the samples at ``run.state_rate`` and the detector's statuses.
        """
        samples, measured = self._flown(control)
        return samples, self._detector.statuses(measured, cut=bool(self.failure))

    def _flown(self, control: Control) -> tuple[np.ndarray, np.ndarray]:
        """Run to the end; return the samples at ``run.state_rate``, and those of the detector."""
        run = self.bench.scene.run
        pieces = list(drive(self.bench, control=control))
        self.failure = str(pieces[-1].failure or "")
        samples = joined([piece.samples for piece in pieces])
        measured = samples[:: round(run.state_rate / run.rate)]
        self._note(measured)
        return samples, measured

    def _integrated(self, times: np.ndarray) -> np.ndarray:
        try:
            return self.bench.finish(times)
        except SimulationError as error:
            self.failure = str(error)
            return error.partial

    def integrate_to_verdict(self) -> None:
        """Run until the detector has a verdict, or to the end of the run."""
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
        """Return the detector's final status; call it once, after the integration."""
        return self._detector.finish(cut=bool(self.failure))

    @property
    def since(self) -> float:
        """Time at which the detector's last state began, s since the release."""
        return self._detector.since

    @property
    def behind(self) -> float:
        """Distance of the tip's centre behind BE at the last sample, m, along the cone's axis.

        It is 0 if the tip is in front of BE, or behind it by at most the capture radius.  Beyond BE
        the simulated motion means little, because no scene describes the inside of the target.
        """
        behind = -self._detector.axial
        return behind if behind > self.bench.scene.detector.capture_radius else 0.0


@lru_cache(maxsize=4)
def _measured_at(t_end: float, rate: float) -> np.ndarray:
    """Return the times of the detector's samples, s, ended by :func:`to_the_end`.

    Most runs of a study have equal times, so the result is cached.
    """
    times: np.ndarray = np.arange(math.floor(t_end * rate) + 2) / rate
    return to_the_end(times[times <= t_end])
