"""The live viewer: what someone sees who connects, sooner or later."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from capture_sim.dynamics.samples import Phase
from capture_sim.errors import CaptureSimError
from capture_sim.run.reconstruction import measured_samples
from capture_sim.run.series import Series, series_in
from capture_sim.viewing.shapes import tip_in_cone

pytest.importorskip("rerun", reason="needs rerun")

from ports import free_port
from rrd import column, seen

from capture_sim.viewing.live import LiveView

# what is saved while it comes has no table of contents at its end
pytestmark = pytest.mark.filterwarnings("ignore:RRD file has no footer")


@pytest.fixture(scope="module")
def run(runs):
    return runs[1]


@pytest.fixture
def live():
    view = LiveView(free_port(), memory=16)
    yield view
    view.close()


def measurements(scene, samples):
    """Return samples as a bench without the simulator's knowledge would give them."""
    t, series = samples["t"], series_in(samples)
    series |= {name: Series(t, samples[name]) for name in ("normal_force", "walls")}
    series["string_phase"] = Series(t, samples["phase"])
    for name in ("string_tension", "mass_height", "mass_speed"):
        series[name] = Series(t, samples[name])
    return measured_samples(scene, t, series)


def test_a_viewer_that_connects_late_has_the_run_so_far(live, run, tmp_path):
    every = run.samples[::20]
    live.begin("trial", run.scene)
    for i in range(len(every)):
        live.take(every[i : i + 1])
    for event in run.events:
        live.event(event.t, event.kind.label, event.detail)
    for touch in run.touches:
        live.touch(touch["peak_time"], touch["peak_force"])
    for status in run.statuses:
        live.verdict(status.t, status.state.label)
    live.end()

    def check(found):
        times, tip = column(found, "/trial/close_up/tip", "positions")
        assert times * 1e-9 == pytest.approx(every["t"], abs=1e-9)
        assert tip == pytest.approx(tip_in_cone(every) * 1e3, abs=1e-4)
        # the pieces of the trail together are the complete path
        pieces = column(found, "/trial/close_up/trail", "strips")[1]
        path = [tuple(point) for piece in pieces for point in piece]
        assert set(path) == {
            tuple(point) for point in (tip_in_cone(every) * 1e3).astype("f4").tolist()
        }
        _, peaks = column(found, "/plots/contact_force/trial/touches", "scalars")
        assert sorted(peaks) == sorted(run.touches["peak_force"])
        _, verdicts = column(found, "/states/trial/verdict", "state")
        assert verdicts.tolist() == ["approach", "contact", "captured"]
        _, notes = column(found, "/events/trial", "text")
        assert any("shown from the beginning" in note and "newest 16 MB" in note for note in notes)

    seen(live.address, tmp_path / "late.rrd", check)


def test_the_hanging_mass_descends_in_a_view_that_gets_its_samples_in_pieces(live, run, tmp_path):
    every = run.samples[::20]
    live.begin("trial", run.scene)
    for piece in np.array_split(every, 12):
        for i in range(len(piece)):
            live.take(piece[i : i + 1])
        live.show()
    live.end()

    def check(found):
        t, place = column(found, "/trial/world/hanging_mass", "translation")
        fallen = np.interp(t * 1e-9, every["t"], every["mass_height"][0] - every["mass_height"])
        assert fallen.max() > 0.05
        assert place[0, 2] - place[:, 2] == pytest.approx(fallen, abs=2e-3)

    seen(live.address, tmp_path / "mass.rrd", check)


def test_phases_that_no_sensor_measures_come_from_the_events_of_a_run_joined_late(
    live, run, tmp_path
):
    every = run.samples[::10]
    live.begin("trial", run.scene, measured=True)
    every = every[every["t"] > 1.0]
    events = iter(run.events)
    event = next(events)
    for i in range(len(every)):
        while event is not None and event.t <= every["t"][i]:
            live.event(event.t, event.kind.label)
            event = next(events, None)
        live.take(measurements(run.scene, every[i : i + 1]))
        if i % 50 == 0:
            live.show()
    live.end()

    def check(found):
        times, names = column(found, "/states/trial/phase", "state")
        truth = [Phase(p).name.lower() for p in every["phase"]]
        changes = [i for i in range(len(truth)) if i == 0 or truth[i] != truth[i - 1]]
        assert dict.fromkeys(names) == dict.fromkeys(truth[i] for i in changes)
        _, notes = column(found, "/events/trial", "text")
        assert any("joined 1.01 s after the release, not shown before" in note for note in notes)
        # a batch late at most
        latched = times[names.tolist().index("latched")] * 1e-9
        assert latched == pytest.approx(every["t"][truth.index("latched")], abs=0.51)

    seen(live.address, tmp_path / "x.rrd", check)


def resident(pid):
    """Return a process's memory, MB."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(re.search(r"VmRSS:\s+(\d+) kB", status)[1]) / 1024


def test_memory_is_bounded_and_the_newest_is_kept(run, tmp_path):
    live = LiveView(free_port(), memory=8)
    try:
        live.begin("trial", run.scene)
        first = run.samples[:1000].copy()
        live.take(first)
        live.show()
        time.sleep(1.0)
        before = resident(live.server_pid)
        for k in range(1, 101):  # some 40 MB
            later = first.copy()
            later["t"] += k
            live.take(later)
            live.show()
        live.end()

        def check(found):
            times, _ = column(found, "/trial/close_up/tip", "positions")
            assert times[-1] * 1e-9 == pytest.approx(100.999)
            assert times[0] * 1e-9 > 50.0, "the oldest should have gone"
            assert "/trial/world/target/body" in found, "what does not change stays"

        seen(live.address, tmp_path / "x.rrd", check)
        assert resident(live.server_pid) - before < 40.0
    finally:
        live.close()


def test_port_that_is_taken_is_refused_in_one_line():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(CaptureSimError, match=f"port = {port}: .*must be a free port"):
            LiveView(port)


def test_server_ends_with_the_view_and_the_view_closes_without_its_server(run):
    live = LiveView(free_port())
    pid = live.server_pid
    live.close()
    assert not Path(f"/proc/{pid}").exists()
    # Ctrl-C reaches both
    live = LiveView(free_port())
    live.begin("trial", run.scene)
    os.kill(live.server_pid, signal.SIGKILL)
    live.close()


@pytest.mark.skipif(shutil.which("setpriv") is None, reason="needs setpriv of util-linux")
def test_server_ends_with_a_viewer_that_is_killed():
    program = (
        "import sys, time\n"
        "from capture_sim.viewing.rerun_server import RecordingServer\n"
        f"print(RecordingServer({free_port()}, 8).pid, flush=True)\n"
        "time.sleep(900)\n"
    )
    owner = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    server = Path("/proc", owner.stdout.readline().strip(), "cmdline")
    deadline = time.monotonic() + 300.0
    while "--serve-grpc" not in server.read_text() or "pdeathsig" in server.read_text():
        assert time.monotonic() < deadline
        time.sleep(0.05)
    owner.kill()
    owner.wait()
    while server.exists() and server.read_text():
        assert time.monotonic() < deadline + 300.0, "the server still runs"
        time.sleep(0.05)
