"""What a launch file decides: which nodes start, with which parameters, and what is wrong.

The launch files only hand their arguments over, so all is decided, and checked, before the first
process starts.  An argument that is given wins over the file of parameters, which wins over the
node's default.  Whoever says that nothing is to be let go, anywhere, gets that.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from capture_sim.errors import CaptureSimError
from capture_sim.messages.topics import CAPTURE_DETECTOR, LAUNCHER, PLAYER, RECORDER, SIMULATOR
from capture_sim.scene.loading import load_scene

SWITCH = ("true", "false")
ACTUATORS = ("output", "none")
#: Arguments of bench.launch.py: name and description.  Empty, the default: as in the file of
#: parameters, else as the node has it.
ARGUMENTS = {
    "experiment": "scenes in turn, separated by commas: names or files",
    "overrides": "changes of the scenes, SI units, e.g. buffer.c_A=13,buffer.k_A=500",
    "rtf": "real-time factor, 0 to 1000; 0 runs without pacing",
    "state": "initial state of the simulation: playing, paused or stopped",
    "out": "folder of the recordings (default: ~/capture_sim_runs)",
    "scene": "scene of a bench without simulator: the launcher serves its trials, action "
    "launcher/run_trial; without launcher, the detector evaluates by it from the start",
    "actuator": "of these trials: output releases hardware by launcher/hold, none is a dry run "
    "(default: none)",
    "dry_run": "true: nothing is released, whatever else is said",
    "params": "YAML file of parameters, e.g. a copy of config/nodes.yaml",
    "namespace": "namespace of all nodes and topics",
    "simulator": "false: do not start the simulator, for a real bench or another one",
    "launcher": "false: do not start the launcher",
    "detector": "false: do not start the capture detector",
    "record": "false: do not record to MCAP",
    "keep": "true: keep the nodes after the last run, to play or reset again",
    "rviz": "true: show the bench in RViz, where rviz2 is installed",
    "view": "true: show the bench live with rerun",
    "view_python": "Python with rerun for the viewer, e.g. of `make setup`: rerun needs NumPy 2, "
    "an apt Jazzy has 1.26 (default: this one)",
}
_SWITCHES = ("dry_run", "simulator", "launcher", "detector", "record", "keep", "rviz", "view")
#: How wildcards in the names of a file of parameters match.
_WILD = {"**": r"(/[^/]+)*", "*": r"/[^/]+"}
_STATES = ("playing", "paused", "stopped")


class NodeStart(NamedTuple):
    """A node to start, with the parameters that win over the file."""

    program: str
    parameters: dict[str, Any]


class BenchPlan(NamedTuple):
    """What bench.launch.py is to start."""

    nodes: list[NodeStart]
    params: str  # file of parameters, or empty
    namespace: str
    note: str  # what the user should know, a line; may be empty
    shows: dict[str, str]  # "rviz", or "view" with its Python


def plan_bench(
    given: Mapping[str, str], has_package: Callable[[str], bool] = lambda _: True
) -> BenchPlan:
    """Return what to start for the arguments of bench.launch.py, texts by name.

    ``has_package``: whether a ROS package is installed.  CaptureSimError, in one line, if an
    argument or the file of parameters is wrong; nothing is to be started then.
    """
    text = {name: given.get(name, "").strip() for name in ARGUMENTS}
    if unknown := [name for name in given if name not in ARGUMENTS]:
        raise CaptureSimError(f"{unknown[0]}: not an argument; arguments: {', '.join(ARGUMENTS)}")
    for name in _SWITCHES:
        text[name] = text[name].lower()  # ROS writes True
        _check_choice(name, text[name], SWITCH)
    _check_choice("state", text["state"], _STATES)
    _check_choice("actuator", text["actuator"], ACTUATORS)
    namespace = _namespace(text["namespace"])
    file = _parameters(text["params"])

    def of(node: str) -> dict[str, Any]:
        return _of_node(file, f"{namespace.rstrip('/')}/{node}")

    switch = {n: text[n] != "false" for n in ("simulator", "launcher", "detector", "record")}
    overrides = _listed(text["overrides"])
    nodes: list[NodeStart] = []
    note = ""
    if switch["launcher"]:
        own, note = _launcher(text, of(LAUNCHER), overrides, simulator=switch["simulator"])
        nodes.append(NodeStart(LAUNCHER, own))
    if switch["detector"]:
        own = {}
        if text["scene"] and not switch["simulator"] and not switch["launcher"]:
            own = _scene_of(text["scene"], overrides)
        nodes.append(NodeStart(CAPTURE_DETECTOR, own))
    if switch["record"]:
        own = {"out": text["out"]} if text["out"] else {}
        if not own and "out" not in of(RECORDER):
            own = {"out": str(Path.home() / "capture_sim_runs")}
        nodes.append(NodeStart(RECORDER, own))
    if switch["simulator"]:
        roles = [start.program for start in nodes]
        nodes.append(NodeStart(SIMULATOR, _simulator(text, of(SIMULATOR), overrides, roles)))
    shows = {}
    if text["rviz"] == "true":
        if not has_package("rviz2"):
            raise CaptureSimError("rviz = true: rviz2 is not installed")
        shows["rviz"] = ""
    if text["view"] == "true":
        if text["view_python"] and shutil.which(text["view_python"]) is None:
            raise CaptureSimError(
                f"view_python = {text['view_python']}: must be a Python that can be started"
            )
        shows["view"] = text["view_python"]
    return BenchPlan(nodes, text["params"], namespace, note, shows)


#: Arguments of replay.launch.py: name and description.
REPLAY_ARGUMENTS = {
    "bag": "an .mcap file, or a bag's folder",
    "rtf": "real-time factor, 0 to 1000; 0 plays without pacing (default: 1)",
    "start": "time after the recording's start at which to begin, s (default: 0)",
    "namespace": "namespace of all nodes and topics",
    "paused": "true: start paused",
    "detect": "true: evaluate the run again; the recorded verdict is not played",
}


def plan_replay(given: Mapping[str, str]) -> BenchPlan:
    """Return what to start for the arguments of replay.launch.py, see :func:`plan_bench`."""
    text = {name: given.get(name, "").strip() for name in REPLAY_ARGUMENTS}
    for name in ("paused", "detect"):
        text[name] = text[name].lower()
        _check_choice(name, text[name], SWITCH)
    if not Path(text["bag"]).exists() or not text["bag"]:
        raise CaptureSimError(f"bag = {text['bag']!r}: must be a recording that exists")
    detects = text["detect"] == "true"
    player: dict[str, Any] = {
        "bag": text["bag"],
        "rtf": _number("rtf", text["rtf"] or "1", 0.0, 1000.0),
        "start": _number("start", text["start"] or "0", 0.0, 1e9),
        "paused": text["paused"] == "true",
        "wait_for": [CAPTURE_DETECTOR if detects else ""],
    }
    nodes = [NodeStart(PLAYER, player)]
    if detects:
        nodes.append(NodeStart(CAPTURE_DETECTOR, {}))
    return BenchPlan(nodes, "", _namespace(text["namespace"]), "", {})


def _namespace(text: str) -> str:
    namespace = "/" + text.strip("/")
    if not re.fullmatch(r"/|(/[A-Za-z_]\w*)+", namespace):
        raise CaptureSimError(f"namespace = {text!r}: must be a ROS name, e.g. lab")
    return namespace


def _launcher(
    text: Mapping[str, str], file: Mapping[str, Any], overrides: Sequence[str], *, simulator: bool
) -> tuple[dict[str, Any], str]:
    """Return the launcher's parameters, and what the user should know of its actuator."""
    own = {} if simulator or not text["scene"] else _scene_of(text["scene"], overrides)
    said = {text["actuator"], str(file.get("actuator", "")), "none" * (text["dry_run"] == "true")}
    serves = not simulator and bool(text["scene"] or file.get("scene") or said & set(ACTUATORS))
    if "none" in said:
        return {**own, "actuator": "none"}, "dry run: nothing is released (actuator none)"
    if "output" in said:
        return {**own, "actuator": "output"}, "the launcher releases hardware by launcher/hold"
    if serves:
        note = "dry run: nothing is released; actuator:=output releases hardware"
        return {**own, "actuator": "none"}, note
    return own, ""


