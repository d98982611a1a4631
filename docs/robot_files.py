"""What came of robot files, for docs/robots.md: those of packages of PyPI, loaded, inspected, simulated, replayed.

    pip install --no-deps --target robots robosuite dm_control gymnasium-robotics rtb-data
    python docs/robot_files.py robots                     # what stops them, for the page
    python docs/robot_files.py robots/robosuite --print   # a row for each file of one folder, on the terminal

example-robot-data is taken where it is installed. Each file has a process of its own, and two minutes.
"""

from __future__ import annotations

import argparse
import json
import logging
import re
import subprocess
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

import varpin as vp
from varpin.model.names import robots_dir

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "benchmarks"))
from pages import fill  # noqa: E402

# Packages and what of theirs is robots; the others hold scenes, objects and parts.
FOLDERS = {
    "robosuite": ("models/assets/robots", "models/assets/grippers", "models/assets/bullet_data"),
    "dm_control": ("third_party/kinova", "suite"),
    "gymnasium_robotics": ("envs/assets",),
    "rtbdata": ("xacro", "data"),
}
TIMEOUT = 120.0


@dataclass(frozen=True)
class Row:
    """What came of a file: how far it got, its joints, what the log told, and why it stopped."""

    stage: str
    joints: int = 0
    told: tuple[str, ...] = ()
    why: str = ""


