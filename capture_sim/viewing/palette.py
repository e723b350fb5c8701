"""Colours that people with any common colour vision tell apart (Okabe and Ito)."""

from __future__ import annotations

BLACK = "#000000"
ORANGE = "#E69F00"
SKY = "#56B4E9"
GREEN = "#009E73"
YELLOW = "#F0E442"
BLUE = "#0072B2"
VERMILION = "#D55E00"
PURPLE = "#CC79A7"
DARK_GREEN = "#006B4E"  # for text on light green
DARK = "#404040"
GREY = "#7F7F7F"
LIGHT = "#D9D9D9"

#: One for each run, in order, the most different first; they repeat after that.
RUNS = (BLUE, VERMILION, GREEN, SKY, ORANGE, PURPLE)

PLUS_WALL = BLUE
MINUS_WALL = VERMILION


def light(colour: tuple[int, int, int]) -> tuple[int, int, int]:
    """Return a colour mixed with twice as much white."""
    red, green, blue = ((part + 2 * 255) // 3 for part in colour)
    return red, green, blue


def rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue, 0 to 255, of ``#RRGGBB``."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
