"""Planar chains of rods, the usual benchmark mechanisms."""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from varpin.errors import InputError
from varpin.model.loading import load_robot
from varpin.model.robot import Robot
from varpin.support.checks import count, finite_array, positive


def planar_chain(links: int, *, length: float = 1.0, mass: float = 1.0) -> Robot:
    """A chain of uniform slender rods on parallel revolute joints, in the vertical x-z plane.

    At q = 0 the chain is stretched out along x; with gravity along -z it falls. Angles are relative to the previous
    link and turn about +y, so a positive angle points down.

    Args:
        links: Number of links and joints.
        length: Length of each link [m].
        mass: Mass of each link [kg]; the rod's inertia is m l^2 / 12 about its middle.

    Raises:
        InputError: ``links`` < 1, or ``length`` or ``mass`` not positive and finite.
    """
    links = count("links", links, 1)
    length, mass = positive("length", length, "m"), positive("mass", mass, "kg")
    return rod_chain([length] * links, [mass] * links)


def rod_chain(
    lengths: Sequence[float],
    masses: Sequence[float],
    *,
    base: Sequence[float] = (0.0, 0.0, 0.0),
    armature: float = 0.0,
    rail: float | None = None,
) -> Robot:
    """A chain like :func:`planar_chain` of rods of these lengths [m] and masses [kg], >= 0, from ``base`` (3,) [m] on.

    Every joint has an ``armature`` [kg m^2 or kg]; a carriage of mass ``rail`` [kg] slides along x and carries them.
    """
    links = count("number of lengths", len(lengths), 1)
    sizes, weights = finite_array("lengths", lengths, (links,)), finite_array("masses", masses, (links,))
    if (sizes < 0.0).any() or (weights < 0.0).any():
        raise InputError("lengths and masses must be >= 0")
    model = pin.Model()
    model.name = f"chain{links}"
    placement = pin.SE3(np.eye(3), finite_array("base", base, (3,)))
    joint = 0
    if rail is not None:
        joint = model.addJoint(joint, pin.JointModelPX(), placement, "rail")
        model.appendBodyToJoint(joint, pin.Inertia(rail, np.zeros(3), np.zeros((3, 3))), pin.SE3.Identity())
        placement = pin.SE3.Identity()
    for k, (length, mass) in enumerate(zip(sizes, weights, strict=True)):
        across = mass * length**2 / 12.0
        rod = pin.Inertia(mass, np.array([0.5 * length, 0.0, 0.0]), np.diag([0.0, across, across]))
        joint = model.addJoint(joint, pin.JointModelRY(), placement, f"joint{k + 1}")
        model.appendBodyToJoint(joint, rod, pin.SE3.Identity())
        placement = pin.SE3(np.eye(3), np.array([length, 0.0, 0.0]))
    model.armature = np.full(model.nv, armature)
    model.addFrame(pin.Frame("tip", joint, 0, placement, pin.FrameType.OP_FRAME))
    return load_robot(model)
