"""Weak references to functions that the compiled core calls.

Python's garbage collector does not see references held by the core. A user's function that refers to its scene would
form a cycle that is never collected: the scene refers to its core, and the core to the function.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any


class Weak:
    """Calls a function through a weak reference.

    Raises:
        ReferenceError: The function no longer exists.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = weakref.ref(function)

    def __call__(self, *args: Any) -> Any:
        """Call the function."""
        function = self._function()
        if function is None:
            raise ReferenceError("the scene that this function belongs to no longer exists")
        return function(*args)
