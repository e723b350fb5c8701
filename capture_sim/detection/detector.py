"""The capture detector for measurements: one pipeline from messages to statuses.

measurements -> sequencer (order of stamps) -> gates (poses that a vehicle can have had) -> aligner
(common instants) -> smoother (path of the tip) -> criteria -> statuses.

Behind the sequencer everything is a function of stamps and values, so the live detector and
`capture-sim detect` give the same statuses for the same messages.
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
from capture_sim.scene.geometry import tip_motion
from capture_sim.scene.parts import Scene

#: Number of measurements of the buffer that are averaged if a single one is too noisy.
_N_AVERAGED = 12
#: Deflection of a pushed buffer in standard deviations: a single measurement of many decides.
BUFFER_GUARD = 6.0
#: If speeds are noisy, rest is also evaluated over this many ``still_time``.
_LONGEST_REST = 4.0
#: A source whose last stamp is older than the others' by this is reported, ns.
STALE = 2_000_000_000
#: Period of the comparison of the sources' clocks, ns (wall).
_CLOCK_PERIOD = 100_000_000
#: Times are counted from a multiple of this, ns: small numbers, equal whenever a trial begins.
_EPOCH = 1_000_000_000_000

# a few hundred measurements a second: not worth compiled functions of their own
_tip_motion, _decide, _note_push = plain(tip_motion), plain(decide), plain(note_push)
_enter, _wall_gap, _decide_at_end = plain(enter), plain(wall_gap), plain(decide_at_end)
_wrapped_angle = plain(wrapped_angle)


class CaptureDetector:
    """Follows one run, as it is measured, to a verdict; see docs/detection.md.

    Measurements may be noisy, wrong, missing, late and in any order between the sources.  With
    noise the path is smoothed: then a status is about an instant up to ``detector.max_delay``
    before, and decisions allow for the remaining noise.

    Parameters
    ----------
    scene
        Geometry of buffer and cone, and the criteria.
    is_released
        True if the run begins with the chaser's release, as simulated ones do.  Otherwise nothing
        is evaluated before the tip has approached BE by ``detector.capture_radius``.
    zero
        Stamp of t = 0 of the statuses, ns; None: a multiple of 1000 s before the first stamp.
    reorder
        Messages of a source may be overtaken by later ones of the source by up to this, ns; every
        decision waits for it.  0: they come in the order of their stamps, as from the simulator.
    last
        No later instant is evaluated, s.
    max_speed
        Largest relative speed of the vehicles at an impact, m/s, for the gate; None: by the plan of
        the scene's launch.
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
        #: Measurements received and not used, by source and reason.
        self.counts = Counts()
        #: The source whose clock differs from the others' by more than :data:`WARN_OFFSET`, and
        #: by how much, s; None if none does.
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
        self._t_buffer = -math.inf  # s, the last measurement of the buffer
        self._scene = scene
        self._criteria = Criteria.of(scene)
        # what cameras show of a bench for a moment only may be wrong
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
        self._place: Place | None = None  # the last that was evaluated
        self._closest = ClosestApproach()
        self._t_rest_end = -math.inf  # s, the last instant before the approach
        self._t_gap_end = -math.inf  # s, the first instant after the last gap
        self._is_contact_unseen = False  # the tip may have met the cone in a gap
        self._last: tuple[Observation, MeasuredTip] | None = None
        self._buffer_noise = (NoiseEstimate(), NoiseEstimate())
        self._buffer: deque[tuple[float, float, float]] = deque(maxlen=_N_AVERAGED)

    @property
    def delay(self) -> float:
        """Present delay between an instant and its evaluation, s; 0 without noise."""
        return self._path.half_window

    @property
    def behind(self) -> float:
        """Time from the last instant that was evaluated to the newest measurement, s.

        NaN if nothing was evaluated.
        """
        newest = self._sequencer.newest
        if newest is None or self._place is None:
            return math.nan
        return self._seconds(newest) - self._place.t

    @property
    def clocks_differ(self) -> bool:
        """True if the sources' clocks differ by too much for a verdict."""
        return self.clock_offset is not None and abs(self.clock_offset[1]) > MAX_OFFSET

    @property
    def warnings(self) -> list[str]:
        """Present warnings for an operator, one line each."""
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
        return [*lines, *self.counts.warnings]

    def measure(
        self, source: Source, stamp: int, values: Values, arrival: int | None = None
    ) -> list[CaptureStatus]:
        """Add a measurement of one source; return the statuses that it completes, in order.

        Parameters
        ----------
        source, values
            See :class:`Source`.
        stamp
            ns.
        arrival
            Time of arrival, ns by any clock; None if it shows nothing about the source's clock, as
            in a simulation.
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

        The last status is at the last measurement: a verdict, or undecided.  It is final, unless a
        run that was cut has no verdict.  If nothing was measured, its numbers are NaN and its time
        is the earliest stamp.  ``cut`` is True if the run was ended early.  ``has_end`` is False
        for a recording without the end of its run, where a moving tip proves nothing.
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
        elif last is None:  # too few measurements to know the noise, and so an approach
            memory.state, memory.cause = CaptureState.UNDECIDED, Cause.NOT_APPROACHED
            memory.since = self._last[0].t
        elif self._state <= CaptureState.CONTACT:
            if last.size > 1:
                # the end of a fit is its least certain position: fit the last second once more
                end = self._path.fit(last.t, last.t - self._criteria.still_time, last.t, 1)
                memory.outwards = end.axial * end.axial_rate + end.lateral * end.lateral_rate
                memory.speed = math.hypot(end.axial_rate, end.lateral_rate)
                memory.distance = math.hypot(end.axial, end.lateral)
            # a source that stopped before the end: the rest of the run is unknown
            newest = self._sequencer.newest
            is_blind = newest is not None and self._seconds(newest) - last.t > self._path.gap
            lacks_end = not has_end and (cut or memory.speed >= self._criteria.still_speed)
            ended_early = cut or is_blind or lacks_end
            _decide_at_end(self._criteria, memory, self._corner_time, ended_early)
            self._doubt_miss()
            if lacks_end and memory.cause in (Cause.END_BEFORE_CONTACT, Cause.END_AFTER_CONTACT):
                memory.cause = Cause.NO_END
        return [*remaining, self._status(*self._last, is_over=not cut, is_end=True)]

    def update(self, observation: Observation) -> CaptureStatus:
        """Add measurements of all sources at one instant, later than the last; return the status.

        This is the part of the pipeline behind gates and aligner.
        """
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

    @property
    def _state(self) -> CaptureState:
        return CaptureState(int(self._memory.state))

    def _set_epoch(self, first: int) -> None:
        """Let times count from near the first stamp, as floats are exact to 1 ns only there."""
        if not self._has_zero:
            self.zero = self._epoch = first // _EPOCH * _EPOCH
        elif abs(first - self.zero) > _EPOCH:
            self._epoch = self.zero + (first - self.zero) // _EPOCH * _EPOCH

    def _seconds(self, stamp: int) -> float:
        return (stamp - self._epoch) / 1e9

    def _take(self, measurements: list[Measurement]) -> list[CaptureStatus]:
        """Pass measurements in the order of their stamps through gates and aligner."""
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
        """Length by which a parabola shortens the corner of a hit in the path, m per m/s.

        That is 3/16 of the change of velocity times the window.
        """
        return 3.0 / 16.0 * 2.0 * self._path.half_window

    def _evaluate(self, place: Place) -> None:
        """Evaluate the criteria at the next place of the tip."""
        if not (self._memory.has_approached or self._path.knows_noise):
            return  # noise would be taken for an approach
        if not self._memory.has_approached:
            self._t_rest_end = place.t
        before = self._place
        is_after_gap = before is not None and place.t - before.t > self._path.gap
        if before is not None and is_after_gap:
            self._note_gap(before, place)
        self._note_jump(place)
        criteria, is_still = self._criteria, False
        if place.size > 1 and self._state <= CaptureState.CONTACT:
            # the mean speed over a longer time is known better
            for times in (1.0, _LONGEST_REST):
                begin = place.t - times * criteria.still_time
                if begin < max(self._t_rest_end, self._t_gap_end):
                    break  # it includes the rest before the release, or a gap
                speed, deviation = self._path.rate_over(begin, place.t)
                is_still = is_still or speed + GUARD * deviation < criteria.still_speed
        _decide(criteria, self._memory, place, is_still, self._corner_time, self._outside_time)
        self._note_closest(place)
        passed = self._memory.cause in (Cause.PASSED_THROAT, Cause.PASSED_BESIDE)
        if before is not None and is_after_gap and passed and self._memory.since == place.t:
            # it passed BE in the gap: when is interpolated, as the place of the crossing is
            share = before.axial / (before.axial - place.axial)
            self._memory.since = before.t + share * (place.t - before.t)
        self._doubt_miss()
        self._place = place

    def _note_closest(self, place: Place) -> None:
        """Update the closest approach, and name it in the reason of a verdict that came of it."""
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
        """End the evaluation if a vehicle has jumped to a new place during the trial."""
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
        """Note that the tip's path between two positions is unknown."""
        memory, criteria = self._memory, self._criteria
        memory.zone_since = memory.still_since = memory.outside_since = math.nan
        self._t_gap_end = after.t
        wall_distance = _wall_gap(criteria, before.axial, before.lateral)[0]
        if wall_distance > memory.fastest * (after.t - before.t):
            return  # too far away to have met the cone
        if self._state is not CaptureState.APPROACH or not memory.has_approached:
            return
        unseen = self._aligner.values_between(Source.BUFFER, before.t, after.t)
        strokes = [(stroke, torsion) for stroke, torsion, *_ in unseen]
        if any(self._is_pushed(strokes[: k + 1]) for k in range(len(strokes))):
            _enter(memory, CaptureState.CONTACT, Cause.AT_CONE, after.t, 0.0)
        else:
            self._is_contact_unseen = True

    def _doubt_miss(self) -> None:
        """Turn a miss into undecided if the tip may have met the cone in a gap."""
        memory = self._memory
        is_doubtful = memory.cause in (Cause.MOVED_AWAY, Cause.END_NOT_APPROACHING)
        if self._is_contact_unseen and self._state is CaptureState.MISSED and is_doubtful:
            _enter(
                memory, CaptureState.UNDECIDED, Cause.CONTACT_UNSEEN, memory.since, memory.nearest
            )

    def _pushed(self) -> bool:
        """Update the buffer's noise while it is at rest; return True if it has been pushed."""
        if len(self._buffer) >= 4:
            four = list(self._buffer)[-4:]
            weights = third_difference([t for t, _, _ in four])
            for i, noise in enumerate(self._buffer_noise):
                noise.add(sum(w * item[1 + i] for w, item in zip(weights, four, strict=True)))
        return self._is_pushed([(stroke, torsion) for _, stroke, torsion in self._buffer])

    def _is_pushed(self, values: list[tuple[float, float]]) -> bool:
        """Return True if the last of these strokes (m) and torsions (rad) show a push."""
        if not self._buffer_noise[0].known:
            return False
        limit, arm = self._criteria.contact_gap, self._criteria.rest_length
        stroke, torsion = values[-1]
        scatter = max(self._buffer_scatter())
        if BUFFER_GUARD * scatter >= limit:
            # a single measurement is too noisy: take the mean of several
            if len(values) < _N_AVERAGED:
                return False
            stroke, torsion = (mean(column) for column in zip(*values[-_N_AVERAGED:], strict=True))
            scatter /= math.sqrt(_N_AVERAGED)
        return max(abs(stroke), abs(torsion) * arm) > limit + BUFFER_GUARD * scatter

    def _buffer_scatter(self) -> tuple[float, float]:
        """Return the contribution of the buffer's noise to the tip's noise, m."""
        stroke, torsion = (noise.deviation for noise in self._buffer_noise)
        return stroke, torsion * self._criteria.rest_length

    def _quantisation_noise(self) -> float:
        """Return the standard deviation of the tip from the steps of quantised poses, m."""
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
        if place is not None and (rate is None or place.size > 1):
            rate = (place.axial_rate, place.lateral_rate)
        return CaptureStatus(
            t=observation.t + (self._epoch - self.zero) / 1e9,
            state=self._state,
            final=is_over or self._state.is_verdict,
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
        )


_POSES = (Source.CHASER, Source.TARGET)
