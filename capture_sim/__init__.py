"""Simulation of a planar ground test bench for probe-and-cone docking, in Python or ROS 2 nodes.

>>> import capture_sim
>>> run = capture_sim.simulate("tilt_0", {"buffer.c_A": 20})
>>> run.verdict
'captured'

- ``simulate(scene, overrides)`` returns a ``Run``; ``read_run(path)`` reads a ``Run`` from a file.
- ``load_scene(name, overrides)`` returns a ``Scene``; ``scene_names()`` lists the packaged scenes.
- ``plot(run, ...)`` draws runs; ``sweep(scene, vary)`` returns a pandas table of many runs.
- ``calibrate(trials)`` fits the parameters of a bench to its measured runs, and predicts a run.
- ``Bench`` and ``drive`` advance a run step by step.
- ``Phase``, ``EventKind`` and ``CaptureState`` name the constants of samples, events and statuses.
- ``CaptureSimError`` is the base class of ``SceneError``, ``SimulationError``, ``RunError``,
  ``RecordingError`` and ``MissingPackageError``.  ``RunError`` is also a ``SimulationError``.

``help(capture_sim.simulate)`` prints the details of a function; the same works for each name above.
"""

from __future__ import annotations

import importlib
from pkgutil import extend_path
from typing import TYPE_CHECKING, Any

from capture_sim.base.version import __version__ as __version__

if TYPE_CHECKING:
    from capture_sim.detection.criteria import CaptureState as CaptureState
    from capture_sim.dynamics.bench import Bench as Bench
    from capture_sim.dynamics.drive import drive as drive
    from capture_sim.dynamics.samples import EventKind as EventKind
    from capture_sim.dynamics.samples import Phase as Phase
    from capture_sim.errors import CaptureSimError as CaptureSimError
    from capture_sim.errors import MissingPackageError as MissingPackageError
    from capture_sim.errors import RecordingError as RecordingError
    from capture_sim.errors import SceneError as SceneError
    from capture_sim.errors import SimulationError as SimulationError
    from capture_sim.recording.read import read_run as read_run
    from capture_sim.run.run import Run as Run
    from capture_sim.run.simulation import RunError as RunError
    from capture_sim.run.simulation import simulate as simulate
    from capture_sim.scene.files import scene_names as scene_names
    from capture_sim.scene.loading import load_scene as load_scene
    from capture_sim.scene.parts import Scene as Scene
    from capture_sim.studies.evaluate.sweep import sweep as sweep
    from capture_sim.studies.fit.calibrate import calibrate as calibrate
    from capture_sim.viewing.plots import plot as plot

# lets capture_sim.msg, generated into an install prefix, be found from a source checkout
__path__ = extend_path(__path__, __name__)

# loaded at first use: code that needs no kernels does not import the compiler
_MODULES = {
    "dynamics.bench": ("Bench",),
    "dynamics.drive": ("drive",),
    "detection.criteria": ("CaptureState",),
    "errors": (
        "CaptureSimError",
        "MissingPackageError",
        "RecordingError",
        "SceneError",
        "SimulationError",
    ),
    "scene.loading": ("load_scene",),
    "recording.read": ("read_run",),
    "run.run": ("Run",),
    "dynamics.samples": ("EventKind", "Phase"),
    "scene.files": ("scene_names",),
    "scene.parts": ("Scene",),
    "run.simulation": ("RunError", "simulate"),
    "studies.fit.calibrate": ("calibrate",),
    "studies.evaluate.sweep": ("sweep",),
    "viewing.plots": ("plot",),
}
_HOMES = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        module = importlib.import_module(f"{__name__}.{_HOMES[name]}")
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "matplotlib":
            raise
        errors = importlib.import_module(f"{__name__}.errors")
        raise errors.MissingPackageError(
            f"{name}() needs matplotlib: pip install matplotlib"
        ) from None
    return getattr(module, name)


def __dir__() -> list[str]:
    return sorted({*_HOMES, *(name for name in globals() if name.startswith("__"))})
