"""Ctrl-C: the first stops the run and keeps its results, the second ends all."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType, TracebackType

from rich.console import Console

from varpin.cli.console import say

_STOPPING = "Ctrl-C: stopping"
_KEEPING = "Ctrl-C: stopping; what is done is kept, and a second one ends without it"
_ENDING = "Ctrl-C again: ending"


class Interrupts:
    """Handler of SIGINT within a ``with`` block in the main thread.

    Python calls a signal handler between two of its instructions, and a call of the core may last for seconds. A thread
    therefore prints an answer at once; the handler acts later. Every Ctrl-C raises KeyboardInterrupt, but for a first
    one while a file is being :meth:`written`, which sets ``wanted``.

    Attributes:
        wanted: Whether to finish the current file and write no other.
    """

    def __init__(self, console: Console) -> None:
        self.wanted = False
        self._console = console
        self._keeping = self._writing = False
        self._received = self._handled = 0
        self._undo = contextlib.ExitStack()

    def __enter__(self) -> Interrupts:
        main = threading.current_thread() is threading.main_thread()
        if main and signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
            reader, writer = os.pipe()
            os.set_blocking(writer, False)
            thread = threading.Thread(target=self._answer, args=(reader,), daemon=True)
            thread.start()
            self._undo.callback(os.close, reader)
            self._undo.callback(thread.join)
            self._undo.callback(os.close, writer)
            self._undo.callback(signal.set_wakeup_fd, signal.set_wakeup_fd(writer, warn_on_full_buffer=False))
            self._undo.callback(signal.signal, signal.SIGINT, signal.signal(signal.SIGINT, self._handle))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._undo.close()

    @contextlib.contextmanager
    def keeping(self) -> Iterator[None]:
        """A block whose results are kept if it is interrupted."""
        self._keeping = True
        try:
            yield
        finally:
            self._keeping = False

    @contextlib.contextmanager
    def written(self) -> Iterator[None]:
        """A block within :meth:`keeping` that writes one file."""
        # Python handles several signals within one call of the core as one.
        if self._received > max(1, self._handled):
            raise KeyboardInterrupt
        self._writing = True
        try:
            yield
        finally:
            self._writing = False

    def _answer(self, reader: int) -> None:
        """Print an answer to each SIGINT at once, even while the main thread is in the core."""
        while number := os.read(reader, 1):
            if number[0] == signal.SIGINT:
                self._received += 1
                first = _KEEPING if self._keeping else _STOPPING
                say(self._console, first if self._received == 1 else _ENDING)

    def _handle(self, _number: int, _frame: FrameType | None) -> None:
        self._handled += 1
        if self._writing and self._handled == 1:
            self.wanted = True
        else:
            raise KeyboardInterrupt
