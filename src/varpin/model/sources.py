"""Sources of robots: files, bundled robots, example-robot-data, robot_descriptions, models in memory."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from varpin.errors import FileError, InputError, RobotError, RobotNotFound
from varpin.model import example_robot_data, robot_descriptions
from varpin.model.equalities import Closure, Equality
from varpin.model.mimic import JOINT_PARAMETERS, Tie, depth_first, joint_frames, of_mimics, rebuild, ties_of
from varpin.model.mjcf import is_mjcf, read_mjcf, root_tag
from varpin.model.packages import Packages
from varpin.model.srdf import Posture, beside, read_postures, read_rotors, reference_postures
from varpin.model.urdf import Inertial, read_urdf
from varpin.model.xacro import expand, is_xacro, plain_name

logger = logging.getLogger(__name__)

# Suffixes of robots' files.
_SUFFIXES = (".urdf", ".xacro", ".xml", ".mjcf")


@dataclass(frozen=True)
class Description:
    """A robot as its source describes it, before joints are locked.

    Attributes:
        name: Name of the file, the bundled robot or the model.
        model: The model without mimic joints.
        ties: Mimic joints.
        urdf: The URDF or xacro file, if there is one.
        expanded: The URDF text of a xacro file.
        mjcf: The MJCF file, if there is one.
        package_dirs: Folders in which ``package://`` paths are looked up.
        visuals: Geometry of a RobotWrapper.
        inertials: Inertias of the links of a URDF, which the model merges into bodies.
        remarks: What the source leaves out, in words.
        faults: What its masses lack, in words.
        postures: Postures of the joints of ``model``.
        loops: Pairs of frames that the source closes to loops, and the tree leaves open.
        equalities: Equality constraints of the source.
    """

    name: str
    model: pin.Model
    ties: tuple[Tie, ...] = ()
    urdf: Path | None = None
    expanded: str | None = field(default=None, repr=False)
    mjcf: Path | None = None
    package_dirs: tuple[str, ...] = ()
    visuals: pin.GeometryModel | None = None
    inertials: tuple[Inertial, ...] = ()
    remarks: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()
    postures: tuple[Posture, ...] = ()
    loops: tuple[tuple[str, str], ...] = ()
    equalities: tuple[Equality, ...] = ()

    def rebuilt(self, **changes: Any) -> Description:
        """The robot with its model rebuilt; see :func:`varpin.model.mimic.rebuild`."""
        new = rebuild(self.model, **changes)
        return replace(self, model=new.model, ties=new.ties(self.ties), visuals=new.shapes(self.visuals))


def models_dir() -> Path:
    """The folder of the bundled robots: in the wheel, or at the top of a source tree."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "models", package.parents[1] / "models"):
        if (folder / "SOURCES.md").is_file():
            return folder
    raise FileError(f"varpin's bundled models are missing beside {package}")


def bundled_robots() -> dict[str, Path]:
    """Files of the robots bundled with varpin, by name."""
    return {path.stem: path for path in sorted(models_dir().glob("*.urdf"))}


def robot_names() -> tuple[str, ...]:
    """The names that :func:`varpin.load_robot` takes: varpin's own robots, then those of example-robot-data.

    The latter are the fixed-base robots in the installed version of example-robot-data, if it is installed.
    """
    return (*bundled_robots(), *example_robot_data.installed())


@dataclass(frozen=True)
class _Request:
    """What a source is read with: options of :func:`varpin.load_robot`, and folders of packages by name.

    Attributes:
        folders: Folders in which packages are looked up.
        xacro_args: Arguments of a xacro file.
        mimic: Whether mimic joints follow their leaders.
        srdf: The SRDF file or its xacro file; None to take the one beside the robot's file.
        srdf_args: Arguments of that xacro file.
        packages: Folders of packages by name.
    """

    folders: tuple[str, ...]
    xacro_args: Mapping[str, object]
    mimic: bool
    srdf: Path | None
    srdf_args: Mapping[str, object]
    packages: Mapping[str, str] = field(default_factory=dict)


