"""One look for everything that is drawn: colours, marks, units, sizes.

Colours, most of them of Okabe and Ito (2008), differ for people with any common colour vision.
Each means one thing in plots, report and rerun: a run keeps its colour and marker, a wall its
triangle, a verdict its colour and marker.  The bench itself is drawn in greys.
"""

from __future__ import annotations

from typing import NamedTuple

BLACK = "#000000"
ORANGE = "#E69F00"
SKY = "#56B4E9"
GREEN = "#009E73"
YELLOW = "#F0E442"
BLUE = "#0072B2"
VERMILION = "#D55E00"
PURPLE = "#CC79A7"
ROSE = "#F29CC4"
CRIMSON = "#C04060"
BROWN = "#8C510A"
LIME = "#77BB00"
VIOLET = "#AA00FF"
OLIVE = "#857000"
MAGENTA = "#FF44EE"
LAVENDER = "#8888FF"
PLUM = "#773399"
WINE = "#882255"
DARK = "#404040"
GREY = "#7F7F7F"
LIGHT = "#D9D9D9"
CONE = "#9CC3DB"
PALE = "#E3EEF5"

#: Colour of each run, in order; they repeat after that.
RUNS = (BLUE, VERMILION, ROSE, CRIMSON, VIOLET, LIME, OLIVE, MAGENTA, LAVENDER, PLUM)
#: Runs whose colours differ for people with any colour vision. Of more runs, each has a marker too.
COLOURS_ALONE = 4
#: Marker of each run; triangles up and down are the walls'.
RUN_MARKERS = ("o", "s", "D", "P", "X", "*", "p", "<", ">", "h")
#: The tip touches the cone.
CONTACT = YELLOW
#: The zone of capture, and what lies in it.
ZONE = GREEN
#: Walls by their side: marker and name.
WALLS = {1: ("^", "+y wall"), -1: ("v", "-y wall")}
#: Marker and name of a measured touch whose wall is not known.
NO_WALL = ("D", "wall not known")


class Look(NamedTuple):
    """Colour and marker of a verdict."""

    colour: str
    marker: str


VERDICTS = {
    "captured": Look(GREEN, "o"),
    "rebound": Look(ORANGE, "D"),
    "stuck": Look(WINE, "s"),
    "missed": Look("#6FA5C4", "X"),
    "undecided": Look(BLACK, "P"),
}
#: Of the lanes over time.
PHASES = {
    "held": "#BFBFBF",
    "taut": "#8F7CB5",
    "coast": "#2A5B7C",
    "free": PALE,
    "contact": CONTACT,
    "latched": ZONE,
}
STATES = {
    "approach": PALE,
    "contact": CONTACT,
    **{verdict: look.colour for verdict, look in VERDICTS.items()},
}

#: Of axes' labels, in points; chosen to be read when a figure is shown at half its size.
FONT = 14.0
#: Of everything else.
SMALL = 12.5
#: Pixels per inch of PNG files.
DPI = 110
#: Dashes of a line while the tip does not touch.
FREE_LINE = (0, (4.0, 2.4))


class Line(NamedTuple):
    """Style of a curve: dashes of matplotlib, and a width relative to the width in contact."""

    dashes: tuple[float, tuple[float, ...]] | str
    width: float


#: While the tip is free, in contact, latched.
LINES = {
    "free": Line(FREE_LINE, 0.6),
    "in contact": Line("solid", 1.0),
    "latched": Line((0, (5.0, 1.2, 1.0, 1.2)), 0.8),
}


def run_colour(i: int) -> str:
    """Return the colour of the i-th run."""
    return RUNS[i % len(RUNS)]


def run_marker(i: int) -> str:
    """Return the marker of the i-th run."""
    return RUN_MARKERS[i % len(RUN_MARKERS)]


def rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue, 0 to 255, of ``#RRGGBB``."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def light(colour: tuple[int, int, int]) -> tuple[int, int, int]:
    """Return a colour mixed with two parts of white."""
    red, green, blue = ((part + 2 * 255) // 3 for part in colour)
    return red, green, blue
