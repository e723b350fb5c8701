"""``capture-sim reproduce``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from jinja2 import Environment, PackageLoader, StrictUndefined

from capture_sim.commands import OK
from capture_sim.commands.compiling import compile_first
from capture_sim.commands.inputs import add_out, add_workers, prepare_folder
from capture_sim.commands.output import echo, write_text
from capture_sim.errors import SceneError
from capture_sim.studies.executors import open_executor
from capture_sim.studies.paper import CASES, OPEN, Claim, Evidence, claims
from capture_sim.viewing.canvas import save
from capture_sim.viewing.paper_figures import FIGURES

DESCRIPTION = (
    "Run the paper's numerical section and its experiments, in about a minute; write a page with "
    "a table 'paper says, we get, difference, why' and the figures."
)
#: Of the page and of the folder of its figures.
NAME = "reproduction"
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
        raise SceneError(f"--only {options.only}: must be one of {', '.join(FIGURES)}")
    folder = options.out / NAME
    prepare_folder(folder)
    compile_first()
    with open_executor(options.workers) as executor:
        evidence = Evidence(executor)
        for name in FIGURES if options.only is None else (options.only,):
            path = save(FIGURES[name].draw(evidence), folder / f"{name}.png")
            echo(f"{FIGURES[name].title}: {path}")
        if options.only is not None:
            return OK
        found = list(claims(evidence))
        titles = {name: figure.title for name, figure in FIGURES.items()}
        text = page(found, evidence, titles)
    echo("")
    echo(terminal_table(found))
    echo("")
    target = write_text(options.out / f"{NAME}.md", text)
    echo(f"page in {target}, figures in {folder}")
    return OK


def page(claims: Sequence[Claim], evidence: Evidence, titles: dict[str, str]) -> str:
    """Return the page as Markdown; ``titles`` of the figures by name."""
    environment = Environment(
        loader=PackageLoader("capture_sim.viewing", "."),
        trim_blocks=True,
        keep_trailing_newline=True,
        undefined=StrictUndefined,
    )
    environment.filters["percent"] = "{:.0%}".format
    return environment.get_template("reproduction.md.j2").render(
        claims=claims,
        agreed=[claim.agrees for claim in claims],
        evidence=evidence,
        names={case: case.removeprefix("paper_") for case in CASES},
        open=OPEN,
        folder=NAME,
        titles=titles,
    )


def terminal_table(claims: Sequence[Claim]) -> str:
    """Return the claims as text for a terminal."""
    lines = []
    for claim in claims:
        mark = {True: "agrees", False: "DIFFERS", None: "-"}[claim.agrees]
        lines.append(f"{claim.where:10} {mark:8} {claim.paper}")
        detail = "; ".join(part for part in (claim.here, claim.difference, claim.why) if part)
        lines.append(f"{'':19} {detail}")
    return "\n".join(lines)
