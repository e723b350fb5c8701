"""Contact episodes: motion of the vehicles, law fitted to the rig, and their comparison."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace

import numpy as np

from capture_sim.hardware.fit import LawEstimate, fit_touch
from capture_sim.hardware.law import Penetration, WallLaw, Walls
from capture_sim.hardware.stage import LoopStage, SafeStopError, StageState

#: Relative error of the restitution, compared with the rig's, up to which the restitution is held.
TOLERANCE = 0.05
#: Largest rms misfit of a law that describes the contact, as a share of the peak force.
MAX_MISFIT = 0.05
#: Number of successive episodes with disagreement of rig and law after which the loop stops.
MAX_DISAGREEMENTS = 3
#: Divisor of the stiffness after a contact that the rig did not feel.
SOFTENING = 4.0
#: Steps of a comparison in each step of the loop; smallest number of steps after its contact.
TWIN_STEPS, MIN_FREE_STEPS = 2, 5
#: Lowest approach speed for which a restitution is computed, m/s.
MIN_APPROACH = 1e-4


@dataclass
class ContactEpisode:
    """One contact, from its first force to its last, with all touches of a tip that chatters."""

    begin: float  # s
    approach_speed: float  # m/s, of the vehicles against the wall, with the buffer as rigid
    mass: float  # kg, effective mass of both vehicles in this contact
    duration: float = 0.0  # s, under force
    work: float = 0.0  # J, of wrench and law on the vehicles
    peak_force: float = 0.0  # N, on the vehicles
    rig_peak_force: float = 0.0  # N, that the load cell has read
    # separation speed of the vehicles over approach speed; NaN if only the rig or the law touched
    restitution: float = math.nan
    # law fitted to the rig's measurements; None if there is none
    rig: LawEstimate | None = None
    # restitution of the same vehicles on walls with the fitted law; NaN if not known
    rig_restitution: float = math.nan
    # True if both restitutions agree within 5 %, None if the comparison is not possible
    is_held: bool | None = None


@dataclass
class _Course:
    """Data of an episode for its comparison with the rig's law."""

    states: list[StageState]  # of the stage, up to the first force
    wall: Penetration  # at the first force
    energy: float  # J, before the first force


