"""The check of measurements: which rules of plausibility do they break?

Offline, :func:`check` is called with the measurements of a whole recording.  A running node keeps
the last seconds of messages in a :class:`capture_sim.plausibility.live.LiveMeasurements`, and calls
:func:`check` with them.  All rules are checked in both cases.  A rule that lacks the measurements
to decide finds nothing, e.g. a rule that needs a contact while the vehicles are at rest.

    doubts = check(live.measured(), scene, waived=("frames_differ",))
    refused = [doubt for doubt in doubts if doubt.grade is Grade.REFUSED]  # do not release

``doubt.line`` is the line to show; ``doubt.rule.name`` is what a user waives.
"""

from __future__ import annotations

from collections.abc import Collection

from capture_sim.errors import SceneError
from capture_sim.plausibility import buffer, clocks, force, frames, sources, units
from capture_sim.plausibility.measured import Measured
from capture_sim.plausibility.motion import MeasuredMotion
from capture_sim.plausibility.rules import RULES, Doubt, Grade, Rule, examine
from capture_sim.scene.parts import Scene

_GRADES = list(Grade)
#: The modules of rules in the order of their check: each may rely on those before it.
_MODULES = [module.__name__ for module in (sources, units, frames, clocks, buffer, force)]


def _place(item: tuple[str, Rule]) -> int:
    return _MODULES.index(item[1].check.__module__)


_in_order = dict(sorted(RULES.items(), key=_place))
RULES.clear()
RULES.update(_in_order)


def check(
    measured: Measured, scene: Scene | None = None, waived: Collection[str] = ()
) -> tuple[Doubt, ...]:
    """Return the doubts about measurements, the gravest grade first; empty if no rule is broken.

    Parameters
    ----------
    measured
        Measurements of a whole recording, or of the last seconds.
    scene
        Scene of the bench; None to skip the rules that need one.
    waived
        Names of rules that are not checked.

    Raises
    ------
    SceneError
        A name in ``waived`` is not that of a rule.
    """
    check_names(waived)
    doubts = examine(MeasuredMotion(measured, scene), waived).doubts
    return tuple(sorted(doubts, key=lambda doubt: _GRADES.index(doubt.grade)))


def check_names(waived: Collection[str]) -> None:
    """Raise SceneError if a name in ``waived`` is not that of a rule."""
    unknown = [name for name in waived if name not in RULES]
    if unknown:
        raise SceneError(f"rule {unknown[0]!r}: not found; rules: {', '.join(RULES)}")


def table_of_rules() -> str:
    """Return all rules as a table in Markdown, for the documentation."""
    head = "| rule | grade | compares | broken | reason of the threshold |\n|---|---|---|---|---|\n"
    return head + "".join(
        f"| `{each.name}` | {each.grade} | {each.compares} | {each.threshold} | {each.reason} |\n"
        for each in RULES.values()
    )
