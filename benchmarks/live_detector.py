"""CPU and lag of the live detector and launcher at the rates of a rig.

    python -m benchmarks.live_detector                    # about 2 minutes
    python -m benchmarks.live_detector --before CHECKOUT  # beside another version, in turn

A driver sends two vehicles at 240 Hz as Odometry, the buffer at 500 Hz and a force at 2 kHz, of one
trial; detector and launcher are processes of their own.  The lag of a status is the newest stamp
that was sent when it came, less its own.  Waiting for others (0.1 s) and the smoother's window are
in it.
"""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import time
from argparse import ArgumentParser
from contextlib import ExitStack
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
RATE, BUFFER_RATE, FORCE_RATE = 240.0, 500.0, 2000.0
NODES = {
    "capture_detector": ["-p", "scene:=tilt_0"],
    "launcher": ["-p", "actuator:=none", "-p", "scene:=tilt_0"],
}
TICKS = os.sysconf("SC_CLK_TCK")
#: Nodes start for so long at least, and find the driver within so much more, s.
STARTED, MATCHED = 3.0, 60.0


def trial():
    """Return the messages of a trial in order: due time (s), topic and bytes without a stamp."""
    sys.path.append(str(ROOT / "tests"))
    from injections import HARD, STAMP_OF_RELEASE, stream  # with the tests

    from capture_sim.detection.measurements import Source
    from capture_sim.messages.convert import HINGE_JOINT, SLIDE_JOINT
    from capture_sim.messages.definitions import blank, typestore
    from capture_sim.messages.topics import (
        CHASER_ODOMETRY,
        JOINT_STATES,
        LOAD_CELL,
        TARGET_ODOMETRY,
    )

    topics = {Source.CHASER: CHASER_ODOMETRY, Source.TARGET: TARGET_ODOMETRY}
    poses = stream("tilt_0", HARD, RATE, np.random.default_rng(0))
    found = []

    def add(topic, stamps, fill, rows):
        message = blank(topic.type_name)
        for stamp, row in zip(stamps.tolist(), rows.tolist(), strict=True):
            fill(message, row)
            data = typestore().serialize_cdr(message, topic.type_name)
            found.append(((stamp - STAMP_OF_RELEASE) / 1e9, topic, bytes(data)))

    def pose(message, row):
        at = message.pose.pose
        at.position.x, at.position.y = row[:2]
        at.orientation.z, at.orientation.w = np.sin(row[2] / 2.0), np.cos(row[2] / 2.0)

    def joints(message, row):
        message.name = [SLIDE_JOINT, HINGE_JOINT]
        message.position = np.array(row[:2])

    def force(message, row):
        message.wrench.force.x = row

    for source, topic in topics.items():
        add(topic, poses.stamps[source], pose, poses.values[source])
    times = poses.stamps[Source.BUFFER]
    ends = int(times[0]), int(times[-1])
    at = np.arange(*ends, int(1e9 / BUFFER_RATE))
    rows = np.column_stack(
        [np.interp(at, times, poses.values[Source.BUFFER][:, i]) for i in (0, 1)]
    )
    add(JOINT_STATES, at, joints, rows)
    at = np.arange(*ends, int(1e9 / FORCE_RATE))
    add(LOAD_CELL, at, force, np.zeros(at.size))
    return sorted(found, key=lambda each: each[0])


