"""Mimic joints: leaders and followers, and Pinocchio models with and without the ties between them.

Pinocchio computes no RNEA derivatives of a model with mimic joints. varpin therefore keeps two models: one in which
followers are tied to their leaders, and a free one in which every joint is independent.
"""

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from varpin.errors import RobotError
from varpin.model.urdf import Mimic

logger = logging.getLogger(__name__)

# Attributes of a pin.Model with one number for each degree of freedom.
JOINT_PARAMETERS = (
    "lowerVelocityLimit",
    "upperVelocityLimit",
    "lowerEffortLimit",
    "upperEffortLimit",
    "lowerDryFrictionLimit",
    "upperDryFrictionLimit",
    "armature",
    "rotorInertia",
    "rotorGearRatio",
    "damping",
)


@dataclass(frozen=True)
class Tie:
    """Joint ``follower`` is at ratio * (position of joint ``leader``) + offset. Joints are Pinocchio indices."""

    follower: int
    leader: int
    ratio: float
    offset: float


def joint_index(model: pin.Model) -> dict[str, int]:
    """Index of each joint by name, without the universe."""
    return {name: i for i, name in enumerate(model.names) if i > 0}


def ties_of(mimics: Mapping[str, Mimic], model: pin.Model) -> tuple[Tie, ...]:
    """The ties of a URDF's mimic elements.

    A follower whose leader is not in the robot stays free, with a warning in the log: some published models
    name leaders that do not exist. Where a leader is itself a follower, the tie is to the leader of that one.

    Raises:
        RobotError: Joints follow each other in a loop.
    """
    index = joint_index(model)
    ties: dict[int, Tie] = {}
    for name, mimic in mimics.items():
        if name not in index:
            continue
        if mimic.leader not in index:
            logger.warning(
                "joint %r mimics %r, which is not a moving joint of the robot: it stays free", name, mimic.leader
            )
            continue
        ties[index[name]] = Tie(index[name], index[mimic.leader], mimic.ratio, mimic.offset)
    return tuple(_to_free_leader(tie, ties, model) for tie in ties.values())


def _to_free_leader(tie: Tie, ties: dict[int, Tie], model: pin.Model) -> Tie:
    """The tie to the free joint at the end of the chain of leaders."""
    for _ in range(len(ties) + 1):
        if tie.leader not in ties:
            _require_usable(tie, model)
            return tie
        after = ties[tie.leader]
        tie = Tie(tie.follower, after.leader, tie.ratio * after.ratio, tie.ratio * after.offset + tie.offset)
    raise RobotError(f"joint {model.names[tie.follower]!r} mimics itself through a loop of mimic joints")


def _require_usable(tie: Tie, model: pin.Model) -> None:
    """Refuse a tie whose offset, or squared ratio (the factor of inertias), is not finite."""
    if math.isfinite(tie.ratio * tie.ratio) and math.isfinite(tie.offset):
        return
    raise RobotError(
        f"joint {model.names[tie.follower]!r} mimics {model.names[tie.leader]!r} with multiplier {tie.ratio:g} and "
        f"offset {tie.offset:g}: the offset and the square of the multiplier must be finite"
    )


def tied_model(model: pin.Model, ties: Sequence[Tie]) -> pin.Model:
    """``model`` with its followers as Pinocchio mimic joints."""
    for tie in ties:
        model = pin.transformJointIntoMimic(model, tie.leader, tie.follower, tie.ratio, tie.offset)
    return model


def depth_first(model: pin.Model, ties: Sequence[Tie]) -> list[int]:
    """An order of the joints that Pinocchio's algorithms accept: subtrees contiguous, leaders before followers.

    The given order is kept where it qualifies.

    Raises:
        RobotError: A follower carries its own leader, or each of two branches follows the other.
    """
    parents = list(model.parents)

    def ancestors(joint: int) -> list[int]:
        path = [joint]
        while path[-1] > 0:
            path.append(parents[path[-1]])
        return path

    before: dict[int, set[int]] = {}
    for tie in ties:
        leaders, followers = ancestors(tie.leader), ancestors(tie.follower)
        if tie.follower in leaders:
            raise RobotError(
                f"joint {model.names[tie.follower]!r} carries the joint it mimics, {model.names[tie.leader]!r}: "
                "Pinocchio cannot tie them; load with mimic='free' and lock one of them"
            )
        if tie.leader in followers:
            continue
        fork = next(joint for joint in leaders if joint in followers)
        first, then = leaders[leaders.index(fork) - 1], followers[followers.index(fork) - 1]
        before.setdefault(then, set()).add(first)

    children: list[list[int]] = [[] for _ in parents]
    for joint in range(1, model.njoints):
        children[parents[joint]].append(joint)
    order, stack = [], [0]
    while stack:
        order.append(joint := stack.pop())
        waiting, visits = children[joint], []
        while waiting:
            ready = [child for child in waiting if not before.get(child, set()) & set(waiting)]
            if not ready:
                raise RobotError(f"mimic joints below {model.names[joint]!r} follow each other across branches")
            waiting.remove(ready[0])
            visits.append(ready[0])
        stack.extend(reversed(visits))
    return order[1:]


def reordered(model: pin.Model, ties: Sequence[Tie], order: Sequence[int]) -> tuple[pin.Model, tuple[Tie, ...]]:
    """``model`` and ``ties`` with the joints in another order."""
    new_index = {joint: k + 1 for k, joint in enumerate(order)}
    new_ties = tuple(Tie(new_index[tie.follower], new_index[tie.leader], tie.ratio, tie.offset) for tie in ties)
    return rebuild(model, order, lambda joint: model.joints[joint]), new_ties


