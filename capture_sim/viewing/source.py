"""What the viewing needs of a run, wherever it comes from."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from capture_sim.detection import CaptureStatus
from capture_sim.samples import Event, EventKind
from capture_sim.scene import Scene


class ViewableRun(Protocol):
    """A run that can be drawn: a Result of the core, or a Run read from a file."""

    @property
    def scene(self) -> Scene:
        """What was on the bench."""

    @property
    def samples(self) -> np.ndarray:
        """(n,) of dtype SAMPLE, by time."""

    @property
    def touches(self) -> np.ndarray:
        """(m,) of dtype TOUCH, by their end."""

    @property
    def events(self) -> Sequence[Event]:
        """By time."""

    @property
    def statuses(self) -> Sequence[CaptureStatus]:
        """The detector's judgements, by time."""


def verdict(run: ViewableRun) -> str:
    """Return the detector's last word, or that there is none."""
    if not run.statuses:
        return "no verdict"
    return str(run.statuses[-1].state.name).lower()


def first_touch(run: ViewableRun) -> Event | None:
    """Return the event of the first touch."""
    return next((event for event in run.events if event.kind is EventKind.TOUCH), None)


def impact_speed(run: ViewableRun) -> float | None:
    """Return the speed of the vehicles to each other at the first touch, m/s."""
    touch = first_touch(run)
    if touch is None:
        return None
    v = touch.v
    return math.hypot(float(v[0] - v[5]), float(v[1] - v[6]))


def headline(run: ViewableRun) -> str:
    """Return name, verdict and impact speed in one line, and what was changed in another."""
    speed = impact_speed(run)
    impact = "no touch" if speed is None else f"impact at {speed:.3f} m/s"
    changed = run.scene.title.partition("; with ")[2]
    line = f"{run.scene.name}: {verdict(run)}, {impact}"
    return line + ("\nwith " + textwrap.shorten(changed, 90) if changed else "")


def in_contact(run: ViewableRun) -> np.ndarray:
    """Return whether the tip touches at or right after each sample, (n,) bool.

    Touches shorter than the distance of two samples count.
    """
    t = run.samples["t"]
    touching: np.ndarray = run.samples["walls"] != 0
    for touch in run.touches:
        first = int(np.searchsorted(t, touch["start"], side="right")) - 1
        last = int(np.searchsorted(t, touch["end"], side="left"))
        touching[max(first, 0) : last] = True
    return touching


def decided_at(run: ViewableRun) -> float | None:
    """Return when the detector's verdict became final, s since the release."""
    return next((status.t for status in run.statuses if status.final), None)
