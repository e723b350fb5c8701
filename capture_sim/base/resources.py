"""Folders of the package's data files: config/ (YAML) and msg/ (message definitions).

They are next to the package in a source checkout, and in share/capture_sim after installation with
pip or colcon. ROS is not needed to find them.
"""

from __future__ import annotations

import sys
from pathlib import Path

# Not resolved: with colcon's --symlink-install, the data are near the link.
_PACKAGE = Path(__file__).parents[1]


def _data_dir(name: str) -> Path:
    """Return the folder of data files with this name; FileNotFoundError if it is not installed."""
    checkout = _PACKAGE.parent
    if (checkout / "package.xml").is_file() and (checkout / name).is_dir():
        return checkout / name
    # <prefix>/lib/python3.x/site-packages/capture_sim -> <prefix>/share/capture_sim
    prefixes = [*_PACKAGE.parents[2:5], Path(sys.prefix)]
    candidates = [prefix / "share" / _PACKAGE.name / name for prefix in prefixes]
    for candidate in candidates:
        if candidate.is_dir():
            return candidate
    searched = ", ".join(map(str, dict.fromkeys([checkout / name, *candidates])))
    raise FileNotFoundError(f"capture_sim's {name} files are not installed; looked in {searched}")


def config_dir() -> Path:
    """Return the folder of scenes and settings (YAML); FileNotFoundError if it is not installed."""
    return _data_dir("config")


def message_dir() -> Path:
    """Return the folder of the ``*.msg`` files; FileNotFoundError if it is not installed."""
    return _data_dir("msg")
