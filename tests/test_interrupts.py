"""Ctrl-C in a process of its own: answered at once, and what is being written is written."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

import varpin as vp
from varpin.cli import main

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")

# The command as installed, with a run and writers that take their time and say where they are. PBKDF2 keeps the main
# thread in C without the GIL, as the core does, where no Python handler runs.
SLOW = """
import hashlib, sys, time
import varpin as vp
import varpin.cli.outputs, varpin.cli.runs
from varpin.cli import main

begin = time.perf_counter()
hashlib.pbkdf2_hmac("sha256", b"a", b"b", 100_000)
rate = 100_000 / (time.perf_counter() - begin)

def busy(seconds):
    hashlib.pbkdf2_hmac("sha256", b"a", b"b", max(1, int(rate * seconds)))

def slow_simulate(*arguments, progress, **options):
    def slow(done, steps):
        progress(done, steps)
        print("RUNNING", file=sys.stderr, flush=True)
        busy(RUN)
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

    def __init__(self, *words, run=0.0, save=0.0, code=SLOW):
        code = code.replace("RUN)", f"{run})").replace("SAVE\n", f"{save}\n")
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


LONG = ("simulate", "finger", "--no-gravity", "--v0", "0.1", "--dt", "1e-4", "--steps", "60000")
SHORT = ("simulate", "finger", "--no-gravity", "--v0", "0.1", "--steps", "10")


def test_the_first_is_answered_at_once_even_within_the_core(tmp_path):
    path = tmp_path / "a.npz"
    command = Command(*LONG, "--save", str(path), run=4.0)
    command.wait_for("RUNNING")
    time.sleep(0.5)
    asked = command.interrupt()
    assert command.wait_for("Ctrl-C: stopping; what is done is kept") - asked < 1.0
    assert command.end() == 130
    kept = vp.Trajectory.load(path)
    assert 0 < kept.steps < 60000
    assert f"varpin: interrupted after {kept.steps} steps, which are kept" in command.lines


def test_the_first_while_writing_finishes_the_file(tmp_path):
    path, figure = tmp_path / "a.npz", tmp_path / "a.png"
    command = Command(*SHORT, "--save", str(path), "--plot", str(figure), save=2.0)
    command.wait_for("WRITING")
    command.interrupt()
    assert command.end() == 130
    assert vp.Trajectory.load(path).steps == 10
    assert not figure.exists()


@pytest.mark.parametrize(
    ("run", "words", "seconds"),
    [(0.1, "WRITING", 10.0), pytest.param(3.0, "what is done is kept", 2.0, marks=pytest.mark.slow)],
    ids=["while it writes", "within one call"],
)
def test_the_second_ends_it(run, words, seconds, tmp_path):
    path = tmp_path / "a.npz"
    command = Command(*LONG, "--save", str(path), run=run, save=60.0)
    command.wait_for("RUNNING")
    command.interrupt()
    command.wait_for(words)
    asked = command.interrupt()
    assert command.end() == 130
    assert time.monotonic() - asked < seconds
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


def test_handlers_are_as_they_were_after_the_command():
    before, threads = signal.getsignal(signal.SIGINT), threading.active_count()
    assert main(["inspect", "finger"]) == 0
    assert signal.getsignal(signal.SIGINT) is before
    assert signal.set_wakeup_fd(-1) == -1
    assert threading.active_count() == threads
