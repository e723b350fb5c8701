"""Comparison of two runs: choice of their series, key numbers, and differences over time.

For each quantity, the series with the highest rate that both runs have are compared.  A simulated
run has all quantities at the rate of ``bench/state``, but the bag of a bench only has the rates of
its sensors.  Peaks of series at 1 kHz and at 100 Hz would differ because of the sampling alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from capture_sim.detection.criteria import CaptureStatus
from capture_sim.errors import CaptureSimError, RecordingError
from capture_sim.run.first_contact import first_cluster
from capture_sim.run.loads import LOADS
from capture_sim.run.run import EVENTS, Run
from capture_sim.run.series import PARTS, Series, SeriesPart
from capture_sim.run.touches import TICK, Touches
from capture_sim.studies.compare.frame import Frame

#: Topic of the detector's statuses.
CAPTURE_STATUS = "capture/status"
#: Name of the tip's distance to BE.
DISTANCE = "distance"
#: Quantities that are compared.
COMPARED = (*PARTS, "force", DISTANCE)
#: Name of the largest sample of the force; the peak of a touch between two samples may exceed it.
SAMPLED_FORCE = "largest sampled force, N"


class RunFigure(NamedTuple):
    """One number of a run, with the topic and the rate that it comes from."""

    value: float
    source: str


@dataclass(frozen=True)
class Side:
    """One of two compared runs, with its series and touches."""

    run: Run
    contact: float  # first contact, s since the release
    contact_source: str  # topic in which it was found
    series: Mapping[str, Series]  # by quantity, of COMPARED
    sources: Mapping[str, str]  # topic and rate by quantity
    touches: Touches | None  # resolved touches; None if there are none
    touch_source: str  # topic and rate, or why there are none
    # loads of the integration if both runs have them, else empty
    loads: Mapping[str, float | None] = field(default_factory=dict)
    turned: float = 0.0  # rad, by which the poses were turned into the frame of the other run

    @property
    def contact_may_be_late(self) -> bool:
        """True if an earlier touch may lie between the samples of the force.

        The first contact is then found in a sampled force, without resolved touches.
        """
        return self.touches is None and self.contact_source.endswith("wrench")

    @property
    def measured(self) -> dict[str, Series]:
        """The series of poses, stroke and torsion."""
        return {name: self.series[name] for name in PARTS if name in self.series}


def sides(a: Run, b: Run) -> tuple[Side, Side]:
    """Choose the series by which two runs are compared.

    For each quantity, one series of each run is chosen: the pair whose slower series has the
    highest rate.  Among pairs with equal rates, a pair of the same topic is preferred, then motion
    capture to odometry.  The rates of forces and distances are not compared.  RecordingError if a
    run contains no contact to align it by.
    """
    sources_a, sources_b = _sources(a), _sources(b)
    chosen_a: dict[str, str] = {}
    chosen_b: dict[str, str] = {}
    for name in dict.fromkeys([*sources_a, *sources_b]):
        if name in sources_a and name in sources_b:
            chosen_a[name], chosen_b[name] = _finest(name, sources_a[name], sources_b[name])
        elif name in sources_a:
            chosen_a[name] = next(iter(sources_a[name]))
        else:
            chosen_b[name] = next(iter(sources_b[name]))
    side_a, side_b = _side(a, sources_a, chosen_a), _side(b, sources_b, chosen_b)
    side_b = _in_frame_of(side_a, side_b)
    if a.given.extremes is not None and b.given.extremes is not None:
        side_a, side_b = replace(side_a, loads=a.loads), replace(side_b, loads=b.loads)
    return _without_unresolved_touches(side_a, side_b), _without_unresolved_touches(side_b, side_a)


def characteristics(side: Side, *, sampled: bool = False) -> dict[str, RunFigure]:
    """Return key numbers of a run by name with the unit; values not measured are absent.

    Forces and times are taken from the touches that were located between samples, if these are
    recorded.  ``sampled`` adds the largest sample of the force, for the comparison with a run that
    has only a sampled force.
    """
    figures = {"first contact, s": RunFigure(side.contact, side.contact_source)}
    touches = side.run.given.touches
    if touches.size:
        first = first_cluster(touches)
        for name, value in (
            ("first contact lasts, ms", (first["end"].max() - first["start"].min()) * 1e3),
            ("peak force of first contact, N", first["peak_force"].max()),
            ("peak normal force, N", touches["peak_force"].max()),
            ("touches", touches.size),
            ("normal impulse, N s", touches["impulse"].sum()),
        ):
            figures[name] = RunFigure(float(value), EVENTS)
    else:
        for source, peak_force in side.run.series.get("peak_force", {}).items():
            figures["peak normal force, N"] = RunFigure(float(peak_force.values.max()), source)
    if sampled and "force" in side.series:
        largest = float(side.series["force"].values.max())
        figures[SAMPLED_FORCE] = RunFigure(largest, side.sources["force"])
    measured = {
        "max_axial_stroke_in": ("stroke", lambda x: -x.min()),
        "max_axial_stroke_out": ("stroke", lambda x: x.max()),
        "max_torsion": ("torsion", lambda x: np.abs(x).max()),
    }
    for load in LOADS:
        quantity, value_in = measured.get(load.key, ("", None))
        name = f"{load.meaning}, {load.shown_in}"
        for key, when in ((load.key, ""), (f"{load.key}_before_latch", ", until the latch")):
            if value := side.loads.get(key):
                figures[name + when] = RunFigure(value * load.factor, "integration")
        if not side.loads and value_in is not None and quantity in side.series:
            value = float(value_in(side.series[quantity].values))
            figures[name] = RunFigure(value * load.factor, side.sources[quantity])
        if not side.loads and load.key == "nearest_distance" and (closest := _closest(side)):
            figures[name] = closest._replace(value=closest.value * load.factor)
    return figures


def _closest(side: Side) -> RunFigure | None:
    """Return the closest approach, m: from exact samples, else the estimate of the detector.

    None if it is not known, or if the noise is too large for an estimate.
    """
    run, source = side.run, side.sources.get(DISTANCE, "")
    if source and CAPTURE_STATUS not in source:
        return RunFigure(float(side.series[DISTANCE].values.min()), source)
    statuses: Sequence[CaptureStatus] = ()
    with suppress(CaptureSimError):  # a bag without buffer or scene
        statuses = run.statuses
    if not statuses or not math.isfinite(statuses[-1].nearest_distance):
        return None
    distance, deviation = statuses[-1].nearest_distance, statuses[-1].nearest_deviation
    if math.isinf(deviation):
        return None
    error = f", +- {deviation * 1e3:.2f} mm" if deviation else ""
    return RunFigure(distance, f"{CAPTURE_STATUS if run.given.statuses else 'poses'}{error}")


def _sources(run: Run) -> dict[str, dict[str, Series]]:
    """Return the series of each quantity by topic; quantities not measured are absent."""
    sources = {
        name: {source: series for source, series in by_source.items() if series.t.size}
        for name, by_source in run.series.items()
        if name in COMPARED
    }
    return {name: by_source for name, by_source in sources.items() if by_source}


def _finest(
    name: str, series_a: Mapping[str, Series], series_b: Mapping[str, Series]
) -> tuple[str, str]:
    """Return the topics of both runs by which a quantity is compared.

    ``series_a`` and ``series_b`` are the series of the quantity by topic.
    """

    def rank(pair: tuple[str, str]) -> tuple[float, bool, int]:
        a, b = pair
        slower = min(series_a[a].rate, series_b[b].rate)
        places = list(series_a).index(a) + list(series_b).index(b)
        # forces and distances of two topics differ in filtering or estimation: ignore their rate
        rate = float(f"{slower:.2g}") if name not in ("force", DISTANCE) else 0.0
        return rate, a == b, -places

    return max(((a, b) for a in series_a for b in series_b), key=rank)


def _side(run: Run, sources: Mapping[str, Mapping[str, Series]], chosen: Mapping[str, str]) -> Side:
    if run.first_contact is None:
        raise RecordingError(f"{run.origin.path or run.name}: contains no contact to align it by")
    series = {name: sources[name][source] for name, source in chosen.items()}
    touches, source = run.resolved_touches
    contact = run.first_contact.t
    return Side(
        run=run,
        # a message counts the touches since the previous message
        contact=contact if touches is None else min(contact, float(touches.start[0])),
        contact_source=run.first_contact.source,
        series=series,
        sources={name: f"{chosen[name]}, {series[name].rate:.4g} Hz" for name in series},
        touches=touches,
        touch_source=source,
    )


#: Two frames are different if both vehicles' headings at the contact differ by more than the first
#: angle, and by the same within the second one, rad.
_TURNED, _ALIKE = 0.05, 0.03


def _in_frame_of(a: Side, b: Side) -> Side:
    """Return ``b`` with its poses turned into the frame of ``a``, if the cameras' frames differ."""
    turns = []
    for vehicle in ("chaser", "target"):
        if vehicle not in a.series or vehicle not in b.series:
            return b
        one, two = (
            float(
                np.interp(side.contact, side.series[vehicle].t, side.series[vehicle].values[:, 2])
            )
            for side in (a, b)
        )
        turns.append(math.remainder(one - two, math.tau))
    if min(map(abs, turns)) < _TURNED or abs(turns[0] - turns[1]) > _ALIKE:
        return b
    frame = Frame(0.5 * sum(turns))
    series = {
        name: each._replace(values=frame.applied(each.values))
        if name in ("chaser", "target")
        else each
        for name, each in b.series.items()
    }
    return replace(b, series=series, turned=frame.angle)


