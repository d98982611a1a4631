"""The numbers of a scene that motions depend on: a trajectory stores them, and is of a scene that has the same."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from varpin.arrays import Floats
from varpin.mechanics.forces import ELEMENTS, SUMMED

if TYPE_CHECKING:
    from varpin.mechanics.scene import Scene

# Arrays of the robot's tree and sums by joint among the values.
_OF_TREE = ("center", "inertia", "rotation", "translation", "ratio", "offset")
_OF_JOINTS = ("damping", "stiffness", "rest", "armature")


def values_of(scene: Scene) -> Mapping[str, Floats]:
    """See :attr:`Scene.values`."""
    values = {name: getattr(scene, name) for name in ("gravity", *_OF_JOINTS, "actuation")}
    values |= {name: getattr(scene.robot.tree, name) for name in _OF_TREE}
    rows: list[tuple[str, Sequence[float]]] = [
        (each.kind, (each.coordinate, *each.values)) for each in scene.elements if each.kind not in SUMMED
    ]
    rows += [(each.kind, (each.a, each.b, *each.values)) for each in scene.couplings]
    # Functions are stored as their number only.
    rows += [("functions", [len(scene.custom.parts)])] if scene.custom is not None else []
    constraints = scene.bound_constraints.rows
    for product in constraints.products:
        ends = (*constraints.vectors[product.x], *constraints.vectors[product.y])
        places = [number for end in ends for number in (end.body, float(end.direction), *end.place)]
        rows.append(("constraints.between", [product.factor, product.constant, *places]))
    rows += [("constraints.ties", (t.follower, t.leader, t.rate, *t.coefficients)) for t in constraints.ties]
    rows += [("constraints.custom", [own.rows]) for own in constraints.customs]
    values |= {kind: np.zeros((0, 0)) for kind in ELEMENTS if kind not in SUMMED} | _tables(rows)
    if scene.noise.diffusion is not None:
        fields = scene.noise.diffusion
        values |= {"noise.constant": fields.constant, "noise.control": np.linalg.norm(fields.control, axis=2)}
        values |= {"noise.quadratic": fields.quadratic, "noise.center": fields.center}
    return MappingProxyType(values)


def _tables(rows: Sequence[tuple[str, Sequence[float]]]) -> dict[str, Floats]:
    """Rows of numbers by name as one array for each name; zeros fill short rows."""
    tables = {}
    for name in dict.fromkeys(name for name, _ in rows):
        own = [row for each, row in rows if each == name]
        table = tables[name] = np.zeros((len(own), max(map(len, own))))
        for row, numbers in zip(table, own, strict=True):
            row[: len(numbers)] = numbers
    return tables


def same(one: Floats, other: Floats) -> bool:
    """Whether values of scenes agree up to rounding; versions of Pinocchio may read a robot differently by as much."""
    if one.shape != other.shape:
        return not (one.size or other.size)
    least = 1e-12 * max(float(np.abs(x[np.isfinite(x)]).max(initial=0.0)) for x in (one, other))
    return bool(np.isclose(one, other, rtol=1e-9, atol=least, equal_nan=True).all())


def differences(scene: Scene, values: Mapping[str, Floats], *, noise: bool) -> list[str]:
    """The names of the values in which a scene differs from :attr:`Scene.values`, with ``noise`` or without."""
    found, none = [], np.zeros(0)
    for name in dict.fromkeys((*values, *scene.values)) if values else ():
        before, now = values.get(name, none), scene.values.get(name, none)
        # A CustomNoise has no numbers.
        known = not name.startswith("noise.") or (noise and before.size and now.size)
        if known and not same(before, now):
            found.append(f"the robot's {name}" if name in _OF_TREE else name)
    return found
