"""What is drawn over time, as data: used by pictures, report and rerun alike.

As in the paper, a line is solid while the tip touches the cone and dashed while it does not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from capture_sim.viewing import style
from capture_sim.viewing.source import (
    ViewableRun,
    distinct_names,
    first_touch,
    in_contact,
    normal_force_with_peaks,
    start_word,
    time_window,
)

Runs = ViewableRun | Sequence[ViewableRun]
Window = tuple[float, float]

#: Layers of the ledger, from below: name, colour, fields of a sample.
LAYERS = (
    ("kinetic", style.SKY, ("kinetic",)),
    ("elastic, buffer", style.BLUE, ("elastic_axial", "elastic_torsion", "elastic_stop")),
    ("elastic, contact and latch", style.DARK, ("elastic_contact", "elastic_latch")),
    ("axial damper", style.ORANGE, ("dissipated_axial",)),
    ("torsional damper", "#006B4E", ("dissipated_torsion",)),
    ("contact hysteresis", style.VERMILION, ("dissipated_contact",)),
    ("friction of the tip", style.PURPLE, ("dissipated_friction",)),
    ("rolling", style.LIGHT, ("dissipated_rolling",)),
    ("latches", style.GREEN, ("dissipated_latch",)),
    ("stops", style.BLACK, ("dissipated_stop",)),
    ("landing of the mass", style.YELLOW, ("dissipated_landing",)),
)
_VISIBLE = 1e-3  # share of the whole below which a layer is left out
_POINTS = 600


class Shown(NamedTuple):
    """A run as it is drawn: its name, colour, and from when its time counts."""

    run: ViewableRun
    label: str
    colour: str
    origin: float  # s
    touching: np.ndarray  # (n,) bool, of its samples

    @property
    def time(self) -> np.ndarray:
        """Times of the samples as drawn, (n,), s."""
        return np.asarray(self.run.samples["t"]) - self.origin


class Trace(NamedTuple):
    """A curve from elsewhere, to be drawn over a run's: another engine, a measurement."""

    label: str
    t: np.ndarray  # (n,), s, on the axis that is drawn
    values: np.ndarray  # (n,) or (n, k), SI units


class Panel(NamedTuple):
    """One quantity over time.

    Attributes
    ----------
    title
        In words.
    axis
        Label with unit.
    curve
        Times (n,), s, and values (n,) of a run, in the axis' unit.
    sampled
        Whether the times are those of the samples: then the line tells contact from flight.
    factor
        How many of the unit to the SI unit.
    from_zero
        Whether the axis begins at zero.
    """

    title: str
    axis: str
    curve: Callable[[ViewableRun], tuple[np.ndarray, np.ndarray]]
    sampled: bool = False
    factor: float = 1.0
    from_zero: bool = False


def _of_samples(quantity: style.Quantity, title: str, *, from_zero: bool = False) -> Panel:
    return Panel(
        title,
        quantity.axis,
        lambda run: (run.samples["t"], quantity.of(run.samples)),
        sampled=True,
        factor=quantity.factor,
        from_zero=from_zero,
    )


def penetration(run: ViewableRun) -> tuple[np.ndarray, np.ndarray]:
    """Return times (n,), s, and how deep the tip is in a wall that it touches, (n,), um."""
    samples, touches = run.samples, run.touches
    # of the walls that are touched: latches hold the tip in their place
    touched = (samples["walls"][:, None] & np.array([1, 2])) != 0
    deepest = np.where(touched, samples["penetration"], 0.0).max(axis=1) * 1e6
    # zero at the located ends, so that no touch looks longer than it was
    t = np.concatenate([samples["t"], touches["start"], touches["end"]])
    deepest = np.concatenate([deepest, np.zeros(2 * len(touches))])
    t, first = np.unique(t, return_index=True)
    return t, deepest[first]


#: By name of their figure's file.
PANELS = {
    "impact_force": Panel(
        "Contact force with every touch",
        "normal contact force  [N]",
        normal_force_with_peaks,
        from_zero=True,
    ),
    "intrusion": Panel(
        "Penetration of the tip into the wall", "penetration  [µm]", penetration, from_zero=True
    ),
    "axial_performance": _of_samples(style.STROKE, "Axial buffer"),
    "torsional_performance": _of_samples(style.TORSION, "Torsional buffer"),
    "distance": _of_samples(style.DISTANCE, "Distance of the tip to BE", from_zero=True),
}


def as_shown(
    runs: Runs, labels: Sequence[str] | None = None, *, aligned: bool = False
) -> list[Shown]:
    """Give every run its label, colour and origin of time.

    Parameters
    ----------
    runs
        One, or several.
    labels
        One each; None takes the scenes' names.
    aligned
        Count each run's time from its first touch.

    Raises
    ------
    ValueError
        There is no run, or not one label each.
    """
    several = list(runs) if isinstance(runs, Sequence) else [runs]
    if not several:
        raise ValueError("no run to draw")
    names = distinct_names([run.scene.name for run in several]) if labels is None else labels
    if len(names) != len(several):
        raise ValueError(f"{len(names)} labels for {len(several)} runs")
    shown = []
    for i, (run, name) in enumerate(zip(several, names, strict=True)):
        touch = first_touch(run)
        origin = touch.t if aligned and touch is not None else 0.0
        shown.append(Shown(run, name, style.run_colour(i), origin, in_contact(run)))
    return shown


def common_window(shown: Iterable[Shown], window: Window | None = None) -> Window:
    """Return the time to draw, s on the axis: as asked, or from before contact to verdict."""
    if window is not None:
        return window
    windows = [
        (start - s.origin, end - s.origin) for s in shown for start, end in [time_window(s.run)]
    ]
    return min(start for start, _ in windows), max(end for _, end in windows)


def time_label(shown: Sequence[Shown]) -> str:
    """Return from when time counts, in words."""
    if any(one.origin for one in shown):
        return "time since the first touch"
    words = {start_word(one.run.scene) for one in shown}
    return f"time since the {words.pop() if len(words) == 1 else 'start'}"


def split(values: np.ndarray, touching: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return values in contact and values out of it, (n, ...) each, NaN elsewhere.

    What lies between two samples belongs to the earlier of them.
    """
    before = np.concatenate([touching[:1], touching[:-1]])
    shape = (-1,) + (1,) * (values.ndim - 1)
    in_touch = np.where((touching | before).reshape(shape), values, np.nan)
    return in_touch, np.where((touching & before).reshape(shape), np.nan, values)


def has_ledger(run: ViewableRun) -> bool:
    """Return whether the run's energies are known; those of a measured run are not."""
    return bool(np.isfinite(run.samples["kinetic"]).any())


def energy_layers(
    run: ViewableRun,
) -> tuple[np.ndarray, np.ndarray, list[tuple[str, str, np.ndarray]]]:
    """Return what became of the energy put in.

    Returns
    -------
    t : ndarray (n,)
        s, of some of the samples.
    put_in : ndarray (n,)
        mJ.
    layers : list of (str, str, ndarray (n,))
        Name, colour and energy, mJ, of each that is large enough to be seen.
    """
    samples = run.samples[:: max(len(run.samples) // _POINTS, 1)]
    put_in = (samples["kinetic"][0] + samples["work_string"]) * 1e3
    layers = []
    for name, colour, fields in LAYERS:
        layer = np.sum([samples[field] for field in fields], axis=0) * 1e3
        if layer.max(initial=0.0) > _VISIBLE * put_in.max():
            layers.append((name, colour, layer))
    return samples["t"], put_in, layers
