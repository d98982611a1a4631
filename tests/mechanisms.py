"""Robots made up for tests: random trees in Pinocchio, and URDF texts put together from links and joints."""

from pathlib import Path

import numpy as np
import pinocchio as pin

import varpin as vp

INERTIAL = (
    '<inertial><origin xyz="0.02 0.05 0.1" rpy="0.3 0.2 0.1"/><mass value="1.3"/>'
    '<inertia ixx="0.02" iyy="0.03" izz="0.025" ixy="0.001" ixz="0.002" iyz="0.003"/></inertial>'
)
PLACE = 'xyz="0.1 0.02 0.2" rpy="0.1 0.2 0.3"'


def link(name: str, inertial: str = INERTIAL, extra: str = "") -> str:
    return f'<link name="{name}">{inertial}{extra}</link>\n'


def joint(
    name: str,
    parent: str,
    child: str,
    kind: str = "revolute",
    axis: str = "0 1 0",
    inside: str = "",
    place: str = PLACE,
) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><origin {place}/><parent link="{parent}"/>'
        f'<child link="{child}"/><axis xyz="{axis}"/><limit effort="9" velocity="8" lower="-1" upper="1"/>{inside}'
        "</joint>\n"
    )


def mimic(leader: str, ratio: object = 1, offset: object = 0) -> str:
    return f'<mimic joint="{leader}" multiplier="{ratio}" offset="{offset}"/>'


def write_urdf(folder: Path, *parts: str, name: str = "made_up", base: str = '<link name="base"/>') -> Path:
    path = folder / f"{name}.urdf"
    path.write_text(f'<?xml version="1.0"?>\n<robot name="{name}">\n{base}\n{"".join(parts)}</robot>\n')
    return path


def arm(folder: Path, inertial: str = INERTIAL, **joint_arguments: str) -> Path:
    """A robot of one joint ``j1`` that moves link ``l1``."""
    return write_urdf(folder, link("l1", inertial), joint("j1", "base", "l1", **joint_arguments))


def built(*bodies: tuple[pin.JointModel, list[float], pin.Inertia | None]) -> vp.Robot:
    """Joints in a row, joint0, joint1, ..., each with its place on the one before and the body that it moves."""
    model, joint = pin.Model(), 0
    for k, (kind, offset, inertia) in enumerate(bodies):
        joint = model.addJoint(joint, kind, pin.SE3(np.eye(3), np.array(offset, dtype=float)), f"joint{k}")
        model.appendBodyToJoint(joint, inertia or pin.Inertia.Zero(), pin.SE3.Identity())
    return vp.load_robot(model)


def slider(mass: float = 1.0) -> vp.Robot:
    """A mass on a rail along x, nothing else."""
    return built((pin.JointModelPX(), [0, 0, 0], pin.Inertia.FromSphere(mass, 0.1)))


def crank_and_slider() -> vp.Robot:
    """A crank of 0.3 m, a connecting rod of 1 m; and a block on rails along x."""
    model = pin.Model()
    model.name = "slider-crank"
    place, joint = pin.SE3.Identity(), 0
    for k, length in enumerate((0.3, 1.0)):
        joint = model.addJoint(joint, pin.JointModelRY(), place, f"joint{k}")
        rod = pin.Inertia(1.0, np.array([0.5 * length, 0.0, 0.0]), np.diag([0.0, 1.0, 1.0]) * length**2 / 12.0)
        model.appendBodyToJoint(joint, rod, pin.SE3.Identity())
        place = pin.SE3(np.eye(3), np.array([length, 0.0, 0.0]))
    model.addFrame(pin.Frame("tip", joint, 0, place, pin.FrameType.OP_FRAME))
    block = model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), "block")
    model.appendBodyToJoint(block, pin.Inertia(2.0, np.zeros(3), np.zeros((3, 3))), pin.SE3.Identity())
    model.addFrame(pin.Frame("pin", block, 0, pin.SE3.Identity(), pin.FrameType.OP_FRAME))
    return vp.load_robot(model)


