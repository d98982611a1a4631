"""Costs that the core evaluates against the same in NumPy, term by term."""

from __future__ import annotations

import numpy as np
import pytest
from mechanisms import random_tree

import varpin as vp
from varpin.core import CostTerms, Subject, sample_steps
from varpin.costs import BoundSum, Points
from varpin.linearization import node_jets, velocity_at_nodes
from varpin.robot.kinematics import frame_kinematics, rotation_errors

N, CONTROLS = 7, 3


@pytest.fixture
def rng():
    return np.random.default_rng(5)


@pytest.fixture(params=["sliders and hinges", "finger"])
def robot(request, load):
    # The finger's last joint mimics the one before.
    return load("finger") if request.param == "finger" else vp.load_robot(random_tree(3, 5, branching=False))


@pytest.fixture
def frame(robot):
    return robot.end_effector if robot.name == "finger" else "joint4"


def spd(rng, size):
    root = rng.normal(size=(size, size))
    return root @ root.T


def points(robot):
    return Points(np.linspace(0.0, 0.6, N), 0.6, N - 1, robot.dof, CONTROLS)


def samples(rng, robot):
    return rng.normal(size=(N, robot.dof)), rng.normal(size=(N, robot.dof)), rng.normal(size=(N, CONTROLS))


def plain(residual, J, weight, columns, size):
    """Values, gradients and the Hessians of Gauss and Newton of weight . r^2, for r (N, r) and J (N, r, c)."""
    gradient, hessian = np.zeros((N, size)), np.zeros((N, size, size))
    gradient[:, columns] = 2.0 * np.einsum("Nrc,rs,Ns->Nc", J, weight, residual)
    hessian[:, columns, columns] = 2.0 * np.einsum("Nrc,rs,Nsd->Ncd", J, weight, J)
    return np.einsum("Nr,rs,Ns->N", residual, weight, residual), gradient, hessian


def terms(rng, robot, frame, q, v, u):
    """Costs, and what each is in NumPy."""
    n, size = robot.dof, 2 * robot.dof + CONTROLS
    kinematics = frame_kinematics(robot, frame)
    R, p, J = kinematics.jacobians(q)
    found = []

    def add(cost, weight, residual, derivative, columns):
        found.append((cost, plain(residual, derivative, weight, columns, size)))

    for block, y, width, begin in (("q", q, n, 0), ("v", v, n, n), ("u", u, CONTROLS, 2 * n)):
        W, reference = spd(rng, width), rng.normal(size=(N, width))
        cost = {"q": vp.TrackingCost, "v": vp.VelocityCost, "u": vp.ControlCost}[block]
        cost = cost(reference, W) if block == "q" else cost(W, reference)
        add(cost, W, y - reference, np.tile(np.eye(width), (N, 1, 1)), slice(begin, begin + width))
    W, place = spd(rng, 3), rng.normal(size=3)
    add(vp.FramePositionCost(robot, frame, place, W), W, p - place, J[:, :3], slice(0, n))
    W, turns = spd(rng, 3), np.linalg.qr(rng.normal(size=(N, 3, 3)))[0]
    turns *= np.sign(np.linalg.det(turns))[:, None, None]
    error, turn = rotation_errors(turns, R, derivative=True)
    add(
        vp.FrameOrientationCost(robot, frame, turns, W),
        W,
        error,
        turn @ np.swapaxes(R, 1, 2) @ J[:, 3:],
        slice(0, n),
    )
    W, twist = spd(rng, 6), rng.normal(size=(N, 6))
    slopes = np.concatenate([kinematics.motion(q).twist_in_q(v), J], axis=2)
    add(vp.FrameVelocityCost(robot, frame, twist, W), W, (J @ v[:, :, None])[..., 0] - twist, slopes, slice(0, 2 * n))
    return found


def test_every_term_is_what_it_is_in_numpy(rng, robot, frame):
    at = samples(rng, robot)
    for cost, (value, gradient, hessian) in terms(rng, robot, frame, *at):
        bound = cost.bind(points(robot))
        own = bound.expand(*at)
        np.testing.assert_allclose(bound.value(*at), value, rtol=1e-12, err_msg=repr(cost))
        np.testing.assert_allclose(own.gradient, gradient, rtol=1e-11, atol=1e-11 * np.abs(gradient).max())
        full = np.broadcast_to(own.hessian, hessian.shape)
        np.testing.assert_allclose(full, hessian, rtol=1e-11, atol=1e-11 * np.abs(hessian).max())


