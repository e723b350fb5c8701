"""Common style of plots, report and rerun: colours, markers, line styles and font sizes.

In all of them a run has the same colour and marker, a wall the same triangle, and a verdict the
same colour and marker.  A colour may have another meaning in a plot that shows no runs, e.g. blue
for a simulated curve.  Vehicles and walls are drawn in black and greys in plots.

Most colours are those of Okabe and Ito (2008), which people with colour-vision deficiencies can
tell apart.
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
INDIGO = "#8811EE"
PLUM = "#773399"
WINE = "#882255"
DARK = "#404040"
GREY = "#7F7F7F"
LIGHT = "#D9D9D9"
CONE = "#9CC3DB"
PALE = "#E3EEF5"

#: Colour of each run, in order; they repeat after that.
RUNS = (BLUE, VERMILION, ROSE, CRIMSON, VIOLET, LIME, OLIVE, MAGENTA, LAVENDER, PLUM)
#: Number of runs whose colours differ for all kinds of colour vision; more runs have markers too.
COLOURS_ALONE = 4
#: Marker of each run, in order; they repeat. The triangles up and down are those of the walls.
RUN_MARKERS = ("o", "s", "D", "P", "X", "*", "p", "<", ">", "h")
#: Colour of the times at which the tip touches the cone.
CONTACT = YELLOW
#: Colour of the capture zone, and of the phase latched.
ZONE = GREEN
#: Marker and name of each wall, by its side: +1 or -1.
WALLS = {1: ("^", "+y wall"), -1: ("v", "-y wall")}
#: Marker and name of a measured touch whose wall is not known.
NO_WALL = ("D", "wall not known")


class Look(NamedTuple):
    """The colour and the marker of a verdict."""

    colour: str
    marker: str
    hatch: str = ""  # of areas, where success and failure must differ without colours, too


#: Look of each outcome: the verdicts, and captures whose tip has left the capture zone again.
VERDICTS = {
    "captured": Look(GREEN, "o"),
    "captured, left": Look(INDIGO, "*", "///"),
    "rebound": Look(ORANGE, "D"),
    "stuck": Look(WINE, "s"),
    "missed": Look("#6FA5C4", "X"),
    "undecided": Look(BLACK, "P"),
}
#: Colours of the phases and of the detector's states in bars over time.
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

#: Font size of the axes' labels, points; legible when a figure is shown at half its size.
FONT = 14.0
#: Font size of legends and annotations, points.
SMALL = 12.5
#: Pixels per inch of PNG files.
DPI = 110
#: Dashes, as in matplotlib, of a line while the tip does not touch the cone.
FREE_LINE = (0, (4.0, 2.4))


class Line(NamedTuple):
    """A line style: dashes as in matplotlib, and a width relative to that in contact."""

    dashes: tuple[float, tuple[float, ...]] | str
    width: float


#: Line styles while the tip is free, in contact, or latched.
LINES = {
    "free": Line(FREE_LINE, 0.6),
    "in contact": Line("solid", 1.0),
    "latched": Line((0, (5.0, 1.2, 1.0, 1.2)), 0.8),
}


def run_colour(i: int) -> str:
    """Return the colour of run ``i``, counted from 0; colours repeat after the last of RUNS."""
    return RUNS[i % len(RUNS)]


def run_marker(i: int) -> str:
    """Return the marker of run ``i``, counted from 0; markers repeat after the last one."""
    return RUN_MARKERS[i % len(RUN_MARKERS)]


def rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue, 0 to 255 each, of a colour written as ``#RRGGBB``."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def light(colour: tuple[int, int, int]) -> tuple[int, int, int]:
    """Return a lighter colour: one part of the colour and two parts of white, 0 to 255 each."""
    red, green, blue = ((part + 2 * 255) // 3 for part in colour)
    return red, green, blue
