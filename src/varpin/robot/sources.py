"""From what a user names to a Pinocchio model: files, bundled robots, example-robot-data, models in memory."""

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

from varpin.errors import FileError, InputError, RobotError, RobotNotFound
from varpin.robot import example_robot_data
from varpin.robot.mimic import (
    JOINT_PARAMETERS,
    Tie,
    depth_first,
    joint_frames,
    reordered,
    repair_velocity_limits,
    ties_of,
    untied_model,
)
from varpin.robot.urdf import Inertial, Mimic, build_model, read_urdf

logger = logging.getLogger(__name__)


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
        inertials: Of the links in a URDF, which the model has merged into bodies.
        remarks: What the source leaves out, in words.
    """

    name: str
    model: pin.Model
    ties: tuple[Tie, ...] = ()
    urdf: Path | None = None
    package_dirs: tuple[str, ...] = ()
    visuals: pin.GeometryModel | None = None
    inertials: tuple[Inertial, ...] = ()
    remarks: tuple[str, ...] = ()


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


def robot_names() -> tuple[str, ...]:
    """The names that :func:`varpin.load_robot` takes: varpin's own robots, then those of example-robot-data.

    Of example-robot-data, the fixed-base robots that the installed version holds; none where it is not installed.
    """
    return (*bundled_robots(), *example_robot_data.installed())


def describe(source: object, package_dirs: Sequence[str | os.PathLike[str]] | None, *, mimic: bool) -> Description:
    """Find and parse ``source``; see :func:`varpin.load_robot`."""
    folders = _folders(package_dirs)
    if isinstance(source, pin.Model):
        return _of_model(source, source.name or "model", None)
    if isinstance(source, pin.RobotWrapper):
        return _of_model(source.model, source.model.name or "robot", source.visual_model)
    if not isinstance(source, str | os.PathLike):
        raise InputError(
            "source must be a URDF path, a robot's name, a pin.Model or a pin.RobotWrapper, "
            f"got {type(source).__name__}"
        )
    text = os.fspath(source)
    path = Path(text).expanduser()
    is_path = isinstance(source, os.PathLike) or path.suffix or os.sep in text
    if is_path and _is_file(path):
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
    if is_path and path.is_dir():
        raise RobotError(f"{path} is a folder, not a URDF file; it holds {_urdf_files(path)}")
    note = "" if path.suffix != ".urdf" else f" (looked in {path.absolute().parent})"
    raise RobotNotFound(text, [*bundled, *example_robot_data.installed()], note)


def _folders(package_dirs: Sequence[str | os.PathLike[str]] | str | os.PathLike[str] | None) -> tuple[str, ...]:
    if isinstance(package_dirs, str | os.PathLike):
        package_dirs = [package_dirs]
    try:
        return tuple(os.fspath(folder) for folder in package_dirs or ())
    except TypeError:
        raise InputError(f"package_dirs must be a list of folders, got {package_dirs!r}") from None


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError as error:
        raise FileError(f"cannot read the URDF file: {error.strerror}: {str(path)[:80]!r}") from None


def _urdf_files(folder: Path) -> str:
    return ", ".join(sorted(file.name for file in folder.glob("*.urdf"))) or "no URDF file"


def _of_model(model: pin.Model, name: str, visuals: pin.GeometryModel | None) -> Description:
    _check_model(model, name)
    # Copies: what the user does to the model afterwards must not reach the robot.
    free, ties = untied_model(model.copy())
    shapes = visuals.copy() if visuals is not None else None
    for shape in shapes.geometryObjects if shapes is not None else ():
        if shape.parentJoint >= free.njoints:
            raise RobotError(f"shape {shape.name!r} hangs on joint {shape.parentJoint}, which model {name!r} has not")
    order = depth_first(free, ties)
    in_order = order == sorted(order)
    if not (in_order and _has_joint_frames(free)):
        free, ties = reordered(free, ties, order)
        for shape in shapes.geometryObjects if shapes is not None else ():
            shape.parentJoint = [0, *order].index(shape.parentJoint)
    if not in_order:
        # Pinocchio lets joints be added in any order, and then computes another mass matrix without a word.
        logger.warning(
            "the joints of model %r were not added subtree by subtree, as Pinocchio's algorithms need: reordered to %s",
            name,
            ", ".join(list(free.names)[1:]),
        )
    repair_velocity_limits(free)
    if shapes is not None:
        hang_shapes(shapes, model, free)
    return Description(name, free, ties, visuals=shapes)


def _check_model(model: pin.Model, name: str) -> None:
    """Refuse a model whose parts do not fit together: Pinocchio's algorithms do not look, and end the process.

    Raises:
        RobotError: Naming the part.
    """
    n, nq, nv = model.njoints, model.nq, model.nv
    sizes = dict.fromkeys(("joints", "names", "parents", "inertias", "jointPlacements"), n)
    sizes |= dict.fromkeys(("lowerPositionLimit", "upperPositionLimit"), nq)
    sizes |= dict.fromkeys(JOINT_PARAMETERS, nv)
    for part, size in sizes.items():
        if (found := len(getattr(model, part))) != size:
            raise RobotError(f"model {name!r} is damaged: its {part} has {found} entries, where {size} belong")
    q, v = 0, 0
    for joint in range(1, n):
        kind, parent = model.joints[joint], model.parents[joint]
        if parent >= joint:
            raise RobotError(f"model {name!r} is damaged: joint {model.names[joint]!r} comes before its parent")
        # A mimic joint has no coordinates of its own and stands at its leader's.
        if kind.id != joint or (kind.nv and (kind.idx_q, kind.idx_v) != (q, v)) or kind.idx_v >= nv:
            raise RobotError(f"model {name!r} is damaged: joint {model.names[joint]!r} is not at the place it has")
        q, v = q + kind.nq, v + kind.nv
    if (q, v) != (nq, nv):
        raise RobotError(f"model {name!r} is damaged: its joints have {q} and {v} coordinates, not nq and nv")
    for frame in model.frames:
        if frame.parentJoint >= n or frame.parentFrame >= model.nframes:
            raise RobotError(f"model {name!r} is damaged: frame {frame.name!r} hangs on what is not there")


def _has_joint_frames(model: pin.Model) -> bool:
    """Whether every joint has its frame, and it comes before what hangs on it, as pin.buildReducedModel needs.

    It reads beyond its arrays where one is missing.
    """
    frame_of = {model.frames[index].parentJoint: index for index in joint_frames(model)}
    if len(frame_of) < model.njoints - 1:
        return False
    return all(frame_of.get(frame.parentJoint, 0) <= index for index, frame in enumerate(model.frames))


def hang_shapes(shapes: pin.GeometryModel, old: pin.Model, new: pin.Model) -> None:
    """Hang shapes from the frames of ``old`` on those of ``new``, and where there is none on their joint's."""
    for shape in shapes.geometryObjects:
        frame = new.nframes
        if shape.parentFrame < old.nframes:
            link = old.frames[shape.parentFrame]
            frame = new.getFrameId(link.name, link.type)
        if frame >= new.nframes:
            frame = new.getFrameId(new.names[shape.parentJoint], pin.FrameType.JOINT) if shape.parentJoint else 0
        shape.parentFrame = frame


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
    urdf = read_urdf(path)
    model, mimics, remarks = build_model(urdf), urdf.mimics, urdf.remarks
    if urdf.root is None:
        remarks = (*remarks, f"{urdf.fault}; varpin has it as Pinocchio's parser, which is more lenient, reads it")
        mimics = _mimics_of(build_model(urdf, mimic=True))
    ties: tuple[Tie, ...] = ()
    if mimic:
        ties = ties_of(mimics, model)
        order = depth_first(model, ties)
        if order != sorted(order):
            model, ties = reordered(model, ties, order)
    return Description(name, model, ties, path, (*folders, str(path.parent)), inertials=urdf.inertials, remarks=remarks)


def _mimics_of(model: pin.Model) -> dict[str, Mimic]:
    """The mimic joints of a model by name."""
    free, ties = untied_model(model)
    return {free.names[tie.follower]: Mimic(free.names[tie.leader], tie.ratio, tie.offset) for tie in ties}
