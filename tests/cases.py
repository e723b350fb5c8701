"""How many cases the tests try: few in `make test`, all in `make test-all`.

The environment variable CAPTURE_SIM_CASES says which: ``few`` (as without it), ``all``, or a
number, which stands for all and counts the cases of the tests that draw theirs at random.  With
few, pytest deselects the tests that are marked ``long``.
"""

from __future__ import annotations

import os
from typing import TypeVar

_T = TypeVar("_T")
_CHOSEN = os.environ.get("CAPTURE_SIM_CASES") or "few"


def all_cases() -> bool:
    """Return True where the tests try all their cases."""
    return _CHOSEN != "few"


def cases(few: _T, all: _T) -> _T:
    """Return a test's cases, or their number: `few` in `make test`, `all` in `make test-all`.

    The few must detect each fault of tests/faults that all of them detect.
    """
    if _CHOSEN == "few":
        return few
    if _CHOSEN == "all" or not isinstance(all, int):
        return all
    return int(_CHOSEN)
