"""Results that depend on some fields of a scene, kept while these fields stay the same.

The scenes of a study share every field that does not vary, so a rule on other fields that holds for
one of them holds for all, and is evaluated once.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import update_wrapper
from operator import attrgetter, is_
from typing import Generic, TypeVar

from capture_sim.scene.parts import Scene

T = TypeVar("T")


class CachedFunction(Generic[T]):
    """A function of a scene that keeps its last result.

    It is called again where one of its ``fields`` is another object.  The function must read no
    other field, and its result must not be changed.
    """

    def __init__(self, function: Callable[[Scene], T], fields: tuple[str, ...]) -> None:
        update_wrapper(self, function)
        self.function, self.fields = function, fields
        self._read = attrgetter(*fields)
        self._last: tuple[object, T] | None = None

    def __call__(self, scene: Scene) -> T:
        """Return the result of the function for a scene."""
        found, last = self._read(scene), self._last
        if last is None or not self._is_same(found, last[0]):
            # the objects are kept with the result, so that no other can take their place in memory
            last = self._last = found, self.function(scene)
        return last[1]

    def _is_same(self, found: object, earlier: object) -> bool:
        if len(self.fields) == 1:
            return found is earlier
        assert isinstance(found, tuple)
        assert isinstance(earlier, tuple)
        return all(map(is_, found, earlier))


def depends_on(*fields: str) -> Callable[[Callable[[Scene], T]], CachedFunction[T]]:
    """Return a decorator for a function of some fields of a scene; see :class:`CachedFunction`.

    ``fields`` are parts (``"cone"``) or values in parts that each scene has
    (``"buffer.hinge_offset"``).
    """
    return lambda function: CachedFunction(function, fields)
