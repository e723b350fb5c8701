"""Recordings for rerun: read from a file, and received as a viewer does who connects."""

from __future__ import annotations

import signal
import subprocess
import time

import numpy as np
from ports import free_port
from rerun.chunk import RrdReader

from capture_sim.viewing.rerun_server import program


def chunks(rrd):
    by_path = {}
    for chunk in RrdReader(rrd).stream():
        by_path.setdefault(str(chunk.entity_path), []).append(chunk)
    return by_path


def column(found, path, ending, timeline="sim_time"):
    """Return times (ns) and values (first of each row, or all of several) of a component."""
    times, values = [], []
    for chunk in found[path]:
        batch = chunk.to_record_batch()
        names = [n for n in batch.schema.names if n.endswith(ending)]
        if chunk.is_static or not names or timeline not in batch.schema.names:
            continue
        times += batch.column(timeline).to_numpy().astype("i8").tolist()
        values += [row[0] if len(row) == 1 else row for row in batch.column(names[0]).to_pylist()]
    order = np.argsort(times, kind="stable")
    return np.array(times)[order], np.array(values)[order]


def seen(address, path, check, timeout=600.0):
    """Connect to a server as a viewer does, until what has come, by entity, passes a check."""
    command = [str(program()), address, "--save", str(path)]
    command += ["--bind", "127.0.0.1", "--port", str(free_port())]
    viewer = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + timeout
    try:
        while True:
            time.sleep(0.25)
            try:
                return check(chunks(path))
            except (AssertionError, LookupError, ValueError, OSError, RuntimeError):
                if time.monotonic() > deadline:  # else there is more to come
                    raise
    finally:
        viewer.send_signal(signal.SIGINT)
        viewer.wait(600)
