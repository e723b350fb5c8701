"""Kills at random moments: does the next start work, and which files remain?

    python -m benchmarks.kills --kills 200 [--profile FILE.xml]

One suite after another in one ROS_DOMAIN_ID: simulator, launcher, detector and recorder, forked
from a process that has loaded everything.  A random node is killed (kill -9) at a random moment
from its start to the end of a run, the others are ended, and every so many kills a run is demanded
of a suite started at once.  Prints how many of these runs were complete, and the files that Fast
DDS has left in /dev/shm.
"""

from __future__ import annotations

import argparse
import os
import random
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from capture_sim.recording.bag import read_bag
from tests.nodes.bench_processes import processes
from tests.nodes.forked import Forked

NODES = ("simulator", "launcher", "capture_detector", "recorder")
#: A node is killed this long after its start at most, s.
LATEST = 3.0
#: A suite that has not ended by then is stuck, s.
LIMIT = 90.0


def leftovers() -> int:
    """Return how many files of Fast DDS are in /dev/shm."""
    return len(list(Path("/dev/shm").glob("*fast*")))


def start_suite(start: Callable[..., Any], out: Path, rtf: float) -> dict[str, Any]:
    """Start four nodes; the simulator waits for the others."""
    waited = "[launcher, capture_detector, recorder]"
    suite = {name: start(name) for name in NODES[1:3]}
    suite["recorder"] = start("recorder", out=out)
    suite["simulator"] = start("simulator", rtf=rtf, wait_for=waited)
    return suite


def kill_one(out: Path, source: random.Random) -> str:
    """Start a suite, kill one of its nodes at a random moment, then all others; name it."""
    with processes(Forked) as start:
        suite = start_suite(start, out, 2.0)
        victim = source.choice(NODES)
        time.sleep(source.uniform(0.0, LATEST))
        suite.pop(victim).process.kill()
        for node in suite.values():
            if source.random() < 0.5:
                node.process.kill()
    return victim


def is_next_complete(out: Path) -> bool:
    """Return whether a suite started now ends by itself with a whole recording."""
    with processes(Forked) as start:
        suite = start_suite(start, out, 0.0)
        begin = time.monotonic()
        while suite["simulator"].process.poll() is None and time.monotonic() < begin + LIMIT:
            time.sleep(0.1)
        if suite["simulator"].process.poll() != 0:
            print(suite["simulator"].text, flush=True)
            return False
        if suite["recorder"].end() != 0:
            return False
    return read_bag(out / "tilt_0.mcap").complete


def main() -> None:
    """Kill, start, count."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--every", type=int, default=1, help="kills before each run")
    parser.add_argument("--profile", help="profile of Fast DDS in place of the nodes' own")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="stop after so long")
    options = parser.parse_args()
    if options.profile:
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "SYSTEM_DEFAULT"
        os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(Path(options.profile).resolve())
    source, before, begin = random.Random(1), leftovers(), time.monotonic()
    runs = complete = kills = 0
    with tempfile.TemporaryDirectory() as folder:
        while kills < options.kills and time.monotonic() < begin + options.seconds:
            kill_one(Path(folder, f"killed_{kills}"), source)
            kills += 1
            if kills % options.every == 0:
                runs += 1
                complete += is_next_complete(Path(folder, f"run_{kills}"))
    print(
        f"{kills} kills; {complete} of {runs} runs after them complete; files in /dev/shm: "
        f"{before} before, {leftovers()} after; {time.monotonic() - begin:.0f} s"
    )


if __name__ == "__main__":
    main()
