"""Losses of a recording: lost messages and early ends, by sequence numbers and reported counts."""

from __future__ import annotations

from collections.abc import Sequence

from capture_sim.errors import MessageError, RecordingError
from capture_sim.messages.cdr import sequence_of
from capture_sim.messages.topics import (
    SIMULATOR,
    STREAM_COUNTS,
)
from capture_sim.recording.completeness import Completeness
from capture_sim.recording.recorded_topics import RecordedTopics


def losses(topics: RecordedTopics, publishers: Sequence[str]) -> tuple[str, ...]:
    """Return a line for each loss and early end of the one run in a recording.

    ``publishers``: names of the nodes whose counts must be there.
    """
    recorded = topics.typed
    completeness = Completeness(publishers, list(recorded))
    uncounted = []
    for topic, messages in recorded.items():
        try:
            if messages and topic.sequenced:
                topics.store_of_topic(topic)  # with other fields, the number stands elsewhere
            for data in messages:
                completeness.add(topic, sequence_of(topic, data))
        except MessageError as error:
            raise RecordingError(f"{topics.path}: {error}") from None
        except RecordingError as error:
            reason = str(error).removeprefix(f"{topics.path}: ")
            uncounted.append(f"lost messages cannot be counted: {reason}")
    ends = topics.columns_if_typed(STREAM_COUNTS)
    for i, publisher in enumerate(ends.get("publisher", ())):
        names, counts = ends["topics"][i], ends["counts"][i].tolist()
        if len(names) != len(counts):
            raise RecordingError(
                f"{topics.path}: {STREAM_COUNTS.name}: {len(names)} topics, {len(counts)} counts"
            )
        completeness.end(
            publisher,
            dict(zip(names, counts, strict=True)),
            complete=bool(ends["complete"][i]),
            reason=ends["reason"][i],
        )
    return (*uncounted, *completeness.problems())


def is_cut(topics: RecordedTopics) -> bool:
    """Return True if no end of a complete run of the simulator is recorded."""
    ends = topics.columns_if_typed(STREAM_COUNTS)
    ended = zip(ends.get("publisher", ()), ends.get("complete", ()), strict=True)
    return not any(publisher == SIMULATOR and complete for publisher, complete in ended)
