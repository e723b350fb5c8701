"""Sweeps: many runs of a scene with different values, in a table with one row for each run.

A row contains the inputs, the verdict, the loads of the complete run and, if the run failed, the
reason.  A row depends only on its inputs, so the table does not depend on where the runs are
computed.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import time
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from capture_sim.base.journal import Journal
from capture_sim.dynamics.memory import Memory
from capture_sim.dynamics.samples import EXTREMES, TOUCH, Extremes
from capture_sim.errors import MissingPackageError, SceneError, import_failure
from capture_sim.run.controllers import control_of
from capture_sim.run.integration import Integration, kept
from capture_sim.run.loads import LOADS, loads_of
from capture_sim.scene import paths
from capture_sim.scene.approach import APPROACH, Approach, approach_of, placed, with_approach
from capture_sim.scene.files import Overrides
from capture_sim.scene.loading import as_scene
from capture_sim.scene.parts import Scene
from capture_sim.studies.evaluate.executors import answers, open_executor
from capture_sim.studies.evaluate.limits import Limit, exceeded, make_limits
from capture_sim.studies.evaluate.outcome import Outcome, outcome_of
from capture_sim.studies.vary.inputs import Input, declaration_of, read_input
from capture_sim.studies.vary.sampling import PLAIN, Correlations, Samples, make_samples

if TYPE_CHECKING:
    import pandas

#: Verdict of a run that could not be computed; the column ``failure`` gives the reason.
FAILED = "failed"
#: Number of runs in one task of a worker.
_CHUNK = 20
#: With a journal, the intended maximum duration of one task of a worker, s.
_MOMENT = 2.0
#: Relative tolerance of the runs of a sweep; see docs/evidence/random_scenes.md.
RTOL = 1e-6

#: Results of a run other than its loads, and their units.
_OUTCOME = {
    "verdict": "",
    "verdict_time": "s",
    "left_again": "",
    "first_touch_time": "s",
    "energy_residual": "J",
}
#: Columns that a table may have in addition to inputs, outcome and loads, and their units.
_NOTES = {
    "design": "",
    "verdict_at_half_tolerance": "",
    "exceeded": "",  # names of the loads that exceed their limits, separated by blanks
    "failure": "",
    "command": "",  # command that repeats the run; only in files
}


@functools.cache
def result_units() -> dict[str, str]:
    """Return the columns of a table other than the inputs, and their units."""
    of_load = {load.key: load.unit for load in LOADS}
    of_load |= {"touches": "", "first_contact_impulse": "N s"}
    units = dict(_OUTCOME)
    for name in loads_of(Extremes(np.zeros(1, EXTREMES)[0], None), np.zeros(0, TOUCH)):
        key = name.removesuffix("_time").removesuffix("_before_latch")
        units[name] = "s" if name.endswith("_time") else of_load[key]
    return {**units, **_NOTES}


@functools.cache
def result_columns(*, check: bool, limited: bool) -> tuple[str, ...]:
    """Return the names of the result columns of a run.

    ``check`` includes the verdict at half the tolerance, ``limited`` the exceeded limits.
    """
    left_out = {"design", "command"}
    left_out |= set() if check else {"verdict_at_half_tolerance"}
    left_out |= set() if limited else {"exceeded"}
    return tuple(name for name in result_units() if name not in left_out)


def sweep(
    scene: Scene | str | Path,
    vary: Mapping[str, Any] | pandas.DataFrame,
    overrides: Overrides = (),
    *,
    runs: int = 0,
    sample: str = "random",
    seed: int = 1,
    edges: int = 0,
    correlations: Correlations | None = None,
    limits: Mapping[str, Any] | None = None,
    rtol: float = RTOL,
    check: bool = False,
    control: str = "",
    executor: Executor | None = None,
    report: Callable[[int, int], None] | None = None,
) -> pandas.DataFrame:
    """Run a scene over values, distributions or the rows of a table.

    The detector evaluates the exact motion, even if the scene has ``sensors.motion_capture``.  For
    one run with measurement noise, see :func:`capture_sim.simulate`.

    Parameters
    ----------
    scene
        Scene, or the name or path of a scene for :func:`capture_sim.load_scene`.
    vary
        Varied inputs by name, or a table.  An input is a field (``"buffer.c_A"``) or a value of
        the approach, the free flight just before the first touch (``"approach.angle"``,
        ``.offset`` or ``.mouth_offset``, ``.speed``).  Each input has values, a text
        (``"5:30:26"``, ``"normal(500, 5%)"``, ``"-5 deg:5 deg:11"``) or a frozen distribution of
        scipy.stats.  A table has one row for each run and one column for each field.  Its other
        columns are copied to the result as notes, with a warning.  A row with an invalid value
        becomes a failed run with the reason.
    overrides
        Values to change in the scene, as for :func:`capture_sim.load_scene`.
    runs
        Number of draws from the distributions at each combination of the values.
    sample
        Sampling method: ``"random"``, ``"latin"``, ``"sobol"``, or ``"saltelli"`` for Sobol
        indices (``runs`` is then the number of base samples).
    seed
        Seed of the draws.  The draws do not depend on the order in which the distributions are
        given.
    edges
        Number of additional draws near the edges of the distributions.  Their rows have
        ``"edges"`` in the column ``design``.
    correlations
        Correlations of a Gaussian copula by pairs of names of distributions, e.g.
        ``{("approach.speed", "approach.angle"): 0.6}``.
    limits
        Upper limits of loads, SI or a text with a unit, e.g. ``{"max_normal_force": 500}``.  The
        column ``exceeded`` has the names of the loads that exceed their limits.
    rtol
        Relative tolerance of the runs, unless ``overrides`` or ``vary`` set ``run.rtol``.
    check
        True to repeat every run at half the tolerance.  The column
        ``verdict_at_half_tolerance`` has the verdicts of the repeated runs.
    control
        ``"module:function"`` of a controller of the scene's thrusters, made anew for each run, see
        :func:`capture_sim.run.controllers.control_of`.  ``sensors.*`` may then vary.
    executor
        Executor as in ``concurrent.futures``; None for one process on each core.
    report
        Function called with the number of finished runs and the number of all runs.

    Returns
    -------
    pandas.DataFrame
        One row for each run, in the order of the samples; ``attrs["units"]`` has the unit of each
        column.  After Ctrl-C, the table contains only finished runs, with a warning.
        :func:`capture_sim.plot` draws it.

    Raises
    ------
    SceneError
        A name or a value is invalid; raised before anything runs.
    MissingPackageError
        pandas, or SALib for ``"saltelli"``, is not installed.

    Warnings
    --------
    A run that could not be computed is a row with the verdict ``"failed"`` and a reason in
    ``failure``.  Its loads, up to then, are no loads of a capture.

    See Also
    --------
    capture_sim.simulate : One run, with its samples.
    capture_sim.studies.search.design.design_buffer : The best buffers instead of a table of all.
    capture_sim.studies.evaluate.dispersion : Probabilities, quantiles and indices of a table.

    Examples
    --------
    >>> import capture_sim
    >>> table = capture_sim.sweep("tilt_0", {"buffer.c_A": [5, 15, 25]})
    >>> table["verdict"].tolist()
    ['captured', 'captured', 'captured']
    """
    scene = as_scene(scene, overrides)
    scene = at_tolerance(scene, overrides, rtol)
    samples = samples_of(
        scene, vary, runs, sample, seed, edges, correlations, is_flown=bool(control)
    )
    if samples.notes:
        warnings.warn(notes_text(scene, list(samples.notes)), stacklevel=2)
    table = run_samples(
        scene,
        samples,
        limits=make_limits(limits or {}),
        check=check,
        executor=executor,
        report=report,
        control=control,
    )
    if len(table) < len(samples.rows):
        warnings.warn(
            f"interrupted: {len(table)} of {len(samples.rows)} runs are done", stacklevel=2
        )
    return table


def at_tolerance(scene: Scene, overrides: Overrides, rtol: float = RTOL) -> Scene:
    """Return a scene with the tolerance of a sweep, unless ``overrides`` set another."""
    items = [overrides] if isinstance(overrides, str) else overrides
    if any(item.partition("=")[0].strip() == "run.rtol" for item in items):
        return scene
    changed: Scene = paths.changed(scene, "run.rtol", rtol)
    return changed


def notes_text(scene: Scene, names: Sequence[str]) -> str:
    """Return the warning text for columns of a table that are not fields of a scene."""
    return f"columns that are no fields of {scene.name}, kept as notes: {', '.join(names)}"


def samples_of(
    scene: Scene,
    vary: Mapping[str, Any] | pandas.DataFrame,
    runs: int = 0,
    sample: str = "random",
    seed: int = 1,
    edges: int = 0,
    correlations: Correlations | None = None,
    *,
    is_flown: bool = False,
) -> Samples:
    """Return the runs of a sweep after checking its arguments; see :func:`sweep`.

    ``is_flown``: a controller sees the scene's sensors.  Raises SceneError if a name, a value or a
    combination of names is invalid.
    """
    if not isinstance(vary, Mapping):
        samples = _samples_of_table(scene, vary)
    else:
        axes = [read_input(scene, name, given) for name, given in vary.items()]
        if not axes:
            raise SceneError("vary: must have one axis or more")
        samples = make_samples(axes, runs, sample, seed, edges, correlations)
    names = [axis.name for axis in samples.axes]
    fields = [path for name in names for path in paths.expanded(name)]
    if twice := [path for path in fields if fields.count(path) > 1]:
        raise SceneError(f"{twice[0]}: varies twice: must be named once")
    sensors = [name for name in names if name.startswith("sensors.")]
    if sensors and not is_flown:
        raise SceneError(f"{sensors[0]}: must not vary: verdicts are of the exact motion")
    clash = [name for name in names if name.startswith(("initial.", "rail.", "string."))]
    if clash and set(names) & set(APPROACH):
        raise SceneError(f"{clash[0]}: must not vary with approach.*, which replaces it")
    if {"approach.offset", "approach.mouth_offset"} <= set(names):
        raise SceneError("approach.mouth_offset: must not vary with approach.offset")
    if set(names) & set(APPROACH):
        approach_of(scene)
    return samples


def _samples_of_table(scene: Scene, table: pandas.DataFrame) -> Samples:
    inputs = {*paths.field_names(scene), *APPROACH, *paths.ALIASES}
    columns, ignored = [], []
    for name in map(str, table.columns):
        if name in inputs:
            columns.append(name)
        elif name not in result_units():
            _refuse_misspelt(scene, name, inputs)
            ignored.append(name)
    if not columns or table.empty:
        raise SceneError("table: must have one row and one column of a field or more")
    axes, failures = [], dict[int, str]()
    for name in columns:
        axis, invalid = _column(scene, name, table[name].tolist())
        axes.append(axis)
        failures |= {row: text for row, text in invalid.items() if row not in failures}
    if len(failures) == len(table):
        raise SceneError(next(iter(failures.values())))
    rows = list(zip(*(axis.values for axis in axes), strict=True))
    notes = {name: table[name].tolist() for name in ignored}
    return Samples(tuple(axes), rows, [PLAIN] * len(rows), notes, failures)


def _column(scene: Scene, name: str, cells: Sequence[Any]) -> tuple[Input, dict[int, str]]:
    """Return the axis of a table's column, and the reason for each invalid value by row number.

    Invalid values are NaN in the axis.
    """
    try:
        if not any(map(_is_blank, cells)):
            return read_input(scene, name, cells), {}
    except SceneError:
        declaration_of(scene, name)  # raises here if the name of the column is invalid
    values: list[Any] = []
    invalid: dict[int, str] = {}
    for row, cell in enumerate(cells):
        try:
            if _is_blank(cell):
                raise SceneError(f"{name}: has no value")
            values += read_input(scene, name, [cell]).values
        except SceneError as error:
            values.append(math.nan)
            invalid[row] = f"row {row}: {error}"
    return Input(name, declaration_of(scene, name).unit, tuple(values)), invalid


def _is_blank(cell: Any) -> bool:
    return cell is None or cell == "" or cell != cell


def _refuse_misspelt(scene: Scene, name: str, inputs: Collection[str]) -> None:
    """Raise SceneError if the name of a column looks like a misspelt field.

    Such a name begins with a part of the scene (``buffer.c``), or is a field's name without its
    part (``c_A``).
    """
    lower = name.lower()
    part = lower.partition(".")[0]
    fields = [field.lower() for field in inputs]
    is_in_part = "." in name and any(field.startswith(f"{part}.") for field in fields)
    if is_in_part or any(field.endswith(f".{lower}") for field in fields):
        hint = paths.did_you_mean(paths.alike(sorted(inputs), name))
        raise SceneError(f"column {name}: no field of {scene.name}; {hint}")


def run_samples(
    scene: Scene,
    samples: Samples,
    *,
    limits: Sequence[Limit] = (),
    check: bool = False,
    executor: Executor | None = None,
    report: Callable[[int, int], None] | None = None,
    journal: Journal | None = None,
    control: str = "",
) -> pandas.DataFrame:
    """Run samples and return their table.

    After Ctrl-C, the table ends before the first unfinished run.  A journal stores the rows as
    they are computed.  Rows that are already in the journal are not computed again.
    """
    try:
        import pandas
    except ImportError as error:
        text = import_failure("sweep() needs pandas", error, "study")
        raise MissingPackageError(text) from None
    names = tuple(axis.name for axis in samples.axes)
    rows, count, invalid = samples.rows, len(samples.rows), samples.failures
    recipe = Recipe(scene, names, control)
    if control:
        control_of(scene, control)  # what is wrong with it is said before anything runs
    done = {k: _failed_row(text, check=check, limits=limits) for k, text in invalid.items()}
    for first, earlier in journal.entries if journal is not None else ():
        done |= {first + k: tuple(row) for k, row in enumerate(earlier)}
    size = _CHUNK if journal is None else _rows_of_a_moment(recipe, rows, done)
    chunks = list(_chunks([k for k in range(count) if k not in done], size))
    work = functools.partial(run_rows, recipe, check, tuple(limits))
    try:
        with (
            nullcontext(executor) if executor else open_executor(None if count > 1 else 1) as ready
        ):
            tasks = [[rows[k] for k in chunk] for chunk in chunks]
            for chunk, results in zip(chunks, answers(ready, work, tasks), strict=True):
                done |= zip(chunk, results, strict=True)
                if journal is not None:
                    journal.add([chunk.start, results])
                if report is not None:
                    report(len(done), count)
    except KeyboardInterrupt:
        pass  # keep the finished rows; the caller can see that rows are missing
    finished = next((k for k in range(count) if k not in done), count)
    inputs = dict(zip(names, zip(*rows[:finished], strict=True), strict=True)) if finished else {}
    table = pandas.DataFrame(inputs)
    if len(set(samples.designs)) > 1:
        table["design"] = samples.designs[:finished]
    for name, cells in samples.notes.items():
        table[name] = cells[:finished]
    results = pandas.DataFrame(
        [done[k] for k in range(finished)],
        columns=list(result_columns(check=check, limited=bool(limits))),
    )
    table = pandas.concat([table, results], axis=1)
    table.index.name = "run"
    units = {**{axis.name: axis.unit for axis in samples.axes}, **result_units()}
    table.attrs["units"] = {name: units.get(name, "") for name in table.columns}
    table.attrs["scene"] = scene.name
    table.attrs["inputs"] = {axis.name: axis.text for axis in samples.axes}
    return table


def _chunks(rows: Sequence[int], size: int) -> Iterator[range]:
    """Yield ascending row numbers as ranges of at most ``size`` consecutive rows."""
    first = last = -1
    for row in rows:
        if row != last or last - first == size:
            if last > first:
                yield range(first, last)
            first = row
        last = row + 1
    if last > first:
        yield range(first, last)


def _rows_of_a_moment(
    recipe: Recipe, rows: Sequence[tuple[Any, ...]], done: Collection[int]
) -> int:
    """Return the number of rows in one task, so that a killed sweep loses only seconds of work.

    One waiting row is run to measure its duration.
    """
    waiting = next((row for k, row in enumerate(rows) if k not in done), None)
    if waiting is None:
        return _CHUNK
    began = time.perf_counter()
    run_rows(recipe, False, (), [waiting])
    return min(max(int(_MOMENT / (time.perf_counter() - began)), 1), _CHUNK)


def _failed_row(text: str, *, check: bool, limits: Sequence[Limit]) -> tuple[Any, ...]:
    results = _results(SceneError(text), limits)
    columns = result_columns(check=check, limited=bool(limits))
    return tuple(results.get(name, math.nan) for name in columns)


@dataclasses.dataclass(frozen=True)
class Recipe:
    """Recipe for a run: the scene to vary, and the names of the varied inputs.

    ``control``: ``module:function`` of the controller that flies it, or empty.
    """

    scene: Scene
    names: tuple[str, ...]
    control: str = ""

    @functools.cached_property
    def _approach(self) -> Approach | None:
        """The approach in the scene before any change; None if no axis varies the approach."""
        if not set(self.names) & set(APPROACH):
            return None
        return approach_of(self.scene)

    def scene_of(self, values: Iterable[Any]) -> Scene:
        """Return the scene of a run from the values of its inputs.

        Raises
        ------
        SceneError
            A value is out of its range.
        """
        given = dict(zip(self.names, values, strict=True))
        fields = {name: value for name, value in given.items() if name not in APPROACH}
        scene: Scene = paths.with_values(self.scene, fields)
        if self._approach is None:
            return scene
        return placed(scene, self._approach_of(given))

    def _approach_of(self, given: Mapping[str, Any]) -> Approach:
        """Return the approach of a run from its values by name."""
        assert self._approach is not None
        values = {n.removeprefix("approach."): x for n, x in given.items() if n in APPROACH}
        return with_approach(self._approach, values)

    def overrides_of(self, values: Sequence[Any]) -> list[str]:
        """Return the overrides (``name=value``) that reproduce a run's scene exactly."""
        given = dict(zip(self.names, values, strict=True))
        changes = [f"{name}={value}" for name, value in given.items() if name not in APPROACH]
        if self._approach is not None:
            approach = dataclasses.asdict(self._approach_of(given))
            # only one of the two offsets is valid; every other value is listed, because the values
            # not given would be taken from the changed scene instead of the original scene
            del approach["offset" if approach["mouth_offset"] is not None else "mouth_offset"]
            changes += [f"approach.{name}={value}" for name, value in approach.items()]
        return changes


