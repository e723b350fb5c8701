"""Other engines on the paper's scene, configured as closely as possible: docs/evidence/engines.md.

    python -m benchmarks.other_engines

Needs the packages of the extra ``benchmark``; what is not installed is skipped.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import math
from argparse import Namespace
from pathlib import Path
from types import ModuleType

import numpy as np

from benchmarks import programs
from benchmarks.engines.own import with_run
from benchmarks.pages import error, ratio, seconds, table, write_parts
from benchmarks.reference import load_reference
from benchmarks.trial import Progress, Trial, run_rounds
from capture_sim.scene.loading import load_scene

SCENE = "paper_designed"
_T_END = 0.35  # s
#: By the name of their package; each adapter has REFERENCE, NOTE, ``trials(scene, truth, quick)``.
ENGINES = {"exudyn": "Exudyn", "mujoco": "MuJoCo", "drake": "Drake"}


def adapter(package: str) -> tuple[ModuleType | None, str]:
    """Return the module that drives an engine and its version, or None and why it cannot."""
    try:
        version = importlib.metadata.version(package)
        return importlib.import_module(f"benchmarks.engines.{package}"), version
    except importlib.metadata.PackageNotFoundError:
        return None, "not installed: pip install -c requirements/lock.txt '.[benchmark]'"
    except ImportError as reason:
        return None, f"does not load: {str(reason).splitlines()[0]}"


def engines(asked: Namespace, _: Path) -> list[str]:
    """Time all engines that are installed, in turn with capture_sim."""
    scene, lines, rows = with_run(load_scene(SCENE), t_end=_T_END), [], []
    for package, name in ENGINES.items():
        engine, version = adapter(package)
        if engine is None:
            lines.append(f"- {name}: {version}.")
            continue
        truth = load_reference(SCENE + engine.REFERENCE).at(_T_END)
        theirs = list(engine.trials(scene, truth, False))
        plan = programs.Plan(_T_END)
        own = list(programs.own_trials(scene, plan, load_reference(SCENE).at(_T_END)))
        run_rounds(theirs + own, asked.rounds, Progress(), f"{name} in turn with capture_sim")
        lines.append(f"- {name} {version}: {engine.NOTE}.")
        rows += [_row(trial, own) for trial in theirs]
    head = ["engine", "setting", "position error, m", "peak force, 1", "CPU time"]
    return [*lines, "", table([*head, "ratio", "remark"], rows)]


def _row(trial: Trial, own: list[Trial]) -> list[str]:
    """Return an engine's setting, with its time per our least at the same position error."""
    reached = [t.least for t in own if t.errors.position <= trial.errors.position]
    ours = min(reached, default=math.nan)
    errors = [error(trial.errors.position), error(trial.errors.peak_force)]
    times = [seconds(trial.least), ratio(trial.least / ours), trial.failure]
    return [trial.family, trial.setting, *errors, *times]


def agreement(_: Namespace, __: Path) -> list[str]:
    """Compare Exudyn at a tight tolerance with references of its own law of friction."""
    engine, _version = adapter("exudyn")
    rows = []
    for law in ("frictionless", "clamp") if engine is not None else ():
        reference = load_reference(f"{SCENE}_{law}")
        for t in reference.times:
            mu = 0.0 if law == "frictionless" else None
            run, read = engine.prepare(with_run(load_scene(SCENE), t_end=t), 1e-10, mu)
            difference = np.abs(read(run()).q - reference.at(t).q).max()
            rows.append([law, f"{t:g} s", error(float(difference))])
    return [table(["friction", "at", "largest difference, m or rad"], rows)] if rows else []


if __name__ == "__main__":
    write_parts(
        "engines",
        __doc__,
        {"engines": engines, "agreement": agreement},
        untimed=("agreement",),
        rounds=(5, "of each setting"),
    )
