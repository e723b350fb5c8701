"""The quantities drawn over time, as data for plots and for rerun.

In plots, the line of a run is solid while the tip touches the cone, dashed while it does not, and
dash-dotted while the latch holds the tip.  Contact force and penetration always have solid lines,
because their values already show when the tip touches.  More than ten runs together always have
solid lines too.  Summary plots of single runs shade the times of contact; there, lines over time
are solid in flight, too.
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

#: Layers of the plot of energies, from below: name, colour, fields of a sample that it adds up.
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
#: What holds the tip, by name; :data:`capture_sim.viewing.style.LINES` has the line style of each.
HOLDS = ("free", "in contact", "latched")
_VISIBLE = 1e-3  # share of the whole below which a layer is left out
_POINTS = 600
_MARKERS = 6  # of a run on each of its curves
_ENVELOPE_POINTS = 400


class PlottedRun(NamedTuple):
    """A run as it is drawn: its name, colour and marker, its drawn samples, and its time zero."""

    run: Run
    label: str
    colour: str
    origin: float  # s since the release: the time that is zero on the time axis
    samples: np.ndarray  # (n,) of dtype SAMPLE: the drawn ones
    touching: np.ndarray  # (n,) bool: contact at a drawn sample or before the next one
    marker: str | None  # None where the colour is enough

    @property
    def holds(self) -> np.ndarray:
        """What holds the tip from each drawn sample to the next, (n,), as indices of :data:`HOLDS`.

        A sample in the phase latched counts as latched, whether or not it counts as contact too.
        """
        latched = self.samples["phase"] == Phase.LATCHED
        return np.where(latched, HOLDS.index("latched"), self.touching.astype(int))

    @property
    def scene(self) -> Scene:
        """The scene that is drawn: the run's, or for a measured run at its first measured poses."""
        return self.run.drawn_scene

    def curve(self, quantity: Quantity) -> tuple[np.ndarray, np.ndarray]:
        """Return times (n,), s since the release, and values of a quantity, in the quantity's unit.

        Values are (n,), or (n, k) of a quantity of k curves.  They reach from the first to the last
        drawn sample.  The origin is not subtracted from the times.
        """
        t, values = quantity.curve(self.run)
        inside = (t >= self.samples["t"][0]) & (t <= self.samples["t"][-1])
        return t[inside], values[inside]

    @property
    def time(self) -> np.ndarray:
        """Times of the drawn samples on the time axis, (n,), s since ``origin``."""
        return np.asarray(self.samples["t"]) - self.origin


class LimitLine(NamedTuple):
    """A level that a quantity should reach, or should not pass.

    It has a name, a value in the unit of the quantity, and a colour.
    """

    name: str
    value: float
    colour: str


class Quantity(NamedTuple):
    """A quantity that is drawn over time: how it is computed from samples, named and scaled."""

    title: str  # in words
    label: str  # of its axis
    unit: str  # of its axis
    factor: float  # from the SI unit to this unit
    #: Values in the SI unit of samples (n,): (n,), or (n, k) of several curves.
    si: Callable[[np.ndarray], np.ndarray]
    sign: str = ""  # what its sign means
    from_zero: bool = False  # the axis begins at zero
    #: Function that returns times (n,), s since the release, and values (n,), SI, of a run, at its
    #: samples and at points of the touches between them.  Such a quantity is drawn as a solid line.
    #: None: the quantity is drawn at the samples only, and the line's style shows what holds the
    #: tip (:data:`HOLDS`).
    located: Callable[[Run], tuple[np.ndarray, np.ndarray]] | None = None
    limits: Callable[[Scene], tuple[LimitLine, ...]] = lambda _: ()  # of a scene, in the unit

    @property
    def axis(self) -> str:
        """The axis' label, with the meaning of the sign if there is one, and the unit."""
        return f"{self.label}{self.sign and f' ({self.sign})'}  [{self.unit}]"

    def of(self, samples: np.ndarray) -> np.ndarray:
        """Return the quantity's values, (n,) or (n, k), at samples (n,), in the quantity's unit."""
        return np.asarray(self.si(samples) * self.factor)

    def curve(self, run: Run) -> tuple[np.ndarray, np.ndarray]:
        """Return times (n,), s since the release, and values of a whole run.

        Values are (n,) or (n, k), in the quantity's unit.  The times are those of the samples; if
        ``located`` is set, they include points of the touches between the samples.
        """
        if self.located is None:
            return run.samples["t"], self.of(run.samples)
        t, values = self.located(run)
        return t, values * self.factor


