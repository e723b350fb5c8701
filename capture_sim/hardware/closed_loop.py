"""The loop closed: what is applied, what the rig is sent, and what energy the loop has made."""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from capture_sim.errors import CaptureSimError
from capture_sim.hardware.compensation import (
    Compensation,
    ContactFit,
    passive_share,
    predicted,
)
from capture_sim.hardware.in_the_loop import LoopStage, SafeStopError, StageState
from capture_sim.hardware.walls import NOTHING, TipState, WallLaw, Walls, Wrench

NO_LAW = WallLaw(0.0)
NO_COMPENSATION = Compensation()

#: Answers with a force from which on a touch is resolved: the trapezoidal rule over n places of
#: half a sine is wrong by 1 / n^2 of the energy.
RESOLVED = 10

#: Share of a touch's energy that is not worth a wrench.
SETTLED = 1e-4

#: Share of what is owed that a step takes out: more would make the buffer ring.
PAID = 0.1

#: By which share the yielding of the tip to the force may be missed; the work stays below.
MISSED = 2e-4


@dataclass
class Touch:
    """One touch, from its first force to its last.

    Attributes
    ----------
    begin
        s.
    approach_speed
        m/s, along the force.
    energy
        J, of that motion before: half the effective mass times its square.
    duration
        s, under force.
    work
        J, of the wrench on the vehicles: with a contact that cannot make energy, above 0 the
        loop's doing.
    port
        J, what the rig's contact gave, by its wrenches at the places that they answer; never
        above 0, as a contact cannot.
    peak_force
        N.
    impulse
        N s.
    """

    begin: float
    approach_speed: float
    energy: float
    duration: float = 0.0
    work: float = 0.0
    port: float = 0.0
    peak_force: float = 0.0
    impulse: float = 0.0

    @property
    def restitution(self) -> float:
        """Speed after over speed before, from the energy."""
        return math.sqrt(max(1.0 + self.work / self.energy, 0.0))


