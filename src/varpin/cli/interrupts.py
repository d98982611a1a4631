"""Ctrl-C: the first stops the run and keeps its results, the second ends the process."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType

from rich.console import Console

from varpin.cli.console import INTERRUPTED, say


class Interrupts(contextlib.ExitStack):
    """Handler of SIGINT within a ``with`` block in the main thread.

    Python calls a signal handler between two of its instructions, and a call of the core may last for seconds. A thread
    therefore answers at once, and ends the process at the second Ctrl-C. The first raises KeyboardInterrupt, but for
    one while a file is being :meth:`written`, which sets ``wanted``.

    Attributes:
        wanted: Whether to finish the current file and write no other.
    """

    def __init__(self, console: Console) -> None:
        super().__init__()
        self.wanted = False
        self._console = console
        self._keeping = self._writing = False

    def __enter__(self) -> Interrupts:
        main = threading.current_thread() is threading.main_thread()
        if main and signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
            reader, writer = os.pipe()
            os.set_blocking(writer, False)
            thread = threading.Thread(target=self._answer, args=(reader,), daemon=True)
            thread.start()
            self.callback(os.close, reader)
            self.callback(thread.join)
            self.callback(os.close, writer)
            self.callback(signal.set_wakeup_fd, signal.set_wakeup_fd(writer, warn_on_full_buffer=False))
            self.callback(signal.signal, signal.SIGINT, signal.signal(signal.SIGINT, self._handle))
        return self

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
        self._writing = True
        try:
            yield
        finally:
            self._writing = False

    def _answer(self, reader: int) -> None:
        """Answer each SIGINT at once, even while the main thread is in the core."""
        received = 0
        while number := os.read(reader, 1):
            if number[0] != signal.SIGINT:
                continue
            received += 1
            if received == 1:
                kept = "; what is done is kept, and a second one ends without it" if self._keeping else ""
                say(self._console, f"Ctrl-C: stopping{kept}")
            else:
                # A progress bar hides the cursor.
                self._console.show_cursor()
                os._exit(INTERRUPTED)

    def _handle(self, _number: int, _frame: FrameType | None) -> None:
        if not self._writing:
            raise KeyboardInterrupt
        self.wanted = True
