"""Laws and policies that act once a period, in finer steps too, and controls by joint name."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused

import varpin as vp

CHAIN = vp.planar_chain(2)
SCENE = vp.Scene(CHAIN, damping=0.1)
Q0 = [0.3, -0.2]
REST = [0.0, 0.0]
INTERVALS, PERIOD = 10, 0.02


def policy(**options):
    rng = np.random.default_rng(0)
    gains = -np.tile(np.hstack([2.0 * np.eye(2), 0.5 * np.eye(2)]), (INTERVALS, 1, 1))
    return vp.LinearPolicy(
        rng.normal(size=(INTERVALS, 2)),
        gains,
        np.zeros((INTERVALS, 4)),
        on="velocity",
        **{"period": PERIOD} | options,
    )


def run(given, dt, steps, **options):
    return vp.simulate(SCENE, Q0, REST, dt=dt, steps=steps, controls=given, integrator=vp.RungeKutta4(), **options)


@pytest.mark.parametrize("finer", [1, 2, 7])
def test_a_policy_with_a_period_is_held_over_finer_steps(finer):
    given, dt = policy(), PERIOD / finer
    motion = run(given, dt, INTERVALS * finer)
    assert_array_equal(np.ptp(motion.u.reshape(INTERVALS, finer, 2), axis=1), 0.0)
    for k in range(INTERVALS):
        x = np.concatenate([motion.q[finer * k], motion.v[finer * k]])
        assert_allclose(motion.u[finer * k], given.control(k, x), rtol=1e-12, atol=1e-12)
    assert_array_equal(motion.q, run(policy(hold=finer, period=None), dt, INTERVALS * finer).q)
    assert_allclose(run(motion.u, dt, INTERVALS * finer).q, motion.q, rtol=0.0, atol=1e-13)


def test_a_plan_runs_at_finer_steps_as_it_is():
    cost = vp.VelocityCost(0.1) + vp.ControlCost(0.1) + vp.Terminal(vp.TrackingCost([0.5, 0.2], 10.0))
    problem = vp.OptimalControlProblem(SCENE, cost, Q0, REST, dt=0.01, steps=20, hold=2)
    plan = vp.solve(problem)
    assert plan.policy.period == 0.02
    finer = vp.simulate(SCENE, Q0, REST, dt=0.0025, steps=80, controls=plan.policy, integrator=vp.Gauss(4))
    assert_allclose(finer.q[::4], plan.trajectory.q, atol=1e-7)
    for same in (
        plan.policy.without_feedback(),
        plan.shifted(1),
        problem.holding_policy(),
        plan.policy_on("velocity"),
    ):
        assert (same.period, same.joints) == (0.02, CHAIN.joint_names)


def test_steps_that_do_not_fit_are_refused_with_what_does():
    with refused(vp.InputError, "0.02 s", "0.003 s", f"dt = {0.02 / 7!r} s"):
        run(policy(), 0.003, 70)
    # As many steps as it has intervals, but longer ones: nothing told of it before.
    with refused(vp.InputError, "0.04 s", "0.02 s"):
        run(policy(), 0.04, INTERVALS)
    with refused(vp.InputError, "2", "20", "10"):
        run(policy(), 0.01, 10)
    with refused(vp.InputError, "30", "period="):
        run(policy(period=None), 0.01, 3 * INTERVALS)
    with refused(vp.InputError, "period"):
        policy(period=0.0)


def test_laws_and_functions_of_time_may_answer_by_joint_name():
    def pull(t):
        return {"joint2": 2.0 * np.cos(t)}

    # Means over the steps.
    rows = np.array([[0.0, 200.0 * (np.sin((k + 1) * 0.01) - np.sin(k * 0.01))] for k in range(8)])
    options = {"dt": 0.01, "steps": 8, "integrator": vp.Midpoint()}
    pulled = vp.simulate(SCENE, Q0, REST, controls=vp.OpenLoop(pull), **options)
    assert_allclose(pulled.u, rows, rtol=1e-12)
    law = vp.simulate(SCENE, Q0, REST, controls=lambda t, q, v: {"joint1": -q[0]}, **options)
    assert_array_equal(law.u, np.column_stack([-law.q[:-1, 0], np.zeros(8)]))
    paths = vp.simulate_ensemble(SCENE, Q0, REST, controls=vp.OpenLoop(pull), paths=1, rng=0, **options)
    assert_array_equal(paths.u[0], pulled.u)
    with refused(vp.ControlError, "'join2'", "'joint2'"):
        vp.simulate(SCENE, Q0, REST, controls=vp.OpenLoop(lambda t: {"join2": t}), **options)
    geared = vp.Scene(CHAIN, actuation=2.0 * np.eye(2))
    with refused(vp.ControlError, "joint name"):
        vp.simulate(geared, Q0, REST, controls=vp.OpenLoop(pull), **options)


def test_limits_of_policies_by_name():
    named = policy(limits=({"joint2": -0.5}, {"joint2": 0.5, "joint1": 1.0}), joints=SCENE.control_joints)
    assert_array_equal(named.limits, [[-np.inf, -0.5], [1.0, 0.5]])
    given = policy(limits=([-np.inf, -0.5], [1.0, 0.5]))
    assert_array_equal(run(named, PERIOD, INTERVALS).q, run(given, PERIOD, INTERVALS).q)
    with refused(vp.InputError, "limits: lower", "joint name"):
        policy(limits=({"joint2": -0.5}, 1.0))
    with refused(vp.UnknownJoint, "'joint2'"):
        policy(limits=({"join2": -0.5}, 1.0), joints=SCENE.control_joints)
    with refused(vp.InputError, "joints", "2"):
        policy(joints=["joint1"])
    swapped = policy(joints=["joint2", "joint1"])
    with refused(vp.InputError, "joint2, joint1"):
        run(swapped, PERIOD, INTERVALS)


def test_the_control_before_a_plan_by_name():
    cost = vp.ControlCost(0.1) + vp.ControlRateCost(1e-2) + vp.Terminal(vp.TrackingCost([0.5, 0.2], 10.0))
    mpc = vp.Mpc(vp.OptimalControlProblem(SCENE, cost, Q0, REST, dt=0.02, steps=8))
    for previous in (None, mpc.plan(0.0, Q0, REST)):
        named = mpc.plan(0.0, Q0, REST, previous, before={"joint2": 3.0})
        given = mpc.plan(0.0, Q0, REST, previous, before=[0.0, 3.0])
        assert_array_equal(named.controls, given.controls)
        assert np.abs(named.controls - mpc.plan(0.0, Q0, REST, previous).controls).max() > 1e-3
    plan = mpc.plan(0.0, Q0, REST)
    assert_array_equal(plan.shifted(2, {"joint1": 1.0}).before, [1.0, 0.0])


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(3), vp.RungeKutta4(), vp.ExplicitEuler()], ids=str)
def test_a_law_is_called_once_where_each_period_begins(integrator):
    called = []

    def law(t, q, v):
        called.append((t, q, v))
        return 3.0 * np.sin(7.0 * t) - 2.0 * v * np.abs(v) - 2.0 * q

    given = {"dt": 0.01, "steps": 48, "controls": law, "period": 5, "integrator": integrator, "check": True}
    motion = vp.simulate(SCENE, Q0, REST, **given)
    assert len(called) == 10
    for k, (t, q, v) in enumerate(called):
        assert t == pytest.approx(0.05 * k, abs=1e-12)
        assert_array_equal(q, motion.q[5 * k])
        assert_array_equal(v, motion.v[5 * k])
        assert_array_equal(np.ptp(motion.u[5 * k : 5 * k + 5], axis=0), 0.0)
    assert np.abs(np.diff(motion.u[::5], axis=0)).min() > 0.0


def test_noise_that_python_evaluates_keeps_the_period():
    motions = []
    for noise in (vp.CustomNoise(lambda q, v, u: np.eye(2) * 0.1, 2), vp.AdditiveNoise(0.1)):
        given = {"dt": 1e-2, "steps": 17, "controls": lambda t, q, v: -10.0 * q - v, "period": 5, "rng": 3}
        motions.append(vp.simulate(vp.Scene(CHAIN, noise=noise), Q0, REST, **given))
    assert_allclose(motions[0].u, motions[1].u, atol=1e-12)
