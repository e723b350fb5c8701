"""Imports point one way: the core knows no ROS, no recording and no viewing.

Read from the sources, so that imports within functions count as well. Every rule is about a
single import; as the core may import nothing but the core, it holds for what it imports in
turn, which the last test sees once more at run time.
"""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = "capture_sim"
SOURCE = Path(__file__).resolve().parent.parent / PACKAGE

# What belongs to whom, by the name's beginning
RECORDING = ("mcap", "mcap_ros2", "pyarrow", "rosbags")
VIEWING = ("matplotlib", "rerun")
ROS = re.compile(
    rf"(ament_\w+|launch\w*|rcl\w*|rosidl\w*|tf2\w*|\w+_msgs|\w+_srvs|\w+_interfaces|{PACKAGE}\.(msg|srv))$"
)
ADAPTERS = (
    "nodes",
    "recording",
    "viewing",
    "benchmarking",
    "reproduction",
    "commands",
    "cli",
    "__main__",
)
# The only ones that may show or record for a node
EXCEPTIONS = {
    ("nodes.recorder", "recording"),
    ("nodes.player", "recording"),
    ("nodes.viewer", "viewing"),
}


def module_name(path, source):
    """Return a file's dotted name within the package; empty for the package itself."""
    parts = path.relative_to(source).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def modules(source):
    """Return the dotted name within the package and the path of every module."""
    return {module_name(path, source): path for path in source.rglob("*.py")}


def imports(name, path, known):
    """Yield the line and the full dotted name of all that a module imports."""
    # what a relative import starts from: the module's package
    package = [PACKAGE, *name.split(".")] if name else [PACKAGE]
    if path.name != "__init__.py":
        package = package[:-1]
    for node in ast.walk(ast.parse(path.read_text(), str(path))):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*base, *filter(None, [node.module])])
            for alias in node.names:
                full = f"{base}.{alias.name}"
                # `from capture_sim import viewing` is about the module, not about a name in it
                is_module = full.removeprefix(PACKAGE + ".") in known
                generated = full in (f"{PACKAGE}.msg", f"{PACKAGE}.srv")
                yield node.lineno, full if is_module or generated else base


def layer(name):
    """Return which part of the package a module (name within the package) belongs to."""
    top = name.split(".")[0]
    return top if top in ADAPTERS else "core"


def forbidden(name, imported):
    """Return why the module may not import that, or None."""
    top = imported.split(".")[0]
    own = layer(name)
    if top in VIEWING:
        if own == "benchmarking" and top == "matplotlib":
            return None  # its diagrams are of the integrators, not of runs
        return None if own == "viewing" else "only viewing draws"
    if top in RECORDING:
        return None if own == "recording" else "only recording reads and writes bags"
    if ROS.match(".".join(imported.split(".")[: 2 if top == PACKAGE else 1])):
        return None if own == "nodes" else "only nodes know ROS"
    if top != PACKAGE:
        return None
    inner = imported.removeprefix(PACKAGE).removeprefix(".")
    other = layer(inner)
    if other in ("core", own) or own == "__main__" or (own == "cli" and other != "__main__"):
        return None
    if own == "reproduction" and other in ("benchmarking", "viewing"):
        return None  # it runs the second engine, and draws
    if own == "commands" and other not in ("cli", "__main__"):
        return None
    if own == "core" or other in ("commands", "cli", "__main__"):
        return f"{own} may not know {other}"
    return None if (name, other) in EXCEPTIONS else f"{own} and {other} stay apart"


def violations(source):
    """Return a line for every import in the package that points the wrong way."""
    known = modules(source)
    return sorted(
        f"{path.relative_to(source.parent)}:{line}: {imported}: {why}"
        for name, path in known.items()
        for line, imported in imports(name, path, known)
        if (why := forbidden(name, imported))
    )


def test_imports_point_one_way():
    assert violations(SOURCE) == []


@pytest.mark.parametrize(
    "module, line",
    [
        ("bench", "import rclpy"),
        ("bench", "from rclpy.node import Node"),
        ("bench", "def late():\n    import mcap.writer"),
        ("bench", "if TYPE_CHECKING:\n    from capture_sim.nodes import simulator"),
        ("bench", "from . import viewing"),
        ("bench", "from capture_sim.msg import BenchState"),
        ("bench", "from capture_sim import msg"),
        ("bench", "import geometry_msgs.msg"),
        ("__init__", "from .recording import write"),
        ("dynamics/contact", "from ..recording.write import write"),
        ("dynamics/__init__", "from ..recording import write"),
        ("dynamics/contact", "import matplotlib.pyplot as plt"),
        ("messages", "from rosbags.typesys import get_typestore"),
        ("recording/write", "from ..viewing import plots"),
        ("recording/write", "import rclpy"),
        ("viewing/plots", "from capture_sim.recording.write import write"),
        ("viewing/plots", "from capture_sim import cli"),
        ("nodes/simulator", "from capture_sim.recording import write"),
        ("nodes/recorder", "import mcap"),
        ("nodes/recorder", "from capture_sim.viewing import plots"),
        ("nodes/viewer", "import rerun as rr"),
        ("cli", "import rerun"),
    ],
)
def test_a_violation_is_seen(tmp_path, module, line):
    source = small_package(tmp_path)
    (source / f"{module}.py").write_text(line)
    [found] = violations(source)
    assert found.startswith(f"{PACKAGE}/{module}.py:")


@pytest.mark.parametrize(
    "module, line",
    [
        ("bench", "import numpy as np\nfrom . import messages\nfrom .dynamics import contact"),
        ("dynamics/contact", "from ..bench import Bench\nfrom .. import bench"),
        ("recording/write", "import mcap.writer, rosbags\nfrom capture_sim import bench"),
        ("viewing/plots", "import rerun as rr\nfrom matplotlib import pyplot"),
        ("nodes/recorder", "import rclpy\nfrom ..recording import write\nfrom ..msg import Pulse"),
        ("nodes/viewer", "from capture_sim.viewing.plots import draw"),
        ("cli", "def run():\n    from capture_sim import recording, viewing, bench"),
        ("__main__", "from capture_sim.cli import main"),
    ],
)
def test_what_is_allowed_is_left_alone(tmp_path, module, line):
    source = small_package(tmp_path)
    (source / f"{module}.py").write_text(line)
    assert violations(source) == []


def small_package(folder):
    """Make a package of empty modules, laid out as ours."""
    source = folder / PACKAGE
    names = ["__init__", "__main__", "bench", "messages", "cli"]
    names += ["dynamics/__init__", "dynamics/contact", "recording/__init__", "recording/write"]
    names += ["viewing/__init__", "viewing/plots"]
    names += [f"nodes/{name}" for name in ("__init__", "simulator", "recorder", "viewer")]
    for name in names:
        path = source / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return source


def test_core_loads_without_the_others():
    """Every module of the core loads where nothing of ROS, recording and viewing can be."""
    core = [f"{PACKAGE}.{name}".rstrip(".") for name in modules(SOURCE) if layer(name) == "core"]
    script = f"""
import importlib, re, sys
class Refuse:
    def find_spec(self, name, path=None, target=None):
        top = name.split(".")[0]
        if top in {RECORDING + VIEWING} or re.match({ROS.pattern!r}, name):
            raise ImportError(name + " is refused")
sys.meta_path.insert(0, Refuse())
for name in {sorted(core)}:
    importlib.import_module(name)
"""
    answer = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr
