"""The compiled core at its border: what it computes of many rows, along directions, and what it refuses."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from oracles import slope
from refusals import refused
from test_border import of_mechanism

import varpin as vp
from varpin.core import (
    ExplicitMethod,
    ExplicitRollout,
    Mechanism,
    Outcome,
    Rollout,
    accelerations,
    linearize_explicit,
)
from varpin.core.arrays import ConstraintRows, new_nodes
from varpin.signals.commands import open_loop

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

    def jets(s):
        _, _, _, Lqq, A, M = scene.core.jet(q + s[0] * alpha, v + s[0] * beta)
        return np.stack([M, A, Lqq])

    expected = slope(jets, np.zeros(1), np.ones(1), 0.02)
    for ours, theirs in zip(scene.core.jets_along(q[None], v[None], alpha[None], beta[None]), expected, strict=True):
        assert np.abs(ours - theirs).max() <= 1e-9 * np.abs(theirs).max()


@pytest.mark.parametrize("integrator", [vp.Gauss(2), vp.Midpoint(), vp.RungeKutta4()], ids=repr)
@pytest.mark.parametrize("line", [False, True])
def test_paths_with_controls_of_their_own(integrator, line):
    """Each is the path alone, to the last bit."""
    scene, P, R = vp.Scene(vp.planar_chain(2), damping=0.1), 3, 2
    q, v, before = rng.normal(size=(3, P, 2))
    u, options = rng.normal(size=(P, R, 2)), {"hold": 4}
    if line:
        options["stage_times"] = np.array(integrator.stage_times or (0.5,))
    own = open_loop(u.reshape(-1, 2))._replace(own=R, before=before, **options)
    found = integrator.motions(scene, q, v, own, 0.01)
    for k in range(P):
        part = slice(k, k + 1)
        alone = open_loop(u[k])._replace(before=before[part], **options)
        expected = integrator.motions(scene, q[part], v[part], alone, 0.01)
        assert all(a[k].tobytes() == b[0].tobytes() for a, b in zip(found, expected, strict=True))
    with pytest.raises(ValueError, match="u has"):
        integrator.motions(scene, q, v, own._replace(u=own.u[1:].copy()), 0.01)


@pytest.mark.parametrize(
    ("field", "value", "facts"),
    [
        ("parent", [-1, 1], "parents"),
        ("coordinate", [0, 2], "coordinate"),
        ("group", [0, 3], "group"),
        ("mass", [1.0], ("mass", "1")),
        ("ends", [1], "block"),
        ("ends", [3], "blocks"),
        ("loads", [0], ("carried", "0", "1")),
    ],
)
def test_what_is_no_tree_is_refused(field, value, facts):
    own = of_mechanism(vp.Scene(vp.planar_chain(2)))
    own[field] = np.array(value, dtype=np.asarray(own[field]).dtype)
    with refused(ValueError, facts):
        Mechanism.make(**own)


def sliding():
    """A slider on a turning axis, a point mass: about the axis it has no inertia where it stands on it."""
    model = pin.Model()
    turns = model.addJoint(0, pin.JointModelRZ(), pin.SE3.Identity(), "turns")
    slides = model.addJoint(turns, pin.JointModelPX(), pin.SE3(np.eye(3), np.array([0.5, 0.0, 0.0])), "slides")
    model.appendBodyToJoint(slides, pin.Inertia(1.0, np.zeros(3), np.zeros((3, 3))), pin.SE3.Identity())
    return vp.Scene(vp.load_robot(model))


@pytest.mark.parametrize("method", ExplicitMethod)
def test_where_a_mass_matrix_is_singular(method):
    scene = sliding()
    at = np.array([[0.0, 1.0], [0.0, 2.0], [0.0, -0.5], [0.0, 1.0]])
    nothing = np.zeros_like(at)
    assert accelerations(scene.core, at, nothing, nothing)[-1] == 2
    assert linearize_explicit(scene.core, method, 1e-3, at, nothing, nothing[:, None])[-1] == 2
    nodes = new_nodes(4, 3, 2, 2)
    assert not ExplicitRollout.start(scene.core, method, at, nothing).first_nodes(nodes)
    ExplicitRollout.start(scene.core, method, at, nothing).roll(
        1e-3, open_loop(np.zeros((3, 2))), np.zeros((0, 0, 0)), np.zeros((0, 0, 2)), nodes
    )
    assert nodes.done.tolist() == [3, 3, 0, 3]
    assert nodes.ended.tolist() == [Outcome.solved, Outcome.solved, Outcome.singular, Outcome.solved]


@pytest.mark.parametrize(
    ("change", "error", "facts"),
    [
        ({"q": np.zeros((3, 4, 2))[:, :, ::-1]}, TypeError, "q"),
        ({"done": np.zeros(3, dtype=np.int32)}, TypeError, "done"),
        ({"hold": 0}, ValueError, "steps"),
        ({"gains": np.zeros((4, 2, 3))}, ValueError, "column"),
    ],
)
def test_what_no_rollout_takes_is_refused(change, error, facts):
    still, nothing = np.zeros((3, 2)), (np.zeros((0, 0, 0)), np.zeros((0, 0, 2)))
    commands, nodes = open_loop(np.zeros((4, 2))), new_nodes(3, 4, 2, 2)
    rollout = ExplicitRollout.start(vp.Scene(vp.planar_chain(2)).core, ExplicitMethod.euler, still, still)
    rollout.roll(1e-2, commands, *nothing, nodes)
    own, other = ({key: change[key] for key in change if hasattr(part, key)} for part in (commands, nodes))
    with refused(error, facts):
        rollout.roll(1e-2, commands._replace(**own), *nothing, nodes._replace(**other))


def test_matrices_beyond_the_range_of_indices_are_refused_before_there_is_room_for_them():
    """A chain of 50 000 joints has mass matrices of more than 2^31 numbers; what needs none of them runs."""
    n, link = 50_000, vp.planar_chain(1).tree
    own = {name: np.repeat(getattr(link, name), n, axis=0) for name in (
        "prismatic", "rotation", "translation", "mass", "center", "inertia", "ratio", "offset", "periodic", "armature",
        "group",
    )}  # fmt: skip
    own |= {"parent": np.arange(-1, n - 1), "coordinate": np.arange(n), "origin": np.repeat([1, 0], [1, n - 1])}
    own |= {"loads": np.zeros(0, dtype=np.int64), "carried": np.zeros((0, n), dtype=np.int64), "ends": np.array([n])}
    own |= {"actuation": np.zeros((n, 0)), "constant": np.zeros((n, 0)), "control": np.zeros((n, 0, 0))}
    own |= {"quadratic": np.zeros((n, 0)), "centers": np.zeros((n, 0))}
    own |= {"forces": [], "couplings": [], "constraints": ConstraintRows(), "custom": None}
    chain = Mechanism.make(**own, groups=1, gravity=np.zeros(3))
    still = np.zeros((1, n))
    step = (vp.Midpoint()._tableau(), 0.5, vp.Midpoint()._guards())
    assert Rollout(chain, *step, 1.0, 1).begin(still, still)
    with refused(ValueError, "matrix"):
        Rollout(chain, vp.Gauss(2)._tableau(), *step[1:], 1.0, 1)
    with refused(ValueError, "matrix"):
        chain.jet(still[0], still[0])
