"""Mimic joints, leaders and followers, which are independent in Pinocchio's model; and models rebuilt."""

import xml.etree.ElementTree as ET
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from varpin.errors import RobotError
from varpin.model.urdf import listed

# Attributes of a pin.Model with one number for each entry of a configuration.
POSITION_LIMITS = ("lowerPositionLimit", "upperPositionLimit")
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


def ties_of(root: ET.Element, model: pin.Model) -> tuple[tuple[Tie, ...], tuple[str, ...]]:
    """The ties of a URDF's mimic elements, and a remark on followers whose leaders are not there, which stay free.

    Where a leader is itself a follower, the tie is to the leader of that one. Pinocchio's parser has refused elements
    without a leader, and numbers that are none.
    """
    index = joint_index(model)
    ties: dict[int, Tie] = {}
    alone = []
    for joint in root.findall("joint[mimic]"):
        name, mimic = joint.get("name", ""), joint.findall("mimic")[0]
        leader = mimic.get("joint", "")
        if name in index and leader in index:
            numbers = float(mimic.get("multiplier", 1.0)), float(mimic.get("offset", 0.0))
            ties[index[name]] = Tie(index[name], index[leader], *numbers)
        elif name in index:
            alone.append(f"{name!r} of {leader!r}")
    remark = f"mimic joints whose leaders are no moving joints of the robot stay free: {listed(alone, 'joints')}"
    remarks = (remark,) if alone else ()
    return tuple(_to_free_leader(tie, ties, model) for tie in ties.values()), remarks


def _to_free_leader(tie: Tie, ties: dict[int, Tie], model: pin.Model) -> Tie:
    """The tie to the free joint at the end of the chain of leaders."""
    for _ in range(len(ties) + 1):
        if tie.leader not in ties:
            return tie
        after = ties[tie.leader]
        tie = Tie(tie.follower, after.leader, tie.ratio * after.ratio, tie.ratio * after.offset + tie.offset)
    raise RobotError(f"joint {model.names[tie.follower]!r} mimics itself through a loop of mimic joints")


def depth_first(model: pin.Model) -> list[int]:
    """The joints, subtree by subtree, as Pinocchio's algorithms need them."""
    children: list[list[int]] = [[] for _ in model.parents]
    for joint in range(model.njoints - 1, 0, -1):
        children[model.parents[joint]].append(joint)
    order, stack = [], [0]
    while stack:
        order.append(joint := stack.pop())
        stack += children[joint]
    return order[1:]


def of_mimics(model: pin.Model) -> tuple[tuple[Tie, ...], dict[int, pin.JointModel]]:
    """The ties of a model's mimic joints, and independent joints in their place."""
    ties, free = [], {}
    leaders = dict(zip(model.mimicking_joints, model.mimicked_joints, strict=True))
    for joint, leader in leaders.items():
        follower = model.joints[joint].extract()
        if follower.scaling == 0.0:
            raise RobotError(
                f"joint {model.names[joint]!r} mimics {model.names[leader]!r} with multiplier 0, for which "
                "Pinocchio keeps no axis: make it a fixed joint, or load the URDF file by path"
            )
        data = model.joints[joint].createData()
        model.joints[joint].calc(data, pin.neutral(model))
        subspace = np.asarray(data.S, dtype=float).reshape(6)
        slides = bool(subspace[:3].any())
        axis = (subspace[:3] if slides else subspace[3:]) / follower.scaling
        ties.append(Tie(joint, leader, float(follower.scaling), float(follower.offset)))
        free[joint] = pin.JointModelPrismaticUnaligned(axis) if slides else pin.JointModelRevoluteUnaligned(axis)
    return tuple(ties), free


def joint_frames(model: pin.Model) -> dict[int, int]:
    """The index of the frame of each joint that has one: of type JOINT, with the joint's name."""
    return {
        frame.parentJoint: index
        for index, frame in enumerate(model.frames)
        if frame.type == pin.FrameType.JOINT and frame.name == model.names[frame.parentJoint]
    }


