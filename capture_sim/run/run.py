"""A run from :func:`capture_sim.simulate`, from a recording, or from a real bench's bag.

Detection, comparison, fits, plots, reports and tables accept a :class:`Run` from any of these
sources.  The run is an :class:`ExactRun` if the full state is known, else a :class:`MeasuredRun`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

import numpy as np

from capture_sim.base.notebook import drawn, html_table
from capture_sim.detection.criteria import CaptureState, CaptureStatus
from capture_sim.dynamics.samples import ENERGIES, Event, EventKind, Extremes
from capture_sim.errors import RecordingError, SceneError
from capture_sim.plausibility.motion import MIN_DEFLECTION, MeasuredMotion
from capture_sim.plausibility.rules import Doubt, Grade, Unapplied
from capture_sim.plausibility.signals import noise, onset
from capture_sim.run.bounds import DEVIATIONS, Bounds, contact_bounds, peak_bounds, speed_error
from capture_sim.run.doubts import CountedSeries, examined, refuse, remaining
from capture_sim.run.first_contact import first_cluster, first_touch, impact_speed
from capture_sim.run.frames import Table, events_frame, samples_frame, topic_frame, touches_frame
from capture_sim.run.given import Given, Integrated
from capture_sim.run.loads import (
    NEAREST_ERROR,
    bounds_of_loads,
    if_measured,
    loads_of,
    sampled_extremes,
    with_closest,
)
from capture_sim.run.origin import Origin, scene_origin
from capture_sim.run.reconstruction import (
    RATE_WINDOW,
    events_of,
    measured_samples,
    placed,
    touches_in_force,
    touches_in_samples,
)
from capture_sim.run.series import NO_SERIES, STATE, Series
from capture_sim.run.summary import end_and_residual, sample_rate
from capture_sim.run.summary_table import heads
from capture_sim.run.summary_table import rows as table_rows
from capture_sim.run.touches import (
    MIN_SAMPLES,
    Touches,
    first_above,
    in_force,
    in_messages,
    located,
)
from capture_sim.run.verdict import (
    as_cut,
    detect_received,
    detect_state,
    received_in,
    with_criteria,
)

if TYPE_CHECKING:
    import pandas

    from capture_sim.dynamics.bench import Statistics
    from capture_sim.run.series import SeriesBySource
    from capture_sim.scene.launch_plan import LaunchPlan
    from capture_sim.scene.parts import Scene

#: Maximum time between the onsets of force and buffer deflection that count as one contact, s.
MAX_CONFIRMED = 0.1
#: Source of located touches and events: the topic that carries them.
EVENTS = "bench/event"


@dataclass(frozen=True)
class Check:
    """Comparison of a run with a second, more accurate run.

    The second run has a hundredth of the tolerance (with rk4, a quarter of the step).
    ``error`` is the largest difference of the two runs' coordinates up to each sample time, which
    estimates the first run's error.  Differences of angles are multiplied by a lever arm: hinge
    offset plus rest length for the chaser, ``L_T + R_c`` for the target.  If ``same_touches`` is
    False, the sequence of touches depends on the tolerance, and the motion after the first
    difference is not determined.
    """

    error: np.ndarray  # (n,), m
    same_touches: bool  # True if both runs touch the same walls in the same order
    failure: str = ""  # reason why the second run stopped early; the error is infinite from there


R = TypeVar("R", bound="Run")


class FirstContact(NamedTuple):
    """The first contact of a run."""

    t: float  # s since the release
    source: str  # topic that shows it


@dataclass(frozen=True, repr=False, eq=False)
class Run(ABC):
    """One run from any source; times are in s since the release, all units are SI.

    ``given`` contains the data that the source of the run provides; missing data are empty there.
    The run's own properties ``scene``, ``samples``, ``touches``, ``events``, ``statuses``,
    ``extremes``, ``loads`` and ``summary`` exist for every run that has a scene and poses.  Each
    returns the value in ``given`` if there is one; otherwise it is computed once from the other
    data.

    Attributes
    ----------
    name : str
        Name of the run.
    given : Given
        Data that the integration, the recording or the loop provides, e.g. ``given.series``.
    origin : Origin
        Source of the run, and the software that made it.
    wall_time : float or None
        Wall time of the run, s.
    statistics : Statistics or None
        Steps, rejected steps and evaluations of the equations of motion.
    check : Check or None
        Comparison with a more accurate run; None without ``check=True``.
    failure : str
        Reason why the simulation stopped early; empty for a complete run.
    waived : sequence of str
        Names of the plausibility rules that are not checked.

    Examples
    --------
    >>> from capture_sim import simulate
    >>> run = simulate("paper_designed", {"buffer.c_A": 20}, t_end=0.5)
    >>> run
    Run(paper_designed: undecided, 6 touches, peak 131.6 N, 501 samples to 0.5 s)
    >>> [round(float(force), 1) for force in run.touches["peak_force"][:3]]  # N
    [131.6, 85.9, 53.0]
    >>> round(run.loads["max_normal_force"], 1), run.q.shape
    (131.6, (501, 8))
    """

    name: str
    given: Given = field(default_factory=Given)
    origin: Origin = field(default_factory=Origin)
    wall_time: float | None = None
    statistics: Statistics | None = None
    check: Check | None = None
    failure: str = ""
    waived: Sequence[str] = ()

    #: True if the full state is known; False for a run known from measurements alone.
    is_exact: ClassVar[bool]

    # origin

    @property
    def scene(self) -> Scene:
        """Scene of the run; SceneError if it is not known."""
        if self.given.scene is None:
            raise SceneError(
                f"{self.origin.path or self.name}: contains no scene: give it with --scene"
            )
        return self.given.scene

    @property
    def problems(self) -> tuple[str, ...]:
        """Reasons why the run or its recording is incomplete; empty if it is complete."""
        failure = (self.failure,) if self.failure else ()
        return (*failure, *self.origin.problems)

    @property
    def complete(self) -> bool:
        """True if the run ended as planned and no message of it was lost."""
        return not self.problems

    def replaced(self: R, **changes: Any) -> R:
        """Return a copy of the run with changed attributes, of the run itself or of ``given``.

        Topics that are not yet decoded are not decoded by this call.
        """
        own = {f.name for f in fields(self)}
        of_source = {name: value for name, value in changes.items() if name not in own}
        changes = {name: value for name, value in changes.items() if name in own}
        if of_source:
            changes["given"] = self.given.replaced(**of_source)
        if "scene" in of_source and "origin" not in changes:
            changes["origin"] = replace(self.origin, scene_sha256="")
        run = replace(self, **changes)
        if not {*of_source, *changes} & {"evidence", "scene", "waived"}:
            kept = ("_examined", "_motions")  # not looked for a second time
            vars(run).update({name: vars(self)[name] for name in kept if name in vars(self)})
        return run

    @cached_property
    def made_by(self) -> dict[str, Any]:
        """Provenance of the run: source, scene, overrides, hash of the scene, seed, software."""
        made_by: dict[str, Any] = {"source": self.origin.path or "simulated"}
        if self.given.scene is not None:
            made_by |= scene_origin(self.given.scene, self.origin.scene_sha256)
        return {**made_by, "software": list(self.origin.software)}

    # values of ``given``, returned unchanged

    @property
    def series(self) -> SeriesBySource:
        """Series by quantity and source, e.g. ``series["chaser"]["chaser/odom"]``."""
        return self.given.series

    @property
    def plan(self) -> LaunchPlan | None:
        """Launch as commanded; None if the run contains no launch plan."""
        return self.given.plan

    @property
    def tables(self) -> Mapping[str, Table]:
        """Recorded topics by name, as columns with units; empty for a simulated run."""
        return self.given.tables

    @property
    def trace(self) -> np.ndarray:
        """Contact at the ends of the integrator's steps, (k,); empty without ``run.trace``."""
        return self.given.trace

    # measurements

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """Plausibility rules that the measurements break, the most serious first.

        Code that evaluates or fits measurements calls :func:`checked` instead.  It also removes the
        topics that a rule leaves out.
        """
        return self._examined[0]

    @property
    def unapplied(self) -> tuple[Unapplied, ...]:
        """Plausibility rules that the measurements do not allow to apply, and why."""
        return self._examined[1]

    @cached_property
    def _examined(self) -> tuple[tuple[Doubt, ...], tuple[Unapplied, ...]]:
        return examined(self._motions, self.waived)

    @cached_property
    def _motions(self) -> list[MeasuredMotion]:
        return [MeasuredMotion(each, self.given.scene) for each in self.given.evidence]

    def measured(self, quantity: str) -> Series:
        """Return the series of a quantity from its first sensor, else from the exact state.

        Empty series are skipped.
        """
        sources = self.series.get(quantity, {})
        for name in sorted(sources, key=lambda name: name == STATE):
            if sources[name].t.size:
                return sources[name]
        return NO_SERIES

    @property
    @abstractmethod
    def cone_force(self) -> Series:
        """Force on the tip in the cone's axes, (n, 2), N; empty if it was not measured."""

    @property
    def first_contact(self) -> FirstContact | None:
        """The first contact and its source; None if no contact was found.

        The sources, in order of preference, are located events, ``bench/contact``, a measured force
        and the deflection of the buffer.  A force is ignored if it begins while the poses exclude
        a contact.  The time is within :attr:`contact_bounds`.
        """
        shown, bounds = self._contact_shown, self.contact_bounds
        if shown is None or bounds is None:
            return shown
        return shown._replace(t=bounds.around(shown.t))

    @cached_property
    def contact_bounds(self) -> Bounds | None:
        """Times between which the first contact of a measured run lies, s since the release.

        None for an exact run, if there is no contact and none can be hidden, and without a scene
        or poses of both vehicles.
        """
        motion = self._motion
        if motion is None:
            return None
        release, shown = motion.measured.release, self._contact_shown
        bounds = contact_bounds(motion, () if shown is None else [shown.t + release])
        return None if bounds is None else bounds.later(-release)

    @property
    def begins_without_zero(self) -> bool:
        """True if the recording of a rig begins at the walls, so that no state shows the zero."""
        motion, bounds = self._motion, self.contact_bounds
        if motion is None or bounds is None or math.isfinite(bounds.low):
            return False
        return not bool(np.isfinite(motion.zero_error).all())

    @property
    def _motion(self) -> MeasuredMotion | None:
        if self.is_exact or self.given.scene is None:
            return None
        return next(iter(self._motions), None)

    @cached_property
    def _contact_shown(self) -> FirstContact | None:
        for event in self.given.events:
            if event.kind is EventKind.TOUCH:
                return FirstContact(event.t, EVENTS)
        for source, in_touch in self.series.get("in_touch", {}).items():
            begun = self.series["touches_begun"][source]
            touching = np.flatnonzero((in_touch.values != 0.0) | (begun.values > 0.0))
            return FirstContact(float(in_touch.t[touching[0]]), source) if touching.size else None
        is_doubted = any(doubt.rule.name == "force_without_contact" for doubt in self.doubts)
        for quantity in ("tip_force", "cone_force"):
            for source, force in self.series.get(quantity, {}).items():
                if force.t.size and not is_doubted:
                    first = self._contact_in(force)
                    return None if first is None else FirstContact(first, source)
        return self._contact_of_buffer

    def _contact_in(self, force: Series) -> float | None:
        """Return the time at which a force first shows a contact, s; None if it never does.

        A moving rig is noisier than a rig at rest, so noise alone may exceed the threshold.  With
        measured data, the time is therefore compared with the deflection of the buffer.  If the
        times differ by :data:`MAX_CONFIRMED` or more, and the force near the deflection exceeds
        half of its peak, the time of the deflection is returned.
        """
        first = first_above(force.t, force.values)
        buffer = self._contact_of_buffer if self.given.evidence else None
        if first is None or buffer is None or abs(first - buffer.t) < MAX_CONFIRMED:
            return first
        size = np.hypot(*(force.values - np.median(force.values, axis=0)).T)
        near = np.abs(force.t - buffer.t) < MAX_CONFIRMED
        return buffer.t if size[near].max(initial=0.0) > 0.5 * size.max() else first

    @cached_property
    def _contact_of_buffer(self) -> FirstContact | None:
        """The first deflection of the buffer; None if there is none, or in an exact run."""
        stroke, torsion = self.measured("stroke"), self.measured("torsion")
        if self.is_exact or stroke.t.size < MIN_SAMPLES or torsion.t.size != stroke.t.size:
            return None
        length = 0.2 if self.given.scene is None else self.given.scene.rest_length
        moved = np.column_stack([stroke.values, length * torsion.values])
        found = onset(stroke.t, moved, MIN_DEFLECTION)
        source = next(iter(self.series["stroke"]))
        return None if found is None else FirstContact(found[0], source)

    @cached_property
    def resolved_touches(self) -> tuple[Touches | None, str]:
        """The individually resolved touches and their source; None and the reason without any.

        Located touches are preferred.  Otherwise the touches come from the counts in
        ``bench/contact`` or from a sampled force; the source with more messages is tried first.
        The list ends before the first touch that cannot be resolved.  Peaks are peaks of the
        normal force, or of the force's magnitude if the run has no scene.
        """
        if self.given.touches.size:
            return located(self.given.touches), EVENTS
        candidates = [
            (series.t.size, quantity, source, series)
            for quantity in ("in_touch", "tip_force", "cone_force")
            for source, series in self.series.get(quantity, {}).items()
        ]
        slow_sources = []
        for _, quantity, source, series in sorted(candidates, key=lambda found: -found[0]):
            limit = "as long as each message counts one"
            if quantity == "in_touch":
                columns = (self.series[name][source] for name in ("touches_begun", "peak_force"))
                begun, peak = (column.values for column in columns)
                touches = in_messages(series.t, begun.astype(int), peak, series.values != 0.0)
            else:
                touches = self._touches_in(series, is_turned=quantity == "tip_force")
                shortest = MIN_SAMPLES * series.interval
                limit = f"which may miss touches below {shortest * 1e3:.3g} ms"
            described = f"{source}, {series.rate:.4g} Hz" if series.interval else source
            if touches is not None:
                return touches, f"{described}, {limit}"
            slow_sources.append(described)
        if slow_sources:
            return None, f"{' and '.join(slow_sources)}: too slow to show touches"
        return None, "no force"

    def _touches_in(self, force: Series, *, is_turned: bool) -> Touches | None:
        """Return the touches in a force in the cone's axes, or the tip's if ``is_turned``."""
        if self.given.scene is None:
            return in_force(force.t, force.values)
        attitude = self._attitude(force.t) if is_turned else np.zeros(force.t.size)
        return in_force(force.t, force.values, attitude, self.given.scene.cone)

    def _attitude(self, t: np.ndarray) -> np.ndarray:
        """Return the tip's attitude in the cone, (n,), rad; unmeasured angles count as 0."""
        angle = np.zeros(t.size)
        for sign, quantity in ((1.0, "chaser"), (-1.0, "target"), (1.0, "torsion")):
            series = self.measured(quantity)
            if series.t.size:
                values = series.values if series.values.ndim == 1 else series.values[:, 2]
                angle += sign * np.interp(t, series.t, values)
        return angle

    # derived

    @property
    @abstractmethod
    def samples(self) -> np.ndarray:
        """Samples (n,) of dtype SAMPLE: the exact state, else the measurements.

        Samples from measurements are at the stamps of the chaser's poses; quantities that were not
        measured are NaN.  Raises SceneError without a scene, and RecordingError without poses of
        both vehicles or without the buffer's state.
        """

    @property
    @abstractmethod
    def touches(self) -> np.ndarray:
        """All touches, (m,) of dtype TOUCH, ordered by their ends: located, else measured."""

    @property
    @abstractmethod
    def events(self) -> Sequence[Event]:
        """Events in order: as logged, else one TOUCH event for each measured touch."""

    @cached_property
    def statuses(self) -> Sequence[CaptureStatus]:
        """Statuses of the detector: as reported, else evaluated now; the last has the verdict.

        The sequence is empty if no status was reported and a rule of grade *refused* is broken.  If
        a recording ended before its detector had finished, the last status is undecided.
        """
        reported = self.given.statuses
        if not reported:
            is_refused = any(doubt.grade is Grade.REFUSED for doubt in self.doubts)
            return () if is_refused else detect(self)
        if self.given.scene is None or self.given.integrated is not None:
            return reported
        last = as_cut(reported[-1], self.given.scene)
        return reported if last is reported[-1] else [*reported[:-1], last]

    @cached_property
    def extremes(self) -> Extremes:
        """Peak loads: located by the integrator, else from samples, touches and events."""
        if self.given.extremes is not None:
            return self.given.extremes
        buffer = None if self.is_exact else {q: self.measured(q) for q in ("stroke", "torsion")}
        return sampled_extremes(self.scene, self.samples, self.touches, self.events, buffer)

    @cached_property
    def loads(self) -> dict[str, Any]:
        """Loads of the complete run and of the time before the latch closes, by name, SI units.

        Examples of names are ``max_torsion`` and ``max_torsion_before_latch``.  Each name with the
        suffix ``_time`` gives the time of the load.  :data:`capture_sim.run.loads.LOADS` lists
        names and units.
        """
        loads = loads_of(self.extremes, self.touches)
        if self.is_exact or self.given.extremes is not None or not self.statuses:
            return loads
        last = self.statuses[-1]
        if last.nearest_deviation == 0.0:
            return loads
        return with_closest(loads, last.nearest_distance, last.nearest_deviation)

    @cached_property
    def load_bounds(self) -> dict[str, Bounds] | None:
        """Bounds of the measured loads, by name, SI units; None if the loads are exact.

        They are those of stroke, torsion and normal force over the whole run.  The force has no
        upper one: a touch of metal lasts less than a sensor's rise time.
        """
        if self.given.extremes is not None:
            return None
        if self._motion is None:  # samples of a simulated run, or nothing to measure against
            return {}
        contact, chaser = self.contact_bounds, self.measured("chaser").t
        end = float(chaser[-1])
        begin = math.inf if contact is None else contact.low
        stroke, torsion, force = (self.measured(q) for q in ("stroke", "torsion", "tip_force"))
        force = force if force.t.size else self.measured("cone_force")
        found = {}
        for key, t, values, error in (
            ("max_axial_stroke_in", stroke.t, -stroke.values, self._motion.zero_error[0]),
            ("max_axial_stroke_out", stroke.t, stroke.values, self._motion.zero_error[0]),
            ("max_torsion", torsion.t, np.abs(torsion.values), self._motion.zero_error[1]),
        ):
            kept = (t >= chaser[0]) & (t <= end)
            found[key] = peak_bounds(t[kept], values[kept], begin, end, float(error))
        peak = self.loads["max_normal_force"]
        if force.t.size and peak is not None:
            low = peak - DEVIATIONS * max(map(noise, force.values.T))
            found["max_normal_force"] = Bounds(max(low, 0.0), math.inf)
        return found

    @property
    def verdict(self) -> str:
        """Verdict of the detector: captured, rebound, missed, stuck or undecided."""
        return self.statuses[-1].state.label if self.statuses else "undecided"

    @cached_property
    def summary(self) -> dict[str, Any]:
        """Main results of the run, SI units; keys as in results.json.

        A result that the run does not have is None, e.g. the first contact of a run without
        touches.  They are described in :data:`capture_sim.run.summary.KEYS`.
        """
        known = self.given.integrated
        if known is None:
            known = Integrated(*end_and_residual(self.samples, self.scene.run.rate))
        status = self.statuses[-1] if self.statuses else None
        since = math.nan if status is None else status.t - status.time_in_state
        touch, speed = first_touch(self.events), impact_speed(self.events)
        is_unmeasured = touch is not None and speed is not None and math.isnan(speed)
        error = 0.0 if self._motion is None else speed_error(self._motion, RATE_WINDOW)
        first = first_cluster(self.touches)
        time, low, high = self._contact_summary(first)
        # of a contact that is hidden in part, only the time is known
        is_whole = self.contact_bounds is None or not self.contact_bounds.why
        is_seen = first.size > 0 and is_whole
        return {
            "name": self.name,
            "verdict": None if status is None else status.state.label,
            "verdict_time": if_measured(since),
            "verdict_time_low": None if status is None else if_measured(since - status.may_precede),
            "verdict_time_high": None if status is None else if_measured(since + status.may_follow),
            "left_again": status is not None and status.left_again,
            "not_used": "" if status is None else status.not_used,
            "problems": list(self.problems),
            "doubts": [doubt.line for doubt in self.doubts],
            "waived": list(self.waived),
            "impact_speed": None if is_unmeasured else speed,
            "impact_speed_missing": touch.detail if touch is not None and is_unmeasured else "",
            "impact_speed_error": None if is_unmeasured or speed is None else if_measured(error),
            "first_contact_time": time,
            "first_contact_time_low": low,
            "first_contact_time_high": high,
            "first_contact_duration": float(first["end"].max() - first["start"].min())
            if is_seen
            else None,
            "first_contact_touches": int(first.size) if is_whole else None,
            "first_contact_peak_force": if_measured(first["peak_force"].max()) if is_seen else None,
            "normal_impulse": if_measured(self.touches["impulse"].sum()),
            NEAREST_ERROR: 0.0,
            **self.loads,
            **bounds_of_loads(self.loads, self.load_bounds),
            "loads_from": "integration" if self.given.extremes is not None else self._loads_from,
            "energy_residual": if_measured(known.energy_residual),
            "wall_time": self.wall_time,
            "real_time_factor": known.t_end / self.wall_time if self.wall_time else None,
            "made_by": dict(self.made_by),
        }

    @property
    def _loads_from(self) -> str:
        text = f"samples at {sample_rate(self.samples):.4g} Hz"
        rate = 0.0 if self.is_exact else self.measured("stroke").rate
        return f"{text}, of the buffer at {rate:.4g} Hz" if rate else text

    def _contact_summary(
        self, touches: np.ndarray
    ) -> tuple[float | None, float | None, float | None]:
        """Return the time of the first contact, whose touches are given, and its bounds, s."""
        bounds, first = self.contact_bounds, self.first_contact
        if self._motion is None:
            exact = float(touches["start"].min()) if touches.size else None
            return exact, exact, exact
        t = None if first is None else first.t
        if bounds is None:
            return t, None, None
        return t, if_measured(bounds.low), if_measured(bounds.high)

    @cached_property
    def drawn_scene(self) -> Scene:
        """The scene as drawn in plots; a measured run is drawn at its first measured poses.

        The scene drawn for a measured run has the run's name.
        """
        if self.is_exact:
            return self.scene
        poses = [self.samples["q"][0, :3], self.samples["q"][0, 5:]]
        return placed(self.scene, self.name, poses)

    @property
    def t(self) -> np.ndarray:
        """Sample times (n,), s since the release."""
        return np.asarray(self.samples["t"])

    @property
    def q(self) -> np.ndarray:
        """Coordinates (n, 8): x_S, y_S, theta_S, theta_P, h, x_T, y_T, theta_T; m and rad."""
        return np.asarray(self.samples["q"])

    @property
    def v(self) -> np.ndarray:
        """Rates of ``q`` (n, 8), m/s and rad/s."""
        return np.asarray(self.samples["v"])

    @property
    def energy(self) -> dict[str, np.ndarray]:
        """Energies of the ledger by name, each (n,), J."""
        return {name: np.asarray(self.samples[name]) for name in ENERGIES}

    # output

    def __repr__(self) -> str:
        if self.given.scene is None:
            return f"Run({self.name}: without a scene)"
        peak = np.nan_to_num(self.touches["peak_force"]).max(initial=0.0)
        ends = [self.t.max(initial=0.0), *(event.t for event in self.events[-1:])]
        text = (
            f"{self.name}: {self._verdict_text()}, {self.touches.size} touches, "
            f"peak {peak:.1f} N, {self.samples.size} samples to {max(ends):.6g} s"
        )
        return f"Run({'; '.join([text, *self.problems[:1]])})"

    def _verdict_text(self) -> str:
        if not self.statuses:
            return "no verdict"
        last = self.statuses[-1]
        if not last.state.is_verdict:
            return last.label
        return f"{last.label} after {last.t - last.time_in_state:.6g} s"

    def _repr_html_(self) -> str:
        """Return the summary as an HTML table for a notebook."""
        # if a latch closed, there is a second column of values
        columns = table_rows([self.summary])
        rows = (
            (" ".join(filter(None, (group, name))), *cells, unit)
            for (group, name, unit), *cells in zip(heads(), *columns, strict=True)
        )
        return html_table(self.scene.title, rows)

    def to_dataframe(self, table: str = "samples") -> pandas.DataFrame:
        """Return samples, touches, events or a recorded topic as a pandas table.

        Parameters
        ----------
        table
            ``samples``: one column for each number, indexed by time ``t``; the name of a component
            begins with the name of its field, e.g. ``q.x_S``, ``v.theta_P``, ``penetration.+y``.
            ``touches``: one row for each touch, numbered from 0.  ``events``: kind, wall, detail
            and state, indexed by ``t``.  Otherwise the name of a topic of ``tables``, indexed by
            ``t``.

        Returns
        -------
        pandas.DataFrame
            The table; phases and kinds of events are pandas categories with their names.
            ``attrs["units"]`` maps each column and the index to its unit, which may be empty.

        Raises
        ------
        MissingPackageError
            pandas is not installed.
        ValueError
            There is no such table.
        """
        if table == "samples":
            return samples_frame(self.samples)
        if table == "touches":
            return touches_frame(self.touches)
        if table == "events":
            return events_frame(self.events)
        topic = table if table in self.tables else f"/{table}"
        if topic not in self.tables:
            available = ", ".join(("samples", "touches", "events", *self.tables))
            raise ValueError(
                f"table = {table!r}: must be one of {available}; loads are in run.loads"
            )
        return topic_frame(self.tables[topic])

    def plot(self) -> Any:
        """Return a matplotlib figure of the run; see :func:`capture_sim.plot`.

        Raises
        ------
        MissingPackageError
            matplotlib is not installed.
        """
        return drawn(self)


