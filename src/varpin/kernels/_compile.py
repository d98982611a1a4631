"""The decorator of every compiled kernel, and its disk cache.

numba stores compiled code beside the source and looks only at the file of the function itself to see whether
it is stale. A kernel that inlines a kernel of another file would then survive an edit of that file. Here the
cache is keyed on the contents of every kernel source together.
"""

import contextlib
import hashlib
import logging
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.event import Event, Listener, install_listener

logger = logging.getLogger(__name__)

_Function = TypeVar("_Function", bound=Callable[..., Any])


def sources_digest(folder: Path = Path(__file__).parent) -> str:
    """SHA-256 over the names and contents of all kernel sources in ``folder``."""
    digest = hashlib.sha256()
    for path in sorted(folder.glob("*.py")):
        digest.update(path.name.encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


_DIGEST = sources_digest()


class _StampedLocator:
    """A numba cache locator whose source stamp covers all kernel sources."""

    def __init__(self, locator: Any) -> None:
        self._locator = locator

    def __getattr__(self, name: str) -> Any:
        return getattr(self._locator, name)

    def get_source_stamp(self) -> str:
        return _DIGEST


class _KernelCacheImpl(CompileResultCacheImpl):
    @property
    def locator(self) -> _StampedLocator:
        return _StampedLocator(self._locator)


class _KernelCache(FunctionCache):
    _impl_class = _KernelCacheImpl


# No reference counting (_nrt): no kernel allocates, and counting references to the arrays of a scene takes longer
# than a sweep. Division by zero gives inf, which the callers test for (error_model).
_OPTIONS = {"error_model": "numpy", "nogil": True, "_nrt": False}


def inlined(function: _Function) -> _Function:
    """Compile ``function`` into its callers: what passing so many arrays to it costs would exceed its work."""
    return numba.njit(forceinline=True, **_OPTIONS)(function)


def kernel(function: _Function) -> _Function:
    """Compile ``function`` with numba (strict IEEE arithmetic, no GIL) and cache the result on disk."""
    dispatcher = numba.njit(**_OPTIONS)(function)
    if numba.config.DISABLE_JIT:
        return function
    # Without a writable place for the cache every process compiles anew.
    with contextlib.suppress(RuntimeError):
        dispatcher._cache = _KernelCache(dispatcher.py_func)
    return dispatcher


class _Announcer(Listener):
    """Says once that numba is compiling, and for what, so that the first call's delay does not look like a hang."""

    def __init__(self, feature: str) -> None:
        self._feature = feature
        self._said = False

    def on_start(self, event: Event) -> None:  # noqa: ARG002
        if not self._said:
            logger.warning(
                "compiling varpin's kernels for %s: up to half a minute, once on this machine for each feature",
                self._feature,
            )
            self._said = True

    def on_end(self, event: Event) -> None:
        pass


# Features use each other; the one that was called speaks for all of them.
_ANNOUNCED = ContextVar("_ANNOUNCED", default=False)


@contextlib.contextmanager
def announced_compilation(feature: str) -> Iterator[None]:
    """Within this context a compilation that the disk cache does not save is announced in the log, for ``feature``.

    Within another such context it does nothing.
    """
    if _ANNOUNCED.get():
        yield
        return
    token = _ANNOUNCED.set(True)
    try:
        with install_listener("numba:compile", _Announcer(feature)):
            yield
    finally:
        _ANNOUNCED.reset(token)
