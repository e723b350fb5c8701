"""``capture-sim design``: find the best buffers that capture within limits."""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from capture_sim.base.exit_status import FAILED, INTERRUPTED, OK
from capture_sim.base.journal import Journal, read_journal
from capture_sim.base.software import software_versions
from capture_sim.commands.compiling import compile_first
from capture_sim.commands.design_report import (
    report_front,
    sections_of,
    write_front,
)
from capture_sim.commands.inputs import (
    add_limits,
    add_out,
    add_resume,
    add_scene,
    add_seed,
    add_under,
    add_workers,
    dispersions,
    in_unit,
    load,
    number,
    prepare_folder,
    reader,
    whole,
)
from capture_sim.commands.output import Progress, command_line, drawing, echo, warn
from capture_sim.errors import SceneError
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import Range
from capture_sim.scene.units import in_si, split
from capture_sim.studies.evaluate.capture_range import AREAS, make_area
from capture_sim.studies.evaluate.executors import open_executor
from capture_sim.studies.evaluate.limits import (
    CAPTURE_RANGE,
    Limit,
    Measure,
    make_limits,
    make_objectives,
    read_limits,
)
from capture_sim.studies.evaluate.outcome import run_to_end
from capture_sim.studies.search.design import (
    CANDIDATES,
    CANDIDATES_OF_AREA,
    CANDIDATES_OF_DRAWS,
    MAX_ROWS,
    Design,
    costs_of_limits,
    default_candidates,
    design_buffer,
)
from capture_sim.studies.search.evaluator import (
    CHECK_DRAWS,
    DRAWS,
    EARLIER,
    SEARCH,
    Archive,
    Candidate,
    Dispersions,
    Requirements,
)
from capture_sim.studies.search.front import require_pymoo
from capture_sim.studies.search.limit_costs import LimitCost
from capture_sim.studies.search.rows import CONVERGED
from capture_sim.studies.search.search import Window
from capture_sim.studies.search.variables import FREE, TORSIONAL, make_variables

