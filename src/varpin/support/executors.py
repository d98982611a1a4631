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

from varpin.errors import InputError, VarpinError
from varpin.support.checks import count

Task = TypeVar("Task")
Result = TypeVar("Result")

logger = logging.getLogger(__name__)

# Tasks that wait or run for each worker; in all, where an executor does not say how many it has; and the bytes that
# their results may take in all.
_AHEAD, _AHEAD_OF_ANY, _BYTES_AHEAD = 4, 1024, 2**31
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
        ) as pool:
            yield pool
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
    executor: Executor, function: Callable[[Task], Result], tasks: Iterable[Task], *, result_bytes: int = 0
) -> Generator[Result, None, None]:
    """``function`` of each task, in their order.

    A task whose worker is lost is done again, in a pool that has broken by a new one like it. Few tasks are ahead of
    the result that is waited for, so that results do not pile up: four for each worker, and so many that their results
    take 2 GiB, but two at least. Close the iterator to call off what has not begun.

    Args:
        executor: Where ``function`` is called.
        function: Of a task.
        tasks: Asked for one by one.
        result_bytes: What a result takes [bytes].

    Raises:
        VarpinError: Workers get lost again and again.
        Exception: Whatever ``function`` raises.
    """
    work: _Guarded[Task, Result] = _Guarded(function)
    current: Executor | None = None
    waiting: deque[tuple[Task, Future[Result | _Raised]]] = deque()
    left, losses = iter(tasks), 0

    def submitted(task: Task) -> Future[Result | _Raised]:
        while True:
            try:
                return executor.submit(work, task)
            except BrokenExecutor as error:
                renew(error)

    def renew(error: BrokenExecutor) -> None:
        """Go on in a new pool with all that the broken one has not done."""
        nonlocal executor, current, losses
        executor, losses = _renewed(executor, error), _counted(losses, error)
        if current is not None:
            current.shutdown(wait=False, cancel_futures=True)
        current = executor
        try:
            for index, (task, future) in enumerate(waiting):
                if not future.done() or future.cancelled() or future.exception() is not None:
                    waiting[index] = task, executor.submit(work, task)
        except BrokenExecutor as again:
            renew(again)

    try:
        while True:
            ahead = _ahead(executor, result_bytes)
            while len(waiting) < ahead:
                try:
                    task = next(left)
                except StopIteration:
                    break
                waiting.append((task, submitted(task)))
            if not waiting:
                return
            task, future = waiting[0]
            try:
                result = future.result()
            except (pickle.PicklingError, AttributeError, TypeError) as error:
                raise InputError(
                    f"what the workers need cannot be sent to them: {error}; functions must be importable there, "
                    "defined at the top of a module and not in index"
                ) from error
            except BrokenExecutor as error:
                renew(error)
                continue
            except Exception as error:
                losses = _counted(losses, error)
                waiting[0] = task, submitted(task)
                continue
            waiting.popleft()
            losses = 0
            if isinstance(result, _Raised):
                raise result.error
            yield result
    finally:
        for _, future in waiting:
            future.cancel()
        if current is not None:
            current.shutdown(wait=False, cancel_futures=True)


def _counted(losses: int, error: Exception) -> int:
    """The losses without a result between them, this one among them.

    Raises:
        VarpinError: They are too many for an accident.
    """
    if losses == _LOSSES:
        raise VarpinError(f"workers get lost again and again, at last by {error!r}") from error
    logger.warning("a worker was lost (%r); its work is done again", error)
    return losses + 1


def _workers(executor: Executor) -> int | None:
    """How many it has now, if it says."""
    workers = getattr(executor, "_max_workers", None) or getattr(executor, "num_workers", None)
    client = getattr(executor, "_client", None)
    if client is not None and hasattr(client, "ncores"):
        # Dask's, whose workers come and go, with so many threads each.
        workers = sum(client.ncores().values())
    return workers if isinstance(workers, int) and workers > 0 else None


def _ahead(executor: Executor, result_bytes: int) -> int:
    """How many tasks may be ahead of the result that is waited for."""
    workers = _workers(executor)
    most = _AHEAD_OF_ANY if workers is None else _AHEAD * workers
    return max(2, min(most, _BYTES_AHEAD // max(1, result_bytes)))


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
        max_tasks_per_child=getattr(executor, "_max_tasks_per_child", None),
    )
