"""Versions of the software that decides about a run's numbers or its file."""

from __future__ import annotations

import hashlib
import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version

_PACKAGES = ("capture_sim", "numpy", "numba", "mcap", "rosbags")


def scene_hash(text: str) -> str:
    """Return the hash of a scene's resolved YAML text, hexadecimal (SHA-256)."""
    return hashlib.sha256(text.encode()).hexdigest()


@cache
def software_versions() -> tuple[str, ...]:
    """Return ``"name version"`` of Python and of each installed package that counts."""
    found = [f"python {platform.python_version()}"]
    for name in _PACKAGES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return tuple(found)
