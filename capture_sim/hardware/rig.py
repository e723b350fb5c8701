"""A simulated contact rig: a servo that moves the tip, walls, a load cell, and the transport."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from capture_sim.hardware.answers import Answer
from capture_sim.hardware.law import NO_WRENCH, TipState, WallLaw, Walls, Wrench
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import Range, quantity

#: The servo is integrated in steps of at most this, s.
_SERVO_STEP = 1e-4
_SHARE = Range(0.0, 1.0)


@dataclass(frozen=True)
class Servo:
    """Servo of the tip: x'' = w^2 (u(t - delay) - x) - 2 zeta w x', with w = 2 pi bandwidth.

    u is the commanded position, x the position of the tip.
    """

    bandwidth: float = quantity(
        "Hz", Range(0.0, 1e4), default=10.0, doc="bandwidth; 0: the tip is where it is commanded"
    )
    delay: float = quantity("s", Range(0.0, 1.0), default=0.010, doc="delay of the servo")
    acceleration: float = quantity(
        "m/s^2", Range(0.0, 1e6), default=50.0, doc="saturation of the servo"
    )
    damping_ratio: float = 0.7  # zeta

    @property
    def lag(self) -> float:
        """Time by which the tip is behind a command of constant velocity, s."""
        if not self.bandwidth:
            return self.delay
        return self.delay + 2.0 * self.damping_ratio / (2.0 * math.pi * self.bandwidth)


@dataclass(frozen=True)
class Cell:
    """Load cell of the simulated rig: its filter, noise, bias, resolution and range."""

    cutoff: float = quantity(
        "Hz", Range(0.0, 1e6), default=0.0, doc="cutoff of the cell's low-pass; 0: none"
    )
    noise: float = quantity(
        "N", Range(0.0, 1e6), default=0.1, doc="standard deviation of a force component"
    )
    torque_noise: float = quantity(
        "N m", Range(0.0, 1e6), default=0.005, doc="standard deviation of a torque component"
    )
    bias: float = quantity("N", Range(0.0, 1e6), default=0.5, doc="bias of each force component")
    resolution: float = quantity(
        "N and N m", Range(0.0, 1e6), default=0.006, doc="resolution; 0: not quantised"
    )
    force_range: float = quantity(
        "N", Range(0.0, 1e9), default=1000.0, doc="saturation of each force component"
    )


@dataclass(frozen=True)
class Transport:
    """Simulated transport between loop and rig: delay, loss and duplication of the wrenches."""

    delay: float = quantity("s", Range(0.0, 10.0), default=0.001, doc="round-trip delay")
    jitter: float = quantity(
        "s", Range(0.0, 1.0), default=0.0003, doc="scale of the random (half-normal) delay added"
    )
    drops: float = quantity("1", _SHARE, default=0.001, doc="share of wrenches that are lost")
    doubles: float = quantity("1", _SHARE, default=0.001, doc="share of wrenches that come twice")


#: Servo, load cell and transport of a rig without delay, noise, bias, lag and loss.  With it, only
#: the loop itself causes errors.
IDEAL = (Servo(0.0, 0.0), Cell(0.0, 0.0, 0.0, 0.0, 0.0), Transport(0.0, 0.0, 0.0, 0.0))


@dataclass
class Rig:
    """Simulated contact rig, whose walls have the shape of the scene's cone and a contact law.

    The stamps of the received positions are its clock.
    """

    scene: Scene  # whose cone it is
    law: WallLaw  # of the walls
    servo: Servo = field(default_factory=Servo)
    cell: Cell = field(default_factory=Cell)
    transport: Transport = field(default_factory=Transport)
    hidden_lag: float = 0.0  # s, age of the force that is sent with the present position
    sends_tip: bool = True  # whether the tip's measured position is sent as well
    seed: int = 0  # of noise and transport

    def __post_init__(self) -> None:
        self._walls = Walls(self.scene)
        self._rng = np.random.default_rng(self.seed)
        self._commands: deque[TipState] = deque()  # not yet at the servo
        self._tip: TipState | None = None
        self._target: tuple[float, ...] = (0.0, 0.0, 0.0)
        self._filtered = NO_WRENCH
        self._contacts: deque[tuple[float, Wrench]] = deque()  # newest last
        self._on_the_way: list[tuple[float, Answer]] = []
        self.peak_force = 0.0  # N, largest force of the walls on the tip

    def answer(self, pose: TipState) -> list[Answer]:
        """Move the tip towards a position, and return the answers that have arrived at the loop.

        The list is empty if none has arrived.  A repeated first position is answered immediately,
        because nothing moves.  A position with an earlier time than the last one begins a new loop:
        the tip is placed there, and pending positions and answers are discarded.
        """
        if self._tip is None or pose.t < self._tip.t:
            self._tip, self._target = pose, pose[1:4]
            self._filtered = NO_WRENCH
            for pending in (self._commands, self._contacts, self._on_the_way):
                pending.clear()
        if self._tip.t >= pose.t:
            return [self._measured(pose)]
        self._commands.append(pose)
        self._move(pose.t)
        answer, t = self._measured(pose), pose.t
        way = self.transport
        if self._rng.random() >= way.drops:
            due = t + way.delay + abs(self._rng.normal()) * way.jitter
            n = 2 if self._rng.random() < way.doubles else 1
            self._on_the_way += [(due, answer)] * n
        # the loop's next step is half a step later than this, on the mean
        arrived = [entry for entry in self._on_the_way if entry[0] <= t + 1e-9]
        self._on_the_way = [entry for entry in self._on_the_way if entry[0] > t + 1e-9]
        return [answer for _, answer in sorted(arrived, key=lambda entry: entry[0])]

    def _move(self, until: float) -> None:
        """Simulate the tip and the force on it up to a time, s."""
        assert self._tip is not None
        tip, servo = self._tip, self.servo
        steps = max(1, math.ceil((until - tip.t) / _SERVO_STEP - 1e-9))
        if not servo.bandwidth and not self.cell.cutoff:
            steps = 1
        h, start = (until - tip.t) / steps, tip.t
        w = 2.0 * math.pi * servo.bandwidth
        gain, damping = w * w, 2.0 * servo.damping_ratio * w
        for k in range(1, steps + 1):
            t = start + k * h
            command = None
            while self._commands and self._commands[0].t <= t - servo.delay + 1e-12:
                command = self._commands.popleft()
                self._target = command[1:4]
            position: tuple[float, ...] = tip[1:4]
            rates: tuple[float, ...] = tip[4:]
            if servo.bandwidth:  # scalars: arrays of three take several times as long
                state = zip(self._target, position, rates, strict=True)
                a = [gain * (target - x) - damping * v for target, x, v in state]
                size = math.hypot(a[0], a[1])
                share = min(1.0, servo.acceleration / size) if size else 1.0
                rates = tuple(v + h * (share * each) for v, each in zip(rates, a, strict=True))
                position = tuple(x + h * v for x, v in zip(position, rates, strict=True))
            elif command is not None:
                position, rates = self._target, command[4:]
            tip = TipState(t, *position, *rates)
            if self.cell.cutoff or k == steps:
                self._feel(tip, h)
        self._tip = tip

    def _feel(self, tip: TipState, h: float) -> None:
        """Store the walls' wrench on the tip, filtered by the load cell over a step ``h`` (s).

        Wrenches older than ``hidden_lag`` are discarded.
        """
        contact = self._walls.wrench(self.law, tip)
        self.peak_force = max(self.peak_force, contact.force)
        if contact != self._filtered:
            share = -math.expm1(-h * 2.0 * math.pi * self.cell.cutoff) if self.cell.cutoff else 1.0
            pairs = zip(self._filtered, contact, strict=True)
            self._filtered = Wrench(*(old + share * (new - old) for old, new in pairs))
        self._contacts.append((tip.t, self._filtered))
        while len(self._contacts) > 1 and self._contacts[1][0] <= tip.t - self.hidden_lag + 1e-9:
            self._contacts.popleft()

    def _measured(self, pose: TipState) -> Answer:
        """Return the answer to a position: the load cell's reading, and the tip's state.

        The tip is None if ``sends_tip`` is False.
        """
        cell = self.cell
        contact = self._contacts[0][1] if self._contacts else NO_WRENCH
        noise = self._rng.normal(size=6) * np.repeat([cell.noise, cell.torque_noise], 3)
        read = np.array(contact) + noise + np.repeat([cell.bias, 0.0], 3)
        read[:3] = np.clip(read[:3], -cell.force_range, cell.force_range)
        if cell.resolution:
            read = cell.resolution * np.round(read / cell.resolution)
        return Answer(pose.t, Wrench(*read.tolist()), self._tip if self.sends_tip else None)
