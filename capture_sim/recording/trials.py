"""The trials in one recording of a rig, told apart by the pauses between them."""

from __future__ import annotations

from contextvars import ContextVar
from pathlib import Path

import numpy as np

from capture_sim.errors import RecordingError
from capture_sim.messages.measurements import OF_A_BENCH
from capture_sim.messages.topics import LAUNCH_COMMAND, LOAD_CELL
from capture_sim.recording.contents import Contents

#: Number of the trial to read, counted from 1; 0 for the whole recording.
TRIAL: ContextVar[int] = ContextVar("trial", default=0)
#: All sources are silent for longer than this between two trials, ns.
_PAUSE = 2_000_000_000
#: Topics of which only the messages of one trial are kept; others, e.g. latched ones, stay whole.
_OF_TRIALS = tuple(t.absolute_name for t in (*OF_A_BENCH, LOAD_CELL, LAUNCH_COMMAND))


def keep_trial(path: Path, contents: Contents, number: int) -> None:
    """Leave out the measurements of all trials but one, in place.

    RecordingError if there is no trial of this ``number``, counted from 1.
    """
    sources = [contents.log_times.get(topic.absolute_name, []) for topic in OF_A_BENCH]
    t = np.sort(np.concatenate([np.array(times, dtype=np.int64) for times in sources]))
    pauses = np.flatnonzero(np.diff(t) > _PAUSE)
    count = len(pauses) + 1 if t.size else 0
    if not 1 <= number <= count:
        raise RecordingError(f"{path}: trial = {number}: must be 1 to {count}, by pauses of 2 s")
    middles = (t[pauses] + t[pauses + 1]) // 2
    edges = [-(2**63), *middles.tolist(), 2**63 - 1]
    low, high = edges[number - 1 : number + 1]
    for topic in _OF_TRIALS:
        times = contents.log_times.get(topic)
        if times:
            kept = [k for k, at in enumerate(times) if low <= at < high]
            messages = contents.messages[topic]
            contents.messages[topic] = [messages[k] for k in kept]
            contents.log_times[topic] = [times[k] for k in kept]
