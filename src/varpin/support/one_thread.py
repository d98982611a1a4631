"""One thread of linear algebra while something runs whose threads would only wait for each other."""

from __future__ import annotations

import contextlib
import functools
import threading
from contextlib import ContextDecorator

from threadpoolctl import ThreadpoolController


class OneThread(ContextDecorator):
    """Limits the process' linear algebra to one thread, from the first that enters to the last that leaves.

    The number of threads belongs to the process: whoever restored it alone would change it for the others. A second
    thread saves a search within constraints a tenth of its time. But threads that wait for each other spin: of two such
    searches at a time on two cores, each would take ten times as long.
    """

    def __init__(self) -> None:
        self._lock, self._users = threading.Lock(), 0
        # To find the libraries takes as long as a small search.
        self._pools = ThreadpoolController()
        self._limit = contextlib.ExitStack()

    def __enter__(self) -> None:
        with self._lock:
            if self._users == 0:
                self._limit.enter_context(self._pools.limit(limits=1, user_api="blas"))
            self._users += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._users -= 1
            if self._users == 0:
                self._limit.close()


# The limit of this process.
one_thread = functools.cache(OneThread)
