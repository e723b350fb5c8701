"""Types of a rule, its grade and its doubts; the table of all rules."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

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
    zero: tuple[float, float] = (0.0, 0.0)  # of stroke (m) and torsion (rad), to be subtracted


Check = Callable[[MeasuredMotion], Iterable[Said]]


@dataclass(frozen=True, eq=False)
class Rule:
    """One rule of plausibility: its check, and the texts that explain it to the user."""

    name: str
    grade: Grade
    compares: str  # what is compared with what
    threshold: str  # with its unit
    reason: str  # of the threshold
    needs_scene: bool  # not checked without a scene
    needs_poses: bool  # not checked after any rule of grade REFUSED has been broken
    check: Check


@dataclass(frozen=True)
class Doubt:
    """A broken rule with one of its findings, see :class:`Said`."""

    rule: Rule
    topic: str  # whose messages are doubted; or two topics, joined by " and "
    text: str  # value, unit, expectation, and what to do
    messages: int | None = None  # number of messages concerned; None: all of the topic
    zero: tuple[float, float] = (0.0, 0.0)  # of stroke (m) and torsion (rad), to be subtracted

    @property
    def grade(self) -> Grade:
        """Grade of the broken rule."""
        return self.rule.grade

    @property
    def leaves_out_topic(self) -> bool:
        """True if the doubt excludes all messages of the topic: not for the grade NOTED."""
        return self.messages is None and self.grade is not Grade.NOTED

    @property
    def line(self) -> str:
        """The doubt in one line: topic, grade, name of the rule, text."""
        return f"{self.topic}: {self.grade} ({self.rule.name}): {self.text}"


#: Every rule by its name.  ``check.py`` puts them in the order in which they are checked.
RULES: dict[str, Rule] = {}


def rule(
    name: str,
    grade: Grade,
    *,
    compares: str,
    threshold: str,
    reason: str,
    needs_scene: bool = False,
    needs_poses: bool = False,
) -> Callable[[Check], Check]:
    """Return a decorator that adds a function to :data:`RULES` as the check of the rule ``name``.

    The other arguments are the fields of :class:`Rule`.  The function itself is returned unchanged.
    """

    def add(check: Check) -> Check:
        RULES[name] = Rule(
            name, grade, compares, threshold, reason, needs_scene, needs_poses, check
        )
        return check

    return add


def broken(motion: MeasuredMotion, waived: Iterable[str] = ()) -> Iterator[Doubt]:
    """Yield a doubt for each finding of the rules, in the order of :data:`RULES`.

    A rule is not checked if ``waived`` has its name, if it needs a scene and there is none, or if
    it needs poses and a rule of grade REFUSED has been broken before.
    """
    left, refused = set(waived), False
    for each in RULES.values():
        if each.name in left or (each.needs_scene and motion.scene is None):
            continue
        if each.needs_poses and refused:
            continue  # it would only repeat that the poses are wrong
        for said in each.check(motion):
            refused = refused or each.grade is Grade.REFUSED
            yield Doubt(each, *said)
