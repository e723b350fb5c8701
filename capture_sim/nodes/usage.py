"""What a node's ``--help`` says."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from pathlib import Path

from capture_sim.resources import config_dir


def usage_of(make: Callable[..., object]) -> str:
    """Return how this process's node is called, what it does, and which parameters it has.

    Parameters
    ----------
    make
        The node's class.
    """
    program = Path(sys.argv[0]).name
    name = Path(program).stem.removeprefix("capture-sim-").replace("-", "_")
    file = config_dir() / "nodes.yaml"
    sections = file.read_text(encoding="utf-8").split("\n/**/")
    mine = [section for section in sections if section.startswith(f"{name}:")]
    lines = [
        f"usage: {program} [--ros-args -p NAME:=VALUE ... --params-file FILE -r NAME:=NAME ...]",
        "",
        inspect.getdoc(make) or "",
        "",
    ]
    for section in mine:
        lines += [f"Parameters, as they are unless changed ({file}):", "", section.rstrip(), ""]
    lines.append(f"While it runs, `ros2 param describe /{name} PARAMETER` tells what is allowed.")
    return "\n".join(lines)
