"""The program of rerun: a server of live recordings, or a viewer."""

from __future__ import annotations

import importlib.util
import socket
import subprocess
import time
from pathlib import Path

from capture_sim.base.interrupts import tied
from capture_sim.errors import CaptureSimError

#: All traffic stays on this machine.
LOCALHOST = "127.0.0.1"
#: The server accepts connections within this long, s (wall).
START_TIMEOUT = 30.0


def program() -> Path:
    """Return the program in rerun's Python package; ImportError if rerun is not installed.

    The package's Python wrapper would leave the program running when it is ended itself.
    """
    spec = importlib.util.find_spec("rerun_cli")
    if spec is None or spec.origin is None:
        raise ImportError("rerun is not installed")
    return Path(spec.origin).parent / "rerun"


class RecordingServer:
    """Keeps live recordings for viewers that connect sooner or later.

    It listens on a TCP port of this machine only, and keeps the newest ``memory`` MB.
    CaptureSimError if the port is taken or the server does not start.
    """

    def __init__(self, port: int, memory: int) -> None:
        self.address = f"rerun+http://{LOCALHOST}:{port}/proxy"
        with socket.socket() as probe:
            # a server that ended leaves its port in a state that does not matter
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((LOCALHOST, port))
            except OSError as error:
                raise CaptureSimError(
                    f"port = {port}: {error.strerror or error}; must be a free port"
                ) from None
        command = [str(program()), "--serve-grpc", "--bind", LOCALHOST, "--port", str(port)]
        self._process = subprocess.Popen(
            tied([*command, "--server-memory-limit", f"{memory}MB"]),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        self._await_start(port)

    def _await_start(self, port: int) -> None:
        deadline = time.monotonic() + START_TIMEOUT
        while time.monotonic() < deadline and self._process.poll() is None:
            with socket.socket() as probe:
                if probe.connect_ex((LOCALHOST, port)) == 0:
                    return
            time.sleep(0.02)
        status = self._process.poll()
        if status is None:
            self.close()
        how = f"no answer for {START_TIMEOUT:g} s" if status is None else f"exit status {status}"
        raise CaptureSimError(f"the server of rerun on port {port} has not started: {how}")

    @property
    def pid(self) -> int:
        """Process id of the server."""
        return self._process.pid

    def close(self) -> None:
        """End the server."""
        self._process.terminate()
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
