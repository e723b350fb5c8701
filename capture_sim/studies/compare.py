"""Two runs compared: which of their series, in numbers, and in time after their first contacts.

Of each quantity the finest series that both runs have is compared.  A simulated run has all
quantities at the rate of ``bench/state``, a bench's bag only at that of its sensors: peaks found at
1 kHz and at 100 Hz would differ by the sampling alone.
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

#: Topic of the detector's statuses.
CAPTURE_STATUS = "capture/status"
#: Name of the tip's distance to BE.
DISTANCE = "distance"
#: Quantities that are compared.
COMPARED = (*PARTS, "force", DISTANCE)
#: Name of the largest force of a sampled series; a touch between two samples may exceed it.
SAMPLED_FORCE = "largest sampled force, N"


class RunFigure(NamedTuple):
    """One number of a run, and its topic and rate."""

    value: float
    source: str


@dataclass(frozen=True)
class Side:
    """One of two compared runs, with its series and touches."""

    run: Run
    contact: float  # first contact, s since the release
    contact_source: str  # topic that shows it
    series: Mapping[str, Series]  # by quantity, of COMPARED
    sources: Mapping[str, str]  # topic and rate of each
    touches: Touches | None  # one by one; None if there are none
    touch_source: str  # topic and rate, or why there are none
    # of the integration if both runs have it, else empty
    loads: Mapping[str, float | None] = field(default_factory=dict)

    @property
    def contact_may_be_late(self) -> bool:
        """True if an earlier touch may lie between the samples of the force that shows it."""
        return self.touches is None and self.contact_source.endswith("wrench")

    @property
    def measured(self) -> dict[str, Series]:
        """The series of poses, stroke and torsion."""
        return {name: self.series[name] for name in PARTS if name in self.series}


def sides(a: Run, b: Run) -> tuple[Side, Side]:
    """Choose the series by which two runs are compared.

    For each quantity one series of each run is chosen, so that the slower of the two is as fast as
    possible.  Among equal rates, two series of one topic come first, then motion capture before
    odometry.  RecordingError if a run contains no contact for the alignment.
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
    if a.given.extremes is not None and b.given.extremes is not None:
        side_a, side_b = replace(side_a, loads=a.loads), replace(side_b, loads=b.loads)
    return _without_unresolved_touches(side_a, side_b), _without_unresolved_touches(side_b, side_a)


def characteristics(side: Side, *, sampled: bool = False) -> dict[str, RunFigure]:
    """Return a run's characteristic numbers by name with the unit; unmeasured numbers are absent.

    Forces and times are taken from the touches located between samples, if these are recorded.
    ``sampled`` adds the largest sample of the force, for a comparison with a run that has only
    samples.
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
    """Return the closest approach, m: of exact samples, else as the detector estimates it.

    None if it is not known, or if noise hides it.
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
    """Return every series of each quantity by its topic; unmeasured quantities are absent."""
    sources = {
        name: {source: series for source, series in by_source.items() if series.t.size}
        for name, by_source in run.series.items()
        if name in COMPARED
    }
    return {name: by_source for name, by_source in sources.items() if by_source}


def _finest(
    name: str, series_a: Mapping[str, Series], series_b: Mapping[str, Series]
) -> tuple[str, str]:
    """Return the topics that a quantity is compared by, of its series by topic."""

    def rank(pair: tuple[str, str]) -> tuple[float, bool, int]:
        a, b = pair
        slower = min(series_a[a].rate, series_b[b].rate)
        places = list(series_a).index(a) + list(series_b).index(b)
        # two topics do not mean quite the same there: filtered, or estimated
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
        # a message counts what was since the one before
        contact=contact if touches is None else min(contact, float(touches.start[0])),
        contact_source=run.first_contact.source,
        series=series,
        sources={name: f"{chosen[name]}, {series[name].rate:.4g} Hz" for name in series},
        touches=touches,
        touch_source=source,
    )


