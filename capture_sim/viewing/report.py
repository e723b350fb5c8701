"""Report of runs as one HTML page that needs no scripts and no other files, and can be printed."""

from __future__ import annotations

import base64
import datetime
from collections.abc import Callable, Iterator, Sequence
from dataclasses import is_dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader

from capture_sim.base.files import whole_file
from capture_sim.base.software import own_version
from capture_sim.dynamics.samples import ENERGIES, EventKind
from capture_sim.errors import SceneError, SimulationError
from capture_sim.run.first_contact import first_cluster
from capture_sim.run.run import Run
from capture_sim.run.simulation import applied_again, simulate
from capture_sim.run.summary_table import LEGEND, heads, notes, rows
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import Declared, declared
from capture_sim.viewing import style
from capture_sim.viewing.canvas import small_png
from capture_sim.viewing.curves import has_ledger
from capture_sim.viewing.figures import Picture, pictures_of
from capture_sim.viewing.source import (
    decided_at,
    headline,
    resolved_or_not,
    start_word,
)

#: Resolution of the pictures, dots per inch: enough for printing.
_DPI = 144
_HALF = 8.5  # inches: wider pictures are as wide as the page


def error_statement(run: Run) -> str:
    """Return a text on the accuracy of a simulated run, found by simulating it again, twice.

    The first simulation has the run's settings and shows whether the run can be reproduced.  The
    second has a hundredth of the tolerance, so its difference estimates the integration error.  If
    the run cannot be simulated again, the text gives the reason.
    """
    times = np.asarray(run.samples["t"])
    try:
        control = applied_again(run)
        grid = times if control is None else None
        again = simulate(run.scene, t_eval=grid, check=True, control=control)
    except (SimulationError, SceneError) as error:
        return f"The run cannot be made again to check it: {error}"
    n = min(len(again.samples), len(times))
    reproduced = float(np.abs(again.q[:n] - run.samples["q"][:n]).max(initial=0.0))
    same = "bit for bit" if reproduced == 0.0 else f"to {reproduced:.1e} m and rad"
    check = again.check
    assert check is not None  # asked for
    cluster = first_cluster(again.touches)
    end = float(cluster["end"].max()) if cluster.size else float(again.t[-1])
    early = float(check.error[again.t <= end].max(initial=0.0))
    late = float(check.error[np.isfinite(check.error)].max(initial=0.0))
    text = (
        f"a run made now gives the same states {same}. One with a finer integration (a hundredth "
        f"of the tolerance) differs by up to {early:.1e} m until the end of the first contact and "
        f"{late:.1e} m until the end of the run, angles counted by the tip's displacement. "
    )
    if check.same_touches:
        text += "It has the same touches in the same order. "
    else:
        text += (
            "Its sequence of touches differs: the motion after the first difference is one of "
            "several possible. "
        )
    residual = float(np.abs(run.samples["energy_residual"]).max())
    return f"{text}The energy ledger closes to {residual:.1e} J."


_MEASURED = (
    "measured. Its errors are the sensors' errors, which the recording does not contain. Nothing "
    "is known between two messages, so the length of a touch is known to one message period."
)


#: Function that is called with the number of finished steps of the report, and of all steps.
ShowProgress = Callable[[int, int], None]


class _Image(NamedTuple):
    """A picture of the page: caption, PNG file as a data URL, and width on the page."""

    caption: str
    source: str
    kind: str  # "half" or "wide" of the page


def save_report(
    runs: Sequence[Run], path: Path | str, progress: ShowProgress = lambda done, count: None
) -> Path:
    """Save the report of runs as one HTML file; return its path.

    ``progress`` is called before each step of the report and at its end, see :data:`ShowProgress`.

    Raises
    ------
    RecordingError
        The file cannot be written.
    """
    path, text = Path(path), report(runs, progress)
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")
    return path


def report(runs: Sequence[Run], progress: ShowProgress = lambda done, count: None) -> str:
    """Return the report of runs as the text of one HTML page.

    Each simulated run is simulated again: to draw it with samples in every touch, and for
    :func:`error_statement`.  ``progress`` is called as by :func:`save_report`.
    """
    names = [run.name for run in runs]
    with_ledger = [run for run in runs if has_ledger(run)]
    pictures = pictures_of([resolved_or_not(run) for run in runs], names)
    steps = len(runs) + len(pictures)
    about_runs, images = [], []
    for done, run in enumerate(runs):
        progress(done, steps)
        about_runs.append(_about(run))
    for done, picture in enumerate(pictures, len(runs)):
        progress(done, steps)
        images.append(_image(picture))
    progress(steps, steps)
    summaries = [run.summary for run in runs]
    differing, shared = parameter_rows([run.scene for run in runs])
    groups = groupby(heads(), key=lambda head: head[0] or head)  # nameless ones stand alone
    environment = Environment(loader=PackageLoader("capture_sim.viewing", "."), autoescape=True)
    return environment.get_template("report.html.j2").render(
        title=f"Docking and capture: {', '.join(names)}",
        date=datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"),
        version=own_version(),
        names=names,
        runs=about_runs,
        groups=[(g if isinstance(g, str) else "", len(list(inside))) for g, inside in groups],
        columns=[(name, unit) for _, name, unit in heads()],
        results=rows(summaries, names),
        legend=" ".join([*LEGEND, *notes(summaries)]),
        images=images,
        ledger=energy_rows(with_ledger) if with_ledger else [],
        ledger_names=[run.name for run in with_ledger],
        not_measured=[run.name for run in runs if not has_ledger(run)],
        differing=differing,
        shared=shared,
    )


