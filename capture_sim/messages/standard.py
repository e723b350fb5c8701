"""ROS 2 message types that topics of the suite use, in the form in which rosbags describes them.

Loading all types of ROS 2 takes longer than everything else that a node loads.  Tests compare the
types here with those of rosbags.
"""

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Typesdict

_BASE, _NAME, _ARRAY = Nodetype.BASE, Nodetype.NAME, Nodetype.ARRAY
_SEQUENCE = Nodetype.SEQUENCE
#: Constants and fields of each type.
STANDARD: Typesdict = {
    "builtin_interfaces/msg/Time": (
        [],
        [("sec", (_BASE, ("int32", 0))), ("nanosec", (_BASE, ("uint32", 0)))],
    ),
    "geometry_msgs/msg/Point": (
        [],
        [
            ("x", (_BASE, ("float64", 0))),
            ("y", (_BASE, ("float64", 0))),
            ("z", (_BASE, ("float64", 0))),
        ],
    ),
    "geometry_msgs/msg/Pose": (
        [],
        [
            ("position", (_NAME, "geometry_msgs/msg/Point")),
            ("orientation", (_NAME, "geometry_msgs/msg/Quaternion")),
        ],
    ),
    "geometry_msgs/msg/PoseStamped": (
        [],
        [("header", (_NAME, "std_msgs/msg/Header")), ("pose", (_NAME, "geometry_msgs/msg/Pose"))],
    ),
    "geometry_msgs/msg/PoseWithCovariance": (
        [],
        [
            ("pose", (_NAME, "geometry_msgs/msg/Pose")),
            ("covariance", (_ARRAY, ((_BASE, ("float64", 0)), 36))),
        ],
    ),
    "geometry_msgs/msg/Quaternion": (
        [],
        [
            ("x", (_BASE, ("float64", 0))),
            ("y", (_BASE, ("float64", 0))),
            ("z", (_BASE, ("float64", 0))),
            ("w", (_BASE, ("float64", 0))),
        ],
    ),
    "geometry_msgs/msg/Twist": (
        [],
        [
            ("linear", (_NAME, "geometry_msgs/msg/Vector3")),
            ("angular", (_NAME, "geometry_msgs/msg/Vector3")),
        ],
    ),
    "geometry_msgs/msg/TwistWithCovariance": (
        [],
        [
            ("twist", (_NAME, "geometry_msgs/msg/Twist")),
            ("covariance", (_ARRAY, ((_BASE, ("float64", 0)), 36))),
        ],
    ),
    "geometry_msgs/msg/Vector3": (
        [],
        [
            ("x", (_BASE, ("float64", 0))),
            ("y", (_BASE, ("float64", 0))),
            ("z", (_BASE, ("float64", 0))),
        ],
    ),
    "geometry_msgs/msg/Wrench": (
        [],
        [
            ("force", (_NAME, "geometry_msgs/msg/Vector3")),
            ("torque", (_NAME, "geometry_msgs/msg/Vector3")),
        ],
    ),
    "geometry_msgs/msg/WrenchStamped": (
        [],
        [
            ("header", (_NAME, "std_msgs/msg/Header")),
            ("wrench", (_NAME, "geometry_msgs/msg/Wrench")),
        ],
    ),
    "nav_msgs/msg/Odometry": (
        [],
        [
            ("header", (_NAME, "std_msgs/msg/Header")),
            ("child_frame_id", (_BASE, ("string", 0))),
            ("pose", (_NAME, "geometry_msgs/msg/PoseWithCovariance")),
            ("twist", (_NAME, "geometry_msgs/msg/TwistWithCovariance")),
        ],
    ),
    "rosgraph_msgs/msg/Clock": ([], [("clock", (_NAME, "builtin_interfaces/msg/Time"))]),
    "sensor_msgs/msg/JointState": (
        [],
        [
            ("header", (_NAME, "std_msgs/msg/Header")),
            ("name", (_SEQUENCE, ((_BASE, ("string", 0)), 0))),
            ("position", (_SEQUENCE, ((_BASE, ("float64", 0)), 0))),
            ("velocity", (_SEQUENCE, ((_BASE, ("float64", 0)), 0))),
            ("effort", (_SEQUENCE, ((_BASE, ("float64", 0)), 0))),
        ],
    ),
    "std_msgs/msg/Bool": ([], [("data", (_BASE, ("bool", 0)))]),
    "std_msgs/msg/String": ([], [("data", (_BASE, ("string", 0)))]),
    "tf2_msgs/msg/TFMessage": (
        [],
        [("transforms", (_SEQUENCE, ((_NAME, "geometry_msgs/msg/TransformStamped"), 0)))],
    ),
    "geometry_msgs/msg/TransformStamped": (
        [],
        [
            ("header", (_NAME, "std_msgs/msg/Header")),
            ("child_frame_id", (_BASE, ("string", 0))),
            ("transform", (_NAME, "geometry_msgs/msg/Transform")),
        ],
    ),
    "geometry_msgs/msg/Transform": (
        [],
        [
            ("translation", (_NAME, "geometry_msgs/msg/Vector3")),
            ("rotation", (_NAME, "geometry_msgs/msg/Quaternion")),
        ],
    ),
    "std_msgs/msg/Header": (
        [],
        [("stamp", (_NAME, "builtin_interfaces/msg/Time")), ("frame_id", (_BASE, ("string", 0)))],
    ),
}
