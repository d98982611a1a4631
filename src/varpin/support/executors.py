"""Tasks on an executor of :mod:`concurrent.futures`, with results in order."""

from __future__ import annotations

import contextlib
import itertools
import os
import pickle
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from typing import TypeVar

from varpin.errors import InputError, WorkersLost
from varpin.support.checks import count

Task = TypeVar("Task")
Result = TypeVar("Result")

# Most tasks that are submitted ahead of the awaited one: two for each of 128 workers; and the largest total size of
# their results [bytes].
_AHEAD, _BYTES_AHEAD = 256, 2**31


@contextlib.contextmanager
def executing(executor: Executor | None, workers: int | None) -> Iterator[Executor]:
    """The user's executor, which stays open, or ``workers`` threads; as many as there are cores if both are None."""
    if executor is None:
        threads = count("workers", (os.cpu_count() or 1) if workers is None else workers, least=1)
        with ThreadPoolExecutor(threads) as pool:
            yield pool
    elif workers is not None:
        raise InputError("give workers, a number of threads, or executor, which has workers of its own; not both")
    elif not isinstance(executor, Executor):
        wanted = "a concurrent.futures.Executor, for example a ProcessPoolExecutor or Dask's client.get_executor()"
        raise InputError(f"executor must be {wanted}, got {type(executor).__name__}")
    else:
        yield executor


def in_order(
    executor: Executor, function: Callable[[Task], Result], tasks: Iterable[Task], *, result_bytes: int = 0
) -> Generator[Result, None, None]:
    """Results of ``function`` for each task, in the order of the tasks.

    The tasks ahead of the awaited result are at most 256, with at most 2 GiB of results, but at least two. Close the
    iterator to cancel tasks that have not begun.
    """
    ahead = max(2, min(_AHEAD, _BYTES_AHEAD // max(1, result_bytes)))
    left, waiting = iter(tasks), deque[Future[Result]]()
    try:
        while True:
            for task in itertools.islice(left, ahead - len(waiting)):
                waiting.append(executor.submit(function, task))
            if not waiting:
                return
            try:
                result = waiting[0].result()
            except (pickle.PicklingError, AttributeError, TypeError) as error:
                if isinstance(executor, ThreadPoolExecutor) or not _unsendable(function, task):
                    raise
                raise InputError(
                    f"the tasks cannot be sent to the workers ({error!s:.80}): functions must be importable there, "
                    "defined at the top of a module"
                ) from error
            waiting.popleft()
            yield result
    except BrokenExecutor as error:
        raise WorkersLost(error) from error
    finally:
        for future in waiting:
            future.cancel()


def _unsendable(*parts: object) -> bool:
    """Whether something cannot be pickled."""
    try:
        pickle.dumps(parts)
    except Exception:
        return True
    return False


def take_all(results: Iterable[Result], take: Callable[[Result], None], tell: Callable[[], None]) -> None:
    """``take`` each result, wholly or not at all, and ``tell`` of it."""
    # Ctrl-C interrupts the main thread alone.
    with ThreadPoolExecutor(1) as taker:
        for result in results:
            taker.submit(take, result).result()
            tell()
