"""Bags of some topics of a recorded run, as another recorder or a bench would leave them."""

from rosbags.rosbag2 import StoragePlugin, Writer

from capture_sim.messages.definitions import typestore
from capture_sim.recording.bag import read_bag

#: What a real bench records at least.
BENCH_TOPICS = (
    ("/chaser/odom", "nav_msgs/msg/Odometry"),
    ("/target/odom", "nav_msgs/msg/Odometry"),
    ("/bench/buffer", "capture_sim/msg/BufferState"),
    ("/contact/wrench", "geometry_msgs/msg/WrenchStamped"),
)


def as_it_is(time, message):
    yield time, message


def rewritten(path, folder, change=as_it_is, topics=BENCH_TOPICS):
    """A bag of some topics of a run, each message changed: times and message, or left out."""
    run, store = read_bag(path), typestore()
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for name, type_name in topics:
            connection = writer.add_connection(name, type_name, typestore=store)
            for time, data in zip(run.log_times(name).tolist(), run.raw(name), strict=True):
                message = store.deserialize_cdr(data, type_name)
                for when, what in change(time, message):
                    writer.write(connection, when, store.serialize_cdr(what, type_name))
    return folder