def random_inertia(rng: np.random.Generator) -> pin.Inertia:
    """Mass, centre and inertia of a cloud of points, so that a body could have them."""
    points, masses = rng.normal(0.0, 0.1, (8, 3)), rng.uniform(0.05, 0.5, 8)
    center = masses @ points / masses.sum()
    r = points - center
    moments = np.einsum(
        "i,ijk->jk", masses, np.einsum("ij,ij->i", r, r)[:, None, None] * np.eye(3) - r[:, :, None] * r[:, None, :]
    )
    return pin.Inertia(masses.sum(), center, moments)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    return pin.Quaternion(rng.normal(size=4)).normalized().matrix()


def random_axis(rng: np.random.Generator) -> np.ndarray:
    axis = rng.normal(size=3)
    return axis / np.linalg.norm(axis)


def random_tree(
    seed: int, bodies: int = 7, *, branching: bool = True, armature: bool = True, ratio: float = 1.0
) -> pin.Model:
    """A tree of every one-axis joint Pinocchio can make in Python: all but continuous ones about oblique axes.

    The last body is ``ratio`` times as heavy as it would be, those before it by powers in between.
    """
    rng = np.random.default_rng(seed)
    aligned = [pin.JointModelRX, pin.JointModelRY, pin.JointModelRZ, pin.JointModelPX, pin.JointModelPY]
    aligned += [pin.JointModelPZ, pin.JointModelRUBX, pin.JointModelRUBY, pin.JointModelRUBZ]
    oblique = [pin.JointModelRevoluteUnaligned, pin.JointModelPrismaticUnaligned]
    model = pin.Model()
    model.name = f"tree{seed}"
    for k in range(bodies):
        parent = int(rng.integers(0, k + 1)) if branching else k
        if rng.random() < 0.5:
            kind = aligned[rng.integers(len(aligned))]()
        else:
            kind = oblique[rng.integers(len(oblique))](random_axis(rng))
        placement = pin.SE3(random_rotation(rng), rng.normal(0.0, 0.3, 3))
        new = model.addJoint(parent, kind, placement, f"joint{k}")
        weight = ratio ** (k / max(1, bodies - 1))
        body = random_inertia(rng)
        body = pin.Inertia(weight * body.mass, body.lever, weight * body.inertia)
        model.appendBodyToJoint(new, body, pin.SE3.Identity())
    if armature:
        model.armature = rng.uniform(0.0, 0.1, model.nv)
    return model


def rod_chain(lengths, masses, *, base=(0.0, 0.0, 0.0), armature=0.0, rail=None):
    """A chain like ``planar_chain`` of rods of these lengths [m] and masses [kg], from ``base`` (3,) [m] on.

    Every joint has an ``armature`` [kg m^2 or kg]; a carriage of mass ``rail`` [kg] slides along x and carries them.
    """
    model = pin.Model()
    model.name = f"chain{len(lengths)}"
    placement = pin.SE3(np.eye(3), np.array(base, dtype=float))
    joint = 0
    if rail is not None:
        joint = model.addJoint(joint, pin.JointModelPX(), placement, "rail")
        model.appendBodyToJoint(joint, pin.Inertia(rail, np.zeros(3), np.zeros((3, 3))), pin.SE3.Identity())
        placement = pin.SE3.Identity()
    for k, (length, mass) in enumerate(zip(lengths, masses, strict=True)):
        across = mass * length**2 / 12.0
        rod = pin.Inertia(mass, np.array([0.5 * length, 0.0, 0.0]), np.diag([0.0, across, across]))
        joint = model.addJoint(joint, pin.JointModelRY(), placement, f"joint{k + 1}")
        model.appendBodyToJoint(joint, rod, pin.SE3.Identity())
        placement = pin.SE3(np.eye(3), np.array([length, 0.0, 0.0]))
    model.armature = np.full(model.nv, armature)
    model.addFrame(pin.Frame("tip", joint, 0, placement, pin.FrameType.OP_FRAME))
    return vp.load_robot(model)
