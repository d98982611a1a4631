"""Work that is handed to an executor of :mod:`concurrent.futures`: results in order, and what gets lost again."""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from typing import Generic, TypeVar

from varpin.checks import count
from varpin.errors import InputError, VarpinError

Task = TypeVar("Task")
Result = TypeVar("Result")

logger = logging.getLogger(__name__)

# Tasks that wait or run for each worker; and in all, where an executor does not say how many it has.
_AHEAD, _AHEAD_OF_ANY = 4, 1024
# Losses without a result between them after which it is no accident.
_LOSSES = 3


@contextlib.contextmanager
def executing(executor: Executor | None, workers: int | None) -> Iterator[Executor]:
    """The user's executor, which stays open; or so many threads, as many as there are cores if neither is given.

    Raises:
        InputError: Both are given, or one is no such thing.
    """
    if executor is None:
        with ThreadPoolExecutor(
            count("workers", (os.cpu_count() or 1) if workers is None else workers, least=1)
        ) as own:
            yield own
        return
    if workers is not None:
        raise InputError("give workers, a number of threads, or executor, which has workers of its own; not both")
    yield require_executor(executor)


def require_executor(executor: object) -> Executor:
    """``executor`` itself, or an InputError that says what it is instead."""
    if not isinstance(executor, Executor):
        raise InputError(
            "executor must be a concurrent.futures.Executor, for example a ProcessPoolExecutor or Dask's "
            f"client.get_executor(), got {type(executor).__name__}"
        )
    return executor


def in_process(executor: Executor) -> bool:
    """Whether its workers share this process."""
    return isinstance(executor, ThreadPoolExecutor)


class _Raised:
    """What a task raised by itself, told apart from what befell its worker."""

    def __init__(self, error: Exception) -> None:
        self.error = error


class _Guarded(Generic[Task, Result]):
    def __init__(self, function: Callable[[Task], Result]) -> None:
        self.function = function

    def __call__(self, task: Task) -> Result | _Raised:
        try:
            return self.function(task)
        except Exception as error:
            try:
                pickle.loads(pickle.dumps(error))
            except Exception:
                # On the way back it would break the pool.
                return _Raised(VarpinError(f"{type(error).__name__}: {error}"))
            return _Raised(error)


def in_order(
    executor: Executor, function: Callable[[Task], Result], tasks: Iterable[Task]
) -> Generator[Result, None, None]:
    """``function`` of each task, in their order.

    A task whose worker is lost is done again, in a pool that has broken by a new one like it. Few tasks are ahead of
    the result that is waited for, so that results do not pile up. Close the iterator to call off what has not begun.

    Raises:
        VarpinError: Workers get lost again and again.
        Exception: Whatever ``function`` raises.
    """
    work: _Guarded[Task, Result] = _Guarded(function)
    own: Executor | None = None
    waiting: deque[tuple[Task, Future[Result | _Raised]]] = deque()
    ahead, left, losses = _ahead(executor), iter(tasks), 0

    def submitted(task: Task) -> Future[Result | _Raised]:
        nonlocal executor, own
        try:
            return executor.submit(work, task)
        except BrokenExecutor as error:
            executor = _renewed(executor, error)
            if own is not None:
                own.shutdown(wait=False, cancel_futures=True)
            own = executor
            return executor.submit(work, task)

    try:
        while True:
            while len(waiting) < ahead:
                try:
                    task = next(left)
                except StopIteration:
                    break
                waiting.append((task, submitted(task)))
            if not waiting:
                return
            task, future = waiting.popleft()
            try:
                result = future.result()
            except (pickle.PicklingError, AttributeError, TypeError) as error:
                raise InputError(
                    f"what the workers need cannot be sent to them: {error}; functions must be importable there, "
                    "defined at the top of a module and not in place"
                ) from error
            except Exception as error:
                losses += 1
                if losses > _LOSSES:
                    raise VarpinError(f"workers get lost again and again, at last by {error!r}") from error
                logger.warning("a worker was lost (%r); its work is done again", error)
                waiting.appendleft((task, submitted(task)))
                continue
            losses = 0
            if isinstance(result, _Raised):
                raise result.error
            yield result
    finally:
        for _, future in waiting:
            future.cancel()
        if own is not None:
            own.shutdown(wait=False, cancel_futures=True)


def _workers(executor: Executor) -> int | None:
    """How many it has, if it says."""
    workers = getattr(executor, "_max_workers", None) or getattr(executor, "num_workers", None)
    return workers if isinstance(workers, int) else None


def _ahead(executor: Executor) -> int:
    workers = _workers(executor)
    return _AHEAD_OF_ANY if workers is None else _AHEAD * workers


def _renewed(executor: Executor, error: BrokenExecutor) -> Executor:
    """A pool like one that has broken.

    Raises:
        VarpinError: It is of a kind that only its owner can make.
    """
    if not isinstance(executor, ProcessPoolExecutor):
        raise VarpinError(f"the executor has broken, and only a ProcessPoolExecutor is made anew: {error}") from error
    return ProcessPoolExecutor(
        _workers(executor),
        executor._mp_context,
        initializer=executor._initializer,
        initargs=executor._initargs,
    )
