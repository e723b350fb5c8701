"""Stands in for the hardware of fake_rig.py: a chaser, its buffer, and their motion."""

import math

TARGET, STOP, SPEED, DROP = 0.66, 0.2125, 0.105, 0.1  # m, of the chaser at the cone; m/s after m
BACK, ASIDE, RETURNED = 0.5, 0.12, 0.4  # m/s pulled back; m of a miss; speed after by before
MASS, STIFFNESS = 22.0, 500.0  # kg; N/m, k_A of the scene tilt_0
#: s and m, of half a swing on the buffer's spring.
CONTACT, STROKE = math.pi * math.sqrt(MASS / STIFFNESS), SPEED * math.sqrt(MASS / STIFFNESS)


class FakeChaser:
    def __init__(self, outcomes):
        self.outcomes = outcomes  # of the releases in turn: captured, rebound, missed
        self.t = self.x = self.y = self.speed = 0.0  # s; m; m/s
        self.released, self.held, self.trial = None, -1.0, 0  # s, s, number of the release
        self.since_contact, self.push = -1.0, 0.0  # s; force by its peak, 0 to 1

    def hold(self):
        if self.released is not None:  # the brake stops a chaser that moves
            self.released, self.held, self.trial = None, self.t, self.trial + 1

    def let_go(self):
        if self.released is None:
            self.released, self.x = self.t, 0.0

    def move(self, dt):
        self.t += dt
        outcome = self.outcomes[self.trial % len(self.outcomes)]
        self.speed, self.since_contact = 0.0, -1.0
        if self.released is not None:
            going, sinking = self.going, 2.0 * DROP / SPEED  # s, of the mass
            self.speed = SPEED * min(1.0, going / sinking)
            self.x = 0.5 * self.speed * min(going, sinking) + SPEED * max(0.0, going - sinking)
            if self.x >= STOP and outcome != "missed":
                self.since_contact = (self.x - STOP) / SPEED
                self.speed = -RETURNED * SPEED if outcome == "rebound" else 0.0
                self.x = STOP + self.speed * self.since_contact
        elif self.t > self.held + 0.5:  # somebody pulls it back
            self.x = max(0.0, self.x - BACK * dt)
            self.y = ASIDE if outcome == "missed" else 0.0
        share = min(1.0, max(0.0, self.since_contact / CONTACT))
        self.push = max(0.0, math.sin(math.pi * share))  # a half sine in the contact

    @property
    def going(self):
        """Time since the release, s; None while it is held."""
        return None if self.released is None else self.t - self.released

    @property
    def stroke(self):
        """Compression of the buffer, m."""
        return STROKE * self.push

    @property
    def poses(self):
        """x, y (m) and yaw (rad) of both vehicles."""
        return (self.x + self.stroke, self.y, 0.0), (TARGET, 0.0, 0.0)

    @property
    def force(self):
        """Force on the load cell along x, N."""
        return STIFFNESS * self.stroke