def _depth(samples: np.ndarray) -> np.ndarray:
    """Return the tip's depth in the wall that it touches, (n,), m; 0 while it touches none.

    If it touches both walls, the result is the larger depth.
    """
    # of the walls that are touched: latches hold the tip in their place
    touched = (samples["walls"][:, None] & np.array([1, 2])) != 0
    return np.asarray(np.where(touched, samples["penetration"], 0.0).max(axis=1))


def _depth_with_ends(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Return times (n,), s since the release, and the tip's depth in a wall (n,), m, of a run.

    A depth of zero is inserted at the located start and end of each touch.  Without these points,
    lines to the samples before and after a touch would make it look longer.
    """
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

#: Quantities that have a figure of their own, by the name of the figure's file.
PANELS = {
    "impact_force": FORCE,
    "intrusion": PENETRATION,
    "axial_performance": STROKE,
    "torsional_performance": TORSION,
    "distance": DISTANCE,
}

#: Velocities: rows are x, y and angle; columns are chaser and target.
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
    """Return one run or several as they are drawn, each with its label, colour, marker and origin.

    Without labels, runs have the names of their scenes, with ``_1``, ``_2`` ... added where several
    scenes have the same name.  Leading underscores of a label are removed, because Matplotlib
    leaves labels with them out of legends.  ``aligned``: True counts the time of each run from its
    first touch, and the time of a run without a touch from the release.  ``window`` selects the
    drawn samples by their time, s since the release (also if ``aligned``); None draws all samples.

    ValueError: there is no run, or the number of labels is not the number of runs.
    CaptureSimError: a run has no sample in the window.
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
    """Return the slice of the run's samples that lie in a window, s since the release.

    None for the window selects all.  CaptureSimError: no sample lies in the window.
    """
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
    """Return True if there are more runs than colours.

    Such runs are all drawn in the same colour: quantities over time as an :class:`Envelope`, paths
    as thin lines.
    """
    return len(shown) > len(style.RUNS)


class Envelope(NamedTuple):
    """The range of a quantity over many runs, as it changes with time.

    ``bounds`` are taken at each time over the values that the runs have then, in the unit of the
    quantity.
    """

    t: np.ndarray  # (n,), s, on the time axis
    bounds: np.ndarray  # (n, 5): least, first quartile, median, third quartile, greatest


def envelope(quantity: Quantity, shown: Sequence[PlottedRun], window: Window) -> Envelope:
    """Return the range of a quantity over runs at evenly spread times in a window.

    ``window`` is in seconds on the time axis.  A run counts at the times from its first to its last
    drawn sample; times at which no run has a value are left out.  A touch may be shorter than the
    interval between two of the times.  So for a quantity with ``located``, the value of a run at
    one of the times is the greatest value that the run has from halfway since the time before to
    halfway to the time after.
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
    """Return the indices (k,) of the points of a curve at which its run's marker is drawn.

    ``length`` is the time or length of the curve up to each point, (n,), ascending.  ``number`` is
    the run's number, counted from 0, and ``count`` the number of runs.  The markers of each run are
    at other shares of the length, so that they remain visible where curves coincide.  A curve of
    fewer than two points has no markers.
    """
    if length.size < 2:
        return np.zeros(0, int)
    shares = (np.arange(_MARKERS) + (number + 0.5) / count) / _MARKERS
    at = length[0] + shares * (length[-1] - length[0])
    return np.unique(np.searchsorted(length, at))


def highest_touches(t: np.ndarray, values: np.ndarray, plotted: PlottedRun) -> np.ndarray:
    """Return the indices (k,) in a curve of the maxima of the run's highest touches.

    The curve has times ``t``, (n,), s on the time axis, ascending, and values (n,) of a quantity
    with ``located``, so that it has points in every touch.  There are at most six indices, of the
    highest touch first; a touch outside the times is left out.
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
    """Return the start and end of the drawn time, s on the time axis.

    These are those of ``window`` if it is given.  Otherwise they enclose the times that are drawn
    by default of all runs: from shortly before the first touch to shortly after the verdict.
    """
    if window is not None:
        return window
    windows = [
        (start - s.origin, end - s.origin) for s in shown for start, end in [time_window(s.run)]
    ]
    return min(start for start, _ in windows), max(end for _, end in windows)


def time_label(shown: Sequence[PlottedRun]) -> str:
    """Return the label of the time axis of runs, without the unit: from when time counts.

    If runs are aligned and at least one has a touch, it is ``time since the first touch``, although
    the time of a run without a touch counts from the release.  Otherwise it names the release, or
    the start unless all scenes have a string.
    """
    if any(plotted.origin for plotted in shown):
        return "time since the first touch"
    words = {start_word(plotted.scene) for plotted in shown}
    return f"time since the {words.pop() if len(words) == 1 else 'start'}"


def held_by(shown: Iterable[PlottedRun]) -> list[str]:
    """Return the names in :data:`HOLDS` that occur in the drawn samples of runs, in that order."""
    numbers = {int(number) for plotted in shown for number in np.unique(plotted.holds)}
    return [name for number, name in enumerate(HOLDS) if number in numbers]


def split(values: np.ndarray, holds: np.ndarray) -> dict[str, np.ndarray]:
    """Return a copy of values for each name of :data:`HOLDS` that occurs, NaN where it does not.

    The copies are the lines to draw, each in the line style of its name.  ``values`` (n, ...) are
    at samples, and ``holds`` (n,) are those of :attr:`PlottedRun.holds`.  The interval between two
    samples belongs to the name at the earlier sample.  So where the name changes, the later sample
    is in both copies, and the lines meet in it.
    """
    before = np.concatenate([holds[:1], holds[:-1]])
    shape = (-1,) + (1,) * (values.ndim - 1)
    return {
        name: np.where(((holds == number) | (before == number)).reshape(shape), values, np.nan)
        for number, name in enumerate(HOLDS)
        if np.any(holds == number)
    }


def has_ledger(run: Run) -> bool:
    """Return True if the run's energies are known, i.e. if it was simulated and not measured."""
    return run.is_exact


def energy_layers(
    samples: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, list[tuple[str, str, np.ndarray]]]:
    """Return the energy put into the bench since the start, and the layers that it is divided into.

    The energy put in is the sum of all layers at the first of the samples (n,), of dtype SAMPLE,
    and the work of string and thrusters since then.  Of 1200 samples or more, only every second,
    third, etc. is used.  The result has

    - the times of the samples, (m,), s since the release,
    - the energy put in until each time, (m,), mJ,
    - name, colour and energy (m,), mJ, of each layer in :data:`LAYERS`, from below.  A layer that
      never exceeds a thousandth of the largest energy put in is left out.
    """
    samples = samples[:: max(len(samples) // _POINTS, 1)]
    values = [np.sum([samples[field] for field in fields], axis=0) * 1e3 for *_, fields in LAYERS]
    work = (samples["work_string"] + samples["work_thrust"] + samples["work_floor"]) * 1e3
    # the samples may begin within the run: what the first one has was put in before
    put_in = sum(layer[0] for layer in values) + work - work[0]
    layers = []
    for (name, colour, _), layer in zip(LAYERS, values, strict=True):
        if layer.max(initial=0.0) > _VISIBLE * put_in.max():
            layers.append((name, colour, layer))
    return samples["t"], put_in, layers
