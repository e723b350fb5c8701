"""The detector for exact samples: compiled code evaluates the criteria for a block of samples.

Poses and buffer of a simulated run are known exactly, at common instants.  Of the pipeline in
:mod:`capture_sim.detection.detector`, only the criteria are therefore needed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, overload

import numpy as np

from capture_sim.base.compiled.kernels import entry_kernel, plain, records
from capture_sim.detection.criteria import (
    MEMORY,
    CaptureState,
    CaptureStatus,
    Cause,
    Criteria,
    Place,
    decide,
    decide_at_end,
    new_memory,
    note_push,
    reason,
)
from capture_sim.dynamics.model.equations import tip_in_cone
from capture_sim.dynamics.model.trig import wrapped_angle
from capture_sim.scene.parts import Scene

_STATES = tuple(CaptureState)
_decide_at_end = plain(decide_at_end)
#: Type of MEMORY with its fields as attributes, for Python code.
_MEMORY_BY_NAME = np.dtype((np.record, MEMORY))
_NUMBERS = (
    *("t", "distance", "axial_offset", "lateral_offset", "relative_attitude", "relative_speed"),
    *("nearest_distance", "time_in_state"),
)
#: Type of a status with its numbers only.
ROW = np.dtype(
    [("state", "i8"), ("cause", "i8"), ("value", "f8"), *((name, "f8") for name in _NUMBERS)]
)


def _first_row() -> np.ndarray:
    row = np.zeros(1, ROW)
    for name in _NUMBERS[1:6]:
        row[name] = math.nan
    row["nearest_distance"] = math.inf
    return row


#: The status before the first sample.
_FIRST_ROW = _first_row()


@entry_kernel
def follow(criteria, memories, samples, y, rows, to_verdict):
    """Evaluate the criteria at each sample; return the number of samples used.

    With ``to_verdict``, evaluation stops at the sample that gives the verdict; otherwise all
    samples are used.  The function writes the statuses to ``rows`` of dtype ROW and overwrites
    the last row if there are more samples than rows.  ``y`` (16,) is work space for a state.
    """
    memory, c = memories[0], criteria
    for k in range(samples.size):
        sample = samples[k]
        t, axial, lateral = sample.t, sample.tip_axial, sample.tip_lateral
        for i in range(8):
            y[i] = sample.q[i]
            y[8 + i] = sample.v[i]
        _, _, wx, wy = tip_in_cone(y, c)
        if max(abs(sample.axial_stroke), abs(sample.torsion) * c.rest_length) > c.contact_gap:
            note_push(c, memory, t, axial, lateral)
        place = Place(t, axial, lateral, -wx, wy, 0.0, 0.0, 1)
        decide(c, memory, place, False, 0.0, 0.0)
        row = rows[min(k, rows.size - 1)]
        row.state, row.cause, row.value = memory.state, memory.cause, memory.value
        row.t = t
        row.distance = sample.tip_distance
        row.axial_offset = axial
        row.lateral_offset = lateral
        row.relative_attitude = wrapped_angle(y[2] - y[7])
        row.relative_speed = memory.speed
        row.nearest_distance = memory.nearest
        row.time_in_state = t - memory.since
        is_over = memory.state > CaptureState.CONTACT
        if c.flies > 0.0:
            is_over = memory.state == CaptureState.CAPTURED
        if to_verdict and is_over:
            return k + 1
    return samples.size


class Statuses(Sequence[CaptureStatus]):
    """The statuses of a run, stored as one array and converted to objects on access.

    Attributes
    ----------
    rows
        (n,) of dtype ROW: a row for each sample and a row for the end of the run.
    """

    def __init__(self, rows: np.ndarray, criteria: Criteria, last: CaptureStatus) -> None:
        self.rows, self._criteria, self._last = rows, criteria, last

    def __len__(self) -> int:
        return len(self.rows)

    @overload
    def __getitem__(self, index: int) -> CaptureStatus: ...

    @overload
    def __getitem__(self, index: slice) -> list[CaptureStatus]: ...

    def __getitem__(self, index: int | slice) -> CaptureStatus | list[CaptureStatus]:
        """Return the status at an index, or the statuses of a slice as a list."""
        if isinstance(index, slice):
            return list(self)[index]
        if index in (-1, len(self.rows) - 1):
            return self._last
        return _Words(self._criteria).status(self.rows[index].item())

    def __iter__(self) -> Iterator[CaptureStatus]:
        """Yield the statuses in order."""
        words = _Words(self._criteria)
        yield from (words.status(row) for row in self.rows[:-1].tolist())
        yield self._last

    def __eq__(self, other: object) -> bool:
        """Return True if another sequence contains equal statuses, e.g. those of another run."""
        return isinstance(other, Sequence) and list(self) == list(other)

    __hash__ = None  # type: ignore[assignment]


class _Words:
    """Converter of rows to statuses; it caches the last reason, which most rows share."""

    def __init__(self, criteria: Criteria) -> None:
        self._criteria = criteria
        self._last = ((-1, 0.0), "")

    def status(self, row: Any, *, is_over: bool = False) -> CaptureStatus:
        """Return the status of a row, a tuple of the fields of ROW.

        ``is_over`` marks the status as final, whatever its state.
        """
        state, cause, value, t, *numbers = row
        if self._last[0] != (cause, value):
            self._last = (cause, value), reason(self._criteria, cause, value)
        final = is_over or self._criteria.is_final(_STATES[state])
        return CaptureStatus._make(
            (t, _STATES[state], final, *numbers, self._last[1], "", 0.0, 0.0, 0.0)
        )


class ExactDetector:
    """Detector that evaluates one exactly known simulated run, from the approach to a verdict.

    The verdict is

    - *captured* when the tip's centre stays within ``detector.capture_radius`` of the centre of BE
      for ``detector.min_dwell``, or passes BE inside the throat,
    - *rebound* when the tip has been in contact and then retreats by ``detector.min_retreat`` from
      its closest approach,
    - *missed* when the tip retreats by that distance without contact, or passes BE outside the
      throat,
    - *stuck* when the tip is at rest for ``detector.min_still_time`` outside the capture radius.

    A run that ends before a verdict is *undecided* unless a rule of docs/detection.md applies.

    Parameters
    ----------
    scene
        Geometry of buffer and cone, and the ``detector`` part.

    Examples
    --------
    >>> from capture_sim import Bench, load_scene
    >>> bench = Bench(load_scene("paper_designed"))
    >>> detector = ExactDetector(bench.scene)
    >>> statuses = detector.update(bench.advance(bench.times(0, 100))[::10])
    >>> statuses[0].state.label
    'contact'
    """

    def __init__(self, scene: Scene) -> None:
        self._criteria = Criteria.of(scene)
        self._memory = new_memory(has_approached=True)
        self._y = np.zeros(16)
        self._row = _FIRST_ROW.copy()  # the last status
        self._words = _Words(self._criteria)

    @property
    def state(self) -> CaptureState:
        """State after the samples so far."""
        return CaptureState(int(self._memory["state"][0]))

    @property
    def since(self) -> float:
        """Time at which the present state began, s since the release."""
        return float(self._memory["since"][0])

    @property
    def axial(self) -> float:
        """Axial position of the tip at the last sample, m; positive ahead of BE."""
        return float(self._memory["axial"][0])

    @property
    def final(self) -> bool:
        """True if there is a verdict that does not change any more."""
        return self._criteria.is_final(self.state)

    def update(self, samples: np.ndarray) -> list[CaptureStatus]:
        """Return the status at each of the next samples, (n,) of dtype SAMPLE."""
        rows = np.zeros(samples.size, ROW)
        self._follow(samples, rows, to_verdict=False)
        return [self._words.status(row) for row in rows.tolist()]

    def statuses(self, samples: np.ndarray, *, cut: bool = False, has_end: bool = True) -> Statuses:
        """Evaluate all samples of a run, (n,) of dtype SAMPLE, and close it like :meth:`finish`."""
        rows = np.zeros(samples.size + 1, ROW)
        self._follow(samples, rows[:-1], to_verdict=False)
        rows[-1:] = self._row
        self._row = rows[-1:]
        last = self.finish(cut=cut, has_end=has_end)
        return Statuses(rows, self._criteria, last)

    def until_verdict(self, samples: np.ndarray) -> int:
        """Evaluate the next samples, (n,) of dtype SAMPLE, until a sample gives the verdict.

        Returns
        -------
        int
            Number of samples evaluated: all of them unless :attr:`final` becomes true.
        """
        return self._follow(samples, self._row, to_verdict=True)

    def to_end(self, samples: np.ndarray) -> None:
        """Evaluate all of the next samples, (n,) of dtype SAMPLE, without returning statuses.

        :meth:`finish` returns the last status.
        """
        self._follow(samples, self._row, to_verdict=False)

    def _follow(self, samples: np.ndarray, rows: np.ndarray, *, to_verdict: bool) -> int:
        if not samples.size:
            return 0
        memory, read = records(self._memory), records(np.ascontiguousarray(samples))
        used: int = follow(self._criteria, memory, read, self._y, records(rows), to_verdict)
        self._row = rows[-1:]
        return used

    def finish(self, *, cut: bool = False, has_end: bool = True) -> CaptureStatus:
        """Close the run and return its last status; the state is a verdict or undecided.

        The status belongs to the last sample.  It is final unless the run was cut before a
        verdict.

        Parameters
        ----------
        cut
            True if the run was ended early.
        has_end
            False for a recording that lacks the end of its run.  A tip that still moves at the end
            of such a recording gives no verdict.
        """
        memory, row = self._memory[0], self._row[0]
        if math.isnan(row["distance"]):
            memory["state"], memory["cause"] = CaptureState.UNDECIDED, Cause.NOT_MEASURED
        elif not self.state.is_verdict:
            lacks_end = not has_end and (cut or memory["speed"] >= self._criteria.still_speed)
            by_name = self._memory.view(_MEMORY_BY_NAME)[0]
            _decide_at_end(self._criteria, by_name, 0.0, cut or lacks_end)
            if lacks_end and memory["cause"] in (Cause.END_BEFORE_CONTACT, Cause.END_AFTER_CONTACT):
                memory["cause"] = Cause.NO_END
        for name in ("state", "cause", "value"):
            row[name] = memory[name]
        row["time_in_state"] = row["t"] - memory["since"]
        return self._words.status(row.tolist(), is_over=not cut)
