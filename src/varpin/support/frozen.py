"""Frozen objects that can be pickled and deep-copied."""

from __future__ import annotations

from functools import cached_property
from types import MappingProxyType
from typing import Any, ClassVar, Self

import numpy as np


class _View(dict[str, Any]):
    """A view of a mapping, which Python does not pickle, on its way."""


class Frozen:
    """Base of frozen dataclasses that are pickled and deep-copied.

    Arrays of a copy, also those in tuples and views of mappings, are read-only. Cached properties are left out and
    computed again on use.
    """

    _cached: ClassVar[frozenset[str]] = frozenset()  # names of the cached properties

    def __init_subclass__(cls, **options: Any) -> None:
        """Collect the names of the cached properties."""
        super().__init_subclass__(**options)
        own = (name for name, value in vars(cls).items() if isinstance(value, cached_property))
        cls._cached = cls._cached.union(own)

    def changed(self, **values: Any) -> Self:
        """A copy with other values of attributes, which are not checked; cached properties are computed anew."""
        copy = object.__new__(type(self))
        # The frozen dataclass refuses assignments.
        vars(copy).update(self._kept() | values)
        return copy

    def __copy__(self) -> Self:
        return self.changed()

    def _kept(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in self._cached}

    def __getstate__(self) -> dict[str, Any]:
        kept = self._kept().items()
        return {name: _View(value) if isinstance(value, MappingProxyType) else value for name, value in kept}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update({name: _read_only(value) for name, value in state.items()})


def _read_only(value: Any) -> Any:
    """An array, or those of a tuple or a view of a mapping, read-only, and the view as it was."""
    if isinstance(value, np.ndarray):
        # A buffer of another owner may be unaligned.
        array = value if value.flags.owndata and value.flags.aligned else value.copy(order="K")
        array.setflags(write=False)
        return array
    if isinstance(value, _View):
        return MappingProxyType({name: _read_only(item) for name, item in value.items()})
    if isinstance(value, tuple):
        items = map(_read_only, value)
        return type(value)(*items) if hasattr(value, "_fields") else tuple(items)
    return value
