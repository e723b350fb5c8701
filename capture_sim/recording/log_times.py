"""Corrects log times of a clock that was set while it recorded, or that was not set at all."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

#: Log times that are further apart than this are those of two clocks, ns: a day.
JUMP = 86_400 * 10**9


def settle(log_times: Mapping[str, list[int]]) -> list[str]:
    """Remove jumps of the recorder's clock from log times, in place.

    ``log_times``, ns, has those of each topic in the order of the file.  Where the log times of all
    topics together, sorted, have a gap of more than :data:`JUMP`, they are by two clocks.  The
    times by the clock with the most messages are kept; the others are shifted so that each clock
    goes on where the one before ended.

    Return a line for each jump, and one for messages whose log time is 0, if there are any.  The
    jump from such messages to others has no line.
    """
    used = {topic: times for topic, times in log_times.items() if times}
    if not used:
        return []
    low, high = min(map(min, used.values())), max(map(max, used.values()))
    n_zero = sum(times.count(0) for times in used.values()) if low == 0 else 0
    lines = [f"{n_zero} messages without a log time (0 ns)"] if n_zero else []
    if high - low <= JUMP:
        return lines
    arrays = {topic: np.array(times, dtype=np.int64) for topic, times in used.items()}
    every = np.sort(np.concatenate(list(arrays.values())))
    splits = np.flatnonzero(np.diff(every) > JUMP) + 1
    clocks = np.split(every, splits)
    begins = np.array([clock[0] for clock in clocks])
    if len(clocks) == 1:
        return lines
    of_clock = {topic: np.searchsorted(begins, a, "right") - 1 for topic, a in arrays.items()}
    # the topic that changes its clock most often shows their order
    orders = [list(dict.fromkeys(numbers.tolist())) for numbers in of_clock.values()]
    order = max(orders, key=len)
    order += [number for number in range(len(clocks)) if number not in order]
    shift = np.zeros(len(clocks), dtype=np.int64)
    kept = max(range(len(order)), key=lambda i: len(clocks[order[i]]))
    for i in range(kept - 1, -1, -1):
        here, after = order[i], order[i + 1]
        shift[here] = clocks[after][0] + shift[after] - clocks[here][-1]
    for i in range(kept + 1, len(order)):
        here, before = order[i], order[i - 1]
        shift[here] = clocks[before][-1] + shift[before] - clocks[here][0]
    for topic, array in arrays.items():
        log_times[topic][:] = (array + shift[of_clock[topic]]).tolist()
    count = 0
    for before, after in pairwise(order):
        count += len(clocks[before])
        if clocks[before][-1] == 0:
            continue
        days = (int(clocks[after][0]) - int(clocks[before][-1])) / JUMP
        lines.append(
            f"the log times jump by {days:+.4g} days after {count} messages; "
            "they are counted on from there"
        )
    return lines
