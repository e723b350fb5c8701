"""Nodes keep to names of their own, and compile nothing that they do not need."""

import subprocess
import sys

import pytest
import rclpy
from cases import cases

from capture_sim.nodes.simulator import SimulatorNode
from tests.nodes.own_domain import participant


@pytest.fixture
def context(_domain):
    return participant()


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
