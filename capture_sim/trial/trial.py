"""A trial of a real bench as a state machine, without ROS.

The phases are PREPARING -> APPROACH -> CONTACT -> DECIDED -> CLOSING -> OVER.  Every phase before
CLOSING can also change directly to CLOSING, and APPROACH directly to DECIDED.  The chaser is held
except from the release to CLOSING.  :class:`Trial` receives each measurement and the time of a
steady clock.  Only :meth:`Trial.advance` decides; it returns the steps that its caller must do.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

from capture_sim.detection.measurements import Source
from capture_sim.dynamics.samples import Named
from capture_sim.errors import CaptureSimError
from capture_sim.launcher.state_machine import Launcher, LauncherPhase, LauncherStatus
from capture_sim.messages.topics import CAPTURE_DETECTOR
from capture_sim.scene.parts import Scene
from capture_sim.trial.bench_watch import BenchWatch
from capture_sim.trial.hold import HOLD_TIMEOUT
from capture_sim.trial.interlocks import Interlocks
from capture_sim.trial.rest import Pose

#: Verdicts that a goal may expect, as the detector names them.
VERDICTS = ("captured", "rebound", "missed", "stuck", "undecided")
#: Maximum number of characters of a name and of a note.
MAX_NAME, MAX_NOTE = 200, 2000
#: State of the detector from the first contact on: the chaser is at the cone.
_CONTACT = "contact"
#: Maximum difference of a detector status's stamp from the stamps of the poses, s.
MAX_STAMP_ERROR = 1.0
#: Time within which a hold reaches the detector, s.
MAX_TRANSIT = 0.1
#: Failure reason of a trial that the client has cancelled.
CANCELLED = "cancelled"


class TrialPhase(Named):
    """Phase of a trial, as in action/RunTrial.action."""

    PREPARING = 0
    APPROACH = 1
    CONTACT = 2
    DECIDED = 3
    CLOSING = 4
    OVER = 5


class TrialStep(Enum):
    """A step that the caller of :meth:`Trial.advance` has to take."""

    ANNOUNCE = "announce"  # to the other nodes, which then join
    RELEASE = "release"
    ABORT = "abort"
    CLOSE = "close"  # report to the other nodes that the trial has ended
    WITHDRAW = "withdraw"  # as CLOSE, but before a release: the trial may be announced again


@dataclass(frozen=True)
class TrialGoal:
    """The trial that an operator requests; fields as in action/RunTrial.action."""

    name: str
    note: str = ""
    expected: str = ""

    def __post_init__(self) -> None:
        """Check the texts; CaptureSimError names the invalid field."""
        for name, text, longest in (
            ("name", self.name, MAX_NAME),
            ("note", self.note, MAX_NOTE),
        ):
            if not text.isprintable() or len(text) > longest:
                raise CaptureSimError(f"{name}: must be at most {longest} printable characters")
        if self.expected not in ("", *VERDICTS):
            raise CaptureSimError(
                f"expected = {self.expected[:50]!r}: must be empty or one of {', '.join(VERDICTS)}"
            )


@dataclass
class MeasuredLoads:
    """Measured peak loads since the release; NaN if no sensor has measured them."""

    max_force: float = math.nan  # N, change of the load cell's force since before the release
    max_stroke: float = math.nan  # m, largest compression
    max_torsion: float = math.nan  # rad
    _rest_sum: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    _rest_count: int = 0

    def add_force(self, force: tuple[float, float, float], *, is_released: bool) -> None:
        """Add a measured force, N; the mean force before the release is the sensor's offset."""
        if not all(map(math.isfinite, force)):
            return
        if not is_released:
            self._rest_sum = [a + b for a, b in zip(self._rest_sum, force, strict=True)]
            self._rest_count += 1
            return
        offset = [total / max(self._rest_count, 1) for total in self._rest_sum]
        self.max_force = _larger(self.max_force, math.dist(force, offset))

    def add_buffer(self, stroke: float, torsion: float) -> None:
        """Add a stroke, m, and a torsion, rad, measured after the release."""
        self.max_stroke = _larger(self.max_stroke, -stroke)
        self.max_torsion = _larger(self.max_torsion, abs(torsion))


