"""Tables and texts of a report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass
from html import escape
from typing import Any

import numpy as np

from capture_sim.errors import SceneError, SimulationError
from capture_sim.results import first_cluster
from capture_sim.samples import ENERGIES
from capture_sim.scene.parts import Scene
from capture_sim.simulation import simulate
from capture_sim.viewing.source import ViewableRun

STYLE = """
body { font: 15px/1.45 "DejaVu Sans", Arial, sans-serif; color: #111; background: #fff;
       max-width: 1180px; margin: 0 auto; padding: 1em 1.5em 3em; }
h1 { font-size: 1.6em; } h2 { font-size: 1.25em; border-bottom: 1px solid #888; margin-top: 1.8em; }
table { border-collapse: collapse; margin: 0.6em 0; font-size: 0.92em; }
th, td { padding: 0.2em 0.6em; border-bottom: 1px solid #ccc; text-align: left; }
th { border-bottom: 2px solid #555; vertical-align: bottom; }
table.results td:nth-child(n+3), table.results th, table.numbers td:nth-child(n+2),
table.numbers th:nth-child(n+2) { text-align: right; }
.note { font-size: 0.88em; color: #444; } .problem { color: #a33c00; font-weight: bold; }
figure { display: inline-block; margin: 0.4em 0; vertical-align: top; break-inside: avoid; }
figure.wide { width: 100%; } figure.medium { width: 76%; margin-left: 12%; }
figure.narrow { width: 49.5%; } figure img { width: 100%; }
figcaption { font-size: 0.9em; color: #333; text-align: center; }
@media print {
  @page { size: A4; margin: 14mm 12mm; }
  body { font-size: 10pt; max-width: none; padding: 0; }
  h2 { break-after: avoid; } thead { display: table-header-group; } tr { break-inside: avoid; }
  table { font-size: 8pt; }
}
"""


def table(head: Sequence[str], lines: Sequence[Sequence[str]], kind: str = "plain") -> str:
    """Return a table as HTML; ``numbers`` is a kind that is aligned on the right."""
    top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    body = "".join(
        f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in line)}</tr>" for line in lines
    )
    return f"<table class={kind}><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"


def energy_rows(runs: Sequence[ViewableRun]) -> list[tuple[str, ...]]:
    """Return the ledger at the end of each run, mJ, a row for each entry that is not zero."""
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
    """Return every parameter of the scenes: rows that differ, and rows that all share.

    A row holds name, unit, a value (of each scene, where they differ) and the meaning.
    """
    described: dict[str, tuple[str, str]] = {}
    values: list[dict[str, str]] = []
    for scene in scenes:
        found: dict[str, str] = {}
        _walk("", scene, found, described)
        values.append(found)
    differing: list[tuple[str, ...]] = []
    shared: list[tuple[str, ...]] = []
    for name, (unit, doc) in described.items():
        cells = [found.get(name, "-") for found in values]
        if len(set(cells)) > 1:
            differing.append((name, unit, *cells, doc))
        else:
            shared.append((name, unit, cells[0], doc))
    return differing, shared


def _walk(
    prefix: str, part: Any, found: dict[str, str], described: dict[str, tuple[str, str]]
) -> None:
    for f in fields(part):
        value, name = getattr(part, f.name), f"{prefix}{f.name}"
        if is_dataclass(value):
            _walk(f"{name}.", value, found, described)
            continue
        if name in ("name", "title"):
            continue
        unit = str(f.metadata.get("unit", ""))
        unit = "" if unit == "1" else unit
        described.setdefault(name, (unit, str(f.metadata.get("doc", ""))))
        found[name] = _shown(value)


def _shown(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, tuple):
        return f"[{', '.join(map(_shown, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class ErrorStatement:
    """How far a run's numbers can be trusted, in words and numbers.

    Attributes
    ----------
    text
        For people.
    reproduced
        Largest difference of the run's states to a run made now, m and rad; None if not run.
    error
        Largest difference to a run with a finer integration, m, to the end of the first
        contact and to the end of the run; None if not run.
    same_touches
        Whether the finer run has the same touches.
    """

    text: str
    reproduced: float | None = None
    error: tuple[float, float] | None = None
    same_touches: bool = False


def error_statement(run: ViewableRun) -> ErrorStatement:
    """Run the scene of a simulated run again, as it was and finer, and compare."""
    times = np.asarray(run.samples["t"])
    try:
        again = simulate(run.scene, t_eval=times, check=True)
    except (SimulationError, SceneError) as error:
        return ErrorStatement(f"The run cannot be made again to check it: {error}")
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
        f"{late:.1e} m until the end of the run, angles counted by what they move the tip. "
    )
    if check.same_touches:
        text += "It has the same touches in the same order. "
    else:
        text += (
            "Its sequence of touches is another: what follows the first difference is one of "
            "several possible courses. "
        )
    residual = float(np.abs(run.samples["energy_residual"]).max())
    text += f"The energy ledger closes to {residual:.1e} J."
    return ErrorStatement(text, reproduced, (early, late), check.same_touches)


def not_simulated() -> ErrorStatement:
    """Return what can be said of measurements."""
    return ErrorStatement(
        "measured. Its errors are those of the sensors, which the recording does not tell; between "
        "two messages lies what was not seen, and the length of a touch is known to one message."
    )