def test_sums_scale_and_add_up(rng, robot, frame):
    """Of terms in the core, and of others beside them."""
    at = samples(rng, robot)
    found = terms(rng, robot, frame, *at)
    factors = rng.uniform(0.5, 2.0, len(found))
    custom = vp.CustomCost(
        lambda t, q, v, u: u[:, 0] ** 2,
        lambda t, q, v, u: (
            2.0 * u[:, :1] * np.eye(2 * robot.dof + CONTROLS)[2 * robot.dof],
            np.tile(2.0 * np.diag(np.eye(2 * robot.dof + CONTROLS)[2 * robot.dof]), (N, 1, 1)),
        ),
    )
    cost = sum((factor * own for factor, (own, _) in zip(factors, found, strict=True)), start=custom)
    bound = cost.bind(points(robot))
    assert isinstance(bound, BoundSum)
    expansion = bound.expand(*at)
    expected = [sum(f * parts[i] for f, (_, parts) in zip(factors, found, strict=True)) for i in range(3)]
    last = 2 * robot.dof
    expected[0] = expected[0] + at[2][:, 0] ** 2
    expected[1][:, last] += 2.0 * at[2][:, 0]
    expected[2][:, last, last] += 2.0
    np.testing.assert_allclose(bound.value(*at), expected[0], rtol=1e-12)
    np.testing.assert_allclose(expansion.gradient, expected[1], rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(expansion.hessian, expected[2], rtol=1e-10, atol=1e-10)
    many = [np.stack([x, x[::-1]]) for x in at]
    np.testing.assert_allclose(bound.value(*many)[0], expected[0], rtol=1e-12)
    shares = sum(np.asarray(share).reshape(2, N, -1).sum(axis=2) for share in bound.shares(*many))
    np.testing.assert_allclose(shares, bound.value(*many), rtol=1e-12)


def test_linear_terms_share_their_hessian(rng, robot):
    at = samples(rng, robot)
    bound = (vp.TrackingCost(0.0) + vp.ControlCost(2.0)).bind(points(robot))
    n = robot.dof
    expected = np.diag(np.concatenate([np.full(n, 2.0), np.zeros(n), np.full(CONTROLS, 4.0)]))
    np.testing.assert_array_equal(bound.expand(*at).hessian, expected[None])


def test_terms_of_what_is_not_there_are_refused(robot, frame):
    n = robot.dof
    costs, kinematics = CostTerms.make(n, 2), frame_kinematics(robot, frame)
    with pytest.raises(ValueError, match="not there"):
        costs.add_term(Subject.entries, 2 * n, np.eye(3), np.zeros((1, 3)))
    with pytest.raises(ValueError, match="not there"):
        costs.add_term(Subject.position, 0, np.eye(3), np.zeros((1, 3)))
    costs.add_frame(kinematics.links.core, kinematics.rotation, kinematics.translation)
    with pytest.raises(ValueError, match="wrong size"):
        costs.add_term(Subject.twist, 0, np.eye(3), np.zeros((1, 3)))
    with pytest.raises(ValueError, match="target has size 3"):
        costs.add_term(Subject.orientation, 0, np.eye(3), np.zeros((1, 3)))
    with pytest.raises(ValueError, match="no target"):
        costs.add_term(Subject.position, 0, np.eye(3), np.zeros((0, 3)))
    with pytest.raises(ValueError, match="another number"):
        CostTerms.make(n + 1, 2).add_frame(kinematics.links.core, kinematics.rotation, kinematics.translation)


def test_samples_are_weighted_nodes(rng):
    rule, q, v = rng.normal(size=(2, 9)), rng.normal(size=(3, 5, 4)), rng.normal(size=(3, 5, 4))
    rule[0, 4] = 0.0
    nodes = np.stack([q[:, :-1], v[:, :-1], q[:, 1:], v[:, 1:]])
    expected = [np.einsum("sc,cPNi->PNsi", rule[:, b : b + 4], nodes).reshape(3, 8, 4) for b in (1, 5)]
    for found, other in zip(sample_steps(rule, q, v), expected, strict=True):
        np.testing.assert_allclose(found, other, rtol=1e-13, atol=1e-14)
    # What has no weight may be no number.
    v[:, -1] = np.nan
    assert np.isfinite(sample_steps(rule, q, v)[0][:, -2]).all()


def test_slopes_of_velocities(rng, robot):
    scene = vp.Scene(robot)
    q, v = rng.normal(size=(2, N, robot.dof))
    M, A = node_jets(scene, q, v)
    expected = np.concatenate([-np.linalg.solve(M, A), np.linalg.inv(M)], axis=2)
    np.testing.assert_allclose(velocity_at_nodes(scene, q, v), expected, rtol=1e-9, atol=1e-9)
