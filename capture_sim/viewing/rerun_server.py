"""The program of rerun: a server of live recordings, or a viewer."""

from __future__ import annotations

import importlib.util
import shutil
import socket
import subprocess
from pathlib import Path

from capture_sim.errors import CaptureSimError

#: All traffic stays on this machine.
LOCALHOST = "127.0.0.1"


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
        The port is taken.
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
