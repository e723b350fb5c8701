"""The page: table, figures with the command that makes each, and what the readings do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from capture_sim.reproduction.claims import Claim
from capture_sim.reproduction.readings import CASES, OPEN, Scan, Together

#: Of the page and its figures, in the folder that is asked for.
NAME = "reproduction"

_COMMAND = ".venv/bin/capture-sim reproduce"
_MARK = {True: "yes", False: "**no**", None: "-"}


@dataclass
class Reproduction:
    """All that the page tells.

    ``pictures`` are titles by name of the figures that were drawn, ``left_out`` what was not
    and why.
    """

    claims: list[Claim]
    scans: list[Scan] = field(default_factory=list)
    together: Together | None = None
    pictures: dict[str, str] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)


def table(claims: Sequence[Claim]) -> list[str]:
    """Return the lines of the table."""
    head = ["| paper | it says | here | difference | why | agrees |", "|---|---|---|---|---|---|"]
    return head + [
        f"| {c.where} | {c.paper} | {c.here} | {c.difference} | {c.why} | {_MARK[c.agrees]} |"
        for c in claims
    ]


def page(found: Reproduction) -> str:
    """Return the page as Markdown."""
    agreed = [claim.agrees for claim in found.claims]
    lines = [
        "# The paper, reproduced",
        "",
        "*A New Buffer in Impact Reduction for Aerospace Applications*, sections 5 and 6. Made by",
        "",
        f"    {_COMMAND} --out docs",
        "",
        "from the scenes in config/scenes; none of it is written by hand. Restitution 0.5, "
        "friction tanh with v_eps = 1 mm/s, captured = within 5 mm of the centre of BE for 0.2 s, "
        "unless it says otherwise: the paper gives none of these.",
        "",
        f"{agreed.count(True)} statements agree, {agreed.count(False)} do not, "
        f"{agreed.count(None)} cannot be compared.",
        "",
        *table(found.claims),
        "",
    ]
    if found.scans and found.together is not None:
        lines += _readings(found.scans, found.together)
    lines += ["## Figures", ""]
    for name, title in found.pictures.items():
        lines += _picture(name, title)
    for title, why in found.left_out.items():
        lines += [f"### {title}", "", f"Not drawn: {why}.", ""]
    return "\n".join(lines).rstrip() + "\n"


def _picture(name: str, title: str) -> list[str]:
    return [
        f"### {title}",
        "",
        f"![{title}]({NAME}/{name}.png)",
        "",
        f"    {_COMMAND} --only {name} --out runs",
        "",
    ]


def _readings(scans: Sequence[Scan], together: Together) -> list[str]:
    names = [case.removeprefix("paper_") for case in CASES]
    lines = [
        "## Over which readings each verdict holds",
        "",
        "One reading varied at a time, all else as taken here; the values at which the verdict is "
        "the paper's. (The grids are in `capture_sim/reproduction/readings.py`; what is said to be "
        "all, is all of its range there.)",
        "",
        f"| reading | the paper | tried | {' | '.join(names)} |",
        "|---|---|---|" + "---|" * len(names),
    ]
    for scan in scans:
        r = scan.reading
        where = " | ".join(scan.where(case) for case in CASES)
        lines.append(f"| {r.name} | {r.stated} | {_tried(scan)} | {where} |")
    shares = {name: together.share(case) for name, case in zip(names, CASES, strict=True)}
    fields = ", ".join(f"{name} {low:g} to {high:g}" for name, low, high, _ in OPEN)
    lines += [
        "",
        f"All that the paper leaves open varied together ({together.count} readings, Latin "
        f"hypercube; SI units: {fields}): the verdict is the paper's in "
        + ", ".join(f"{share:.0%} ({name})" for name, share in shares.items())
        + f"; all five at once in {together.share(*CASES):.0%}; designed captured and case 2 not "
        f"in {together.share('paper_designed', 'paper_case_2'):.0%}; case 2 not and case 3 "
        f"captured in {together.share('paper_case_2', 'paper_case_3'):.0%}.",
        "",
        *_conclusion(together),
    ]
    return lines


def _tried(scan: Scan) -> str:
    r = scan.reading
    if isinstance(r.values[0], str):
        return f"{len(r.values)} laws"
    low, high = float(min(r.values)) * r.factor, float(max(r.values)) * r.factor
    return f"{low:.4g} to {high:.4g} {r.unit}".rstrip()


def _conclusion(together: Together) -> list[str]:
    if together.share("paper_designed", "paper_case_2") > 0.0:
        return []
    return [
        "Case 2 and the designed case cannot both be as the paper says under any of these: with "
        "the paper's numbers the softer, less damped buffer of case 2 brings the tip nearer to BE "
        "than the designed one does, so whatever radius refuses it refuses the designed one too. "
        "Also tried, before this program: friction in the fixed direction of eq. (12), with which "
        "no case captures, and damping of the probe's turning by a literal eq. (9), which moves "
        "the tip by 0.13 mm.",
        "",
    ]


def terminal_table(claims: Sequence[Claim]) -> str:
    """Return the claims as text for a terminal."""
    lines = []
    for claim in claims:
        mark = {True: "agrees", False: "DIFFERS", None: "-"}[claim.agrees]
        lines.append(f"{claim.where:10} {mark:8} {claim.paper}")
        detail = "; ".join(part for part in (claim.here, claim.difference, claim.why) if part)
        lines.append(f"{'':19} {detail}")
    return "\n".join(lines)
