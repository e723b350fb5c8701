"""A ROS domain for each test, and in it the one DDS participant of this process."""

import os
from contextlib import contextmanager

import rclpy
from rclpy.signals import SignalHandlerOptions

from tests.domains import claim_domain

#: Of each open domain, the present one last, the context once that is needed; first the session's.
_open = [None]


@contextmanager
def own_domain():
    """Let nodes and clients meet in a domain that nobody else has.

    End the nodes before: Fast DDS may spin for ever if a participant is destroyed while another
    comes or goes (see capture_sim.base.interrupts.end_within), and this process's is destroyed
    here.
    """
    outer = os.environ.get("ROS_DOMAIN_ID", "0")
    number, lock = claim_domain()
    os.environ["ROS_DOMAIN_ID"] = str(number)
    _open.append(None)
    try:
        yield
    finally:
        context = _open.pop()
        if context is not None:
            context.first_node.destroy_node()
            context.try_shutdown()
        os.environ["ROS_DOMAIN_ID"] = outer
        lock.close()


def participant():
    """Return the context of this process in the present domain: all its nodes share it.

    A participant lives as long as one of its nodes; the first one has no topics.
    """
    if _open[-1] is None:
        context = rclpy.Context()
        rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
        context.first_node = rclpy.create_node(
            "_tests", context=context, enable_rosout=False, start_parameter_services=False
        )
        _open[-1] = context
    return _open[-1]