DESCRIPTION = (
    "Find the buffers that capture within limits, keep the tip captured until t_end, and that no "
    "other buffer beats in all objectives: one buffer for one objective, the front for two or "
    "three. Each row of the table is also a scene, and says how far it has converged. "
    "If no buffer captures within the limits, print the one that comes "
    "closest among the ones tried. Limits apply to the whole run, including the "
    "latched phase. Without limits and objectives, the strokes of the scene's own buffer are the "
    "limits. To design as in the paper, for strokes of the first contact: capture-sim paper."
)
FAILS = "no buffer was found that captures within the limits"
GIVES = "what is in design.json"
EXAMPLE = """\
  capture-sim design tilt_p10 --minimize max_axial_stroke_in,max_buffer_force --torsion-limit 8
  capture-sim design tilt_0 --stroke-limit 10 --minimize max_buffer_force \\
    --free buffer.k_A,buffer.c_A,buffer.preload --under dispersions.yaml
  capture-sim design tilt_0 --stroke-limit 10 --minimize max_buffer_force \\
    --maximize capture_range --approach mouth_offset='-60 mm:60 mm:9'"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_scene(parser, "tilt_0")
    parser.add_argument(
        "--minimize",
        action="append",
        default=[],
        metavar="LOAD[,LOAD[,LOAD]]",
        help="minimise these loads of results.json, of the whole run or with _before_latch "
        "(default: max_buffer_force, and max_buffer_torque where torsion is free)",
    )
    parser.add_argument(
        "--maximize",
        action="append",
        default=[],
        metavar=CAPTURE_RANGE,
        help="maximise the share of the area of --approach that is captured within the limits",
    )
    parser.add_argument(
        "--approach",
        action="append",
        default=[],
        metavar="NAME=LOW:HIGH:COUNT",
        help="set the area of the capture range: angle, offset, mouth_offset or speed over a grid, "
        f"e.g. offset='-40 mm:40 mm:9'; or {', '.join(AREAS)}, the initial contact conditions of "
        "that docking standard. May be repeated",
    )
    parser.add_argument(
        "--capture-range",
        type=number(Range(0.0, 1.0, low_open=True)),
        default=0.0,
        metavar="SHARE",
        help="require that this share of the area of --approach is captured within the limits",
    )
    parser.add_argument(
        "--pick",
        type=reader(_pick, f"knee, or the number of a row, 1 to {MAX_ROWS}"),
        default="knee",
        metavar="knee|N",
        help="write this row of the front as design.yaml (default: knee, the row farthest below "
        "the line between both ends of the front on logarithmic axes)",
    )
    parser.add_argument(
        "--window",
        metavar="LOAD=LOW:HIGH",
        help="space the rows over these values of an objective, e.g. "
        "max_axial_stroke_in=3:10mm (default: over the whole front)",
    )
    parser.add_argument(
        "--allow-leaving",
        action="store_true",
        help="accept a capture that the tip has left again at t_end",
    )
    parser.add_argument(
        "--allow-passing",
        action="store_true",
        help="accept a tip that has flown through the target: at t_end it is further behind BE, "
        "the cone's inner edge, than the capture radius",
    )
    parser.add_argument(
        "--stroke-limit",
        type=in_unit("mm"),
        metavar="MM",
        help="limit the axial stroke, inwards and outwards, mm or with a unit",
    )
    parser.add_argument(
        "--torsion-limit",
        type=in_unit("mrad"),
        metavar="MRAD",
        help="limit the torsion, mrad or with a unit, e.g. '0.2 deg'",
    )
    parser.add_argument(
        "--peak-force",
        type=in_unit("N"),
        metavar="N",
        help="limit the peak force of every touch, N (default: no limit)",
    )
    add_limits(parser)
    parser.add_argument(
        "--free",
        action="append",
        default=[],
        metavar="NAME[=LOW:HIGH],..",
        help="search these values, e.g. buffer.k_A,buffer.c_A=5:50,buffer.preload, or a catalogue, "
        f"buffer.k_A=[450,500,560]; may be repeated (default: {','.join(FREE)}). damping_ratio is "
        "the damper as a share of the critical one. buffer.c_A_rebound keeps its ratio to "
        "buffer.c_A unless it is free",
    )
    parser.add_argument(
        "--costs",
        action="store_true",
        help="also compute what each active limit costs in the objectives, if the row has "
        "converged; takes an eighth of the candidates",
    )
    parser.add_argument(
        "--candidates",
        type=whole(Range(100, 1_000_000)),
        metavar="N",
        help=f"try at most N buffers in all (default: {CANDIDATES}, {CANDIDATES_OF_DRAWS} with "
        f"--under, {CANDIDATES_OF_AREA} with --approach)",
    )
    parser.add_argument(
        "--from",
        type=Path,
        dest="earlier",
        metavar="DIR",
        help="begin with the runs of an earlier design of the same scene: with other limits, "
        "ranges or objectives, or more candidates",
    )
    add_resume(parser, "design")
    add_seed(parser, "the search and of the draws")
    add_under(parser, "require the limits under the distributions of this YAML file")
    parser.add_argument(
        "--confidence",
        type=number(Range(0.5, 1.0, high_open=True)),
        metavar="SHARE",
        help="set the share of the draws that must be captured within the limits (default: 0.95)",
    )
    parser.add_argument(
        "--draws",
        type=whole(Range(1, 10_000)),
        metavar="N",
        help=f"with --under, run each candidate with N draws (default: {DRAWS}); the design is "
        f"checked with {CHECK_DRAWS} new ones",
    )
    parser.add_argument("-v", "--verbose", action="store_true", help="list every candidate buffer")
    add_workers(parser)
    add_out(parser, "runs/design")


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    _check(options)
    scene = load(options.scene, options.overrides)
    free = _free(options.free)
    under = None
    if options.under is not None or options.calibrated is not None:
        chosen = [text.partition("=")[0].strip() for text in free]
        under = Dispersions(*dispersions(options, chosen))
    given, objectives = _limits(options), _objectives(options, free)
    if len(objectives) == 1 and options.pick != "knee":
        raise SceneError(f"--pick {options.pick}: must be omitted with one objective: one buffer")
    window = _window(options.window, objectives) if options.window is not None else None
    requirements = Requirements(
        objectives,
        given,
        under,
        options.confidence or 0.95,
        options.draws or DRAWS,
        make_area(scene, options.approach),
        options.capture_range,
        options.allow_leaving,
        not options.allow_passing,
    )
    make_variables(scene, given, free)  # before anything runs
    require_pymoo()
    earlier = _earlier(options.earlier, scene) if options.earlier is not None else []
    prepare_folder(options.out)
    compile_first()
    if not (given or options.minimize or options.maximize):
        requirements = dataclasses.replace(requirements, limits=_own_limits(scene))
    with _journal(scene, requirements, free, options) as journal:
        archive = Archive(journal)
        if not journal.entries:
            for entry in earlier:
                archive.add(*entry)
        return _design(scene, requirements, free, window, options, archive, journal)


def _design(
    scene: Scene,
    requirements: Requirements,
    free: Sequence[str],
    window: Window | None,
    options: argparse.Namespace,
    archive: Archive,
    journal: Journal,
) -> int:
    """Search for the best buffers, print the report and write the files; return the exit status."""
    objectives = requirements.objectives
    echo(f"objectives: {', '.join(each.meaning for each in objectives)}")
    limits = [limit.text for limit in requirements.limits]
    if options.capture_range:
        limits.append(f"capture range >= {options.capture_range:.4g}")
    echo(f"limits: {', '.join(limits) or 'none'}")
    costs: tuple[LimitCost, ...] = ()
    budget = options.candidates or default_candidates(requirements)
    with (
        open_executor(options.workers, options.scheduler) as executor,
        Progress("buffers") as progress,
    ):
        line, count = _line_of(objectives), itertools.count(1)

        def show(candidate: Candidate) -> None:
            number = next(count)
            if options.verbose:
                echo(f"{number:5d}  {line(candidate)}")
            progress.at("design", number, budget)

        design = design_buffer(
            scene,
            requirements,
            free,
            window=window,
            candidates=budget,
            seed=options.seed,
            executor=executor,
            report=show,
            archive=archive,
            costs=options.costs,
        )
        picked = _picked(design, options.pick)
        if options.costs and picked is not None and not design.interrupted:
            try:
                costs = costs_of_limits(
                    design,
                    design.rows[picked],
                    seed=options.seed,
                    executor=executor,
                    candidates=budget,
                )
            except KeyboardInterrupt:
                design = dataclasses.replace(design, interrupted=True)
    sections = sections_of(design, picked, costs)
    if options.costs and picked is not None and design.rows[picked].convergence != CONVERGED:
        found = design.rows[picked].convergence
        warn(f"--costs: not computed, as row {picked + 1} has not converged ({found})")
    report_front(sections)
    write_front(design, picked, costs, options.out, options.seed)
    if design.interrupted:
        warn(
            f"interrupted: {len(design.history)} buffers tried, written to {options.out}; "
            "--resume continues"
        )
        return INTERRUPTED
    with drawing():
        from capture_sim.viewing.canvas import save
        from capture_sim.viewing.design import draw_design
        from capture_sim.viewing.study_page import asked_of, save_design_page

        figure = draw_design(design, picked)
        echo(f"plot in {save(figure, options.out / 'design.png')}")
        asked = asked_of(design, command_line(), options.seed, budget)
        path = save_design_page(
            design, picked, sections, figure, options.out / "design.html", asked
        )
        echo(f"page in {path}")
    journal.finish()
    return OK if design.met else FAILED


def _free(texts: Sequence[str]) -> list[str]:
    """Return the free values that ``--free`` names, each as a text; without it, :data:`FREE`.

    The texts are split at commas, except at the commas of a catalogue in brackets.
    """
    items = [item for text in texts for item in re.split(r",(?![^\[]*\])", text)]
    return items or list(FREE)


def _window(text: str, objectives: Sequence[Measure]) -> Window:
    """Return the window that the text ``LOAD=LOW:HIGH`` of ``--window`` describes.

    The unit of HIGH also applies to LOW if LOW has none.  SceneError if the text is invalid, if
    LOAD is not an objective, or if there is only one objective.
    """
    key, _, ends = (part.strip() for part in text.partition("="))
    measure = next((each for each in objectives if each.key == key), None)
    if measure is None or len(objectives) < 2:
        keys = ", ".join(each.key for each in objectives) if len(objectives) > 1 else ""
        raise SceneError(f"--window {text}: must be of one of two or three objectives {keys}")
    low, _, high = (part.strip() for part in ends.partition(":"))
    try:
        number, unit = split(low)
        low = low if unit else f"{number} {split(high)[1]}".strip()
        window = Window(key, in_si(low, measure.load.unit), in_si(high, measure.load.unit))
    except ValueError:
        raise SceneError(
            f"--window {text}: must be {key}=LOW:HIGH, in {measure.load.unit} or with a unit"
        ) from None
    if not 0.0 < window.low < window.high < math.inf:
        raise SceneError(f"--window {text}: must be 0 < LOW < HIGH")
    return window


#: File in the folder of a design to which its runs are written.
_JOURNAL = "design.journal"


def _journal(
    scene: Scene, requirements: Requirements, free: Sequence[str], options: argparse.Namespace
) -> Journal:
    """Open the journal, the file to which the runs of the design are written, and return it.

    With ``--resume``, the journal also has the runs of the interrupted design.
    """
    head: dict[str, Any] = {"study": "design", "software": list(software_versions())}
    head["scene"] = scene.to_yaml()
    under = requirements.under
    kept = dataclasses.replace(requirements, under=None, area=())
    head |= {"requirements": repr(kept), "free": list(free), "window": options.window}
    head |= {"area": options.approach, "candidates": options.candidates, "seed": options.seed}
    if under is not None:
        varied = {name: str(given) for name, given in under.vary.items()}
        head["under"] = varied
        head["correlate"] = [[*pair, value] for pair, value in under.correlations.items()]
    journal = Journal(options.out / _JOURNAL, head, resume=options.resume)
    if journal.replaced is not None:
        warn(f"the unfinished design of before is now {journal.replaced}; --resume continues one")
    if options.resume:
        echo(f"{sum(len(entry[2]) for entry in journal.entries)} runs were made before")
    return journal


def _earlier(folder: Path, scene: Scene) -> list[tuple[Any, ...]]:
    """Return the runs of an earlier design, each entry as the arguments of ``Archive.add``.

    ``folder`` is the folder of that design.  SceneError if it has another scene or is of another
    version of capture_sim.
    """
    head, entries = read_journal(folder / _JOURNAL)
    if head.get("scene") != scene.to_yaml():
        raise SceneError(f"--from {folder}: must be a design of the same scene")
    if head.get("software") != list(software_versions()):
        raise SceneError(f"--from {folder}: must be of this version of capture_sim")
    return [(EARLIER, *entry[1:]) for entry in entries if entry[0] in (SEARCH, EARLIER)]


def _pick(text: str) -> int | str:
    if text == "knee":
        return text
    if not (text.isascii() and text.isdecimal() and 1 <= int(text) <= MAX_ROWS):
        raise ValueError(text)
    return int(text)


def _picked(design: Design, pick: int | str) -> int | None:
    """Return the index of the row that ``--pick`` selects; None if no buffer was found.

    If there is no row of the given number, the index of the knee is returned, with a warning.
    """
    if not design.rows:
        return None
    if isinstance(pick, str):
        return design.knee
    if pick > len(design.rows):
        warn(f"--pick {pick}: must be knee or 1 to {len(design.rows)}; the knee is picked")
        return design.knee
    return pick - 1


def _check(options: argparse.Namespace) -> None:
    """Raise SceneError if an option excludes, or requires, another option."""
    of_draws = {"--confidence": options.confidence, "--draws": options.draws}
    of_draws["--correlate"] = options.correlate
    for name, value in of_draws.items():
        if value and options.under is None and options.calibrated is None:
            raise SceneError(f"{name}: must be given with --under or --calibrated")


def _objectives(options: argparse.Namespace, free: Sequence[str]) -> tuple[Measure, ...]:
    """Return the objectives of ``--minimize`` and ``--maximize``.

    The default is the peak force of the buffer and, if a torsional value is free, its peak torque.
    """
    least = [name.strip() for text in options.minimize for name in text.split(",")]
    if not (least or options.maximize):
        least = ["max_buffer_force"]
        if any(text.partition("=")[0].strip() in TORSIONAL for text in free):
            least.append("max_buffer_torque")
    return make_objectives(least, options.maximize)


def _limits(options: argparse.Namespace) -> tuple[Limit, ...]:
    """Return the limits of ``--stroke-limit``, ``--torsion-limit``, ``--peak-force``, ``--limit``.

    SceneError is raised if a load has two limits.
    """
    limits: dict[str, float] = {}
    if options.stroke_limit is not None:
        limits |= dict.fromkeys(
            ("max_axial_stroke_in", "max_axial_stroke_out"), options.stroke_limit
        )
    if options.torsion_limit is not None:
        limits["max_torsion"] = options.torsion_limit
    if options.peak_force is not None:
        limits["max_normal_force"] = options.peak_force
    others = read_limits(options.limits)
    for limit in others:
        if limit.key in limits:
            raise SceneError(f"--limit {limit.key}: must be given once")
    return (*make_limits(limits), *others)


def _own_limits(scene: Scene) -> tuple[Limit, ...]:
    """Return limits equal to the largest stroke and the torsion of the scene's own buffer.

    The scene is run to its end; the largest stroke limits both directions.  SceneError if the run
    has no stroke or no torsion.
    """
    loads = run_to_end(scene).loads
    stroke = max(loads["max_axial_stroke_in"], loads["max_axial_stroke_out"])
    if not stroke or not loads["max_torsion"]:
        raise SceneError(f"{scene.name}: its buffer has no stroke: --stroke-limit must be given")
    return (
        Limit("max_axial_stroke_in", stroke),
        Limit("max_axial_stroke_out", stroke),
        Limit("max_torsion", loads["max_torsion"]),
    )


def _line_of(objectives: Sequence[Measure]) -> Callable[[Candidate], str]:
    def line(candidate: Candidate) -> str:
        values = "  ".join(
            f"{name.rpartition('.')[2]} {value:9.5g}" for name, value in candidate.values.items()
        )
        loads = "  ".join(
            f"{each.shown(candidate.loads[each.key]):>8} {each.load.shown_in}"
            for each in objectives
        )
        violates = "" if candidate.feasible else f", violates by {candidate.violation:.3g}"
        return f"{values}  {loads}  {candidate.verdict}{violates}"

    return line
