"""The cost of changing controls: values, feedback on the control before, and what hands it on."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from oracles import rollout
from plan_problems import linear, sliders

import varpin as vp

MATRIX = np.array([[2e-2, 5e-3], [5e-3, 1e-2]])
BEFORE = np.array([0.7, -0.3])


def plain_rate(u, weight, before, period):
    W = np.asarray(weight) * np.eye(u.shape[1]) if np.ndim(weight) < 2 else np.asarray(weight)
    total, last = 0.0, before
    for row in u:
        if last is not None:
            total += (row - last) @ W @ (row - last) / period
        last = row
    return total


@pytest.mark.parametrize("hold", [1, 3])
@pytest.mark.parametrize("before", [None, BEFORE], ids=["free", "given"])
@pytest.mark.parametrize("weight", [0.3, [0.3, 0.1], MATRIX], ids=["number", "vector", "matrix"])
def test_value(weight, before, hold):
    rng = np.random.default_rng(0)
    u = rng.normal(size=(24 // hold, 2))
    bare, rated = linear(hold=hold), linear(vp.ControlRateCost(weight, before), hold=hold)
    motion = rollout(bare, u)
    expected = plain_rate(u, weight, before, 0.05 * hold)
    assert rated.cost_of(motion) - bare.cost_of(motion) == pytest.approx(expected, rel=1e-11)
    # Scaled and summed, and of many motions at once.
    half = vp.ControlRateCost(np.multiply(0.25, weight), before)
    parts = linear(2.0 * (half + 0.0 * vp.VelocityCost()) + 0.5 * vp.ControlRateCost(weight, before), hold=hold)
    assert parts.cost_of(motion) == pytest.approx(rated.cost_of(motion), rel=1e-12)
    many = [np.repeat(array[None], 3, axis=0) for array in (motion.q, motion.v, motion.u)]
    assert_allclose(rated.costs(*many), rated.cost_of(motion), rtol=1e-12)


def random_policy(scene, steps, hold=1, before=None, limits=None):
    rng = np.random.default_rng(5)
    n, m = scene.robot.dof, scene.controls
    return vp.LinearPolicy(
        rng.normal(size=(steps, m)), -0.3 * rng.random(size=(steps, m, 2 * n)), rng.normal(size=(steps, 2 * n)), hold,
        limits=limits, previous_gains=0.4 * rng.normal(size=(steps, m, m)), previous=rng.normal(size=(steps, m)),
        before=before,
    )  # fmt: skip


@pytest.mark.parametrize("before", [None, BEFORE], ids=["free", "given"])
@pytest.mark.parametrize("limits", [None, (-0.8, 0.8)], ids=["free", "limited"])
@pytest.mark.parametrize(
    "integrator",
    [vp.Midpoint(), vp.Gauss(2), vp.RungeKutta4(), vp.SemiImplicitEuler(), vp.ExplicitEuler(), vp.Reference()],
    ids=str,
)
def test_policies_feed_the_control_before_back(monkeypatch, integrator, limits, before):
    monkeypatch.setattr("varpin.simulation.simulate._CHUNK", 8)
    scene = vp.Scene(sliders(2), gravity=False, damping=0.3)
    policy = random_policy(scene, 10, 2, before, limits)
    motion = vp.simulate(scene, [0.3, -0.4], [0.5, 0.1], dt=0.05, steps=20, controls=policy, integrator=integrator)
    x = np.hstack([motion.q, motion.p if integrator.variational else motion.v])
    last = before
    assert ((motion.u == -0.8) | (motion.u == 0.8)).any() == (limits is not None)
    for k in range(10):
        u = policy.u[k] + policy.gains[k] @ (x[2 * k] - policy.reference[k])
        if last is not None:
            u = u + policy.previous_gains[k] @ (last - policy.previous[k])
        u = np.clip(u, -0.8, 0.8) if limits else u
        assert_allclose(motion.u[2 * k : 2 * k + 2], [u, u], rtol=0, atol=1e-12)
        assert_array_equal(policy.control(k, x[2 * k], last), u)
        last = motion.u[2 * k]


def test_feedback_on_another_start_and_another_control_before():
    """On a linear system the law is the optimum wherever it starts: shifted, with what acted before."""
    problem = linear(vp.ControlRateCost(MATRIX), sampling="start", hold=2)
    whole = vp.solve(problem, tolerance=1e-15)
    motion, j = whole.trajectory, 8
    applied = whole.controls[3] + [0.5, -0.4]
    later = problem.at(q0=motion.q[j] + 0.1, v0=motion.v[j] - 0.2, steps=24 - j, t0=problem.dt * j, before=applied)
    own = whole.shifted(4, applied)
    rows = slice(0, 8)
    policy = vp.LinearPolicy(
        own.u[rows], own.gains[rows], own.reference[rows], own.hold, previous_gains=own.previous_gains[rows],
        previous=own.previous[rows], before=own.before,
    )  # fmt: skip
    best = vp.solve(later, tolerance=1e-15)
    assert_allclose(later.simulate(policy).u[::2], best.controls, rtol=0, atol=1e-6)
    # What is repeated at the end expects itself before, so that it goes on where nothing is off.
    assert_array_equal(own.previous[9:], own.u[8:-1])


def test_mpc_joins_its_plans():
    for before in (BEFORE, None):
        problem = linear(vp.ControlRateCost(0.1, before), q0=(0.0, 0.0))
        robot, actuation = problem.scene.robot, problem.scene.actuation
        noisy = vp.Scene(robot, gravity=False, noise=vp.AdditiveNoise(0.5), damping=0.2, actuation=actuation)
        run = vp.Mpc(problem).run(vp.Plant(noisy), duration=1.0, rng=1)
        given = [plan.problem.rate.before for plan in run.plans]
        assert given[0] is None if before is None else (given[0] == before).all()
        assert_array_equal(given[1:], run.motion.u[::10][: len(given) - 1])
    again = vp.Mpc(problem).plan(0.1, [0.1, 0.1], [0.0, 0.0], run.plans[0], decisions=2)
    assert_array_equal(again.problem.rate.before, run.plans[0].controls[1])


def test_sums_scales_and_words():
    own = vp.ControlRateCost(2.0)
    assert own.of_controls
    assert repr(0.5 * own + vp.ControlCost()) == "0.5 * ControlRateCost(weight=2.0) + ControlCost(weight=1.0)"
    assert repr(vp.ControlRateCost([1.0, 2.0], 0.5)) == "ControlRateCost(weight=[1.0, 2.0], before=0.5)"
    assert_array_equal(linear(vp.ControlRateCost(1.0, 0.5)).rate.before, [0.5, 0.5])
    assert_array_equal(linear(2.0 * own + vp.ControlRateCost([1.0, 3.0])).rate.weight, np.diag([5.0, 7.0]))
