"""The paper reproduced: a table 'paper says, we get, difference, why', and the figures.

    make reproduction                                           # a minute or two
    python -m benchmarks.reproduction --only figure_6 --out runs

Runs the paper's numerical section and its experiments, and writes
docs/evidence/reproduction.md and the figures in docs/evidence/reproduction/.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from benchmarks.pages import EVIDENCE
from benchmarks.paper import CASES, OPEN, Agreement, Claim, Evidence, claims
from benchmarks.paper_figures import FIGURES
from capture_sim.base.files import whole_file
from capture_sim.dynamics.compilation import compile_kernels
from capture_sim.studies.evaluate.executors import open_executor
from capture_sim.viewing.canvas import save

#: Name of the page and of the folder of its figures.
NAME = "reproduction"


def main() -> None:
    """Run everything, or what one figure needs, and write it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", choices=FIGURES, help="draw one figure, and write no page")
    parser.add_argument(
        "--out", type=Path, default=EVIDENCE, help="folder to write (default: docs/evidence)"
    )
    parser.add_argument("--workers", type=int, help="processes (default: one per core)")
    options = parser.parse_args()
    folder = options.out / NAME
    folder.mkdir(parents=True, exist_ok=True)
    compile_kernels()
    with open_executor(options.workers) as executor:
        evidence = Evidence(executor)
        for name in FIGURES if options.only is None else (options.only,):
            path = save(FIGURES[name].draw(evidence), folder / f"{name}.png")
            print(f"{FIGURES[name].title}: {path}", flush=True)
        if options.only is not None:
            return
        found = list(claims(evidence))
        titles = {name: figure.title for name, figure in FIGURES.items()}
        text = page(found, evidence, titles)
    print(f"\n{terminal_table(found)}\n")
    with whole_file(options.out / f"{NAME}.md") as part:
        part.write_text(text, encoding="utf-8")


def page(claims: Sequence[Claim], evidence: Evidence, titles: dict[str, str]) -> str:
    """Return the page as Markdown; ``titles`` of the figures by name."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        trim_blocks=True,
        keep_trailing_newline=True,
        undefined=StrictUndefined,
    )
    environment.filters["percent"] = "{:.0%}".format
    return environment.get_template("reproduction.md.j2").render(
        claims=claims,
        agreements=[(kind, [c.agreement for c in claims].count(kind)) for kind in Agreement],
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
        lines.append(f"{claim.where:10} {claim.agreement:18} {claim.paper}")
        detail = "; ".join(part for part in (claim.here, claim.difference, claim.why) if part)
        lines.append(f"{'':29} {detail}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
