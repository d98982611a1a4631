"""Feeds inputs to workers that may die of them, and reports what came out.

Every input follows from (kind, seed, number). Workers read them one after another, with a limit on memory and under a
watch: a worker that dies or hangs is a finding with its input, and so is whatever is raised that is no VarpinError.
"""

from __future__ import annotations

import collections
import contextlib
import importlib
import json
import logging
import os
import random
import resource
import selectors
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

from fuzz.damage import Case

MEMORY = 1_000_000_000  # bytes that a reader may take in all
TIMEOUT = 10.0  # [s] of processor time that one input may take; of wall time twenty times as much
KINDS = ("urdf", "npz", "solution", "scene", "reference", "record", "command")


def module(kind: str) -> ModuleType:
    """What makes and reads inputs of a kind."""
    return importlib.import_module(f"fuzz.{kind}")


def make(kind: str, number: int, seed: int, corpus: object) -> Case:
    """Input ``number``."""
    case: Case = module(kind).make(random.Random(f"{kind} {seed} {number}"), corpus)
    return case


def work(kind: str, seed: int, begin: int, end: int) -> None:
    """Read inputs begin .. end and report each on stdout, before it is read and after."""
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    own, report = module(kind), os.fdopen(os.dup(1), "w", buffering=1)
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        corpus = own.corpus()
        # What varpin, Pinocchio and the core take themselves is no part of an input's memory.
        whole = own.whole(corpus)
        own.read(whole.write(Path(folder)), whole.form)
        _empty(Path(folder))
        base = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (base + MEMORY, base + MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        for number in range(begin, end):
            report.write(f"{number}\n")
            case = make(kind, number, seed, corpus)
            path = case.write(Path(folder))
            Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
            started, problem = time.perf_counter(), ""
            try:
                outcome = own.read(path, case.form)
            except BaseException as error:
                outcome, problem = "FINDING", _said(error)
            took = time.perf_counter() - started
            peak = _peak()
            if peak > MEMORY and not problem:
                outcome, problem = "FINDING", f"took {peak / 1e6:.0f} MB"
            report.write(json.dumps([number, outcome, problem, took, peak]) + "\n")
            _empty(Path(folder))
            if peak > MEMORY:
                return


def _peak() -> int:
    """The most memory that this process has had since its peak was last forgotten, in bytes."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    raise RuntimeError("the kernel does not say how much memory a process takes")


def _said(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    way = " <- ".join(f"{frame.name}, {frame.line}" for frame in frames[:-4:-1])
    return f"{type(error).__name__}: {str(error)[:200]} ({way})"


def _empty(folder: Path) -> None:
    for leftover in folder.iterdir():
        if leftover.is_dir() and not leftover.is_symlink():
            shutil.rmtree(leftover)
        else:
            leftover.unlink()


@dataclass
class Report:
    """What came out."""

    inputs: int = 0
    outcomes: collections.Counter[str] = field(default_factory=collections.Counter)
    findings: list[tuple[str, int, str]] = field(default_factory=list)
    slowest: float = 0.0  # [s]
    largest: float = 0.0  # bytes
    seconds: float = 0.0  # reading

    def __add__(self, other: Report) -> Report:
        return Report(
            self.inputs + other.inputs,
            self.outcomes + other.outcomes,
            self.findings + other.findings,
            max(self.slowest, other.slowest),
            max(self.largest, other.largest),
            self.seconds + other.seconds,
        )

    def __str__(self) -> str:
        lines = [
            f"{self.inputs} inputs, {self.inputs / max(self.seconds, 1e-9):.0f} a second, "
            f"slowest {self.slowest:.2f} s, most memory {self.largest / 1e6:.0f} MB"
        ]
        lines += [f"{count:8d}  {outcome}" for outcome, count in self.outcomes.most_common()]
        lines += [f"FINDING {kind} {number}: {problem}" for kind, number, problem in self.findings]
        return "\n".join(lines)


def run(kind: str, seed: int, begin: int, end: int, folder: Path | None = None) -> Report:
    """Inputs begin .. end of a kind, each in a worker that may die of it; findings are kept in ``folder``."""
    report = Report()
    # What imports take is no part of an input's memory.
    for line in _watched(kind, seed, begin, begin):
        raise RuntimeError(f"a worker does not get to its first input: {line}")
    while begin < end:
        number, problem, started = begin, "", False
        for line in _watched(kind, seed, begin, end):
            if line is None:
                problem = f"hangs: more than {TIMEOUT:g} s of processor time"
            elif line.startswith("["):
                number, outcome, problem, took, peak = json.loads(line)
                report.inputs += 1
                report.outcomes[outcome] += 1
                report.seconds += took
                report.slowest, report.largest = max(report.slowest, took), max(report.largest, peak)
                if problem:
                    report.findings.append((kind, number, problem))
                begin, problem = number + 1, ""
            elif line.startswith("died"):
                if not started:
                    raise RuntimeError(f"a worker does not get to its first input: {line}")
                problem = line if begin < end else ""
            else:
                number, started = int(line), True
        if problem:
            report.inputs += 1
            report.outcomes["FINDING"] += 1
            report.findings.append((kind, number, problem))
            begin = number + 1
    if folder is not None and report.findings:
        corpus = module(kind).corpus()
        for _, number, _ in report.findings:
            own = folder / f"{kind}-{seed}-{number}"
            own.mkdir(parents=True, exist_ok=True)
            make(kind, number, seed, corpus).write(own)
    return report


def _watched(kind: str, seed: int, begin: int, end: int) -> Iterator[str | None]:
    """The lines of a worker; None where it hangs, and how it died last, if it did."""
    command = [sys.executable, "-m", "fuzz", "--worker", kind, "--seed", str(seed), "--numbers", str(begin), str(end)]
    tests = Path(__file__).resolve().parents[1]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, cwd=tests) as worker:
        assert worker.stdout is not None
        os.set_blocking(worker.stdout.fileno(), False)
        waiting, rest = selectors.DefaultSelector(), b""
        waiting.register(worker.stdout, selectors.EVENT_READ)
        patience = 40.0  # in units of TIMEOUT, until everything is imported
        used, silent = 0.0, time.monotonic()
        while True:
            if not waiting.select(1.0):
                wall, busy = time.monotonic() - silent, _processor_time(worker.pid) - used
                if busy > patience * TIMEOUT or wall > 20.0 * patience * TIMEOUT:
                    worker.kill()
                    yield None
                    return
                continue
            chunk = os.read(worker.stdout.fileno(), 1 << 16)
            if not chunk:
                break
            patience, used, silent = 1.0, _processor_time(worker.pid), time.monotonic()
            *lines, rest = (rest + chunk).split(b"\n")
            for line in lines:
                yield line.decode()
        if worker.wait() != 0:
            yield f"died: exit code {worker.returncode}"


def _processor_time(pid: int) -> float:
    """Of a process so far [s]."""
    fields_of = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields_of[11]) + int(fields_of[12])) / os.sysconf("SC_CLK_TCK")
