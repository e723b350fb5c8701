"""Units of the numbers in messages."""

import numpy as np
import pytest

from capture_sim.dynamics.samples import SAMPLE, columns_of
from capture_sim.messages.definitions import typestore
from capture_sim.messages.units import unit_of
from capture_sim.scene.units import in_si

OURS = sorted(name for name in typestore().fielddefs if name.startswith("capture_sim/msg/"))


@pytest.mark.parametrize("type_name", OURS)
def test_every_decimal_number_of_our_messages_has_a_unit(type_name):
    for field, (_, definition) in typestore().fielddefs[type_name][1]:
        if "float64" in str(definition):
            unit = unit_of(type_name, field)
            assert in_si(f"2 {unit}", unit) == 2.0, (field, unit)


def test_units_of_a_sample_are_those_of_its_equations():
    """An energy is force times way, a torque times angle; impulse is force times time."""
    names = columns_of(np.zeros(1, SAMPLE))
    units = {name: unit_of("capture_sim/msg/BenchState", name) for name in names}
    assert {units[name] for name in ("phase", "walls", "at_rest", "touches")} == {""}
    assert units["q.theta_P"] == units["torsion"] == "rad"
    assert units["v.theta_P"] == "rad/s"
    assert units["q.h"] == units["axial_stroke"] == units["penetration.-y"] == "m"
    assert (units["axial_force"], units["impulse.+y"]) == ("N", "N s")
    assert (units["torsion_torque"], units["energy_residual"]) == ("N m", "J")


@pytest.mark.parametrize(
    "type_name, column, unit",
    [
        ("nav_msgs/msg/Odometry", "pose.pose.position.x", "m"),
        ("nav_msgs/msg/Odometry", "pose.pose.orientation.x", ""),
        ("nav_msgs/msg/Odometry", "twist.twist.angular.z", "rad/s"),
        ("nav_msgs/msg/Odometry", "header.stamp.nanosec", "ns"),
        ("geometry_msgs/msg/WrenchStamped", "wrench.torque.y", "N m"),
        ("geometry_msgs/msg/AccelStamped", "accel.linear.x", ""),
        ("sensor_msgs/msg/JointState", "position.0", ""),
        ("capture_sim/msg/OfALaterVersion", "mass", ""),
    ],
)
def test_units_of_standard_messages(type_name, column, unit):
    assert unit_of(type_name, column) == unit
