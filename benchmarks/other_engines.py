"""Other engines on the paper's scene, each as near as it can come; skipped if not installed."""

from __future__ import annotations

import importlib
import importlib.metadata
from dataclasses import dataclass, replace
from types import ModuleType

import numpy as np

from benchmarks import work_precision
from benchmarks.engines.own import with_run
from benchmarks.reference import load_reference
from benchmarks.trial import Progress, Trial, run_rounds
from capture_sim.scene.parts import Scene

#: By the name of their package; each adapter has REFERENCE, NOTE, ``trials(scene, truth, quick)``.
ENGINES = {"exudyn": "Exudyn", "mujoco": "MuJoCo", "drake": "Drake"}
_ENOUGH = 1e-6  # m or rad: compared there, or where an engine's error ends


@dataclass(frozen=True)
class EngineResult:
    """An engine's trials, ours beside them, and how they compare.

    ``reason`` tells why there are none.
    """

    name: str
    version: str
    note: str
    reason: str
    trials: list[Trial]
    comparisons: list[work_precision.Comparison]


@dataclass(frozen=True)
class Agreement:
    """How far an engine with our own law comes to a reference.

    Attributes
    ----------
    law : str
        Of the friction, on both sides.
    t : float
        s.
    error : float
        Largest difference in any coordinate, m or rad.
    """

    law: str
    t: float
    error: float


def adapter(package: str) -> tuple[ModuleType | None, str]:
    """Return the module that drives an engine, or None and why it cannot."""
    try:
        version = importlib.metadata.version(package)
        return importlib.import_module(f"benchmarks.engines.{package}"), version
    except importlib.metadata.PackageNotFoundError:
        return None, "not installed: pip install -c requirements/lock.txt '.[benchmark]'"
    except ImportError as error:
        return None, f"does not load: {str(error).splitlines()[0]}"


def measure(
    scene: Scene, plan: work_precision.Plan, quick: bool, progress: Progress
) -> list[EngineResult]:
    """Try all engines that are installed, interleaved with our own integrators."""
    results = []
    scene = with_run(scene, t_end=plan.t_end)
    for package, name in ENGINES.items():
        engine, version = adapter(package)
        if engine is None:
            results.append(EngineResult(name, "", "", version, [], []))
            continue
        truth = load_reference(scene.name).at(plan.t_end)
        own = list(work_precision.own_trials(scene, replace(plan, steps=()), truth))
        truth = load_reference(scene.name + engine.REFERENCE).at(plan.t_end)
        theirs = list(engine.trials(scene, truth, quick))
        run_rounds(theirs + own, min(plan.rounds, 5), progress, f"{name} beside ours")
        comparisons = [
            work_precision.compare(
                own, family, plan.t_end, max(_ENOUGH, 1.02 * min(t.errors.position for t in family))
            )
            for family in work_precision.families(theirs)
        ]
        results.append(EngineResult(name, version, engine.NOTE, "", theirs, comparisons))
    return results


def exudyn_agreement(scene: Scene, progress: Progress) -> list[Agreement]:
    """Return how Exudyn at a tight tolerance agrees with references of its own law."""
    exudyn, _ = adapter("exudyn")
    found = []
    for law in ("frictionless", "clamp") if exudyn is not None else ():
        reference = load_reference(f"{scene.name}_{law}")
        for number, t in enumerate(reference.times):
            progress.at(f"agreement with Exudyn, {law}", number, len(reference.times), f"{t:g} s")
            mu = 0.0 if law == "frictionless" else None
            run, read = exudyn.prepare(with_run(scene, t_end=t), 1e-10, mu)
            difference = np.abs(read(run()).q - reference.at(t).q).max()
            found.append(Agreement(law, t, float(difference)))
    return found
