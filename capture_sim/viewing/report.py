"""Runs as one page of HTML that needs nothing beside itself, and prints."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from capture_sim.errors import RecordingError
from capture_sim.results import LEGEND, heads, rows
from capture_sim.scene.parts import Scene
from capture_sim.viewing import figures
from capture_sim.viewing.curves import has_ledger
from capture_sim.viewing.report_parts import (
    STYLE,
    ErrorStatement,
    energy_rows,
    parameter_rows,
    table,
)
from capture_sim.viewing.source import (
    ViewableRun,
    decided_at,
    distinct_names,
    headline,
    resolved_or_not,
    start_word,
)


@dataclass(frozen=True)
class ReportedRun:
    """A run and what is told about it.

    Attributes
    ----------
    run
        To be drawn.
    label
        Its name, no other's of the report; empty for its scene's.
    source
        Where it comes from, in words.
    summary
        As :func:`capture_sim.results.summarize` gives.
    software
        ``"name version"`` each, of what made the run.
    error
        How far it can be trusted.
    problems
        What is wrong with its recording, one line each.
    """

    run: ViewableRun
    source: str
    summary: dict[str, Any]
    software: Sequence[str]
    error: ErrorStatement
    problems: Sequence[str] = ()
    label: str = ""


def save_report(reported: Sequence[ReportedRun], path: Path | str) -> Path:
    """Save the report of runs as one HTML file.

    Returns
    -------
    Path
        Of the file.

    Raises
    ------
    RecordingError
        The file cannot be written.
    """
    path = Path(path)
    text = report(reported)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise RecordingError(f"{path}: cannot write: {error.strerror or error}") from None
    return path


def report(reported: Sequence[ReportedRun]) -> str:
    """Return the report of runs as one page of HTML."""
    names = distinct_names([one.label or one.run.scene.name for one in reported])
    title = f"Docking and capture: {', '.join(names)}"
    parts = [
        f"<h1>{escape(title)}</h1>",
        _sources(reported, names),
        "<h2>Results</h2>",
        _results(reported, names),
        "<h2>Figures</h2>",
        *_figures(reported, names),
        "<h2>Energy</h2>",
        *_energy(reported, names),
        "<h2>How far to trust the numbers</h2>",
        *(f"<p><b>{escape(n)}</b>: {escape(r.error.text)}</p>" for n, r in _named(reported, names)),
        "<h2>Events</h2>",
        *(_events(one, name) for name, one in _named(reported, names)),
        "<h2>Parameters</h2>",
        *_parameters([one.run.scene for one in reported], names),
        "<h2>Versions</h2>",
        table(
            ("run", "made by"),
            [
                (name, ", ".join(one.software) or "not told")
                for name, one in _named(reported, names)
            ],
        ),
    ]
    body = "\n".join(parts)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        # the page needs nothing from elsewhere, and the browser sees to it
        '<meta http-equiv="Content-Security-Policy" '
        "content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'\">\n"
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        # no icon is asked of anyone
        f'<link rel="icon" href="data:,">\n<title>{escape(title)}</title>\n'
        f"<style>{STYLE}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )


def _named(reported: Sequence[ReportedRun], names: Sequence[str]) -> list[tuple[str, ReportedRun]]:
    return list(zip(names, reported, strict=True))


def _sources(reported: Sequence[ReportedRun], names: Sequence[str]) -> str:
    lines = []
    for name, one in _named(reported, names):
        what = f"<b>{escape(name)}</b>: {escape(one.run.scene.title)}; {escape(one.source)}."
        for problem in one.problems:
            what += f' <span class="problem">{escape(problem)}.</span>'
        lines.append(f"<li>{what}</li>")
    return f"<ul>{''.join(lines)}</ul>"


def _results(reported: Sequence[ReportedRun], names: Sequence[str]) -> str:
    groups: list[tuple[str, int]] = []
    for group, _, _ in heads():
        if groups and group and groups[-1][0] == group:
            groups[-1] = (group, groups[-1][1] + 1)
        else:
            groups.append((group, 1))
    top = "".join(f'<th colspan="{span}">{escape(group)}</th>' for group, span in groups)
    second = "".join(
        f"<th>{escape(name)}{f'<br>[{escape(unit)}]' if unit else ''}</th>"
        for _, name, unit in heads()
    )
    lines = []
    for name, cells in zip(names, rows([one.summary for one in reported]), strict=True):
        lines.append("".join(f"<td>{escape(cell)}</td>" for cell in [name, *cells[1:]]))
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return (
        f'<table class="results"><thead><tr>{top}</tr><tr>{second}</tr></thead>'
        f"<tbody>{body}</tbody></table><p class=note>{escape(' '.join(LEGEND))}</p>"
    )


def _figures(reported: Sequence[ReportedRun], names: Sequence[str]) -> list[str]:
    runs = [one.run for one in reported]
    several = len(runs) > 1
    shown: dict[str, Any] = {"labels": names}
    timed = {**shown, "aligned": several}
    when = "; time counts from each run's first touch" if several else ""
    simulated = all(has_ledger(run) for run in runs)
    across = "wide" if len(runs) > 2 else "medium"
    found = [
        (figures.trajectories(runs, **shown), "Way of the tip's centre in the cone", across),
        (figures.impact_force(runs, **timed), f"Contact force with every touch{when}", "narrow"),
        (figures.distance(runs, **timed), f"Distance of the tip to BE{when}", "narrow"),
        (figures.axial_performance(runs, **timed), f"Axial buffer{when}", "narrow"),
        (figures.torsional_performance(runs, **timed), f"Torsional buffer{when}", "narrow"),
    ]
    if simulated:  # neither is measured on a bench
        found += [
            (figures.load_stroke(runs, **shown), "Force over stroke of the axial buffer", "narrow"),
            (
                figures.intrusion([resolved_or_not(run) for run in runs], **timed),
                f"Depth of the tip in the wall{when}",
                "narrow",
            ),
        ]
    found.append((figures.velocities(runs, **timed), f"Velocities{when}", "medium"))
    for name, run in zip(names, runs, strict=True):
        found.append((figures.snapshots(run, labels=[name]), f"{name}, from above", "medium"))
    return [_picture(figure, caption, kind) for figure, caption, kind in found]


def _energy(reported: Sequence[ReportedRun], names: Sequence[str]) -> list[str]:
    known = [(name, one.run) for name, one in _named(reported, names) if has_ledger(one.run)]
    parts = []
    if known:
        labels, runs = [name for name, _ in known], [run for _, run in known]
        caption = "Where the energy is and goes: the layers' sum against what was put in"
        parts.append(
            _picture(
                figures.energy(runs, labels=labels), caption, "wide" if len(runs) > 2 else "medium"
            )
        )
        parts.append(
            table(("at the end of the run [mJ]", *labels), energy_rows(runs), kind="numbers")
        )
    without = [name for name, one in _named(reported, names) if not has_ledger(one.run)]
    if without:
        parts.append(f"<p>Not measured: {escape(', '.join(without))}.</p>")
    return parts


def _events(one: ReportedRun, name: str) -> str:
    run = one.run
    lines = []
    touches = iter(run.touches)
    for event in run.events:
        detail = event.detail
        if event.kind.label == "touch":
            touch = next(touches, None)
            if touch is not None and not detail:
                detail = f"{'+' if event.wall > 0 else '-'}y wall"
        lines.append((f"{event.t:.6f}", event.kind.label, detail))
    decided = decided_at(run)
    said = f"{headline(run, name)}."
    if decided is not None:
        reason = next((s.reason for s in run.statuses if s.final), "")
        said += f" Decided at {decided:.3f} s: {reason}."
    head = (f"since the {start_word(run.scene)} [s]", "event", "")
    return (
        f"<p>{escape(said)}</p><details><summary>{len(lines)} events"
        f"</summary>{table(head, lines)}</details>"
    )


def _parameters(scenes: Sequence[Scene], names: Sequence[str]) -> list[str]:
    differing, shared = parameter_rows(scenes)
    parts = []
    if differing:
        parts.append("<p>In these the runs differ:</p>")
        parts.append(table(("parameter", "unit", *names, "meaning"), differing))
        parts.append("<p>These they share:</p>")
    return [*parts, table(("parameter", "unit", "value", "meaning"), shared)]


def _picture(figure: Figure, caption: str, kind: str) -> str:
    """Return a figure as a drawing within the page."""
    buffer = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": "capture_sim", "svg.fonttype": "path"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    # as an image: names within one drawing must not meet those of another
    data = base64.b64encode(buffer.getvalue().encode()).decode()
    return (
        f'<figure class="{kind}"><img alt="{escape(caption)}" '
        f'src="data:image/svg+xml;base64,{data}"><figcaption>{escape(caption)}</figcaption></figure>'
    )
