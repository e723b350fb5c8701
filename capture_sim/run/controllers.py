"""A user's controller: where it is found, and what it is given of a run."""

from __future__ import annotations

import importlib
import math
import sys
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from capture_sim.dynamics.drive import Control
from capture_sim.dynamics.thrust import Commands
from capture_sim.errors import SceneError
from capture_sim.run.sensors import Pose, SimulatedSensors, Wrench
from capture_sim.scene.parts import Scene


class Sensed(NamedTuple):
    """What the scene's sensors have given a controller by an instant.

    A field is None until its sensor has given it.
    """

    t: float  # of the instant, s since the release
    stamp: float | None = None  # when the poses were measured, s
    chaser: Pose | None = None  # x, y, heading in the world; m, m, rad
    target: Pose | None = None
    wrench: Wrench | None = None  # of the load cell; N, N, N m


#: A controller of one run: from what it sees to the commands for chaser and target.
Controller = Callable[[Any], Commands]


def measured_control(scene: Scene, command: Controller, rate: float | None = None) -> Control:
    """Return a control that gives a controller what the scene's sensors would have given then.

    Each call has a :class:`Sensed` with the newest readings that have arrived, i.e. that are
    older than the sensor's latency.  They are those of the recording of the same run.  ``rate``:
    of the calls, Hz, as in :class:`capture_sim.dynamics.drive.Control`.

    Examples
    --------
    >>> from capture_sim import load_scene, simulate
    >>> from capture_sim.run.controllers import measured_control
    >>> thrusters = {"chaser": {"force": "2 N", "torque": "0.2 N m"}}
    >>> camera = {"motion_capture": {"rate": 50, "latency": "20 ms"}}
    >>> scene = load_scene("paper_designed", {"thrusters": thrusters, "sensors": camera})
    >>> control = measured_control(scene, lambda seen: ((0.1, 0.0, 0.0), None))
    >>> simulate(scene, control=control).failure
    ''
    """
    sensors = SimulatedSensors(scene)
    parts = scene.sensors
    motion_capture = None if parts is None else parts.motion_capture
    latency = 0.0 if motion_capture is None else motion_capture.latency
    waiting: deque[Sensed] = deque()  # poses that have not arrived yet
    newest = Sensed(-math.inf)

    def watch(samples: np.ndarray) -> None:
        nonlocal newest
        for sample in samples:
            t, reading = float(sample["t"]), sensors.read(sample)
            if reading.wrench is not None:
                newest = newest._replace(wrench=reading.wrench)
            if reading.chaser is not None:
                waiting.append(Sensed(t, t, reading.chaser, reading.target))

    def see(sample: np.void) -> Commands:
        nonlocal newest
        t = float(sample["t"])
        while waiting and waiting[0].t + latency <= t + 1e-12:
            arrived = waiting.popleft()
            newest = newest._replace(
                stamp=arrived.stamp, chaser=arrived.chaser, target=arrived.target
            )
        return command(newest._replace(t=t))

    return Control(see, rate, watch=watch)


def control_of(scene: Scene, name: str) -> Control:
    """Return the control of one run by a user's controller, ``module:function``.

    The function is called once for the run, with the scene.  It returns the controller, which is
    called at ``run.rate``, or a :class:`capture_sim.dynamics.drive.Control`.  If the scene has
    sensors, the controller gets a :class:`Sensed`, else the exact sample; a Control always gets
    the sample.

    Raises
    ------
    SceneError
        The module or the function cannot be loaded, the scene has no thrusters, or the function
        fails or returns something else.
    """
    make = load_controller(name)
    if scene.thrusters is None:
        raise SceneError(f"thrusters: must be in {scene.name} for --control {name}")
    try:
        made = make(scene)
    except Exception as error:
        raise SceneError(f"control {name}: {type(error).__name__}: {error}") from error
    if isinstance(made, Control):
        return made
    if not callable(made):
        raise SceneError(f"control {name}: returned {made!r:.100}: must be a function or a Control")
    return Control(made) if scene.sensors is None else measured_control(scene, made)


def load_controller(name: str) -> Callable[[Scene], Any]:
    """Return the function of ``module:function``; SceneError if there is none.

    The module is found as by ``python``, in the present folder too.
    """
    module_name, separator, function = name.partition(":")
    if not (separator and module_name and function.isidentifier()):
        raise SceneError(f"control = {name!r}: must be module:function, e.g. my_control:make")
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    try:
        found = getattr(importlib.import_module(module_name), function, None)
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        raise SceneError(f"control = {name!r}: cannot be imported: {reason}") from error
    if not callable(found):
        raise SceneError(f"control = {name!r}: {module_name} has no function {function}")
    made: Callable[[Scene], Any] = found
    return made
