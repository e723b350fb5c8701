"""Counts the messages of topics, so that lost messages are reported."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from capture_sim.errors import MessageError
from capture_sim.messages.topics import Topic, topic_named


@dataclass
class TopicCount:
    """How many messages of one topic were received, were sent, and are missing."""

    received: int = 0  # messages that came
    # messages that were sent, as their publisher reports at the end; None before
    expected: int | None = None
    next_seq: int = 0  # sequence number that should come next
    # first and last missing sequence numbers, at most :data:`MAX_GAPS` of them
    gaps: list[tuple[int, int]] = field(default_factory=list)
    missing: int = 0  # messages known to be missing from gaps in the sequence
    out_of_order: int = 0  # messages whose number was lower than expected
    first: int | None = None  # log time of the first message, ns
    last: int = 0  # ... and of the last
    longest_gap: int = 0  # longest time between two messages, ns

    @property
    def rate(self) -> float:
        """Mean rate between the first and the last message, Hz; 0 for fewer than two messages."""
        span = 0 if self.first is None else self.last - self.first
        return 1e9 * (self.received - 1) / span if span else 0.0


#: Gaps that are remembered of each topic; further ones are only counted.
MAX_GAPS = 100


def counts_of(message: Any) -> dict[str, int]:
    """Return the numbers of messages in a StreamCounts by name of the topic.

    ``message`` may be an object of rclpy or of another library.  MessageError if it has not one
    number for each topic.
    """
    if len(message.topics) != len(message.counts):
        raise MessageError(f"{len(message.topics)} topics and {len(message.counts)} counts")
    return dict(zip(message.topics, map(int, message.counts), strict=True))


class Completeness:
    """Counts the messages received, and compares them with what the nodes report that they sent.

    Sequence numbers, which some messages have, show which messages are missing.  Of a topic that
    holds a state (:attr:`Topic.holds_state`), only the last message must come, because DDS may
    replace earlier ones by it on their way.

    ``publishers`` are the roles of the nodes that have to report how many messages they sent.
    ``topics`` are the topics whose reported numbers count, None for all.  ``required`` are the
    topics that must have messages, unless a node reports how many it sent.  ``names`` are the names
    to print for topics that were recorded under other names than the bench's.
    """

    def __init__(
        self,
        publishers: Sequence[str] = (),
        topics: Collection[Topic] | None = None,
        required: Collection[Topic] = (),
        names: Mapping[Topic, str] | None = None,
    ) -> None:
        self.publishers = tuple(publishers)
        self._counted_topics = topics
        self._required = tuple(required)
        self._names = names or {}
        self._topics: dict[Topic, TopicCount] = {}
        self._ended: dict[str, str | None] = {}  # why early, by publisher; None: not early

    def add(self, topic: Topic, seq: int | None, time: int | None = None) -> None:
        """Count a message that was received.

        ``seq`` is its sequence number, None if it has none; ``time`` its log time, ns, or None.
        """
        entry = self._topics.get(topic)
        if entry is None:
            entry = self._topics[topic] = TopicCount()
        entry.received += 1
        if time is not None:
            if entry.first is None:
                entry.first = entry.last = time
            entry.longest_gap = max(entry.longest_gap, time - entry.last)
            entry.last = time
        if seq is None:
            return
        if seq == entry.next_seq:
            entry.next_seq += 1
        elif seq > entry.next_seq:
            entry.missing += seq - entry.next_seq
            if len(entry.gaps) < MAX_GAPS:
                entry.gaps.append((entry.next_seq, seq - 1))
            entry.next_seq = seq + 1
        else:
            entry.out_of_order += 1

    def end(
        self, publisher: str, counts: Mapping[str, int], *, complete: bool = True, reason: str = ""
    ) -> None:
        """Take a node's report of how many messages it sent; its second report does not count.

        ``counts`` are the numbers by name of the topic.  ``complete`` is False if the node ended
        the run early, for ``reason``.
        """
        if publisher in self._ended:
            return
        self._ended[publisher] = None if complete else reason
        for name, count in counts.items():
            topic = topic_named(name)
            is_counted = self._counted_topics is None or topic in self._counted_topics
            if topic is not None and is_counted:
                entry = self._topics.setdefault(topic, TopicCount())
                entry.expected = (entry.expected or 0) + count

    @property
    def topics(self) -> dict[Topic, TopicCount]:
        """The counts of each topic that had a message or was in a report."""
        return self._topics

    @property
    def satisfied(self) -> bool:
        """True if all publishers have reported, and their messages were received.

        Of a topic that holds a state only the last message must be received.
        """
        return set(self.publishers) <= set(self._ended) and all(
            (entry.next_seq if topic.holds_state else entry.received) >= (entry.expected or 0)
            for topic, entry in self._topics.items()
        )

    def summary(self) -> list[str]:
        """Return a line for each required topic with messages: number, rate and longest gap."""
        counts = [(topic, self._topics.get(topic, TopicCount())) for topic in self._required]
        return [
            f"{self._name(topic)}: {count.received} messages, {count.rate:.4g} Hz, "
            f"longest gap {count.longest_gap / 1e9:.3g} s"
            for topic, count in counts
            if count.received
        ]

    def _empty(self) -> list[Topic]:
        """Return the required topics without a message, of which no node reported a number."""
        counts = [(topic, self._topics.get(topic, TopicCount())) for topic in self._required]
        return [t for t, count in counts if not count.received and count.expected is None]

    def _name(self, topic: Topic) -> str:
        return self._names.get(topic, topic.name)

    def problems(self) -> list[str]:
        """Return one line for everything that is missing, repeated, disordered or cut short."""
        lines = [f"{self._name(topic)}: no message" for topic in self._empty()]
        lines += [
            # a follower reports it in these words itself
            f"{publisher} ended the run early: {reason.removeprefix('ended early: ')}"
            for publisher, reason in self._ended.items()
            if reason is not None
        ]
        lines += [
            f"{publisher}: never reported how many messages it sent; it may have been killed"
            for publisher in self.publishers
            if publisher not in self._ended
        ]
        for topic, entry in self._topics.items():
            name = self._name(topic)
            # a stream may begin late without a loss: the reported number is better known
            lost = entry.missing
            if entry.expected is not None:
                lost = entry.expected - entry.received + entry.out_of_order
            if topic.holds_state:
                if entry.next_seq < (entry.expected or 0):
                    lines.append(f"{name}: last message missing")
            elif lost > 0:
                lines.append(f"{name}: {lost} messages missing{_gaps_text(topic, entry)}")
            if entry.expected is not None and entry.received > entry.expected:
                lines.append(f"{name}: {entry.received} messages received, {entry.expected} sent")
            if entry.out_of_order:
                lines.append(f"{name}: {entry.out_of_order} messages repeated or disordered")
        return lines


def _gaps_text(topic: Topic, entry: TopicCount) -> str:
    gaps = list(entry.gaps)
    if topic.sequenced and entry.expected is not None and entry.next_seq < entry.expected:
        gaps.append((entry.next_seq, entry.expected - 1))
    if not gaps:
        return ""
    ranges = [str(a) if a == b else f"{a} to {b}" for a, b in gaps[:5]]
    return f" (seq {', '.join(ranges)}{', ...' if len(gaps) > 5 else ''})"
