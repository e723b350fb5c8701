"""A run in the loop as an ordinary Run, made after its end.

The samples of the vehicles are the loop's own.  Touches are found in the samples of the force on
the tip, from the rig or from a law.  Between two samples the force is unknown.
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

#: Events of the stage that its record keeps; the touches of a law are found as those of a rig.
_RECORDED_EVENTS = {
    *(EventKind.STOP_HIT, EventKind.STOP_LEFT, EventKind.SEATED, EventKind.UNSEATED),
    EventKind.LATCHED,
}


class LoopRecord:
    """Collects a stage's samples, one a step from its start on."""

    def __init__(self, stage: LoopStage) -> None:
        self._stage = stage
        self._samples: list[np.ndarray] = []
        self.add()

    def add(self) -> None:
        """Keep the state after a step."""
        self._samples.append(self._stage.sample)

    def run(self, failure: str = "") -> Run:
        """Return the run so far; ``failure``: why it stopped early."""
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
    """Return the scene as it began in the loop: without rail, sampled at each step."""
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
    """Give each force on the tip to the wall that the tip is deepest in."""
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
    """Give touches the speed at which the tip came, and samples the touches begun."""
    for touch in touches:
        first = int(samples["t"].searchsorted(touch["start"]))
        side = 0 if touch["wall"] > 0 else 1
        touch["approach_speed"] = samples["penetration_rate"][max(first - 1, 0), side]
    samples["touches"] = np.searchsorted(touches["start"], samples["t"], side="right")


def _events(samples: np.ndarray, touches: np.ndarray) -> list[Event]:
    """Return release, touches and end."""

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
