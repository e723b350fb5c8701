"""Plays a recording in this process, with nodes of the bench beside it if they are wanted."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from capture_sim.nodes.following import RECORDER
from capture_sim.nodes.uninterrupted import uninterrupted

#: Followers get this long to end by themselves, and again after SIGINT, s.
GRACE = 10.0
#: No status of a node's own.
_INTERRUPTED = 130


def replay(parameters: Mapping[str, Any], out: Path | None = None) -> int:
    """Play a recording with the player node.

    Parameters
    ----------
    parameters
        Of the node.  The nodes named in ``consumers`` are started beside it, and end with it.
    out
        Folder of the recorder's files, where it is one of them.

    Returns
    -------
    int
        0 when all went well, 1 when a node failed, 2 when a follower refused its parameters.

    Raises
    ------
    CaptureSimError
        The recording cannot be read, or a parameter does not fit it.
    KeyboardInterrupt
        After Ctrl-C, when all nodes have ended in order.
    """
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("RCUTILS_CONSOLE_OUTPUT_FORMAT", "[{name}] {message}")
    names: Sequence[str] = parameters.get("consumers", ())
    with tempfile.TemporaryDirectory(prefix="capture_sim_") as folder:
        content: dict[str, dict[str, Any]] = {"player": {"ros__parameters": dict(parameters)}}
        for name in names:
            values: dict[str, Any] = {"exit_when_done": True}
            if name == RECORDER and out is not None:
                values["out"] = str(out)
            content[name] = {"ros__parameters": values}
        path = Path(folder) / "parameters.yaml"
        path.write_text(yaml.safe_dump(content), encoding="utf-8")
        arguments = ["--ros-args", "--params-file", str(path)]
        followers: list[subprocess.Popen[bytes]] = []
        try:
            with uninterrupted():
                followers += [
                    subprocess.Popen(
                        [sys.executable, "-m", f"capture_sim.nodes.{name}", *arguments],
                        process_group=0,  # Ctrl-C reaches them through us alone
                    )
                    for name in names
                ]
            from capture_sim.nodes.player import PlayerNode
            from capture_sim.nodes.running import run

            status = run(PlayerNode, arguments, interrupted=_INTERRUPTED, command=True)
            if status == _INTERRUPTED:
                raise KeyboardInterrupt
            return max([status, *_ended(followers)])
        finally:
            _end(followers)


def _ended(followers: Sequence[subprocess.Popen[bytes]]) -> list[int]:
    """Wait for the followers to end by themselves; return their exit statuses."""
    statuses = []
    for process in followers:
        try:
            statuses.append(abs(process.wait(GRACE)))
        except subprocess.TimeoutExpired:
            statuses.append(1)
    return statuses


def _end(followers: Sequence[subprocess.Popen[bytes]]) -> None:
    for process in followers:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
    for process in followers:
        try:
            process.wait(GRACE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
