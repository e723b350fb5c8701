"""``capture-sim sensitivity``."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator
from functools import partial
from typing import Any

from capture_sim.commands import OK
from capture_sim.commands.compiling import compile_first
from capture_sim.commands.inputs import (
    SEEDS,
    add_out,
    add_scene,
    add_workers,
    load,
    number,
    prepare_folder,
    whole,
)
from capture_sim.commands.output import Progress, drawing, echo, print_table, write_json, write_text
from capture_sim.scene.quantities import Range
from capture_sim.studies.executors import open_executor
from capture_sim.studies.sensitivity import (
    QUANTITIES,
    SMOOTH,
    Global,
    Local,
    check_method,
    default_parameters,
    global_sensitivity,
    local_sensitivity,
)

DESCRIPTION = (
    "How peak force, strokes and verdict move with each parameter: derivatives, a tornado over "
    "the parameters' spreads, and Morris' or Sobol's indices."
)
EXAMPLE = "  capture-sim sensitivity paper_designed --method sobol --samples 64"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_scene(parser, "paper_designed")
    parser.add_argument(
        "--spread",
        type=number(Range(0.0, 50.0, low_open=True), " %"),
        default=10.0,
        metavar="PERCENT",
        help="of each parameter, to either side; offset 2 mm, angles 1 deg (default: 10)",
    )
    parser.add_argument(
        "--method",
        choices=("morris", "sobol", "none"),
        default="morris",
        help="for all parameters at once (default: morris)",
    )
    parser.add_argument(
        "--samples", type=whole(), default=32, help="trajectories, or base samples (default: 32)"
    )
    parser.add_argument("--seed", type=whole(SEEDS), default=1, help="of the samples (default: 1)")
    add_workers(parser)
    add_out(parser, "runs/sensitivity")


def run(options: argparse.Namespace) -> int:
    """Do it; return the exit status."""
    scene = load(options.scene, options.overrides)
    parameters = default_parameters(options.spread / 100.0)
    if options.method != "none":
        check_method(options.method, options.samples)
    prepare_folder(options.out)
    compile_first()
    all_at_once: Global | None = None
    with (
        open_executor(options.workers, options.scheduler) as executor,
        Progress() as progress,
    ):
        near = local_sensitivity(scene, parameters, executor, partial(progress.at, "derivatives"))
        if options.method != "none":
            all_at_once = global_sensitivity(
                scene,
                parameters,
                executor,
                options.method,
                options.samples,
                options.seed,
                partial(progress.at, options.method),
            )
    echo("change of each quantity for a parameter that is off by its spread, by its derivative")
    echo("(!: ill-conditioned, does not converge; *: another verdict at an end of the spread)\n")
    head = ["parameter", "spread", *[f"{q.name} {q.unit}" for q in SMOOTH]]
    print_table(head, _rows(near, "*", "!", 5))
    if all_at_once is not None:
        echo(
            f"captured in {all_at_once.captured:.1%} of {all_at_once.runs} runs over the whole "
            "spread"
        )
    kept = write_json(options.out / "sensitivity.json", _numbers(near, all_at_once))
    page = write_text(options.out / "sensitivity.md", _page(head, near, all_at_once, options))
    echo(f"numbers in {kept}, page in {page}")
    with drawing():
        from capture_sim.viewing.canvas import save
        from capture_sim.viewing.studies import draw_indices, draw_tornado

        echo(f"tornado in {save(draw_tornado(near), options.out / 'tornado.png')}")
        if all_at_once is not None:
            path = options.out / f"{all_at_once.method}.png"
            echo(f"indices in {save(draw_indices(all_at_once), path)}")
    return OK


def _rows(near: Local, flips: str, unsettled: str, digits: int) -> Iterator[list[str]]:
    """Yield the rows of the table: name, spread, and a cell for each quantity in its unit."""
    base = zip(SMOOTH, near.base.tolist(), strict=False)  # the last is the verdict
    yield ["at the scene", "", *[f"{q.factor * v:.{digits}g}" for q, v in base]]
    for parameter, row, low, high in zip(
        near.parameters, near.derivatives, near.low, near.high, strict=True
    ):
        yield [
            parameter.name + (flips if {low[-1], high[-1]} != {near.base[-1]} else ""),
            parameter.displayed_spread,
            *[
                f"{q.factor * d.value:.3g}" + ("" if d.converged else unsettled)
                for q, d in zip(SMOOTH, row, strict=True)
            ],
        ]


def _numbers(near: Local, all_at_once: Global | None) -> dict[str, Any]:
    kept = {"quantities": [q.name for q in QUANTITIES], **dataclasses.asdict(near)}
    if all_at_once is not None:
        indices = dataclasses.asdict(all_at_once)
        del indices["parameters"]
        kept[indices.pop("method")] = indices
    return kept


def _page(
    head: list[str], near: Local, all_at_once: Global | None, options: argparse.Namespace
) -> str:
    """Return derivatives and pictures as a page in Markdown."""
    command = f"capture-sim sensitivity {options.scene} --method {options.method}"
    command += f" --samples {options.samples} --seed {options.seed} --spread {options.spread:g}"
    lines = [
        f"# What {options.scene} depends on",
        "",
        f"Made by `.venv/bin/{command}`, as are both figures. Force, strokes and duration are of "
        "the first contact; nearest is until the verdict.",
        "",
        "Change of each quantity for a parameter that is off by its spread, by its derivative. "
        "**!**: ill-conditioned, the difference quotient does not converge as its step shrinks. "
        "**\\***: another verdict at an end of the spread.",
        "",
        f"| {' | '.join(head)} |",
        "|---" * len(head) + "|",
        *[f"| {' | '.join(row)} |" for row in _rows(near, " **\\***", " **!**", 4)],
        "",
        "![Tornado](tornado.png)",
        "",
    ]
    if all_at_once is not None:
        lines += [
            f"All at once: captured in {all_at_once.captured:.1%} of {all_at_once.runs} runs.",
            "",
            f"![{all_at_once.method.capitalize()}]({all_at_once.method}.png)",
            "",
        ]
    return "\n".join(lines)
