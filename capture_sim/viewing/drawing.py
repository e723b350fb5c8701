"""The bench from above and the tip's way through the cone, drawn with matplotlib."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.patches import Circle

from capture_sim.samples import EventKind
from capture_sim.scene.parts import Scene
from capture_sim.viewing import style
from capture_sim.viewing.canvas import draw_shapes
from capture_sim.viewing.shapes import (
    CHASER,
    TARGET,
    Box,
    chaser_box,
    cone_shapes,
    placed,
    rail_shapes,
    state_shapes,
    target_box,
    tip_in_cone,
    wall,
    wall_name_place,
)
from capture_sim.viewing.source import (
    ViewableRun,
    contacts,
    first_touch,
    in_contact,
    start_word,
    strongest,
)

_MM = 1e3
LETTERS = "abcdefgh"
_ABOUT_WIDTH = 380.0  # points, of the axes in the smallest of the pictures
# of a letter from its dot, points, the best first: above, below, beside, then farther away
_LETTER_PLACES = (
    *((0, 13), (0, -14), (13, 1), (-13, 1), (11, 10), (-11, 10), (11, -10), (-11, -10)),
    *((0, 25), (0, -26), (24, 1), (-24, 1), (18, 18), (-18, 18), (18, -18), (-18, -18)),
)


def draw_bench(axes: Axes, run: ViewableRun, colour: str = style.BLUE) -> str:
    """Draw the vehicles at the start (dashed) and at the first touch (solid), m.

    Returns
    -------
    str
        What is seen, in words.
    """
    scene, start = run.scene, run.samples["q"][0]
    touch = first_touch(run)
    then = run.samples["q"][-1] if touch is None else touch.q
    moved = bool(np.linalg.norm(then[:2] - start[:2]) > 0.01)
    shapes = rail_shapes(scene) + state_shapes(scene, then, colour)
    if moved:
        shapes += state_shapes(scene, start, colour, ghost=True, both=False)
    draw_shapes(axes, shapes)
    degrees = round(float(np.rad2deg(then[TARGET[2]])))
    _name(axes, "chaser", chaser_box(scene), then[list(CHASER)])
    _name(axes, f"target\n{degrees:+d}°" if degrees else "target\n0°", target_box(scene), then[5:])
    axes.set_aspect("equal")
    axes.margins(0.03)
    axes.set_xlabel("x in the world  [m]")
    axes.set_ylabel("y  [m]")
    when = "end of the run" if touch is None else "first touch"
    return f"at the {start_word(scene)} and at the {when}" if moved else f"at the {when}"


def _name(axes: Axes, text: str, box: Box, pose: np.ndarray) -> None:
    """Write along a body's front-to-rear axis, in its middle."""
    middle = placed(np.array([[(box.back + box.front) / 2, 0.0]]), *pose)[0]
    axes.text(
        float(middle[0]),
        float(middle[1]),
        text,
        ha="center",
        va="center",
        fontsize=style.SMALL,
        rotation=float(np.rad2deg(pose[2])),
        zorder=4,  # over the ghost and the balls
        bbox={"facecolor": style.LIGHT, "edgecolor": "none", "pad": 2.0},
    )


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


def draw_cone(axes: Axes, scene: Scene) -> None:
    """Draw walls, bound of the tip's centre and capture zone, and explain them."""
    explained = bool(axes.get_legend_handles_labels()[1])
    draw_shapes(axes, cone_shapes(scene).values(), _MM)
    axes.plot(0, 0, marker="+", ms=10, mew=1.8, color=style.ZONE, zorder=4)
    if not explained:
        axes.plot([], [], color=style.GREY, lw=1.0, ls=style.FREE_LINE, label="bound of the centre")
        axes.plot([], [], color=style.ZONE, lw=2.3, label="capture zone")
    for side, (*_, name) in style.WALLS.items():
        x, y = wall_name_place(scene.cone, side) * _MM
        axes.text(
            x,
            y,
            name,
            color=style.DARK,
            fontsize=13,
            fontweight="bold",
            rotation=-side * np.rad2deg(scene.cone.half_angle),
            rotation_mode="anchor",
            ha="center",
            va="center",
        )


def draw_path(axes: Axes, run: ViewableRun, colour: str = style.BLUE) -> None:
    """Draw the way of the tip's centre: solid while it touches, dashed while it does not."""
    (left, right), (low, high) = frame_bounds(run.scene)
    way = tip_in_cone(run.samples) * _MM
    touching = in_contact(run)
    touching[1:] |= touching[:-1]  # what lies between two samples belongs to the earlier
    # what lies far outside of the frame needs no line
    near = (way > (left - 50.0, low - 50.0)).all(axis=1)
    near &= (way < (right + 50.0, high + 50.0)).all(axis=1)
    way, touching = way[near], touching[near]
    axes.plot(*way.T, color=colour, lw=1.3, ls=style.FREE_LINE, zorder=5)
    axes.plot(*np.where(touching[:, None], way, np.nan).T, color=colour, lw=3.2, zorder=5)


def label_path(axes: Axes, colour: str = style.BLUE) -> None:
    """Explain the way's dashes in the legend."""
    axes.plot([], [], color=colour, lw=1.3, ls=style.FREE_LINE, label="centre, free")
    axes.plot([], [], color=colour, lw=3.2, label="centre, in contact")


def draw_tip(axes: Axes, scene: Scene, moments: list[Moment], colour: str = style.BLUE) -> None:
    """Draw the tip as a circle at each moment, marked a, b, c..."""
    radius = scene.probe.tip_radius * _MM
    halo = [patheffects.withStroke(linewidth=3, foreground="white")]
    offsets = _letter_places(scene, moments)
    for i, moment in enumerate(moments):
        x, y = moment.place * _MM
        axes.add_patch(
            Circle((x, y), radius, facecolor=colour, alpha=0.14, edgecolor="none", zorder=3)
        )
        axes.add_patch(
            Circle((x, y), radius, facecolor="none", edgecolor=style.GREY, lw=1.1, zorder=3)
        )
        axes.plot(x, y, "o", ms=6.5, color=style.BLACK, mec="white", zorder=7)
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
