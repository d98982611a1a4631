"""Mesh files, tried out before Pinocchio reads them.

Assimp, which reads them for Pinocchio, takes gigabytes for some damaged files, and ends the process or does not come
back on others. So another process with limits on memory and time reads them first; those that come with
example-robot-data or varpin are known to be whole.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

# The largest file that is read [bytes], and what it may take to read all of a robot's [bytes, s of processor time].
MOST_BYTES = 100_000_000
MEMORY = 500_000_000
SECONDS = 8
# Of wall time, for one that waits [s]; how many readers may die; and how it is said that one took too long.
_PATIENCE = 60.0
_MOST_DEATHS = 5
_SLOW = "reading takes more than"

_READER = Path(__file__).with_name("_mesh_reader.py")


def mesh_problems(texts: Sequence[str], package_dirs: Sequence[str]) -> list[str | None]:
    """What is wrong with the meshes that each of some URDF texts names; None where they can be read.

    Args:
        texts: URDFs, or parts of one, that Pinocchio reads as robots.
        package_dirs: Where ``package://`` paths are looked up.
    """
    problems: dict[int, str | None] = {}
    waiting = []
    for index, text in enumerate(texts):
        names = [mesh.get("filename", "") for mesh in ET.fromstring(text).iter("mesh")]
        problems[index] = next((said for name in names if (said := _odd_file(name, package_dirs))), None)
        if names and problems[index] is None:
            waiting.append(index)
    deaths = 0
    while waiting:
        answers, said = _tried([texts[index] for index in waiting], package_dirs)
        problems |= dict(zip(waiting, answers, strict=False))
        if len(answers) < len(waiting):
            problems[waiting[len(answers)]] = said
            deaths += _MOST_DEATHS if said.startswith(_SLOW) else 1
        waiting = waiting[len(answers) + 1 :]
        if deaths >= _MOST_DEATHS:
            problems |= dict.fromkeys(waiting, f"it was not tried, after others of which {said}")
            waiting = []
    return [problems[index] for index in range(len(texts))]


def _odd_file(name: str, package_dirs: Sequence[str]) -> str | None:
    """What speaks against opening what a mesh is called, if there is such a thing."""
    scheme, found, rest = name.partition("://")
    places = [name] if not found else [rest] if scheme == "file" else [os.path.join(d, rest) for d in package_dirs]  # noqa: PTH118
    for place in map(Path, places):
        try:
            if not place.exists():
                continue
            if not place.is_file():
                return f"{place} is a folder or a device, not a mesh file"
            if place.stat().st_size > MOST_BYTES:
                return f"{place} is larger than {MOST_BYTES / 1e6:g} MB, the largest mesh that is read"
        except OSError as error:
            return f"{place}: {error.strerror or error}"
        return None
    return None


def _tried(texts: Sequence[str], package_dirs: Sequence[str]) -> tuple[list[str | None], str]:
    """What a reader in another process says of each text, as far as it gets, and how it ended."""
    # Without the folder of the script on its path, whose modules have names of the standard library's.
    command = [sys.executable, "-P", str(_READER)]
    request = json.dumps({"texts": texts, "dirs": package_dirs, "memory": MEMORY, "seconds": SECONDS})
    try:
        ended = subprocess.run(
            command,
            input=request.encode(),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            timeout=_PATIENCE,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        return _answers(error.stdout or b""), f"{_SLOW} {_PATIENCE:g} s"
    said = f"the reader ends with code {ended.returncode}"
    if ended.returncode in (-9, -24):
        said = f"{_SLOW} {SECONDS} s of processor time"
    return _answers(ended.stdout), said


def _answers(output: bytes) -> list[str | None]:
    """The answers that are whole: the last one may have been cut off."""
    return [json.loads(line) for line in output.split(b"\n")[:-1]]