def run_rows(
    recipe: Recipe,
    check: bool,
    limits: Sequence[Limit],
    rows: Sequence[tuple[Any, ...]],
    also: tuple[str, ...] = (),
) -> list[tuple[Any, ...]]:
    """Return the results of some runs, each in the order of :func:`result_columns`.

    ``also`` names results to append that no table has: ``behind``, see :class:`Outcome`.
    """
    columns = (*result_columns(check=check, limited=bool(limits)), *also)
    memories = iter(kept.memories(2 * len(rows) if check else len(rows)))
    prepared = [_prepared(recipe, row, memories, check=check) for row in rows]
    for runs in prepared:
        if not isinstance(runs, SceneError):
            for run in runs:
                run.integrate()
    results = [_results(runs, limits) for runs in prepared]
    return [tuple([of_row.get(name, math.nan) for name in columns]) for of_row in results]


def _prepared(
    recipe: Recipe, row: tuple[Any, ...], memories: Iterator[Memory], *, check: bool
) -> tuple[Integration, ...] | SceneError:
    """Return the integration of a row, or the error if the row has an invalid value.

    With ``check``, a second integration at half the tolerance follows.
    """
    try:
        scene = recipe.scene_of(row)
        scenes = (scene, _at_half_tolerance(scene)) if check else (scene,)
        return tuple(
            Integration(
                scene,
                next(memories),
                control_of(scene, recipe.control) if recipe.control else None,
            )
            for scene in scenes
        )
    except SceneError as error:
        return error


def _results(runs: tuple[Integration, ...] | SceneError, limits: Sequence[Limit]) -> dict[str, Any]:
    """Return the results of a row by the names of their columns."""
    if isinstance(runs, SceneError):
        results: dict[str, Any] = dict.fromkeys(("verdict", "verdict_at_half_tolerance"), FAILED)
        return {**results, "left_again": False, "touches": 0, "exceeded": "", "failure": str(runs)}
    outcome, *finer = map(outcome_of, runs)
    loads = {name: math.nan if x is None else x for name, x in outcome.loads.items()}
    return {
        "verdict": _verdict(outcome),
        "verdict_time": outcome.t,
        "left_again": outcome.left_again,
        "first_touch_time": outcome.first_touch,
        "energy_residual": outcome.energy_residual,
        **loads,
        "verdict_at_half_tolerance": _verdict(finer[0]) if finer else None,
        "exceeded": " ".join(exceeded(limits, outcome.loads)),
        "failure": outcome.failure,
        "behind": outcome.behind,
    }


def _verdict(outcome: Outcome) -> str:
    return FAILED if outcome.failure else outcome.verdict


def _at_half_tolerance(scene: Scene) -> Scene:
    return dataclasses.replace(scene, run=scene.run.refined(2.0, 2.0))
