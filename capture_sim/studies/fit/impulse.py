"""The impulse of a contact, from a force that is sampled too slowly to show its touches.

A low-pass filter lowers the peaks of a force and keeps its integral.  So the integral over a
contact, until the force is small again, is known where single touches are not; the tests try rates
from 200 Hz to 10 kHz, with filters from 40 Hz to 1 kHz and without.  The integral equals the
momentum that the target gained, less the impulse of the floor.  Both follow from the simulated
motion, without samples of the force.  The gain of the cell is a sensor's error, ``scale.force``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from capture_sim.dynamics.model.parameters import pack
from capture_sim.run.run import Run
from capture_sim.run.touches import above, quiet_before_contact
from capture_sim.scene.parts import Scene

#: A contact ends at the smallest force in this time after its begin, s.
_LONGEST = (0.05, 0.5)
#: The integral begins this long before the force shows the contact, s, and at least this number of
#: samples: the target still rests, and a filter may be late.
_BEFORE, _SAMPLES_BEFORE = 0.02, 3
#: Least number of samples by which a filter may delay a force; else the time of its first rise.
_DELAY = 2.0
#: Order of the differences that show the noise of samples; of white noise all orders do.
_ORDER = 9
#: Longest interval of two samples, in medians of them: what a hole hides is not known.
_HOLE = 3.0
#: Part of the impulse that is not resolved: resistance and pose of the target between samples.
_UNRESOLVED = 3e-3
#: An impulse counts if it is known to better than this share.
_KNOWN = 0.2


class MeasuredImpulse(NamedTuple):
    """The impulse on the tip by the cone, in the axes that the cone has at ``begin``."""

    begin: float  # s since the assumed release
    end: float
    value: np.ndarray  # (2,), N s
    sigma: np.ndarray  # (2,), standard deviations

    def of_samples(self, samples: np.ndarray, t: np.ndarray, scene: Scene) -> np.ndarray:
        """Return the impulse (2,), N s, of a simulated trial.

        ``samples`` (n,) of dtype SAMPLE are at the simulated times ``t`` (n,) of the window.
        """
        par = pack(scene, math.nan, math.nan)[0]
        v, theta = samples["v"][:, 5:8], samples["q"][:, 7]
        taken = _by_floor(v, theta, par)
        of_floor = 0.5 * ((taken[1:] + taken[:-1]) * np.diff(t)[:, None]).sum(axis=0)
        gained = float(par["m_T"]) * (v[-1, :2] - v[0, :2])
        return _turned(of_floor - gained, -theta[0])


def impulse_of(run: Run, end: float) -> MeasuredImpulse | None:
    """Return the impulse of the contact of a measured run; None if it is not known.

    ``end``: end of the measurements that are used, s.
    """
    force, target = run.cone_force, run.measured("target")
    kept = force.t <= end
    t, values = force.t[kept], force.values[kept]
    quiet = quiet_before_contact(t, values)
    if quiet is None or target.t.size < 2:
        return None
    net = values - quiet.bias
    size = np.hypot(*net.T)
    parts = above(size, quiet.threshold)
    if not parts or parts[0].start <= _SAMPLES_BEFORE:
        return None
    shown = parts[0].start
    first = min(int(np.searchsorted(t, t[shown] - _BEFORE)), shown - _SAMPLES_BEFORE)
    later = np.flatnonzero((t > t[shown] + _LONGEST[0]) & (t < t[shown] + _LONGEST[1]))
    if not later.size:
        return None
    last = int(later[np.argmin(np.convolve(size, np.ones(5) / 5.0, mode="same")[later])])
    window = slice(first, last + 1)
    step = np.diff(t[window])
    if step.size < 2 * _ORDER or step.max() > _HOLE * float(np.median(step)):
        return None
    heading = np.interp(t[window], target.t, np.unwrap(target.values[:, 2]))
    turned = _turned(net[window], heading - heading[0])
    value = 0.5 * ((turned[1:] + turned[:-1]) * step[:, None]).sum(axis=0)
    # what the samples have near half of their rate: noise, and touches that they may miss
    rough = (np.diff(turned, n=_ORDER, axis=0) ** 2).sum(axis=0) / math.comb(2 * _ORDER, _ORDER)
    top = shown + int(np.argmax(np.diff(size[shown:], append=0.0) <= 0.0))
    late = max(_DELAY * float(np.median(step)), float(t[top] - t[shown]))
    left = late * float(size[last])
    sigma = np.sqrt(
        float(np.mean(step)) ** 2 * rough + left**2 + (_UNRESOLVED * np.hypot(*value)) ** 2
    )
    if not np.all(sigma < _KNOWN * np.hypot(*value)):
        return None
    return MeasuredImpulse(float(t[first]), float(t[last]), value, sigma)


def _by_floor(v: np.ndarray, theta: np.ndarray, par: np.void) -> np.ndarray:
    """Return the force of floor, drag and cable on the target, (n, 2), N; ``v`` (n, 3), m/s."""
    force = float(par["m_T"]) * np.array([par["pull_x"], par["pull_y"]])
    force = force + par["cable_T"] - float(par["drag_T"]) * v[:, :2]
    for x, y, limit in par["balls_T"][:, :3].T.tolist():
        arm = _turned(np.array([x, y]), theta)
        ball = v[:, :2] + v[:, 2:] * np.stack([-arm[:, 1], arm[:, 0]], axis=1)
        speed = np.sqrt((ball**2).sum(axis=1) + float(par["v_eps_ball"]) ** 2)
        force = force - limit * ball / speed[:, None]
    force[~v.any(axis=1)] = 0.0  # at rest the floor holds it
    return np.asarray(force)


def _turned(vectors: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return vectors (..., 2) rotated by angles (...), rad."""
    x, y, c, s = vectors[..., 0], vectors[..., 1], np.cos(angle), np.sin(angle)
    return np.stack([c * x - s * y, s * x + c * y], axis=-1)
