"""The build backend: scikit-build-core's, which brings a C++ compiler from PyPI where the machine has none.

A build that finds no compiler asks pip for the wheel ``ziglang`` and builds with the Clang in it.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from scikit_build_core import build as backend
from scikit_build_core.build import (
    build_sdist,
    get_requires_for_build_sdist,
    prepare_metadata_for_build_editable,
    prepare_metadata_for_build_wheel,
)

__all__ = [
    "build_editable",
    "build_sdist",
    "build_wheel",
    "get_requires_for_build_editable",
    "get_requires_for_build_sdist",
    "get_requires_for_build_wheel",
    "prepare_metadata_for_build_editable",
    "prepare_metadata_for_build_wheel",
]

Settings = dict[str, Any] | None

COMPILERS = ("c++", "g++", "clang++")
# What a build asks of a tool chain, and what zig calls it. Left alone, zig compiles for the very processor it runs on;
# and it makes its C++ library, which takes as long as the core, anew for each level of optimization.
TOOLS = {"c++": "c++ -mcpu=baseline -O3 -fPIC", "ar": "ar", "ranlib": "ranlib"}
# It makes that library again for what is stripped: the module is, so the programs of CMake's own trials are, too.
SCRIPT = """#!/bin/sh
case " $* " in
    *" -c "* | *" -shared "* | *" --version "*) exec "{python}" -m ziglang {command} "$@" ;;
    *) exec "{python}" -m ziglang {command} {programs} "$@" ;;
esac
"""


def has_compiler() -> bool:
    """Whether the environment names a C++ compiler or the path holds one."""
    return "CXX" in os.environ or any(shutil.which(name) for name in COMPILERS)


def get_requires_for_build_wheel(settings: Settings = None) -> list[str]:
    """What scikit-build-core needs, and a compiler if there is none."""
    return [*backend.get_requires_for_build_wheel(settings), *([] if has_compiler() else ["ziglang >=0.13"])]


def get_requires_for_build_editable(settings: Settings = None) -> list[str]:
    """What scikit-build-core needs, and a compiler if there is none."""
    return [*backend.get_requires_for_build_editable(settings), *([] if has_compiler() else ["ziglang >=0.13"])]


@contextlib.contextmanager
def compiler() -> Iterator[None]:
    """Within this context CMake finds a C++ compiler."""
    if has_compiler():
        yield
        return
    before = dict(os.environ)
    with tempfile.TemporaryDirectory() as folder:
        # CMake takes paths of programs, not commands with arguments.
        for name, subcommand in TOOLS.items():
            script = Path(folder) / name
            programs = "-Wl,-s" if name == "c++" else ""
            script.write_text(SCRIPT.format(python=sys.executable, command=subcommand, programs=programs))
            script.chmod(script.stat().st_mode | stat.S_IXUSR)
        os.environ["CXX"] = str(Path(folder) / "c++")
        tools = f"-DCMAKE_AR={folder}/ar -DCMAKE_RANLIB={folder}/ranlib"
        os.environ["CMAKE_ARGS"] = f"{os.environ.get('CMAKE_ARGS', '')} {tools}".strip()
        try:
            yield
        finally:
            os.environ.clear()
            os.environ.update(before)


def build_wheel(folder: str, settings: Settings = None, metadata: str | None = None) -> str:
    """A wheel, with the core compiled for this machine's kind."""
    with compiler():
        return backend.build_wheel(folder, settings, metadata)


def build_editable(folder: str, settings: Settings = None, metadata: str | None = None) -> str:
    """A wheel that points at the source tree, with the core compiled into it."""
    with compiler():
        return backend.build_editable(folder, settings, metadata)
