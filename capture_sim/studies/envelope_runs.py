"""The runs of an envelope, spread over workers and kept as they come.

Each round of the map is cut into chunks.  A chunk that is done is written to a file of its
own, under another name first and then renamed, so that a file that is there is whole.
Killed and started again, a map takes up the files that are there; as the plan decides what
each chunk holds, it ends in the same rows.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture_sim import __version__
from capture_sim.errors import RecordingError, SceneError
from capture_sim.kernels import source_hash
from capture_sim.launch.scenes import load_scene_text
from capture_sim.studies.envelope import ROW, Envelope, Key, Plan, Slices, Span, evaluate, explore
from capture_sim.studies.executors import Executor

#: Points in a chunk: some tenths of a second of work.
CHUNK = 32

_PLAN = "plan.json"


def plan_to_mapping(plan: Plan) -> dict[str, Any]:
    """Return a plan as plain data that gives it again, exactly."""
    mapping: dict[str, Any] = {"capture_sim": __version__}
    for name in ("angle", "offset", "speed"):
        axis = getattr(plan, name)
        mapping[name] = (
            {"values": list(axis.values)}
            if isinstance(axis, Slices)
            else {"low": axis.low, "high": axis.high, "cells": axis.cells}
        )
    for name in ("levels", "runs", "rtol", "run_up", "horizon"):
        mapping[name] = getattr(plan, name)
    mapping["scene"] = plan.scene.to_yaml()
    return mapping


def plan_from_mapping(mapping: dict[str, Any]) -> Plan:
    """Make a plan again.

    Raises
    ------
    SceneError
        Something is missing or out of its range.
    """
    try:
        axes: dict[str, Any] = {
            name: Slices(tuple(mapping[name]["values"]))
            if "values" in mapping[name]
            else Span(**mapping[name])
            for name in ("angle", "offset", "speed")
        }
        numbers = {name: mapping[name] for name in ("levels", "runs", "rtol", "run_up", "horizon")}
        return Plan(load_scene_text(mapping["scene"]), **axes, **numbers)
    except (KeyError, TypeError) as error:
        raise SceneError(f"plan of an envelope: {error} is missing or not understood") from None


@dataclass(frozen=True)
class _Task:
    """A chunk of runs, as it travels to a worker."""

    plan: Plan
    keys: Sequence[Key]
    rtol: float


def _work(task: _Task) -> np.ndarray:
    return evaluate(task.plan, task.keys, task.rtol)


class KeptRuns:
    """Runs points of a map on an executor and keeps them in a folder.

    Parameters
    ----------
    plan
        What is mapped.
    executor
        Where it is run.
    folder
        For the chunks; made if it is not there.
    tell
        Called with a round's name, and how many of its points are done, of how many.

    Raises
    ------
    SceneError
        The folder holds runs of another plan, or of another version of the simulator.
    RecordingError
        The folder cannot be written.
    """

    def __init__(
        self,
        plan: Plan,
        executor: Executor,
        folder: Path,
        tell: Callable[[str, int, int], None] | None = None,
    ) -> None:
        self._plan, self._executor, self._folder, self._tell = plan, executor, folder, tell
        self.resumed = 0  # points taken from the folder
        config = {**plan_to_mapping(plan), "source": source_hash()}
        text = json.dumps(config, indent=1, sort_keys=True)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            kept = folder / _PLAN
            if not kept.exists():
                _write(kept, text.encode())
            elif kept.read_text(encoding="utf-8") != text:
                raise SceneError(
                    f"{folder}: holds runs of another plan or version; remove it, or choose "
                    "another --out"
                )
        except OSError as error:
            raise RecordingError(f"{folder}: cannot be used: {error.strerror}") from None

    def __call__(self, name: str, keys: Sequence[Key], rtol: float) -> np.ndarray:
        """Return the rows of points, from the folder or by running them."""
        pieces = [keys[start : start + CHUNK] for start in range(0, len(keys), CHUNK)]
        found = [self._read(self._path(name, n), piece) for n, piece in enumerate(pieces)]
        missing = [n for n, rows in enumerate(found) if rows is None]
        done = len(keys) - sum(len(pieces[n]) for n in missing)
        self.resumed += done
        self._say(name, done, len(keys))
        tasks = [_Task(self._plan, pieces[n], rtol) for n in missing]
        for place, rows in self._executor.answers(_work, tasks):
            number = missing[place]
            _write(self._path(name, number), rows.tobytes())
            found[number] = rows
            done += len(rows)
            self._say(name, done, len(keys))
        return np.concatenate([np.zeros(0, ROW), *(rows for rows in found if rows is not None)])

    def _say(self, name: str, done: int, count: int) -> None:
        if self._tell is not None:
            self._tell(name, done, count)

    def _path(self, name: str, number: int) -> Path:
        return self._folder / f"{name}-{number:05d}.rows"

    @staticmethod
    def _read(path: Path, keys: Sequence[Key]) -> np.ndarray | None:
        """Return the rows of a chunk if its file is there and holds these points."""
        try:
            rows = np.frombuffer(path.read_bytes(), ROW)
        except (OSError, ValueError):
            return None
        held = zip(*(rows[name].tolist() for name in ("slice", "i", "j")), strict=True)
        return rows if list(held) == list(keys) else None

    def remove(self) -> None:
        """Remove the folder: the finished map is kept elsewhere."""
        shutil.rmtree(self._folder)


def _write(path: Path, data: bytes) -> None:
    """Write a file that is there whole or not at all."""
    beside = path.with_suffix(".part")
    try:
        beside.write_bytes(data)
        beside.replace(path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error.strerror}") from None


def map_envelope(
    plan: Plan,
    executor: Executor,
    folder: Path,
    tell: Callable[[str, int, int], None] | None = None,
) -> Envelope:
    """Map an envelope with its runs kept in ``folder``; see :class:`KeptRuns`."""
    return explore(plan, KeptRuns(plan, executor, folder, tell))
