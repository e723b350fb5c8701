"""Results that depend on some fields of a scene, kept while these fields stay the same.

All scenes of a study (e.g. a sweep) share the fields that the study does not vary.  A function that
reads only such fields has the same result for all these scenes, and is therefore called once.
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

    The function is called again only if one of its ``fields`` is another object (by ``is``) than
    at the last call.  The function must read no other field, and callers must not change its
    result.
    """

    def __init__(self, function: Callable[[Scene], T], fields: tuple[str, ...]) -> None:
        update_wrapper(self, function)
        self.function, self.fields = function, fields
        self._read = attrgetter(*fields)
        self._last: tuple[object, T] | None = None

    def __call__(self, scene: Scene) -> T:
        """Return the function's result for a scene; the kept result if its fields are the same."""
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
    """Return a decorator that makes a function of a scene a :class:`CachedFunction`.

    ``fields`` are all fields of the scene that the function reads: parts (``"cone"``), or values
    (``"buffer.hinge_offset"``) in parts that no scene is without.
    """
    return lambda function: CachedFunction(function, fields)
