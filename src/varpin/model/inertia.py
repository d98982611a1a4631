"""Checks of masses and inertias."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import pinocchio as pin

from varpin.arrays import Floats
from varpin.model.urdf import Inertial

# Relative tolerance of the triangle inequality. A thin plate satisfies it with equality, and misses it by about this
# much if its numbers are rounded.
TRIANGLE_TOLERANCE = 1e-3
# Below this squared radius of gyration [m^2], a link is a point mass and its moments are rounding errors.
POINT = 1e-12
# No link of an arm, or of a crane, weighs more [kg]; a link of 100 g whose mesh is in mm does, 1e9 times too much.
HEAVY = 1e6


def principal_moments(inertia: Floats) -> Floats:
    """Principal moments (3,), ascending [kg m^2], of an inertia (3, 3)."""
    return np.asarray(np.linalg.eigvalsh(inertia), dtype=np.float64)


def fault(link: str, mass: float, moments: Floats) -> tuple[str, str]:
    """The kind of fault of a link's mass [kg] or principal moments (3,), ascending [kg m^2], and a sentence about it.

    Both are empty if there is none.
    """
    if mass < 0.0:
        return "negative mass", f"link {link!r} has mass {mass:g} < 0 [kg]"
    if mass > HEAVY:
        return "heavy", f"link {link!r} has a mass of {mass:.3g} kg: are its sizes in millimetres?"
    if np.abs(moments).max() <= POINT * mass:
        return "", ""
    low, middle, high = moments
    shown = ", ".join(f"{moment:.3g}" for moment in moments)
    if low < -TRIANGLE_TOLERANCE * abs(high):
        return "non-physical inertia", (
            f"link {link!r} has a non-physical inertia: it is not positive definite (principal moments {shown} kg m^2)"
        )
    if high > (1.0 + TRIANGLE_TOLERANCE) * (low + middle):
        return "non-physical inertia", (
            f"link {link!r} has a non-physical inertia: its principal moments {shown} kg m^2 violate the "
            f"triangle inequality, {high:.3g} > {low:.3g} + {middle:.3g}"
        )
    return "", ""


def one_of_each(found: Iterable[tuple[str, str, str]]) -> Iterator[str]:
    """The first sentence of each kind, and which others it is true of."""
    kinds: dict[str, list[tuple[str, str]]] = {}
    for kind, name, sentence in found:
        if sentence:
            kinds.setdefault(kind, []).append((name, sentence))
    for (_, sentence), *others in kinds.values():
        names = ", ".join(repr(name) for name, _ in others[:2]) + (f", {len(others) - 2} more" if others[2:] else "")
        also = f"also {names}" if len(sentence) + len(names) < 230 else f"{len(others)} more"
        yield sentence + (f" ({also})" if others else "")


def faults(model: pin.Model, inertials: Iterable[Inertial]) -> Iterator[str]:
    """Faults of the inertias of a model's moving links, one sentence a kind."""
    links = {frame.name: frame.parentJoint for frame in model.frames if frame.type == pin.FrameType.BODY}
    found = [each for each in inertials if links.get(each.link, 0)] or inertials_of(model)
    return one_of_each(
        (kind, each.link, sentence)
        for each in found
        if np.isfinite(each.inertia).all()
        for kind, sentence in [fault(each.link, each.mass, principal_moments(each.inertia))]
    )


def inertials_of(model: pin.Model) -> list[Inertial]:
    """The bodies of a model's joints, with the name of their first link, or of the joint if it has no link."""
    links = {frame.parentJoint: frame.name for frame in reversed(model.frames) if frame.type == pin.FrameType.BODY}
    bodies = list(enumerate(model.inertias))[1:]
    return [Inertial(links.get(j, model.names[j]), x.mass, np.array(x.lever), np.array(x.inertia)) for j, x in bodies]
