"""Other engines on the paper's scene, each as near as it can come; skipped if not installed."""

from __future__ import annotations

import importlib
import importlib.metadata
from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import ModuleType

import numpy as np

from benchmarks import work_precision
from benchmarks.engines import drake, exudyn, mujoco
from benchmarks.engines.own import with_run
from benchmarks.reference import load_reference
from benchmarks.trial import Outcome, Progress, Trial
from capture_sim.scene.parts import Scene

#: Each has NAME, MODULE, PACKAGE, REFERENCE, NOTE and ``trials(scene, quick)``.
ADAPTERS: tuple[ModuleType, ...] = (exudyn, mujoco, drake)
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


def why_missing(adapter: ModuleType) -> str:
    """Return why an engine cannot be tried; empty if it can."""
    try:
        importlib.import_module(adapter.MODULE)
    except ImportError as error:
        if isinstance(error, ModuleNotFoundError) and error.name == adapter.MODULE:
            return "not installed: pip install -c requirements/constraints.txt '.[benchmark]'"
        return f"does not load: {error}"
    return ""


def measure(
    scene: Scene, plan: work_precision.Plan, quick: bool, progress: Progress
) -> list[EngineResult]:
    """Try all engines that are installed, interleaved with our own integrators."""
    results = []
    adaptive = replace(plan, steps=())
    for adapter in ADAPTERS:
        reason = why_missing(adapter)
        if reason:
            results.append(EngineResult(adapter.NAME, "", adapter.NOTE, reason, [], []))
            continue
        version = importlib.metadata.version(adapter.PACKAGE)
        run_scene = with_run(scene, t_end=plan.t_end)
        theirs = list(adapter.trials(run_scene, quick))
        own = list(work_precision.own_trials(run_scene, adaptive))
        truth = load_reference(scene.name, scene).at(plan.t_end)
        their_truth = load_reference(scene.name + adapter.REFERENCE).at(plan.t_end)
        _interleave(own, truth, theirs, their_truth, min(plan.rounds, 5), progress, adapter.NAME)
        families = work_precision.families(theirs)
        comparisons = [
            work_precision.compare(
                own, family, plan.t_end, max(_ENOUGH, 1.02 * min(t.errors.position for t in family))
            )
            for family in families
        ]
        results.append(EngineResult(adapter.NAME, version, adapter.NOTE, "", theirs, comparisons))
    return results


def _interleave(
    own: Sequence[Trial],
    truth: Outcome,
    theirs: Sequence[Trial],
    their_truth: Outcome,
    rounds: int,
    progress: Progress,
    name: str,
) -> None:
    for k in range(rounds):
        for number, trial in enumerate(theirs):
            progress.at(
                f"{name} beside ours",
                k * len(theirs) + number,
                rounds * len(theirs),
                f"{trial.family}, {trial.setting}",
            )
            trial.run(their_truth)
        for trial in own:
            trial.run(truth)


def exudyn_agreement(scene: Scene, progress: Progress) -> list[Agreement]:
    """Return how Exudyn at a tight tolerance agrees with references of its own law."""
    if why_missing(exudyn):
        return []
    found = []
    for law in ("frictionless", "clamp"):
        reference = load_reference(f"{scene.name}_{law}")
        for number, t in enumerate(reference.times):
            progress.at(f"agreement with Exudyn, {law}", number, len(reference.times), f"{t:g} s")
            changed = with_run(scene, t_end=t)
            job = exudyn.prepare(changed, 1e-10, 0.0 if law == "frictionless" else None)
            difference = np.abs(job()().q - reference.at(t).q).max()
            found.append(Agreement(law, t, float(difference)))
    return found
