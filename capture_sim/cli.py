"""The command line: ``capture-sim run | bench | view | benchmark | scenes | show``."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from capture_sim import __version__, benchmarking
from capture_sim.errors import CaptureSimError, RecordingError, SceneError, SimulationError

if TYPE_CHECKING:
    from capture_sim.recording import Run
    from capture_sim.scene import Scene
    from capture_sim.simulation import Result

OK, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; return the exit status: 0 fine, 1 failed, 2 bad input, 130 interrupted."""
    options = _parser().parse_args(arguments)
    try:
        return int(options.command(options))
    except SceneError as error:
        print(f"capture-sim: {error}", file=sys.stderr)
        return BAD_INPUT
    except CaptureSimError as error:
        print(f"capture-sim: {error}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print("capture-sim: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # the reader of our output has gone; there is nobody left to tell
        sys.stderr.close()
        return FAILED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="capture-sim",
        description="Emulates a ground test bench for docking and capture.",
    )
    parser.add_argument("--version", action="version", version=f"capture_sim {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    run = commands.add_parser(
        "run",
        help="run experiments without ROS",
        description="Run experiments without ROS; record, tabulate and draw them.",
    )
    _add_experiments(run, "names of scenes, paths of YAML files, or recorded .mcap files")
    run.add_argument("--no-record", action="store_true", help="write no MCAP files and no pictures")
    run.set_defaults(command=_run)

    bench = commands.add_parser(
        "bench",
        help="run experiments with the ROS 2 nodes",
        description="Run experiments with the ROS 2 nodes, each in a process of its own; "
        "record, tabulate and draw them.",
    )
    _add_experiments(bench, "names of scenes, paths of YAML files, or recorded .mcap files")
    bench.add_argument(
        "--rtf",
        type=_not_negative,
        default=0.0,
        metavar="FACTOR",
        help="real-time factor; 0 runs as fast as it goes (default: 0)",
    )
    bench.set_defaults(command=_bench)

    view = commands.add_parser(
        "view",
        help="draw recorded runs",
        description="Draw recorded runs: a picture of each, and all side by side for rerun.",
    )
    view.add_argument("runs", nargs="+", metavar="RUN.mcap")
    view.add_argument(
        "--out", type=Path, default=Path(), help="folder of the pictures (default: .)"
    )
    view.set_defaults(command=_view)

    benchmark = commands.add_parser(
        "benchmark",
        help="measure speed against error on this machine",
        description="Measure speed against error on this machine, beside what else there is; "
        "write a page with diagrams.",
    )
    benchmarking.add_arguments(benchmark)
    benchmark.set_defaults(command=benchmarking.run)

    scenes = commands.add_parser("scenes", help="list the scenes that come with the package")
    scenes.set_defaults(command=_scenes)

    show = commands.add_parser("show", help="print a scene with all its values, as YAML")
    show.add_argument("scene")
    _add_overrides(show)
    show.set_defaults(command=_show)
    return parser


def _add_experiments(parser: argparse.ArgumentParser, what: str) -> None:
    parser.add_argument("experiments", nargs="+", metavar="EXPERIMENT", help=what)
    parser.add_argument(
        "--out", type=Path, default=Path("runs"), help="folder of the results (default: runs)"
    )
    _add_overrides(parser)


def _add_overrides(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="overrides",
        metavar="PART.FIELD=VALUE",
        help="change a value of the scene, in SI units; may be repeated",
    )


def _not_negative(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r}: allowed is a number >= 0")
    return value


def _scenes(_: argparse.Namespace) -> int:
    from capture_sim.scene_files import load_scene, scene_names

    for name in scene_names():
        print(f"{name:16} {load_scene(name).title}")
    return OK


def _show(options: argparse.Namespace) -> int:
    print(_load(options.scene, options.overrides).to_yaml(), end="")
    return OK


def _load(source: str, overrides: Sequence[str]) -> Scene:
    """Load a scene by name, from a YAML file, or out of a recording."""
    from capture_sim.scene_files import load_scene, load_scene_text

    if not source.endswith(".mcap"):
        return load_scene(source, overrides)
    from capture_sim.recording import read_run

    return load_scene_text(read_run(source).scene_text, overrides)


