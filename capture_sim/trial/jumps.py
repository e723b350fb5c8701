"""Jumps of measured poses that no body can make.

The names of two bodies are exchanged, a marker set is taken for its mirror image, or the cameras
get another origin.  The next poses agree with each other, but not with those before.
"""

from __future__ import annotations

import math

from capture_sim.trial.rest import Pose

#: Number of poses after a jump that must agree with each other: two wrong frames are no jump.
N_AGREEING = 3
#: Longest step of a body without a jump, m and rad, and its largest speeds, m/s and rad/s: ten
#: times those of a docking, and more than noise and a delayed message explain.
MAX_STEP, MAX_TURN = 0.05, 0.35
MAX_SPEED, MAX_TURN_RATE = 1.0, 3.0


class JumpWatch:
    """Watches the poses of one body; ``text`` is its jump since :meth:`begin`, empty without."""

    def __init__(self) -> None:
        self.text = ""
        self._last: tuple[float, Pose] | None = None  # s and pose, the latest without a jump
        self._others: list[tuple[float, Pose]] = []  # later ones, which do not follow from it

    def begin(self) -> None:
        """Forget jumps: from now on the body is followed."""
        self.text = ""

    def add(self, pose: Pose, now: float) -> None:
        """Add a finite pose that arrived at ``now``, s."""
        latest = (now, pose)
        if self._last is None or _follows(self._last, latest):
            self._last = latest
            self._others.clear()
            return
        if self._others and not _follows(self._others[-1], latest):
            self._others.clear()
        self._others.append(latest)
        if len(self._others) == N_AGREEING:
            before = self._last[1]
            step = math.dist(before[:2], pose[:2])
            turn = math.remainder(pose[2] - before[2], math.tau)
            self.text = (
                f"jumped by {1e3 * step:.3g} mm and {math.degrees(turn):.3g} degrees, as no body "
                "can: exchanged names, a flipped marker set or another origin"
            )
            self._last = latest
            self._others.clear()


def _follows(a: tuple[float, Pose], b: tuple[float, Pose]) -> bool:
    """Return True if a body can move from ``a`` to the later ``b``."""
    elapsed = b[0] - a[0]
    turn = abs(math.remainder(b[1][2] - a[1][2], math.tau))
    step = math.dist(a[1][:2], b[1][:2])
    return step <= MAX_STEP + MAX_SPEED * elapsed and turn <= MAX_TURN + MAX_TURN_RATE * elapsed