def cpu(pid):
    """Return the CPU time of a process, s."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def drive(messages, pids):
    """Send the messages at their times; return the lags (n, 2) at times, the CPU, the verdict."""
    import rclpy
    from rclpy.experimental import EventsExecutor
    from rclpy.signals import SignalHandlerOptions

    from capture_sim.messages.topics import CAPTURE_STATUS
    from capture_sim.nodes.base import dds
    from capture_sim.nodes.base.endpoints import from_bytes, message_class, qos_of

    dds.configure(os.environ)
    # the pool ends this process with SIGTERM, which rclpy would take for its own
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("driver", enable_rosout=False)
    senders = {
        topic: node.create_publisher(message_class(topic.type_name), topic.name, qos_of(topic))
        for topic in {topic for _, topic, _ in messages}
    }
    got, newest = [], 0
    node.create_subscription(
        message_class(CAPTURE_STATUS.type_name),
        CAPTURE_STATUS.name,
        lambda data: got.append((newest, data)),
        qos_of(CAPTURE_STATUS),
        raw=True,
    )
    executor = EventsExecutor()
    executor.add_node(node)
    until = time.monotonic() + STARTED
    while time.monotonic() < until or not all(s.get_subscription_count() for s in senders.values()):
        assert time.monotonic() < until + MATCHED, "a node does not read what the driver sends"
        executor.spin_once(0.05)
    before = {name: cpu(pid) for name, pid in pids.items()}
    zero = time.time_ns() - int(messages[0][0] * 1e9)
    begun = time.monotonic()
    for due, topic, data in messages:
        stamp = zero + int(due * 1e9)
        while time.time_ns() < stamp:
            executor.spin_once(max(0.0, (stamp - time.time_ns()) / 1e9))
        head = bytearray(data)
        head[4:12] = np.array(divmod(stamp, 10**9), dtype="<u4").tobytes()
        senders[topic].publish(bytes(head))
        newest = stamp
    took = time.monotonic() - begun
    used = {name: (cpu(pid) - before[name]) / took for name, pid in pids.items()}
    count = -1
    while count < len(got):  # until nothing has come for a second
        count, until = len(got), time.monotonic() + 1.0
        while time.monotonic() < until:
            executor.spin_once(0.05)
    statuses = [(at, from_bytes(CAPTURE_STATUS, data)) for at, data in got]
    stamps = [(at, s.header.stamp.sec * 10**9 + s.header.stamp.nanosec, s) for at, s in statuses]
    lags = np.array([((stamp - zero) / 1e9, (at - stamp) / 1e9) for at, stamp, _ in stamps])
    final = [(at - stamp) / 1e9 + s.time_in_state for at, stamp, s in stamps if s.final][:1]
    node.destroy_node()
    return lags, used, final


def burn():
    """Use a processor."""
    while True:
        pass


def measure(python, root, messages, busy):
    """Run one trial with the nodes of a checkout; return a row of the table."""
    with ExitStack() as stack:
        for _ in range(busy):
            process = multiprocessing.Process(target=burn, daemon=True)
            process.start()
            stack.callback(process.kill)
        pids = {}
        for name, words in NODES.items():
            command = [python, "-m", "capture_sim.nodes.start", name, "--ros-args", *words]
            node = subprocess.Popen(
                command, cwd=root, stdout=subprocess.DEVNULL, stderr=subprocess.STDOUT
            )
            stack.callback(node.wait)
            stack.callback(node.terminate)
            pids[name] = node.pid
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            lags, used, final = pool.apply(drive, (messages, pids))
    late = lags[:, 1]
    return [
        len(lags),
        *(100.0 * used[name] for name in NODES),
        np.median(late),
        np.percentile(late, 99),
        late.max(),
        final[0] if final else np.nan,
    ]


def main():
    """Measure idle and busy, and print a table."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--before", type=Path, help="another checkout with its environment")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--busy", type=int, nargs="*", default=[0, 6], help="busy processes")
    asked = parser.parse_args()
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    messages = trial()
    sides = {"now": (sys.executable, ROOT)}
    if asked.before:
        sides["before"] = (str(asked.before / ".venv/bin/python"), asked.before)
    print("side busy statuses detector% launcher% lag p50 p99 max s, verdict after its time s")
    for busy in asked.busy:
        for _ in range(asked.rounds):
            for name, (python, root) in sides.items():
                row = measure(python, root, messages, busy)
                print(name, busy, *(f"{x:.3f}" for x in row), flush=True)


if __name__ == "__main__":
    main()
