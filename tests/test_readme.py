"""Every code block of the README runs."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from varpin.simulation import limits

ROOT = Path(__file__).resolve().parents[1]
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```$", (ROOT / "README.md").read_text(encoding="utf-8"), re.M | re.S)


def blocks(language):
    return [text for kind, text in BLOCKS if kind == language]


def test_there_are_only_blocks_that_are_run():
    assert {kind for kind, _ in BLOCKS} == {"python", "bash", "text"}
    assert len(blocks("bash")) == 2


@pytest.mark.parametrize("number", range(len(blocks("python"))))
def test_python_block(number, tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", blocks("python")[number]], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    # What is shown first asks nothing of a robot that its description forbids.
    assert not [kind for kind in limits.KINDS if kind in done.stderr], done.stderr
    if "replay" in blocks("python")[number]:
        assert list(tmp_path.glob("*.html"))
    if "verify" in blocks("python")[number]:
        begin = done.stdout.index("                          cost")
        for found, shown in zip(done.stdout[begin:].split(), blocks("text")[0].split(), strict=False):
            # What is down at rounding is another number on another machine.
            assert found == shown or float(found) == pytest.approx(float(shown), rel=0.5, abs=1e-12)
        costs = [float(found) for found in re.findall(r" (\d\.\d{6}e-07)", done.stdout[begin:])[:3]]
        assert costs == pytest.approx([float(x) for x in re.findall(r" (\d\.\d{6}e-07)", blocks("text")[0])], rel=1e-3)


def test_main_command(tmp_path):
    """The first command's own work, with this interpreter for the one it installs; .ci/run runs it whole."""
    run = blocks("bash")[0].replace("\\\n", " ").split("&& .venv/bin/varpin ")[1]
    done = subprocess.run(
        [sys.executable, "-m", "varpin", *run.split()], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert {path.name for path in tmp_path.iterdir()} == {"finger.html", "finger.npz", "finger.png"}
