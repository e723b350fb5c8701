"""Recordings compared by their values: who serialises leaves other bytes between the fields."""

from __future__ import annotations

from capture_sim.messages.topics import SHOWN, topic_named


def holds_state(topic):
    """Return True if DDS may replace a message of a topic by the next one on its way."""
    known = topic_named(topic)
    return known is not None and known.holds_state


def counts_of(run):
    """Return how many messages the topics of a live recording have, states apart."""
    return {name: None if holds_state(name) else count for name, count in run.topics.items()}


def n_sent(run):
    """Return how many messages of a recording nodes have sent, without those that show it."""
    shown = {topic.absolute_name for topic in SHOWN}
    return sum(count for name, count in run.topics.items() if name not in shown)


def values_of(run, topic):
    """Return all that a topic's messages say, to compare to the last bit; of states the last."""
    if topic in {shown.name for shown in SHOWN}:  # lists, in the order in which poses came
        return sorted(run.raw(topic))
    first = -1 if holds_state(topic) else 0
    columns = {name: column[first:] for name, column in run.columns(topic).items()}
    return {
        name: [getattr(value, "tolist", lambda value=value: value)() for value in column]
        if column.dtype == object
        else (column.dtype.str, column.shape, column.tobytes())
        for name, column in columns.items()
    }
