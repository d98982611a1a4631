"""Robots from files and from models in memory."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pinocchio as pin

from varpin.errors import FileError, InputError, RobotError
from varpin.model.equalities import Closure
from varpin.model.mimic import JOINT_PARAMETERS, POSITION_LIMITS, depth_first, joint_frames, of_mimics, ties_of
from varpin.model.mjcf import is_mjcf, read_mjcf
from varpin.model.names import find
from varpin.model.packages import Files, Packages
from varpin.model.robot import Robot
from varpin.model.srdf import beside, read_srdf, reference_postures
from varpin.model.urdf import read_urdf
from varpin.model.xacro import expand, is_xacro
from varpin.support.checks import path_like, word

logger = logging.getLogger(__name__)


def describe(
    source: object,
    *,
    package_dirs: Sequence[str | os.PathLike[str]] | None,
    mimic: Literal["tied", "free"],
    xacro_args: Mapping[str, object] | None,
    srdf: str | os.PathLike[str] | None,
) -> Robot:
    """Find and parse ``source``; see :func:`varpin.load_robot`.

    Joints of any kind are there, and none is locked.
    """
    word("mimic", mimic, ("tied", "free"))
    if xacro_args is not None and not isinstance(xacro_args, Mapping):
        raise InputError(f"xacro_args must be a mapping of names to values, got {xacro_args!r}")
    arguments, path = xacro_args or {}, None if srdf is None else path_like("srdf", srdf)
    files = find(source) if isinstance(source, str | os.PathLike) else Files("", Path())
    files = replace(
        files,
        folders=(*_folders(package_dirs), *files.folders),
        xacro_args={**files.xacro_args, **arguments},
        srdf=path or files.srdf,
        srdf_args={**(files.srdf_args if path is None else {}), **arguments},
    )
    if isinstance(source, pin.Model | pin.RobotWrapper):
        model, shapes = (source, None) if isinstance(source, pin.Model) else (source.model, source.visual_model)
        try:
            robot = _of_model(model, model.name or "model", shapes)
        except RobotError:
            raise
        except (IndexError, ValueError, RuntimeError) as error:
            raise RobotError(f"model {model.name!r} is damaged: {error}") from None
    elif files.name:
        robot = _of_files(files, tied=mimic == "tied")
    else:
        raise InputError(
            "source must be a URDF path, a robot's name, a pin.Model or a pin.RobotWrapper, "
            f"got {type(source).__name__}"
        )
    if xacro_args and robot.expanded is None:
        raise InputError(f"xacro_args need a xacro file; {robot.name!r} does not come from one")
    return _with_srdf(robot if mimic == "tied" else robot.changed(ties=()), files)


def _folders(package_dirs: Sequence[str | os.PathLike[str]] | str | os.PathLike[str] | None) -> tuple[str, ...]:
    if isinstance(package_dirs, str | os.PathLike):
        package_dirs = [package_dirs]
    try:
        return tuple(str(Path(folder).expanduser()) for folder in (() if package_dirs is None else package_dirs))
    except (TypeError, RuntimeError):
        raise InputError(f"package_dirs must be a list of folders, got {package_dirs!r}") from None


def _of_model(model: pin.Model, name: str, visuals: pin.GeometryModel | None) -> Robot:
    _check_model(model, name)
    # Copies, so that later changes of the user's model do not change the robot.
    shapes = visuals.copy() if visuals is not None else None
    ties, kinds = of_mimics(model)
    robot = Robot(name, model.copy(), ties, visuals=shapes, group_states=reference_postures(model))
    order = depth_first(model)
    if kinds or order != sorted(order) or len(joint_frames(model)) < model.njoints - 1:
        robot = robot.rebuilt(order=order, kinds=kinds)
    if order != sorted(order):
        # Pinocchio accepts joints in any order, but then computes a wrong mass matrix silently.
        logger.warning(
            "the joints of model %r were not added subtree by subtree, as Pinocchio's algorithms need: reordered to %s",
            name,
            ", ".join(list(robot.model.names)[1:]),
        )
    frames = robot.model.frames
    for shape in shapes.geometryObjects if (shapes := robot.visuals) is not None else ():
        # Where a shape has no frame of its joint, it has the joint's.
        if shape.parentFrame >= len(frames) or frames[shape.parentFrame].parentJoint != shape.parentJoint:
            joint = robot.model.names[shape.parentJoint]
            shape.parentFrame = robot.model.getFrameId(joint, pin.FrameType.JOINT) if shape.parentJoint else 0
    return robot


def _check_model(model: pin.Model, name: str) -> None:
    """Refuse parameters of another size: Pinocchio's algorithms do not check it, and crash the process."""
    sizes = dict.fromkeys(POSITION_LIMITS, model.nq) | dict.fromkeys(JOINT_PARAMETERS, model.nv)
    for part, size in sizes.items():
        if (found := len(getattr(model, part))) != size:
            raise RobotError(f"model {name!r} is damaged: its {part} has {found} entries instead of {size}")


def _of_files(files: Files, *, tied: bool) -> Robot:
    path, text = files.path, None
    if is_xacro(path):
        text = expand(Packages(path, files.folders, files.packages), files.xacro_args)
    elif is_mjcf(path):
        model, remarks, equalities = read_mjcf(path)
        loops = tuple((each.a.body, each.b.body) for each in equalities if isinstance(each, Closure))
        robot = _of_model(model, files.name, None)
        return robot.changed(mjcf=path, remarks=remarks, loops=loops, equalities=equalities)
    urdf = read_urdf(path, text)
    ties, alone = ties_of(urdf.root, urdf.model) if tied else ((), ())
    return Robot(
        files.name,
        urdf.model,
        ties,
        urdf=path,
        expanded=text,
        package_dirs=files.folders,
        loops=urdf.loops,
        inertials=urdf.inertials,
        remarks=(*urdf.remarks, *alone),
        notes=urdf.notes,
        faults=urdf.faults,
    )


def _with_srdf(robot: Robot, files: Files) -> Robot:
    """The postures and rotors of the SRDF file that was asked for, or of the one beside the robot's file."""
    path, model = files.srdf, robot.model
    if path is None and robot.urdf is not None:
        path = beside(robot.urdf, model.name)
    states = robot.group_states
    if path is not None:
        try:
            text = None
            if is_xacro(path):
                # It need not take all of the robot's arguments.
                text = expand(Packages(path, files.folders, files.packages), files.srdf_args, strict=False)
            states, rotors = read_srdf(path, text)
        except (RobotError, FileError) as error:
            if files.srdf is not None:
                raise
            return robot.changed(remarks=(*robot.remarks, f"the robot has no postures: {error}"))
        values = np.array(model.armature)
        for name in rotors.keys() & set(model.names):
            values[model.joints[model.getJointId(name)].idx_v] = rotors[name]
        model.armature = values
    known = tuple(state for state in states if any(joint in model.names for joint, _ in state.positions))
    return robot.changed(group_states=known)
