"""The loop: what acts on the vehicles, what the rig is sent, and the limits that always hold.

``none``
    The rig's wrench is held over each step.
``prediction``
    The rig is sent the position where the tip will be when the answer is used, by its velocity.
``model``
    A law of the walls acts in the vehicles' own steps; the rig measures the contact, and after
    each touch the law is fitted to what it measured.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Generator, Sequence
from typing import Protocol

import numpy as np

from capture_sim.errors import CaptureSimError
from capture_sim.hardware.answers import Answer, Answers
from capture_sim.hardware.fit import LawEstimate, fit_touch
from capture_sim.hardware.law import (
    NO_LAW,
    NO_WRENCH,
    TipState,
    WallLaw,
    Walls,
    Wrench,
    max_stiffness,
)
from capture_sim.hardware.limits import EnergyLimit, Limits, check_motion
from capture_sim.hardware.stage import LoopStage, SafeStopError
from capture_sim.hardware.touch import Touch

METHODS = ("none", "prediction", "model")

#: A touch begins at so many standard deviations of the cell's noise and ends at half of them.
THRESHOLD_DEVIATIONS = 6.0
#: ... and at least at this force, N.
MIN_THRESHOLD = 0.01
#: Restitution is held if it is within this share of the rig's.
TOLERANCE = 0.05
#: A touch of a law lasts at least this many Runge-Kutta steps: they add 2e-3 of its energy at most.
MIN_TOUCH_STEPS = 12
#: A law that misses more than this share of the peak force does not describe the contact.
MAX_MISFIT = 0.05
#: The loop stops after so many touches in a row in which rig and law disagree.
MAX_DISAGREEMENTS = 3
#: By what a law is softened that the rig was not touched in.
SOFTENING = 4.0
#: Answers at rest from which bias and noise are taken.
N_AT_REST = 100
#: The rig's tip is at the first position if it is not farther from it, m.
MAX_START_DISTANCE = 1e-3
#: A prediction takes over the servo's lag this often, s; settled is a servo of 5 Hz and more.
LAG_PERIOD = 0.1


class Loop:
    """Goes step by step with the wrenches that come, and returns what the rig is to be sent.

    First the rig answers the position at rest, ``N_AT_REST`` times; :meth:`begin` takes bias and
    noise from that.  Then :meth:`receive` for each answer and :meth:`advance` for each step.

    ``method`` is of :data:`METHODS`, ``law`` what ``model`` assumes of the walls at first.
    ``mass`` (kg): what the contact feels; None takes that of the tip at the first force, which is
    right for a touch much shorter than the buffer's own motion.  ``threshold`` (N): where a touch
    begins; 0 for six standard deviations of the cell's noise at rest.
    """

    def __init__(
        self,
        stage: LoopStage,
        method: str = "none",
        law: WallLaw = NO_LAW,
        limits: Limits = Limits(),  # noqa: B008 - a tuple
        mass: float | None = None,
        threshold: float = 0.0,
    ) -> None:
        if method == "model" and law.stiffness <= 0.0:
            raise CaptureSimError(f"stiffness = {law.stiffness:g} N/m^exponent: must be > 0")
        self.stage, self.method = stage, method
        self._limits, self._mass = limits, mass
        self._threshold = threshold
        self._walls = Walls(stage.scene)
        WallLaw(1.0, damping=1.0).restitution(1.0)  # loads what it needs, not within a step
        self._tip_mass = min(stage.effective_mass(-1.0, 0.0), stage.effective_mass(0.0, 1.0))
        self.answers = Answers(limits)
        self.pose = stage.tip  # to be sent
        self._sent = {0: self.pose}
        self._past = deque([self.pose], maxlen=2048)
        self._ages: deque[float] = deque(maxlen=25)
        self._servo_lags: deque[float] = deque(maxlen=25)
        self._servo_lag = self._lag_time = 0.0  # s
        self._samples: deque[tuple[float, ...]] = deque(maxlen=2048)
        self._has_rig_tips = False
        self._rig_in_touch = False
        self._rig_forces: deque[float] = deque([0.0, 0.0], maxlen=2)
        self._last_touched = 0.0  # s, when a force was last seen on either side
        self._begun = stage.energy, stage.impulse  # before this touch
        self._touch: Touch | None = None
        self._fit: Generator[None, None, LawEstimate] | None = None
        self._fitted: Touch | None = None
        self._next_law: WallLaw | None = None
        self._disagreements = 0
        self.energy = EnergyLimit(stage, limits.energy)
        self.rig_peak_force = 0.0  # N
        self.start_distance = 0.0  # m, of the rig's tip from the first position, before the start
        self.touches: list[Touch] = []
        self.notes: list[str] = []
        self.estimate = LawEstimate(law)
        self.law = NO_LAW
        if method == "model":
            self._set_law(law)

    # what is known of the lag

    @property
    def servo_lag(self) -> float:
        """By how much the rig's measured tip is behind the position that it answers, s."""
        return self._servo_lag

    def _update_servo_lag(self) -> None:
        """Take over the median of the latest lags.

        What is sent with a prediction jumps with its lag, so the rig is then given time to settle.
        """
        period = LAG_PERIOD if self.method == "prediction" else 0.0
        if self._touch is None and self._servo_lags and self.stage.t >= self._lag_time + period:
            self._servo_lag = statistics.median(self._servo_lags)
            self._lag_time = self.stage.t

    @property
    def latency(self) -> float:
        """From a position to the use of its wrench, s, by the stamps."""
        return statistics.median(self._ages) if self._ages else 0.0

    @property
    def lag(self) -> float:
        """From a position to the effect of its wrench, s: latency, servo, cell, half a step."""
        return self.latency + self.servo_lag + max(self.estimate.lag, 0.0) + 0.5 * self.stage.step

    @property
    def known_lag(self) -> float | None:
        """The lag as a measurement, s; None beyond the limit of the latency: no answer is so old.

        It is so long e.g. if the rig's tip does not follow the positions.
        """
        return self.lag if self.lag <= self._limits.latency else None

    # steps

    def begin(self) -> None:
        """Take the cell's bias and noise at rest; SafeStopError if it is loaded."""
        self.answers.tare()
        noise = THRESHOLD_DEVIATIONS * self.answers.noise
        self._threshold = self._threshold or max(noise, MIN_THRESHOLD)

    @property
    def threshold(self) -> float:
        """Force at which a touch begins, N; it ends at half of it."""
        return self._threshold

    def receive(self, stamp: float, wrench: Wrench, tip: TipState | None = None) -> None:
        """Take in an answer of the rig, see :meth:`Answers.offer`; SafeStopError beyond a limit.

        Before the first step, only answers of a tip at the first position count as at rest.
        """
        if self.stage.t == 0.0 and abs(stamp) < 1e-9 and not self._is_in_place(tip):
            self.answers.forget_rest()
            self.answers.reject("tip not at the first position")
            return
        answer = self.answers.offer(stamp, self.stage.t, wrench, tip)
        if answer is not None:
            self._record(answer)

    def _is_in_place(self, tip: TipState | None) -> bool:
        """Return whether the rig's tip, where it was last measured, is at the first position."""
        if tip is not None:
            self.start_distance = math.hypot(tip.x - self.pose.x, tip.y - self.pose.y)
        return self.start_distance <= MAX_START_DISTANCE

    def advance(self) -> TipState:
        """Go one step; return the position to send.  SafeStopError at a limit."""
        stage = self.stage
        self.answers.check_latency(stage.t)
        self._ages.append(stage.t - self.answers.latest.stamp)
        self._update_servo_lag()
        if self._touch is None:
            self._begun = stage.energy, stage.impulse
        if self._next_law is not None and self._is_clear(self._next_law):
            self._set_law(self._next_law)
            self._next_law = None
        self._go()
        stage.check()
        self._observe()
        self._continue_fit()
        pose = stage.tip
        if self.method == "prediction":
            pose = self._extrapolated(pose, self.lag)
        index = round(pose.t / stage.step)
        before = self._sent.get(index - 2) if index > 2 else None
        check_motion(self._limits, stage.step, pose, self.pose, before)
        self.pose = self._sent[index] = pose
        return pose

    def _go(self) -> None:
        """Go a step under the rig's wrench, or the law's within the energy limit."""
        if self._touch is None:
            self.energy.note_free_motion()
        had_withheld = self.energy.withheld > 0.0
        wrench = self.answers.latest.wrench if self._rig_in_touch else NO_WRENCH
        try:
            self.energy.go(None if self.method == "model" else wrench)
        finally:
            if self.energy.withheld > 0.0 and not had_withheld:
                limit = self._limits.energy
                self._note(f"energy_limit = {limit:g} J reached: wrench scaled down")

    def _record(self, answer: Answer) -> None:
        """Note what the rig has measured, and whether it is in touch."""
        index = round(answer.stamp / self.stage.step)
        sent = self._sent.get(index)
        if sent is None:
            self.answers.reject("stamped with no position's stamp")
            return
        for old in [k for k in self._sent if k < index]:
            del self._sent[old]
        force = answer.wrench.force
        # a second sample below the threshold ends a touch: one may be the noise's
        self._rig_forces.append(force)
        if force >= self._threshold:
            self._rig_in_touch = True
        elif max(self._rig_forces) < 0.5 * self._threshold:
            self._rig_in_touch = False
        if self._rig_in_touch:
            self._last_touched = self.stage.t
            self.rig_peak_force = max(self.rig_peak_force, force)
        if answer.tip is None:
            if self._has_rig_tips:
                return
        else:
            self._has_rig_tips = True
            speed2 = sent.vx**2 + sent.vy**2
            if not self._rig_in_touch and self._touch is None and speed2 > 1e-6:
                behind = (sent.x - answer.tip.x) * sent.vx + (sent.y - answer.tip.y) * sent.vy
                self._servo_lags.append(max(behind / speed2, 0.0))
        wall = self._walls.deepest(answer.tip or sent)
        fx, fy = answer.wrench.fx, answer.wrench.fy
        normal, tangential = fx * wall.nx + fy * wall.ny, fy * wall.nx - fx * wall.ny
        self._samples.append((answer.stamp, wall.depth, wall.rate, normal, tangential, wall.slip))

    # touches

    def _observe(self) -> None:
        """Follow the touch: of the vehicles, of the rig, or of both."""
        stage, trace = self.stage, self.stage.trace
        force = np.hypot(trace[:, 6], trace[:, 7])
        loaded = np.flatnonzero(force)
        if loaded.size:
            self._last_touched = stage.t
        if self._touch is None:
            if not (loaded.size or self._rig_in_touch):
                return
            self._begin_touch(trace[loaded[0]] if loaded.size else None)
        touch = self._touch
        assert touch is not None
        touch.work = stage.energy - self._begun[0]
        touch.impulse = stage.impulse - self._begun[1]
        touch.peak_force = max(touch.peak_force, float(force.max()))
        touch.duration += loaded.size * stage.step / stage.substeps
        if self._rig_in_touch:
            touch.rig_peak_force = max(touch.rig_peak_force, max(self._rig_forces))
        settled = max(5.0 * stage.step, 2.0 * self.servo_lag, 0.25 * touch.duration)
        if loaded.size or self._rig_in_touch:
            return
        if self.answers.latest.stamp >= self._last_touched + settled:
            self._end_touch(touch)

    def _begin_touch(self, first: np.ndarray | None) -> None:
        """Begin a touch, with the first row of the trace that has a force; None: the rig's."""
        stage = self.stage
        tip = stage.tip if first is None else stage.tip_at(first)
        wall = self._walls.deepest(tip)
        nx, ny = wall.nx, wall.ny
        if first is not None:
            nx, ny = first[6:8] / math.hypot(*first[6:8])
        speed = max(-(tip.vx * nx + tip.vy * ny), 1e-6)
        mass = stage.effective_mass(nx, ny) if self._mass is None else self._mass
        self._touch = Touch(stage.t, speed, 0.5 * mass * speed**2)
        if self.method == "model":
            self._touch.law_restitution = self.law.restitution(speed)

    def _end_touch(self, touch: Touch) -> None:
        """End a touch and begin the fit of what the rig has measured in it."""
        self.touches.append(touch)
        self._touch = None
        rows = np.array(self._samples)
        rows = rows[rows[:, 0] >= touch.begin - max(2.0 * self.lag, 10.0 * self.stage.step)]
        has_force = bool((rows[:, 3] >= self._threshold).any())
        if self.method == "model" and touch.rig_peak_force > 0.0 and touch.peak_force == 0.0:
            self._note_disagreement("the rig was in contact, the law was not")
        if has_force:
            noise = max(self.answers.noise, MIN_THRESHOLD / THRESHOLD_DEVIATIONS)
            prior = self.estimate
            if prior.law.stiffness <= 0.0:
                guess = touch.energy / touch.approach_speed**2 / max(touch.duration, 1e-6) ** 2
                prior = LawEstimate(prior.law._replace(stiffness=20.0 * guess))
            speed, threshold = touch.approach_speed, self._threshold
            self._fit, self._fitted = fit_touch(rows, prior, speed, noise, threshold), touch
        elif self.method == "model":
            short = -(rows[:, 1].max(initial=-math.inf) + self.law.offset)
            where = f"its tip ended {short * 1e3:.3g} mm before the law's wall" if short > 0 else ""
            text = "the law was in contact, the rig was not" + (f": {where}" if where else "")
            if self.estimate.deviations is None:
                softer = self.law.stiffness / SOFTENING
                text += f"; stiffness lowered to {softer:.3g}"
                self._set_next_law(self.law._replace(stiffness=softer, damping=0.0))
                self.estimate = LawEstimate(self.law._replace(stiffness=softer, damping=0.0))
            self._note_disagreement(text)

    def _continue_fit(self) -> None:
        """Do an iteration of the fit, and at its end compare and take over what it found."""
        if self._fit is None or self._fitted is None:
            return
        try:
            next(self._fit)
        except StopIteration as done:
            self._evaluate(self._fitted, done.value)
            self._fit = self._fitted = None

    def _evaluate(self, touch: Touch, found: LawEstimate) -> None:
        """Compare a touch with what the rig has measured in it; take over the law."""
        touch.rig = found
        tolerated = max(5.0 * self.answers.noise, MAX_MISFIT * found.peak_force)
        if found.residual > tolerated:
            self._note_disagreement(
                f"the fitted law misses the rig's force by {found.residual:.3g} N rms, peak "
                f"{found.peak_force:.4g} N"
            )
            return
        self._disagreements = 0
        hidden = found.lag - max(self.estimate.lag, 0.0)
        if hidden > max(3.0 * found.lag_deviation, 0.01 * touch.duration):
            self._note(
                f"the rig's force is {found.lag * 1e3:.3g} ms later than its stamps show"
                + ("" if self._has_rig_tips else "; it sends no loop/rig_tip")
            )
        self.estimate = found
        uncertain = found.restitution_deviation > TOLERANCE * found.restitution
        error = touch.restitution / max(found.restitution, 1e-3) - 1.0
        touch.is_held = None if uncertain else abs(error) <= TOLERANCE
        if math.isnan(touch.restitution):
            touch.is_held = None  # that the law was not in contact has been noted
        elif not touch.is_held:
            self._note(
                f"restitution {touch.restitution:.3g}, measured on the rig "
                f"{found.restitution:.3g} +- {found.restitution_deviation:.2g}: not held within "
                f"{TOLERANCE:.0%}"
            )
        if self.method == "model":
            self._set_next_law(found.law)

    def end(self) -> None:
        """Note of a touch whose restitution could not be compared with the rig's that it is so."""
        if self._touch is not None:
            self._note("the run ended within a touch: its restitution is not known")
        if self._fitted is not None:
            self._note(
                "the run ended before the touch was fitted: its restitution is not compared "
                "with the rig's"
            )

    def _is_clear(self, law: WallLaw) -> bool:
        """Return whether the tip is outside of the walls of this law and of the present one."""
        depth = self._walls.deepest(self.stage.tip).depth
        return depth + max(law.offset, self.law.offset) < 0.0

    def _set_next_law(self, law: WallLaw) -> None:
        self._next_law = law

    def _set_law(self, law: WallLaw) -> None:
        """Let a law act, softened to what the Runge-Kutta steps carry."""
        duration = MIN_TOUCH_STEPS * self.stage.step / self.stage.substeps
        speed = max(math.hypot(self.stage.tip.vx, self.stage.tip.vy), 1e-3)
        most = max_stiffness(law.exponent, self._tip_mass, speed, duration)
        if law.stiffness > most:
            self._note(
                f"stiffness {law.stiffness:.3g} limited to {most:.3g}, as a touch needs "
                f"{MIN_TOUCH_STEPS} Runge-Kutta steps"
            )
        self.law = law.within(most)
        self.stage.set_law(self.law)

    def _note(self, text: str) -> None:
        self.notes.append(f"t = {self.stage.t:.6g} s, touch {len(self.touches)}: {text}")

    def _note_disagreement(self, text: str) -> None:
        self._note(text)
        self._disagreements += 1
        if self._disagreements >= MAX_DISAGREEMENTS and self.method == "model":
            raise SafeStopError(
                f"touches in a row in which rig and law disagree = {self._disagreements}: must be "
                f"< {MAX_DISAGREEMENTS}; {text}"
            )

    # what is sent

    def _extrapolated(self, tip: TipState, lag: float) -> TipState:
        """Return where the tip will be, by its difference over a span of the lag.

        Such a difference does not follow a buffer that rings faster than that.  The time stays
        that of the tip, by which the answer is known.
        """
        step = self.stage.step
        self._past.appendleft(tip)
        n = min(round(lag / step), len(self._past) - 1)
        before = self._past[n]
        rates = np.array(tip[4:])
        if n > 0:
            rates = (np.array(tip[1:4]) - np.array(before[1:4])) / (n * step)
        return TipState(tip.t, *(np.array(tip[1:4]) + lag * rates).tolist(), *rates.tolist())


class Channel(Protocol):
    """A rig and the way to it."""

    def answer(self, pose: TipState) -> Sequence[Answer]:
        """Take a position; return the answers that come until the next one is sent."""


def run_in_process(loop: Loop, rig: Channel, t_end: float) -> str:
    """Run a loop in one process, up to a time (s); return why it stopped, empty at its end."""
    try:
        for _ in range(N_AT_REST):
            for answer in rig.answer(loop.pose):
                loop.receive(*answer)
        loop.begin()
        for _ in range(math.ceil(t_end / loop.stage.step - 1e-9)):
            loop.advance()
            for answer in rig.answer(loop.pose):
                loop.receive(*answer)
    except SafeStopError as stop:
        return f"stopped at t = {loop.stage.t:.6g} s: {stop}"
    finally:
        loop.end()
    return ""
