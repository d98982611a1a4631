"""Inertias that no body can have."""

from collections.abc import Iterable, Iterator

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from varpin.model.urdf import Inertial

Floats = NDArray[np.float64]

# Rounded figures of a thin plate may miss the triangle inequality, which holds for it with equality, by this much.
TRIANGLE_TOLERANCE = 1e-3
# With a radius of gyration below a micrometre [m^2], a link is a point mass, and its moments are rounding.
POINT = 1e-12


def principal_moments(inertia: Floats) -> Floats:
    """Of an inertia (3, 3): (3,), ascending [kg m^2]."""
    return np.asarray(np.linalg.eigvalsh(inertia), dtype=np.float64)


def fault(link: str, mass: float, moments: Floats) -> str:
    """What is wrong with a link's mass [kg] or principal moments (3,), ascending [kg m^2]; empty if nothing is."""
    if mass < 0.0:
        return f"link {link!r} has mass {mass:g} < 0 [kg]"
    if np.abs(moments).max() <= POINT * mass:
        return ""
    low, middle, high = moments
    shown = ", ".join(f"{moment:.3g}" for moment in moments)
    if low < -TRIANGLE_TOLERANCE * abs(high):
        return (
            f"link {link!r} has a non-physical inertia: it is not positive definite (principal moments {shown} kg m^2)"
        )
    if high > (1.0 + TRIANGLE_TOLERANCE) * (low + middle):
        return (
            f"link {link!r} has a non-physical inertia: its principal moments {shown} kg m^2 violate the "
            f"triangle inequality, {high:.3g} > {low:.3g} + {middle:.3g}"
        )
    return ""


def faults(model: pin.Model, inertials: Iterable[Inertial]) -> Iterator[str]:
    """What is wrong with inertias of links that joints of a model move.

    Args:
        model: Every joint on its own.
        inertials: Of links of a URDF; without any, the bodies of the model are looked at.
    """
    links = {frame.name: frame.parentJoint for frame in model.frames if frame.type == pin.FrameType.BODY}
    if not (found := [(x.link, x.mass, x.inertia) for x in inertials if links.get(x.link, 0)]):
        names = {joint: name for name, joint in reversed(links.items())}
        bodies = [(names.get(j, model.names[j]), model.inertias[j]) for j in range(1, model.njoints)]
        found = [(name, body.mass, np.array(body.inertia)) for name, body in bodies]
    for name, mass, inertia in found:
        if np.isfinite(inertia).all() and (said := fault(name, mass, principal_moments(inertia))):
            yield said
