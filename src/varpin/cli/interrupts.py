"""Ctrl-C: the first stops the run and keeps its results, the second ends the process."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType

from rich.console import Console


class Interrupts(contextlib.ExitStack):
    """Handler of SIGINT within a ``with`` block in the main thread.

    The first Ctrl-C raises KeyboardInterrupt, but for one while a file is being :meth:`written`, which sets ``wanted``.
    The second is left to the system, which ends the process. Calls of the core last for tenths of a second at most.

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

    def _handle(self, _number: int, _frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        # A progress bar hides the cursor.
        cursor = "\x1b[?25h" if self._console.is_terminal else ""
        kept = "; what is done is kept, and a second one ends without it" if self._keeping else ""
        # Not by the console, which may be writing.
        os.write(2, f"{cursor}varpin: Ctrl-C: stopping{kept}\n".encode())
        if not self._writing:
            raise KeyboardInterrupt
        self.wanted = True
