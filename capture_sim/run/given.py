"""The data that a run's source gives: an integration, a recording, or a loop with hardware."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

from capture_sim.detection.criteria import CaptureStatus
from capture_sim.dynamics.samples import SAMPLE, TOUCH, TRACE, Event, Extremes
from capture_sim.plausibility.measured import Measured
from capture_sim.run.frames import Table
from capture_sim.run.series import SeriesBySource
from capture_sim.run.verdict import LiveConditions, Received

if TYPE_CHECKING:
    from capture_sim.scene.launch_plan import LaunchPlan
    from capture_sim.scene.parts import Detector, Scene

T = TypeVar("T", bound="Given")


class Integrated(NamedTuple):
    """Results of the integration of a simulated run that need no samples."""

    t_end: float  # s, of the last sample at run.rate
    energy_residual: float  # J, largest residual of the energy ledger at run.rate


class Given:
    """The data that the source of a run gives; a part that it does not give is empty or None.

    ``Given(scene=scene, series=series)`` holds values.  A source that computes its data lazily is a
    subclass with its own cached properties: a topic is decoded only when it is read.
    """

    def __init__(self, **values: Any) -> None:
        """Hold values by the names of the properties; TypeError for any other name."""
        unknown = [name for name in values if name not in GIVEN]
        if unknown:
            raise TypeError(f"{unknown[0]}: must be one of {', '.join(GIVEN)}")
        vars(self).update(values)

    def replaced(self: T, **values: Any) -> T:
        """Return a copy with other values; parts that are not computed yet stay lazy."""
        changed = copy(self)
        Given.__init__(changed, **values)
        return changed

    @cached_property
    def scene(self) -> Scene | None:
        """The scene."""
        return None

    @cached_property
    def samples(self) -> np.ndarray:
        """Exact samples of the full state, (n,) of dtype SAMPLE."""
        return np.zeros(0, SAMPLE)

    @cached_property
    def series(self) -> SeriesBySource:
        """Series by quantity and source, e.g. ``series["chaser"]["chaser/odom"]``."""
        return {}

    @cached_property
    def touches(self) -> np.ndarray:
        """Touches that the integrator has located, (m,) of dtype TOUCH."""
        return np.zeros(0, TOUCH)

    @cached_property
    def events(self) -> Sequence[Event]:
        """Events that the integrator has logged, in order."""
        return ()

    @cached_property
    def received(self) -> Sequence[Received] | None:
        """Measurements for the detector in the order of their arrival; None to use the series."""
        return None

    @cached_property
    def live(self) -> LiveConditions:
        """Measurements that the live detector could use."""
        return LiveConditions(is_simulated=True)

    @cached_property
    def statuses(self) -> Sequence[CaptureStatus]:
        """Statuses that a detector has reported during the run."""
        return ()

    @cached_property
    def criteria(self) -> Detector | None:
        """The criteria of that detector."""
        return None

    @cached_property
    def extremes(self) -> Extremes | None:
        """Peak loads that the integrator has located, before and after the latch closes."""
        return None

    @cached_property
    def trace(self) -> np.ndarray:
        """Contact at the ends of the integrator's steps, (k,) with the fields of TRACE."""
        return np.zeros(0, TRACE)

    @cached_property
    def plan(self) -> LaunchPlan | None:
        """The launch as it was commanded."""
        return None

    @cached_property
    def tables(self) -> Mapping[str, Table]:
        """Recorded topics by name, as columns with units."""
        return {}

    @cached_property
    def evidence(self) -> Sequence[Measured]:
        """Measurements of the sensors, for the rules of plausibility."""
        return ()

    @cached_property
    def integrated(self) -> Integrated | None:
        """Results of the integration of a simulated run; None for any other run."""
        return None


#: Names of what a source may give.
GIVEN = tuple(name for name, value in vars(Given).items() if isinstance(value, cached_property))
