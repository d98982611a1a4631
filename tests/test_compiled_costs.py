"""Costs that the core evaluates against the same in NumPy and of Pinocchio, term by term."""

from __future__ import annotations

import dataclasses

import numpy as np
import pinocchio as pin
import pytest
from mechanisms import random_tree
from refusals import refused

import varpin as vp
from varpin.control.costs import BoundSum, Points, control_rate
from varpin.core import CostTerms, Subject, sample_steps
from varpin.linearization import node_jets, velocity_at_nodes
from varpin.model.kinematics import frame_kinematics

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


def slopes_in_q(function, q, step=1e-2):
    """Derivative (N, ..., n) of a function of q (N, n), by differences of eighth order."""
    weights = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}
    columns = [
        sum(w * (function(q + k * e) - function(q - k * e)) for k, w in weights.items()) / step
        for e in step * np.eye(q.shape[1])
    ]
    return np.stack(columns, axis=-1)


def masses(robot, q):
    """Centres of mass (N, 3) and their derivatives (N, 3, n), by Pinocchio."""
    model, gear = robot.free_model, robot.free_velocities(np.eye(robot.dof)).T
    data = model.createData()
    slopes = np.array([pin.jacobianCenterOfMass(model, data, robot.free_positions(row)) @ gear for row in q])
    return np.array([pin.centerOfMass(model, data, robot.free_positions(row)).copy() for row in q]), slopes


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
    error = np.array([pin.log3(target.T @ own) for target, own in zip(turns, R, strict=True)])
    turn = np.array([pin.Jlog3(target.T @ own) for target, own in zip(turns, R, strict=True)])
    add(
        vp.FrameOrientationCost(robot, frame, turns, W),
        W,
        error,
        turn @ np.swapaxes(R, 1, 2) @ J[:, 3:],
        slice(0, n),
    )
    W, twist = spd(rng, 6), rng.normal(size=(N, 6))
    in_q = slopes_in_q(lambda q: (kinematics.jacobians(q)[2] @ v[:, :, None])[..., 0], q)
    slopes = np.concatenate([in_q, J], axis=2)
    add(vp.FrameVelocityCost(robot, frame, twist, W), W, (J @ v[:, :, None])[..., 0] - twist, slopes, slice(0, 2 * n))
    W, place = spd(rng, 3), rng.normal(size=(N, 3))
    centers, slopes = masses(robot, q)
    add(vp.CenterOfMassCost(robot, place, W), W, centers - place, slopes, slice(0, n))
    # The finger turns in a plane.
    rows = [0, 1] if robot.name == "finger" else [0, 1, 2]

    def chosen(q):
        return kinematics.jacobians(q)[2][:, rows]

    J = chosen(q)
    measured = np.sqrt(np.linalg.det(J @ np.swapaxes(J, 1, 2)))
    least = 1.01 * float(np.median(measured))
    slopes = measured[:, None] * np.einsum("Nar,Nrab->Nb", np.linalg.pinv(J), slopes_in_q(chosen, q))
    slopes = np.where(measured < least, -1.0, 0.0)[:, None, None] * slopes[:, None]
    cost = vp.ManipulabilityCost(robot, frame, least, 1.7, ["xyz"[row] for row in rows])
    add(cost, np.array([[1.7]]), np.maximum(0.0, least - measured)[:, None], slopes, slice(0, n))
    for kind, y, begin in ((vp.JointLimitBarrier, q, 0), (vp.VelocityLimitBarrier, v, n)):
        W, lower, upper = spd(rng, n), np.full(n, -0.5), np.linspace(0.3, 0.6, n)
        beyond = y - np.clip(y, lower + 0.1, upper - 0.1)
        add(
            kind(robot, W, 0.1, (lower, upper)),
            W,
            beyond,
            np.eye(n) * (beyond != 0.0)[:, None],
            slice(begin, begin + n),
        )
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


