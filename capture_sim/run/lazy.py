"""Values that are made at their first use, e.g. of a topic that is not yet decoded."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from functools import cached_property
from typing import Generic, TypeVar

T = TypeVar("T")


class Deferred(Generic[T]):
    """A value that is made at its first use."""

    def __init__(self, make: Callable[[], T]) -> None:
        self._make = make

    @cached_property
    def value(self) -> T:
        """The value."""
        return self._make()


class LazyMapping(Mapping[str, T]):
    """A mapping whose values are made at their first use."""

    def __init__(self, makers: Mapping[str, Callable[[], T]]) -> None:
        self._values = {name: Deferred(make) for name, make in makers.items()}

    def without(self, names: Collection[str]) -> LazyMapping[T]:
        """Return the mapping without some names; no value is made for it."""
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
