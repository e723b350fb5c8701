"""The fit of calibrate to one run, with touches and noise as a test gives them.

:func:`capture_sim.calibrate` finds touches and noise itself, and fits the release of every rig.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from capture_sim.run.run import Run, checked
from capture_sim.run.touches import Touches
from capture_sim.scene.parts import Scene
from capture_sim.studies.fit.checks import Finding
from capture_sim.studies.fit.descent import RESTARTS
from capture_sim.studies.fit.fitting import fit_trials
from capture_sim.studies.fit.parameters import parameters_of
from capture_sim.studies.fit.result import STARTS, Calibration
from capture_sim.studies.fit.trial import launched, resolved, trial_of

#: Name of a parameter that is not in a scene: the actual time of the release, s after the assumed
#: time of the release.
RELEASE = "release"


@dataclass(frozen=True)
class Fit:
    """Result of a fit, in the units of the scene's fields."""

    names: tuple[str, ...]  # of the parameters
    values: np.ndarray  # (k,)
    errors: np.ndarray  # (k,), standard errors; infinite if not determined
    chi2: float  # per degree of freedom: 1 if the model explains all but noise
    freedom: int  # degrees of freedom: residuals less parameters
    at_bound: tuple[str, ...]  # parameters at a bound of their range: errors are invalid
    evaluations: int  # number of simulations
    scene: Scene = field(repr=False)  # scene with the fitted values
    calibration: Calibration = field(repr=False)  # the fit with its tests, and the start poses
    touches: int = 0  # number of touches used

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Parameters that have no influence on the measurements."""
        return tuple(
            n for n, e in zip(self.names, self.errors, strict=True) if not math.isfinite(e)
        )

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Reasons why the fit is not valid; empty if it passed all tests."""
        return self.calibration.findings


def identify(
    scene: Scene,
    run: Run,
    names: Sequence[str],
    *,
    touches: Touches | None = None,
    until: float = math.inf,
    starts: int = 10,
    seed: int = 0,
    report: Callable[[int, int], None] | None = None,
) -> Fit:
    """Fit parameters of a scene to the measurements of one run.

    ``names`` may have :data:`RELEASE` and start poses besides those of ``calibrate``.  ``touches``
    are the first ones, None for none.  With ``starts`` of 1, neither restarts nor candidates test
    the fit.
    """
    shared = [name for name in names if name != RELEASE and name not in STARTS]
    parameters = parameters_of(scene, shared) if shared or not names else ()
    run = run.replaced(scene=scene)
    run = run.replaced(series=checked(run).series)
    touches = None if touches is None else resolved(touches, launched(run))
    trial = trial_of(run, touches=touches, until=until, is_release_fitted=RELEASE in names)
    found = fit_trials(
        [trial],
        parameters,
        restarts=min(RESTARTS, max(starts - 1, 0)),
        seed=seed,
        report=report,
        has_scores=starts > 1,
    )
    return _fit_of(found, tuple(names), 0 if trial.touches is None else trial.touches.start.size)


def _fit_of(found: Calibration, names: tuple[str, ...], touches: int) -> Fit:
    """Return the calibration with one trial as a fit of the named parameters."""
    values, errors = [], []
    start = found.starts[0]
    for name in names:
        if name == RELEASE:
            values.append(start.release)
            errors.append(start.release_error)
        elif name in STARTS:
            values.append(float(start.values[STARTS.index(name)]))
            errors.append(float(start.errors[STARTS.index(name)]))
        else:
            values.append(float(found.values[found.names.index(name)]))
            errors.append(float(found.errors[found.names.index(name)]))
    bounds = tuple(f.text.partition(" ")[0] for f in found.findings if f.kind == "bound")
    return Fit(
        names=names,
        values=np.array(values),
        errors=np.array(errors),
        chi2=found.reduced_chi2,
        freedom=found.freedom,
        at_bound=bounds,
        evaluations=found.simulations,
        scene=found.scene,
        calibration=found,
        touches=touches,
    )


def is_explained(fit: Fit) -> bool:
    """Return True if the residuals are no larger than the noise floor."""
    # reduced chi2 has a standard deviation of sqrt(2 / freedom); the noise is known to about 10 %
    return fit.chi2 < 1.2 + 5.0 * math.sqrt(2.0 / fit.freedom)