def _without_unresolved_touches(side: Side, other: Side) -> Side:
    """Return a side without its touches if its force is sampled too slowly.

    The force is too slow if it may miss touches as short as the shortest touch of the other side.
    """
    if side.touches is None or other.touches is None:
        return side
    shortest = float(np.nanmin(other.touches.lasted, initial=np.inf))
    if not side.touches.may_miss(shortest):
        return side
    source = side.touch_source.partition(", which")[0]
    reason = f"{source}: too slow for touches of {shortest * 1e3:.3g} ms as the other has"
    return replace(side, touches=None, touch_source=reason)


#: Cost of a touch without a partner.  A pair costs the logarithms of the ratios of its times, each
#: plus PAIR_TIME (s), with this weight, of its peaks and of its durations.
_ALONE, PAIR_TIME, _OF_TIME = 1.0, 0.005, 3.0
#: A pair is ambiguous if the whole pairing without it costs less than this more.
_AMBIGUOUS = 0.5


class TouchPair(NamedTuple):
    """Corresponding touches of two runs, by index; None if a touch has no partner."""

    a: int | None
    b: int | None
    is_ambiguous: bool = False  # True if another pairing is nearly as good


def pair_touches(a: Touches, b: Touches) -> list[TouchPair]:
    """Return the pairs of corresponding touches of two runs, in the order of time in both.

    The pairing is the alignment of two sequences with the least cost (Needleman and Wunsch, 1970).
    Touches of a pair are at the same wall, or at an unknown one; the nearer their times, peaks and
    durations are, by their ratios, the less they cost.  Times must be relative to the first contact
    of each run.
    """
    n, m = a.start.size, b.start.size
    cost = _pair_costs(a, b)
    first, last = np.zeros((n + 1, m + 1)), np.zeros((n + 1, m + 1))  # before, and from i and k on
    first[:, 0], first[0] = _ALONE * np.arange(n + 1), _ALONE * np.arange(m + 1)
    last[:, m], last[n] = first[::-1, 0], first[0, ::-1]
    for i in range(n):
        for k in range(m):
            alone = min(first[i, k + 1], first[i + 1, k]) + _ALONE
            first[i + 1, k + 1] = min(alone, first[i, k] + cost[i, k])
            i_r, k_r = n - 1 - i, m - 1 - k
            alone = min(last[i_r + 1, k_r], last[i_r, k_r + 1]) + _ALONE
            last[i_r, k_r] = min(alone, last[i_r + 1, k_r + 1] + cost[i_r, k_r])
    paired = first[:-1, :-1] + cost + last[1:, 1:]  # of the best pairing with each pair
    without = (first[:-1] + last[1:]).min(axis=1, initial=np.inf) + _ALONE  # ... with i alone
    pairs, i, k = [], 0, 0
    while i < n or k < m:
        if i < n and k < m and np.isclose(last[i, k], cost[i, k] + last[i + 1, k + 1]):
            others = np.delete(paired[i], k)
            rest = min(float(without[i]), float(others.min(initial=np.inf))) - paired[i, k]
            pairs.append(TouchPair(i, k, bool(rest < _AMBIGUOUS)))
            i, k = i + 1, k + 1
        elif k == m or (i < n and np.isclose(last[i, k], _ALONE + last[i + 1, k])):
            pairs.append(TouchPair(i, None))
            i += 1
        else:
            pairs.append(TouchPair(None, k))
            k += 1
    return pairs


