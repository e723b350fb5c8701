"""Contact of the rig's tip, by the measured force."""

from __future__ import annotations

from collections import deque


class RigContact:
    """Whether the rig is in contact.

    ``threshold``: force at which a contact begins, N; it ends at half of it.  ``peak_force``: the
    largest force in contacts, N.
    """

    def __init__(self, threshold: float) -> None:
        self.threshold = threshold
        self.is_on = False
        self.peak_force = 0.0
        self._latest: deque[float] = deque([0.0, 0.0], maxlen=2)  # N

    @property
    def force(self) -> float | None:
        """Force of the contact, N; None outside of contacts."""
        return max(self._latest) if self.is_on else None

    def add(self, force: float) -> None:
        """Note a measured force, N."""
        # a second sample below the threshold ends a contact: one may be the noise's
        self._latest.append(force)
        if force >= self.threshold:
            self.is_on = True
        elif max(self._latest) < 0.5 * self.threshold:
            self.is_on = False
        if self.is_on:
            self.peak_force = max(self.peak_force, force)
