"""The series that two recordings are compared by: of each quantity the finest that both contain.

A simulated run contains all quantities at the rate of ``bench/state``, a bench's bag only at that
of its sensors: peaks found at 1 kHz and at 100 Hz would differ by the sampling alone.
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
#: Name of the largest force of a sampled series; a touch between two samples may exceed it.
SAMPLED_FORCE = "largest sampled force, N"


class Figure(NamedTuple):
    """One number of a run, and its topic and rate."""

    value: float
    source: str


class Comparable(NamedTuple):
    """Quantities of a run that are compared with those of another run."""

    run: Run  # the recording
    contact: float  # first contact, s since the release
    contact_source: str  # topic that shows it
    series: Mapping[str, Series]  # by quantity: the fields of Measurements, and DISTANCE
    sources: Mapping[str, str]  # topic and rate of each
    touches: Touches | None  # one by one; None if there are none
    touch_source: str  # topic and rate, or why there are none
    loads: Mapping[str, float | None]  # of the integration if both runs contain it, else empty

    @property
    def contact_may_be_late(self) -> bool:
        """Whether an earlier touch may lie between the samples of the force that shows it."""
        forces = (topics.CONTACT_WRENCH.name, topics.LOAD_CELL.name)
        return self.touches is None and self.contact_source in forces

    def measured(self, *, force: bool = False) -> Measurements:
        """Return the series of poses, stroke and torsion, and of the force if that is asked for."""
        left_out = {DISTANCE} if force else {DISTANCE, "force"}
        return Measurements(**{n: s for n, s in self.series.items() if n not in left_out})


def comparable(a: Run, b: Run) -> tuple[Comparable, Comparable]:
    """Choose the series that two runs are compared by.

    Of each quantity those are chosen, one of each run, whose slower one is fastest; of equal ones
    those of one topic, then motion capture before odometry.  RecordingError if a run contains no
    contact to align it by.
    """
    sources_a, sources_b = _sources(a), _sources(b)
    topics_a: dict[str, str] = {}
    topics_b: dict[str, str] = {}
    for name in dict.fromkeys([*sources_a, *sources_b]):
        if name in sources_a and name in sources_b:
            topics_a[name], topics_b[name] = _finest(name, sources_a[name], sources_b[name])
        elif name in sources_a:
            topics_a[name] = next(iter(sources_a[name]))
        else:
            topics_b[name] = next(iter(sources_b[name]))
    side_a, side_b = _comparable(a, sources_a, topics_a), _comparable(b, sources_b, topics_b)
    if a.extremes is not None and b.extremes is not None:
        side_a = side_a._replace(loads=loads_of(a.extremes, a.touches))
        side_b = side_b._replace(loads=loads_of(b.extremes, b.touches))
    return _without_unresolved_touches(side_a, side_b), _without_unresolved_touches(side_b, side_a)


def rate_of(series: Series) -> float:
    """Return how often a series was sampled, Hz, by its median interval; 0 for one sample."""
    return 1.0 / series.interval if series.interval else 0.0


def characteristics(side: Comparable, *, sampled: bool = False) -> dict[str, Figure]:
    """Return the run in a few numbers, by name with the unit; what was not measured is absent.

    Forces and times are those of the touches located between samples, if they are recorded.
    ``sampled`` adds the largest sample of the force, for a run whose other side has only that.
    """
    figures = {"first contact, s": Figure(side.contact, side.contact_source)}
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
            figures[name] = Figure(float(value), topics.BENCH_EVENT.name)
    elif contact := side.run.columns(topics.CONTACT_STATE):
        figures["peak normal force, N"] = Figure(
            float(contact["peak_force"].max()), topics.CONTACT_STATE.name
        )
    if sampled and "force" in side.series:
        largest = float(side.series["force"].values.max())
        figures[SAMPLED_FORCE] = Figure(largest, side.sources["force"])
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
                figures[name + when] = Figure(value * load.factor, "integration")
        if not side.loads and value_in is not None and quantity in side.series:
            value = float(value_in(side.series[quantity].values))
            figures[name] = Figure(value * load.factor, side.sources[quantity])
    return figures


def _sources(run: Run) -> dict[str, dict[str, Series]]:
    """Return every series of each quantity by its topic, the finest first."""
    sources: dict[str, dict[str, Series]] = {}
    samples = run.samples
    if samples.size:
        exact = dict(measured_in(samples).items())
        exact[DISTANCE] = Series(samples["t"], samples["tip_distance"])
        sources = {name: {topics.BENCH_STATE.name: series} for name, series in exact.items()}
    for name, by_topic in measured_sources(run).items():
        sources.setdefault(name, {}).update(by_topic)
    # of the path that the detector estimates: the closest approach so far
    t_release = run.clock.t_release
    nearest = [(status.t - t_release, status.nearest_distance) for status in run.statuses]
    finite = np.array([row for row in nearest if np.isfinite(row).all()]).reshape(-1, 2)
    sources.setdefault(DISTANCE, {})[topics.CAPTURE_STATUS.name] = Series(*finite.T)
    measured = {
        name: {topic: series for topic, series in by_topic.items() if series.t.size}
        for name, by_topic in sources.items()
    }
    return {name: by_topic for name, by_topic in measured.items() if by_topic}


def _finest(
    name: str, series_a: Mapping[str, Series], series_b: Mapping[str, Series]
) -> tuple[str, str]:
    """Return the topics that a quantity is compared by, of its series by topic."""

    def rank(pair: tuple[str, str]) -> tuple[float, bool, int]:
        a, b = pair
        slower = min(rate_of(series_a[a]), rate_of(series_b[b]))
        places = list(series_a).index(a) + list(series_b).index(b)
        # two topics do not mean quite the same there: filtered, or estimated
        rate = float(f"{slower:.2g}") if name not in ("force", DISTANCE) else 0.0
        return rate, a == b, -places

    return max(((a, b) for a in series_a for b in series_b), key=rank)


def _comparable(
    run: Run, sources: Mapping[str, Mapping[str, Series]], topic_names: Mapping[str, str]
) -> Comparable:
    contact = first_contact(run)
    if contact is None:
        raise RecordingError(f"{run.path}: contains no contact to align it by")
    t_contact, contact_topic = contact
    series = {name: sources[name][topic] for name, topic in topic_names.items()}
    touches, source = touches_of(run)
    return Comparable(
        run=run,
        # a message counts what was since the one before
        contact=t_contact if touches is None else min(t_contact, float(touches.start[0])),
        contact_source=contact_topic.name,
        series=series,
        sources={name: f"{topic_names[name]}, {rate_of(series[name]):.4g} Hz" for name in series},
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
