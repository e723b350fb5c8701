"""Writes the report of a design as one page of HTML, with its figures, its tables and its scene."""

from __future__ import annotations

import base64
import datetime
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from jinja2 import Environment, PackageLoader
from matplotlib import rc_context
from matplotlib.figure import Figure

from capture_sim.base.files import whole_file
from capture_sim.base.software import own_version
from capture_sim.base.tables import Section
from capture_sim.run.simulation import simulate
from capture_sim.studies.design import Design
from capture_sim.viewing.canvas import small_png
from capture_sim.viewing.plots import plot

#: Resolution of pixels on the page, dots per inch: of the run's figure, and of the points of tried
#: buffers in the design's, whose lines and texts are drawn as such.
_DPI = 90.0


def save_design_page(
    design: Design,
    picked: int | None,
    sections: Sequence[Section],
    figure: Figure,
    path: Path,
    asked: Mapping[str, str],
) -> Path:
    """Write the page of a design to a file, and return its path.

    It has what was asked (``asked``, by what it is: the command line, seed and so on), figure and
    tables, the run of the picked row, and the scene.  Everything is within the file.
    RecordingError if it cannot be written; an earlier file of this name then stays.
    """
    environment = Environment(loader=PackageLoader("capture_sim.viewing", "."), autoescape=True)
    run = ""
    if picked is not None:
        shown = plot(simulate(design.scene_of(design.rows[picked].candidate)))
        run = _data("image/png", small_png(shown, _DPI))
    text = environment.get_template("design.html.j2").render(
        title=f"Design of a buffer: {design.scene.name}",
        date=datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"),
        version=own_version(),
        picture=_data("image/svg+xml", _svg(figure)),
        run=run,
        run_title="" if picked is None else _run_title(design, picked),
        sections=sections,
        asked=asked,
        scene=design.scene.to_yaml(),
        rows=[f"design_{n:02d}.yaml" for n in range(1, len(design.rows) + 1)]
        if len(design.rows) > 1
        else ["design.yaml"] * len(design.rows),
    )
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")
    return path


def asked_of(design: Design, command: str, seed: int, budget: int) -> dict[str, str]:
    """Return what a design was asked for, and what was held, as texts by what they are."""
    requirements, scene = design.requirements, design.scene
    limits = [limit.text for limit in requirements.limits]
    held = "not required"
    if not requirements.allow_leaving:
        held = "in the capture zone at the end of the run and at ten times its end"
        held += ", not behind BE" if requirements.hold_at_be else "; it may pass BE"
    searched = [
        f"{each.name} {', '.join(f'{x:.4g}' for x in each.choices)} {each.unit}"
        if each.choices
        else f"{each.name} {each.low:.4g} to {each.high:.4g} {each.unit}"
        for each in design.variables
    ]
    found = {
        "command": command,
        "scene": f"{scene.name}: {scene.title}",
        "objectives": ", ".join(each.meaning for each in requirements.objectives),
        "limits": ", ".join(limits) or "none",
        "tip held": held,
        "searched": "; ".join(searched),
        "budget": f"{budget} buffers, {len(design.history)} run; seed {seed}",
        "dispersions": "none: the limits are met in the scene's own run only",
    }
    if requirements.under is not None:
        varied = "; ".join(f"{name} {given}" for name, given in requirements.under.vary.items())
        found["dispersions"] = f"{varied}; {requirements.confidence:.4g} of the draws required"
    if requirements.area:
        found["area of approach"] = ", ".join(axis.name for axis in requirements.area)
    return found


def _run_title(design: Design, picked: int) -> str:
    return f"Run of row {picked + 1}" if len(design.rows) > 1 else "Run of the design"


def _svg(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "capture_sim"}):
        figure.savefig(buffer, format="svg", dpi=_DPI, metadata={"Date": None})
    return buffer.getvalue()


def _data(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
