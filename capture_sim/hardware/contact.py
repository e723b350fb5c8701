"""Detection of contacts of the rig's tip from the measured force."""

from __future__ import annotations

from collections import deque


class RigContact:
    """Detector of contacts of the rig's tip; ``is_on`` is True during a contact.

    A contact begins at the force ``threshold`` (N).  It ends after two successive forces below half
    of the threshold.  ``peak_force`` is the largest force in all contacts so far, N.
    """

    def __init__(self, threshold: float) -> None:
        self.threshold = threshold
        self.is_on = False
        self.peak_force = 0.0
        self._latest: deque[float] = deque([0.0, 0.0], maxlen=2)  # N

    @property
    def force(self) -> float | None:
        """Larger of the last two measured forces, N, during a contact; None outside contacts."""
        return max(self._latest) if self.is_on else None

    def add(self, force: float) -> None:
        """Add a measured force (N), and update whether the rig is in contact."""
        # two samples below half of the threshold end a contact, because a single one may be noise
        self._latest.append(force)
        if force >= self.threshold:
            self.is_on = True
        elif max(self._latest) < 0.5 * self.threshold:
            self.is_on = False
        if self.is_on:
            self.peak_force = max(self.peak_force, force)
