"""The runs of an envelope: spread over workers, kept in one file as they come.

The file begins with the plan, in a line of JSON; each chunk of runs that is done is written
behind it.  Killed and started again, a map takes the runs that are there and does the others;
as what is run depends on verdicts alone, it ends in the same rows.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from capture_sim import __version__
from capture_sim.errors import RecordingError, SceneError
from capture_sim.kernels import source_hash
from capture_sim.launch.scenes import load_scene_text
from capture_sim.studies.envelope import AXES, ROW, Key, Plan, Slices, Span, evaluate
from capture_sim.studies.executors import answers

#: Points in a chunk: some tenths of a second of work.
CHUNK = 32


#: Fields of a plan: its axes, and its numbers.
_AXES = tuple(name for name, _, _ in AXES)
_NUMBERS = ("levels", "runs", "rtol", "run_up", "horizon")


def plan_to_mapping(plan: Plan) -> dict[str, Any]:
    """Return a plan as plain data that gives it again, exactly."""
    axes = {name: dataclasses.asdict(getattr(plan, name)) for name in _AXES}
    numbers = {name: getattr(plan, name) for name in _NUMBERS}
    return {"capture_sim": __version__, **axes, **numbers, "scene": plan.scene.to_yaml()}


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
            for name in _AXES
        }
        numbers = {name: mapping[name] for name in _NUMBERS}
        return Plan(load_scene_text(mapping["scene"]), **axes, **numbers)
    except (KeyError, TypeError) as error:
        raise SceneError(f"plan of an envelope: {error} is missing or not understood") from None


class KeptRuns:
    """Runs points of a map on an executor and keeps them in a file.

    Parameters
    ----------
    plan
        What is mapped.
    executor
        Where it is run.
    path
        Of the file; made if it is not there.
    report
        Called with a round's name, how many of its points are done, and of how many.

    Attributes
    ----------
    resumed : int
        Points that the file already held.

    Raises
    ------
    SceneError
        The file holds runs of another plan, or of another version of the simulator.
    RecordingError
        The file cannot be read or written.
    """

    def __init__(
        self,
        plan: Plan,
        executor: Executor,
        path: Path,
        report: Callable[[str, int, int], None] | None = None,
    ) -> None:
        self._plan, self._executor, self._path, self._report = plan, executor, path, report
        config = {**plan_to_mapping(plan), "source": source_hash()}
        head = json.dumps(config, sort_keys=True).encode() + b"\n"
        try:
            kept = path.read_bytes() if path.exists() else b""
            if not kept.startswith(head[: len(kept)]):
                raise SceneError(
                    f"{path}: holds runs of another plan or version; remove it, or choose "
                    "another --out"
                )
            whole = max(len(kept) - len(head), 0) // ROW.itemsize * ROW.itemsize
            rows = np.frombuffer(kept[len(head) : len(head) + whole], ROW)
            if len(kept) < len(head):
                path.write_bytes(head)
            else:
                os.truncate(path, len(head) + whole)  # half a row at the end is lost
        except OSError as error:
            raise RecordingError(f"{path}: cannot be used: {error.strerror}") from None
        self._kept = {(bool(row["checked"]), *_key(row)): row for row in rows}
        self.resumed = len(self._kept)

    def __call__(self, name: str, keys: Sequence[Key], rtol: float) -> np.ndarray:
        """Return the rows of points, from the file or by running them."""
        check = name == "check"
        missing = [key for key in keys if (check, *key) not in self._kept]
        done = len(keys) - len(missing)
        chunks = [missing[start : start + CHUNK] for start in range(0, len(missing), CHUNK)]
        work = partial(evaluate, self._plan, rtol=rtol, check=check)
        for rows in answers(self._executor, work, chunks):
            self._keep(rows)
            self._kept.update({(check, *_key(row)): row for row in rows})
            done += len(rows)
            if self._report is not None:
                self._report(name, done, len(keys))
        return np.array([self._kept[check, *key] for key in keys], ROW)

    def _keep(self, rows: np.ndarray) -> None:
        try:
            with self._path.open("ab") as file:
                file.write(rows.tobytes())
        except OSError as error:
            raise RecordingError(f"{self._path}: cannot be written: {error.strerror}") from None

    def remove(self) -> None:
        """Remove the file: the finished map is kept elsewhere."""
        self._path.unlink()


def _key(row: np.void) -> Key:
    return int(row["slice"]), int(row["i"]), int(row["j"])
