"""The ``varpin`` command as it is installed: a module of its own, since importing the package takes a second.

Ctrl-C in that second ends the process at once, without a traceback out of somebody's import.
"""

import signal
import sys


def main() -> int:
    """Run the command line of the process and return the exit status."""
    before = signal.getsignal(signal.SIGINT)
    if before is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from varpin.cli import main as run  # noqa: PLC0415 - this is what takes long

    signal.signal(signal.SIGINT, before)
    return run()


if __name__ == "__main__":
    sys.exit(main())
