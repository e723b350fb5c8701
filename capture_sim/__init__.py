"""Emulates a ground test bench for docking and capture: chaser, buffer, probe, cone, target.

>>> import capture_sim
>>> result = capture_sim.simulate(capture_sim.load_scene("tilt_0"))
>>> result.summary["verdict"]
'captured'
"""

from __future__ import annotations

import importlib
from pkgutil import extend_path
from typing import Any

# lets capture_sim.msg, generated into an install prefix, be found from a source checkout
__path__ = extend_path(__path__, __name__)

__version__ = "0.1.0"

# loaded when first used: nodes and tools that need no kernels do not pay for the compiler
_EXPORTS = {
    "Bench": "bench",
    "CaptureSimError": "errors",
    "RecordingError": "errors",
    "Result": "simulation",
    "Scene": "scene.parts",
    "SceneError": "errors",
    "SimulationError": "errors",
    "load_scene": "launch.scenes",
    "scene_names": "scene.files",
    "simulate": "simulation",
}

__all__ = sorted(_EXPORTS)


def __getattr__(name: str) -> Any:
    if name in _EXPORTS:
        return getattr(importlib.import_module(f"{__name__}.{_EXPORTS[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
