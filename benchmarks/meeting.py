"""Do participants that stood still meet again?  Which profile of Fast DDS holds?

    python -m benchmarks.meeting --profile FILE.xml --nodes 20 --stop 7

Plain participants, a process each, forked; every one publishes a number each 0.25 s on a volatile
and a transient-local topic, reliable and KEEP_ALL, and reads all others'.  Each is stopped
once, one after another 0.4 s apart; then half of them at once.  After each, the pairs of reader and
writer are listed of which the reader hears nothing 30 s after the last stop, and whether each
knows the other: in a half match only one does.  docs/evidence/node_suite.md shows its packets and
how to record them.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import random
import signal
import tempfile
import time
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

PERIOD = 0.25  # s, between two messages of a participant
INTERVAL = 0.4  # s, between the stops of two participants
KINDS = "VOLATILE", "TRANSIENT_LOCAL"
AGE = 3.0  # s without a message, after which a writer is not heard
LIMIT = 30.0  # s, in which all must hear all again
SHOWN = 20  # pairs that are printed


def take_part(number: int, folder: Path) -> None:
    """Publish and read for ever; write to a file who was heard when, and which GIDs are known."""
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
            writers = node.get_publishers_info_by_topic("heard/volatile")
            readers = node.get_subscriptions_info_by_topic("heard/volatile")
            state = {
                "heard": heard,
                "own": [process(i) for i in writers if i.node_name == node.get_name()],
                "writers": [process(info) for info in writers],
                "readers": [process(info) for info in readers],
            }
            file = folder / f"{number}.new"
            file.write_text(json.dumps(state), encoding="utf-8")
            file.rename(folder / f"{number}.json")


def process(info: Any) -> str:
    """Return the part of an endpoint's GID that all endpoints of a DDS participant have."""
    return bytes(info.endpoint_gid[:12]).hex()


def unheard(folder: Path, nodes: int) -> list[str]:
    """Return each pair of writer and reader of which the reader hears nothing, and who is known."""
    files = [folder / f"{number}.json" for number in range(nodes)]
    empty: dict[str, Any] = {"heard": {}, "own": [], "writers": [], "readers": []}
    states = [json.loads(f.read_text(encoding="utf-8")) if f.exists() else empty for f in files]
    missing = []
    for reader, writer in itertools.product(range(nodes), repeat=2):
        there, here = states[writer], states[reader]
        ages = {kind: time.time() - here["heard"].get(f"{writer} {kind}", 0.0) for kind in KINDS}
        silent = [kind for kind in KINDS if ages[kind] > AGE]
        if silent:
            topics = "" if len(silent) == len(KINDS) else f" ({silent[0]})"
            knows = set(there["own"]) & set(here["writers"])
            known = set(here["own"]) & set(there["readers"])
            half = "half match: " if bool(knows) != bool(known) else ""
            missing.append(
                f"{half}{reader} from {writer}{topics}: reader {'has' if knows else 'lacks'} the "
                f"writer, writer {'has' if known else 'lacks'} the reader"
            )
    return missing


def settle(what: str, folder: Path, nodes: int) -> None:
    """Wait until all hear all, and print after how long, or who does not hear whom.

    The first look comes when what was heard before has aged.
    """
    begin = time.monotonic()
    missing = ["not asked"]
    time.sleep(AGE)
    while missing and time.monotonic() < begin + LIMIT:
        time.sleep(0.5)
        missing = unheard(folder, nodes)
    if missing:
        halves = sum(text.startswith("half") for text in missing)
        print(f"{what}: {len(missing)} pairs unheard, {halves} half matches", flush=True)
        print("".join(f"  {text}\n" for text in missing[:SHOWN]), end="", flush=True)
    else:
        print(f"{what}: all after {time.monotonic() - begin:.1f} s", flush=True)


def times_of(profile: Path) -> str:
    """Return the lease and the period of announcements in a profile of Fast DDS."""
    texts = []
    for name in "leaseDuration", "leaseAnnouncement":
        value = ElementTree.parse(profile).find(f".//{{*}}{name}")
        parts = {} if value is None else {part.tag.rpartition("}")[2]: part.text for part in value}
        seconds = float(parts.get("sec") or 0) + 1e-9 * float(parts.get("nanosec") or 0)
        texts.append(f"{name} {seconds:g} s" if parts else f"{name} of Fast DDS")
    return ", ".join(texts)


def main() -> None:
    """Start, stop, continue, look."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--profile", default="config/fast_dds_loopback.xml")
    parser.add_argument("--nodes", type=int, default=20)
    parser.add_argument("--stop", type=float, default=7.0, help="s")
    options = parser.parse_args()
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "SYSTEM_DEFAULT"
    profile = Path(options.profile).resolve()
    os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(profile)
    print(f"{times_of(profile)}; {options.nodes} nodes stopped for {options.stop:g} s", flush=True)
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
