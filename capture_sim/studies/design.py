"""The paper's design flow: strokes wished for in, buffer out, or why there is none.

Steps as in the paper's section 4: springs for the wished strokes of the first contact
(1 to 5, :mod:`capture_sim.studies.stroke_matching`), the damper by the energy it takes (6) and the
verdict (7).  The damper is looked for over the whole of its range first, as the captures
need not lie in one piece; then both ends of the widest piece are bracketed by bisection.

Beyond the paper: the strokes may be asked for with the damper in, the contact force may be
limited, and among the dampers that capture the one is taken that keeps furthest from losing
the capture under a spread of speed, offset and angle.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from capture_sim.detection.exact import CaptureState
from capture_sim.scene.parts import Scene
from capture_sim.studies.approach import approach_of
from capture_sim.studies.capture_margin import Spread, margin_of
from capture_sim.studies.design_target import Design, Trial, Wish
from capture_sim.studies.energy import energy_of
from capture_sim.studies.first_contact import FirstContact, run_first_contact
from capture_sim.studies.stroke_matching import ACCEPTED, Match, guess, match_strokes, with_buffer
from capture_sim.studies.verdict import Outcome, run_to_verdict

#: Dampers that are tried first: none, and these shares of the critical damping of both
#: vehicles on the axial spring.
SHARES = (0.0, *np.geomspace(3e-3, 20.0, 36).tolist())

#: Ends of the range of dampers that capture are known to this part of themselves.
_END = 0.01
_PROMISING, _CLOSER = 6, 12  # where nothing is good: dampers to look round, parts between them
_SIDE = 3  # dampers on each side of the middle that are looked at for the margin


@dataclass(frozen=True)
class _Damper:
    """A damper tried, with the springs that go with it."""

    c_A: float
    match: Match
    outcome: Outcome


class _Flow:
    """One pass through the flow, and the history it leaves."""

    def __init__(self, scene: Scene, wish: Wish, tell: Callable[[Trial], None] | None) -> None:
        self.scene, self.wish, self._tell = scene, wish, tell
        self.speed = approach_of(scene)[2]
        self.history: list[Trial] = []
        self._last: tuple[float, float] | None = None

    def note(self, trial: Trial) -> None:
        self.history.append(trial)
        if self._tell is not None:
            self._tell(trial)

    def springs(self, c_A: float) -> Match:
        """Steps 1 to 5 with a damper of ``c_A``."""

        def heard(k_A: float, k_T: float, c_A: float, contact: FirstContact) -> None:
            self.note(
                Trial(
                    5,
                    k_A,
                    k_T,
                    c_A,
                    contact.axial_stroke,
                    contact.torsion,
                    contact.peak_force,
                    reason=contact.failure,
                )
            )

        wish = self.wish
        start = self._last or guess(self.scene, wish.axial_stroke, wish.torsion, self.speed)
        match = match_strokes(
            self.scene, wish.axial_stroke, wish.torsion, c_A, start, self._last is None, heard
        )
        if match.met:
            self._last = (match.k_A, match.k_T)
        return match

    def judge(self, c_A: float, match: Match) -> _Damper:
        """Step 7 for one damper."""
        outcome = run_to_verdict(with_buffer(self.scene, match.k_A, match.k_T, c_A))
        self.note(
            Trial(
                7,
                match.k_A,
                match.k_T,
                c_A,
                outcome.axial_stroke,
                outcome.torsion,
                outcome.peak_force,
                outcome.nearest,
                outcome.verdict,
                outcome.reason,
            )
        )
        return _Damper(c_A, match, outcome)

    def damper(self, c_A: float, springs: Match) -> _Damper | None:
        """Judge a damper, with springs of its own if the wish wants them; None if it has none."""
        if self.wish.damped and c_A > 0.0:
            springs = self.springs(c_A)
            if not springs.met:
                return None
        return self.judge(c_A, springs)

    def good(self, damper: _Damper | None) -> bool:
        """Whether a damper captures within the limit of force."""
        if damper is None or damper.outcome.failed or not damper.outcome.captured:
            return False
        limit = self.wish.peak_force
        return limit is None or damper.outcome.peak_force <= limit

    def widest(self, tried: Sequence[_Damper | None]) -> tuple[int, int] | None:
        """Return first and last place of the longest piece of good dampers."""
        best: tuple[int, int] | None = None
        start = None
        for place in range(len(tried) + 1):
            if place < len(tried) and self.good(tried[place]):
                start = place if start is None else start
            elif start is not None:
                if best is None or place - 1 - start > best[1] - best[0]:
                    best = (start, place - 1)
                start = None
        return best

    def closer(self, grid: Sequence[float], tried: Sequence[_Damper | None]) -> list[float]:
        """Return dampers between those tried, next to the promising ones.

        Promising are all captures, as the force jumps from one touch sequence to the next;
        without any, the dampers that bring the tip nearest.
        """

        def nearest(place: int) -> float:
            one = tried[place]
            return math.inf if one is None or one.outcome.failed else one.outcome.nearest

        places = [n for n, one in enumerate(tried) if one is not None and one.outcome.captured]
        places = places or sorted(range(len(grid)), key=nearest)[:_PROMISING]
        more: list[float] = []
        for place in places:
            for low, high in itertools.pairwise(grid[max(place - 1, 0) : place + 2]):
                more += np.linspace(low, high, _CLOSER + 1)[1:-1].tolist()
        return more

    def edge(self, inside: _Damper, outside: float) -> _Damper:
        """Bisect to the last good damper between a good one and a bad one (N s/m)."""
        while abs(outside - inside.c_A) > _END * max(inside.c_A, outside):
            middle = 0.5 * (inside.c_A + outside)
            tried = self.damper(middle, inside.match)
            if tried is not None and self.good(tried):
                inside = tried
            else:
                outside = middle
        return inside


def design_buffer(scene: Scene, wish: Wish, tell: Callable[[Trial], None] | None = None) -> Design:
    """Find springs and damper for a wish.

    Parameters
    ----------
    scene
        Vehicles, cone, contact and approach; its k_A, k_T and c_A count nothing.
    wish
        Strokes, and what else the buffer has to keep.
    tell
        Hears of every run as it is done.

    Returns
    -------
    Design
        With a buffer, or with the reason why there is none.

    Raises
    ------
    SceneError
        A value is out of its range, or the chaser never meets the cone.
    """
    flow = _Flow(scene, wish, tell)
    springs = flow.springs(0.0)
    if not springs.met and not wish.damped:
        return _refused(flow, _no_springs(wish, springs), springs, None)
    critical = _critical_damping(scene, springs.k_A)
    grid = [share * critical for share in SHARES]
    tried: list[_Damper | None] = [flow.damper(c_A, springs) for c_A in grid]
    piece = flow.widest(tried)
    if piece is None:
        # the good ones may hide between those tried: look closer where they come nearest
        grid = sorted({*grid, *flow.closer(grid, tried)})
        known = {one.c_A: one for one in tried if one is not None}
        tried = [known.get(c_A) or flow.damper(c_A, springs) for c_A in grid]
        piece = flow.widest(tried)
    if piece is None:
        judged = [one for one in tried if one is not None]
        nearest = min(judged, key=lambda one: one.outcome.nearest) if judged else None
        return _refused(flow, _no_damper(flow, judged, springs), springs, nearest)
    low, high = (tried[place] for place in piece)
    assert low is not None
    assert high is not None
    if piece[0] > 0:
        low = flow.edge(low, grid[piece[0] - 1])
    if piece[1] < len(grid) - 1:
        high = flow.edge(high, grid[piece[1] + 1])
    chosen, margin = _choose(flow, low, high, tried[piece[0] : piece[1] + 1])
    final = with_buffer(scene, chosen.match.k_A, chosen.match.k_T, chosen.c_A)
    return Design(
        wish,
        "",
        final,
        undamped=run_first_contact(with_buffer(final, final.buffer.k_A, final.buffer.k_T, 0.0)),
        damped=run_first_contact(final),
        outcome=chosen.outcome,
        capturing=(low.c_A, high.c_A),
        margin=margin,
        energy=energy_of(final, chosen.outcome.t),
        history=tuple(flow.history),
    )


def _critical_damping(scene: Scene, k_A: float) -> float:
    """Return the damper that just stops both vehicles swinging on the axial spring, N s/m."""
    chaser, target = scene.chaser_total_mass, scene.target.mass
    return 2.0 * math.sqrt(k_A * chaser * target / (chaser + target))


def _choose(
    flow: _Flow, low: _Damper, high: _Damper, between: Sequence[_Damper | None]
) -> tuple[_Damper, float | None]:
    """Return the damper to take, and its margin if that is asked for.

    Without a spread, the good one next to the middle of the range; with one, that of the
    largest margin, the middle's neighbours first where several have the same.
    """
    spread = flow.wish.spread
    # a damper is off by a part of itself: the middle of the logarithms.  Stiffer than critical
    # it hardly lets the probe move, and is taken only where nothing softer captures
    critical = _critical_damping(flow.scene, low.match.k_A)
    top = min(high.c_A, critical) if low.c_A < critical else high.c_A
    middle = math.sqrt(max(low.c_A, SHARES[1] * critical) * top)
    if spread is None:
        one = flow.damper(middle, low.match)
        good = [d for d in (one, low, high, *between) if d is not None and flow.good(d)]
        return min(good, key=lambda d: abs(d.c_A - middle)), None
    best: tuple[_Damper, float] | None = None
    around = [
        middle * (high.c_A / middle) ** share for share in np.linspace(0, 1, _SIDE + 1).tolist()
    ]
    around += [
        low.c_A + share * (middle - low.c_A) for share in np.linspace(0, 1, _SIDE + 1).tolist()
    ]
    for c_A in dict.fromkeys(sorted(around, key=lambda c: abs(c - middle))):
        one = flow.damper(c_A, low.match)
        if one is None or not flow.good(one):
            continue
        margin = margin_of(with_buffer(flow.scene, one.match.k_A, one.match.k_T, c_A), spread)
        if best is None or margin > best[1]:
            best = (one, margin)
    assert best is not None  # low itself is good
    return best


def _refused(flow: _Flow, why: str, springs: Match, nearest: _Damper | None) -> Design:
    scene, outcome = None, None
    if nearest is not None:
        outcome = nearest.outcome
        scene = with_buffer(flow.scene, nearest.match.k_A, nearest.match.k_T, nearest.c_A)
    elif springs.contact.touches:
        scene = with_buffer(flow.scene, springs.k_A, springs.k_T, 0.0)
    return Design(flow.wish, why, scene, outcome=outcome, history=tuple(flow.history))


def _no_springs(wish: Wish, match: Match) -> str:
    contact = match.contact
    return (
        f"no springs give, within {ACCEPTED:.0%}, strokes of {wish.axial_stroke * 1e3:.4g} mm and "
        f"{wish.torsion * 1e3:.4g} mrad: the nearest, k_A = {match.k_A:.4g} N/m and "
        f"k_T = {match.k_T:.4g} N m/rad, give {contact.axial_stroke * 1e3:.4g} mm and "
        f"{contact.torsion * 1e3:.4g} mrad" + (f" ({contact.failure})" if contact.failure else "")
    )


def _no_damper(flow: _Flow, judged: Sequence[_Damper], springs: Match) -> str:
    """Say why no damper will do: the force, too much energy left, or too little."""
    wish = flow.wish
    if not judged:
        return _no_springs(wish, springs)
    top = max(one.c_A for one in judged)
    captures = [one for one in judged if one.outcome.captured and not one.outcome.failed]
    if captures:
        least = min(captures, key=lambda one: one.outcome.peak_force)
        return (
            f"every damper up to {top:.4g} N s/m that captures pushes too hard: at least "
            f"{least.outcome.peak_force:.4g} N (c_A = {least.c_A:.4g} N s/m), "
            f"{wish.peak_force:.4g} N are allowed"
        )
    best = min(judged, key=lambda one: one.outcome.nearest)
    if best.outcome.nearest > flow.scene.cone.L_c:
        return (
            "no damper captures: the tip is turned away at the cone's outer lip, and comes no "
            f"nearer than {best.outcome.nearest * 1e3:.3g} mm ({_outcomes(judged)})"
        )
    below = [one for one in judged if one.c_A < best.c_A]
    said = (
        f"no damper captures up to {top:.4g} N s/m: the tip comes nearest, "
        f"{best.outcome.nearest * 1e3:.3g} mm, with c_A = {best.c_A:.4g} N s/m "
        f"({best.outcome.verdict.label}: {best.outcome.reason})"
    )
    if below:
        stuck = sum(one.outcome.verdict is CaptureState.STUCK for one in below)
        why = "too little energy" if 2 * stuck > len(below) else "too much energy"
        said += f"; with less, {why} is left ({_outcomes(below)})"
    above = [one for one in judged if one.c_A > best.c_A]
    if above:
        said += f"; with more, too little is left to reach BE ({_outcomes(above)})"
    return said


def _outcomes(dampers: Sequence[_Damper]) -> str:
    """Return how often each verdict was given."""
    labels = [one.outcome.verdict.label for one in dampers]
    return ", ".join(f"{labels.count(label)} x {label}" for label in dict.fromkeys(labels))


def trade_off(
    scene: Scene,
    wish: Wish,
    factors: Sequence[float],
    tell: Callable[[Trial], None] | None = None,
) -> list[Design]:
    """Design for several axial strokes: how much force a longer stroke saves.

    Parameters
    ----------
    scene, wish, tell
        As for :func:`design_buffer`.
    factors
        Of the wished axial stroke.

    Returns
    -------
    list of Design
        One for each factor, refusals among them.
    """
    return [
        design_buffer(scene, replace(wish, axial_stroke=factor * wish.axial_stroke), tell)
        for factor in factors
    ]


__all__ = ["Design", "Spread", "Trial", "Wish", "design_buffer", "trade_off"]