def describe(
    source: object,
    package_dirs: Sequence[str | os.PathLike[str]] | None,
    *,
    mimic: bool,
    xacro_args: Mapping[str, object] | None = None,
    srdf: str | os.PathLike[str] | None = None,
) -> Description:
    """Find and parse ``source``; see :func:`varpin.load_robot`."""
    if xacro_args is not None and not isinstance(xacro_args, Mapping):
        raise InputError(f"xacro_args must be a mapping of names to values, got {xacro_args!r}")
    if not (srdf is None or isinstance(srdf, str | os.PathLike)):
        raise InputError(f"srdf must be the path of a file, got {type(srdf).__name__}")
    file, arguments = None if srdf is None else Path(srdf).expanduser(), xacro_args or {}
    request = _Request(_folders(package_dirs), arguments, mimic, file, arguments)
    if isinstance(source, pin.Model):
        description = _of_model(source, source.name or "model", None)
    elif isinstance(source, pin.RobotWrapper):
        description = _of_model(source.model, source.model.name or "robot", source.visual_model)
    elif isinstance(source, str | os.PathLike):
        description, request = _of_text(source, request)
    else:
        raise InputError(
            "source must be a URDF path, a robot's name, a pin.Model or a pin.RobotWrapper, "
            f"got {type(source).__name__}"
        )
    if xacro_args and (description.urdf is None or description.expanded is None):
        raise InputError(f"xacro_args need a xacro file; {description.name!r} does not come from one")
    return _with_srdf(description, request)


def _of_text(source: str | os.PathLike[str], request: _Request) -> tuple[Description, _Request]:
    """The robot of a path or a name, and the request with what a package adds to it."""
    text = os.fspath(source)
    if text.lstrip("\ufeff \t\r\n").startswith("<"):
        raise InputError(
            "source is the text of a file, not its path: write it to a file, or give pin.buildModelFromXML(text)"
        )
    path = Path(text).expanduser()
    is_path = isinstance(source, os.PathLike) or path.suffix or os.sep in text
    if is_path and _is_file(path):
        return _of_file(path.resolve(), plain_name(path), request), request
    bundled = bundled_robots()
    if text in bundled:
        return _of_urdf(bundled[text], text, request), request
    if text in example_robot_data.FIXED_BASE:
        urdf = example_robot_data.locate(example_robot_data.FIXED_BASE[text])
        request = replace(request, folders=(*request.folders, str(example_robot_data.package_dir(urdf))))
        if request.srdf is None and text in example_robot_data.SRDF:
            request = replace(request, srdf=example_robot_data.locate(example_robot_data.SRDF[text]))
        return _of_urdf(urdf, text, request), request
    if text in example_robot_data.FLOATING_BASE:
        raise RobotError(
            f"{text!r} has a free-flyer base in example-robot-data, and varpin models fixed bases; "
            "to pin its base to the world, load its URDF file by path"
        )
    downloadable = robot_descriptions.names()
    if text in downloadable or (not downloadable and not is_path and text.endswith(robot_descriptions.SUFFIX)):
        found = robot_descriptions.download(text)
        request = replace(
            request,
            folders=(*request.folders, *found.package_dirs),
            xacro_args={**found.xacro_args, **request.xacro_args},
            packages=found.packages,
        )
        if request.srdf is None and found.srdf is not None:
            request = replace(request, srdf=found.srdf, srdf_args={**found.srdf_args, **request.srdf_args})
        return _of_file(found.path, text, request), request
    if is_path and path.is_dir():
        raise RobotError(f"{path} is a folder, not a URDF file; it contains {_urdf_files(path)}")
    if is_path:
        folder = path.absolute().parent
        if not folder.is_dir():
            raise RobotNotFound(text, (), f": there is no folder {folder}")
        there = [file.name for file in folder.iterdir() if file.suffix in _SUFFIXES]
        raise RobotNotFound(path.name, there, f" in the folder {folder}")
    # Without the package its names are unknown.
    more = "" if downloadable else robot_descriptions.INSTALL
    raise RobotNotFound(text, [*bundled, *example_robot_data.installed(), *downloadable], more=more)


def _folders(package_dirs: Sequence[str | os.PathLike[str]] | str | os.PathLike[str] | None) -> tuple[str, ...]:
    if isinstance(package_dirs, str | os.PathLike):
        package_dirs = [package_dirs]
    try:
        return tuple(str(Path(folder).expanduser()) for folder in package_dirs or ())
    except (TypeError, RuntimeError):
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
    # Copies, so that later changes of the user's model do not change the robot.
    shapes = visuals.copy() if visuals is not None else None
    for shape in shapes.geometryObjects if shapes is not None else ():
        if shape.parentJoint >= model.njoints:
            raise RobotError(
                f"shape {shape.name!r} has the parent joint {shape.parentJoint}, which model {name!r} does not have"
            )
    ties, kinds = of_mimics(model)
    description = Description(name, model.copy(), ties, visuals=shapes, postures=reference_postures(model))
    order = depth_first(model, ties)
    if kinds or order != sorted(order) or len(joint_frames(model)) < model.njoints - 1:
        description = description.rebuilt(order=order, kinds=kinds)
    if order != sorted(order):
        # Pinocchio accepts joints in any order, but then computes a wrong mass matrix silently.
        logger.warning(
            "the joints of model %r were not added subtree by subtree, as Pinocchio's algorithms need: reordered to %s",
            name,
            ", ".join(list(description.model.names)[1:]),
        )
    frames = description.model.frames
    for shape in shapes.geometryObjects if (shapes := description.visuals) is not None else ():
        # Where a shape has no frame of its joint, it has the joint's.
        if shape.parentFrame >= len(frames) or frames[shape.parentFrame].parentJoint != shape.parentJoint:
            joint = description.model.names[shape.parentJoint]
            shape.parentFrame = description.model.getFrameId(joint, pin.FrameType.JOINT) if shape.parentJoint else 0
    return description