class Loop:
    """Goes step by step with the wrenches that come, and says what the rig is to be sent.

    Parameters
    ----------
    stage
        Before its first step.
    way
        What is done against the delay.
    law
        For ``model``: what is assumed of the walls at first.  For ``hybrid``: the virtual spring
        and damper.
    energy_limit
        J, that the loop may make before it is opened.
    mass
        kg, that the contact feels; None takes that of the tip at the first force, which is right
        for a touch much shorter than the buffer's own motion.

    Raises
    ------
    CaptureSimError
        The drag of ``law`` is more than the stage's steps can carry.
    """

    def __init__(
        self,
        stage: LoopStage,
        way: Compensation = NO_COMPENSATION,
        law: WallLaw = NO_LAW,
        energy_limit: float = math.inf,
        mass: float | None = None,
    ) -> None:
        self.stage, self._way = stage, way
        self._limit, self._mass = energy_limit, mass
        self._walls = Walls(stage.scene)
        self._law = law if way.model or way.hybrid else NO_LAW
        # more than Runge-Kutta's steps can carry would make energy by itself
        h, mass_x, mass_y = stage.step / stage.substeps, *map(stage.effective_mass, (1, 0), (0, 1))
        most = 2.0 / h / (1.0 / mass_x + 1.0 / mass_y)
        if self._law.drag > most:
            raise CaptureSimError(
                f"drag = {law.drag:g} N s/m: must be <= {most:g}, twice the tip's mass over the "
                f"Runge-Kutta step of {h:g} s"
            )
        stage.take_law(self._law, gated=False)
        self.fit = ContactFit(law) if way.model else None
        self.place = stage.tip  # to be sent
        self._sent = {0: self.place}
        self._answered = -1
        self._measured = self._held = NOTHING
        self._at = self.place  # where the latest wrench was measured
        self._past = deque([self.place], maxlen=2048)
        self._ages: deque[float] = deque(maxlen=25)
        # of this touch: what the rig's contact has given, and the least that it must have, J
        self._port = self._given = 0.0
        self._made = 0.0  # of touches before, J
        self._push = NOTHING  # the largest wrench measured, this touch
        self._touch: Touch | None = None
        self._energy = stage.energy
        self._begun = self._energy, stage.impulse  # before this touch
        self._loaded = 0  # answers with a force, this touch
        self.touches: list[Touch] = []

    @property
    def work(self) -> float:
        """Energy that the loop has made so far, J; below 0 it was lost in the contact."""
        return self.stage.energy - self._energy

    def advance(self, stamp: float, wrench: Wrench) -> TipState:
        """Go one step; return the place to send.

        Parameters
        ----------
        stamp
            s, of the place that the wrench answers; the same as before if nothing new came.
        wrench
            As measured.

        Raises
        ------
        SafeStopError
            The loop has made too much energy, or the vehicles cannot go on.
        """
        stage = self.stage
        index = math.floor(stamp / stage.step + 1e-6)
        if index > self._answered:
            self._take(index, wrench)
        self._ages.append(stage.t - stamp)
        if self._touch is None:
            self._begun = stage.energy, stage.impulse
        kept = stage.saved()
        self._go(kept)
        tip = stage.arrived()
        self._observe(kept)
        self.place = self._next_place(tip)
        self._sent[round(tip.t / stage.step)] = self.place
        return self.place

    def _take(self, index: int, wrench: Wrench) -> None:
        """Take in a new wrench: the rig's energy, the fit, the correction of the law."""
        place = self._sent[index]
        for old in [k for k in self._sent if k < index]:
            del self._sent[old]
        self._answered = index
        if wrench != NOTHING:
            self._loaded += 1
            if math.hypot(*wrench[:2]) > math.hypot(*self._push[:2]):
                self._push = wrench
        before, after = _work(self._measured, self._at, place), _work(wrench, self._at, place)
        exchanged = 0.5 * (before + after)
        self._port = min(self._port + exchanged, 0.0)
        # between two places of a touch too short for them only bounds are known
        self._given += exchanged if exchanged < 0.0 else max(min(before, after), 0.0)
        if self._given > self._limit:
            self._stop(f"the contact has given {self._given:.3g} J more than it took")
        self._measured, self._at, self._held = wrench, place, wrench
        if self.fit is None:
            return
        walls = self._walls.touching(place)
        if len(walls) == 1:
            self.fit.learn(walls[0], wrench)
        if self._touch is None and not self._walls.touching(self.stage.tip):
            self._law = self.fit.law
        fx, fy, torque = self._walls.wrench(self._law, place)
        self._held = (wrench[0] - fx, wrench[1] - fy, wrench[2] - torque)
        self.stage.take_law(self._law, gated=bool(walls))

    def _go(self, kept: StageState) -> None:
        """Go a step with the share of the wrench that does no more work than is allowed.

        The vehicles, with what a law in their steps has stored, get no more out of a touch than
        they have put in; with passivity a part of what is owed is paid as well.  The wrench is
        not turned round and at most doubled; after the touch it brakes the tip with no more than
        was measured in it.
        """
        stage, wrench = self.stage, np.array(self._held)
        owed, quiet = self._owed(), self._held == NOTHING
        moved = stage.go(*wrench)
        if self._way == NO_COMPENSATION or (quiet and owed == 0.0):
            return
        done = float(wrench @ moved)
        allowed = min(done - PAID * owed, -self._touch.work if self._touch else 0.0)
        if done <= allowed:
            return
        unit = np.array(self._push) if quiet else wrench

        def along(share: float) -> float:
            stage.restore(kept)
            return float(unit @ stage.go(*(share * unit)))

        # the tip yields in proportion to the force: how far without any, and how far with this one
        if quiet:
            low, high, wanted, share = -1.0, 0.0, 0.0, -1.0
            coast, best = float(unit @ moved), stage.saved()
            pushed = along(share)
        else:
            low, high, wanted, share = 0.0, 2.0, 1.0, 1.0
            pushed = done
            coast, best = along(0.0), stage.saved()
        for _ in range(2):
            bend = (pushed - coast) / share
            share = passive_share(coast, bend * (1.0 + MISSED), low, high, wanted, allowed)
            pushed = along(share)
            if share * pushed <= max(allowed, 0.0):
                best = stage.saved()
            if share == 0.0 or abs(pushed - coast - share * bend) <= MISSED * abs(share * bend):
                break
        stage.restore(best)

    def _owed(self) -> float:
        """Return what passivity still has to take out, J."""
        touch = self._touch
        # a rig that was pushed in by more than the vehicles had gives that back first; a law in
        # the vehicles' own steps still holds what it has stored
        if not (self._way.passivity and touch and self._loaded >= RESOLVED):
            return 0.0
        if -self._port >= touch.energy:
            return 0.0
        if self._law is not NO_LAW and self._walls.touching(self.stage.tip):
            return 0.0
        owed = touch.work - self._port
        return owed if owed >= SETTLED * touch.energy else 0.0

    def _observe(self, kept: StageState) -> None:
        """See what the step has done; undo it and stop where it has made too much."""
        stage, trace = self.stage, self.stage.trace
        force = np.hypot(trace[:, 6], trace[:, 7])
        loaded = np.flatnonzero(force)
        if loaded.size and self._touch is None:
            self._begin(trace[loaded[0]])
        touch = self._touch
        if touch is None:
            return
        touch.work = stage.energy - self._begun[0]
        touch.impulse = stage.impulse - self._begun[1]
        made = self._made + max(touch.work, 0.0)
        if made > self._limit:
            stage.restore(kept)
            self._stop(f"the wrench would have made {made:.3g} J")
        touch.peak_force = max(touch.peak_force, float(force.max()))
        touch.duration += loaded.size * stage.step / stage.substeps
        if not loaded.size and self._measured == NOTHING:
            touch.port = self._port
            self.touches.append(touch)
            self._made += max(touch.work, 0.0)
            self._touch, self._push, self._loaded = None, NOTHING, 0
            self._port = self._given = 0.0
            if self.fit is not None:
                self.fit.next_touch()

    def _begin(self, first: np.ndarray) -> None:
        """Begin a touch with the first row of the trace that has a force."""
        fx, fy = first[6:]
        nx, ny = fx / math.hypot(fx, fy), fy / math.hypot(fx, fy)
        tip = self.stage.tip_at(first)
        speed = -(tip.vx * nx + tip.vy * ny)
        mass = self.stage.effective_mass(nx, ny) if self._mass is None else self._mass
        self._touch = Touch(tip.t, speed, 0.5 * mass * speed**2)

    def _next_place(self, tip: TipState) -> TipState:
        """Return what the rig is to be sent after a step."""
        if self._way.prediction:
            return self._extrapolated(tip, statistics.median(self._ages) + 0.5 * self.stage.step)
        if self.fit is None:
            return tip
        # a touch may lie within a step: then the place of it of which the fit knows least
        best, most = tip, 0.0
        loaded: np.ndarray = np.any(self.stage.trace[:, 6:8] != 0.0, axis=1)
        for row in self.stage.trace[loaded & ~loaded[-1]]:
            there = self.stage.tip_at(row)
            walls = self._walls.touching(there)
            unknown = self.fit.ignorance(walls[0]) if len(walls) == 1 else 0.0
            if unknown > most:
                best, most = there, unknown
        return best

    def _extrapolated(self, tip: TipState, delay: float) -> TipState:
        """Return where the tip will be, by differences over spans of the delay.

        Such differences do not follow a buffer that rings faster than that.
        """
        step = self.stage.step
        self._past.appendleft(tip)
        n = round(delay / step)
        span = max(n, 1) * step
        now, then, before = (
            np.array(self._past[min(i * max(n, 1), len(self._past) - 1)][1:]) for i in range(3)
        )
        if n > 0:
            rates = (now[:3] - then[:3]) / span
            accelerations = (now[:3] - 2.0 * then[:3] + before[:3]) / span**2
        else:
            rates, accelerations = now[3:], (now[3:] - then[3:]) / span
        if self._way.prediction == 1:
            return predicted(tip, delay, rates, np.zeros(3))
        if n > 0:
            rates = rates + 0.5 * span * accelerations
        return predicted(tip, delay, rates, accelerations)

    def _stop(self, why: str) -> None:
        raise SafeStopError(
            f"stopped at t = {self.stage.t:.6g} s: {why}: must be <= {self._limit:g} J"
        )


