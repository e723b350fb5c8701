"""Ways in which a run ends: for the node that announces it, and for each participant."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from capture_sim.nodes.protocol.roll import RunReport

#: Reason that is reported for a run that Ctrl-C has ended.
INTERRUPTED = "interrupted"


class CutKind(Enum):
    """Reason why the simulator or player ends a run early."""

    RESET = "reset"  # the same scene begins again, as a new run
    STOPPED = "stopped"
    QUITTING = "quitting"
    ABORTED = "aborted"  # something has gone wrong

    @property
    def is_requested(self) -> bool:
        """True if a user has asked for the early end, False after an error."""
        return self is not CutKind.ABORTED


class EndKind(Enum):
    """Ways in which a run can end for a participant."""

    COMPLETE = "complete"
    REQUESTED = "requested"  # reset, stopped, quitting, Ctrl-C
    CUT = "cut"  # the announcer or this node has failed
    MISSING = "missing"  # messages that were sent have not come
    ABANDONED = "abandoned"  # the announcer has not ended it


@dataclass(frozen=True)
class RunEnd:
    """The end of a run, as a participant sees it; ``reason`` is empty if the run is complete."""

    kind: EndKind
    reason: str = ""

    @property
    def report(self) -> RunReport:
        """The report of a node whose only problem, if any, is the reason of the end."""
        return RunReport((self.reason,) if self.reason else ())
