"""``capture-sim reproduce``."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Sequence

from capture_sim.commands import OK
from capture_sim.commands.compiling import compile_first
from capture_sim.commands.inputs import add_out, add_workers, prepare_folder
from capture_sim.commands.output import say, write_text
from capture_sim.errors import SceneError
from capture_sim.studies.executors import default_workers, open_executor
from capture_sim.studies.paper import CASES, OPEN, Claim, Evidence, Scan, claims
from capture_sim.viewing.canvas import save
from capture_sim.viewing.paper_figures import FIGURES

DESCRIPTION = (
    "Run the paper's numerical section and its experiments, in about a minute; write a page with "
    "a table 'paper says, we get, difference, why' and the figures."
)
#: Of the page and of the folder of its figures.
NAME = "reproduction"
_PAGE = """\
# The paper, reproduced

*A New Buffer in Impact Reduction for Aerospace Applications*, sections 5 and 6. Made by

```sh {{.minutes}}
.venv/bin/capture-sim reproduce --out docs
```

from the scenes in config/scenes; none of it is written by hand. Restitution 0.5, friction tanh \
with v_eps = 1 mm/s, captured = within 5 mm of the centre of BE for 0.2 s, unless stated \
otherwise: the paper gives none of these.

{agree} statements agree, {differ} do not, {open} cannot be compared.

| paper | it says | here | difference | why | agrees |
|---|---|---|---|---|---|
{claims}

The second engine of Figures 10 and 11: {engine}; its velocities are kept in config/reference.

## Under which assumptions each verdict holds

One assumption varied at a time, all else as in the scenes; the values at which the verdict is the \
paper's. (The grids are in `capture_sim/studies/paper.py`; 'all' means its whole range there.)

| assumption | the paper | tried | {cases} |
|---|---|---|{rules}|
{scans}

Everything that the paper leaves open varied together ({count} samples, Latin hypercube; SI \
units: {fields}): the verdict is the paper's in {shares}; all five at once in {all_five:.0%}; \
designed captured and case 2 not in {designed_2:.0%}; case 2 not and case 3 captured in \
{two_3:.0%}.
{conclusion}
## Damping of a touch, and its memory

The contact's damping is chi = a K / v_0 with v_0 of the touch's first approach, kept for as long \
as the touch lasts, also where chatter has become one sustained contact. What a factor that \
returns e exactly, and damping without that memory, change:

| case | damping | first contact | largest force | nearest to BE | verdict |
|---|---|---|---|---|---|
{damping}

## Figures
{figures}"""
_CONCLUSION = """
Case 2 and the designed case cannot both be as the paper says under any of these: with the paper's \
numbers the softer, less damped buffer of case 2 brings the tip nearer to BE than the designed one \
does, so whatever radius refuses it refuses the designed one too. Also tried, before this program: \
friction in the fixed direction of eq. (12), with which no case captures, and damping of the \
probe's turning by a literal eq. (9), which moves the tip by 0.13 mm.
"""
_FIGURE = """
### {title}

![{title}]({folder}/{name}.png)

`.venv/bin/capture-sim reproduce --only {name} --out runs`
"""
EXAMPLE = "  capture-sim reproduce --out runs"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_out(parser, "runs", "folder of reproduction.md and reproduction/")
    parser.add_argument(
        "--only", metavar="FIGURE", help="draw one figure, as figure_6, into the folder"
    )
    add_workers(parser, scheduler=False)


def run(options: argparse.Namespace) -> int:
    """Do it; return the exit status."""
    if options.only is not None and options.only not in FIGURES:
        raise SceneError(f"--only {options.only}: allowed are {', '.join(FIGURES)}")
    folder = options.out / NAME
    prepare_folder(folder)
    compile_first()
    with open_executor(options.workers or default_workers()) as executor:
        evidence = Evidence(executor)
        for name in FIGURES if options.only is None else (options.only,):
            path = save(FIGURES[name].draw(evidence), folder / f"{name}.png")
            say(f"{FIGURES[name].title}: {path}")
        if options.only is not None:
            return OK
        found = list(claims(evidence))
        titles = {name: figure.title for name, figure in FIGURES.items()}
        text = page(found, evidence, titles)
    say("")
    say(terminal_table(found))
    say("")
    target = write_text(options.out / f"{NAME}.md", text)
    say(f"page in {target}, figures in {folder}")
    return OK


def page(claims: Sequence[Claim], evidence: Evidence, titles: dict[str, str]) -> str:
    """Return the page as Markdown; ``titles`` of the figures by name."""
    agreed = [claim.agrees for claim in claims]
    names = [case.removeprefix("paper_") for case in CASES]
    together = evidence.together
    shares = (f"{together.share(case):.0%} ({n})" for n, case in zip(names, CASES, strict=True))
    designed_2 = together.share("paper_designed", "paper_case_2")
    return _PAGE.format(
        agree=agreed.count(True),
        differ=agreed.count(False),
        open=agreed.count(None),
        claims=_rows(
            [*claim[:-1], {True: "yes", False: "**no**", None: "-"}[claim.agrees]]
            for claim in claims
        ),
        engine=evidence.engine.source,
        cases=" | ".join(names),
        rules="|".join("---" for _ in names),
        scans=_rows(
            [scan.assumption.name, scan.assumption.stated, _tried(scan), *map(scan.where, CASES)]
            for scan in evidence.scans
        ),
        count=together.count,
        fields=", ".join(f"{name} {low:g} to {high:g}" for name, low, high, _ in OPEN),
        shares=", ".join(shares),
        all_five=together.share(*CASES),
        designed_2=designed_2,
        two_3=together.share("paper_case_2", "paper_case_3"),
        conclusion="" if designed_2 > 0.0 else _CONCLUSION,
        damping=_rows(_damping(evidence)),
        figures="".join(
            _FIGURE.format(title=title, name=name, folder=NAME) for name, title in titles.items()
        ),
    )


def _rows(cells: Iterable[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(row)} |" for row in cells)


def _tried(scan: Scan) -> str:
    of = scan.assumption
    if isinstance(of.values[0], str):
        return f"{len(of.values)} laws"
    low, high = float(min(of.values)) * of.factor, float(max(of.values)) * of.factor
    return f"{low:.4g} to {high:.4g} {of.unit}".rstrip()


def _damping(evidence: Evidence) -> Iterator[list[str]]:
    for (case, how), run in evidence.damping.items():
        s = run.summary
        yield [
            case.removeprefix("paper_"),
            how,
            f"{s['first_contact_duration'] * 1e3:.1f} ms",
            f"{s['peak_force']:.1f} N",
            f"{s['nearest_distance'] * 1e3:.2f} mm",
            s["verdict"],
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
