"""Identification: fit of parameters of the bench to one run, with standard errors.

It is the joint fit of :mod:`capture_sim.studies.calibration` with one trial.  The start poses are
fitted too, and so is the release time if it is named.

Poses, stroke and torsion depend smoothly on the parameters, even if the tip chatters.  A sampled
contact force does not, because a touch lasts half a millisecond and samples hit or miss it.
Therefore the fit uses the first touches instead: their start times and impulses.  For touches that
were not found in a sampled force, e.g. touches of a simulation, it uses the peak force instead of
the impulse.

The filter and the clock of a load cell delay all touches by the same unknown time.  This delay is
fitted together with the parameters.  Without it, rolling resistance would change by several of its
standard errors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from capture_sim.errors import SceneError
from capture_sim.run.run import Run, checked
from capture_sim.run.series import PARTS
from capture_sim.run.touches import Touches
from capture_sim.scene.parts import Scene
from capture_sim.studies.calibration.calibrate import STARTS, Calibration, fit_trials
from capture_sim.studies.calibration.checks import Finding
from capture_sim.studies.calibration.descent import RESTARTS
from capture_sim.studies.calibration.parameters import parameters_of
from capture_sim.studies.calibration.trial import launched, resolved, trial_of

#: Name of a parameter that is not in a scene: the actual time of the release, s after the assumed
#: time of the release.
RELEASE = "release"


@dataclass(frozen=True)
class Fit:
    """Result of a fit, in the units of the scene's fields."""

    names: tuple[str, ...]  # of the parameters
    values: np.ndarray  # (k,)
    errors: np.ndarray  # (k,), standard errors; infinite if not determined
    correlation: np.ndarray  # (k, k), of the errors
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
    noise: Mapping[str, Sequence[float]] | None = None,
    until: float = math.inf,
    starts: int = 10,
    seed: int = 0,
    report: Callable[[int, int], None] | None = None,
) -> Fit:
    """Fit parameters of a scene to the measurements of one run.

    Parameters
    ----------
    scene
        Scene with the initial values of the search.
    run
        The measured run.  Its sampled force is not used, because samples hit or miss a touch by
        chance.  The simulated launch is the recorded launch command, whatever the parameters are;
        without a recorded command it is the launch of the scene.  Measurements after the first
        ``launcher/hold`` that follows the release are not used.
    names
        Names of the parameters: ``c_rr`` (of both vehicles), ``e``, ``mu``, ``c_A``, fields, e.g.
        ``buffer.k_A``, or errors of sensors, see :func:`capture_sim.calibrate`.  Add
        :data:`RELEASE` if the release time is not known exactly.  Start poses, e.g.
        ``initial.chaser.y``, are always fitted; a start pose that is named here is also reported.
    touches
        The first touches; None to fit without touches.  Touches from a force that is sampled too
        slowly for the touches of the scene are not used.
    noise
        Standard deviations by series, one for each part of the series; None to estimate them.
    until
        End of the measurements that are used, s.
    starts
        Maximum number of searches: the first search, and restarts around its result.  With 1, the
        fit is tested neither by restarts nor by a search for effects that the model lacks.
    seed
        Seed of the restarts.
    report
        Function called with the number of simulations made and the total number expected.

    Raises
    ------
    SceneError
        A name is unknown or given twice, nothing was measured, or a standard deviation is not
        positive.
    RecordingError
        A vehicle has no poses.
    """
    if touches is not None and min(touches.start_noise, touches.peak_noise) <= 0.0:
        raise SceneError(
            f"noise of touches = {touches.start_noise:g} s, {touches.peak_noise:g} N: must be > 0"
        )
    for name in names:
        if list(names).count(name) > 1:
            raise SceneError(f"parameter {name}: given twice: must be given once")
    shared = [name for name in names if name != RELEASE and name not in STARTS]
    parameters = parameters_of(scene, shared) if shared or not names else ()
    run = run.replaced(scene=scene)
    run = run.replaced(series=checked(run).series)
    if not any(run.measured(name).t.size for name in PARTS):
        raise SceneError("nothing to fit to: the run holds no poses, stroke or torsion")
    touches = None if touches is None else resolved(touches, launched(run))
    given = None if noise is None else {key: np.asarray(value) for key, value in noise.items()}
    trial = trial_of(
        run, touches=touches, noise=given, until=until, is_release_fitted=RELEASE in names
    )
    found = fit_trials(
        [trial],
        parameters,
        restarts=min(RESTARTS, max(starts - 1, 0)),
        seed=seed,
        report=report,
        is_noise_known=given is not None,
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
        correlation=found.correlation_of(names),
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
