"""Rule, grade and doubt; the table of all rules."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from capture_sim.plausibility.motion import MeasuredMotion


class Grade(StrEnum):
    """The consequence of a broken rule."""

    REFUSED = "refused"  # no answer would mean anything
    LEFT_OUT = "left out"  # these messages are no measurements
    NOTED = "noted"  # used, and here is the doubt


class Said(NamedTuple):
    """The finding of a rule's check: topic, text and number of messages; None is all of them."""

    topic: str
    text: str
    messages: int | None = None


Check = Callable[[MeasuredMotion], Iterable[Said]]


@dataclass(frozen=True, eq=False)
class Rule:
    """One rule of plausibility."""

    name: str
    grade: Grade
    compares: str  # what is compared with what
    threshold: str  # with its unit
    reason: str  # of the threshold
    needs_scene: bool
    needs_poses: bool  # skipped once another rule has refused a measurement
    check: Check


@dataclass(frozen=True)
class Doubt:
    """A broken rule."""

    rule: Rule
    topic: str  # whose messages are doubted
    text: str  # value, unit, expectation, and what to do
    messages: int | None = None  # number that is left out; None: all of the topic

    @property
    def grade(self) -> Grade:
        """The consequence of the broken rule."""
        return self.rule.grade

    @property
    def leaves_out_topic(self) -> bool:
        """True if no message of the topic is used."""
        return self.messages is None and self.grade is not Grade.NOTED

    @property
    def line(self) -> str:
        """The doubt in one line: topic, grade, name of the rule, text."""
        return f"{self.topic}: {self.grade} ({self.rule.name}): {self.text}"


#: Every rule by its name, in the order in which they are checked.
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
    """Add a function to :data:`RULES` as the check of a rule."""

    def add(check: Check) -> Check:
        RULES[name] = Rule(
            name, grade, compares, threshold, reason, needs_scene, needs_poses, check
        )
        return check

    return add


def broken(motion: MeasuredMotion, waived: Iterable[str] = ()) -> Iterator[Doubt]:
    """Yield a doubt for each rule that is broken, without the waived ones."""
    left, refused = set(waived), False
    for each in RULES.values():
        if each.name in left or (each.needs_scene and motion.scene is None):
            continue
        if each.needs_poses and refused:
            continue  # it would only repeat that the poses are wrong
        for said in each.check(motion):
            refused = refused or each.grade is Grade.REFUSED
            yield Doubt(each, *said)
