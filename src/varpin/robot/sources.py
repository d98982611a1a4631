"""From what a user names to a Pinocchio model: files, bundled robots, example-robot-data, models in memory."""

import contextlib
import os
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

from varpin.errors import FileError, InputError, RobotError, RobotNotFound
from varpin.robot import example_robot_data
from varpin.robot.mimic import Tie, leaders_first, ties_of_urdf, untied_model

Source = "str | os.PathLike[str] | pin.Model | pin.RobotWrapper"


@dataclass(frozen=True)
class Description:
    """A robot as its source describes it, before anything is locked.

    Attributes:
        name: Of the file, the bundled robot or the model.
        model: Every joint on its own.
        ties: Mimic joints.
        urdf: The file, if there is one.
        package_dirs: Where ``package://`` paths are looked up.
        visuals: Geometry handed over with a RobotWrapper.
    """

    name: str
    model: pin.Model
    ties: tuple[Tie, ...] = ()
    urdf: Path | None = None
    package_dirs: tuple[str, ...] = ()
    visuals: pin.GeometryModel | None = None


def models_dir() -> Path:
    """The folder of the bundled robots: in the wheel, or at the top of a source tree."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "models", package.parents[1] / "models"):
        if (folder / "SOURCES.md").is_file():
            return folder
    raise FileError(f"varpin's bundled models are missing beside {package}")


def bundled_robots() -> dict[str, Path]:
    """The robots that come with varpin, by name."""
    return {path.stem: path for path in sorted(models_dir().glob("*.urdf"))}


def describe(source: object, package_dirs: Sequence[str | os.PathLike[str]] | None, *, mimic: bool) -> Description:
    """Find and parse ``source``; see :func:`varpin.load_robot`."""
    folders = tuple(os.fspath(folder) for folder in package_dirs or ())
    if isinstance(source, pin.Model):
        return _of_model(source, source.name or "model", None)
    if isinstance(source, pin.RobotWrapper):
        return _of_model(source.model, source.model.name or "robot", source.visual_model)
    if not isinstance(source, str | os.PathLike):
        raise InputError(
            f"source must be a URDF path, a robot's name, a pin.Model or a pin.RobotWrapper, got {type(source).__name__}"
        )
    text = os.fspath(source)
    path = Path(text).expanduser()
    is_path = isinstance(source, os.PathLike) or path.suffix or os.sep in text
    if is_path and path.is_file():
        return _of_urdf(path.resolve(), path.stem, folders, mimic=mimic)
    bundled = bundled_robots()
    if text in bundled:
        return _of_urdf(bundled[text], text, folders, mimic=mimic)
    if text in example_robot_data.FIXED_BASE:
        return _of_example(text, folders, mimic=mimic)
    if text in example_robot_data.FLOATING_BASE:
        raise RobotError(
            f"{text!r} stands on a free-flyer in example-robot-data, and varpin models fixed bases; "
            "to pin its base to the world, load its URDF file by path"
        )
    note = "" if path.suffix != ".urdf" else f" (looked in {path.absolute().parent})"
    raise RobotNotFound(text, [*bundled, *example_robot_data.FIXED_BASE], note)


def _of_model(model: pin.Model, name: str, visuals: pin.GeometryModel | None) -> Description:
    free, ties = untied_model(model)
    return Description(name, free, ties, visuals=visuals)


def _of_example(name: str, folders: tuple[str, ...], *, mimic: bool) -> Description:
    urdf = example_robot_data.locate(example_robot_data.FIXED_BASE[name])
    folders = (*folders, str(example_robot_data.package_dir(urdf)))
    description = _of_urdf(urdf, name, folders, mimic=mimic)
    if name in example_robot_data.ROTORS:
        model = description.model
        pin.loadRotorParameters(model, str(example_robot_data.locate(example_robot_data.ROTORS[name])), False)
        model.armature = np.asarray(model.rotorInertia) * np.asarray(model.rotorGearRatio) ** 2
    return description


def _of_urdf(path: Path, name: str, folders: tuple[str, ...], *, mimic: bool) -> Description:
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror}") from None
    _check_urdf(text, path)
    with _captured_stderr() as complaint:
        try:
            model = pin.buildModelFromUrdf(str(path))
        except (ValueError, RuntimeError) as error:
            detail = " ".join([*complaint(), str(error)])
            raise RobotError(f"{path} is not a URDF that Pinocchio can read: {detail}") from None
    ties: tuple[Tie, ...] = ()
    if mimic:
        ties = ties_of_urdf(text, model)
        ordered = leaders_first(model, ties)
        if ordered is not model:
            model, ties = ordered, ties_of_urdf(text, ordered)
    return Description(name, model, ties, path, (*folders, str(path.parent)))


def _check_urdf(text: str, path: Path) -> None:
    """Say in words what Pinocchio's parser would say in part or not at all."""
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise RobotError(f"{path} is not well-formed XML: {error}") from None
    if root.tag != "robot":
        raise RobotError(f"{path} is not a URDF: its root element is <{root.tag}>, not <robot>")
    if root.find("link") is None:
        raise RobotError(f"{path} describes no link")


@contextlib.contextmanager
def _captured_stderr() -> "Iterator[object]":
    """Catch what Pinocchio's C++ parser writes to the process's stderr; yields a function that returns its lines."""
    sys.stderr.flush()
    saved = os.dup(2)
    with tempfile.TemporaryFile() as sink:
        os.dup2(sink.fileno(), 2)

        def lines() -> list[str]:
            sink.seek(0)
            return [line.strip() for line in sink.read().decode(errors="replace").splitlines() if line.strip()]

        try:
            yield lines
        finally:
            os.dup2(saved, 2)
            os.close(saved)