def _work(wrench: Wrench, start: TipState, end: TipState) -> float:
    """Return the work of a wrench on the tip from one place to another, J."""
    fx, fy, torque = wrench
    return fx * (end.x - start.x) + fy * (end.y - start.y) + torque * (end.theta - start.theta)


#: What comes out of the rig and the way to it: the step's number, the place sent then and the
#: wrench as (stamp, wrench).
Channel = Callable[[int, TipState], tuple[float, Wrench]]


def late(answer: Callable[[TipState], Wrench], lag: int) -> Channel:
    """Return a rig that answers ``lag`` steps late."""
    places: deque[TipState] = deque(maxlen=lag + 1)

    def channel(_: int, place: TipState) -> tuple[float, Wrench]:
        places.append(place)
        return places[0].t, answer(places[0])

    return channel


def close(loop: Loop, channel: Channel, t_end: float, touches: int | None = None) -> str:
    """Run a loop in one process, up to a time (s) or a number of touches.

    Returns
    -------
    str
        Why it had to be opened; empty if it had not.
    """
    try:
        for k in range(math.ceil(t_end / loop.stage.step - 1e-9)):
            loop.advance(*channel(k, loop.place))
            if touches is not None and len(loop.touches) >= touches:
                break
    except SafeStopError as stop:
        return str(stop)
    return ""
