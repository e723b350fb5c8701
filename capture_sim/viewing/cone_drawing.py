"""The tip's way through the cone, drawn with matplotlib in the cone's frame."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon

from capture_sim.samples import EventKind
from capture_sim.scene.parts import Scene
from capture_sim.viewing import palette
from capture_sim.viewing.geometry import circle, tip_bound, tip_in_cone, wall
from capture_sim.viewing.source import (
    ViewableRun,
    contacts,
    first_touch,
    in_contact,
    strongest,
)

_MM = 1e3
_WALL_THICKNESS = 0.006  # m, for the eye only
LETTERS = "abcdefgh"
_ABOUT_WIDTH = 380.0  # points, of the axes in the smallest of the pictures
# of a letter from its dot, points, the best first: above, below, beside, then farther away
_LETTER_PLACES = (
    *((0, 13), (0, -14), (13, 1), (-13, 1), (11, 10), (-11, 10), (11, -10), (-11, -10)),
    *((0, 25), (0, -26), (24, 1), (-24, 1), (18, 18), (-18, 18), (18, -18), (-18, -18)),
)
FREE_LINE = (0, (4, 3))  # dashes


class Moment(NamedTuple):
    """An instant worth a picture of the tip."""

    t: float  # s
    place: np.ndarray  # tip's centre in the cone's frame, (2,), m
    meaning: str


def key_moments(run: ViewableRun) -> list[Moment]:
    """Return first touch, strongest touch, then latching or nearest approach and end.

    The end counts only where it lies within the frame.
    """
    samples = run.samples
    t, places = samples["t"], tip_in_cone(samples)
    found: list[Moment] = []

    def add(time: float, meaning: str) -> None:
        place = np.array([np.interp(time, t, places[:, i]) for i in (0, 1)])
        found.append(Moment(time, place, meaning))

    touch = first_touch(run)
    if touch is not None:
        peak_time, peak = strongest(run)
        first_end = min((end for start, end in contacts(run) if start == touch.t), default=touch.t)
        if peak > 0.0 and touch.t <= peak_time <= first_end:
            add(touch.t, f"first touch, {peak:.0f} N")
        else:
            add(touch.t, "first touch")
            if peak > 0.0:
                add(peak_time, f"strongest, {peak:.0f} N")
    latched = next((e for e in run.events if e.kind is EventKind.LATCHED), None)
    if latched is not None:
        add(latched.t, "latched")
    else:
        nearest = int(np.argmin(samples["tip_distance"]))
        add(float(t[nearest]), f"nearest, {samples['tip_distance'][nearest] * _MM:.1f} mm")
        (left, right), (low, high) = frame_bounds(run.scene)
        x, y = places[-1] * _MM
        if nearest == len(t) - 1:
            # as of a run that was broken off: one place, one letter
            found[-1] = found[-1]._replace(meaning=f"{found[-1].meaning} (end)")
        elif left < x < right and low < y < high:
            add(float(t[-1]), "end of the run")
    return sorted(found, key=lambda moment: moment.t)


def draw_cone(axes: Axes, scene: Scene, *, coloured: bool = True) -> None:
    """Draw both walls, the bound of the tip's centre and the capture zone.

    Parameters
    ----------
    axes, scene
        Where and what.
    coloured
        Whether the walls have colours of their own; not where the runs have.
    """
    cone, radius = scene.cone, scene.probe.tip_radius
    explained = bool(axes.get_legend_handles_labels()[1])
    for side, own in ((1, palette.PLUS_WALL), (-1, palette.MINUS_WALL)):
        colour = own if coloured else palette.DARK
        face = wall(cone, side) * _MM
        # the wall's body lies on the far side of its face
        out = np.array([np.sin(cone.beta), side * np.cos(cone.beta)]) * _WALL_THICKNESS * _MM
        body = np.concatenate([face, (face + out)[::-1]])
        axes.add_patch(Polygon(body, facecolor=palette.LIGHT, edgecolor="none", zorder=1))
        axes.plot(*face.T, color=colour, lw=4.0, zorder=2, solid_capstyle="round")
        axes.plot(
            *(tip_bound(cone, radius, side) * _MM).T,
            color=palette.GREY,
            lw=1.2,
            ls=":",
            zorder=2,
            label="centre when touching" if side > 0 and not explained else None,
        )
        # where neither legend nor list of moments is
        share = 0.6 if side > 0 else 0.15
        middle = (1.0 - share) * face[0] + share * face[1] + 1.9 * out
        axes.text(
            middle[0],
            middle[1],
            f"{'+' if side > 0 else '-'}y wall",
            color=colour,
            fontsize=13,
            fontweight="bold",
            rotation=-side * np.rad2deg(cone.beta),
            rotation_mode="anchor",
            ha="center",
            va="center",
        )
    zone = circle(np.zeros(2), scene.detector.radius) * _MM
    label = None if explained else "capture zone"
    axes.plot(*zone.T, color=palette.GREEN, lw=2.3, zorder=4, label=label)
    axes.plot(0, 0, marker="+", ms=10, mew=1.8, color=palette.GREEN, zorder=4)


def draw_path(axes: Axes, run: ViewableRun, colour: str = palette.BLACK) -> None:
    """Draw the way of the tip's centre: solid while it touches, dashed while it does not."""
    way = tip_in_cone(run.samples) * _MM
    touching = in_contact(run)
    touching[1:] |= touching[:-1]  # a stretch belongs to the sample before it
    axes.plot(*way.T, color=colour, lw=1.3, ls=FREE_LINE, zorder=5)
    axes.plot(*np.where(touching[:, None], way, np.nan).T, color=colour, lw=3.2, zorder=5)


