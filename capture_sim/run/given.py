"""The data that a run's source provides: an integration, a recording, or a loop with hardware."""

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
    """End and energy residual of a simulated run, known without its full samples."""

    t_end: float  # s, of the last sample at run.rate
    energy_residual: float  # J, largest residual of the energy ledger at run.rate


class Given:
    """The data that the source of a run provides; a property without data is empty or None.

    ``Given(scene=scene, series=series)`` stores known values.  A source that computes its data
    lazily is a subclass that overrides the cached properties, so that a recorded topic, for
    example, is decoded only when it is read.
    """

    def __init__(self, **values: Any) -> None:
        """Store values under the names of the properties; TypeError if a name is not a property."""
        unknown = [name for name in values if name not in GIVEN]
        if unknown:
            raise TypeError(f"{unknown[0]}: must be one of {', '.join(GIVEN)}")
        vars(self).update(values)

    def replaced(self: T, **values: Any) -> T:
        """Return a copy with some properties replaced; it computes no other property."""
        changed = copy(self)
        Given.__init__(changed, **values)
        return changed

    @cached_property
    def scene(self) -> Scene | None:
        """Scene of the run; None if the source contains no scene."""
        return None

    @cached_property
    def samples(self) -> np.ndarray:
        """Exact samples of the full state, (n,) of dtype SAMPLE; empty if it is not known."""
        return np.zeros(0, SAMPLE)

    @cached_property
    def series(self) -> SeriesBySource:
        """Series by quantity and source, e.g. ``series["chaser"]["chaser/odom"]``."""
        return {}

    @cached_property
    def touches(self) -> np.ndarray:
        """Touches that the integrator has located, (m,) of dtype TOUCH; empty without any."""
        return np.zeros(0, TOUCH)

    @cached_property
    def events(self) -> Sequence[Event]:
        """Events that the integrator has logged, in the order of their times."""
        return ()

    @cached_property
    def received(self) -> Sequence[Received] | None:
        """Measurements for the detector, in the order in which they arrived.

        With None the detector uses measurements made from :attr:`series`.
        """
        return None

    @cached_property
    def live(self) -> LiveConditions:
        """Conditions under which the live detector evaluated the run, to evaluate it again."""
        return LiveConditions(is_simulated=True)

    @cached_property
    def statuses(self) -> Sequence[CaptureStatus]:
        """Statuses that a detector has reported during the run; empty without any."""
        return ()

    @cached_property
    def criteria(self) -> Detector | None:
        """Criteria of the detector that took part in the run; None if they are not known."""
        return None

    @cached_property
    def extremes(self) -> Extremes | None:
        """Peak loads that the integrator has located, before and after the latch closes."""
        return None

    @cached_property
    def trace(self) -> np.ndarray:
        """State of the contact at the ends of integrator steps, (k,) with the fields of TRACE."""
        return np.zeros(0, TRACE)

    @cached_property
    def plan(self) -> LaunchPlan | None:
        """Launch plan that the launcher was commanded to carry out; None if it is not known."""
        return None

    @cached_property
    def tables(self) -> Mapping[str, Table]:
        """Recorded topics by name, as columns with units; empty for a simulated run."""
        return {}

    @cached_property
    def evidence(self) -> Sequence[Measured]:
        """Sensor measurements that the plausibility rules check."""
        return ()

    @cached_property
    def integrated(self) -> Integrated | None:
        """Results of the integration of a simulated run; None for any other run."""
        return None


#: Names of the properties of Given, i.e. of all data that a source may provide.
GIVEN = tuple(name for name, value in vars(Given).items() if isinstance(value, cached_property))