def _load_all(sources: Sequence[str], overrides: Sequence[str]) -> list[Scene]:
    scenes = [_load(source, overrides) for source in sources]
    names = [scene.name for scene in scenes]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise SceneError(
            f"experiments: {', '.join(sorted(twice))} given twice: each needs a name of its own, "
            "for its files"
        )
    return scenes


def _prepare_folder(folder: Path) -> None:
    """Make sure, before anything runs, that results can be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise RecordingError(f"--out {folder}: cannot be written: {error.strerror}") from None


def _say(text: str) -> None:
    print(text, flush=True)


def _compile() -> None:
    from capture_sim.bench import compile_kernels
    from capture_sim.kernels import is_compiled

    if not is_compiled():
        _say("compiling the kernels, once for this version (about ten seconds) ...")
        began = time.perf_counter()
        compile_kernels()
        _say(f"compiled in {time.perf_counter() - began:.1f} s")


def _run(options: argparse.Namespace) -> int:
    from capture_sim.simulation import simulate

    scenes = _load_all(options.experiments, options.overrides)
    _prepare_folder(options.out)
    _compile()
    results: list[Result] = []
    status = OK
    for scene in scenes:
        try:
            result = simulate(scene)
        except SimulationError as error:
            print(f"capture-sim: {error}", file=sys.stderr)
            status = FAILED
            if error.result is None or error.result.samples.size == 0:
                continue
            result = error.result
        results.append(result)
        if not options.no_record:
            from capture_sim.recording import write_run

            path = write_run(result, options.out / f"{scene.name}.mcap")
            _say(f"{scene.name}: recorded in {path}")
    _report([result.summary for result in results], options.out)
    if not options.no_record:
        _draw(results, options.out)
    return status


def _bench(options: argparse.Namespace) -> int:
    from capture_sim.nodes.suite import run_suite
    from capture_sim.recording import read_run

    scenes = _load_all(options.experiments, options.overrides)
    _prepare_folder(options.out)
    _compile()
    status = run_suite(scenes, options.out, pace=options.rtf)
    paths = [options.out / f"{scene.name}.mcap" for scene in scenes]
    runs = [read_run(path) for path in paths if path.is_file()]
    _report([_summary_of(run) for run in runs if run.samples.size], options.out)
    _draw([run for run in runs if run.samples.size], options.out)
    return int(status)


def _summary_of(run: Run) -> dict[str, Any]:
    from capture_sim.results import summarize

    verdict = run.verdict.label if run.verdict is not None else "none"
    return summarize(run.scene, run.samples, run.touches, run.events, verdict, run.wall_time)


def _report(summaries: list[dict[str, Any]], folder: Path) -> None:
    from capture_sim.results import table

    text = table(summaries)
    print()
    print(text)
    print()
    try:
        (folder / "results.txt").write_text(text + "\n", encoding="utf-8")
        (folder / "results.json").write_text(
            json.dumps(summaries, indent=2, allow_nan=False) + "\n", encoding="utf-8"
        )
    except OSError as error:
        raise RecordingError(f"{folder}: cannot be written: {error.strerror}") from None
    _say(f"table in {folder / 'results.txt'}, numbers in {folder / 'results.json'}")


def _draw(runs: Sequence[Result | Run], folder: Path) -> None:
    if not runs:
        return
    try:
        from capture_sim.viewing import save_figure, save_overview

        for run in runs:
            _say(f"picture in {save_figure(run, folder / f'{run.scene.name}.png')}")
        if len(runs) > 1:
            _say(f"side by side in {save_overview(runs, folder / 'overview.png')}")
    except ImportError as error:
        _say(f"no pictures: {error}")
    try:
        from capture_sim.viewing import save_rrd

        _say(f"for rerun in {save_rrd(runs, folder / 'runs.rrd')}")
    except ImportError as error:
        # an ordinary workstation's ROS bears no rerun: the recording is what counts there
        _say(f"no rerun file: {error}; capture-sim view makes it where rerun is installed")


def _view(options: argparse.Namespace) -> int:
    from capture_sim.recording import read_run

    _prepare_folder(options.out)
    runs = [read_run(path) for path in options.runs]
    for run in runs:
        for problem in run.problems:
            print(f"capture-sim: {run.name}: {problem}", file=sys.stderr)
    drawable = [run for run in runs if run.samples.size]
    if not drawable:
        raise RecordingError("nothing to draw: no recording holds a sample")
    _draw(drawable, options.out)
    return OK


if __name__ == "__main__":
    raise SystemExit(main())
