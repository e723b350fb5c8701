"""Shared memory beside UDP on loopback: latency at 1 kHz, a flood, and processor time.

    python -m benchmarks.transports --pairs 4

Each pair runs both transports, in turn first.  Two plain processes: 180 bytes, reliable, KEEP_ALL;
the profile is the nodes' own, with shared memory added for the other side.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from capture_sim.base.resources import config_dir

ENDS = """
import resource, sys, time
import rclpy
from rclpy.experimental import EventsExecutor
from rclpy.qos import HistoryPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String
role, count, period = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # SIGTERM ends this process
node = rclpy.create_node(role)
qos = QoSProfile(history=HistoryPolicy.KEEP_ALL)
def used():
    own = resource.getrusage(resource.RUSAGE_SELF)
    return own.ru_utime + own.ru_stime
if role == "writer":
    sender = node.create_publisher(String, "timed", qos)
    while not sender.get_subscription_count():
        time.sleep(0.01)
    time.sleep(0.5)
    begin, start = used(), time.monotonic()
    for i in range(count):
        time.sleep(max(0.0, start + i * period - time.monotonic()))
        while True:
            text = f"{time.monotonic_ns():020d}" + 156 * "x"
            try:
                sender.publish(String(data=text))
                break
            except RuntimeError:  # full queue
                time.sleep(0.0005)
    print(used() - begin, flush=True)
    sys.stdin.readline()
else:
    late, begin = [], None
    def hear(message):
        global begin
        begin = begin or (used(), time.monotonic())
        late.append((time.monotonic_ns() - int(message.data[:20])) * 1e-3)
    executor = EventsExecutor()
    node.create_subscription(String, "timed", hear, qos)
    executor.add_node(node)
    limit = time.monotonic() + 120.0
    while len(late) < count and time.monotonic() < limit:
        executor.spin_once(0.1)
    import numpy
    rate = len(late) / (time.monotonic() - begin[1])
    print(*numpy.percentile(late, (50, 99, 99.9)), used() - begin[0], len(late), rate)
import os
sys.stdout.flush()
os._exit(0)  # DDS's own end may spin while another participant leaves
"""

SHARED = """
    <transport_descriptor><transport_id>shared_memory</transport_id><type>SHM</type>
    </transport_descriptor>
  </transport_descriptors>"""


def with_shared_memory(folder: Path) -> Path:
    """Write the nodes' profile with shared memory besides UDP; return its file."""
    text = (config_dir() / "fast_dds_loopback.xml").read_text(encoding="utf-8")
    text = text.replace("</transport_descriptors>", SHARED.lstrip("\n"))
    used = "<userTransports>"
    text = text.replace(used, f"{used}<transport_id>shared_memory</transport_id>")
    file = folder / "shared_memory.xml"
    file.write_text(text, encoding="utf-8")
    return file


def run_pair(profile: Path, count: int, period: float) -> list[float]:
    """Return latency p50, p99, p99.9, us; CPU of both per message, us; messages read; rate, 1/s."""
    environment = os.environ | {
        "FASTRTPS_DEFAULT_PROFILES_FILE": str(profile),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT",
    }

    def begin(role: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-c", ENDS, role, str(count), str(period)],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    reader, writer = begin("reader"), begin("writer")
    assert reader.stdout is not None
    assert writer.stdout is not None
    p50, p99, p999, cpu, heard, rate = (float(word) for word in reader.stdout.read().split())
    cpu += float(writer.stdout.readline())
    writer.communicate("\n")
    reader.wait()
    return [p50, p99, p999, 1e6 * cpu / count, heard, rate]


def main() -> None:
    """Measure in alternating pairs and print each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", type=int, default=4)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        profiles = {
            "shared memory": with_shared_memory(Path(folder)),
            "UDP": config_dir() / "fast_dds_loopback.xml",
        }
        print("transport, flow: latency p50, p99, p99.9, us; CPU, us a message; read; 1/s")
        for pair in range(options.pairs):
            for name in list(profiles)[:: 1 - 2 * (pair % 2)]:
                for flow, count, period in (("1 kHz", 5000, 1e-3), ("flood", 50_000, 0.0)):
                    values = run_pair(profiles[name], count, period)
                    words = " ".join(f"{value:.0f}" for value in values)
                    print(f"{name}, {flow}: {words}", flush=True)


if __name__ == "__main__":
    main()
