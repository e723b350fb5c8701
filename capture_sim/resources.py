"""Where the package's data files are: config/ (YAML) and msg/ (message definitions).

They lie beside the package in a source checkout and below share/capture_sim once it is
installed, by pip or by colcon. No ROS is needed to find them.
"""

from __future__ import annotations

import sys
from pathlib import Path

# Not resolved: with colcon's --symlink-install the link's place is what counts.
_PACKAGE = Path(__file__).parent


def _data_dir(name: str) -> Path:
    checkout = _PACKAGE.parent
    if (checkout / "package.xml").is_file() and (checkout / name).is_dir():
        return checkout / name
    # <prefix>/lib/python3.x/site-packages/capture_sim -> <prefix>/share/capture_sim
    prefixes = [*_PACKAGE.parents[2:5], Path(sys.prefix)]
    places = [prefix / "share" / _PACKAGE.name / name for prefix in prefixes]
    for place in places:
        if place.is_dir():
            return place
    looked = ", ".join(map(str, dict.fromkeys([checkout / name, *places])))
    raise FileNotFoundError(f"capture_sim's {name} files are not installed; looked in {looked}")


def config_dir() -> Path:
    """Return the folder of the configuration files.

    Raises
    ------
    FileNotFoundError
        When the package was installed without its data.
    """
    return _data_dir("config")


def message_dir() -> Path:
    """Return the folder of the message definitions (``*.msg``).

    Raises
    ------
    FileNotFoundError
        When the package was installed without its data.
    """
    return _data_dir("msg")
