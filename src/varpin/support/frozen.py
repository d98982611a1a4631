"""Frozen objects that pickle and deepcopy preserve exactly."""

from __future__ import annotations

from functools import cached_property
from types import MappingProxyType
from typing import Any, ClassVar, Self

import numpy as np


class Frozen:
    """Base of frozen dataclasses that are pickled and deep-copied.

    Pickle does not keep the read-only flag of arrays, and arrays with out-of-band buffers are restored read-only. This
    class restores the flag of attributes and of entries of tuples. Views of mappings, which cannot be pickled, are
    pickled as mappings. Cached properties are left out and computed again on use.
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
        own = vars(copy)
        # The frozen dataclass refuses assignments.
        own.update(vars(self))
        for name in self._cached:
            own.pop(name, None)
        own.update(values)
        return copy

    def __getstate__(self) -> dict[str, Any]:
        values = {name: value for name, value in vars(self).items() if name not in self._cached}
        views = {name: dict(value) for name, value in values.items() if isinstance(value, MappingProxyType)}
        return {
            "values": values | views,
            "views": tuple(views),
            "writable": {name: _writable(values[name]) for name in values},
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        values = {name: _restored(value, state["writable"][name]) for name, value in state["values"].items()}
        # The frozen dataclass refuses assignments.
        vars(self).update(values | {name: MappingProxyType(values[name]) for name in state["views"]})


def _writable(value: Any) -> Any:
    """Whether an array is writable; for a tuple or a view of a mapping, the same for each item."""
    if isinstance(value, np.ndarray):
        return bool(value.flags.writeable)
    if isinstance(value, MappingProxyType):
        return {name: _writable(item) for name, item in value.items()}
    return tuple(map(_writable, value)) if isinstance(value, tuple) else None


def _restored(value: Any, writable: Any) -> Any:
    if isinstance(value, np.ndarray):
        # A buffer of another owner may be read-only or unaligned.
        array = value if value.flags.owndata and value.flags.aligned else value.copy(order="K")
        array.setflags(write=writable)
        return array
    if isinstance(writable, dict):
        return {name: _restored(item, writable[name]) for name, item in value.items()}
    if isinstance(value, tuple):
        items = [_restored(*pair) for pair in zip(value, writable, strict=True)]
        return type(value)(*items) if hasattr(value, "_fields") else tuple(items)
    return value
