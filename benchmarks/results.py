"""Everything that one run of the benchmark has measured."""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks.costs import BatchCost, EvaluationCost, PartCost, RunCost
from benchmarks.engines import Agreement, EngineResult
from benchmarks.work_precision import WorkPrecision


@dataclass(frozen=True)
class Results:
    """Measurements, and what they were made on.

    Attributes
    ----------
    scene : str
        Name of the scene of works, engines and costs.
    quick : bool
        It was a reduced sweep.
    machine : dict
        From :func:`benchmarks.machine.describe`.
    clock : float
        Hz.
    loads : tuple of float
        Running processes before and after.
    seconds : float
        That the benchmark took.
    works : list of WorkPrecision
        One for each horizon.
    engines : list of EngineResult
        Other engines, skipped ones too.
    agreement : list of Agreement
        With Exudyn.
    uncertainty : dict
        Of each reference at its times, m or rad: {name: {t: u}}.
    evaluation : EvaluationCost
        Of the equations of motion.
    operations : dict
        Arithmetic in one evaluation, by phase.
    parts, rail, times, batches
        What things cost.
    """

    scene: str
    quick: bool
    machine: dict[str, str]
    clock: float
    loads: tuple[float, float]
    seconds: float
    works: list[WorkPrecision]
    engines: list[EngineResult]
    agreement: list[Agreement]
    uncertainty: dict[str, dict[float, float]]
    evaluation: EvaluationCost
    operations: dict[str, dict[str, int]]
    parts: list[PartCost]
    rail: RunCost
    times: list[RunCost]
    batches: list[BatchCost]
