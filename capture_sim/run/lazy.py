"""Values that are computed at their first use, e.g. series of a topic that is not yet decoded."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from functools import cached_property
from typing import Generic, TypeVar

T = TypeVar("T")


class Deferred(Generic[T]):
    """A value that ``make`` computes at its first use, and that is then stored."""

    def __init__(self, make: Callable[[], T]) -> None:
        self._make = make

    @cached_property
    def value(self) -> T:
        """The value; the first access computes it."""
        return self._make()


class LazyMapping(Mapping[str, T]):
    """Mapping that computes each value with a function of its own at the first access."""

    def __init__(self, makers: Mapping[str, Callable[[], T]]) -> None:
        self._values = {name: Deferred(make) for name, make in makers.items()}

    def without(self, names: Collection[str]) -> LazyMapping[T]:
        """Return a copy of the mapping without some names; this computes no value."""
        kept = LazyMapping[T]({})
        kept._values = {name: value for name, value in self._values.items() if name not in names}
        return kept

    def __getitem__(self, name: str) -> T:
        return self._values[name].value

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __contains__(self, name: object) -> bool:
        return name in self._values
