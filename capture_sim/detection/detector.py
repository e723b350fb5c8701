"""The capture detector for measurements: one pipeline from messages to statuses.

measurements -> sequencer (order of stamps) -> gates (rejection of impossible poses) -> aligner
(common instants) -> smoother (path of the tip) -> criteria -> statuses.

After the sequencer, every result depends only on stamps and values, not on arrival times.  The
live detector and `capture-sim detect` therefore give the same statuses for the same messages.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from statistics import mean
from types import SimpleNamespace

from capture_sim.base.compiled.kernels import plain
from capture_sim.detection.align import Aligner, Observation
from capture_sim.detection.clocks import MAX_OFFSET, WARN_OFFSET, ClockOffsets
from capture_sim.detection.criteria import (
    GUARD,
    CaptureState,
    CaptureStatus,
    Cause,
    Criteria,
    Place,
    decide,
    decide_at_end,
    enter,
    new_memory,
    note_push,
    reason,
    wall_gap,
)
from capture_sim.detection.gate import Gate, PoseLimits, largest_speed
from capture_sim.detection.measurements import (
    REORDER,
    Counts,
    Measurement,
    Sequencer,
    Source,
    Values,
)
from capture_sim.detection.nearest import ClosestApproach
from capture_sim.detection.noise import NoiseEstimate, third_difference
from capture_sim.detection.smoother import MeasuredTip, TipPath
from capture_sim.dynamics.model.trig import wrapped_angle
from capture_sim.plausibility.signals import AWAY, MIN_REST, N_REST, zero_of, zero_text
from capture_sim.scene.geometry import tip_motion
from capture_sim.scene.parts import Scene

#: Number of buffer measurements that are averaged if a single measurement is too noisy.
_N_AVERAGED = 12
#: Standard deviations by which a deflection must exceed ``max_contact_gap`` to count as a push.
#: The number is large because any single measurement of a run may decide.
BUFFER_GUARD = 6.0
#: With noise, rest is also evaluated over this multiple of ``still_time``.
_LONGEST_REST = 4.0
#: A source is reported if its latest stamp is older than the newest stamp by more than this, ns.
STALE = 2_000_000_000
#: Period of the comparison of the sources' clocks, ns of arrival time.
_CLOCK_PERIOD = 100_000_000
#: Tolerance for the round-off of times, s.
_TICK = 1e-9
#: Times are counted from a multiple of this, ns.  They are then small numbers, and a stamp gives
#: the same time whenever the trial begins.
_EPOCH = 1_000_000_000_000

# a few hundred measurements a second do not justify compiled functions
_tip_motion, _decide, _note_push = plain(tip_motion), plain(decide), plain(note_push)
_enter, _wall_gap, _decide_at_end = plain(enter), plain(wall_gap), plain(decide_at_end)
_wrapped_angle = plain(wrapped_angle)


class CaptureTimes:
    """The times at which a capture may have been, and surely was, within the noise of the path.

    Both rules of a capture count: the dwell in the capture zone, and passing BE.
    """

    def __init__(self, criteria: Criteria) -> None:
        self._criteria = criteria
        self._since_perhaps = self._since_surely = math.nan
        self.earliest = self.latest = math.inf  # s

    def add(self, place: Place, distance: float, before: float, gap: float, blur: float) -> None:
        """Add a place of the tip and its distance from BE, m; ``before``: s, the place before.

        A place more than ``gap``, s, after the one before says nothing of the time between.  The
        smoothing may have moved the place by ``blur``, m.
        """
        c, t = self._criteria, place.t
        unsure = blur + GUARD * math.sqrt(max(place.axial_variance, place.lateral_variance, 0.0))
        along = blur + GUARD * math.sqrt(max(place.axial_variance, 0.0))
        if distance - unsure > c.radius:
            self._since_perhaps = math.nan
        elif math.isnan(self._since_perhaps):
            # without noise, the place before is surely outside
            self._since_perhaps = t if unsure == 0.0 and t - before <= gap else before
        if distance + unsure > c.radius or (t - before > gap and self.latest == math.inf):
            self._since_surely = math.nan
        if distance + unsure <= c.radius and math.isnan(self._since_surely):
            self._since_surely = t
        if t - self._since_perhaps >= c.dwell - _TICK:
            self.earliest = min(self.earliest, self._since_perhaps + c.dwell)
        if place.axial - along <= 0.0:
            self.earliest = min(self.earliest, t if along == 0.0 and t - before <= gap else before)
        if t - self._since_surely >= c.dwell - _TICK or place.axial + along <= 0.0:
            self.latest = min(self.latest, t)


class CaptureDetector:
    """Detector that evaluates one measured run up to its verdict; see docs/detection.md.

    Measurements may be noisy, wrong, missing or late, and in any order between the sources.  With
    noise, the path of the tip is smoothed.  A status then describes an instant up to
    ``detector.max_delay`` earlier, and decisions allow for the remaining noise.

    Parameters
    ----------
    scene
        Geometry of buffer and cone, and the criteria.
    is_released
        True if the run begins with the chaser's release, as simulated runs do.  Otherwise nothing
        is evaluated before the tip has approached BE by ``detector.capture_radius``.
    zero
        Stamp of t = 0 of the statuses, ns.  None: the last multiple of 1000 s before the first
        stamp.
    reorder
        Largest difference of stamps, ns, between messages of one source that arrive in the wrong
        order.  Every decision waits this long.  0: the messages of each source arrive in the order
        of their stamps, as from the simulator.
    last
        Time of the last instant that is evaluated, s.
    max_speed
        Largest relative speed of the vehicles at an impact, m/s, for the gate.  None: computed
        from the launch plan of the scene.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        is_released: bool = True,
        zero: int | None = 0,
        reorder: int = REORDER,
        last: float = math.inf,
        max_speed: float | None = None,
    ) -> None:
        part = scene.detector
        #: Numbers of measurements received by source, and of those rejected by source and reason.
        self.counts = Counts()
        #: Source whose clock differs most from the other clocks, and the difference, s.  None if
        #: the difference does not exceed :data:`WARN_OFFSET`.
        self.clock_offset: tuple[Source, float] | None = None
        #: Stamp of t = 0 of the statuses, ns.
        self.zero = 0 if zero is None else zero
        self._has_zero = zero is not None
        self._epoch, self._last_instant = self.zero, last
        self._sequencer = Sequencer(self.counts, reorder)
        self._clocks = ClockOffsets()
        self._clocks_compared = -_CLOCK_PERIOD  # ns, arrival
        self._withheld: list[Measurement] = []  # while clocks differ
        self._gates = {
            source: Gate(source, PoseLimits.of(scene, source), self.counts) for source in _POSES
        }
        self._max_speed = largest_speed(scene) if max_speed is None else max_speed
        self._aligner = Aligner(part.max_data_gap, self.counts)
        self._t_buffer = -math.inf  # s, time of the last buffer measurement
        self._scene = scene
        self._criteria = Criteria.of(scene)
        # on a real bench, a position that cameras report only briefly may be wrong
        self._outside_time = 0.0 if is_released else self._criteria.dwell
        memory = new_memory(has_approached=is_released)
        fields = zip(memory.dtype.names or (), *memory.tolist(), strict=True)
        self._memory = SimpleNamespace(**dict(fields))
        self._path = TipPath(
            radius=part.capture_radius,
            delay=part.max_delay,
            clean=part.max_contact_gap / 4.0,
            gap=part.max_data_gap,
            keep=_LONGEST_REST * part.min_still_time,
        )
        self._place: Place | None = None  # last evaluated position of the tip
        self._closest = ClosestApproach()
        self._t_rest_end = -math.inf  # s, the last instant before the approach
        self._t_gap_end = -math.inf  # s, the first instant after the last gap
        self._nearest_unseen = math.inf  # m, how near the tip may have come in a gap
        self._is_contact_unseen = False  # the tip may have met the cone in a gap
        self._last: tuple[Observation, MeasuredTip] | None = None
        self._capture = CaptureTimes(self._criteria)
        self._t_moving = -math.inf  # s, when the tip last was surely not at rest
        self._t_near = -math.inf  # s, when it last had surely not retreated
        self._earliest = math.inf  # s, when the present state may have begun
        self._noted = (math.nan, -1)  # begin (s) and cause of the state that it belongs to
        self._buffer_noise = (NoiseEstimate(), NoiseEstimate())
        self._buffer: deque[tuple[float, float, float]] = deque(maxlen=_N_AVERAGED)
        self._at_rest: deque[tuple[float, float]] = deque(maxlen=N_REST)  # m, rad
        self._n_at_rest, self._was_near = 0, False
        #: What the buffer's encoders show at rest, m and rad; it is subtracted.
        self.buffer_zero = (0.0, 0.0)

    @property
    def delay(self) -> float:
        """Present delay between an instant and its evaluation, s; 0 if there is no noise."""
        return self._path.half_window

    @property
    def behind(self) -> float:
        """Time from the last evaluated instant to the newest measurement, s.

        NaN if nothing was evaluated.
        """
        newest = self._sequencer.newest
        if newest is None or self._place is None:
            return math.nan
        return self._seconds(newest) - self._place.t

    @property
    def clocks_differ(self) -> bool:
        """True if a source's clock offset exceeds :data:`MAX_OFFSET`, which prevents a verdict."""
        return self.clock_offset is not None and abs(self.clock_offset[1]) > MAX_OFFSET

    @property
    def warnings(self) -> list[str]:
        """Present warnings for the operator, one line each."""
        lines = []
        if self.clock_offset:
            source, lead = self.clock_offset
            lines.append(
                f"{source.value}: clock {abs(lead):.3f} s {'ahead of' if lead > 0.0 else 'behind'} "
                "the other sources' (stamp less arrival): "
                + (
                    f"nothing is evaluated beyond {MAX_OFFSET:g} s"
                    if self.clocks_differ
                    else f"warned of beyond {WARN_OFFSET:g} s"
                )
            )
        if silent := self._sequencer.silent(STALE):
            names = " and ".join(source.value for source in silent)
            lines.append(
                f"nothing is evaluated: no measurement of the {names} for {STALE / 1e9:g} s"
            )
        if zero := zero_text(self.buffer_zero):
            lines.append(f"{Source.BUFFER.value}: {zero}")
        return [*lines, *self.counts.warnings]

    def measure(
        self, source: Source, stamp: int, values: Values, arrival: int | None = None
    ) -> list[CaptureStatus]:
        """Add a measurement of one source; return the statuses that it completes, in order.

        Parameters
        ----------
        source, values
            Source and its values, see :class:`Source`.
        stamp
            Time stamp, ns.
        arrival
            Time of arrival, ns by any clock.  None if the arrival gives no information about the
            source's clock, as in a simulation.
        """
        if arrival is not None:
            self._clocks.add(source, stamp, arrival)
            if arrival - self._clocks_compared >= _CLOCK_PERIOD:
                self._clocks_compared = arrival
                worst = self._clocks.worst()
                self.clock_offset = worst if worst and abs(worst[1]) > WARN_OFFSET else None
        if not self.counts.received:
            self._set_epoch(stamp)
        return self._take(self._sequencer.add(source, stamp, values))

    def finish(self, *, cut: bool = False, has_end: bool = True) -> list[CaptureStatus]:
        """Close the run; return the remaining statuses, ending with the final one.

        The last status belongs to the last measurement; its state is a verdict or undecided.  It
        is final unless the run was cut before a verdict.  If nothing was measured, the measured
        quantities are NaN and the time is the earliest stamp.

        Parameters
        ----------
        cut
            True if the run was ended early.
        has_end
            False for a recording that lacks the end of its run.  A tip that still moves at the end
            of such a recording gives no verdict.
        """
        remaining = self._take(self._sequencer.finish())
        if not self.clocks_differ:
            for source, gate in self._gates.items():
                for pose in gate.finish():
                    self._aligner.add(source, *pose)
            remaining += self._update_all(self._aligner.complete(None))
        memory = self._memory
        if self._last is None:
            memory.state, memory.cause = CaptureState.UNDECIDED, Cause.NOT_MEASURED
            if self.clocks_differ:
                self._blame_clocks()
            unknown = (math.nan,) * 3
            first = self._sequencer.first
            memory.since = 0.0 if first is None else self._seconds(first)
            observation = Observation(memory.since, unknown, unknown, unknown[:2])
            return [self._status(observation, self._tip(observation), is_over=not cut, is_end=True)]
        for place in self._path.finish():
            self._evaluate(place)
        last = self._place
        if self._state.is_verdict:
            pass
        elif self.clocks_differ:
            self._blame_clocks()
        elif last is None:  # too few measurements to estimate the noise and detect an approach
            memory.state, memory.cause = CaptureState.UNDECIDED, Cause.NOT_APPROACHED
            memory.since = self._last[0].t
        elif self._state <= CaptureState.CONTACT:
            if last.size > 1:
                # a fit is least accurate at its end, so fit the last still_time once more
                end = self._path.fit(last.t, last.t - self._criteria.still_time, last.t, 1)
                memory.outwards = end.axial * end.axial_rate + end.lateral * end.lateral_rate
                memory.speed = math.hypot(end.axial_rate, end.lateral_rate)
                memory.distance = math.hypot(end.axial, end.lateral)
            # if a source stopped before the end, the rest of the run is unknown
            newest = self._sequencer.newest
            is_blind = newest is not None and self._seconds(newest) - last.t > self._path.gap
            lacks_end = not has_end and (cut or memory.speed >= self._criteria.still_speed)
            ended_early = cut or is_blind or lacks_end
            _decide_at_end(self._criteria, memory, self._corner_time, ended_early)
            self._doubt_miss()
            if lacks_end and memory.cause in (Cause.END_BEFORE_CONTACT, Cause.END_AFTER_CONTACT):
                memory.cause = Cause.NO_END
        self._note_earliest(math.inf)
        return [*remaining, self._status(*self._last, is_over=not cut, is_end=True)]

    def update(self, observation: Observation) -> CaptureStatus:
        """Add measurements of all sources at one instant, later than the last; return the status.

        This is the part of the pipeline after the gates and the aligner.
        """
        tip = self._tip(observation)
        self._note_zero(observation, tip)
        if any(self.buffer_zero):
            observation = self._from_zero(observation)
            tip = self._tip(observation)
        if self._last is None:
            self._memory.since = observation.t  # a bench's clock may count from 1970
        self._last = (observation, tip)
        self._buffer.append((observation.t, observation.buffer[0], observation.buffer[1]))
        if self._state is CaptureState.APPROACH and self._pushed():
            _note_push(self._criteria, self._memory, observation.t, *tip.place)
        places = self._path.add(
            observation.t, tip, self._buffer_scatter(), self._quantisation_noise()
        )
        for place in places:
            self._evaluate(place)
        return self._status(observation, tip)

    def _note_zero(self, observation: Observation, tip: MeasuredTip) -> None:
        """Update the zero of the buffer while the tip is ahead of the cone's mouth.

        Once the tip has been in it in the approach, the zero stays as it is.
        """
        if self._was_near and self._memory.has_approached:
            return
        is_away = tip.rigid[0] > self._scene.cone.mouth + AWAY
        self._was_near = not is_away
        if is_away:
            self._at_rest.append((observation.buffer[0], observation.buffer[1]))
            self._n_at_rest += 1
        if not is_away or self._n_at_rest % MIN_REST == 0:
            self.buffer_zero = zero_of(list(self._at_rest), self._criteria.rest_length)

    def _from_zero(self, observation: Observation) -> Observation:
        stroke, torsion, *rates = observation.buffer
        zero = self.buffer_zero
        return observation._replace(buffer=(stroke - zero[0], torsion - zero[1], *rates))

    @property
    def _state(self) -> CaptureState:
        return CaptureState(int(self._memory.state))

    def _set_epoch(self, first: int) -> None:
        """Set the origin of times near the first stamp, where floats resolve 1 ns."""
        if not self._has_zero:
            self.zero = self._epoch = first // _EPOCH * _EPOCH
        elif abs(first - self.zero) > _EPOCH:
            self._epoch = self.zero + (first - self.zero) // _EPOCH * _EPOCH

    def _seconds(self, stamp: int) -> float:
        return (stamp - self._epoch) / 1e9

    def _take(self, measurements: list[Measurement]) -> list[CaptureStatus]:
        """Pass measurements, in the order of their stamps, through the gates and the aligner."""
        if self.clocks_differ:
            self._withheld += measurements
            return []
        if self._withheld:
            measurements, self._withheld = [*self._withheld, *measurements], []
        if not measurements:
            return []
        chaser, target = (self._gates[source] for source in _POSES)
        for stamp, source, values in measurements:
            t = self._seconds(stamp)
            if source is Source.BUFFER:
                self._aligner.add(source, t, values)
                self._t_buffer = t
                continue
            speed = math.dist(chaser.velocity[:2], target.velocity[:2])
            gate = self._gates[source]
            for pose in gate.add(t, values, max(speed, self._max_speed)):
                self._aligner.add(source, *pose)
        decided = {Source.TARGET: target.decided, Source.BUFFER: self._t_buffer}
        return self._update_all(self._aligner.complete(decided))

    def _update_all(self, observations: Iterable[Observation]) -> list[CaptureStatus]:
        limit = self._last_instant + (self.zero - self._epoch) / 1e9
        return [self.update(each) for each in observations if each.t <= limit]

    def _blame_clocks(self) -> None:
        assert self.clock_offset is not None
        memory = self._memory
        memory.state, memory.cause = CaptureState.UNDECIDED, Cause.CLOCKS_DIFFER
        memory.value = abs(self.clock_offset[1])

    @property
    def _corner_time(self) -> float:
        """Length that a fitted parabola cuts off the corner of a hit in the path, m per m/s.

        The length is 3/16 of the change of velocity times the window.
        """
        return 3.0 / 16.0 * 2.0 * self._path.half_window

    def _evaluate(self, place: Place) -> None:
        """Evaluate the criteria at the next place of the tip."""
        if not (self._memory.has_approached or self._path.knows_noise):
            return  # noise could be mistaken for an approach
        if not self._memory.has_approached:
            self._t_rest_end = place.t
        before = self._place
        is_after_gap = before is not None and place.t - before.t > self._path.gap
        if before is not None and is_after_gap:
            self._note_gap(before, place)
        self._note_jump(place)
        criteria, is_still = self._criteria, False
        if place.size > 1 and self._state <= CaptureState.CONTACT:
            # the mean speed over a longer time has a smaller standard deviation
            for times in (1.0, _LONGEST_REST):
                begin = place.t - times * criteria.still_time
                if begin < max(self._t_rest_end, self._t_gap_end):
                    break  # the interval includes the rest before the release, or a gap
                speed, deviation = self._path.rate_over(begin, place.t)
                is_still = is_still or speed + GUARD * deviation < criteria.still_speed
                if times == 1.0 and speed - GUARD * deviation > criteria.still_speed:
                    self._t_moving = place.t
        _decide(criteria, self._memory, place, is_still, self._corner_time, self._outside_time)
        self._note_closest(place)
        passed = self._memory.cause in (Cause.PASSED_THROAT, Cause.PASSED_BESIDE)
        if before is not None and is_after_gap and passed and self._memory.since == place.t:
            # the tip passed BE in the gap: interpolate the time, as decide does the position
            share = before.axial / (before.axial - place.axial)
            self._memory.since = before.t + share * (place.t - before.t)
        self._doubt_miss()
        if self._memory.has_approached:
            gap = self._path.gap
            blur = self._corner_time * math.hypot(place.axial_rate, place.lateral_rate)
            last = -math.inf if before is None else before.t
            self._capture.add(place, self._memory.distance, last, gap, blur)
        is_sampled = place.size == 1 and before is not None and not is_after_gap
        self._note_earliest(math.inf if is_sampled else -math.inf if before is None else before.t)
        retreat = self._memory.distance - self._memory.nearest_now
        unsure = math.sqrt(max(place.axial_variance, place.lateral_variance, 0.0))
        # the closest approach of a bounce is a corner of the path
        blur = self._corner_time * self._memory.fastest
        if retreat + GUARD * unsure + blur <= criteria.leave:
            self._t_near = place.t
        self._place = place

    def _note_earliest(self, before: float) -> None:
        """Note when a new state may have begun: after ``before``, s, the place before it."""
        memory = self._memory
        now = (float(memory.since), int(memory.cause))
        if now == self._noted:
            return
        self._noted = now
        if memory.cause == Cause.AT_REST and math.isfinite(before):
            before = min(before, self._t_moving)
        if memory.cause in (Cause.RETREATED, Cause.MOVED_AWAY) and math.isfinite(before):
            before = min(before, self._t_near)
        if memory.cause == Cause.STAYED:
            before = -math.inf
        elif not memory.has_approached or self._state is CaptureState.APPROACH:
            before = math.inf
        self._earliest = before

    def _note_closest(self, place: Place) -> None:
        """Update the closest approach; store it for the reason of a verdict that refers to it."""
        memory = self._memory
        if not memory.has_approached:
            self._closest = ClosestApproach()  # the approach has not begun
        if place.size > 1:
            self._closest.add(self._path.halves(place.t))
        else:
            self._closest.add_exact(memory.distance)
        if memory.since == place.t and memory.cause in (Cause.RETREATED, Cause.MOVED_AWAY):
            memory.value, _ = self._closest.estimate

    def _note_jump(self, place: Place) -> None:
        """Set the state to undecided if a vehicle has jumped to a new position during the trial."""
        memory, before = self._memory, -math.inf if self._place is None else self._place.t
        for gate in self._gates.values():
            jump = gate.jump
            if (
                jump is not None
                and before < jump.t <= place.t + self._path.half_window
                and memory.has_approached
                and self._state <= CaptureState.CONTACT
            ):
                _enter(memory, CaptureState.UNDECIDED, Cause.JUMPED, jump.t, jump.distance)

    def _note_gap(self, before: Place, after: Place) -> None:
        """Record that the tip's path between two positions is unknown."""
        memory, criteria = self._memory, self._criteria
        memory.zone_since = memory.still_since = memory.outside_since = math.nan
        self._t_gap_end = after.t
        far = math.hypot(before.axial, before.lateral) + math.hypot(after.axial, after.lateral)
        nearest = 0.5 * (far - memory.fastest * (after.t - before.t))
        self._nearest_unseen = min(self._nearest_unseen, nearest)
        wall_distance = _wall_gap(criteria, before.axial, before.lateral)[0]
        if wall_distance > memory.fastest * (after.t - before.t):
            return  # too far away to have met the cone
        if self._state is not CaptureState.APPROACH or not memory.has_approached:
            return
        unseen = self._aligner.values_between(Source.BUFFER, before.t, after.t)
        zero = self.buffer_zero
        strokes = [(stroke - zero[0], torsion - zero[1]) for stroke, torsion, *_ in unseen]
        if any(self._is_pushed(strokes[: k + 1]) for k in range(len(strokes))):
            _enter(memory, CaptureState.CONTACT, Cause.AT_CONE, after.t, 0.0)
        else:
            self._is_contact_unseen = True

    def _doubt_miss(self) -> None:
        """Change a miss to undecided if the tip may have touched the cone in a gap."""
        memory = self._memory
        is_doubtful = memory.cause in (Cause.MOVED_AWAY, Cause.END_NOT_APPROACHING)
        if self._is_contact_unseen and self._state is CaptureState.MISSED and is_doubtful:
            _enter(
                memory, CaptureState.UNDECIDED, Cause.CONTACT_UNSEEN, memory.since, memory.nearest
            )

    def _pushed(self) -> bool:
        """Update the noise of the buffer at rest; return True if the buffer has been pushed."""
        if len(self._buffer) >= 4:
            four = list(self._buffer)[-4:]
            weights = third_difference([t for t, _, _ in four])
            for i, noise in enumerate(self._buffer_noise):
                noise.add(sum(w * item[1 + i] for w, item in zip(weights, four, strict=True)))
        return self._is_pushed([(stroke, torsion) for _, stroke, torsion in self._buffer])

    def _is_pushed(self, values: list[tuple[float, float]]) -> bool:
        """Return True if the last of these pairs of stroke (m) and torsion (rad) show a push."""
        if not self._buffer_noise[0].known:
            return False
        limit, arm = self._criteria.contact_gap, self._criteria.rest_length
        stroke, torsion = values[-1]
        scatter = max(self._buffer_scatter())
        if BUFFER_GUARD * scatter >= limit:
            # a single measurement is too noisy, so use the mean of several
            if len(values) < _N_AVERAGED:
                return False
            stroke, torsion = (mean(column) for column in zip(*values[-_N_AVERAGED:], strict=True))
            scatter /= math.sqrt(_N_AVERAGED)
        return max(abs(stroke), abs(torsion) * arm) > limit + BUFFER_GUARD * scatter

    def _buffer_scatter(self) -> tuple[float, float]:
        """Return the axial and lateral standard deviations of the tip due to buffer noise, m."""
        stroke, torsion = (noise.deviation for noise in self._buffer_noise)
        return stroke, torsion * self._criteria.rest_length

    def _quantisation_noise(self) -> float:
        """Return the standard deviation of the tip due to the steps of quantised poses, m."""
        (chaser, chaser_turn), (target, target_turn) = (
            self._gates[source].resolution for source in _POSES
        )
        arm = self._criteria.a + self._criteria.rest_length
        turns = chaser_turn * arm, target_turn * self._scene.cone.L_T
        return math.hypot(chaser, target, *turns) / math.sqrt(12.0)

    def _tip(self, observation: Observation) -> MeasuredTip:
        """Return the tip in the cone's frame from the measured poses and buffer."""
        a, h_0, front = self._criteria.a, self._criteria.rest_length, self._scene.cone.L_T
        chaser, target, (stroke, torsion) = (
            observation.chaser[:3],
            observation.target[:3],
            observation.buffer[:2],
        )
        theta, phi, theta_T = chaser[2], chaser[2] + torsion, target[2]
        rates: Values = (0.0,) * 8
        if observation.has_rates:
            stroke_rate, torsion_rate = observation.buffer[2:]
            rates = (
                *observation.chaser[3:],
                observation.chaser[5] + torsion_rate,
                stroke_rate,
                *observation.target[3:],
            )
        sS, cS, sT, cT = math.sin(theta), math.cos(theta), math.sin(theta_T), math.cos(theta_T)
        sines = (sS, cS, math.sin(phi), math.cos(phi), sT, cT)
        px, py, wx, wy = _tip_motion((*chaser, phi, h_0 + stroke, *target, *rates), a, *sines)
        at_rest = (*chaser, theta, h_0, *target, *rates)
        bx, by, _, _ = _tip_motion(at_rest, a, sS, cS, sS, cS, sT, cT)
        rate = (-wx, wy) if observation.has_rates else None
        return MeasuredTip((-(px + front), py), (-(bx + front), by), rate)

    def _status(
        self,
        observation: Observation,
        tip: MeasuredTip,
        *,
        is_over: bool = False,
        is_end: bool = False,
    ) -> CaptureStatus:
        rate, place, memory = tip.rate, self._place, self._memory
        nearest, deviation = self._closest.estimate
        if self._nearest_unseen < nearest and math.isfinite(deviation):
            nearest, deviation = nearest + GUARD * deviation, math.inf
        if place is not None and (rate is None or place.size > 1):
            rate = (place.axial_rate, place.lateral_rate)
        earliest, latest = self._earliest, float(memory.since)
        if self._state is CaptureState.CAPTURED and memory.cause != Cause.STAYED:
            earliest, latest = min(earliest, self._capture.earliest), self._capture.latest
        return CaptureStatus(
            t=observation.t + (self._epoch - self.zero) / 1e9,
            state=self._state,
            final=is_over or self._criteria.is_final(self._state),
            distance=math.hypot(*tip.place),
            axial_offset=tip.place[0],
            lateral_offset=tip.place[1],
            relative_attitude=_wrapped_angle(observation.chaser[2] - observation.target[2]),
            relative_speed=math.nan if rate is None else math.hypot(*rate),
            nearest_distance=nearest,
            time_in_state=observation.t - float(memory.since),
            reason=reason(self._criteria, int(memory.cause), float(memory.value)),
            not_used=self.counts.text if is_end else "",
            nearest_deviation=deviation,
            may_precede=max(float(memory.since) - earliest, 0.0),
            may_follow=max(latest - float(memory.since), 0.0),
        )


_POSES = (Source.CHASER, Source.TARGET)
