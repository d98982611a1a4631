"""The planar chain of equal links, the test bench of the field."""

import numpy as np
import pinocchio as pin

from varpin.checks import count, positive
from varpin.robot.model import Robot, load_robot


def planar_chain(links: int, *, length: float = 1.0, mass: float = 1.0) -> Robot:
    """A chain of uniform slender rods on parallel revolute joints, in the vertical x-z plane.

    At q = 0 it lies stretched out along x; with gravity along -z it falls. Angles are relative to the link before
    and turn about +y, so positive angles point down.

    Args:
        links: Number of links and joints.
        length: Of each link [m].
        mass: Of each link [kg]; the rod's inertia is m l^2 / 12 about its middle.

    Raises:
        InputError: ``links`` < 1, or ``length`` or ``mass`` not positive and finite.
    """
    links = count("links", links, 1)
    length, mass = positive("length", length, "m"), positive("mass", mass, "kg")
    model = pin.Model()
    model.name = f"chain{links}"
    across = mass * length**2 / 12.0
    rod = pin.Inertia(mass, np.array([0.5 * length, 0.0, 0.0]), np.diag([0.0, across, across]))
    joint = 0
    for k in range(links):
        placement = pin.SE3(np.eye(3), np.array([length if k else 0.0, 0.0, 0.0]))
        joint = model.addJoint(joint, pin.JointModelRY(), placement, f"joint{k + 1}")
        model.appendBodyToJoint(joint, rod, pin.SE3.Identity())
    tip = pin.SE3(np.eye(3), np.array([length, 0.0, 0.0]))
    model.addFrame(pin.Frame("tip", joint, 0, tip, pin.FrameType.OP_FRAME))
    return load_robot(model)
