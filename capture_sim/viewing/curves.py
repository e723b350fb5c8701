"""The quantities drawn over time, as data for plots and for rerun.

As in the paper, a line is solid while the tip touches the cone and dashed while it does not.  While
a latch holds the tip, the line is dotted and dashed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from capture_sim.dynamics.samples import Phase
from capture_sim.errors import CaptureSimError
from capture_sim.run.first_contact import first_touch
from capture_sim.run.run import Run
from capture_sim.scene.parts import Scene
from capture_sim.viewing import style
from capture_sim.viewing.shapes import CHASER, TARGET
from capture_sim.viewing.source import (
    distinct_names,
    in_contact,
    normal_force_with_peaks,
    start_word,
    time_window,
)

Runs = Run | Sequence[Run]
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
    ("friction of the slide", style.WINE, ("dissipated_slide",)),
    ("rolling", style.LIGHT, ("dissipated_rolling",)),
    ("latches", style.GREEN, ("dissipated_latch",)),
    ("stops", style.BLACK, ("dissipated_stop",)),
    ("landing of the mass", style.YELLOW, ("dissipated_landing",)),
)
#: What holds the tip; :data:`capture_sim.viewing.style.LINES` has the look of each.
HOLDS = ("free", "in contact", "latched")
_VISIBLE = 1e-3  # share of the whole below which a layer is left out
_POINTS = 600
_MARKERS = 6  # of a run on each of its curves
_ENVELOPE_POINTS = 400


class PlottedRun(NamedTuple):
    """A run as it is drawn: its name, colour, marker, and from when its time counts."""

    run: Run
    label: str
    colour: str
    origin: float  # s
    samples: np.ndarray  # (n,) of dtype SAMPLE: the drawn ones
    touching: np.ndarray  # (n,) bool, of these samples
    marker: str | None  # None where the colour is enough

    @property
    def holds(self) -> np.ndarray:
        """Constraint on the tip just after each sample, (n,), as numbers of :data:`HOLDS`."""
        latched = self.samples["phase"] == Phase.LATCHED
        return np.where(latched, HOLDS.index("latched"), self.touching.astype(int))

    @property
    def scene(self) -> Scene:
        """The scene as drawn."""
        return self.run.drawn_scene

    def curve(self, quantity: Quantity) -> tuple[np.ndarray, np.ndarray]:
        """Return times (n,), s since the release, and values (n,) of a quantity, in its unit."""
        t, values = quantity.curve(self.run)
        inside = (t >= self.samples["t"][0]) & (t <= self.samples["t"][-1])
        return t[inside], values[inside]

    @property
    def time(self) -> np.ndarray:
        """Times of the samples as drawn, (n,), s."""
        return np.asarray(self.samples["t"]) - self.origin


class LimitLine(NamedTuple):
    """A level that a quantity is to reach or not to pass: name, value in its unit, colour."""

    name: str
    value: float
    colour: str


class Quantity(NamedTuple):
    """A quantity over time."""

    title: str  # in words
    label: str  # of its axis
    unit: str  # of its axis
    factor: float  # from the SI unit to this unit
    #: Values in the SI unit of samples (n,): (n,), or (n, k) of several curves.
    si: Callable[[np.ndarray], np.ndarray]
    sign: str = ""  # what its sign means
    from_zero: bool = False  # the axis begins at zero
    #: Times (n,), s, and values (n,), SI, of a run, with the touches between its samples.  None if
    #: the samples are all: then the line shows contact and flight.
    located: Callable[[Run], tuple[np.ndarray, np.ndarray]] | None = None
    limits: Callable[[Scene], tuple[LimitLine, ...]] = lambda _: ()  # of a scene, in the unit

    @property
    def axis(self) -> str:
        """The axis' label with its unit."""
        return f"{self.label}{self.sign and f' ({self.sign})'}  [{self.unit}]"

    def of(self, samples: np.ndarray) -> np.ndarray:
        """Return its values in samples (n,), in its unit."""
        return np.asarray(self.si(samples) * self.factor)

    def curve(self, run: Run) -> tuple[np.ndarray, np.ndarray]:
        """Return times (n,), s, and values (n,), in its unit, of a run."""
        if self.located is None:
            return run.samples["t"], self.of(run.samples)
        t, values = self.located(run)
        return t, values * self.factor


def _depth(samples: np.ndarray) -> np.ndarray:
    """Return how deep the tip is in a wall that it touches, (n,), m."""
    # of the walls that are touched: latches hold the tip in their place
    touched = (samples["walls"][:, None] & np.array([1, 2])) != 0
    return np.asarray(np.where(touched, samples["penetration"], 0.0).max(axis=1))


