"""The compiled core at its border: what it computes of many rows, along directions, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest

import varpin as vp
from varpin.core import Mechanism

rng = np.random.default_rng(3)
ROBOTS = ("finger", "ur5", "panda", "chain")


@pytest.fixture(scope="module", params=ROBOTS)
def scene(request):
    robot = vp.planar_chain(12) if request.param == "chain" else vp.load_robot(request.param)
    return vp.Scene(robot, gravity=(1.0, -2.0, -9.0), stiffness=0.3, rest=0.1)


def test_many_jets_are_those_of_each_row(scene):
    q, v = rng.normal(size=(2, 5, scene.robot.dof))
    M, A = scene.core.jets(q, v)
    for k in range(5):
        *_, own_A, own_M = scene.core.jet(q[k], v[k])
        assert np.array_equal(M[k], own_M)
        assert np.array_equal(A[k], own_A)


def test_the_jet_along_a_direction_is_its_difference(scene):
    q, v, alpha, beta = rng.normal(size=(4, scene.robot.dof))
    # Central differences of eighth order.
    step, weights = 0.02, {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}
    expected = np.zeros((3, len(q), len(q)))
    for k, c in weights.items():
        for sign in (1.0, -1.0):
            s = sign * k * step
            _, _, _, Lqq, A, M = scene.core.jet(q + s * alpha, v + s * beta)
            expected += sign * c / step * np.stack([M, A, Lqq])
    for ours, theirs in zip(scene.core.jets_along(q[None], v[None], alpha[None], beta[None]), expected, strict=True):
        assert np.abs(ours - theirs).max() <= 1e-9 * np.abs(theirs).max()


def test_arrays_of_a_wrong_shape_are_refused(scene):
    n = scene.robot.dof
    q = np.zeros(n)
    with pytest.raises(ValueError, match=f"v has size {n + 1} along axis 0, not {n}"):
        scene.core.jet(q, np.zeros(n + 1))
    with pytest.raises(ValueError, match="v has size 2 along axis 0, not 3"):
        scene.core.jets(np.zeros((3, n)), np.zeros((2, n)))
    with pytest.raises(TypeError):
        scene.core.jet(q, np.zeros((n, n)))


@pytest.mark.parametrize(
    ("field", "value", "match"),
    [
        ("parent", [-1, 1], "parents come before"),
        ("coordinate", [0, 2], "coordinate is out of range"),
        ("group", [0, 3], "group is out of range"),
        ("mass", [1.0], "mass has size 1"),
        ("ends", [1], "last block ends"),
        ("ends", [3], "ends of blocks"),
        ("loads", [0], "carried has size 0 along axis 0, not 1"),
    ],
)
def test_what_is_no_tree_is_refused(field, value, match):
    tree = vp.planar_chain(2).tree
    names = (
        "parent", "prismatic", "rotation", "translation", "mass", "center", "inertia", "coordinate", "ratio",
        "offset", "origin", "loads", "carried", "periodic", "armature", "group",
    )  # fmt: skip
    own = {name: getattr(tree, name) for name in names}
    own["ends"] = np.array(tree.ends)
    own[field] = np.array(value, dtype=own[field].dtype)
    own |= {name: np.zeros(2) for name in ("damping", "stiffness", "rest")}
    own |= {"actuation": np.eye(2), "constant": np.zeros((2, 0)), "control": np.zeros((2, 0, 2))}
    own |= {"quadratic": np.zeros((2, 0)), "centers": np.zeros((2, 0))}
    with pytest.raises(ValueError, match=match):
        Mechanism.make(**own, groups=tree.groups, gravity=np.zeros(3))