class ExactRun(Run):
    """A run whose full state is known: simulated, recorded from a simulation, or from a loop."""

    is_exact = True

    @cached_property
    def cone_force(self) -> Series:
        """Force on the tip in the cone's axes, (n, 2), N."""
        force = self.samples["contact_force"] + self.samples["latch_force"]
        return Series(self.samples["t"], _turned(force, -self.samples["q"][:, 7]))

    @property
    def samples(self) -> np.ndarray:
        """Exact samples (n,) of dtype SAMPLE."""
        return self.given.samples

    @property
    def touches(self) -> np.ndarray:
        """All located touches, (m,) of dtype TOUCH, ordered by their ends."""
        return self.given.touches

    @property
    def events(self) -> Sequence[Event]:
        """Events in order, as logged."""
        return self.given.events


class MeasuredRun(Run):
    """A run that is known from sensor measurements only."""

    is_exact = False

    @cached_property
    def cone_force(self) -> Series:
        """Force on the tip in the cone's axes, (n, 2), N; empty if it was not measured."""
        series = self.measured("tip_force")
        if not series.t.size:
            return self.measured("cone_force")
        return series._replace(values=_turned(series.values, self._attitude(series.t)))

    @cached_property
    def samples(self) -> np.ndarray:
        """Samples (n,) of dtype SAMPLE at the stamps of the chaser's poses.

        Quantities that were not measured are NaN.
        """
        scene = self.scene
        self._check_poses()
        return measured_samples(
            scene, self.measured("chaser").t, self._sensors, self._touches_in_samples
        )

    @cached_property
    def touches(self) -> np.ndarray:
        """All touches, (m,) of dtype TOUCH, ordered by their ends: located, else measured."""
        if self.given.touches.size:
            return self.given.touches
        if self._touches_in_samples is not None:
            return touches_in_force(self._touches_in_samples)
        found = touches_in_samples(self.samples, self._sensors)
        bounds = self.contact_bounds  # noise may place the tip at a wall before
        return found if bounds is None else found[found["end"] >= bounds.low]

    @cached_property
    def events(self) -> Sequence[Event]:
        """Events in order: as logged, else one TOUCH event for each measured touch."""
        if self.given.events:
            return self.given.events
        return events_of(self.scene, self.samples, self.touches, self._sensors)

    def _left_out(self, *words: str) -> str:
        """Return why topics with one of these words in their names are left out, or nothing."""
        lines = [line for line in self.origin.left_out if any(word in line for word in words)]
        return f" ({'; '.join(lines)})" if lines else ""

    def _check_poses(self) -> None:
        where = self.origin.path or self.name
        for vehicle in ("chaser", "target"):
            if not self.measured(vehicle).t.size:
                raise RecordingError(
                    f"{where}: contains no finite pose of the {vehicle} "
                    f"(/motion_capture/{vehicle} or /{vehicle}/odom); --remap reads it from "
                    f"another topic{self._left_out(vehicle)}"
                )
        if not self.measured("stroke").t.size or not self.measured("torsion").t.size:
            raise RecordingError(
                f"{where}: contains neither /bench/buffer nor /joint_states with buffer_hinge and "
                "buffer_slide, so the position of the tip is unknown"
                + self._left_out("buffer", "joint")
            )

    @cached_property
    def _sensors(self) -> dict[str, Series]:
        """The series from which the samples are made, by quantity."""
        return {name: self.measured(name) for name in self.series}

    @cached_property
    def _touches_in_samples(self) -> Touches | None:
        """Located touches, or the touches in a force if it shows all of them; else None."""
        if self.given.touches.size:
            return located(self.given.touches)
        if "in_touch" in self.series:
            return None  # touches_in_samples() uses the walls and counts of bench/contact
        touches, _ = self.resolved_touches
        return touches if touches is not None and touches.all_found else None