def _image(picture: Picture) -> _Image:
    """Draw a picture for the page as a PNG file of 64 colours.

    Reason: an SVG file of the same picture is larger, because its letters are stored as paths.
    """
    figure = picture.draw()
    data = base64.b64encode(small_png(figure, _DPI)).decode()
    source = f"data:image/png;base64,{data}"
    return _Image(picture.title, source, "wide" if figure.get_figwidth() > _HALF else "half")


def _about(run: Run) -> dict[str, Any]:
    """Return the data of the page's section on one run, for the template ``report.html.j2``."""
    lines = []
    for event in run.events:
        _, wall = style.WALLS.get(event.wall, style.NO_WALL)
        detail = wall if event.kind is EventKind.TOUCH else ""
        if event.detail:
            detail = f"{detail}, {event.detail}" if detail else event.detail
        lines.append((f"{event.t:.6f}", event.kind.label, detail))
    course = f"{headline(run, run.name)}."
    decided = decided_at(run)
    if decided is not None:
        reason = next(s.reason for s in run.statuses if s.state.is_verdict)
        course += f" Decided at {decided:.3f} s: {reason}."
    return {
        "name": run.name,
        "title": run.scene.title,
        "source": _source(run),
        "problems": (*run.origin.left_out, *run.problems, *(doubt.line for doubt in run.doubts)),
        "software": ", ".join(run.origin.software) or "not known",
        "error": error_statement(run) if run.is_exact else _MEASURED,
        "course": course,
        "events": lines,
        "event_head": (f"since the {start_word(run.scene)} [s]", "event", "detail"),
    }


def _source(run: Run) -> str:
    path = run.origin.path
    if not path:
        return "run now"
    return f"recorded in {path}" if run.is_exact else f"measured, in {path}"


def energy_rows(runs: Sequence[Run]) -> list[tuple[str, ...]]:
    """Return the rows of the table of energies: a name, then a value of each run, mJ, as text.

    The first row is the kinetic energy at the first sample, the last row the largest absolute
    residual of the ledger.  The rows between are the energies at the last sample; an energy below
    0.0005 mJ in all runs has no row.
    """
    lines: list[tuple[str, ...]] = []
    for name in ENERGIES:
        if name == "energy_residual":
            worst = [float(np.abs(run.samples[name]).max()) * 1e3 for run in runs]
            lines.append(("largest residual of the ledger", *(f"{value:.1e}" for value in worst)))
            continue
        values = [float(run.samples[name][-1]) * 1e3 for run in runs]
        if any(abs(value) >= 5e-4 for value in values):
            lines.append((name.replace("_", " "), *(f"{value:.3f}" for value in values)))
    start = tuple(f"{float(run.samples['kinetic'][0]) * 1e3:.3f}" for run in runs)
    return [("kinetic at the start", *start), *lines]


def parameter_rows(
    scenes: Sequence[Scene],
) -> tuple[list[tuple[str, ...]], list[tuple[str, ...]]]:
    """Return all parameters of the scenes as rows of text: those that differ, those that do not.

    A row that differs has name, unit, one value for each scene (``-`` if the scene has no such
    parameter) and meaning.  A row that does not differ has name, unit, the common value and
    meaning.  The scenes' names and titles are left out.
    """
    described: dict[str, Declared] = {}
    values = [dict(_fields("", scene, described)) for scene in scenes]
    differing: list[tuple[str, ...]] = []
    shared: list[tuple[str, ...]] = []
    for name, declaration in described.items():
        unit = "" if declaration.unit == "1" else declaration.unit
        cells = [of_scene.get(name, "-") for of_scene in values]
        if len(set(cells)) > 1:
            differing.append((name, unit, *cells, declaration.doc))
        else:
            shared.append((name, unit, cells[0], declaration.doc))
    return differing, shared


def _fields(prefix: str, part: Any, described: dict[str, Declared]) -> Iterator[tuple[str, str]]:
    """Yield the path and the value, as text, of each parameter of a part and its inner parts.

    ``prefix`` is the part's own path, e.g. ``buffer.``.  The declaration of each parameter is added
    to ``described`` by its path.  Fields ``name`` and ``title`` are left out.
    """
    for name, declaration in declared(type(part)).items():
        value = getattr(part, name)
        if is_dataclass(value):
            yield from _fields(f"{prefix}{name}.", value, described)
        elif name not in ("name", "title"):
            described.setdefault(prefix + name, declaration)
            yield prefix + name, _shown(value)


def _shown(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, tuple):
        return f"[{', '.join(map(_shown, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value)
