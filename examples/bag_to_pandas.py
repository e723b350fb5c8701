"""Read a recording into pandas with a third-party library, rosbags, without capture_sim."""

import sys
from pathlib import Path

import pandas as pd
from rosbags.highlevel import AnyReader

if len(sys.argv) != 2:
    sys.exit("usage: python bag_to_pandas.py RECORDING.mcap")
rows = []
with AnyReader([Path(sys.argv[1])]) as reader:
    poses = [connection for connection in reader.connections if connection.topic == "/chaser/odom"]
    for connection, _, data in reader.messages(poses):
        message = reader.deserialize(data, connection.msgtype)
        stamp, position = message.header.stamp, message.pose.pose.position
        rows.append({"t": stamp.sec + 1e-9 * stamp.nanosec, "x": position.x, "y": position.y})
table = pd.DataFrame(rows).set_index("t")
print(table.describe())
