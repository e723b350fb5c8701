"""``capture-sim sensitivity``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from capture_sim.commands.arguments import OK, add_overrides, load, prepare_folder

if TYPE_CHECKING:
    from capture_sim.studies.sensitivity import Global, Local

HELP = "find what force, strokes and verdict hang on"
DESCRIPTION = (
    "How peak force, strokes and verdict move with each parameter: derivatives, a tornado over "
    "the parameters' spreads, and Morris' or Sobol's indices."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "scene", nargs="?", default="paper_designed", help="default: paper_designed"
    )
    parser.add_argument(
        "--spread",
        type=float,
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
        "--samples", type=int, default=32, help="trajectories, or base samples (default: 32)"
    )
    parser.add_argument("--seed", type=int, default=1, help="of the samples (default: 1)")
    parser.add_argument(
        "--workers", type=int, default=0, metavar="N", help="processes (default: one per core)"
    )
    parser.add_argument("--scheduler", metavar="ADDRESS", help="of a Dask cluster")
    parser.add_argument(
        "--out", type=Path, default=Path("runs/sensitivity"), help="default: runs/sensitivity"
    )
    add_overrides(parser)


def run(options: argparse.Namespace) -> int:
    """Do it; return the exit status."""
    from capture_sim.commands.progress import Progress
    from capture_sim.commands.showing import compile_first, say
    from capture_sim.errors import SceneError
    from capture_sim.studies.executors import default_workers, open_executor
    from capture_sim.studies.sensitivity import (
        check_method,
        default_parameters,
        global_sensitivity,
        local_sensitivity,
    )

    scene = load(options.scene, options.overrides)
    if not 0.0 < options.spread <= 50.0:
        raise SceneError(f"--spread {options.spread:g} %: allowed is > 0 and <= 50")
    parameters = default_parameters(options.spread / 100.0)
    if not 0 <= options.workers <= 1024:
        raise SceneError(f"--workers {options.workers}: allowed is >= 1 and <= 1024")
    if options.method != "none":
        check_method(options.method, options.samples)
    prepare_folder(options.out)
    compile_first()
    whole: Global | None = None
    with (
        open_executor(options.workers or default_workers(), options.scheduler) as executor,
        Progress() as progress,
    ):
        near = local_sensitivity(
            scene,
            parameters,
            executor,
            lambda done, count: progress.at("derivatives", done, count),
        )
        if options.method != "none":
            whole = global_sensitivity(
                scene,
                parameters,
                executor,
                options.method,
                options.samples,
                options.seed,
                lambda done, count: progress.at(options.method, done, count),
            )
    _report(near)
    if whole is not None:
        say(f"captured in {whole.captured:.1%} of {whole.runs} runs over the whole spread")
    _keep(near, whole, options.out)
    _write(options.out / "sensitivity.md", _page(near, whole, options))
    try:
        from capture_sim.viewing.tornado import save_indices, save_tornado

        say(f"tornado in {save_tornado(near, options.out / 'tornado.png')}")
        if whole is not None:
            say(f"indices in {save_indices(whole, options.out / f'{whole.method}.png')}")
    except ImportError as error:
        say(f"no picture: {error}")
    return OK


def _report(near: Local) -> None:
    """Print what a parameter off by its spread would do, were it linear; ! where that is not so."""
    from capture_sim.commands.showing import say
    from capture_sim.studies.sensitivity import SMOOTH

    say("change of each quantity for a parameter that is off by its spread, by its derivative")
    say("(!: ill-conditioned, does not converge; *: another verdict at an end of the spread)")
    say("")
    head = [f"{q.name} {q.unit}" for q in SMOOTH]
    say(f"{'':22}" + "".join(f"{text:>16}" for text in head))
    base = near.base.tolist()
    say(
        f"{'at the scene':22}"
        + "".join(f"{q.factor * v:16.5g}" for q, v in zip(SMOOTH, base[:-1], strict=True))
    )
    for parameter, row, low, high in zip(
        near.parameters, near.derivatives, near.low, near.high, strict=True
    ):
        flips = "*" if low[-1] != base[-1] or high[-1] != base[-1] else " "
        cells = "".join(
            f"{q.factor * d.value:15.3g}{' ' if d.converged else '!'}"
            for q, d in zip(SMOOTH, row, strict=True)
        )
        say(f"{parameter.name + flips:22}{cells}")
    say("")


def _keep(near: Local, whole: Global | None, folder: Path) -> None:
    """Write the numbers."""
    import dataclasses
    import json

    import numpy as np

    from capture_sim.studies.sensitivity import QUANTITIES

    def plain(table: Any) -> Any:
        return [[None if np.isnan(value) else value for value in row] for row in table.tolist()]

    kept: dict[str, Any] = {
        "quantities": [q.name for q in QUANTITIES],
        "parameters": [dataclasses.asdict(parameter) for parameter in near.parameters],
        "base": near.base.tolist(),
        "low": near.low.tolist(),
        "high": near.high.tolist(),
        "derivatives": [[dataclasses.asdict(d) for d in row] for row in near.derivatives],
    }
    if whole is not None:
        kept[whole.method] = {
            "runs": whole.runs,
            "captured": whole.captured,
            "first": plain(whole.first),
            "total": plain(whole.total),
            "confidence": plain(whole.confidence),
        }
    text = json.dumps(kept, indent=1, allow_nan=False) + "\n"
    _write(folder / "sensitivity.json", text)


def _write(path: Path, text: str) -> None:
    from capture_sim.commands.showing import say
    from capture_sim.errors import RecordingError

    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error.strerror}") from None
    say(f"written: {path}")


def _page(near: Local, whole: Global | None, options: argparse.Namespace) -> str:
    """Return derivatives and pictures as a page in Markdown."""
    from capture_sim.studies.sensitivity import SMOOTH

    command = f"capture-sim sensitivity {options.scene} --method {options.method}"
    command += f" --samples {options.samples} --seed {options.seed} --spread {options.spread:g}"
    lines = [
        f"# What {options.scene} hangs on",
        "",
        f"Made by `.venv/bin/{command}`, as are both figures. Force, strokes and duration are of "
        "the first contact; nearest is until the verdict.",
        "",
        "Change of each quantity for a parameter that is off by its spread, by its derivative. "
        "**!**: ill-conditioned, the difference quotient does not converge as its step shrinks. "
        "**\\***: another verdict at an end of the spread.",
        "",
        "| parameter | spread | " + " | ".join(f"{q.name} {q.unit}" for q in SMOOTH) + " |",
        "|---" * (2 + len(SMOOTH)) + "|",
        "| at the scene | | "
        + " | ".join(f"{q.factor * v:.4g}" for q, v in zip(SMOOTH, near.base[:-1], strict=True))
        + " |",
    ]
    for parameter, row, low, high in zip(
        near.parameters, near.derivatives, near.low, near.high, strict=True
    ):
        flips = " **\\***" if {low[-1], high[-1]} != {near.base[-1]} else ""
        cells = " | ".join(
            f"{q.factor * d.value:.3g}{'' if d.converged else ' **!**'}"
            for q, d in zip(SMOOTH, row, strict=True)
        )
        lines.append(f"| {parameter.name}{flips} | {parameter.displayed_spread} | {cells} |")
    lines += ["", "![Tornado](tornado.png)", ""]
    if whole is not None:
        lines += [
            f"All at once: captured in {whole.captured:.1%} of {whole.runs} runs.",
            "",
            f"![{whole.method.capitalize()}]({whole.method}.png)",
            "",
        ]
    return "\n".join(lines)
