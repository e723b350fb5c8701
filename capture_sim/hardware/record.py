"""The record of a loop: the vehicles' samples, turned into an ordinary Run after the end.

There is one sample per step of the loop.  Touches are determined from the force on the tip in these
samples, whether the force came from the rig or from a law.  Their start and end are therefore not
known more exactly than a step.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from capture_sim.dynamics.memory import joined
from capture_sim.dynamics.samples import Event, EventKind, Phase
from capture_sim.hardware.law import TipState, Walls
from capture_sim.hardware.stage import LoopStage
from capture_sim.run.given import Given
from capture_sim.run.loads import sampled_extremes
from capture_sim.run.reconstruction import touches_in_samples
from capture_sim.run.run import ExactRun, Run
from capture_sim.scene.parts import PlanarState, Scene

#: Events of the stage that the record keeps.  Touches are always determined from the samples.
_RECORDED_EVENTS = {
    *(EventKind.STOP_HIT, EventKind.STOP_LEFT, EventKind.SEATED, EventKind.UNSEATED),
    EventKind.LATCHED,
}


class LoopRecord:
    """Collects one sample of a stage per step, beginning with the stage's present state."""

    def __init__(self, stage: LoopStage) -> None:
        self._stage = stage
        self._samples: list[np.ndarray] = []
        self.add()

    def add(self) -> None:
        """Add the stage's present state as a sample; to be called after each step."""
        self._samples.append(self._stage.sample)

    def run(self, failure: str = "") -> Run:
        """Return the recorded steps as a Run; ``failure``: reason of an early stop, or empty."""
        samples = joined(self._samples)
        scene = _scene_of(self._stage, samples[0])
        samples["t"] = np.arange(len(samples)) / scene.run.state_rate  # to the last bit
        _fill_walls(samples, Walls(scene))
        touches = touches_in_samples(samples, {})
        _fill_speeds(touches, samples)
        own = [event for event in self._stage.events if event.kind in _RECORDED_EVENTS]
        events = sorted([*own, *_events(samples, touches)], key=lambda event: event.t)
        given = Given(
            scene=scene,
            samples=samples,
            touches=touches,
            events=tuple(events),
            extremes=sampled_extremes(scene, samples, touches, events),
        )
        return ExactRun(scene.name, given, failure=failure)


def _scene_of(stage: LoopStage, first: np.void) -> Scene:
    """Return the stage's scene with the first sample as initial state, without rail and string.

    Its states are sampled at each step of the loop.
    """
    scene, rate = stage.scene, 1.0 / stage.step
    q, v = first["q"].tolist(), first["v"].tolist()
    initial = replace(
        scene.initial,
        chaser=PlanarState(*q[:3], *v[:3]),
        target=PlanarState(*q[5:], *v[5:]),
    )
    every = max(round(rate / scene.run.rate), 1)
    run = replace(scene.run, state_rate=rate, rate=rate / every)
    return replace(scene, rail=None, string=None, initial=initial, run=run)


def _fill_walls(samples: np.ndarray, walls: Walls) -> None:
    """Set normal force, friction, walls and phase of the samples from the force on the tip.

    Each force is attributed to the wall that the tip is deepest in, or closest to.
    """
    force = samples["contact_force"]
    for name in ("normal_force", "friction_force", "walls"):
        samples[name] = 0.0
    for k in np.flatnonzero(np.hypot(force[:, 0], force[:, 1])):
        sample = samples[k]
        tip = TipState(0.0, -sample["tip_axial"], sample["tip_lateral"], 0.0, 0.0, 0.0, 0.0)
        sides = walls.penetrations(tip)
        side = int(sides[1].depth > sides[0].depth)
        c, s = math.cos(sample["q"][7]), math.sin(sample["q"][7])
        (fx, fy), nx, ny = force[k], sides[side].nx, sides[side].ny
        fx, fy = c * fx + s * fy, c * fy - s * fx  # in the target's axes
        sample["normal_force"][side] = fx * nx + fy * ny
        sample["friction_force"][side] = fy * nx - fx * ny
        sample["walls"], sample["phase"] = side + 1, Phase.CONTACT


def _fill_speeds(touches: np.ndarray, samples: np.ndarray) -> None:
    """Set the approach speed of the touches, and the number of touches begun in the samples.

    The approach speed is the penetration rate in the sample before the touch.
    """
    for touch in touches:
        first = int(samples["t"].searchsorted(touch["start"]))
        side = 0 if touch["wall"] > 0 else 1
        touch["approach_speed"] = samples["penetration_rate"][max(first - 1, 0), side]
    samples["touches"] = np.searchsorted(touches["start"], samples["t"], side="right")


def _events(samples: np.ndarray, touches: np.ndarray) -> list[Event]:
    """Return the events RELEASE, END, and TOUCH and LIFT_OFF of each touch, not sorted by time."""

    def event(kind: EventKind, t: float, touch: np.void | None = None) -> Event:
        sample = samples[min(int(samples["t"].searchsorted(t)), len(samples) - 1)]
        wall, detail = 0, ""
        if touch is not None:
            wall, detail = int(touch["wall"]), "found in the samples"
        ended = touch if kind is EventKind.LIFT_OFF else None
        return Event(kind, t, sample["q"], sample["v"], wall, detail, ended)

    found = [event(EventKind.RELEASE, 0.0), event(EventKind.END, float(samples["t"][-1]))]
    for touch in touches:
        found.append(event(EventKind.TOUCH, float(touch["start"]), touch))
        found.append(event(EventKind.LIFT_OFF, float(touch["end"]), touch))
    return found
