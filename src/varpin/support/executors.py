"""Tasks on an executor of :mod:`concurrent.futures`: results in order, and lost tasks repeated."""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from typing import Generic, TypeVar

from varpin.errors import InputError, VarpinError
from varpin.support.checks import count

Task = TypeVar("Task")
Result = TypeVar("Result")

logger = logging.getLogger(__name__)

# Largest number of tasks submitted ahead: for each worker, and in all where the number of workers is unknown; and the
# largest total size of their results [bytes].
_AHEAD, _AHEAD_OF_ANY, _BYTES_AHEAD = 4, 1024, 2**31
# Number of successive lost workers, without a result in between, that are tolerated.
_LOSSES = 3


@contextlib.contextmanager
def executing(executor: Executor | None, workers: int | None) -> Iterator[Executor]:
    """The user's executor, which stays open, or ``workers`` threads; as many as there are cores if both are None.

    Raises:
        InputError: Both are given, or one is invalid.
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
    """``executor`` itself; raises an InputError with its type if it is not an Executor."""
    if not isinstance(executor, Executor):
        raise InputError(
            "executor must be a concurrent.futures.Executor, for example a ProcessPoolExecutor or Dask's "
            f"client.get_executor(), got {type(executor).__name__}"
        )
    return executor


def in_process(executor: Executor) -> bool:
    """Whether the workers of an executor run in this process."""
    return isinstance(executor, ThreadPoolExecutor)


class _Raised:
    """An exception of a task, as distinct from the loss of its worker."""

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
                # An error that cannot be pickled would break the pool.
                return _Raised(VarpinError(f"{type(error).__name__}: {error}"))
            return _Raised(error)


def in_order(
    executor: Executor, function: Callable[[Task], Result], tasks: Iterable[Task], *, result_bytes: int = 0
) -> Generator[Result, None, None]:
    """Results of ``function`` for each task, in the order of the tasks.

    A task whose worker is lost is repeated; a broken pool is replaced by a new one. The number of tasks ahead of
    the awaited result is limited, so that results do not accumulate: four for each worker and 2 GiB of results, but at
    least two. Close the iterator to cancel tasks that have not begun. After Ctrl-C, or a KeyboardInterrupt thrown
    into the iterator, results go on up to the first task that is neither done nor begun in a thread of this process;
    then the KeyboardInterrupt is raised.

    Args:
        executor: The executor.
        function: Function of a task.
        tasks: The tasks, which are consumed one by one.
        result_bytes: Size of a result [bytes].

    Raises:
        VarpinError: Workers are lost repeatedly.
        Exception: ``function`` raised it.
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
        """Resubmit the tasks that the broken pool has not finished to a new pool."""
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
                    f"the tasks cannot be sent to the workers: {error}; functions must be importable there, "
                    "defined at the top of a module and not in index"
                ) from error
            except BrokenExecutor as error:
                renew(error)
                continue
            except Exception as error:
                losses = _counted(losses, error)
                waiting[0] = task, submitted(task)
                continue
            losses = 0
            try:
                if isinstance(result, _Raised):
                    raise result.error
                yield result
            finally:
                waiting.popleft()
    except KeyboardInterrupt:
        yield from _begun(executor, [future for _, future in waiting])
        raise
    finally:
        for _, future in waiting:
            future.cancel()
        if current is not None:
            # Without tasks left, waiting is short. Without waiting, Python 3.11 may replace a worker that has done its
            # max_tasks_per_child after the shutdown of its pool, and then hangs at exit.
            current.shutdown(wait=not waiting, cancel_futures=True)


def _begun(executor: Executor, futures: Sequence[Future[Result | _Raised]]) -> Iterator[Result]:
    """Results of the first tasks: of those that are done, and of those that threads of this process are doing."""
    # From the last to the first, lest a worker takes one with a gap before it.
    for future in reversed(futures):
        future.cancel()
    for future in futures:
        # Other workers get Ctrl-C themselves, or are too far away to wait for.
        if future.cancelled() or not (future.done() or in_process(executor)):
            return
        try:
            result = future.result()
        except Exception:
            return
        if isinstance(result, _Raised):
            return
        yield result


def take_all(results: Generator[Result, None, None], take: Callable[[Result], None], tell: Callable[[], None]) -> None:
    """``take`` each result of :func:`in_order`, and ``tell`` of it; after Ctrl-C also those of tasks that have begun.

    Raises:
        KeyboardInterrupt: Ctrl-C.
    """
    # Ctrl-C interrupts the main thread alone: in another one each result is taken wholly or not at all.
    with ThreadPoolExecutor(1) as taker:
        try:
            for result in results:
                taker.submit(take, result).result()
                tell()
        except KeyboardInterrupt as interrupt:
            result = results.throw(interrupt)
            while True:
                taker.submit(take, result).result()
                result = next(results)


def _counted(losses: int, error: Exception) -> int:
    """The number of successive losses, including this one.

    Raises:
        VarpinError: There are more than ``_LOSSES``.
    """
    if losses == _LOSSES:
        raise VarpinError(f"workers get lost again and again, at last by {error!r}") from error
    logger.warning("a worker was lost (%r); its work is done again", error)
    return losses + 1


def _workers(executor: Executor) -> int | None:
    """The number of workers of an executor; None if it is unknown."""
    workers = getattr(executor, "_max_workers", None) or getattr(executor, "num_workers", None)
    client = getattr(executor, "_client", None)
    if client is not None and hasattr(client, "ncores"):
        # Dask: the number of threads of all workers, which may change.
        workers = sum(client.ncores().values())
    return workers if isinstance(workers, int) and workers > 0 else None


def _ahead(executor: Executor, result_bytes: int) -> int:
    """How many tasks may be submitted ahead of the awaited result."""
    workers = _workers(executor)
    most = _AHEAD_OF_ANY if workers is None else _AHEAD * workers
    return max(2, min(most, _BYTES_AHEAD // max(1, result_bytes)))


def _renewed(executor: Executor, error: BrokenExecutor) -> Executor:
    """A new pool like one that has broken.

    Raises:
        VarpinError: It is not a ProcessPoolExecutor.
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
