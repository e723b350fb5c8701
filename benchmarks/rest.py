"""Which motions count as rest before a release, and how long a body at rest waits.

python -m benchmarks.rest

For each motion, rate and noise: the share of instants at which the chaser counts as at rest, its
fastest true speed among these, what a release at that speed adds to an impact at 0.1 m/s, and the
longest time without an instant of rest.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from benchmarks.machine import stamp
from benchmarks.pages import table
from capture_sim.trial.rest import SETTLE, WINDOW, Rest

IMPACT_SPEED = 0.1  # m/s
DURATION, SEEDS = 10.0, range(5)
RATES = (100.0, 30.0, 10.5)
NOISES = (2e-4, 1e-3)

Motion = Callable[[np.ndarray], np.ndarray]


def creep(speed: float) -> Motion:
    """Return a steady motion, m/s."""
    return lambda t: speed * t


def swing(amplitude: float, frequency: float) -> Motion:
    """Return an oscillation, m and Hz."""
    return lambda t: amplitude * np.sin(2.0 * math.pi * frequency * t)


def sway(t: np.ndarray) -> np.ndarray:
    """Return 50 mm at 0.7 Hz that decay with a time constant of 2 s."""
    return np.asarray(0.05 * np.exp(-t / 2.0) * np.sin(2.0 * math.pi * 0.7 * t))


MOTIONS: dict[str, Motion] = {
    "none": creep(0.0),
    "creep 2 mm/s": creep(0.002),
    "creep 5 mm/s": creep(0.005),
    "creep 8 mm/s": creep(0.008),
    "+-1 mm at 1 Hz": swing(0.001, 1.0),
    "+-2 mm at 1 Hz": swing(0.002, 1.0),
    "+-8 mm at 1 Hz": swing(0.008, 1.0),
    "+-20 mm at 1 Hz": swing(0.02, 1.0),
    "+-40 mm at 0.5 Hz": swing(0.04, 0.5),
    "+-10 mm at 3 Hz": swing(0.01, 3.0),
    "+-1.5 mm at 3 Hz": swing(0.0015, 3.0),
    "+-2.5 mm at 3 Hz": swing(0.0025, 3.0),
    "+-40 mm at 0.1 Hz": swing(0.04, 0.1),
    "+-10 mm at 0.1 Hz": swing(0.01, 0.1),
    "sway 50 mm, 0.7 Hz, 2 s": sway,
}


def instants(motion: Motion, rate: float, noise: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return times, (n,), s, and whether the chaser counts as at rest at each, (n,)."""
    rng, rest = np.random.default_rng(seed), Rest()
    times = np.arange(0.0, DURATION + WINDOW + SETTLE, 1.0 / rate)
    rows = np.column_stack([motion(times), 0.0 * times, 0.0 * times])
    rows += noise * rng.normal(size=rows.shape)
    found = []
    for t, row in zip(times.tolist(), rows.tolist(), strict=True):
        rest.add(row, t)
        found.append(rest.is_at_rest(t))
    return times, np.array(found)


def row(name: str, rate: float, noise: float) -> tuple[str, ...]:
    """Return a row of the table."""
    motion, n, n_rest, fastest, wait = MOTIONS[name], 0, 0, 0.0, 0.0
    for seed in SEEDS:
        times, found = instants(motion, rate, noise, seed)
        at = times[found]
        n, n_rest = n + int((times >= WINDOW - 0.2 + SETTLE).sum()), n_rest + len(at)
        speed = np.abs(motion(at + 1e-4) - motion(at - 1e-4)) / 2e-4
        fastest = max(fastest, float(speed.max(initial=0.0)))
        wait = max(wait, float(np.diff(np.concatenate([[0.0], at, times[-1:]])).max()))
    return (
        name,
        f"{1e3 * noise:g}",
        f"{rate:g}",
        f"{100.0 * n_rest / n:.0f}",
        f"{1e3 * fastest:.1f}" if n_rest else "",
        f"{100.0 * fastest**2 / (2.0 * IMPACT_SPEED**2):.2f}" if n_rest else "",
        f"{wait:.1f}" if n_rest > 0.2 * n else "",
    )


if __name__ == "__main__":
    head = ["motion", "noise mm", "poses Hz", "rest % of instants", "fastest mm/s"]
    head += ["adds % to the impact", "longest wait s"]
    rows = [row(name, rate, noise) for name in MOTIONS for noise in NOISES for rate in RATES]
    print(table(head, rows))
    print(stamp(0.0))
