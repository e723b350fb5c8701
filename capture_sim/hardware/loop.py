"""The loop: the wrench that acts on the vehicles, and the positions that are sent to the rig.

``none``
    The rig's wrench is applied with a zero-order hold over each step.
``prediction``
    The rig is sent the position that the tip will have when the answer is used.  The position is
    extrapolated with the tip's velocity.
``model``
    A law of the walls acts in the integration of the vehicles, together with a residual: the rig's
    wrench minus the wrench of the law at the rig's tip.  A share of the residual acts; it falls to
    zero as the lag grows relative to the duration of the touch.  After each contact the law is
    fitted to the rig's measurements.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from capture_sim.errors import CaptureSimError
from capture_sim.hardware.answers import Answer, Answers
from capture_sim.hardware.contact import RigContact
from capture_sim.hardware.episodes import ContactEpisode, Episodes
from capture_sim.hardware.fit import LawEstimate
from capture_sim.hardware.guard import Guard, LoopLimits
from capture_sim.hardware.lags import Lags
from capture_sim.hardware.law import NO_LAW, NO_WRENCH, TipState, WallLaw, Walls, Wrench
from capture_sim.hardware.positions import Predictor, RunUp
from capture_sim.hardware.stage import LoopStage, SafeStopError

METHODS = ("none", "prediction", "model")

#: Force at which a contact begins, in standard deviations of the load cell's noise.  The contact
#: ends at half of this force.
THRESHOLD_DEVIATIONS = 6.0
#: Smallest force at which a contact begins, N.
MIN_THRESHOLD = 0.01
#: Number of answers at rest that give bias and noise of the load cell.
N_AT_REST = 100
#: Largest distance of the rig's tip from the first position at which the loop may start, m.
MAX_START_DISTANCE = 1e-3
#: Distance from the walls, m, at which the tip cannot touch them, whatever walls and lag are not
#: known by; a force that the cell shows there is its own drift.
CLEARANCE = 2e-3
#: Drift of the cell that is named and taken out, as a share of the contact's threshold.
MAX_DRIFT = 0.25
#: Lag as a share of the touch's duration: up to the first value the full residual acts, from the
#: second on none.
FULL_RESIDUAL, NO_RESIDUAL = 0.1, 0.2
#: Steps between two updates of the residual's share; an update costs as much as a step.
RESIDUAL_PERIOD = 10
#: Number of sent positions that are kept until their answers arrive.
MAX_SENT = 2048


def _load_law() -> None:
    """Load the kernels that a fit of the walls needs, so that no step waits for them."""
    law, some = WallLaw(1.0, damping=1.0), np.ones(1)
    law.restitution(1.0)
    law.normal_forces(some, some)
    law.friction_shares(some)


class Loop:
    """Advances the vehicles step by step under the rig's wrenches; returns the positions to send.

    First the rig answers the position at rest, :attr:`pose`, ``N_AT_REST`` times, and :meth:`begin`
    computes bias and noise from these answers.  Then call :meth:`receive` for each answer and
    :meth:`advance` for each step.  Within ``run_up`` (s) before time 0, the positions accelerate
    from rest to the vehicles' first speed.

    ``method`` is one of :data:`METHODS`, ``law`` the initial law of the walls.  ``threshold`` (N)
    is the force at which a contact begins; 0 selects six standard deviations of the cell's noise
    at rest, and at least ``MIN_THRESHOLD``.
    """

    def __init__(
        self,
        stage: LoopStage,
        method: str = "none",
        law: WallLaw = NO_LAW,
        limits: LoopLimits = LoopLimits(),  # noqa: B008 - frozen
        threshold: float = 0.0,
        run_up: float = 0.2,
    ) -> None:
        if method == "model" and law.stiffness <= 0.0:
            raise CaptureSimError(f"stiffness = {law.stiffness:g} N/m^exponent: must be > 0")
        _load_law()
        self.stage, self.method = stage, method
        self._limits = limits
        self._walls = Walls(stage.scene)
        self._run_up = RunUp(stage.tip, run_up, stage.step)
        self._predictor = Predictor(stage.tip, stage.step, limits)
        self._index = -self._run_up.n_steps  # of the newest position
        self._guard = Guard(stage, limits, law)
        self.answers = Answers(self._guard, self.t)
        self.pose = self._guard.send(self._run_up.pose(self.t))  # to be sent
        self._predictor.add(self.pose)
        self._sent = {self._index: self.pose}
        self.lags, self.contact = Lags(), RigContact(threshold)
        self._samples: deque[tuple[float, ...]] = deque(maxlen=2048)
        self._clear: deque[Wrench] = deque(maxlen=N_AT_REST)  # readings with the tip clear
        self.start_distance = 0.0  # m, from the rig's tip to the first position, before the start
        self.notes: list[str] = []
        self._episodes = Episodes(stage, self._walls, law, method == "model", self._note)
        self.law, self._residual_share, self._max_residual = NO_LAW, 0.0, 0.0
        if method == "model":
            self._set_law(law)

    # what is known

    @property
    def t(self) -> float:
        """Time of the vehicles' newest position, s; below 0 during the run-up."""
        return self._index * self.stage.step

    @property
    def energy_excess(self) -> float:
        """Largest energy that the loop has added to the vehicles so far, J."""
        return self._guard.excess

    @property
    def energy_withheld(self) -> float:
        """Energy that the limit has withheld by scaling wrenches down, J."""
        return self._guard.withheld

    @property
    def episodes(self) -> list[ContactEpisode]:
        """Contacts that have ended."""
        return self._episodes.all

    @property
    def estimate(self) -> LawEstimate:
        """Latest estimate of the rig's law."""
        return self._episodes.estimate

    @property
    def lag(self) -> float:
        """Time from a position to the effect of its wrench, s: latency, servo, cell, half step."""
        lags, step = self.lags, self.stage.step
        return lags.latency + lags.servo + max(self.estimate.lag, 0.0) + 0.5 * step

    @property
    def known_lag(self) -> float | None:
        """Measured lag, s; None if it exceeds the latency limit.

        A lag above the limit is not plausible, because no wrench in use is that old.  It occurs
        e.g. if the rig's tip does not follow the positions.
        """
        return self.lag if self.lag <= self._limits.latency else None

    # steps

    def begin(self) -> None:
        """Determine the load cell's bias and noise at rest; SafeStopError if the cell is loaded."""
        self.answers.tare()
        noise = THRESHOLD_DEVIATIONS * self.answers.noise
        self.contact.threshold = self.contact.threshold or max(noise, MIN_THRESHOLD)

    def receive(self, stamp: float, wrench: Wrench, tip: TipState | None = None) -> None:
        """Process an answer of the rig, see :meth:`Answers.offer`; SafeStopError beyond a limit.

        Before the first step, an answer is rejected unless the rig's tip is at the first position.
        """
        is_at_start = self._index == -self._run_up.n_steps and abs(stamp - self.t) < 1e-9
        if is_at_start and not self._is_in_place(tip):
            self.answers.forget_rest()
            self.answers.reject("tip not at the first position")
            return
        answer = self.answers.offer(stamp, self.t, wrench, tip)
        if answer is not None:
            self._record(answer, wrench)

    def _is_in_place(self, tip: TipState | None) -> bool:
        """Return True if the rig's tip is at the first position, and store its distance.

        Without a new measurement, the last distance is used.
        """
        if tip is not None:
            self.start_distance = math.hypot(tip.x - self.pose.x, tip.y - self.pose.y)
        return self.start_distance <= MAX_START_DISTANCE

    def advance(self) -> TipState:
        """Advance one step and return the position to send; SafeStopError at a limit."""
        self.answers.check_latency(self.t)
        self.lags.add_latency(self.t - self.answers.latest.stamp)
        if self._index >= 0:
            self._move_vehicles()
        self._index += 1
        pose = self._run_up.pose(self.t) if self._index < 0 else self.stage.tip
        if self.method == "prediction":
            self._predictor.add(pose)
            if self._episodes.present is None:
                self._predictor.follow(self.lag)
            pose = self._predictor.predicted()
        self.pose = self._guard.send(pose)
        self._sent[self._index] = self.pose
        self._sent.pop(self._index - MAX_SENT, None)
        return self.pose

    def _move_vehicles(self) -> None:
        """Advance the vehicles one step and update the contact episode."""
        episodes = self._episodes
        if episodes.present is None:
            self._guard.note_free_motion()
            self.lags.update_servo()
            if episodes.next_law is not None and self._is_clear(episodes.next_law):
                self._set_law(episodes.next_law)
                episodes.next_law = None
            if self.method == "model" and self._index % RESIDUAL_PERIOD == 0:
                self._update_residual_share()
        is_model, had_withheld = self.method == "model", self._guard.withheld > 0.0
        try:
            self._guard.take_guarded_step(self._wrench(), is_correction=is_model)
        finally:
            if self._guard.withheld > 0.0 and not (had_withheld or is_model):
                limit = self._limits.energy
                self._note(f"energy_limit = {limit:g} J reached: wrench scaled down")
        episodes.observe(list(self._guard.history), self.contact.force)
        if episodes.has_ended(self.answers.latest.stamp, self.lags.servo):
            self._end_episode()
        episodes.work()

    def _wrench(self) -> Wrench:
        """Return the external wrench on the vehicles in the next step."""
        answer = self.answers.latest
        measured = answer.wrench if self.contact.is_on else NO_WRENCH
        if self.method != "model":
            return measured
        if answer.tip is None or self._residual_share == 0.0:
            return NO_WRENCH
        expected = self._walls.wrench(self.law, answer.tip)
        fx, fy = measured.fx - expected.fx, measured.fy - expected.fy
        share, size = self._residual_share, math.hypot(fx, fy)
        if size > self._max_residual:
            share *= self._max_residual / size
        return Wrench(share * fx, share * fy, tz=share * (measured.tz - expected.tz))

    def _update_residual_share(self) -> None:
        """Set the factor and the largest force of the correction in the next contact.

        The correction is the residual, i.e. the rig's measured wrench minus that of the law.  Its
        factor is 0 to 1; it is smaller the longer the lag is compared with the duration of a touch.
        Duration and peak force are those of an elastic touch of the vehicles' effective mass, or of
        the probe's mass if the buffer is softer than the wall.
        """
        scene, law, tip = self.stage.scene, self.law, self.stage.tip
        wall = self._walls.deepest(tip)
        speed, mass = max(wall.rate, 1e-3), self.stage.contact_mass(wall.nx, wall.ny)
        probe_duration = law.duration(scene.probe.mass, speed)
        if probe_duration**2 * scene.buffer.stiffness_at_rest < math.pi**2 * scene.probe.mass:
            mass = scene.probe.mass
        duration = law.duration(mass, speed)
        share = (NO_RESIDUAL - self.lag / duration) / (NO_RESIDUAL - FULL_RESIDUAL)
        self._residual_share = min(max(share, 0.0), 1.0)
        self._max_residual = law.peak_force(mass, speed)

    def _record(self, answer: Answer, reading: Wrench) -> None:
        """Check and store a measurement of the rig, and update the contact state."""
        index = round(answer.stamp / self.stage.step)
        sent = self._sent.get(index)
        if sent is None:
            self.answers.reject("stamped with no position's stamp")
            return
        for old in [k for k in self._sent if k < index]:
            del self._sent[old]
        wall = self._walls.deepest(answer.tip or sent)
        unseen_lag = 0.0 if answer.tip is not None else self._limits.latency
        force = answer.wrench.force
        fx, fy = answer.wrench.fx, answer.wrench.fy
        normal, tangential = fx * wall.nx + fy * wall.ny, fy * wall.nx - fx * wall.ny
        self._guard.check_answer(reading, normal, wall, unseen_lag)
        self._watch_cell(reading, wall.depth)
        self.contact.add(force)
        is_free = not self.contact.is_on and self._episodes.present is None
        if answer.tip is not None and index >= 0 and is_free:
            self.lags.add_tip(sent, answer.tip)
        self._samples.append((answer.stamp, wall.depth, wall.rate, normal, tangential, wall.slip))

    def _watch_cell(self, reading: Wrench, depth: float) -> None:
        """Take out and name a drift of the load cell, while the tip is clear of the walls.

        ``depth`` (m) is the tip's penetration of the scene's walls, negative outside.  The newest
        :data:`N_AT_REST` readings must be as quiet as at the start.
        """
        if depth > -CLEARANCE:
            self._clear.clear()
            return
        self._clear.append(reading)
        if len(self._clear) < N_AT_REST:
            return
        readings = np.array(self._clear)
        drift = self.answers.tared(Wrench(*np.median(readings, axis=0).tolist())).force
        is_quiet = readings[:, :3].std(axis=0).max() <= max(2.0 * self.answers.noise, 1e-9)
        if is_quiet and drift > MAX_DRIFT * self.contact.threshold:
            self.answers.bias = Wrench(*np.median(readings, axis=0).tolist())
            self._note(f"the load cell has drifted by {drift:.3g} N: taken out")

    def _end_episode(self) -> None:
        episode = self._episodes.present
        assert episode is not None
        rows = np.array(self._samples)
        rows = rows[rows[:, 0] >= episode.begin - max(2.0 * self.lag, 10.0 * self.stage.step)]
        noise = max(self.answers.noise, MIN_THRESHOLD / THRESHOLD_DEVIATIONS)
        self._episodes.end(rows, noise, self.contact.threshold)

    def end(self) -> None:
        """Add a note if the run ends within a contact or before its comparison with the rig."""
        if self._episodes.present is not None:
            self._note("the run ended within a contact: its restitution is not known")
        if self._episodes.is_comparing:
            self._note("the run ended before the contact was compared with the rig's")

    def _is_clear(self, law: WallLaw) -> bool:
        """Return True if the tip is outside the walls of this law and of the present law."""
        depth = self._walls.deepest(self.stage.tip).depth
        return depth + max(law.offset, self.law.offset) < 0.0

    def _set_law(self, law: WallLaw) -> None:
        self.law = law
        self.stage.set_law(law)

    def _note(self, text: str) -> None:
        self.notes.append(f"t = {self.stage.t:.6g} s, contact {len(self.episodes)}: {text}")


class RigLink(Protocol):
    """A rig together with its transport."""

    def answer(self, pose: TipState) -> Sequence[Answer]:
        """Accept a position; return the answers that arrive before the next position is sent."""


def run_in_process(loop: Loop, rig: RigLink, t_end: float) -> str:
    """Run a loop in one process up to ``t_end`` (s).

    Return the reason for an early stop, empty if there was none.
    """
    try:
        for _ in range(N_AT_REST):
            for answer in rig.answer(loop.pose):
                loop.receive(*answer)
        loop.begin()
        while loop.t < t_end - 1e-9 * loop.stage.step:
            loop.advance()
            for answer in rig.answer(loop.pose):
                loop.receive(*answer)
    except SafeStopError as stop:
        return f"stopped at t = {loop.t:.6g} s: {stop}"
    finally:
        loop.end()
    return ""
