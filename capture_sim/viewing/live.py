"""The part of the live viewer that does not use ROS: it shows samples in rerun as they arrive.

Its load is bounded: samples are collected and sent to rerun's server a few times a second, and the
server keeps only a limited number of MB.
"""

from __future__ import annotations

import time

import numpy as np
import rerun as rr

from capture_sim.dynamics.samples import Phase
from capture_sim.scene.parts import Scene
from capture_sim.viewing import style
from capture_sim.viewing.rerun_bench import BenchLog
from capture_sim.viewing.rerun_layout import blueprint
from capture_sim.viewing.rerun_plots import PlotLog, event_text
from capture_sim.viewing.rerun_server import RecordingServer
from capture_sim.viewing.rerun_stream import RunStream

#: If the first sample is later than this, s since the release, an event says what is not shown.
LATEST_JOIN = 0.1

_BEGINS = {"landed": Phase.COAST, "rail_end": Phase.FREE, "latched": Phase.LATCHED}


class LiveView:
    """Shows runs in rerun while they are simulated or measured, one run after the other.

    Each run is a rerun recording of its own.  The recordings go to a server process that listens on
    the TCP port ``port`` of this machine.  The server keeps the newest ``memory`` MB for viewers
    that connect late.  ``refresh`` is the rate of updates, Hz (wall).  ``address`` is the URL for
    viewers, ``server_pid`` the process id of the server.  CaptureSimError if the port is taken or
    the server does not start.
    """

    def __init__(self, port: int, memory: int = 64, refresh: float = 10.0) -> None:
        self._server = RecordingServer(port, memory)
        self.address, self.server_pid = self._server.address, self._server.pid
        self._memory = memory
        self._period = 1.0 / refresh
        self._recording: rr.RecordingStream | None = None

    def begin(self, name: str, scene: Scene, *, measured: bool = False) -> None:
        """Begin to show a run, and end the run that was shown before.

        ``scene``: gives the geometry.  ``measured``: True for a real bench.  Its samples contain no
        energies, and its phases coast, free and latched begin with their events, see :meth:`event`.
        """
        self.end()
        # an application of its own, so that each run keeps its layout
        self._recording = rr.RecordingStream(f"capture_sim {name}", recording_id=None)
        title = f"{name}, live"
        layout = blueprint(
            [scene], [name], [title], aligned=False, live=True, energies=not measured
        )
        self._recording.connect_grpc(self.address, default_blueprint=layout)
        stream = RunStream(self._recording, name)
        self._bench = BenchLog(stream, scene, style.BLUE)
        self._plots = PlotLog(stream, style.BLUE)
        stream.scene(title, scene)
        self._pending: list[np.ndarray] = []
        self._last_row: np.ndarray | None = None  # of what is shown
        self._last_logged = time.monotonic()
        self._measured, self._joined = measured, False
        self._phase: Phase | None = None
        self._unloaded = Phase.FREE  # phase of a measured run while the tip does not touch
        self._verdict = ""

    def take(self, samples: np.ndarray) -> None:
        """Add samples, (n,) of dtype SAMPLE, which must be later than all earlier ones.

        They are shown at the next update.  Without a run, i.e. before :meth:`begin` or after
        :meth:`end`, this and all other methods that show data do nothing.
        """
        if self._recording is None:
            return
        if not self._joined:
            self._joined = True
            self._note_begin(float(samples["t"][0]))
        self._pending.append(samples)
        if time.monotonic() - self._last_logged >= self._period:
            self.show()

    def show(self) -> None:
        """Show all samples that were added and are not yet shown, without waiting for an update."""
        if self._recording is None:
            return
        self._last_logged = time.monotonic()
        if not self._pending:
            return
        samples = np.concatenate(self._pending)
        self._pending.clear()
        self._bench.motion(samples, samples["walls"] != 0)
        before = samples[:0] if self._last_row is None else self._last_row
        self._bench.trail_piece(np.append(before, samples))
        self._last_row = samples[-1:]
        self._plots.curves(samples)
        for t, number in zip(samples["t"].tolist(), samples["phase"].tolist(), strict=True):
            phase = Phase(number)
            if self._measured and (phase is Phase.FREE or self._unloaded is Phase.LATCHED):
                phase = self._unloaded
            if phase is not self._phase:
                self._phase = phase
                self._plots.states("phase", np.array([t]), [phase.label])

    def touch(self, t: float, peak_force: float) -> None:
        """Show a mark at the peak of a touch; ``t``: s since the release, ``peak_force``: N."""
        if self._recording is not None:
            self._plots.mark_touches(np.array([t]), np.array([peak_force]))

    def event(self, t: float, kind: str, detail: str = "") -> None:
        """Show an event as a line of text; ``t``: s since the release, ``kind``: e.g. ``latched``.

        In a measured run, the events landed, rail_end and latched also begin a phase, because no
        sensor measures these phases.
        """
        if self._recording is not None:
            self._plots.note(np.array([t]), [event_text(kind, detail)])
            self._unloaded = _BEGINS.get(kind, self._unloaded)

    def verdict(self, t: float, state: str) -> None:
        """Show a state of the detector from ``t`` on, s since the release, if it is a new one."""
        if self._recording is not None and state != self._verdict:
            self._verdict = state
            self._plots.states("verdict", np.array([t]), [state])

    def end(self) -> None:
        """Show all samples not yet shown and end the run; the server keeps its data for viewers.

        RuntimeError of rerun if the server can no longer be reached.
        """
        if self._recording is not None:
            self.show()
            self._recording.flush()
            self._recording.disconnect()
            self._recording = None

    def close(self) -> None:
        """End the run and the server process; a server that has ended already is no error."""
        try:
            self.end()
        except RuntimeError:
            # Ctrl-C reaches the whole group: the server may have ended before
            self._recording = None
        finally:
            self._server.close()

    def _note_begin(self, first: float) -> None:
        detail = f"a viewer that connects later sees the newest {self._memory} MB"
        if first > LATEST_JOIN:
            self.event(first, f"joined {first:.2f} s after the release, not shown before", detail)
        else:
            self.event(first, "shown from the beginning", detail)
