"""Interlocks: conditions on the measurements before a release and during the approach.

:class:`Interlocks` receives each pose and buffer state; every release of the chaser depends on it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from statistics import median

from capture_sim.detection.measurements import Source
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import Range, quantity
from capture_sim.trial.emergency_stop import EmergencyStop
from capture_sim.trial.hold import HoldPublishers, HoldReaders
from capture_sim.trial.jumps import JumpWatch
from capture_sim.trial.rest import BUFFER_LIMITS, POSE_LIMITS, HeldWatch, Pose, Rest
from capture_sim.trial.starts import (
    differences,
    nearest_other,
    relative,
    shown,
    start_of,
    tolerances,
)

#: If a stamp is older than the previous stamp by more than this, the clock was set back, s.
MAX_STEP_BACK = 0.5
#: Number of such steps back within a window, s, that show two publishers on one topic.
MIN_STEPS_BACK, STEP_WINDOW = 3, 1.0
#: Length, s, and number of the latest periods from which a source's rate and clock are computed.
PERIOD, N_PERIODS = 0.1, 10
#: Number of consecutive messages that must show a clock step: a single stamp may be an outlier.
N_STEPPED = 5
#: A source that is silent for longer between release and verdict is a problem of the trial, s.
MAX_SILENCE = 1.0

#: Sources of poses.
VEHICLES = (Source.CHASER, Source.TARGET)
#: A check of plausibility must not be older before a release, s, and what it means if it is.
MAX_CHECK_AGE = 3.0
OVERLOAD = "this machine is overloaded: end other programs"
#: Maximum stroke, m, and torsion, rad, of a buffer at rest.
MAX_REST_STROKE, MAX_REST_TORSION = 0.003, 0.05

#: Release rules that a laboratory may waive by name, and the condition of each.
RULES = {
    "machine_clock": "the sources' clocks agree with this machine's",
    "start": "both bodies are where the scene starts, and nearer to it than to any other scene",
    "buffer_rest": "the buffer is at rest, near its rest length",
    "rates": "each source sends often enough",
    "standstill": "the chaser is at rest",
    "target_standstill": "the target is at rest",
}


@dataclass(frozen=True)
class TrialLimits:
    """Limits of a trial; each is a parameter of the launcher."""

    max_pose_age: float = quantity(
        "s",
        Range(0.02, 10.0),
        default=0.3,
        doc="time without a new pose of a vehicle: an approach is aborted; before a release, "
        "rest is checked, which permits 0.1 s",
    )
    max_buffer_age: float = quantity(
        "s",
        Range(0.0, 10.0),
        default=0.3,
        doc="time without a new buffer state: nothing is released; 0.0: no buffer is needed",
    )
    max_hold_silence: float = quantity(  # drivers hold after 0.5 s
        "s",
        Range(0.15, 10.0),
        default=0.4,
        doc="wall time without launcher/hold, as of a stalled computer: an approach is aborted",
    )
    start_timeout: float = quantity(
        "s",
        Range(0.0, 3600.0),
        default=10.0,
        doc="wall time, wait for fresh measurements and for the other nodes before a release",
    )
    time_limit: float = quantity(
        "s",
        Range(1.0, 86400.0),
        default=60.0,
        doc="wall time from the release to the end of a trial without verdict",
    )
    after_verdict: float = quantity(
        "s",
        Range(0.0, 3600.0),
        default=1.0,
        doc="wall time from the verdict to the end of the trial",
    )
    closing_timeout: float = quantity(
        "s",
        Range(0.1, 600.0),
        default=10.0,
        doc="wall time, wait for verdict and recording after the end of a trial",
    )
    stop_timeout: float = quantity(
        "s",
        Range(0.5, 60.0),
        default=3.0,
        doc="wall time in which a chaser must stop once it is held: else nothing is let go",
    )
    max_clock_error: float = quantity(
        "s",
        Range(0.0, 3600.0),
        default=1.0,
        doc="difference of the sources' clocks from this machine's: nothing is released beyond it",
    )
    min_rate: float = quantity(
        "Hz",
        Range(0.0, 10_000.0),
        default=10.0,
        doc="new measurements of each source: nothing is released below it",
    )

    require_emergency_stop: bool = quantity(
        "",
        default=False,
        doc="let a chaser go only while emergency_stop reports that it is not pressed",
    )
    max_emergency_stop_silence: float = quantity(
        "s",
        Range(0.05, 60.0),
        default=1.0,
        doc="time without emergency_stop, if it is required: nothing is released, a trial aborted",
    )


class SourceMonitor:
    """Monitors the messages of one topic.

    A message with a non-finite number, or with a stamp that does not advance, contains no new
    measurement: its driver has lost sight of the vehicle and repeats the last measurement.
    """

    def __init__(self) -> None:
        self.n_messages = 0
        self._empty, self._emptied = "", -math.inf  # why the last one had no measurement; s
        self._stamp: int | None = None  # ns
        self._values: tuple[float, ...] = ()
        self._last_new = -math.inf  # s, arrival of the last new measurement
        self._last_change = -math.inf  # s, arrival of the last measurement with changed values
        self._steps_back: deque[float] = deque(maxlen=MIN_STEPS_BACK)  # arrivals, s
        # for each period: start (s), number of messages, largest stamp minus arrival (s)
        self._periods: deque[tuple[float, int, float]] = deque(maxlen=N_PERIODS + 1)
        self._latest: deque[float] = deque(maxlen=N_STEPPED)  # stamp minus arrival, s
        self._reference = math.nan  # s, clock at the release
        self._stepped_back = False  # a stamp has stepped back since the release
        self._quickest = -math.inf  # s, largest stamp minus arrival since a step back

    def add(self, stamp: int, values: tuple[float, ...], arrival: float) -> bool:
        """Note a message: its stamp, ns by any clock, and its arrival, s by a steady clock.

        Return True if the message contains a new measurement.
        """
        advance = math.inf if self._stamp is None else (stamp - self._stamp) * 1e-9
        if stamp == 0:
            return self.add_empty("their stamp is 0, i.e. not set", arrival)
        if not all(map(math.isfinite, values)):
            return self.add_empty("their values are not finite, or their quaternion is 0", arrival)
        if -MAX_STEP_BACK <= advance <= 0.0:
            return self.add_empty("their stamp does not advance", arrival)
        self.n_messages += 1
        if advance < 0.0:
            self._steps_back.append(arrival)
            self._stepped_back = True
            self._quickest = -math.inf
        self._stamp, self._last_new = stamp, arrival
        offset = stamp * 1e-9 - arrival
        self._latest.append(offset)
        self._quickest = max(self._quickest, offset)
        begin, count, quickest = self._periods[-1] if self._periods else (-math.inf, 0, 0.0)
        if arrival < begin + PERIOD:
            self._periods[-1] = begin, count + 1, max(quickest, offset)
        else:
            self._periods.append((arrival, 1, offset))
        if values != self._values:
            self._values, self._last_change = values, arrival
        return True

    def add_empty(self, reason: str, arrival: float) -> bool:
        """Note a message without a measurement; return False.  ``reason``: what such messages have.

        A message at the time of a stamp that has been measured already, e.g. each pose twice, is no
        news as long as others bring new ones.
        """
        self.n_messages += 1
        self._empty, self._emptied = reason, arrival
        return False

    def emptiness(self, now: float) -> str:
        """Return why the messages that arrive give no measurement; empty if none arrive."""
        return self._empty if self._emptied > max(self._last_new, now - STEP_WINDOW) else ""

    def age(self, now: float) -> float:
        """Return the time since the last new measurement, s; ``inf`` before the first."""
        return now - self._last_new

    def has_two_clocks(self, now: float) -> bool:
        """Return True if the stamps jump back and forth, as from two publishers."""
        steps = self._steps_back
        return len(steps) == MIN_STEPS_BACK and steps[0] > now - STEP_WINDOW

    def rate(self, now: float) -> float:
        """Return the rate of new measurements, Hz; NaN while it is unknown."""
        periods = [p for p in self._periods if p[0] >= now - (N_PERIODS + 1) * PERIOD]
        span = now - periods[0][0] if periods else 0.0
        return sum(p[1] for p in periods) / span if span > 5.0 * PERIOD else math.nan

    def clock(self, now: float) -> float:
        """Return the source's clock minus the clock of the arrivals, s; NaN while it is unknown.

        This is the largest stamp minus arrival of the latest periods, i.e. of the message with the
        shortest delay.
        """
        periods = [p for p in self._periods if p[0] >= now - (N_PERIODS + 1) * PERIOD]
        enough = sum(p[1] for p in periods) >= N_STEPPED
        return max(p[2] for p in periods) if enough else math.nan

    def mark(self) -> None:
        """Note the clock at the release, given by the message with the shortest delay."""
        self._reference, self._stepped_back = self._quickest, False

    def clock_step(self) -> float:
        """Return the step by which the clock was set since the release, s; 0 if it was not set.

        Delayed messages look like a clock that was set back, but their stamps do not step back.  A
        step forward cannot be confused with a delay, because no message arrives too early.
        """
        if not math.isfinite(self._reference) or len(self._latest) < N_STEPPED:
            return 0.0
        ahead, behind = min(self._latest) - self._reference, max(self._latest) - self._reference
        if ahead > MAX_STEP_BACK:
            return ahead
        return behind if behind < -MAX_STEP_BACK and self._stepped_back else 0.0

    def unchanged(self, now: float) -> float:
        """Return the time since the measured values last changed, s."""
        return now - self._last_change


class Interlocks:
    """Checks each measurement; returns why a release is refused or why the approach must end.

    ``topics``: by source, the names of the topics that it may publish.  :meth:`choose` selects the
    topic that a trial uses; the source's other topics are then ignored.  ``readers`` and
    ``publishers``: readers and publishers of launcher/hold.  ``waived``: names of :data:`RULES`
    that do not refuse a release.
    """

    def __init__(
        self,
        limits: TrialLimits,
        topics: Mapping[Source, Sequence[str]],
        readers: HoldReaders | None = None,
        publishers: HoldPublishers | None = None,
        waived: Collection[str] = (),
    ) -> None:
        self.limits = limits
        self.readers = readers or HoldReaders()
        self.publishers = publishers or HoldPublishers("/launcher", -math.inf)
        self.monitors = {name: SourceMonitor() for names in topics.values() for name in names}
        #: This machine's clock minus the clock of the arrivals, s; NaN: the rule
        #: ``machine_clock`` is not checked.
        self.machine_clock = math.nan
        self.held = HeldWatch(limits.stop_timeout)
        self.waived = frozenset(waived)
        #: A line for each broken plausibility rule that refuses a release.
        self.implausible: tuple[str, ...] = ()
        #: Time of the latest measurements in the last check of plausibility, s; ``inf`` if there
        #: is no such check.
        self.checked = math.inf
        #: Function that requests a check, whose result goes to :meth:`note_check`.
        self.request_check: Callable[[], None] = lambda: None
        #: Relative poses at the start of other scenes, by name; see :mod:`.starts`.
        self.starts: Mapping[str, Pose] = {}
        self.emergency_stop = EmergencyStop(
            is_required=limits.require_emergency_stop,
            max_silence=limits.max_emergency_stop_silence,
        )
        self.jumps = {
            name: JumpWatch()
            for source in (Source.CHASER, Source.TARGET)
            for name in topics.get(source, ())
        }
        self._scene: Scene | None = None  # of the trial
        self._last: dict[str, tuple[float, ...]] = {}  # the latest measurement, by topic
        self._rests = {
            name: Rest(BUFFER_LIMITS if source is Source.BUFFER else POSE_LIMITS)
            for source, names in topics.items()
            for name in names
        }
        self._topics = {source: tuple(names) for source, names in topics.items()}
        self._chosen: dict[Source, str] = {}
        self._publishers: dict[str, tuple[str, ...]] | None = None  # names of nodes, by topic
        self._mismatches: dict[str, str] = {}

    def add(self, topic: str, stamp: int, values: tuple[float, ...], arrival: float) -> None:
        """Note a measurement, see :meth:`SourceMonitor.add`."""
        if self.monitors[topic].add(stamp, values, arrival):
            self._last[topic] = values
            self._rests[topic].add(values, arrival)
            if topic in self.jumps:
                self.jumps[topic].add((values[0], values[1], values[2]), arrival)

    def note_publishers(
        self, nodes: Mapping[str, Sequence[str]], mismatches: Mapping[str, str]
    ) -> None:
        """Note the nodes that publish each topic, and why no message of a topic can arrive.

        ``nodes``: full names by topic.  ``mismatches``: reasons by topic, e.g. another type.
        """
        self._publishers = {topic: tuple(names) for topic, names in nodes.items()}
        self._mismatches = dict(mismatches)

    def begin(self, scene: Scene | None = None) -> None:
        """Start a trial of this scene: forget which topics the previous trial used."""
        self._scene = scene
        self._chosen.clear()

    def choose(self, source: Source, topic: str) -> bool:
        """Return True if the trial uses this topic of a source: the first one passed here."""
        return self._chosen.setdefault(source, topic) == topic

    def refusal(self, now: float) -> str:
        """Return the reasons against releasing the chaser; empty if there are none."""
        stale = [
            self._stale_text(source, now, limit)
            for source, limit in self._limited()
            if not self._age(source, now) <= limit
        ]
        conflicts = [text for source, _ in self._limited() if (text := self._conflict(source))]
        hold = [self.publishers.refusal(now), self.readers.refusal(now), self.held.alarm]
        rules = [] if stale else self._broken_rules(now)
        late = now > self.checked + MAX_CHECK_AGE
        overload = f"rules of plausibility: last checked {now - self.checked:.2g} s ago: {OVERLOAD}"
        # the cause comes first; an age is only its consequence
        first = [self.emergency_stop.problem(now), *self.implausible, *rules, *conflicts]
        return "; ".join(filter(None, [*first, *stale, *hold, overload if late else ""]))

    def note_hold(self, is_held: bool, now: float) -> None:
        """Note at ``now``, s, that the chaser is held, or that it is let go."""
        if is_held:
            self.held.hold(now)
            return
        self.held.let_go(self._rest(Source.CHASER).median(now))

    def note_check(self, implausible: Collection[str], at: float) -> None:
        """Note the lines of a check of plausibility whose latest measurements arrived at ``at``."""
        self.implausible, self.checked = tuple(implausible), at

    def mark(self) -> None:
        """Note the sources' clocks and the publishers of launcher/hold at a release."""
        self.publishers.begin()
        for source in self._needed():
            self.monitors[self._best(source)].mark()
        for watch in self.jumps.values():
            watch.begin()

    def jump(self) -> str:
        """Return which body has moved since the release as no body can; empty if none has."""
        found = ((name, self.jumps[name].text) for name in map(self._best, VEHICLES))
        return "; ".join(f"{name}: {text}" for name, text in found if text)

    def watch_held(self, now: float) -> None:
        """Check whether a chaser that was held again has stopped, see :attr:`HeldWatch.alarm`."""
        self.held.update(self._rest(Source.CHASER), now)

    def clock_steps(self) -> list[str]:
        """Return a line for each source whose clock was set since the release."""
        steps = {n: self.monitors[n].clock_step() for n in map(self._best, self._needed())}
        if "machine_clock" in self.waived:  # the clock's rate may differ as well: only steps back
            steps = {name: min(step, 0.0) for name, step in steps.items()}
        return [f"{name}: clock stepped by {step:+.3g} s" for name, step in steps.items() if step]

    def silences(self, now: float) -> dict[str, float]:
        """Return the silence, s, of each topic of a needed source that is silent for too long."""
        ages = {
            self._best(source): (self._age(source, now), limit) for source, limit in self._limited()
        }
        return {name: age for name, (age, limit) in ages.items() if age > max(limit, MAX_SILENCE)}

    def _needed(self) -> list[Source]:
        return [source for source, _ in self._limited()]

    def _rest(self, source: Source) -> Rest:
        return self._rests[self._best(source)]

    def _broken_rules(self, now: float) -> list[str]:
        """Return a line for each of :data:`RULES` that is broken and not waived."""
        limits, names = self.limits, [self._best(source) for source in self._needed()]
        broken: list[tuple[str, str]] = []
        clocks = {name: self.monitors[name].clock(now) for name in names}
        if clocks and all(map(math.isfinite, clocks.values())):
            middle = median(clocks.values())
            lead = middle - self.machine_clock
            if abs(lead) > limits.max_clock_error:
                text = f"clocks of the sources: {_lead(lead)} this machine's: must be within "
                text += f"{limits.max_clock_error:g} s: synchronise them (chrony, PTP)"
                broken.append(("machine_clock", text))
        for name in names:
            if (rate := self.monitors[name].rate(now)) < limits.min_rate:
                text = f"{name}: {rate:.3g} Hz: must be at least {limits.min_rate:g} (min_rate)"
                broken.append(("rates", text))
        if self._scene is not None:
            broken += self._start_rule(self._scene, now)
        for source, name in zip(VEHICLES, ("standstill", "target_standstill"), strict=True):
            if problem := self._rest(source).problem(now):
                text = f"the {source.value} {problem}: it must be at rest before a release"
                broken.append((name, text))
        if Source.BUFFER in self._needed():
            broken += self._buffer_rule(now)
        return [f"{text} [rule {rule}]" for rule, text in broken if rule not in self.waived]

    def _start_rule(self, scene: Scene, now: float) -> list[tuple[str, str]]:
        """Compare the relative pose of the bodies with the scene's start; name and text if off."""
        chaser, target = (self._rest(source).median(now) for source in VEHICLES)
        if chaser is None or target is None:
            return []
        start, found = start_of(scene), relative(chaser, target)
        distance, turn = tolerances(start, self.starts)
        off, turned = differences(found, start)
        other = nearest_other(start, self.starts, found)
        if off <= distance and turned <= turn and not other:
            return []
        text = (
            f"{self._best(Source.CHASER)}: target {shown(found)}; in the scene {shown(start)}: "
            f"must be within {distance:.3g} m and {math.degrees(turn):.3g} deg: "
        )
        text += (
            f"this is nearer to the start of {other}: name the scene that is set up"
            if other
            else "put the chaser at its start, check units and base frames"
        )
        return [("start", text)]

    def _buffer_rule(self, now: float) -> list[tuple[str, str]]:
        """Return name and text if the buffer is not at rest near its rest length, else nothing."""
        topic, rest = self._best(Source.BUFFER), self._rest(Source.BUFFER)
        if problem := rest.problem(now):
            return [("buffer_rest", f"{topic}: the buffer {problem}: it must be at rest")]
        stroke, torsion = rest.median(now) or (math.nan, math.nan)
        if abs(stroke) <= MAX_REST_STROKE and abs(torsion) <= MAX_REST_TORSION:
            return []
        text = (
            f"{topic}: stroke {stroke:.4g} m, torsion {torsion:.3g} rad: must be within "
            f"{MAX_REST_STROKE:g} m and {MAX_REST_TORSION:g} rad before a release: check zero and "
            "unit of the encoders"
        )
        return [("buffer_rest", text)]

    def blindness(self, now: float, *, has_moved: bool) -> tuple[str, float]:
        """Return why the approach must end, and for how long the chaser was not seen, s.

        The reason is empty if the approach may continue.  ``has_moved``: the chaser is moving, so
        an exactly repeated pose shows that the driver has lost sight of it.
        """
        limit, age = self.limits.max_pose_age, self._age(Source.CHASER, now)
        if not age <= limit:
            return self._stale_text(Source.CHASER, now, limit), age
        topic = self._best(Source.CHASER)
        unchanged = self.monitors[topic].unchanged(now)
        if has_moved and unchanged > limit:
            text = f"{topic}: the same pose for {unchanged:.3g} s: must be at most {limit:g}"
            return text, unchanged
        if not self._age(Source.TARGET, now) <= limit:
            return self._stale_text(Source.TARGET, now, limit), 0.0
        mixed = [
            f"{name}: stamps of two clocks: two nodes publish it"
            for name in (topic, self._best(Source.TARGET))
            if self.monitors[name].has_two_clocks(now)
        ]
        return "; ".join(mixed) or self.readers.absence(), 0.0

    def _limited(self) -> list[tuple[Source, float]]:
        limits = self.limits
        needed = {
            Source.CHASER: limits.max_pose_age,
            Source.TARGET: limits.max_pose_age,
            Source.BUFFER: limits.max_buffer_age,
        }
        return [(source, limit) for source, limit in needed.items() if limit > 0.0]

    def _best(self, source: Source) -> str:
        """Return the topic that the trial uses, else the topic with the latest measurement."""
        names = self._topics[source]
        return self._chosen.get(source) or min(names, key=lambda name: self.monitors[name].age(0.0))

    def _age(self, source: Source, now: float) -> float:
        return self.monitors[self._best(source)].age(now)

    def _conflict(self, source: Source) -> str:
        """Return an error text if several nodes publish one source's topics; else an empty text.

        With e.g. a driver and a simulator, the topic that the trial uses would be left to chance.
        """
        publishers, topics = self._publishers or {}, self._topics[source]
        nodes = sorted({node for topic in topics for node in publishers.get(topic, ())})
        if len(nodes) <= 1:
            return ""
        names = " and ".join(topic for topic in topics if publishers.get(topic))
        return (
            f"{names}: published by {' and '.join(nodes)}: must be one node for the {source.value}"
        )

    def _stale_text(self, source: Source, now: float, limit: float) -> str:
        """Return why a source has no recent measurement: what its messages have, or their age."""
        topics = self._topics[source]
        best = self._best(source)
        age = self.monitors[best].age(now)
        if math.isfinite(age):
            topics = (best,)
            text = f"{best}: last measurement {age:.3g} s old: must be at most {limit:g}"
        elif heard := tuple(name for name in topics if self.monitors[name].n_messages):
            topics = heard
            text = f"{' and '.join(topics)}: no measurement"
        else:
            text = f"{' or '.join(topics)}: no measurement"
        if empty := "; ".join(filter(None, (self.monitors[t].emptiness(now) for t in topics))):
            text = f"{' and '.join(topics)}: messages without a measurement: {empty} ({text})"
        if self._publishers is not None and not any(self._publishers.get(t) for t in topics):
            text += ", no publisher"
        mismatches = [f"{t}: {self._mismatches[t]}" for t in topics if t in self._mismatches]
        return f"{text} ({'; '.join(mismatches)})" if mismatches else text


def _lead(lead: float) -> str:
    return f"{abs(lead):.3f} s {'ahead of' if lead > 0.0 else 'behind'}"
