"""Parts of nodes, without DDS: what is sent, shown and reported."""

from types import SimpleNamespace

import pytest

from capture_sim.errors import CaptureSimError
from capture_sim.messages.topics import BENCH_STATE, CHASER_POSE
from capture_sim.nodes.base import sources
from capture_sim.nodes.base.publishers import Publishers
from capture_sim.nodes.base.sources import SourceDiagnostics
from capture_sim.nodes.viewer import ViewerNode


def test_error_of_publishing_is_reported_at_once_with_its_cause():
    """Only a full queue is waited for: here the message cannot be converted."""

    class Broken:
        def publish(self, message):
            raise RuntimeError("Failed to publish: type support not from this implementation")

    topic_publishers = Publishers(SimpleNamespace(create_publisher=lambda *arguments: Broken()))
    topic_publishers.open([BENCH_STATE])
    with pytest.raises(CaptureSimError, match=r"bench/state: cannot be published: .*type support"):
        topic_publishers.send(BENCH_STATE, b"")


def test_rates_of_sources_are_those_of_what_came(monkeypatch):
    """Each message counts once, whenever the rate is published."""
    now, published, timers = [100.0], [], []
    node = SimpleNamespace(
        every=lambda period, callback: timers.append(callback),
        nodes_that_publish=lambda topic: ["/driver"],
        resolve_topic_name=lambda name: f"/{name}",
        get_publishers_info_by_topic=lambda name: [],
    )
    clock = SimpleNamespace(monotonic=lambda: now[0], monotonic_ns=lambda: int(now[0] * 1e9))
    monkeypatch.setattr(sources, "time", clock)
    monkeypatch.setattr(
        sources, "Diagnostics", lambda node: SimpleNamespace(publish=lambda *s: published.extend(s))
    )
    diagnostics = SourceDiagnostics(node)
    diagnostics.watch(CHASER_POSE)
    at = []  # s, of each publication
    for k in range(1, 1000):
        now[0] += 0.004 + 0.002 * (k % 3)
        diagnostics.add(CHASER_POSE, int(now[0] * 1e9), (1e-3 * k, 0.0, 0.0))
        if k % 170 == 0:  # not at a message
            now[0] += 0.0031
            timers[0]()
            at.append(now[0])
    rates = [float(status.values["rate [Hz]"]) for status in published]
    spans = [b - a for a, b in zip([100.0, *at], at, strict=False)]
    counted = [rate * span for rate, span in zip(rates, spans, strict=True)]
    assert counted == pytest.approx([169, 170, 170, 170, 170], abs=0.01)  # intervals


def test_a_viewer_shows_fifty_states_of_each_simulated_second(monkeypatch):
    monkeypatch.setattr("capture_sim.nodes.viewer.stamp_of", lambda topic, data: data)
    viewer = SimpleNamespace(_period=1.0 / 50.0, _last_slot={}, run="a run")
    shown = [k for k in range(3000) if ViewerNode._is_shown(viewer, BENCH_STATE, k * 1_000_000)]
    assert shown == list(range(0, 3000, 20))