def _depth_with_ends(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Return times, s, and depth, m, (n,): zero at the located ends, or a touch looks longer."""
    touches = run.touches
    t = np.concatenate([run.samples["t"], touches["start"], touches["end"]])
    t, first = np.unique(t, return_index=True)
    return t, np.concatenate([_depth(run.samples), np.zeros(2 * len(touches))])[first]


def _rate(index: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda samples: np.asarray(samples["v"][:, index])


def _stops(scene: Scene) -> tuple[LimitLine, ...]:
    stops = {
        "stop, inwards": None if scene.stops is None else -scene.stops.compression,
        "stop, outwards": scene.outward_stroke,
    }
    return tuple(
        LimitLine(name, stroke * 1e3, style.GREY)
        for name, stroke in stops.items()
        if stroke is not None
    )


def _zone(scene: Scene) -> tuple[LimitLine, ...]:
    return (LimitLine("capture zone", scene.detector.capture_radius * 1e3, style.ZONE),)


FORCE = Quantity(
    "Contact force with every touch",
    "normal contact force",
    "N",
    1.0,
    lambda samples: samples["normal_force"].sum(axis=1),
    from_zero=True,
    located=normal_force_with_peaks,
)
PENETRATION = Quantity(
    "Penetration of the tip into the wall",
    "penetration",
    "µm",
    1e6,
    _depth,
    from_zero=True,
    located=_depth_with_ends,
)
STROKE = Quantity(
    "Axial buffer",
    "axial stroke",
    "mm",
    1e3,
    itemgetter("axial_stroke"),
    "compression < 0",
    limits=_stops,
)
TORSION = Quantity("Torsional buffer", "torsion", "mrad", 1e3, itemgetter("torsion"), "ccw > 0")
DISTANCE = Quantity(
    "Distance of the tip to BE",
    "tip to the centre of BE",
    "mm",
    1e3,
    itemgetter("tip_distance"),
    from_zero=True,
    limits=_zone,
)

#: By name of their figure's file.
PANELS = {
    "impact_force": FORCE,
    "intrusion": PENETRATION,
    "axial_performance": STROKE,
    "torsional_performance": TORSION,
    "distance": DISTANCE,
}

#: Rates of x, y and theta: a row each; of chaser and target: a column each.
VELOCITIES = tuple(
    tuple(
        Quantity(vehicle, label, unit, 1e3, _rate(first + row))
        for vehicle, first in (("chaser", CHASER[0]), ("target", TARGET[0]))
    )
    for row, (label, unit) in enumerate(
        (("velocity x", "mm/s"), ("velocity y", "mm/s"), ("angular velocity", "mrad/s"))
    )
)


def plotted_runs(
    runs: Runs,
    labels: Sequence[str] | None = None,
    *,
    aligned: bool = False,
    window: Window | None = None,
) -> list[PlottedRun]:
    """Return one run or several with their labels, colours, markers and origins of time.

    Without labels, runs have their scenes' names.  ``aligned`` counts each run's time from its
    first touch; ``window`` is the drawn time, s since the release.  ValueError: there is no run, or
    not one label for each.  CaptureSimError: a run has no sample in the window.
    """
    several = list(runs) if isinstance(runs, Sequence) else [runs]
    if not several:
        raise ValueError("no run to draw")
    names = distinct_names([run.drawn_scene.name for run in several]) if labels is None else labels
    if len(names) != len(several):
        raise ValueError(f"{len(names)} labels for {len(several)} runs")
    shown = []
    for i, (run, name) in enumerate(zip(several, names, strict=True)):
        touch = first_touch(run.events)
        origin = touch.t if aligned and touch is not None else 0.0
        marker = style.run_marker(i) if len(several) > style.COLOURS_ALONE else None
        inside = _inside(run, window)
        touching = in_contact(run)[inside]
        samples = run.samples[inside]
        label = name.lstrip("_") or name  # Matplotlib leaves labels with "_" out of legends
        shown.append(PlottedRun(run, label, style.run_colour(i), origin, samples, touching, marker))
    return shown


def _inside(run: Run, window: Window | None) -> slice:
    """Return the samples of a run that lie in a window, s since the release."""
    if window is None:
        return slice(None)
    t = run.samples["t"]
    first, last = np.searchsorted(t, window[0], "left"), np.searchsorted(t, window[1], "right")
    if first == last:
        raise CaptureSimError(
            f"{run.name}: no sample from {window[0]:g} to {window[1]:g} s; it has samples from "
            f"{t[0]:g} to {t[-1]:g} s"
        )
    return slice(int(first), int(last))


def are_many(shown: Sequence[PlottedRun]) -> bool:
    """Return True if runs are more than there are colours: they are drawn as an envelope."""
    return len(shown) > len(style.RUNS)


class Envelope(NamedTuple):
    """A quantity of many runs over time, in its unit; columns of ``bounds`` are runs together."""

    t: np.ndarray  # (n,), s, as drawn
    bounds: np.ndarray  # (n, 5): least, first quartile, median, third quartile, greatest


def envelope(quantity: Quantity, shown: Sequence[PlottedRun], window: Window) -> Envelope:
    """Return the range of a quantity over runs; a run counts while it has samples.

    Of a quantity with located touches, each point has the greatest value around it: a touch is
    shorter than the distance of two points.
    """
    t = np.linspace(*window, _ENVELOPE_POINTS)
    step = t[1] - t[0]
    curves = np.empty((len(shown), len(t)))
    for curve, plotted in zip(curves, shown, strict=True):
        times, values = plotted.curve(quantity)
        times = times - plotted.origin
        curve[:] = np.interp(t, times, values, left=np.nan, right=np.nan)
        if quantity.located is not None:
            inside = (times >= t[0]) & (times <= t[-1])
            nearest = np.rint((times[inside] - t[0]) / step).astype(int)
            np.fmax.at(curve, nearest, values[inside])
    known = np.isfinite(curves).any(axis=0)
    shares = (0.0, 0.25, 0.5, 0.75, 1.0)
    return Envelope(t[known], np.nanquantile(curves[:, known], shares, axis=0).T)


def marked_points(length: np.ndarray, number: int, count: int) -> np.ndarray:
    """Return which points of a curve bear the marker of run ``number`` of ``count``, indices (k,).

    ``length`` is the time or length of the curve up to each point, (n,), ascending.  On curves
    that coincide, the markers of different runs do not.
    """
    if length.size < 2:
        return np.zeros(0, int)
    shares = (np.arange(_MARKERS) + (number + 0.5) / count) / _MARKERS
    at = length[0] + shares * (length[-1] - length[0])
    return np.unique(np.searchsorted(length, at))


def highest_touches(t: np.ndarray, values: np.ndarray, plotted: PlottedRun) -> np.ndarray:
    """Return where a run's highest touches have their maximum in a curve, indices (k,).

    ``t`` (n,), s, is as drawn and ascending; the values (n,) have every touch in them.
    """
    touches = plotted.run.touches
    first, last = (np.searchsorted(t, touches[end] - plotted.origin) for end in ("start", "end"))
    pieces = zip(first.tolist(), last.tolist(), strict=True)
    peaks = np.array([a + int(values[a : b + 1].argmax()) for a, b in pieces if a < b], int)
    return np.asarray(peaks[np.argsort(-values[peaks], kind="stable")[:_MARKERS]])


def path_length(path: np.ndarray) -> np.ndarray:
    """Return the length of a path up to each of its points, (n,), from points (n, 2)."""
    return np.concatenate([[0.0], np.hypot(*np.diff(path, axis=0).T).cumsum()])


def common_window(shown: Iterable[PlottedRun], window: Window | None = None) -> Window:
    """Return the time to draw, s on the axis: as asked, or from before contact to verdict."""
    if window is not None:
        return window
    windows = [
        (start - s.origin, end - s.origin) for s in shown for start, end in [time_window(s.run)]
    ]
    return min(start for start, _ in windows), max(end for _, end in windows)


def time_label(shown: Sequence[PlottedRun]) -> str:
    """Return from when time counts, in words."""
    if any(plotted.origin for plotted in shown):
        return "time since the first touch"
    words = {start_word(plotted.scene) for plotted in shown}
    return f"time since the {words.pop() if len(words) == 1 else 'start'}"


def held_by(shown: Iterable[PlottedRun]) -> list[str]:
    """Return which of :data:`HOLDS` occur in runs."""
    numbers = {int(number) for plotted in shown for number in np.unique(plotted.holds)}
    return [name for number, name in enumerate(HOLDS) if number in numbers]


def split(values: np.ndarray, holds: np.ndarray) -> dict[str, np.ndarray]:
    """Return the values that belong to each of :data:`HOLDS` that occurs, (n, ...), NaN elsewhere.

    The interval between two samples belongs to the earlier sample.
    """
    before = np.concatenate([holds[:1], holds[:-1]])
    shape = (-1,) + (1,) * (values.ndim - 1)
    return {
        name: np.where(((holds == number) | (before == number)).reshape(shape), values, np.nan)
        for number, name in enumerate(HOLDS)
        if np.any(holds == number)
    }


def has_ledger(run: Run) -> bool:
    """Return True if the run's energies are known; a measured run has none."""
    return run.is_exact


def energy_layers(
    samples: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, list[tuple[str, str, np.ndarray]]]:
    """Return where the energy that was put in is, from samples (n,) of the state.

    These are times (n,), s, of some of the samples, the energy put in (n,), mJ, and name, colour
    and energy (n,), mJ, of each layer that is large enough to be seen.
    """
    samples = samples[:: max(len(samples) // _POINTS, 1)]
    values = [np.sum([samples[field] for field in fields], axis=0) * 1e3 for *_, fields in LAYERS]
    work = (samples["work_string"] + samples["work_thrust"]) * 1e3
    # the samples may begin within the run: what the first one has was put in before
    put_in = sum(layer[0] for layer in values) + work - work[0]
    layers = []
    for (name, colour, _), layer in zip(LAYERS, values, strict=True):
        if layer.max(initial=0.0) > _VISIBLE * put_in.max():
            layers.append((name, colour, layer))
    return samples["t"], put_in, layers
