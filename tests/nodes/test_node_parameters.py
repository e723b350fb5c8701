"""config/nodes.yaml holds what the nodes declare, with their own defaults."""

import re
import subprocess
import sys

import pytest
import rclpy
import yaml
from cases import cases

from capture_sim.base.resources import config_dir
from capture_sim.nodes.capture_detector import CaptureDetectorNode
from capture_sim.nodes.contact_rig import ContactRigNode
from capture_sim.nodes.launcher import LauncherNode
from capture_sim.nodes.loop_simulator import LoopSimulatorNode
from capture_sim.nodes.recorder import RecorderNode
from capture_sim.nodes.simulator import SimulatorNode
from tests.nodes.own_domain import participant

UNSET = ("['']", "nan")
IGNORED = re.compile(r"use_sim_time|qos_overrides\..*|start_type_description_service")
MADE = (SimulatorNode, LauncherNode, CaptureDetectorNode, RecorderNode)
MADE += (LoopSimulatorNode, ContactRigNode)


@pytest.fixture
def context(_domain):
    return participant()


def test_file_and_nodes_agree(context, tmp_path, monkeypatch):
    """The viewer and the player, which need more to start, are in the long test of the tool."""
    monkeypatch.chdir(tmp_path)  # below which the recorder has its folder
    written = yaml.safe_load((config_dir() / "nodes.yaml").read_text())
    for make in MADE:
        node = make(context=context)
        names = node.list_parameters([], 0).names
        values = {n: node.get_parameter(n).value for n in names if not IGNORED.match(n)}
        # one that is not set is not given in the file either
        given = {name: value for name, value in values.items() if str(value) not in UNSET}
        assert written.pop(f"/**/{node.get_name()}") == {"ros__parameters": given}
        node.destroy_node()
    assert written.keys() == {"/**/viewer", "/**/player"}


def test_nodes_keep_nothing_under_a_name_of_rclpys_node(context):
    plain = rclpy.create_node("plain", context=context)
    node = SimulatorNode(context=context)
    for name, value in vars(plain).items():
        assert type(vars(node)[name]) is type(value), name
    plain.destroy_node()
    node.destroy_node()


NUMBA_FREE = ["launcher", "recorder", "capture_detector"]


@pytest.mark.parametrize("name", cases(few=NUMBA_FREE[1:2], all=NUMBA_FREE))
def test_nodes_that_compile_nothing_start_without_numba(name):
    program = f"import sys, capture_sim.nodes.{name}\nraise SystemExit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0
