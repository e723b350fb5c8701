"""The program ``rerun``, and its start as a server that keeps live recordings for viewers."""

from __future__ import annotations

import importlib.util
import socket
import subprocess
import time
from pathlib import Path

from capture_sim.base.interrupts import tied
from capture_sim.errors import CaptureSimError

#: Address of the server: only programs on this machine can connect.
LOCALHOST = "127.0.0.1"
#: Longest wait until the server accepts connections, s (wall).
START_TIMEOUT = 30.0


def program() -> Path:
    """Return the path of the executable ``rerun`` that the Python package of rerun contains.

    Start this file and not the package's Python script of the same name: if that script is ended,
    the executable that it has started keeps running.  ImportError if rerun is not installed.
    """
    spec = importlib.util.find_spec("rerun_cli")
    if spec is None or spec.origin is None:
        raise ImportError("rerun is not installed")
    return Path(spec.origin).parent / "rerun"


class RecordingServer:
    """A server process that receives live recordings and keeps them for viewers that connect later.

    It listens on the TCP port ``port`` of this machine only, and keeps the newest ``memory`` MB.
    ``address`` is the URL for senders and viewers.  The constructor returns when the server accepts
    connections.  CaptureSimError if the port is taken or the server does not start, ImportError if
    rerun is not installed.
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
        """End the server process; kill it if it has not ended 5 s after SIGTERM."""
        self._process.terminate()
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
