"""All rules of plausibility, and their names as a user gives them."""

from __future__ import annotations

from collections.abc import Collection

from capture_sim.errors import SceneError

# importing them adds their rules to RULES
from capture_sim.plausibility import buffer as buffer
from capture_sim.plausibility import clocks as clocks
from capture_sim.plausibility import force as force
from capture_sim.plausibility import frames as frames
from capture_sim.plausibility import sources as sources
from capture_sim.plausibility import units as units
from capture_sim.plausibility.rules import RULES, in_order


def check_names(waived: Collection[str]) -> None:
    """Raise SceneError if a name in ``waived`` is not that of a rule."""
    unknown = [name for name in waived if name not in RULES]
    if unknown:
        names = ", ".join(rule.name for rule in in_order())
        raise SceneError(f"rule {unknown[0]!r}: not found; rules: {names}")


def rules_among(waived: Collection[str]) -> tuple[str, ...]:
    """Return which rules of plausibility a trial waives, of all names that its laboratory gave.

    Who waives ``machine_clock`` has a clock of any rate, also of one that varies: that it was set
    is then not told from that.
    """
    implied = ["clock_steps"] if "machine_clock" in waived else []
    return tuple(name for name in RULES if name in {*waived, *implied})
