"""Functions that the compiled core calls and does not own.

What the core keeps is out of sight of Python's garbage collector. A user's function that knows its scene would keep the
scene, the scene its core, and the core the function, for good.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any


class Weak:
    """Calls a function that somebody else keeps.

    Raises:
        ReferenceError: Nobody does any more.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = weakref.ref(function)

    def __call__(self, *args: Any) -> Any:
        """What the function returns."""
        function = self._function()
        if function is None:
            raise ReferenceError("the scene that this function belongs to is gone")
        return function(*args)