def checked(run: Run) -> CountedSeries:
    """Return the series of a run that may be evaluated and fitted, and the doubts to print.

    All code that evaluates measurements calls this function.  The series are those of
    :attr:`Run.series` without the topics that a rule leaves out.  There is one doubt for each
    broken rule and topic; the caller must print the doubt's ``line``.  A simulated run has no
    doubts.

    Raises
    ------
    RecordingError
        A rule of grade *refused* is broken and not waived (:attr:`Run.waived`).
    """
    doubts = run.doubts
    refuse(run.origin.path or run.name, doubts)
    return CountedSeries(remaining(run.series, doubts), doubts)


def detect(
    run: Run, scene: Scene | None = None, *, from_series: bool = False
) -> Sequence[CaptureStatus]:
    """Evaluate a run with the capture detector; return its statuses, the final verdict last.

    Parameters
    ----------
    run
        Run to evaluate.  Exact samples are evaluated directly, at ``run.rate`` of the scene;
        measurements are evaluated as the detector's node does.
    scene
        Scene with the detector's criteria; None for the run's scene with the criteria of the
        detector that took part in the run.
    from_series
        True to evaluate the measurements even if exact samples are known.

    Raises
    ------
    RecordingError
        A topic that the detector needs is missing, or a rule of grade *refused* is broken.
    SceneError
        The run contains no scene.
    """
    if scene is None:
        scene = with_criteria(run.scene, run.given.criteria, ())
    has_noise = any(name.startswith("motion_capture/") for name in run.series.get("chaser", ()))
    is_cut = run.given.live.is_cut or bool(run.failure)
    if run.is_exact and not has_noise and not from_series:
        has_end = run.given.live.has_end
        return detect_state(run.given.samples, scene, is_cut=is_cut, has_end=has_end)
    checked(run)
    live = run.given.live._replace(is_cut=is_cut)
    received = received_in(run.series) if run.given.received is None else run.given.received
    *earlier, last = detect_received(received, scene, live)
    if last.state is CaptureState.STUCK and run.begins_without_zero:
        reason = "at rest to each other, but the zero of the buffer is not known"
        last = last._replace(state=CaptureState.UNDECIDED, reason=reason)
    return [*earlier, last]


def _turned(vectors: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return vectors (n, 2) rotated by angles (n,), rad."""
    c, s = np.cos(angle), np.sin(angle)
    x, y = vectors.T
    return np.stack([c * x - s * y, s * x + c * y], axis=-1)
