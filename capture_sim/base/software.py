"""Versions of the software that can change a run's numbers or its recording."""

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
#: Folders of a clone whose files can change a run's numbers or its recording.
_DECISIVE = ("capture_sim", "config", "msg", "srv", "action")


def scene_hash(text: str) -> str:
    """Return the SHA-256 hash of a scene's YAML text, in hexadecimal digits."""
    return hashlib.sha256(text.encode()).hexdigest()


@cache
def own_version() -> str:
    """Return the version of this package, with the git commit if it runs from a clone.

    The result is ``0.2.0+1a2b3c4`` in a clone at this commit, ``0.2.0+1a2b3c4.changed`` if files
    in its folders capture_sim, config, msg, srv or action differ from the commit or are new, and
    ``0.2.0`` in an installation or without git.  It is determined once per process.
    """
    commit = _commit(Path(__file__).resolve().parents[2])
    return f"{__version__}+{commit}" if commit else __version__


def _commit(root: Path) -> str:
    """Return the commit of a clone, 7 digits, with ``.changed`` if files in _DECISIVE differ.

    The result is empty if ``root`` is not a clone of this package or git cannot report its commit.
    """
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
    """Return ``"name version"`` of Python, of this package, and of NumPy, Numba, mcap and rosbags.

    A package that is not installed is left out.
    """
    found = [f"python {platform.python_version()}", f"{_OWN} {own_version()}"]
    for name in _PACKAGES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return tuple(found)


def newer_version(software: Iterable[str]) -> str:
    """Return the version of capture_sim in a list of ``"name version"``, if it is newer than ours.

    The result is empty if it is not newer or not listed.  A commit in a version is not compared.
    """
    for line in software:
        name, _, found = line.partition(" ")
        if name == _OWN and _numbers(found) > _numbers(__version__):
            return found
    return ""


def newer_line(found: str) -> str:
    """Return a warning about a file that was made by the newer version ``found`` of capture_sim."""
    return (
        f"made by capture_sim {found}, read by {__version__}: "
        "what only the newer version knows is left out"
    )


def _numbers(text: str) -> tuple[int, ...]:
    match = re.match(r"\d{1,9}(\.\d{1,9})*", text)
    return tuple(map(int, match[0].split("."))) if match else ()
