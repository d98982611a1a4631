"""Arguments of the command line: every command with options that are odd, doubled, missing or of others."""

from __future__ import annotations

import contextlib
import io
import json
import random
from pathlib import Path

from fuzz.damage import NUMBERS, WORDS, Case, Special
from varpin.cli import main

OPTIONS = {
    "simulate": [
        *("--dt", "--steps", "--duration", "--torque", "--q", "--v", "--lock", "--gravity", "--integrator", "--stages"),
        *("--html", "--save", "--plot", "--trace", "--speed", "--package-dir", "--alpha", "--seed"),
    ],
    "solve": ["--html", "--save", "--plot", "--resume", "--max-iterations", "--trace"],
    "inspect": ["--q", "--v", "--lock", "--gravity", "--package-dir", "--no-gravity"],
    "tradeoff": ["--dt", "--duration", "--repeats", "--out"],
    "advise": ["--duration", "--tolerance", "--budget", "--out"],
    "extremes": ["--out", "--deep", "--lock"],
    "paper": ["--out", "--quick"],
    "robots": ["--quiet"],
    "replay": ["--html"],
}
ODD = ["--help", "--version", "-h", "-q", "--quiet", "--", "-", "--nonsense", "--dt=1e-3", "@input.json", "=", "-1"]
# Outputs are written: nothing here leads out of the worker's own folder.
NAMES = [
    *("arm.urdf", "fifo.csv", "fifo.urdf", "folder", "out.npz", "out.html", "out.png", "out", "nowhere/out.npz"),
    *(word for word in WORDS if not word.startswith(("/", "..", "~"))),
]

Corpus = None


def corpus() -> None:
    """Nothing."""
    return


def whole(corpus: None) -> Case:
    """A robot is looked at."""
    return Case("command", {"input.json": json.dumps(["inspect", "finger"]).encode()})


def make(rng: random.Random, corpus: None) -> Case:
    """Some arguments."""
    command = rng.choice([*OPTIONS, "inspect", "simulate"])
    # What would run for long is given no robot that is there, or an option that is not.
    words = [command, rng.choice(["finger", "ur5", "finger_tracking", *NAMES] if command == "inspect" else NAMES)]
    if command == "simulate":
        words = [command, "finger", "--steps", "2"]
    words += ["--no-such-option"] if command in ("paper", "robots", "extremes") else []
    for _ in range(rng.choice([0, 1, 1, 2, 4])):
        words.append(rng.choice([*OPTIONS[command], *ODD]))
        words += [rng.choice([*NUMBERS, *NAMES, "1,2,3", "mcp=0.2", "mcp=", "=1", "mcp=x"])]
    beside = {
        "arm.urdf": b"<robot name='a'/>",
        "fifo.csv": Special("fifo"),
        "fifo.urdf": Special("fifo"),
        "folder": Special("folder"),
    }
    words = [word.replace("\0", "") for word in words]  # no process can be given one
    return Case("command", {"input.json": json.dumps(words).encode(), **beside})


def read(path: Path, form: str) -> str:
    """Run the command in this process: it says one line, and its status is that of a mistake or of success."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            status = main(json.loads(path.read_text()))
        except SystemExit as leaving:  # of argparse
            status = leaving.code
    assert "Traceback" not in said.getvalue(), said.getvalue()[-300:]
    assert status in (0, 1, 2, 3), f"status {status}"
    return f"status {status}"
