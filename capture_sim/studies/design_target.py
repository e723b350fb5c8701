"""What goes into the design flow and what comes out of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from capture_sim.detection.exact import CaptureState
from capture_sim.errors import SceneError
from capture_sim.scene.parts import Scene
from capture_sim.studies.capture_margin import Spread
from capture_sim.studies.energy import Energy
from capture_sim.studies.first_contact import FirstContact
from capture_sim.studies.verdict import Outcome


@dataclass(frozen=True)
class Wish:
    """What the buffer is to do.

    Attributes
    ----------
    axial_stroke, torsion : float
        Largest strokes of the first contact, m and rad: Delta_1 and Delta_2.
    damped : bool
        Whether the strokes are those with the damper in; the paper's are those without.
    peak_force : float or None
        Most that any touch up to the verdict may push with, N.
    spread : Spread or None
        Of the approach, for the margin; None takes the middle of the dampers that capture.

    Raises
    ------
    SceneError
        A value is out of its range.
    """

    axial_stroke: float
    torsion: float
    damped: bool = False
    peak_force: float | None = None
    spread: Spread | None = None

    def __post_init__(self) -> None:
        for name, unit, high in (("axial_stroke", "m", 1.0), ("torsion", "rad", 1.0)):
            value = getattr(self, name)
            if not 1e-6 <= value <= high:
                raise SceneError(f"{name} = {value!r} {unit}: allowed is >= 1e-06 and <= {high:g}")
        if self.peak_force is not None and not 0.0 < self.peak_force < math.inf:
            raise SceneError(f"peak_force = {self.peak_force!r} N: allowed is > 0")


@dataclass(frozen=True)
class Trial:
    """One run of the flow: the buffer tried, and what came of it; SI units.

    ``step`` is 5 for strokes, 7 for a verdict; what a step does not look at is NaN or None.
    """

    step: int
    k_A: float
    k_T: float
    c_A: float
    axial_stroke: float
    torsion: float
    peak_force: float
    nearest: float = math.nan
    verdict: CaptureState | None = None
    reason: str = ""


@dataclass(frozen=True)
class Design:
    """What the flow came to.

    Attributes
    ----------
    wish : Wish
    refusal : str
        Why no buffer meets the wish; empty if one does, and all that follows is about it.
    scene : Scene or None
        With the buffer in it; without one that meets the wish, the nearest that was found.
    undamped, damped : FirstContact or None
        The first contact with these springs, without and with the damper.
    outcome : Outcome or None
        Of the run to the verdict.
    capturing : (float, float) or None
        Dampers round the chosen one that capture and keep the limit of force, N s/m.
    margin : float or None
        How many times the wished spread the approach may be off before a capture is lost.
    energy : Energy or None
        Step 6, of the run to the verdict.
    history : tuple of Trial
        Every run, in order.
    """

    wish: Wish
    refusal: str
    scene: Scene | None = None
    undamped: FirstContact | None = None
    damped: FirstContact | None = None
    outcome: Outcome | None = None
    capturing: tuple[float, float] | None = None
    margin: float | None = None
    energy: Energy | None = None
    history: tuple[Trial, ...] = field(default=(), repr=False)

    @property
    def met(self) -> bool:
        """Whether there is a buffer."""
        return not self.refusal
