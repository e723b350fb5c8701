"""Recording of runs as MCAP files, and reading them back; needs no ROS."""

from __future__ import annotations

from capture_sim.recording.live import LiveRecorder, Split
from capture_sim.recording.offline import write_run
from capture_sim.recording.read import Run, read_run
from capture_sim.recording.recover import Recovery, recover
from capture_sim.recording.tally import Tally
from capture_sim.recording.write import RunWriter

__all__ = [
    "LiveRecorder",
    "Recovery",
    "Run",
    "RunWriter",
    "Split",
    "Tally",
    "read_run",
    "recover",
    "write_run",
]
