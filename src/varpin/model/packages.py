"""Files and ROS packages that a robot's file names."""

from __future__ import annotations

import contextlib
import importlib
import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from varpin.errors import FileError, MissingDependency, RobotError, VarpinError
from varpin.support.frozen import Frozen

# The first words of a file that Git LFS has not fetched.
_LFS_POINTER = b"version https://git-lfs"

# A given folder is a package, or contains packages.
_MANIFESTS = ("package.xml", "*/package.xml")
_FIND = re.compile(r"\$\(find ([^)]+)\)/?")


@dataclass(frozen=True)
class Files:
    """The files of a robot, and what they are read with."""

    name: str  # of the robot
    path: Path  # a URDF, xacro or MJCF file
    folders: tuple[str, ...] = ()  # in which packages are looked up
    xacro_args: Mapping[str, object] = field(default_factory=dict)
    packages: Mapping[str, str] = field(default_factory=dict)  # folders of packages by name
    srdf: Path | None = None  # the SRDF file or its xacro file; None for the one beside the robot's file
    srdf_args: Mapping[str, object] = field(default_factory=dict)  # of that xacro file


@dataclass(frozen=True, eq=False)
class Packages(Frozen):
    """Where packages and files that a robot's file names are looked up."""

    file: Path  # the robot's file
    folders: tuple[str, ...] = ()  # that contain packages, or are packages
    named: Mapping[str, str] = field(default_factory=dict)  # folders of packages by name

    @cached_property
    def places(self) -> tuple[Path, ...]:
        """Folders that contain packages: the given ones, those around the file, its own, those of a sourced ROS."""
        ros, ament = (
            [Path(folder) for folder in os.environ.get(name, "").split(os.pathsep) if folder]
            for name in ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH")
        )
        around = [*(package.parent for package in self.around.values()), self.file.parent]
        return tuple(dict.fromkeys([*map(Path, self.folders), *around, *ros, *(folder / "share" for folder in ament)]))

    @cached_property
    def around(self) -> dict[str, Path]:
        """The packages that contain the file, by name, innermost first."""
        manifests = (folder / "package.xml" for folder in self.file.absolute().parents)
        return dict(reversed([*_named(manifest for manifest in manifests if manifest.is_file())]))

    @cached_property
    def below(self) -> dict[str, Path]:
        """The packages in :attr:`places`, by the name in their ``package.xml``."""
        return dict(_named(path for place in self.places for pattern in _MANIFESTS for path in place.glob(pattern)))

    def folder(self, name: str) -> Path | None:
        """The folder of a package: one around the file, one of that name, or one whose ``package.xml`` has it."""
        if found := self.named.get(name) or self.around.get(name):
            return Path(found)
        near = [*(folder for folder in self.file.absolute().parents if folder.name == name)]
        near += [place / name for place in self.places]
        return next((folder.absolute() for folder in near if folder.is_dir()), self.below.get(name))

    def candidates(self, name: str) -> Iterator[Path]:
        """Where a file may be, by its name in the robot's file."""
        name = _FIND.sub(r"package://\1/", name)
        scheme, separator, rest = name.partition("://")
        if not separator:
            yield from (self.file.parent / name, Path(name))
        elif scheme == "file":
            yield Path(rest)
        elif scheme in ("package", "model"):  # Gazebo uses model:// for package://.
            package, _, inside = rest.partition("/")
            if folder := self.folder(package):
                yield folder / inside
            yield from (place / rest for place in self.places)

    def locate(self, name: str) -> Path | None:
        """The path of a file; None if it does not exist."""
        return next((path.absolute() for path in self.candidates(name) if path.is_file()), None)

    def in_other_case(self, name: str) -> Path | None:
        """A file whose path differs from ``name`` in upper and lower case alone; None if there is none."""
        for path in map(Path.absolute, self.candidates(name)):
            found = Path(path.anchor)
            for part in path.parts[1:]:
                exact = found / part
                if not exact.exists() and found.is_dir():
                    exact = next((own for own in found.iterdir() if own.name.lower() == part.lower()), exact)
                found = exact
            if found.is_file():
                return found
        return None


def _named(manifests: Iterator[Path]) -> Iterator[tuple[str, Path]]:
    """Names and folders of packages."""
    for manifest in manifests:
        with contextlib.suppress(ET.ParseError, OSError):
            name = ET.parse(manifest).getroot().findtext("name") or manifest.parent.name
            yield name.strip(), manifest.parent


def content(path: Path, unfetched: type[VarpinError] = RobotError) -> bytes:
    """What is in a file; an error, ``unfetched``, if Git LFS has not fetched it."""
    try:
        found = path.read_bytes()
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror}") from None
    if found.startswith(_LFS_POINTER):
        raise unfetched(f"{path} is a Git LFS pointer, not the file itself: git lfs pull downloads it")
    return found


def optional(module: str, purpose: str, extra: str) -> Any:
    """A module of one of varpin's extras; a MissingDependency if it is not installed."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingDependency(purpose, [error.name or module], f'pip install "varpin[{extra}]"') from None
