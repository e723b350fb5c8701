"""What two recordings are compared by: of each quantity the finest series that both hold.

A simulated run holds it all at ``bench/state``'s rate, a bench's bag only at that of its sensors:
a peak of one found at 1 kHz and of the other at 100 Hz would differ by their sampling alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from capture_sim.errors import RecordingError
from capture_sim.messages import topics
from capture_sim.recording.measured import first_contact, measured_sources, touches_of
from capture_sim.recording.read import Run
from capture_sim.results import LOADS, first_cluster, loads_of
from capture_sim.studies.measurements import Measurements, Series, measured_in
from capture_sim.studies.touches import Touches

#: Name of the tip's distance to BE, beside the fields of Measurements.
DISTANCE = "distance"
#: Name of the largest force that a sampled series holds, which a touch between two samples passes.
SAMPLED_FORCE = "largest sampled force, N"


class Figure(NamedTuple):
    """One number of a run, and the topic with its rate that it was found in."""

    value: float
    source: str


class Comparable(NamedTuple):
    """Quantities of a run that are compared with those of another run."""

    run: Run  # the recording
    contact: float  # first contact, s since the release
    contact_source: str  # topic that it was found in
    series: Mapping[str, Series]  # by quantity: the fields of Measurements, and DISTANCE
    sources: Mapping[str, str]  # topic and rate of each
    touches: Touches | None  # one by one; None where they were not found
    touch_source: str  # what they were found in; why there are none
    loads: Mapping[str, float | None]  # of the integration where both runs hold it, else empty

    @property
    def contact_may_be_late(self) -> bool:
        """Whether it was met in a force between whose samples a touch may have come before."""
        forces = (topics.CONTACT_WRENCH.name, topics.LOAD_CELL.name)
        return self.touches is None and self.contact_source in forces

    def measured(self, *, force: bool = False) -> Measurements:
        """Return the series of poses, stroke and torsion, and of the force if that is asked for."""
        left_out = {DISTANCE} if force else {DISTANCE, "force"}
        return Measurements(**{n: s for n, s in self.series.items() if n not in left_out})


def comparable(a: Run, b: Run) -> tuple[Comparable, Comparable]:
    """Choose what two runs are compared by.

    Of each quantity the series, one of each run, of which the slower one is fastest; among equals
    those of one topic, then motion capture before odometry.

    Raises
    ------
    RecordingError
        One of them holds no contact that it could be aligned by.
    """
    mine, theirs = _sources(a), _sources(b)
    chosen: list[dict[str, str]] = [{}, {}]
    for name in dict.fromkeys([*mine, *theirs]):
        has = [of.get(name, {}) for of in (mine, theirs)]
        pair = _finest(name, *has) if all(has) else tuple(next(iter(of), "") for of in has)
        for choice, topic in zip(chosen, pair, strict=True):
            if topic:
                choice[name] = topic
    first, second = (
        _comparable(run, of, choice)
        for run, of, choice in zip((a, b), (mine, theirs), chosen, strict=True)
    )
    if a.extremes is not None and b.extremes is not None:
        first = first._replace(loads=loads_of(a.extremes, a.touches))
        second = second._replace(loads=loads_of(b.extremes, b.touches))
    return _without_unresolved_touches(first, second), _without_unresolved_touches(second, first)


def rate_of(series: Series) -> float:
    """Return how often a series was sampled, Hz, by its median interval; 0 for one sample."""
    return 1.0 / series.interval if series.interval else 0.0


def characteristics(side: Comparable, *, sampled: bool = False) -> dict[str, Figure]:
    """Return the run in a few numbers, by name with the unit; what was not measured is absent.

    Forces and times are those of the touches located between samples, where the recording
    holds them.

    Parameters
    ----------
    side
        From :func:`comparable`.
    sampled
        Whether the largest sample of the force is listed as well, as nothing else is known of the
        other run.
    """
    found = {"first contact, s": Figure(side.contact, side.contact_source)}
    touches = side.run.touches
    if touches.size:
        first = first_cluster(touches)
        for name, value in (
            ("first contact lasts, ms", (first["end"].max() - first["start"].min()) * 1e3),
            ("peak force of first contact, N", first["peak_force"].max()),
            ("peak normal force, N", touches["peak_force"].max()),
            ("touches", touches.size),
            ("normal impulse, N s", touches["impulse"].sum()),
        ):
            found[name] = Figure(float(value), topics.BENCH_EVENT.name)
    elif contact := side.run.columns(topics.CONTACT_STATE):
        found["peak normal force, N"] = Figure(
            float(contact["peak_force"].max()), topics.CONTACT_STATE.name
        )
    if sampled and "force" in side.series:
        largest = float(side.series["force"].values.max())
        found[SAMPLED_FORCE] = Figure(largest, side.sources["force"])
    measured = {
        "max_axial_stroke_in": ("stroke", lambda x: -x.min()),
        "max_axial_stroke_out": ("stroke", lambda x: x.max()),
        "max_torsion": ("torsion", lambda x: np.abs(x).max()),
        "nearest_distance": (DISTANCE, lambda x: x.min()),
    }
    for load in LOADS:
        quantity, value_in = measured.get(load.key, ("", None))
        name = f"{load.meaning}, {load.shown_in}"
        for key, when in ((load.key, ""), (f"{load.key}_before_latch", ", until the latch")):
            if value := side.loads.get(key):
                found[name + when] = Figure(value * load.factor, "integration")
        if not side.loads and value_in is not None and quantity in side.series:
            value = float(value_in(side.series[quantity].values))
            found[name] = Figure(value * load.factor, side.sources[quantity])
    return found


def _sources(run: Run) -> dict[str, dict[str, Series]]:
    """Return every series of each quantity by its topic, the finest first."""
    found: dict[str, dict[str, Series]] = {}
    samples = run.samples
    if samples.size:
        exact = dict(measured_in(samples).items())
        exact[DISTANCE] = Series(samples["t"], samples["tip_distance"])
        found = {name: {topics.BENCH_STATE.name: series} for name, series in exact.items()}
    for name, by_topic in measured_sources(run).items():
        found.setdefault(name, {}).update(by_topic)
    # the detector's own path: the nearest place so far
    t_release = run.clock.t_release
    nearest = [(status.t - t_release, status.nearest_distance) for status in run.statuses]
    near = np.array([row for row in nearest if np.isfinite(row).all()]).reshape(-1, 2)
    if near.size:
        found.setdefault(DISTANCE, {})[topics.CAPTURE_STATUS.name] = Series(near[:, 0], near[:, 1])
    return {
        name: kept
        for name, by_topic in found.items()
        if (kept := {topic: series for topic, series in by_topic.items() if series.t.size})
    }


def _finest(name: str, mine: Mapping[str, Series], theirs: Mapping[str, Series]) -> tuple[str, str]:
    """Return the topics that a quantity is compared by."""

    def rank(pair: tuple[str, str]) -> tuple[float, bool, int]:
        a, b = pair
        slower = min(rate_of(mine[a]), rate_of(theirs[b]))
        places = list(mine).index(a) + list(theirs).index(b)
        # two topics do not mean quite the same there: filtered, or estimated
        rate = float(f"{slower:.2g}") if name not in ("force", DISTANCE) else 0.0
        return rate, a == b, -places

    return max(((a, b) for a in mine for b in theirs), key=rank)


def _comparable(
    run: Run, sources: Mapping[str, Mapping[str, Series]], choice: Mapping[str, str]
) -> Comparable:
    met = first_contact(run)
    if met is None:
        raise RecordingError(f"{run.path}: contains no contact to align it by")
    series = {name: sources[name][topic] for name, topic in choice.items()}
    touches, source = touches_of(run)
    return Comparable(
        run=run,
        # a message counts what was since the one before
        contact=met[0] if touches is None else min(met[0], float(touches.start[0])),
        contact_source=met[1].name,
        series=series,
        sources={name: f"{choice[name]}, {rate_of(series[name]):.4g} Hz" for name in series},
        touches=touches,
        touch_source=source,
        loads={},
    )


def _without_unresolved_touches(side: Comparable, other: Comparable) -> Comparable:
    """Return a run without its touches if the force they are from misses such as the other has."""
    if side.touches is None or other.touches is None:
        return side
    shortest = float(np.nanmin(other.touches.lasted, initial=np.inf))
    if not side.touches.may_miss(shortest):
        return side
    source = side.touch_source.partition(", which")[0]
    reason = f"{source}: too slow for touches of {shortest * 1e3:.3g} ms as the other has"
    return side._replace(touches=None, touch_source=reason)
