"""What a person looks at after a run: figures and rerun recordings."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from capture_sim.viewing.plots import save_figure, save_overview
    from capture_sim.viewing.rerun_view import save_rrd
    from capture_sim.viewing.source import ViewableRun

# loaded when first used: matplotlib and rerun take long to load, and rerun may be absent
_EXPORTS = {
    "ViewableRun": "source",
    "save_figure": "plots",
    "save_overview": "plots",
    "save_rrd": "rerun_view",
}

__all__ = ["ViewableRun", "save_figure", "save_overview", "save_rrd"]


def __getattr__(name: str) -> Any:
    if name in _EXPORTS:
        return getattr(importlib.import_module(f"{__name__}.{_EXPORTS[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
