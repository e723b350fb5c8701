"""The program of rerun: a server of live recordings, or a viewer."""

from __future__ import annotations

import importlib.util
import shutil
import socket
import subprocess
import time
from pathlib import Path

from capture_sim.errors import CaptureSimError

#: All traffic stays on this machine.
LOCALHOST = "127.0.0.1"
#: The server accepts connections within this long, s (wall).
START_TIMEOUT = 30.0


def program() -> Path:
    """Return the program that rerun's Python package brings along.

    Its Python wrapper would stay between us and it, and leave it running when it is ended.

    Raises
    ------
    ImportError
        rerun is not installed.
    """
    found = importlib.util.find_spec("rerun_cli")
    if found is None or found.origin is None:
        raise ImportError("rerun is not installed")
    return Path(found.origin).parent / "rerun"


class RecordingServer:
    """Keeps live recordings in bounded memory, for viewers that connect sooner or later.

    Parameters
    ----------
    port
        TCP port, on this machine only.
    memory
        MB; beyond it the oldest data goes.

    Raises
    ------
    CaptureSimError
        The port is taken, or the server does not start.
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
                    f"port {port}: {error.strerror or error}; must be one that is free"
                ) from None
        # a killed viewer cannot end its server: then the system does, where util-linux is there
        keeper = shutil.which("setpriv")
        self._process = subprocess.Popen(
            [
                *((keeper, "--pdeathsig", "TERM") if keeper else ()),
                *(str(program()), "--serve-grpc", "--bind", LOCALHOST, "--port", str(port)),
                *("--server-memory-limit", f"{memory}MB"),
            ],
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
        """Of the server's process."""
        return self._process.pid

    def close(self) -> None:
        """End the server."""
        self._process.terminate()
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