def untied_model(model: pin.Model) -> tuple[pin.Model, tuple[Tie, ...]]:
    """``model`` without mimic joints, and the ties that it had."""
    ties = []
    mimics = [j for j in range(1, model.njoints) if model.joints[j].nv == 0 and "Mimic" in model.joints[j].shortname()]
    if not mimics:
        return model, ()
    leaders = dict(zip(model.mimicking_joints, model.mimicked_joints, strict=True))

    def free_joint(joint: int) -> pin.JointModel:
        if joint not in mimics:
            return model.joints[joint]
        follower = model.joints[joint].extract()
        if follower.scaling == 0.0:
            raise RobotError(
                f"joint {model.names[joint]!r} mimics {model.names[leaders[joint]]!r} with multiplier 0, for which "
                "Pinocchio keeps no axis: make it a fixed joint, or load the URDF file by path"
            )
        data = model.joints[joint].createData()
        model.joints[joint].calc(data, pin.neutral(model))
        subspace = np.asarray(data.S, dtype=float).reshape(6)
        slides = bool(subspace[:3].any())
        axis = (subspace[:3] if slides else subspace[3:]) / follower.scaling
        tie = Tie(joint, leaders[joint], float(follower.scaling), float(follower.offset))
        _require_usable(tie, model)
        ties.append(tie)
        return pin.JointModelPrismaticUnaligned(axis) if slides else pin.JointModelRevoluteUnaligned(axis)

    return rebuild(model, range(1, model.njoints), free_joint), tuple(ties)


def joint_frames(model: pin.Model) -> list[int]:
    """Indices of the frames of joints: of type JOINT, with the name of their joint."""
    return [
        index
        for index, frame in enumerate(model.frames)
        if frame.parentJoint and frame.type == pin.FrameType.JOINT and frame.name == model.names[frame.parentJoint]
    ]


def rebuild(
    model: pin.Model,
    order: Sequence[int],
    joint_of: Callable[[int], pin.JointModel],
    root: Sequence[tuple[str, pin.JointModel]] = (),
    onto: pin.Model | None = None,
    prefix: str = "",
) -> pin.Model:
    """``model`` rebuilt with its joints in another order or of another kind.

    Links, frames, limits and armature are kept.

    Args:
        model: The model.
        order: Its joints in the new order, without the universe.
        joint_of: The new joint model of each joint.
        root: Names and models of joints to insert in series between the universe and the model's root joints.
        onto: A model to append to, after its joints; a new one if left out.
        prefix: Prefix of the names of joints and frames.
    """
    new = pin.Model() if onto is None else onto
    if onto is None:
        new.name = model.name
        new.gravity = model.gravity
    new_index = {0: 0}
    for name, kind in root:
        new_index[0] = new.addJoint(new_index[0], kind, pin.SE3.Identity(), name)
    new.appendBodyToJoint(new_index[0], model.inertias[0], pin.SE3.Identity())
    for joint in order:
        source = joint_of(joint)
        new_index[joint] = new.addJoint(
            new_index[model.parents[joint]], source, model.jointPlacements[joint], prefix + model.names[joint]
        )
        new.appendBodyToJoint(new_index[joint], model.inertias[joint], pin.SE3.Identity())
        old, copy = model.joints[joint], new.joints[new_index[joint]]
        if old.nq == copy.nq:
            for limits in ("lowerPositionLimit", "upperPositionLimit"):
                getattr(new, limits)[copy.idx_q : copy.idx_q + copy.nq] = getattr(model, limits)[
                    old.idx_q : old.idx_q + old.nq
                ]
        if old.nv == copy.nv:
            for limits in JOINT_PARAMETERS:
                getattr(new, limits)[copy.idx_v : copy.idx_v + copy.nv] = getattr(model, limits)[
                    old.idx_v : old.idx_v + old.nv
                ]
    # Joint frames first: pin.buildReducedModel looks for a frame's joint among the preceding frames.
    old_frames = {model.frames[index].parentJoint: index for index in joint_frames(model)}
    new_frames, frames = {0: 0}, {0: 0}
    for joint in range(1, len(root) + 1):
        new_frames[0] = frames[0] = new.addJointFrame(joint, new_frames[0])
    for joint in order:
        new_frames[joint] = new.addJointFrame(new_index[joint], new_frames[model.parents[joint]])
        if joint in old_frames:
            frames[old_frames[joint]] = new_frames[joint]
    for index, frame in enumerate(model.frames):
        if index not in frames:
            frames[index] = new.addFrame(
                pin.Frame(
                    prefix + frame.name,
                    new_index[frame.parentJoint],
                    frames.get(frame.parentFrame, frames[0]),
                    frame.placement,
                    frame.type,
                    pin.Inertia.Zero(),
                ),
                False,
            )
    repair_velocity_limits(new)
    return new


def repair_velocity_limits(model: pin.Model) -> None:
    """Replace a lower velocity limit above the upper one by -upper.

    Pinocchio's addJoint sets the lower limit to the largest double with the wrong sign, and its buildReducedModel then
    rejects the model.
    """
    lower, upper = np.array(model.lowerVelocityLimit), np.array(model.upperVelocityLimit)
    model.lowerVelocityLimit = np.where(lower > upper, -upper, lower)
