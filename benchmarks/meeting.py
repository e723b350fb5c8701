"""Do participants that stood still meet again?  Which profile of Fast DDS holds?

    python -m benchmarks.meeting --profile FILE.xml --nodes 20 --stop 7

Plain participants, a process each, forked; every one publishes a number each 0.25 s on a volatile
and a transient-local topic, reliable and KEEP_ALL, and reads all others'.  Each is stopped
once, one after another 0.4 s apart; then half of them at once.  After each the pairs of reader and
writer are listed of which the reader hears nothing: a half match, if it still stands after 30 s.
With a lease of 6 s and stops of 7 s Fast DDS 2.14 leaves some; record them with tcpdump on lo.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import tempfile
import time
from pathlib import Path

PERIOD = 0.25  # s, between two messages of a participant
INTERVAL = 0.4  # s, between the stops of two participants
AGE = 3.0  # s without a message, after which a writer is not heard
LIMIT = 30.0  # s, in which all must hear all again


def take_part(number: int, folder: Path) -> None:
    """Publish and read for ever; write who was heard when to a file."""
    import rclpy
    from rclpy.experimental import EventsExecutor
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile
    from std_msgs.msg import Int32

    rclpy.init()
    node = rclpy.create_node(f"participant_{number}")
    heard: dict[str, float] = {}
    senders = []
    for kind in DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL:
        qos = QoSProfile(history=HistoryPolicy.KEEP_ALL, durability=kind)

        def hear(message: Int32, kind: DurabilityPolicy = kind) -> None:
            heard[f"{message.data} {kind.name}"] = time.time()

        node.create_subscription(Int32, f"heard/{kind.name.lower()}", hear, qos)
        senders.append(node.create_publisher(Int32, f"heard/{kind.name.lower()}", qos))
    executor = EventsExecutor()
    executor.add_node(node)
    due = time.monotonic()
    while True:
        executor.spin_once(0.05)
        if time.monotonic() > due:
            due = time.monotonic() + PERIOD
            for sender in senders:
                sender.publish(Int32(data=number))
            file = folder / f"{number}.new"
            file.write_text(json.dumps(heard), encoding="utf-8")
            file.rename(folder / f"{number}.json")


def unheard(folder: Path, nodes: int) -> list[str]:
    """Return the reader, the writer and the kind of topic for each pair that is not heard."""
    missing = []
    for reader in range(nodes):
        file = folder / f"{reader}.json"
        heard = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
        for writer in range(nodes):
            for kind in "VOLATILE", "TRANSIENT_LOCAL":
                if time.time() - heard.get(f"{writer} {kind}", 0.0) > AGE:
                    missing.append(f"{reader} from {writer} ({kind})")
    return missing


def settle(what: str, folder: Path, nodes: int) -> None:
    """Wait until all hear all, and print after how long, or who does not hear whom."""
    begin = time.monotonic()
    missing = ["not asked"]
    while missing and time.monotonic() < begin + LIMIT:
        time.sleep(0.5)
        missing = unheard(folder, nodes)
    seconds = time.monotonic() - begin
    result = f"{len(missing)} unheard: {missing[:6]}" if missing else f"all after {seconds:.1f} s"
    print(f"{what}: {result}", flush=True)


def main() -> None:
    """Start, stop, continue, look."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--profile", default="config/fast_dds_loopback.xml")
    parser.add_argument("--nodes", type=int, default=20)
    parser.add_argument("--stop", type=float, default=7.0, help="s")
    options = parser.parse_args()
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "SYSTEM_DEFAULT"
    os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(Path(options.profile).resolve())
    pids: list[int] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        try:
            for number in range(options.nodes):
                pid = os.fork()
                if pid == 0:
                    take_part(number, folder)
                pids.append(pid)
            settle("start", folder, options.nodes)
            begin = time.monotonic()
            events = [(i * INTERVAL, pid, signal.SIGSTOP) for i, pid in enumerate(pids)]
            events += [(due + options.stop, pid, signal.SIGCONT) for due, pid, _ in events]
            for due, pid, signum in sorted(events):
                time.sleep(max(0.0, begin + due - time.monotonic()))
                os.kill(pid, signum)
            settle("one after another", folder, options.nodes)
            half = random.sample(pids, len(pids) // 2)
            for pid in half:
                os.kill(pid, signal.SIGSTOP)
            time.sleep(options.stop)
            for pid in half:
                os.kill(pid, signal.SIGCONT)
            settle("half of them at once", folder, options.nodes)
        finally:
            for pid in pids:
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)


if __name__ == "__main__":
    main()
