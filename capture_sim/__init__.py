"""Simulation of a ground test bench for spacecraft docking: chaser, buffer, probe, cone, target.

>>> import capture_sim
>>> result = capture_sim.simulate("tilt_0", {"buffer.c_A": 20})
>>> result.verdict
'captured'
"""

from __future__ import annotations

import importlib
from pkgutil import extend_path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from capture_sim.bench import Bench, drive
    from capture_sim.detection.exact import CaptureState
    from capture_sim.errors import (
        CaptureSimError,
        MissingPackageError,
        RecordingError,
        SceneError,
        SimulationError,
    )
    from capture_sim.launch.scenes import load_scene
    from capture_sim.samples import EventKind, Phase
    from capture_sim.scene.files import scene_names
    from capture_sim.scene.parts import Scene
    from capture_sim.simulation import Result, simulate
    from capture_sim.studies.sweep import sweep
    from capture_sim.viewing.plots import plot

# lets capture_sim.msg, generated into an install prefix, be found from a source checkout
__path__ = extend_path(__path__, __name__)

__version__ = "0.1.0"

__all__ = [
    "Bench",
    "CaptureSimError",
    "CaptureState",
    "EventKind",
    "MissingPackageError",
    "Phase",
    "RecordingError",
    "Result",
    "Scene",
    "SceneError",
    "SimulationError",
    "drive",
    "load_scene",
    "plot",
    "scene_names",
    "simulate",
    "sweep",
]

# loaded at first use: code that needs no kernels does not import the compiler
_MODULES = {
    "bench": ("Bench", "drive"),
    "detection.exact": ("CaptureState",),
    "errors": (
        "CaptureSimError",
        "MissingPackageError",
        "RecordingError",
        "SceneError",
        "SimulationError",
    ),
    "launch.scenes": ("load_scene",),
    "samples": ("EventKind", "Phase"),
    "scene.files": ("scene_names",),
    "scene.parts": ("Scene",),
    "simulation": ("Result", "simulate"),
    "studies.sweep": ("sweep",),
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
            f"{name}() needs matplotlib: pip install 'capture_sim[view]'"
        ) from None
    return getattr(module, name)


def __dir__() -> list[str]:
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})
