"""The report of a loop: its measured values as a dict for JSON, and as lines of text."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import asdict
from typing import Any

from capture_sim.hardware.episodes import ContactEpisode
from capture_sim.hardware.loop import Loop
from capture_sim.hardware.pacing import LoopPacer

#: Number of latest latencies and of latest round trips that are stored.
_MAX_LATENCIES = 100_000


class Timing:
    """Latencies in simulated time and round trips in wall time, s.

    ``latencies`` has the age of the wrench in use at each step; the caller adds it.
    ``round_trips`` has the time from each position to its answer, if the answer came.
    """

    def __init__(self) -> None:
        self._sent: deque[tuple[float, float]] = deque(maxlen=_MAX_LATENCIES)  # stamp, s (wall)
        self.latencies: deque[float] = deque(maxlen=_MAX_LATENCIES)
        self.round_trips: deque[float] = deque(maxlen=_MAX_LATENCIES)

    def sent(self, stamp: float, now: float) -> None:
        """Record that the position with a stamp (s) was sent at the wall time ``now`` (s)."""
        self._sent.append((stamp, now))

    def answered(self, stamp: float, now: float) -> None:
        """Record that the position with a stamp (s) was answered at the wall time ``now`` (s).

        Positions with older stamps then no longer wait for an answer.
        """
        while self._sent and self._sent[0][0] < stamp - 1e-9:
            self._sent.popleft()
        if self._sent and self._sent[0][0] < stamp + 1e-9:
            self.round_trips.append(now - self._sent.popleft()[1])


def report_of(loop: Loop, pacer: LoopPacer | None, timing: Timing, stopped: str) -> dict[str, Any]:
    """Return the measured values of a loop for its JSON report, None for an unknown value.

    Arrays remain NumPy arrays.  ``pacer``: None if the loop did not start.  ``stopped``: reason of
    a safe stop, or empty.
    """
    rejections = dict(loop.answers.rejections)
    is_known = loop.known_lag is not None
    return {
        "stopped": stopped,
        "notes": loop.notes,
        "steps": max(round(loop.t / loop.stage.step), 0),
        "rate": pacer.rate if pacer else None,
        "late_steps": pacer.late_steps if pacer else 0,
        "late_share": pacer.late_share if pacer else 0.0,
        "largest_lateness": pacer.largest_lateness if pacer else 0.0,
        "refused": sum(rejections.values()),
        "rejections": rejections,
        "ages": list(timing.latencies),
        "round_trips": list(timing.round_trips),
        "lag": {
            "servo": loop.lags.servo if is_known else None,
            "force": loop.estimate.lag,
            "whole": loop.known_lag,
        },
        "load_cell": {
            "bias": loop.answers.bias,
            "noise": loop.answers.noise,
            "threshold": loop.contact.threshold,
        },
        "energy_excess": loop.energy_excess,
        "energy_withheld": loop.energy_withheld,
        "rig_peak_force": loop.contact.peak_force,
        "vehicle_peak_force": max((e.peak_force for e in loop.episodes), default=0.0),
        "law": asdict(loop.estimate.law),
        "next_law": _next_law(loop),
        "contacts": [_entry(episode) for episode in loop.episodes],
    }


def _entry(episode: ContactEpisode) -> dict[str, Any]:
    entry = asdict(episode)
    for name in ("restitution", "rig_restitution"):
        if math.isnan(entry[name]):
            entry[name] = None
    return entry


def summary(loop: Loop, report: dict[str, Any]) -> list[str]:
    """Return the lines for the log at the end of a loop; ``report`` is from :func:`report_of`."""
    latencies = sorted(report["ages"]) or [0.0]
    whole = f"{loop.lag * 1e3:.1f} ms"
    if loop.known_lag is None:
        whole = f"not known: {whole} is above timeout"
    rate = "" if report["rate"] is None else f"{report['rate']:.0f} per second, "
    lines = [
        f"{report['steps']} steps, {rate}{report['late_share']:.1%} late; latency "
        f"{latencies[len(latencies) // 2] * 1e3:.1f} ms (median), {latencies[-1] * 1e3:.1f} ms "
        f"(maximum), whole lag {whole}; peak force on the rig {loop.contact.peak_force:.4g} N, "
        f"energy added to the vehicles {loop.energy_excess:.3g} J"
    ]
    if loop.episodes:
        value = loop.episodes[0].restitution
        lines.append(
            f"first contact: restitution {'not known' if math.isnan(value) else f'{value:.4f}'}"
        )
    if report["next_law"]:
        lines.append(f"next law: {report['next_law']}")
    return lines


def _next_law(loop: Loop) -> str:
    """Return the fitted law as parameters of a loop_simulator command line; empty without a fit."""
    if loop.estimate.deviations is None:
        return ""
    law = loop.estimate.law
    values = {
        "stiffness": law.stiffness,
        "exponent": law.exponent,
        "damping": law.damping,
        "wall_offset": law.offset,
        "friction": law.friction,
    }
    # ROS takes a number without a point for an integer, and rejects it
    return " ".join(f"-p {name}:={float(f'{value:.9g}')!r}" for name, value in values.items())
