"""Finds lost messages and early ends of the run in a recording."""

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
    """Return a line for each topic that lost messages, and for each node that ended the run early.

    Losses are found by sequence numbers, and by the numbers of messages that nodes report in
    StreamCounts.  The recording must contain one run.  ``publishers`` are the roles of the nodes
    that must have reported.  RecordingError if a message or a report cannot be read.
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
    """Return True if no report of the simulator that it completed its run is recorded."""
    ends = topics.columns_if_typed(STREAM_COUNTS)
    ended = zip(ends.get("publisher", ()), ends.get("complete", ()), strict=True)
    return not any(publisher == SIMULATOR and complete for publisher, complete in ended)