def _check_model(model: pin.Model, name: str) -> None:
    """Refuse an inconsistent model: Pinocchio's algorithms do not check it, and crash the process.

    Raises:
        RobotError: The model is inconsistent; the message names the attribute.
    """
    n, nq, nv = model.njoints, model.nq, model.nv
    sizes = dict.fromkeys(("joints", "names", "parents", "inertias", "jointPlacements"), n)
    sizes |= dict.fromkeys(("lowerPositionLimit", "upperPositionLimit"), nq)
    sizes |= dict.fromkeys(JOINT_PARAMETERS, nv)
    for part, size in sizes.items():
        if (found := len(getattr(model, part))) != size:
            raise RobotError(f"model {name!r} is damaged: its {part} has {found} entries instead of {size}")
    for joint, parent in enumerate(model.parents):
        if joint and parent >= joint:
            raise RobotError(f"model {name!r} is damaged: joint {model.names[joint]!r} comes before its parent")
    for frame in model.frames:
        if frame.parentJoint >= n or frame.parentFrame >= model.nframes:
            raise RobotError(f"model {name!r} is damaged: the parent of frame {frame.name!r} does not exist")


def _of_file(path: Path, name: str, request: _Request) -> Description:
    if is_xacro(path):
        places = _places(path, request.folders)
        return _of_urdf(path, name, request, expand(path, request.xacro_args, places, request.packages))
    if is_mjcf(path):
        return _of_mjcf(path, name)
    if path.suffix == ".sdf" or (path.suffix in (".xml", ".world") and root_tag(path) == "sdf"):
        raise RobotError(
            f"{path} is an SDF file, which Pinocchio's package on PyPI cannot read; convert it to a URDF or an MJCF"
        )
    return _of_urdf(path, name, request)


def _of_mjcf(path: Path, name: str) -> Description:
    model, remarks, equalities = read_mjcf(path)
    loops = tuple((each.a.body, each.b.body) for each in equalities if isinstance(each, Closure))
    return replace(_of_model(model, name, None), mjcf=path, remarks=remarks, loops=loops, equalities=equalities)


def _places(path: Path, folders: tuple[str, ...]) -> tuple[str, ...]:
    """Folders in which the packages of a file are looked up: ``folders``, those of its enclosing packages, its own."""
    around = (str(package.parent) for package in Packages(path).around.values())
    return tuple(dict.fromkeys((*folders, *around, str(path.parent))))


def _of_urdf(path: Path, name: str, request: _Request, expanded: str | None = None) -> Description:
    urdf = read_urdf(path, expanded)
    for note in urdf.notes:
        logger.info("robot %r: %s", name, note)
    description = Description(
        name=name,
        model=urdf.model,
        ties=ties_of(urdf.mimics, urdf.model) if request.mimic else (),
        urdf=path,
        expanded=expanded,
        package_dirs=_places(path, request.folders),
        inertials=urdf.inertials,
        remarks=urdf.remarks + urdf.unlimited,
        faults=urdf.faults,
        loops=urdf.loops,
    )
    order = depth_first(urdf.model, description.ties)
    return description if order == sorted(order) else description.rebuilt(order=order)


def _with_srdf(description: Description, request: _Request) -> Description:
    """The postures and rotors of the SRDF file that was asked for, or of the one beside the robot's file."""
    path = request.srdf
    if path is None and description.urdf is not None:
        path = beside(description.urdf, description.model.name)
    if path is None:
        return description
    try:
        text = None
        if is_xacro(path):
            # It need not take all of the robot's arguments.
            places = _places(path, request.folders)
            text = expand(path, request.srdf_args, places, request.packages, strict=False)
        postures, rotors = read_postures(path, text), read_rotors(path, text)
    except (RobotError, FileError) as error:
        if request.srdf is not None:
            raise
        return replace(description, remarks=(*description.remarks, f"the robot has no postures: {error}"))
    _add_rotors(description.model, rotors)
    return replace(description, postures=postures)


def _add_rotors(model: pin.Model, armature: Mapping[str, float]) -> None:
    """Set the armature of joints by name [kg m^2 or kg]; names of no joint are ignored."""
    values = np.array(model.armature)
    for joint in range(1, model.njoints):
        if model.names[joint] in armature:
            values[model.joints[joint].idx_v] = armature[model.names[joint]]
    model.armature = values
