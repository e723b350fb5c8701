"""Writes the page of a study as one file of HTML: what was asked, what was printed, its figures."""

from __future__ import annotations

import base64
import datetime
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from jinja2 import Environment, PackageLoader
from matplotlib import rc_context
from matplotlib.figure import Figure

from capture_sim.base.files import whole_file
from capture_sim.base.software import own_version
from capture_sim.base.tables import Section
from capture_sim.run.simulation import simulate
from capture_sim.scene.parts import Scene
from capture_sim.studies.search.design import Design
from capture_sim.viewing.canvas import small_png
from capture_sim.viewing.plots import plot

#: Resolution of pixels on the page, dots per inch: of the run's figure, and of the points that
#: other figures have by the thousand, whose lines and texts are drawn as such.
_DPI = 90.0


class Illustration(NamedTuple):
    """A picture on a page: its caption, and what an image shows, as a data URI."""

    caption: str
    data: str


def drawn(figures: Mapping[str, Figure]) -> list[Illustration]:
    """Return figures as pictures that can be enlarged; their names are the captions."""
    return [
        Illustration(name, _data("image/svg+xml", _svg(each))) for name, each in figures.items()
    ]


def save_page(
    path: Path,
    title: str,
    asked: Mapping[str, str],
    pictures: Sequence[Illustration],
    shown: Sequence[str | Section],
    *,
    files: Mapping[str, str] | None = None,
    last: Sequence[Illustration] = (),
    unshown: str = "",
    scene: Scene | None = None,
) -> Path:
    """Write the page of a study to a file, and return its path.

    Everything is within the file.  RecordingError if it cannot be written; an earlier file of this
    name then stays.

    Parameters
    ----------
    path, title
        The file, and the title of the page.
    asked
        What was asked for, as texts by what they are, e.g. ``command``.
    pictures, last
        Pictures before and after the tables.
    shown
        Lines and tables, as the command has printed them.
    files
        Other files of the study, which the page links to: names by what they are.
    unshown
        What the study does not say, in words.
    scene
        The scene, which the page has as YAML.
    """
    environment = Environment(loader=PackageLoader("capture_sim.viewing", "."), autoescape=True)
    sections = [Section("", [each]) if isinstance(each, str) else each for each in shown]
    text = environment.get_template("study.html.j2").render(
        title=title,
        date=datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"),
        version=own_version(),
        asked=asked,
        pictures=pictures,
        sections=sections,
        files=files or {},
        last=last,
        unshown=unshown,
        scene=scene,
        yaml="" if scene is None else scene.to_yaml(),
    )
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")
    return path


def save_design_page(
    design: Design,
    picked: int | None,
    sections: Sequence[Section],
    figure: Figure,
    path: Path,
    asked: Mapping[str, str],
) -> Path:
    """Write the page of a design, with the run of the picked row; see :func:`save_page`."""
    last, rows = [], len(design.rows)
    if picked is not None:
        shown = plot(simulate(design.scene_of(design.rows[picked].candidate)))
        caption = f"Run of row {picked + 1}" if rows > 1 else "Run of the design"
        last = [Illustration(caption, _data("image/png", small_png(shown, _DPI)))]
    files = {f"row {n}": f"design_{n:02d}.yaml" for n in range(1, rows + 1)} if rows > 1 else {}
    if rows:
        files |= {"design.yaml": "design.yaml", "front.csv": "front.csv"}
    return save_page(
        path,
        f"Design of a buffer: {design.scene.name}",
        asked,
        drawn({"Candidates, front, values and springs of the rows": figure}),
        sections,
        files=files | {"all that was tried": "design.json"},
        last=last,
        unshown="The values that were not searched are those of the scene below, held exact. A "
        "buffer that was not run may beat a row. Without dispersions above, nothing is said of a "
        "bench that differs from the scene. Loads of parts that the scene lacks are not computed.",
        scene=design.scene,
    )


def asked_of(design: Design, command: str, seed: int, budget: int) -> dict[str, str]:
    """Return what a design was asked for, and what was held, as texts by what they are."""
    requirements, scene = design.requirements, design.scene
    limits = [limit.text for limit in requirements.limits]
    held = "not required"
    if not requirements.allow_leaving:
        held = "in the capture zone at the end of the run and at ten times its end"
        held += ", not behind BE" if requirements.hold_at_be else "; it may pass BE"
    searched = [
        f"{each.name} {', '.join(f'{x:.4g}' for x in each.values)} {each.unit}"
        if each.values
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


def _svg(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "capture_sim"}):
        figure.savefig(buffer, format="svg", dpi=_DPI, metadata={"Date": None})
    return buffer.getvalue()


def _data(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
