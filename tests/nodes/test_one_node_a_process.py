"""Nodes of the suite are no components: a process has one, which serves itself."""

from contextlib import closing

import pytest
import rclpy
from rclpy.executors import MultiThreadedExecutor

from capture_sim.errors import CaptureSimError
from capture_sim.nodes.base.node import BenchNode
from tests.nodes.own_domain import participant


def test_a_second_node_and_another_executor_are_refused():
    rclpy.init(args=[])
    try:
        with closing(BenchNode("first")) as node:
            with pytest.raises(CaptureSimError, match="second: this process has the node first"):
                BenchNode("second")
            executor = MultiThreadedExecutor()
            with pytest.raises(CaptureSimError, match="first: serves itself in one thread"):
                executor.add_node(node)
            executor.shutdown()
            node.serve(0.01)
            with closing(BenchNode("of_another_context", context=participant())):
                pass
        with closing(BenchNode("third")):  # the first one has left
            pass
    finally:
        rclpy.try_shutdown()