def _without_unresolved_touches(side: Side, other: Side) -> Side:
    """Return a run without its touches if the force they are from misses such as the other has."""
    if side.touches is None or other.touches is None:
        return side
    shortest = float(np.nanmin(other.touches.lasted, initial=np.inf))
    if not side.touches.may_miss(shortest):
        return side
    source = side.touch_source.partition(", which")[0]
    reason = f"{source}: too slow for touches of {shortest * 1e3:.3g} ms as the other has"
    return replace(side, touches=None, touch_source=reason)


#: Touches of two runs are a pair if their times after the first contact differ by less than this
#: time, s, and this share of the time.
PAIR_TIME, PAIR_SHARE = 0.005, 0.1


def pair_touches(a: Touches, b: Touches) -> list[tuple[int | None, int | None]]:
    """Return the corresponding touches of two runs, by index; None for a touch without a partner.

    The touches of a pair are at the same wall and near each other in time, and pairs keep their
    order.  The chosen pairing has the least sum of time differences; a touch without a partner
    counts half of the largest permitted difference.  Times must count from the first contacts.  An
    unknown wall matches every wall.
    """
    count_a, count_b = a.start.size, b.start.size
    limits = [PAIR_TIME + PAIR_SHARE * abs(t) for t in (*a.start.tolist(), *b.start.tolist())]
    alone_a, alone_b = 0.5 * np.array(limits[:count_a]), 0.5 * np.array(limits[count_a:])
    cost = np.zeros((count_a + 1, count_b + 1))  # of the touches after i and k
    cost[:count_a, -1] = np.cumsum(alone_a[::-1])[::-1]
    cost[-1, :count_b] = np.cumsum(alone_b[::-1])[::-1]
    for i in reversed(range(count_a)):
        for k in reversed(range(count_b)):
            cost[i, k] = min(alone_a[i] + cost[i + 1, k], alone_b[k] + cost[i, k + 1])
            if _may_pair(a, b, i, k):
                cost[i, k] = min(cost[i, k], abs(a.start[i] - b.start[k]) + cost[i + 1, k + 1])
    pairs: list[tuple[int | None, int | None]] = []
    i = k = 0
    while i < count_a or k < count_b:
        if i < count_a and (k == count_b or cost[i, k] == alone_a[i] + cost[i + 1, k]):
            pairs.append((i, None))
            i += 1
        elif i == count_a or cost[i, k] == alone_b[k] + cost[i, k + 1]:
            pairs.append((None, k))
            k += 1
        else:
            pairs.append((i, k))
            i, k = i + 1, k + 1
    return pairs


def _may_pair(a: Touches, b: Touches, i: int, k: int) -> bool:
    walls = {int(a.wall[i]), int(b.wall[k])} - {0}
    t_a, t_b = float(a.start[i]), float(b.start[k])
    limit = PAIR_TIME + PAIR_SHARE * max(abs(t_a), abs(t_b))
    return len(walls) < 2 and abs(t_a - t_b) < limit


#: Samples that two series must have in common to be compared.
LEAST = 4


class Gap(NamedTuple):
    """By how much a measured number of two runs differs, second run less first."""

    series: str  # its quantity
    part: SeriesPart  # of it
    rms: float  # SI units
    largest: float  # SI units
    at: float  # when it is largest, s after the first contact
    begin: float  # first sample that was compared, s after the first contact
    end: float  # last one


def overlap(
    a: Series, b: Series, contact_a: float, contact_b: float, window: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return common sample times (n,), s after the first contacts, and the counts of samples (2,).

    Each count is the number of samples of one series in the common interval.  The times are those
    of the series with fewer samples; the finer series is interpolated.
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
    """Return by how much two runs differ after their first contacts, ``b`` less ``a``.

    Poses count from where they were at the first contact: two benches need not share an
    origin, and the approach is a matter of the launch.  What has fewer than LEAST samples in
    common is left out, and so is the force.  Times are in s, the window after the first contact.
    """
    found = []
    for name, parts in PARTS.items():
        if name not in a or name not in b:
            continue
        one, two = a[name], b[name]
        t, _ = overlap(one, two, contact_a, contact_b, window)
        if t.size < LEAST:
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