def _simulator(
    text: Mapping[str, str],
    file: Mapping[str, Any],
    overrides: Sequence[str],
    roles: Sequence[str],
) -> dict[str, Any]:
    own: dict[str, Any] = {}
    if scenes := _listed(text["experiment"]):
        own["scenes"] = scenes
    if overrides:
        own["overrides"] = overrides
    for scene in scenes or file.get("scenes", ["tilt_0"]):
        load_scene(scene, overrides or [c for c in file.get("overrides", []) if c])
    if text["rtf"]:
        own["rtf"] = _number("rtf", text["rtf"], 0.0, 1000.0)
    if text["state"]:
        own["initial_state"] = text["state"]
    if "wait_for" not in file:
        own["wait_for"] = list(roles) or [""]
    if text["keep"]:
        own["exit_when_done"] = text["keep"] == "false"
    elif "exit_when_done" not in file:
        own["exit_when_done"] = True  # its end shuts the others down
    return own


def _scene_of(scene: str, overrides: Sequence[str]) -> dict[str, Any]:
    load_scene(scene, overrides)
    return {"scene": scene, "overrides": list(overrides) or [""]}


def _check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    if value not in ("", *choices):
        raise CaptureSimError(f"{name} = {value!r}: must be {' or '.join(choices)}")


def _number(name: str, value: str, low: float, high: float) -> float:
    try:
        number = float(value)
    except ValueError:
        number = low - 1.0
    if not low <= number <= high:
        raise CaptureSimError(f"{name} = {value!r}: must be a number from {low:g} to {high:g}")
    return number


def _listed(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]


def _parameters(path: str) -> dict[str, Any]:
    """Return the contents of a file of parameters; empty without one."""
    if not path:
        return {}
    try:
        content = yaml.safe_load(Path(path).read_text(encoding="utf-8")) or {}
    except OSError as error:
        raise CaptureSimError(f"params = {path}: must be a file: {error.strerror}") from None
    except (yaml.YAMLError, ValueError) as error:
        first = " ".join(str(error).split())
        raise CaptureSimError(f"params = {path}: is no YAML: {first}") from None
    is_right = isinstance(content, dict) and all(
        isinstance(each, dict) and isinstance(each.get("ros__parameters", {}), dict)
        for each in content.values()
    )
    if not is_right:
        raise CaptureSimError(f"params = {path}: must have nodes with ros__parameters")
    return content


def _of_node(file: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the parameters that a file has for a node with this full name; later entries win."""
    found: dict[str, Any] = {}
    for pattern, content in file.items():
        words = pattern.removeprefix("/").split("/")
        parts = [_WILD.get(word, f"/{re.escape(word)}") for word in words]
        if re.fullmatch("".join(parts), name):
            found |= content.get("ros__parameters", {}) or {}
    return found
