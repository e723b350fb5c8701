"""Take a picture of a rerun recording as a person sees it, without a screen.

    .venv/bin/python tools/rerun_picture.py runs/runs.rrd docs/rerun.png --at 0.18

Needs a Vulkan driver: on Debian mesa-vulkan-drivers and libvulkan1 draw in software.
"""

import argparse
import io
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

from PIL import Image
from rerun.experimental import ViewerClient

from capture_sim.viewing.rerun_server import LOCALHOST, program
from capture_sim.viewing.rerun_stream import ALIGNED

MENU_HEIGHT = 37  # pixels
_MESSAGE = 8.0  # s, until the viewer's first message has gone
_PATIENCE = 300.0  # s, with a viewer on a busy machine


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--at", type=float, metavar="S", help="since the first touch, s")
    parser.add_argument("--size", default="1600x900", help="pixels (1600x900)")
    options = parser.parse_args()
    with opened(options.recording, options.size) as client:
        if options.at is not None:
            client.set_time(ALIGNED, duration=options.at, play_state="paused")
        time.sleep(_MESSAGE)
        save_without_menu(settled(client), options.picture)
    print(f"picture in {options.picture}")


def save_without_menu(png, path):
    """Save a picture of the viewer without its menu, which names what this machine lacks."""
    with Image.open(io.BytesIO(png)) as image:
        few = image.crop((0, MENU_HEIGHT, *image.size)).convert("RGB")
        few.quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)


@contextmanager
def opened(recording, size="1600x900"):
    """Open a recording in a viewer; yield its client when all of it is loaded."""
    with socket.socket() as probe:
        probe.bind((LOCALHOST, 0))
        port = probe.getsockname()[1]
    viewer = subprocess.Popen(
        [
            *(str(program()), str(recording), "--headless", "--renderer", "vulkan"),
            *("--bind", LOCALHOST, "--port", str(port), "--window-size", size),
            "--hide-welcome-screen",
        ],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        client = tried(
            viewer, lambda: ViewerClient.connect(f"rerun+http://{LOCALHOST}:{port}/proxy")
        )
        tried(viewer, lambda: loaded(client.get_state()))
        yield client
    finally:
        viewer.terminate()
        viewer.wait(60)


def loaded(state):
    if not state.recordings or not state.views or state.loading:
        raise TimeoutError("the recording is not loaded")


def tried(viewer, action):
    """Return what an action returns, tried again while it fails and the viewer lives."""
    deadline = time.monotonic() + _PATIENCE
    while True:
        try:
            return action()
        except Exception:
            if viewer.poll() is not None:
                sys.exit("the viewer ended: it found no Vulkan driver, most likely")
            if time.monotonic() > deadline:
                raise
            time.sleep(0.25)


def settled(client, view=None):
    """Return a picture of all or of one view, taken until two in a row are equal."""
    before, deadline = b"", time.monotonic() + _PATIENCE
    while True:
        time.sleep(0.5)
        try:
            now = client.take_screenshot(view)
        except TimeoutError:  # the machine is busy
            now = b""
        if now == before != b"" or time.monotonic() > deadline:
            return now
        before = now


if __name__ == "__main__":
    main()
