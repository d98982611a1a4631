"""Output of the commands on the console: progress, the log and errors."""

from __future__ import annotations

import argparse
import contextlib
import logging
import re
import time
from collections.abc import Callable, Iterator
from typing import Any, NoReturn

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

# Exit statuses other than 0.
FAULTY, MISTAKE, STEP_FAILED, INTERRUPTED = 1, 2, 3, 130
# Shortest time between two lines of progress where there is no terminal [s].
INTERVAL = 10.0


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, without a list of options, and which knows numbers such as -1e-3."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._negative_number_matcher = re.compile(r"-(\d|\.\d|inf|nan)")

    def error(self, message: str) -> NoReturn:
        """Print the error and a hint at --help; exit with status 2."""
        self.exit(MISTAKE, f"{self.prog}: error: {message} (see {self.prog} --help)\n")


@contextlib.contextmanager
def progress_bar(
    console: Console, steps: int, *, quiet: bool, unit: str = "steps"
) -> Iterator[Callable[[int, int], None]]:
    """A progress callback that draws a bar on a terminal, prints a line now and then elsewhere, or is ``quiet``."""
    if quiet:
        yield lambda _done, _steps: None
    elif console.is_terminal:
        columns = (TextColumn("varpin"), BarColumn(), TextColumn(f"{{task.completed}}/{{task.total}} {unit}"))
        with Progress(*columns, TimeRemainingColumn(), console=console, transient=True) as bar:
            task = bar.add_task("", total=steps)
            yield lambda done, steps: bar.update(task, completed=done, total=steps)
    else:
        printed = time.monotonic()

        def tell(done: int, steps: int) -> None:
            nonlocal printed
            if time.monotonic() - printed >= INTERVAL:
                printed = time.monotonic()
                say(console, f"{done} of {steps} {unit}")

        yield tell


class _ConsoleHandler(logging.Handler):
    """Log records as one readable line each, above a progress bar if there is one."""

    def __init__(self, console: Console, level: int) -> None:
        super().__init__(level)
        self._console = console

    def emit(self, record: logging.LogRecord) -> None:
        say(self._console, record.getMessage(), prefix=f"varpin: {record.levelname.lower()}", style="yellow")


@contextlib.contextmanager
def logged(console: Console, level: int) -> Iterator[None]:
    """Print the library's log from ``level`` on to ``console`` within this context."""
    logger, handler = logging.getLogger("varpin"), _ConsoleHandler(console, level)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def complain(console: Console, error: object) -> None:
    """Print an error as one line."""
    # NumPy breaks lines in long arrays.
    say(console, " ".join(str(error).split()), prefix="varpin: error", style="red")


def say(console: Console, message: str, *, prefix: str = "varpin", style: str | None = None) -> None:
    """Print a message as it is, after a prefix."""
    text = f"{prefix}: {message}" if prefix else message
    console.print(text, style=style, markup=False, emoji=False, highlight=False, soft_wrap=True)


def show(content: object) -> None:
    """Print a table or a text as the result of a command."""
    say(Console(), str(content), prefix="")