class _Heard(logging.Handler):
    """Sentences of the log, without what differs from link to link."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.sentences: dict[str, None] = {}

    def emit(self, record: logging.LogRecord) -> None:
        self.sentences[record.getMessage()] = None


def tried(path: Path) -> Row:
    """A file, taken as far as it goes: a tenth of a second from its middle posture, with what it gives itself."""
    heard, stage, joints = _Heard(), "load", 0
    logging.getLogger("varpin").addHandler(heard)
    try:
        robot = vp.load_robot(path)
        stage, joints = "inspect", robot.dof
        told = tuple(heard.sentences)
        str(vp.inspect_robot(robot))
        stage = "simulate"
        lower, upper = (np.nan_to_num(limit, posinf=0.0, neginf=0.0) for limit in robot.position_limits)
        scene = vp.Scene(robot, damping="robot", constraints="robot" if robot.equalities else ())
        q0 = 0.5 * (lower + upper)
        motion = vp.simulate(
            scene, vp.assemble(scene, q0) if scene.constraints else q0, np.zeros(robot.dof), dt=1e-3, steps=100
        )
        if not np.isfinite(motion.q).all():
            return Row(stage, joints, told, "the motion is not finite")
        stage = "replay"
        with tempfile.TemporaryDirectory() as folder:
            page = vp.replay(robot, motion, html=Path(folder, "page.html"))
            if page.stat().st_size < 100_000:
                return Row(stage, joints, told, "the page is empty")
        told = tuple(heard.sentences)
    except vp.VarpinError as error:
        why = " ".join(str(error).split()).replace(f"{path.parent}/", "").replace(str(path.parent), "its folder")
        return Row(stage, joints, tuple(heard.sentences), why)
    return Row("all", joints, told)


def files(root: Path) -> Iterator[Path]:
    """URDF, xacro and MJCF files below a folder; of packages that are known, of their robots alone."""
    packages = [folder for name in FOLDERS if (folder := root / name).is_dir()]
    folders = [package / part for package in packages for part in FOLDERS[package.name]] or [root]
    for folder in folders:
        for path in sorted(folder.rglob("*")):
            if path.suffix in (".urdf", ".xacro") or (path.suffix == ".xml" and "<mujoco" in _head(path)):
                yield path


def _head(path: Path) -> str:
    with path.open(encoding="utf-8", errors="replace") as file:
        return file.read(4000)


def in_a_process(path: Path) -> Row:
    """:func:`tried`, safe from what crashes or never ends."""
    command = [sys.executable, __file__, "--one", str(path)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT, check=False)
    except subprocess.TimeoutExpired:
        return Row("load", why=f"no end after {TIMEOUT:g} s")
    lines = done.stdout.strip().splitlines()
    if done.returncode or not lines:
        return Row("load", why=f"the process ends with {done.returncode}: {done.stderr.strip().splitlines()[-1:]}")
    return row_of(json.loads(lines[-1]))


def row_of(found: dict[str, Any]) -> Row:
    """A row as it was written down."""
    return Row(**{**found, "told": tuple(found["told"])})


def _local(sentence: str) -> str:
    """A sentence without where packages are installed."""
    return re.sub(r"/\S*site-packages/(\S*/robots/)?", "", sentence)


def lacked(row: Row) -> str:
    """What the log told, each kind of sentence once and how often."""
    kinds: dict[str, int] = {}
    for sentence in row.told:
        # A file may do without dampers; the motion asks for them in every scene.
        if "damping='robot' is none" in sentence:
            continue
        short = next((words for pattern, words in KINDS if re.search(pattern, sentence)), _local(sentence)[:60])
        kinds[short] = kinds.get(short, 0) + 1
    return "; ".join(f"{short} ({count})" if count > 1 else short for short, count in kinds.items())


KINDS = (
    (r"non-physical inertia", "inertia that no body has"),
    (r"no mass|without mass|massless", "links without mass"),
    (r"leaves out the friction", "dry friction left out of the scene"),
    (r"damping is faster than the step", "dampers faster than 1 ms"),
    (r"passe?s? (its|their) position limit", "joints beyond limits"),
    (r"passe?s? (its|their) velocity limit", "joints beyond velocity limits"),
    (r"mesh|skeleton", "meshes missing"),
    (r"mimic", "mimic joints"),
    (r"equality|tendon|spring", "parts of MJCF left out"),
    (r"is coarse for|alternates", "1 ms is coarse"),
)


def table(found: list[tuple[str, Row]]) -> list[str]:
    """Rows of the page."""
    lines = ["| file | joints | what it lacked, or what was told | verdict |", "|---|---|---|---|"]
    for name, row in found:
        verdict = "all" if row.stage == "all" else f"{row.stage}: {_local(row.why)[:240]}"
        joints = row.joints or ""
        lines.append(f"| `{name}` | {joints} | {lacked(row)} | {verdict.replace('|', '/')} |")
    return lines


# What stops a file, by words of its verdict.
REASONS = (
    ("no joint that moves", "no joint that moves"),
    ("FreeFlyer", "a free joint, which `lock` has to hold"),
    ("mass matrix is singular", "a joint that carries no inertia"),
    ("it has no links", "a macro of xacro, which is no robot by itself"),
    ("cannot be expanded", "a package or a file that is not there"),
    ("MuJoCo cannot read", "a fragment that other files include"),
)


def summary(found: list[tuple[str, Row]]) -> list[str]:
    """How many files go all the way, and what stops the others."""
    stopped = [row.why for _, row in found if row.stage != "all"]
    known = [next((words for part, words in REASONS if re.search(part, why)), why) for why in stopped]
    counts = Counter(known).most_common()
    head = [f"{len(found) - len(stopped)} of {len(found)} files go all the way.", ""]
    return [*head, "| what stops a file | files |", "|---|---|", *(f"| {words} | {n} |" for words, n in counts)]


def main() -> None:
    """Write the table, or print it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--print", action="store_true", help="the table on the terminal, and no page")
    parser.add_argument("--record", type=Path, help="what came of each file, to be read again where it is there")
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    request = parser.parse_args()
    warnings.simplefilter("ignore")
    if request.one is not None:
        sys.stdout.write(json.dumps(asdict(tried(request.one))) + "\n")
        return
    given = {str(folder): folder for folder in request.folders}
    if not request.print:
        given = {"example-robot-data": robots_dir(), **given}
    known: dict[str, dict[str, Any]] = {}
    if request.record is not None and request.record.exists():
        known = json.loads(request.record.read_text(encoding="utf-8"))
    found: list[tuple[str, Row]] = []
    for folder in given.values():
        for path in files(folder):
            name = str(path.relative_to(folder))
            row = row_of(known[name]) if name in known else in_a_process(path)
            found.append((name, row))
            sys.stderr.write(f"{name}: {row.stage} {row.why[:100]}\n")
            if request.record is not None:
                request.record.write_text(json.dumps({own: asdict(kept) for own, kept in found}), encoding="utf-8")
    if request.print:
        sys.stdout.write("\n".join(table(found)) + "\n")
        return
    fill(HERE / "robots.md", {"files": "\n".join(summary(found))})


if __name__ == "__main__":
    main()
