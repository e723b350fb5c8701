"""Take a picture of a rerun recording as a person sees it, without a screen.

    .venv/bin/python tools/rerun_picture.py runs/runs.rrd docs/rerun.png --at 0.18

Needs a Vulkan driver: on Debian mesa-vulkan-drivers and libvulkan1 draw in software.
"""

import argparse
import socket
import subprocess
import sys
import time
from pathlib import Path

from rerun.experimental import ViewerClient

from capture_sim.viewing.rerun_server import LOCALHOST, program
from capture_sim.viewing.rerun_stream import ALIGNED


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--at", type=float, metavar="S", help="since the first touch, s")
    parser.add_argument("--size", default="1600x900", help="pixels (1600x900)")
    options = parser.parse_args()
    with socket.socket() as probe:
        probe.bind((LOCALHOST, 0))
        port = probe.getsockname()[1]
    viewer = subprocess.Popen(
        [
            *(str(program()), str(options.recording), "--headless", "--renderer", "vulkan"),
            *("--bind", LOCALHOST, "--port", str(port), "--window-size", options.size),
            "--hide-welcome-screen",
        ],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        client = connected(port, viewer)
        wait_for(lambda: client.get_state().views and not client.get_state().loading)
        if options.at is not None:
            client.set_time(ALIGNED, duration=options.at, play_state="paused")
        options.picture.write_bytes(settled(client))
    finally:
        viewer.terminate()
        viewer.wait(10)
    print(f"picture in {options.picture}")


def connected(port, viewer):
    for _ in range(120):
        if viewer.poll() is not None:
            sys.exit("the viewer ended: it found no Vulkan driver, most likely")
        try:
            return ViewerClient.connect(f"rerun+http://{LOCALHOST}:{port}/proxy")
        except Exception:
            time.sleep(0.25)
    sys.exit("the viewer does not answer")


def wait_for(true):
    for _ in range(80):
        if true():
            return
        time.sleep(0.25)
    sys.exit("the recording is not loaded")


def settled(client):
    """Take pictures until two in a row are equal."""
    before = b""
    for _ in range(40):
        time.sleep(0.6)
        now = client.take_screenshot()
        if now == before:
            break
        before = now
    return now


if __name__ == "__main__":
    main()
