"""Planar chains of rods, the usual benchmark mechanisms."""

import numpy as np
import pinocchio as pin

from varpin.model.loading import load_robot
from varpin.model.robot import Robot
from varpin.support.checks import count, positive


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
    across = mass * length**2 / 12.0
    rod = pin.Inertia(mass, np.array([0.5 * length, 0.0, 0.0]), np.diag([0.0, across, across]))
    model, joint = pin.Model(), 0
    model.name = f"chain{links}"
    placement, end = pin.SE3.Identity(), pin.SE3(np.eye(3), np.array([length, 0.0, 0.0]))
    for k in range(links):
        joint = model.addJoint(joint, pin.JointModelRY(), placement, f"joint{k + 1}")
        model.appendBodyToJoint(joint, rod, pin.SE3.Identity())
        placement = end
    model.addFrame(pin.Frame("tip", joint, 0, end, pin.FrameType.OP_FRAME))
    return load_robot(model)
