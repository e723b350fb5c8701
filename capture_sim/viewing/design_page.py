"""Writes the report of a design as one page of HTML, with its figure and its tables."""

from __future__ import annotations

import base64
import datetime
from collections.abc import Sequence
from pathlib import Path

from jinja2 import Environment, PackageLoader
from matplotlib.figure import Figure

from capture_sim.base.files import whole_file
from capture_sim.base.software import own_version
from capture_sim.base.tables import Section
from capture_sim.viewing.canvas import small_png

#: Resolution of the figure on the page, dots per inch, enough for a screen.
_DPI = 90.0


def save_design_page(title: str, sections: Sequence[Section], figure: Figure, path: Path) -> Path:
    """Write the page of a design with its tables and its figure to a file; return its path.

    The figure is within the file.  RecordingError if it cannot be written; an earlier file of this
    name then stays.
    """
    environment = Environment(loader=PackageLoader("capture_sim.viewing", "."), autoescape=True)
    text = environment.get_template("design.html.j2").render(
        title=title,
        date=datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"),
        version=own_version(),
        picture=f"data:image/png;base64,{base64.b64encode(small_png(figure, _DPI)).decode()}",
        sections=sections,
    )
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")
    return path
