"""Doubts about a run's measurements: refusal of the run, and removal of doubtful topics."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

from capture_sim.errors import RecordingError
from capture_sim.plausibility.check import check_names
from capture_sim.plausibility.motion import MeasuredMotion
from capture_sim.plausibility.rules import Doubt, Grade, Unapplied, examine
from capture_sim.run.lazy import LazyMapping
from capture_sim.run.series import SeriesBySource


class CountedSeries(NamedTuple):
    """Series of a run that may be evaluated, and all doubts about the run's measurements."""

    series: SeriesBySource  # by quantity and source, without topics that a rule leaves out
    doubts: tuple[Doubt, ...]  # the gravest first


def refuse(where: str, doubts: Sequence[Doubt]) -> None:
    """Raise RecordingError if one of the doubts has the grade *refused*.

    ``where`` is the path or name of the run, for the message.
    """
    refused = [doubt for doubt in doubts if doubt.grade is Grade.REFUSED]
    if refused:
        waive = " ".join(f"--waive {name}" for name in dict.fromkeys(d.rule.name for d in refused))
        raise RecordingError(
            f"{where}: {'; '.join(doubt.line for doubt in refused)} (evaluated all the same with "
            f"{waive})"
        )


def remaining(series: SeriesBySource, doubts: Sequence[Doubt]) -> SeriesBySource:
    """Return series without the topics that doubts exclude, see ``Doubt.leaves_out_topic``.

    Quantities without any remaining topic are removed.
    """
    topics = {
        topic.lstrip("/")
        for doubt in doubts
        if doubt.leaves_out_topic
        for topic in doubt.topic.split(" and ")
    }
    if not topics:
        return series
    kept = {
        quantity: sources.without(topics)
        if isinstance(sources, LazyMapping)
        else {name: each for name, each in sources.items() if name not in topics}
        for quantity, sources in series.items()
    }
    return {quantity: sources for quantity, sources in kept.items() if sources}


def examined(
    motions: Sequence[MeasuredMotion], waived: Collection[str]
) -> tuple[tuple[Doubt, ...], tuple[Unapplied, ...]]:
    """Return the doubts about measurements, the gravest first, and the rules that were not applied.

    There is one doubt for each broken rule and topic.  A rule counts as applied if it was to one of
    the motions.  ``waived`` are names of rules that are not applied; SceneError if one of them does
    not exist.
    """
    check_names(waived)
    found: dict[tuple[str, str], Doubt] = {}
    lacking: dict[str, list[Unapplied]] = {}
    for motion in motions:
        doubts, unapplied = examine(motion, waived)
        for doubt in doubts:
            found.setdefault((doubt.rule.name, doubt.topic), doubt)
        for each in unapplied:
            lacking.setdefault(each.rule.name, []).append(each)
    order = list(Grade)
    return (
        tuple(sorted(found.values(), key=lambda doubt: order.index(doubt.grade))),
        tuple(each[0] for each in lacking.values() if len(each) == len(motions)),
    )
