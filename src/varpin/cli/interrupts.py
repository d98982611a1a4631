"""Ctrl-C: the first is answered at once, the second does not take away what is being kept, the third ends it all."""

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
_KEEPING = "Ctrl-C: stopping; what is done is kept"
_WAIT = "Ctrl-C again: what is done is being kept, which takes a moment; a third one ends without it"
_ENDING = "Ctrl-C a third time: ending"


class Interrupts:
    """Handles SIGINT within a ``with`` block, if that is in the main thread.

    Python runs a handler between two of its own instructions, and the core may run for seconds; so a thread says what
    is going to happen, and the handler makes it happen. Outside :meth:`keeping` every Ctrl-C raises KeyboardInterrupt.
    Within it the first does, unless files are being :meth:`written`; the second only asks to finish, and the third
    raises again.

    Attributes:
        wanted: Whether to finish what is being written, and to leave out the rest.
        ended: Whether to write nothing more.
    """

    def __init__(self, console: Console) -> None:
        self.wanted = self.ended = False
        self._console = console
        self._keeping = self._writing = False
        self._heard = self._handled = 0
        self._raised = False
        self._undo = contextlib.ExitStack()

    def __enter__(self) -> Interrupts:
        ours = threading.current_thread() is threading.main_thread()
        if ours and signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
            self._listen()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._undo.close()

    @contextlib.contextmanager
    def keeping(self) -> Iterator[None]:
        """What is computed in this block is kept if it is interrupted."""
        self._keeping = True
        try:
            yield
        finally:
            self._keeping = False

    @contextlib.contextmanager
    def written(self) -> Iterator[None]:
        """A file is written in this block, within :meth:`keeping`."""
        self._writing = True
        try:
            yield
        finally:
            self._writing = False

    def _listen(self) -> None:
        ear, mouth = os.pipe()
        os.set_blocking(mouth, False)
        thread = threading.Thread(target=self._answer, args=(ear,), daemon=True)
        thread.start()
        self._undo.callback(os.close, ear)
        self._undo.callback(thread.join)
        self._undo.callback(os.close, mouth)
        before = signal.set_wakeup_fd(mouth, warn_on_full_buffer=False)
        self._undo.callback(signal.set_wakeup_fd, before)
        self._undo.callback(signal.signal, signal.SIGINT, signal.signal(signal.SIGINT, self._handle))

    def _answer(self, ear: int) -> None:
        """Answer each SIGINT as soon as it comes, whatever the main thread is busy with."""
        while number := os.read(ear, 1):
            if number[0] == signal.SIGINT:
                self._heard += 1
                answer = _STOPPING
                if self._keeping:
                    answer = {1: _KEEPING, 2: _WAIT}.get(self._heard, _ENDING)
                say(self._console, answer)

    def _handle(self, _number: int, _frame: FrameType | None) -> None:
        # Several within one call of the core come as one.
        self._handled = max(self._handled + 1, self._heard)
        if self._keeping:
            self.ended = self._handled > 2
            self.wanted = self.ended or self._handled == 2 or self._writing
            if not self.ended and (self._raised or self._writing):
                return
            self._raised = True
        raise KeyboardInterrupt
