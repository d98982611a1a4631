"""Ctrl-C in a process of its own: answered at once, and what is being written is written."""

import os
import signal
import subprocess
import sys
import time

import pytest

import varpin as vp
from varpin.cli import main

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")

# The command as installed, with a run that says where it is, and writers that take their time and do, too.
SLOW = """
import sys, time
import varpin as vp
import varpin.cli.outputs, varpin.cli.runs
from varpin.cli import main

def slow_simulate(*arguments, progress, **options):
    def slow(done, steps):
        progress(done, steps)
        print("RUNNING", file=sys.stderr, flush=True)
    return vp.simulate(*arguments, progress=slow, **options)

def saving(self, path, write=vp.Trajectory.save):
    print("WRITING", file=sys.stderr, flush=True)
    end = time.monotonic() + SAVE
    while time.monotonic() < end:
        time.sleep(0.01)
    return write(self, path)

varpin.cli.runs.simulate = slow_simulate
vp.Trajectory.save = saving
sys.exit(main(sys.argv[1:]))
"""


class Command:
    """``varpin`` in a process, and its lines on stderr with the times at which they came."""

    def __init__(self, *words, save=0.0, code=SLOW):
        code = code.replace("SAVE\n", f"{save}\n")
        self.process = subprocess.Popen(
            [sys.executable, "-c", code, *words],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            # Whoever started the tests may ignore Ctrl-C, as shells do for jobs in the background.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),  # noqa: PLW1509
        )
        self.lines = []

    def wait_for(self, words):
        for line in self.process.stderr:
            self.lines.append(line.strip())
            if words in line:
                return time.monotonic()
        raise AssertionError(f"{words!r} is not in {self.lines}")

    def interrupt(self):
        self.process.send_signal(signal.SIGINT)
        return time.monotonic()

    def end(self):
        self.lines += [line.strip() for line in self.process.stderr]
        return self.process.wait(timeout=60)


LONG = ("simulate", "finger", "--no-gravity", "--v0", "0.1", "--dt", "1e-4", "--steps", "300000")
SHORT = ("simulate", "finger", "--no-gravity", "--v0", "0.1", "--steps", "10")


def test_the_first_is_answered_at_once_and_keeps_the_run(tmp_path):
    """Calls of the core, in which no Python handler runs, are short."""
    path = tmp_path / "a.npz"
    command = Command(*LONG, "--save", str(path))
    command.wait_for("RUNNING")
    asked = command.interrupt()
    assert command.wait_for("Ctrl-C: stopping; what is done is kept") - asked < 1.0
    assert command.end() == 130
    kept = vp.Trajectory.load(path)
    assert 0 < kept.steps < 300000
    assert f"varpin: interrupted after {kept.steps} steps, which are kept" in command.lines


def test_the_first_while_writing_finishes_the_file(tmp_path):
    path, figure = tmp_path / "a.npz", tmp_path / "a.png"
    command = Command(*SHORT, "--save", str(path), "--plot", str(figure), save=1.0)
    command.wait_for("WRITING")
    command.interrupt()
    assert command.end() == 130
    assert vp.Trajectory.load(path).steps == 10
    assert not figure.exists()


def test_the_second_ends_the_process(tmp_path):
    path = tmp_path / "a.npz"
    command = Command(*LONG, "--save", str(path), save=60.0)
    command.wait_for("RUNNING")
    command.interrupt()
    command.wait_for("WRITING")
    asked = command.interrupt()
    assert command.end() == -signal.SIGINT  # which shells call 130
    assert time.monotonic() - asked < 10.0
    assert not path.exists()
    assert not any("Traceback" in line for line in command.lines)


LOADING = """
import sys, time
import varpin.cli.runs
from varpin.cli import main

def loading(*_, **__):
    print("LOADING", file=sys.stderr, flush=True)
    time.sleep(60)

varpin.cli.runs.motion_of = loading
sys.exit(main(sys.argv[1:]))
"""


def test_before_a_run_it_only_stops():
    command = Command(*SHORT, code=LOADING)
    command.wait_for("LOADING")
    command.interrupt()
    assert command.end() == 130
    assert command.lines[1:] == ["varpin: Ctrl-C: stopping", "varpin: interrupted"]


def test_the_handler_is_as_it_was_after_the_command():
    before = signal.getsignal(signal.SIGINT)
    assert main(["inspect", "finger"]) == 0
    assert signal.getsignal(signal.SIGINT) is before