def label_path(axes: Axes, colour: str = palette.BLACK) -> None:
    """Explain the way's dashes in the legend."""
    axes.plot([], [], color=colour, lw=1.3, ls=FREE_LINE, label="centre, free")
    axes.plot([], [], color=colour, lw=3.2, label="centre, in contact")


def draw_tip(axes: Axes, scene: Scene, moments: list[Moment]) -> None:
    """Draw the tip as a circle at each moment, marked a, b, c..."""
    radius = scene.probe.tip_radius * _MM
    halo = [patheffects.withStroke(linewidth=3, foreground="white")]
    offsets = _letter_places(scene, moments)
    for i, moment in enumerate(moments):
        x, y = moment.place * _MM
        axes.add_patch(
            Circle((x, y), radius, facecolor=palette.SKY, alpha=0.14, edgecolor="none", zorder=3)
        )
        axes.add_patch(
            Circle((x, y), radius, facecolor="none", edgecolor=palette.GREY, lw=1.1, zorder=3)
        )
        axes.plot(x, y, "o", ms=6.5, color=palette.BLACK, mec="white", zorder=7)
        axes.annotate(
            LETTERS[i],
            (x, y),
            xytext=offsets[i],
            textcoords="offset points",
            fontsize=14,
            fontweight="bold",
            ha="center",
            va="center",
            path_effects=halo,
            zorder=8,
        )


def _letter_places(scene: Scene, moments: list[Moment]) -> list[tuple[float, float]]:
    """Return where each moment's letter stands, points from its dot, clear of the others."""
    (left, right), _ = frame_bounds(scene)
    # before it is laid out, the width of the axes is known about
    dots = np.array([moment.place for moment in moments]).reshape(-1, 2) * _MM
    dots *= _ABOUT_WIDTH / (right - left)
    letters: list[np.ndarray] = []
    chosen: list[tuple[float, float]] = []
    for i, dot in enumerate(dots):
        # up and down in turn, so that near ones part
        sign = 1 if i % 2 == 0 else -1
        others = np.delete(dots, i, axis=0)

        def room(
            place: tuple[float, float], dot: np.ndarray = dot, others: np.ndarray = others
        ) -> float:
            """Return how far a letter is from what it must not cover; 1 is enough."""
            at = dot + place
            from_letters = [float(np.linalg.norm(at - other)) / 17.0 for other in letters]
            from_dots = [float(np.linalg.norm(at - other)) / 10.0 for other in others]
            return min([1.0, *from_letters, *from_dots])

        # max takes the first of those that are equally good
        place = max([(float(x), float(sign * y)) for x, y in _LETTER_PLACES], key=room)
        letters.append(dot + place)
        chosen.append(place)
    return chosen


def frame_bounds(scene: Scene) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return what is shown of x and of y, mm."""
    lip = wall(scene.cone, 1)[1] * _MM
    margin = scene.probe.tip_radius * _MM + 4.0
    top = float(lip[1] + 0.6 * margin)
    # room for legends behind BE, where nothing else is
    return (float(lip[0] - 1.5 * margin), float(lip[1] + 0.1 * margin)), (-top, top)


def frame_cone(axes: Axes, scene: Scene) -> None:
    """Fit the axes to the cone, same scale in x and y."""
    across, upwards = frame_bounds(scene)
    axes.set_aspect("equal")
    axes.set_xlim(across)
    axes.set_ylim(upwards)
    axes.set_xlabel("x in the cone's frame, from BE  [mm]")
    axes.set_ylabel("y in the cone's frame  [mm]")
