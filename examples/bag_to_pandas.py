"""Read a recording into pandas with third-party libraries, without capture_sim."""

import sys

import pandas as pd
from mcap_ros2.reader import read_ros2_messages

if len(sys.argv) != 2:
    sys.exit("usage: python bag_to_pandas.py RECORDING.mcap")
rows = [
    {
        "t": message.ros_msg.header.stamp.sec + 1e-9 * message.ros_msg.header.stamp.nanosec,
        "x": message.ros_msg.pose.pose.position.x,
        "y": message.ros_msg.pose.pose.position.y,
    }
    for message in read_ros2_messages(sys.argv[1], topics=["/chaser/odom"])
]
table = pd.DataFrame(rows).set_index("t")
print(table.describe())