class Trial:
    """One trial, from the goal to its result.

    ``has_actuator``: this trial releases the chaser.  Otherwise a person releases it by hand at any
    time, and only the client can abort the trial.  ``needs_client``: the trial releases the chaser
    only after :meth:`note_result_request`.  ``now``: present time, s, by the steady clock that also
    gives all times of arrival.
    """

    def __init__(
        self,
        goal: TrialGoal,
        scene: Scene,
        launcher: Launcher,
        interlocks: Interlocks,
        *,
        has_actuator: bool,
        now: float,
        needs_client: bool = False,
    ) -> None:
        self.goal, self.scene, self.launcher = goal, scene, launcher
        self.loads = MeasuredLoads()
        #: Label of the detector's state, and the detector's reason for it.
        self.verdict, self.verdict_reason = "", ""
        #: Reason why the trial was refused or aborted; empty if neither happened.
        self.failure = ""
        #: Problems of the trial and gaps of its recording, a line each.
        self.problems: list[str] = []
        self.is_released = False
        self.released = math.nan  # s, time of the release
        self._interlocks, self._limits = interlocks, interlocks.limits
        interlocks.begin(scene)
        self._has_actuator = has_actuator
        self.set_launch(launcher.tolerance, aborts=launcher.aborts)
        self._lacks_client = needs_client
        self._silent = -math.inf  # s, time when a silence of launcher/hold was last noted
        self._silence = ""  # text of a silence of launcher/hold after the release
        self._watch = BenchWatch(launcher, scene)
        self._phase = TrialPhase.PREPARING
        self._phase_since = now
        self._is_announced = self._are_others_ready = self._are_others_done = False
        self._pending = ""  # nodes that the trial waits for
        self._absent = ""  # required nodes that do not take part
        self._lost: Mapping[str, str] = {}  # required nodes that have left: a line for each role
        self._is_final = False
        self._held_stamp = math.inf  # s, of the latest pose when the trial failed
        self._cancelled = ""
        self._silences: dict[str, tuple[float, float]] = {}  # by topic: start and end, s
        self._permitted = math.inf  # s, time since when nothing has stood against a release
        self._jump = ""  # of a body's poses, after the contact
        self._steps: list[str] = []  # a line for each clock that was set since the release
        self._stamps = (math.inf, -math.inf)  # s, smallest and largest stamp of chaser poses
        self._statuses: list[tuple[int, LauncherStatus]] = []

    @property
    def phase(self) -> TrialPhase:
        """The present phase."""
        return self._phase

    @property
    def waived(self) -> tuple[str, ...]:
        """Names of the rules that the laboratory waives."""
        return tuple(sorted(self._interlocks.waived))

    @property
    def holds(self) -> bool:
        """True if the trial holds the chaser; always True without an actuator."""
        is_running = TrialPhase.PREPARING < self._phase < TrialPhase.CLOSING
        is_alone = not self._interlocks.publishers.is_disputed
        return not (self._has_actuator and is_running and is_alone and not self._silence)

    @property
    def gap(self) -> float:
        """Measured gap between the tip and the cone, m; NaN while it is unknown."""
        return self._watch.gap

    @property
    def outcome(self) -> tuple[str, str]:
        """The verdict and its reason; the verdict is empty if the chaser was not released."""
        if not self.is_released:
            return "", self.failure
        found = "; ".join(self.sensor_problems)
        is_decided = self._is_final and self.verdict in VERDICTS
        if self.failure and not is_decided:  # what a chaser does that is held decides nothing
            return "undecided", self.failure
        if self.verdict in VERDICTS:
            reason = self.verdict_reason
            if self.verdict == "undecided" and found:
                reason = f"{found} ({reason})"
            return self.verdict, self.failure or reason
        return "undecided", found or f"no verdict {self._limits.time_limit:g} s after the release"

    @property
    def impact_speed(self) -> float:
        """Speed of the chaser at the first contact, m/s; NaN if not measured.

        It is the speed of the impact only if the target has not moved before.
        """
        status = self.launcher.status
        is_known = status.state is LauncherPhase.DELIVERED and not self._watch.target_motion
        return status.measured_speed if is_known else math.nan

    @property
    def deviation(self) -> str:
        """How the launch differs from its plan; empty before the launch."""
        return self.launcher.deviation if self._is_launched else ""

    def waiting_for(self, now: float) -> str:
        """Return what the phase waits for; empty if it only waits for the bench's motion."""
        if self._phase is TrialPhase.PREPARING:
            return self._refusal(now) or self._pending
        return self._pending if self._phase is TrialPhase.CLOSING else ""

    @property
    def _is_launched(self) -> bool:
        """True once the chaser is released; without an actuator, once it has moved."""
        return self.is_released and (self._has_actuator or self._watch.has_moved)

    # what is measured

    def add_pose(self, source: Source, topic: str, stamp: int, pose: Pose, now: float) -> None:
        """Add a pose of a vehicle: x, y (m), heading (rad); the stamp in ns by the bench's clock.

        For each vehicle, a trial uses only the topic that delivers the first pose.
        """
        if not self._interlocks.choose(source, topic):
            return
        if source is Source.TARGET:
            self._watch.add_target(pose, now)
            return
        seconds = stamp * 1e-9
        self._stamps = min(self._stamps[0], seconds), max(self._stamps[1], seconds)
        status = self._watch.add_chaser(seconds, pose, now)
        if status is not None:
            self._statuses.append((stamp, status))

    def take_statuses(self) -> list[tuple[int, LauncherStatus]]:
        """Return the launcher's statuses since the last call, each with its pose's stamp, ns."""
        statuses, self._statuses = self._statuses, []
        return statuses

    def add_buffer(self, topic: str, stroke: float, torsion: float) -> None:
        """Add a stroke, m, and a torsion, rad, of the buffer."""
        if not self._interlocks.choose(Source.BUFFER, topic):
            return
        self._watch.add_buffer(stroke, torsion)
        if self._is_launched and math.isfinite(stroke) and math.isfinite(torsion):
            self.loads.add_buffer(stroke, torsion)

    def add_force(self, x: float, y: float, z: float) -> None:
        """Add a force measured by the load cell, N."""
        self.loads.add_force((x, y, z), is_released=self._is_launched)

    # what the other nodes report

    def add_verdict(
        self, state: str, reason: str, *, is_final: bool, stamp: int | None = None
    ) -> None:
        """Note the detector's state: one of :data:`VERDICTS`, or the label of an earlier state.

        A state is ignored if its ``stamp`` (ns) lies outside the stamps of this trial's poses by
        more than :data:`MAX_STAMP_ERROR`: another detector or a player has sent it.  A state before
        the release is also ignored, because it belongs to an earlier trial.  Once the trial has
        failed, the chaser is held: only a final state counts then that was reached before, by
        measurements up to the hold.
        """
        if not self.is_released:
            return
        is_late = stamp is None or stamp * 1e-9 > self._held_stamp + MAX_TRANSIT
        if self.failure and (is_late or not is_final):
            return
        first, latest = self._stamps
        if (
            stamp is not None
            and not first - MAX_STAMP_ERROR <= stamp * 1e-9 <= latest + MAX_STAMP_ERROR
        ):
            return
        if self._is_final and not is_final:
            return
        self.verdict, self.verdict_reason, self._is_final = state, reason, is_final

    def set_others(
        self,
        *,
        ready: bool,
        done: bool,
        pending: str,
        absent: str = "",
        lost: Mapping[str, str] | None = None,
    ) -> None:
        """Note whether the other nodes have joined the trial, and whether they have left it.

        ``pending``: the nodes that the trial waits for.  ``absent``: the required nodes that cannot
        take part.  ``lost``: by role, the required nodes that have left before the end.
        """
        self._are_others_ready, self._are_others_done = ready, done
        self._pending, self._absent, self._lost = pending, absent, lost or {}

    def note_result_request(self) -> None:
        """Note that the client has requested the result, so it knows that its goal was accepted."""
        self._lacks_client = False

    def note_silence(self, silence: float, now: float) -> None:
        """Note how long launcher/hold was not sent, s.

        After more than ``max_hold_silence`` the driver may have held the chaser.  The trial then
        does not release it again.
        """
        limit = self._limits.max_hold_silence
        if silence <= limit:
            return
        self._silent = now
        if not self.holds:
            self._silence = f"launcher/hold: silent for {silence:.3g} s: must be at most {limit:g}"

    def set_launch(self, tolerance: float, *, aborts: bool) -> None:
        """Change the launch settings, see :class:`Launcher`; without an actuator none aborts."""
        self.launcher.tolerance = tolerance
        self.launcher.aborts = aborts and self._has_actuator

    def cancel(self, reason: str = CANCELLED) -> None:
        """End the trial and hold the chaser at the next :meth:`advance`."""
        self._cancelled = self._cancelled or reason

    # decisions

    def advance(self, now: float) -> list[TrialStep]:
        """Decide at time ``now``, s; return the steps that the caller must do, in order."""
        steps: list[TrialStep] = []
        while True:
            before = self._phase, self._is_announced
            steps += self._advance_once(now)
            if (self._phase, self._is_announced) == before:
                return steps

    def _advance_once(self, now: float) -> list[TrialStep]:
        in_phase = now - self._phase_since
        if self._cancelled and self._phase < TrialPhase.CLOSING:
            return self._fail(self._cancelled, now)
        match self._phase:
            case TrialPhase.PREPARING:
                return self._prepare(now, in_phase)
            case TrialPhase.APPROACH | TrialPhase.CONTACT:
                return self._follow(now)
            case TrialPhase.DECIDED:
                conflict = self._has_actuator and self._interlocks.publishers.conflict(now)
                if conflict:
                    self.problems.append(conflict)
                if conflict or in_phase >= self._limits.after_verdict:
                    return self._close(now)
            case TrialPhase.CLOSING:
                self._await_others(now, in_phase)
        return []

    def _prepare(self, now: float, in_phase: float) -> list[TrialStep]:
        """Announce the trial once a release is permitted; release once the nodes have joined."""
        if self._is_announced and self._lost:
            # a node that was killed may have restarted: the next announcement includes it
            self._is_announced, self._are_others_ready = False, False
            self._absent, self._lost = "; ".join(self._lost.values()), {}
            return [TrialStep.WITHDRAW]
        refusal = self._refusal(now)
        if refusal:
            self._permitted = math.inf
        if refusal or (self._is_announced and not self._are_others_ready):
            if in_phase > self._limits.start_timeout:
                waited = f"after {self._limits.start_timeout:g} s: "
                return self._fail(f"not released {waited}{refusal or self._pending}", now)
            return []
        if not self._is_announced:
            self._is_announced = True
            return [TrialStep.ANNOUNCE]
        self._permitted = min(self._permitted, now)
        if self._interlocks.checked < self._permitted:  # what has come since is not checked yet
            self._interlocks.request_check()
            return []
        self._enter(TrialPhase.APPROACH, now)
        self.is_released, self.released = True, now
        self._interlocks.mark()
        self.launcher.release()
        self._watch.release(now)
        return [TrialStep.RELEASE] if self._has_actuator else []

    def _refusal(self, now: float) -> str:
        """Return why the chaser must not be released; empty if it may be."""
        if not self._has_actuator:  # a release by hand cannot be refused
            return ""
        reasons = [self._interlocks.refusal(now), self._absent]
        if self._lacks_client:
            reasons.append("client: has not asked for the result, it may not know of its goal")
        if now < self._silent + HOLD_TIMEOUT:
            reasons.append(f"launcher/hold: was silent less than {HOLD_TIMEOUT:g} s ago")
        return "; ".join(filter(None, reasons))

    def _follow(self, now: float) -> list[TrialStep]:
        """Follow the chaser to the verdict; abort an approach that is unseen or not as planned."""
        if self._has_actuator:
            stop = self._interlocks.emergency_stop.problem(now)
            # after a silence the driver may have held the chaser: what follows decides nothing
            if stop := stop or self._interlocks.publishers.conflict(now) or self._silence:
                return self._fail(stop, now)
        self._note_sources(now)
        if self._is_final and self.verdict in VERDICTS:
            self._enter(TrialPhase.DECIDED, now)
            return []
        if self._phase is TrialPhase.APPROACH:
            reason, silence = "", 0.0
            if self._has_actuator:
                reason, silence = self._interlocks.blindness(now, has_moved=self._watch.has_moved)
            is_at_cone = self.launcher.status.state is LauncherPhase.DELIVERED
            may_touch = reason and self._watch.may_have_touched(silence)
            reason = reason or (self._has_actuator and "; ".join(self._steps)) or ""
            if self._has_actuator and (jump := self._interlocks.jump()):
                return self._fail(jump, now)
            if is_at_cone or may_touch or self.verdict == _CONTACT:
                self._watch.note_contact()
                self._enter(TrialPhase.CONTACT, now)
            elif self.launcher.status.state is LauncherPhase.ABORTED:
                return self._fail(self.launcher.status.reason, now)
            elif reason:
                return self._fail(reason, now)
            elif self._lost:
                return self._fail("; ".join(self._lost.values()), now)
        elif CAPTURE_DETECTOR in self._lost:  # no verdict can come
            return self._fail(self._lost[CAPTURE_DETECTOR], now)
        if now - self.released > self._limits.time_limit:
            return self._close(now)
        return []

    def _note_sources(self, now: float) -> None:
        """Note silent sources and stepped clocks between the release and the verdict."""
        for topic, age in self._interlocks.silences(now).items():
            begin = max(now - age, self.released)
            self._silences[topic] = min(begin, self._silences.get(topic, (begin, 0.0))[0]), now
        self._steps = self._interlocks.clock_steps() or self._steps
        self._jump = self._jump or self._interlocks.jump()

    @property
    def sensor_problems(self) -> list[str]:
        """A line for each sensor that was silent, jumped or whose clock was set before the verdict.

        Also one for a target that has moved before the contact.
        """
        lines = []
        for topic, (begin, end) in self._silences.items():
            since = max(0.0, begin - self.released)
            is_over = topic not in self._interlocks.silences(end + 1e-3)
            lines.append(
                f"{topic}: stopped {since:.2f} s after the release"
                + (f", for {end - begin:.2f} s" if is_over else "")
            )
        return [*lines, *self._steps, *filter(None, (self._watch.target_motion, self._jump))]

    def _await_others(self, now: float, in_phase: float) -> None:
        if self._are_others_done or not self._is_announced:
            self._enter(TrialPhase.OVER, now)
        elif in_phase > self._limits.closing_timeout:
            self.problems.append(f"after {self._limits.closing_timeout:g} s: {self._pending}")
            self._enter(TrialPhase.OVER, now)

    def _fail(self, reason: str, now: float) -> list[TrialStep]:
        """Hold the chaser and end the trial with this failure reason."""
        self.failure = reason
        self._held_stamp = self._stamps[1]
        self.launcher.abort(reason)
        return [TrialStep.ABORT, *self._close(now)] if self._is_announced else self._close(now)

    def _close(self, now: float) -> list[TrialStep]:
        self._enter(TrialPhase.CLOSING, now)
        self._pending = "report of the other nodes"
        self._are_others_done = False
        return [TrialStep.CLOSE] if self._is_announced else []

    def _enter(self, phase: TrialPhase, now: float) -> None:
        self._phase, self._phase_since = phase, now


def _larger(known: float, value: float) -> float:
    """Return the larger of two numbers, the first of which may be NaN."""
    return value if math.isnan(known) else max(known, value)