@dataclass(frozen=True, eq=False)
class Rebuilt:
    """A model rebuilt from another one, by :func:`rebuild`."""

    model: pin.Model
    joints: Mapping[int, int]  # the joint of the new model that carries the bodies of each old joint
    places: Mapping[int, pin.SE3]  # of each old joint in that one
    frames: Mapping[int, int]  # the index in the new model of each old frame
    held: Collection[int]  # the old joints that are no joints of the new one

    def ties(self, ties: Sequence[Tie]) -> tuple[Tie, ...]:
        """Those of the ties whose joints are still there."""
        return tuple(
            Tie(self.joints[tie.follower], self.joints[tie.leader], tie.ratio, tie.offset)
            for tie in ties
            if tie.follower not in self.held
        )

    def shapes(self, shapes: pin.GeometryModel | None) -> pin.GeometryModel | None:
        """A copy of shapes of the old model, on the new one."""
        if shapes is None:
            return None
        hung = shapes.copy()
        for shape in hung.geometryObjects:
            shape.placement = self.places[shape.parentJoint] * shape.placement
            shape.parentFrame = self.frames.get(shape.parentFrame, shape.parentFrame)
            shape.parentJoint = self.joints[shape.parentJoint]
        return hung


def rebuild(
    model: pin.Model,
    *,
    order: Sequence[int] = (),  # of its joints, without the universe; as they are if left out
    kinds: Mapping[int, pin.JointModel] | None = None,  # joints of another kind
    held: Mapping[int, pin.SE3] | None = None,  # joints to fix, and their motion there
    root: Sequence[tuple[str, pin.JointModel]] = (),  # joints in series between the universe and the root joints
    place: pin.SE3 | None = None,  # of the model's universe; the identity if left out
    onto: pin.Model | None = None,  # a model to append to, after its joints; a new one if left out
    prefix: str = "",  # of the names of joints and frames
) -> Rebuilt:
    """Rebuild a model with other joints, or elsewhere. Links, frames, limits and armature are kept."""
    kinds, held, new = kinds or {}, held or {}, onto
    if new is None:
        new = pin.Model()
        new.name, new.gravity = model.name, model.gravity
    joints, places, frames = {0: 0}, {0: place or pin.SE3.Identity()}, {0: 0}
    for name, kind in root:
        joints[0] = new.addJoint(joints[0], kind, pin.SE3.Identity(), name)
        frames[0] = new.addJointFrame(joints[0], frames[0])
    new.appendBodyToJoint(joints[0], model.inertias[0], places[0])
    for joint in order or range(1, model.njoints):
        parent, old = model.parents[joint], model.joints[joint]
        joints[joint], places[joint] = joints[parent], places[parent] * model.jointPlacements[joint]
        if joint in held:
            places[joint] = places[joint] * held[joint]
        else:
            index = new.addJoint(joints[joint], kinds.get(joint, old), places[joint], prefix + model.names[joint])
            joints[joint], places[joint] = index, pin.SE3.Identity()
            copy = new.joints[index]
            for names, first, own, size in (
                (POSITION_LIMITS, copy.idx_q, old.idx_q, old.nq if old.nq == copy.nq else 0),
                (JOINT_PARAMETERS, copy.idx_v, old.idx_v, old.nv if old.nv == copy.nv else 0),
            ):
                for name in names:
                    getattr(new, name)[first : first + size] = getattr(model, name)[own : own + size]
        new.appendBodyToJoint(joints[joint], model.inertias[joint], places[joint])
    framed = joint_frames(model)
    missing: dict[int, int] = {}
    for joint, carrier in joints.items():
        if joint and joint not in framed and joint not in held:
            missing[joint] = new.addJointFrame(carrier, missing.get(model.parents[joint], frames[0]))
    for index, frame in list(enumerate(model.frames))[1:]:
        joint, kind = frame.parentJoint, frame.type
        if framed.get(joint) == index and joint in held:
            kind = pin.FrameType.FIXED_JOINT
        up = frames.get(frame.parentFrame, frames[0])
        placement = places[joint] * frame.placement
        copied = pin.Frame(prefix + frame.name, joints[joint], up, placement, kind, pin.Inertia.Zero())
        frames[index] = new.addFrame(copied, False)
    # Pinocchio's addJoint sets lower velocity limits to the largest double with the wrong sign.
    lower, upper = np.array(new.lowerVelocityLimit), np.array(new.upperVelocityLimit)
    new.lowerVelocityLimit = np.where(lower > upper, -upper, lower)
    return Rebuilt(new, joints, places, frames, held)