def _pair_costs(a: Touches, b: Touches) -> np.ndarray:
    """Return the cost of each pair of touches, (n, m); infinite at different walls."""

    def ratios(of_a: np.ndarray, of_b: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.abs(np.log(of_a[:, None] / of_b[None, :]))
        return np.nan_to_num(logs, nan=0.0, posinf=0.0)  # what was not measured costs nothing

    times = (np.maximum(each.start, 0.0) + PAIR_TIME for each in (a, b))
    cost = _OF_TIME * ratios(*times) + ratios(a.peak, b.peak) + ratios(a.lasted, b.lasted)
    return np.where(a.wall[:, None] * b.wall[None, :] < 0.0, np.inf, cost)


#: Least number of common samples for a comparison of two series.
MIN_SAMPLES = 4


class Gap(NamedTuple):
    """Difference of a measured quantity between two runs, second run minus first."""

    series: str  # name of the quantity
    part: SeriesPart  # part of the quantity
    rms: float  # SI units
    largest: float  # SI units
    at: float  # time of the largest difference, s after the first contact
    begin: float  # time of the first compared sample, s after the first contact
    end: float  # time of the last compared sample, s after the first contact


def overlap(
    a: Series, b: Series, contact_a: float, contact_b: float, window: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the times at which two series are compared, (n,), and the numbers of samples, (2,).

    Times are in s after the first contact of each run.  The numbers are the samples of each series
    in the interval that both series cover.  The times are the sample times of the series with fewer
    samples there; the other series is then interpolated.
    """
    mine, theirs = a.t - contact_a, b.t - contact_b
    begin = max(0.0, mine[0], theirs[0]) - TICK
    end = min(window, mine[-1], theirs[-1]) + TICK
    inside = [t[(t >= begin) & (t <= end)] for t in (mine, theirs)]
    counts = np.array([len(t) for t in inside])
    return inside[int(np.argmin(counts))], counts


def gaps(
    a: Mapping[str, Series],
    b: Mapping[str, Series],
    contact_a: float,
    contact_b: float,
    window: float,
) -> list[Gap]:
    """Return the differences of two runs after their first contacts, ``b`` minus ``a``.

    Poses are relative to the pose at the first contact.  Reason: two benches need not have the same
    origin, and the motion before the contact depends on the launch.  The force, and series with
    fewer than MIN_SAMPLES common samples, are left out.  ``contact_a`` and ``contact_b`` are the
    times of the first contacts, s; ``window`` is the compared time after the first contact, s.
    """
    found = []
    for name, parts in PARTS.items():
        if name not in a or name not in b:
            continue
        one, two = a[name], b[name]
        t, _ = overlap(one, two, contact_a, contact_b, window)
        if t.size < MIN_SAMPLES:
            continue
        for k, part in enumerate(parts):
            difference, offset = np.zeros(t.size), 0.0
            for sign, series, contact in ((-1.0, one, contact_a), (1.0, two, contact_b)):
                values = series.values if len(parts) == 1 else series.values[:, k]
                difference += sign * np.interp(t, series.t - contact, values)
                offset += sign * float(np.interp(0.0, series.t - contact, values))
            if len(parts) > 1:
                difference -= offset
            worst = int(np.argmax(np.abs(difference)))
            rms = float(np.sqrt(np.mean(difference**2)))
            extreme = float(difference[worst]), float(t[worst])
            found.append(Gap(name, part, rms, *extreme, float(t[0]), float(t[-1])))
    return found
