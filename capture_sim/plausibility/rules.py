"""Types of a rule, its grade and its doubts; the table of all rules."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from capture_sim.plausibility.momentum import has_change, lacks_rate
from capture_sim.plausibility.motion import MeasuredMotion


class Grade(StrEnum):
    """What a broken rule does to the measurements, the gravest grade first."""

    REFUSED = "refused"  # the run is not evaluated: no result would mean anything
    LEFT_OUT = "left out"  # these messages are not used: they are no measurements
    NOTED = "noted"  # the messages are used, and the doubt is reported


class Said(NamedTuple):
    """One finding of a rule's check: the topic, and what is wrong with its messages.

    Some rules find several topics, and yield one finding for each.
    """

    topic: str  # or two topics, joined by " and "
    text: str  # value, unit, expectation, and what to do
    messages: int | None = None  # number of messages concerned; None: all of the topic
    grade: Grade | None = None  # None: the rule's


Check = Callable[[MeasuredMotion], Iterable[Said]]


@dataclass(frozen=True, eq=False)
class Rule:
    """One rule of plausibility: its check, and the texts that explain it to the user."""

    name: str
    grade: Grade  # the gravest that it gives
    compares: str  # what is compared with what
    threshold: str  # with its unit
    reason: str  # of the threshold
    needs: tuple[str, ...]  # keys of NEEDS: without one of them the rule is not applied
    check: Check


@dataclass(frozen=True)
class Doubt:
    """A broken rule with one of its findings, see :class:`Said`."""

    rule: Rule
    topic: str  # whose messages are doubted; or two topics, joined by " and "
    text: str  # value, unit, expectation, and what to do
    messages: int | None = None  # number of messages concerned; None: all of the topic
    of_size: Grade | None = None  # grade by the size of the fault; None: that of the rule

    @property
    def grade(self) -> Grade:
        """Grade of the broken rule: what it does to these measurements."""
        return self.of_size or self.rule.grade

    @property
    def leaves_out_topic(self) -> bool:
        """True if the doubt excludes all messages of the topic: not for the grade NOTED."""
        return self.messages is None and self.grade is not Grade.NOTED

    @property
    def line(self) -> str:
        """The doubt in one line: topic, grade, name of the rule, text."""
        return f"{self.topic}: {self.grade} ({self.rule.name}): {self.text}"


#: Every rule by its name.
RULES: dict[str, Rule] = {}
#: Modules of rules in the order of their check: each may rely on those before it.
_MODULES = ("sources", "units", "frames", "clocks", "buffer", "force")


def in_order() -> list[Rule]:
    """Return all rules in the order in which they are checked."""
    return sorted(
        RULES.values(), key=lambda each: _MODULES.index(each.check.__module__.rpartition(".")[2])
    )


def rule(
    name: str,
    grade: Grade,
    *,
    compares: str,
    threshold: str,
    reason: str,
    needs: tuple[str, ...] = (),
) -> Callable[[Check], Check]:
    """Return a decorator that adds a function to :data:`RULES` as the check of the rule ``name``.

    The other arguments are the fields of :class:`Rule`.  The function itself is returned unchanged.
    """

    def add(check: Check) -> Check:
        RULES[name] = Rule(name, grade, compares, threshold, reason, needs, check)
        return check

    return add


class Unapplied(NamedTuple):
    """A rule that was not applied to measurements, and why."""

    rule: Rule
    reason: str


class Examined(NamedTuple):
    """What the rules say of measurements."""

    doubts: tuple[Doubt, ...]  # in the order of :data:`RULES`
    unapplied: tuple[Unapplied, ...]


#: What rules need, by name: a function that returns why it is lacking, '' if it is not.
NEEDS: dict[str, Callable[[MeasuredMotion], str]] = {
    "scene": lambda motion: "" if motion.scene is not None else "no scene",
    "poses": lambda motion: "" if motion.pair is not None else "no poses of both vehicles",
    "buffer": lambda motion: "" if motion.buffer is not None else "no state of the buffer",
    "rate": lacks_rate,
    "force": lambda motion: "" if motion.force is not None else "no force in known axes",
    "contact": lambda motion: (
        "" if has_change(motion) else "no contact that changes the chaser's speed"
    ),
}


def examine(motion: MeasuredMotion, waived: Iterable[str] = ()) -> Examined:
    """Return a doubt for each finding of the rules, in the order of :func:`in_order`.

    A rule is not applied if ``waived`` has its name, or if something is lacking that it needs.
    Poses of which a rule of grade REFUSED has been broken are lacking.
    """
    left, doubts, unapplied, lacking = set(waived), [], [], dict[str, str]()
    for each in in_order():
        reason = "waived" if each.name in left else ""
        for need in each.needs:
            if need not in lacking:
                lacking[need] = NEEDS[need](motion)
            reason = reason or lacking[need]
        if reason:
            unapplied.append(Unapplied(each, reason))
            continue
        for said in each.check(motion):
            doubt = Doubt(each, *said)
            doubts.append(doubt)
            of_poses = set(motion.pair_topic.split(" and ")) & set(said.topic.split(" and "))
            if doubt.grade is Grade.REFUSED and of_poses and not lacking.get("poses"):
                lacking["poses"] = f"poses refused ({each.name})"
    return Examined(tuple(doubts), tuple(unapplied))