@pytest.mark.parametrize("before", [None, np.array([0.4, -0.2, 0.1])], ids=["free", "given"])
def test_changes_of_controls(rng, before):
    """Each against the quadratic form, its slope and curvature against differences, which a quadratic leaves exact."""
    W, period, u = spd(rng, CONTROLS), 0.03, rng.normal(size=(4, N, CONTROLS))
    rate = control_rate(vp.ControlRateCost(W, before), CONTROLS)
    start = u[:, :1] if before is None else np.tile(before, (4, 1, 1))
    change = u - np.concatenate([start, u[:, :-1]], axis=1)
    expected = np.einsum("pki,ij,pkj->pk", change, W, change) / period
    np.testing.assert_allclose(rate.shares(u, period), expected, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(rate.value(u, period), expected.sum(axis=1), rtol=1e-13)
    gradient, hessian = rate.expand(u[0], period)
    first = 1 if before is None else 0
    assert not gradient[:first].any()
    assert not hessian[:first].any()
    for k in range(first, N):

        def at(d, k=k):
            moved = change[0, k] + d
            return moved @ W @ moved / period

        axes = np.eye(CONTROLS)
        np.testing.assert_allclose(gradient[k], [0.5 * (at(e) - at(-e)) for e in axes], rtol=1e-9, atol=1e-9)
        mixed = [[0.25 * (at(a + b) - at(a - b) - at(b - a) + at(-a - b)) for b in axes] for a in axes]
        np.testing.assert_allclose(hessian[k], mixed, rtol=1e-9, atol=1e-9)


def test_manipulability_where_there_is_none(load):
    """The slope of |det J| is that of cofactors, whichever rows of J are dependent, and zero where two are lost."""
    robot = load("ur5")
    frame = frame_kinematics(robot, "tool0")
    straight = np.array([0.3, -1.0, 0.0, 0.4, 0.9, 0.2])  # elbow
    wrist = np.array([0.3, -1.0, 0.7, 0.4, 0.0, 0.2])
    q = np.array([straight, wrist, straight * [1, 1, 1, 1, 0, 1]])
    bound = vp.ManipulabilityCost(robot, "tool0", 0.05).bind(Points(np.zeros(3), 1.0, 2, 6, 6))
    given = bound.expand(q, q, q)
    slopes = slopes_in_q(lambda q: np.linalg.det(frame.jacobians(q)[2]), q)
    assert (np.abs(slopes[:2]).max(axis=1) > 1e-3).all()
    np.testing.assert_allclose(np.abs(given.gradient[:, :6]), 0.1 * np.abs(slopes), atol=1e-10)
    np.testing.assert_allclose(given.gradient[2], 0.0, atol=1e-10)
    outer = slopes[:, :, None] * slopes[:, None, :]
    np.testing.assert_allclose(given.hessian[:, :6, :6], 2.0 * outer, atol=1e-9)


def test_states_that_are_no_numbers_have_no_cost(load):
    robot = load("ur5")
    bad = np.full((1, 6), np.nan)
    points, still = Points(np.zeros(1), 1.0, 1, 6, 6), np.zeros((1, 6))
    for cost in (
        vp.JointLimitBarrier(robot), vp.ManipulabilityCost(robot, "tool0", 0.1), vp.CenterOfMassCost(robot, [0, 0, 0]),
    ):  # fmt: skip
        assert np.isnan(cost.bind(points).value(bad, still, still)).all(), cost


def test_terms_of_what_is_not_there_are_refused(robot, frame):
    n = robot.dof
    costs, kinematics = CostTerms.make(n, 2), frame_kinematics(robot, frame)
    none = np.zeros(0, dtype=np.int64)

    def no(fact, subject, place, size, target, directions=none):
        with refused(ValueError, fact):
            costs.add_term(subject, place, np.eye(size), np.zeros(target), directions)

    no("do not exist", Subject.entries, 2 * n, 3, (1, 3))
    no("do not exist", Subject.excess, 2 * n, 3, (1, 6))
    no("do not exist", Subject.position, 0, 3, (1, 3))
    costs.add_frame(kinematics.links.core, kinematics.rotation, kinematics.translation)
    no("wrong size", Subject.twist, 0, 3, (1, 3))
    no("wrong size", Subject.manipulability, 0, 3, (1, 3), np.array([0]))
    no("target has size 3", Subject.orientation, 0, 3, (1, 3))
    no("target has size 2 along axis 1, not 4", Subject.excess, 0, 2, (1, 2))
    no("no target", Subject.position, 0, 3, (0, 3))
    no("has directions", Subject.manipulability, 0, 1, (1, 1))
    no("has directions", Subject.manipulability, 0, 1, (1, 1), np.arange(n + 1))
    no("has directions", Subject.position, 0, 3, (1, 3), np.array([0]))
    no("rows of a Jacobian", Subject.manipulability, 0, 1, (1, 1), np.array([6]))
    center = costs.add_center(kinematics.links.core)
    no("only a position", Subject.twist, center, 6, (1, 6))
    other = CostTerms.make(n + 1, 2)
    with refused(ValueError, "number"):
        other.add_frame(kinematics.links.core, kinematics.rotation, kinematics.translation)
    with refused(ValueError, "number"):
        other.add_center(kinematics.links.core)
    light = dataclasses.replace(kinematics.links, mass=np.zeros(len(kinematics.links.mass)))
    with refused(ValueError, "mass"):
        costs.add_center(light.core)


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
