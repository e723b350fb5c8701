"""Versions of the software that decides about a run's numbers or its file."""

from __future__ import annotations

import hashlib
import os
import platform
import re
import subprocess
from collections.abc import Iterable
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from capture_sim.base.version import __version__

_PACKAGES = ("numpy", "numba", "mcap", "rosbags")
_OWN = "capture_sim"
#: The parts of a checkout that decide about numbers and files.
_DECISIVE = ("capture_sim", "config", "msg", "srv", "action")


def scene_hash(text: str) -> str:
    """Return the hash of a scene's resolved YAML text, hexadecimal (SHA-256)."""
    return hashlib.sha256(text.encode()).hexdigest()


@cache
def own_version() -> str:
    """Return the version of this package with its commit, where that is known.

    ``0.2.0+1a2b3c4`` from a clone at this commit, ``0.2.0+1a2b3c4.changed`` from a clone whose
    files differ from the commit's, ``0.2.0`` from an installation or without git.
    """
    commit = _commit(Path(__file__).resolve().parents[2])
    return f"{__version__}+{commit}" if commit else __version__


def _commit(root: Path) -> str:
    """Return the commit of a clone, marked if its files differ from it; empty if unknown."""
    if not ((root / ".git").exists() and (root / "package.xml").is_file()):
        return ""
    # a caller within a git hook has set these for another repository
    environment = {k: v for k, v in os.environ.items() if not k.startswith("GIT_")}

    command = ["git", "--no-optional-locks", "-C", str(root), "status", "--porcelain=v2"]
    command += ["--branch", "--no-ahead-behind", "--", *_DECISIVE]
    options = {"env": environment, "timeout": 10.0, "stderr": subprocess.DEVNULL}
    try:
        lines = subprocess.check_output(command, text=True, **options).splitlines()  # type: ignore[call-overload]
    except (OSError, subprocess.SubprocessError, UnicodeDecodeError):
        return ""
    head = [line for line in lines if line.startswith("#")]
    found = re.search(r"^# branch\.oid ([0-9a-f]{7})", "\n".join(head), re.MULTILINE)
    if not found:  # no commit yet
        return ""
    return f"{found[1]}.changed" if len(lines) > len(head) else found[1]


@cache
def software_versions() -> tuple[str, ...]:
    """Return ``"name version"`` of Python, of this package and of each package that counts."""
    found = [f"python {platform.python_version()}", f"{_OWN} {own_version()}"]
    for name in _PACKAGES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return tuple(found)


def newer_version(software: Iterable[str]) -> str:
    """Return this package's version in a list of ``"name version"``, if above ours; else empty."""
    for line in software:
        name, _, found = line.partition(" ")
        if name == _OWN and _numbers(found) > _numbers(__version__):
            return found
    return ""


def newer_line(found: str) -> str:
    """Return the line about a file that a newer version of this package has made."""
    return (
        f"made by capture_sim {found}, read by {__version__}: "
        "what only the newer version knows is left out"
    )


def _numbers(text: str) -> tuple[int, ...]:
    match = re.match(r"\d{1,9}(\.\d{1,9})*", text)
    return tuple(map(int, match[0].split("."))) if match else ()