class Episodes:
    """Tracks contact episodes, fits a law to each and compares the vehicles' motion with it.

    ``is_model``: True if a law acts on the vehicles; each fitted law replaces it.  ``estimate``:
    the latest law with its uncertainty.  ``next_law``: the law to set next, None to keep the
    present law.
    """

    def __init__(
        self,
        stage: LoopStage,
        walls: Walls,
        law: WallLaw,
        is_model: bool,
        note: Callable[[str], None],
    ) -> None:
        self._stage, self._walls, self._is_model, self._note = stage, walls, is_model, note
        q, v = stage.q, stage.v
        self._twin = LoopStage(stage.scene, stage.step, (q, v))
        self._course: _Course | None = None
        self._comparison: Generator[None, None, None] | None = None
        self._disagreements = 0
        self._last_loaded = 0.0  # s
        self.all: list[ContactEpisode] = []
        self.present: ContactEpisode | None = None
        self.estimate = LawEstimate(law)
        self.next_law: WallLaw | None = None

    @property
    def is_comparing(self) -> bool:
        """True while an episode is being compared with the rig."""
        return self._comparison is not None

    def work(self) -> None:
        """Do one iteration of the fit, or one piece of the comparison."""
        if self._comparison is not None and next(self._comparison, self) is self:
            self._comparison = None

    def observe(self, states: list[StageState], rig_force: float | None) -> None:
        """Update the present episode after a step.

        ``states``: states before the step, newest last.  ``rig_force``: force of the rig's contact,
        N; None outside contacts.
        """
        stage = self._stage
        forces = stage.forces
        n_loaded = int(np.count_nonzero(forces))
        if n_loaded or rig_force is not None:
            self._last_loaded = stage.t
            if self.present is None:
                self._begin(states)
        if self.present is None or self._course is None:
            return
        episode = self.present
        episode.work = stage.energy - self._course.energy
        episode.peak_force = max(episode.peak_force, float(forces.max()))
        episode.duration += n_loaded * stage.step / len(forces)
        episode.rig_peak_force = max(episode.rig_peak_force, rig_force or 0.0)

    def has_ended(self, answered: float, servo_lag: float) -> bool:
        """Return True if the present episode is over.

        ``answered``: stamp of the latest answer, s.  ``servo_lag``: lag of the rig's tip, s.
        """
        if self.present is None or self._last_loaded == self._stage.t:
            return False
        settling = max(5.0 * self._stage.step, 2.0 * servo_lag, 0.25 * self.present.duration)
        return answered >= self._last_loaded + settling

    def _begin(self, states: list[StageState]) -> None:
        stage = self._stage
        wall = self._walls.deepest(stage.tip)
        speed = stage.closing_speed(wall.nx, wall.ny, states[-1])
        mass = stage.contact_mass(wall.nx, wall.ny)
        self.present = ContactEpisode(stage.t, speed, mass)
        self._course = _Course(states, wall, states[-1].energy)

    def end(self, rows: np.ndarray, noise: float, threshold: float) -> None:
        """End the present episode; start a fit to the rig's measurements if the rig was touched.

        ``rows``: the samples for :func:`fit_touch`; ``noise`` and ``threshold`` in N.
        """
        episode, course = self.present, self._course
        assert episode is not None
        assert course is not None
        self.all.append(episode)
        self.present = self._course = None
        if episode.peak_force and episode.rig_peak_force and episode.approach_speed > MIN_APPROACH:
            separation = -self._stage.closing_speed(course.wall.nx, course.wall.ny)
            episode.restitution = separation / episode.approach_speed
        if (rows[:, 3] >= threshold).any():
            self._comparison = self._compare(episode, course, rows, noise, threshold)
            if self._is_model and episode.peak_force == 0.0:
                self._disagree("the rig was in contact, the law was not")
        elif self._is_model:
            self._soften(float(rows[:, 1].max(initial=-math.inf)))

    def _soften(self, depth: float) -> None:
        """Report a contact that the rig did not feel; soften the law if it was never fitted."""
        law = self.estimate.law
        short = -(depth + law.offset)
        text = "the law was in contact, the rig was not"
        if 0.0 < short < math.inf:
            text += f": its tip ended {short * 1e3:.3g} mm before the law's wall"
        if self.estimate.deviations is None:
            softer = replace(law, stiffness=law.stiffness / SOFTENING, damping=0.0)
            text += f"; stiffness lowered to {softer.stiffness:.3g}"
            self.next_law, self.estimate = softer, LawEstimate(softer)
        self._disagree(text)

    def _compare(
        self,
        episode: ContactEpisode,
        course: _Course,
        rows: np.ndarray,
        noise: float,
        threshold: float,
    ) -> Generator[None, None, None]:
        """Fit a law to the rig and simulate the vehicles with it; yield after each part."""
        prior, speed = self.estimate, max(episode.approach_speed, MIN_APPROACH)
        if prior.law.stiffness <= 0.0:
            duration = max(episode.duration, self._stage.step)
            prior = LawEstimate(prior.law.lasting(episode.mass, speed, duration))
        found = yield from fit_touch(rows, prior, speed, noise, threshold)
        episode.rig = found
        if found.residual > max(5.0 * noise, MAX_MISFIT * found.peak_force):
            self._disagree(
                f"the fitted law misses the rig's force by {found.residual:.3g} N rms, peak "
                f"{found.peak_force:.4g} N"
            )
            return
        self._disagreements = 0
        hidden = found.lag - max(self.estimate.lag, 0.0)
        if hidden > max(3.0 * found.lag_deviation, 0.01 * episode.duration):
            self._note(
                f"the rig's force is {found.lag * 1e3:.3g} ms later than its stamps and tips show"
            )
        self.estimate = found
        if self._is_model:
            self.next_law = found.law
        episode.rig_restitution = yield from self._restitution_on(found.law, episode, course)
        self._judge(episode, found)

    def _restitution_on(
        self, law: WallLaw, episode: ContactEpisode, course: _Course
    ) -> Generator[None, None, float]:
        """Return the restitution of the same approach on walls with this law; NaN if not known."""
        twin = self._twin
        for state in reversed(course.states):
            twin.restore(state)
            if self._walls.deepest(twin.tip).depth + law.offset < 0.0:
                break
        else:
            return math.nan  # the tip was in the wall in every state
        twin.set_law(law)
        loaded = free = 0
        while not loaded or free < max(MIN_FREE_STEPS, 0.25 * loaded):
            if twin.t > self._stage.t:
                return math.nan  # the tip does not touch this wall, or does not leave it
            for _ in range(TWIN_STEPS):
                try:
                    twin.take_step()
                except SafeStopError:
                    return math.nan
                is_loaded = bool(twin.forces.any())
                loaded, free = loaded + is_loaded, 0 if is_loaded else free + 1
            yield
        separation = -twin.closing_speed(course.wall.nx, course.wall.ny)
        return separation / max(episode.approach_speed, MIN_APPROACH)

    def _judge(self, episode: ContactEpisode, found: LawEstimate) -> None:
        """Compare the restitution of the vehicles with their restitution on the rig's law."""
        ours, rigs = episode.restitution, episode.rig_restitution
        if math.isnan(ours) or math.isnan(rigs):
            return
        if found.restitution_deviation <= TOLERANCE * found.restitution:
            episode.is_held = abs(ours - rigs) <= TOLERANCE * abs(rigs)
        if not episode.is_held:
            self._note(
                f"restitution {ours:.3g}, on the rig's law {rigs:.3g} +- "
                f"{found.restitution_deviation:.2g}: not held within {TOLERANCE:.0%}"
            )

    def _disagree(self, text: str) -> None:
        self._note(text)
        self._disagreements += 1
        if self._disagreements >= MAX_DISAGREEMENTS and self._is_model:
            raise SafeStopError(
                f"contacts in a row in which rig and law disagree = {self._disagreements}: must be "
                f"< {MAX_DISAGREEMENTS}; {text}"
            )
