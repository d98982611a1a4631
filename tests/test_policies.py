"""Laws and policies that act once a period, controls by joint name, and what changes of controls cost."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from oracles import rollout, slope
from plan_problems import linear, sliders
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
    given = {"on": "velocity", "period": PERIOD} | options
    return vp.LinearPolicy(rng.normal(size=(INTERVALS, 2)), gains, np.zeros((INTERVALS, 4)), **given)


def run(given, dt, steps, **options):
    return vp.simulate(SCENE, Q0, REST, dt=dt, steps=steps, controls=given, integrator=vp.RungeKutta4(), **options)


@pytest.mark.parametrize("finer", [1, 2, 7])
def test_a_period_of_so_many_steps_is_a_hold_of_them(finer):
    by_period, by_hold = policy(), policy(hold=finer, period=None)
    motions = [run(given, PERIOD / finer, INTERVALS * finer) for given in (by_period, by_hold)]
    assert_array_equal(motions[0].q, motions[1].q)


def test_a_plan_runs_at_finer_steps_as_it_is():
    cost = vp.VelocityCost(0.1) + vp.ControlCost(0.1) + vp.Terminal(vp.TrackingCost([0.5, 0.2], 10.0))
    problem = vp.OptimalControlProblem(SCENE, cost, Q0, REST, dt=0.01, steps=20, hold=2)
    plan = vp.solve(problem)
    assert plan.policy.period == 0.02
    finer = vp.simulate(SCENE, Q0, REST, dt=0.0025, steps=80, controls=plan.policy, integrator=vp.Gauss(4))
    assert_allclose(finer.q[::4], plan.trajectory.q, atol=1e-7)
    others = plan.policy.without_feedback(), plan.shifted(1), problem.holding_policy(), plan.policy_on("velocity")
    for same in others:
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


# --- the cost of changing controls, and what hands the control before on ---------------------------------------------


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
    rng = np.random.default_rng(5)
    policy = vp.LinearPolicy(
        rng.normal(size=(10, 2)), -0.3 * rng.random(size=(10, 2, 4)), rng.normal(size=(10, 4)), 2, limits=limits,
        previous_gains=0.4 * rng.normal(size=(10, 2, 2)), previous=rng.normal(size=(10, 2)), before=before,
    )  # fmt: skip
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


# --- that change within a step: their values and means, steps in parts, functions of time ----------------------------


ARM, UR5_Q = vp.Scene(vp.load_robot("ur5")), np.array([0.3, -1.2, 0.8, 0.2, 0.5, -0.3])


def force(t):
    return np.array([40.0, 60.0, 30.0, 5.0, 4.0, 3.0]) * np.sin(np.arange(3.0, 9.0) * t + np.arange(6))


def moments(force, begin, dt):
    """The moments of a function over a step by Legendre's polynomials of degree 0 to 3, and 40 points."""
    x, w = np.polynomial.legendre.leggauss(40)
    values = np.array([force(begin + 0.5 * dt * (1.0 + at)) for at in x])
    return 0.5 * np.polynomial.legendre.legvander(x, 3).T @ (w[:, None] * values)


HELD = [vp.Midpoint(), vp.Gauss(1), vp.Radau(1), vp.ExplicitEuler()]


@pytest.mark.parametrize("integrator", [*HELD, vp.Gauss(3), vp.Radau(2), vp.RungeKutta4()], ids=str)
def test_values_and_means(integrator):
    """One stage holds the mean; the values at several have the moments of the function."""
    motion = vp.simulate(ARM, UR5_Q, np.zeros(6), dt=0.01, steps=6, controls=vp.OpenLoop(force), integrator=integrator)
    times = np.zeros(0) if integrator in HELD else 2.0 * np.array(integrator.stage_times) - 1.0
    for k in range(6):
        of_force = moments(force, 0.01 * k, 0.01)
        assert_allclose(motion.u[k], of_force[0], rtol=1e-12)
        if times.size:
            through = np.polynomial.legendre.legfit(times, motion.u_stages[k], len(times) - 1)
            own = through / (2.0 * np.arange(len(times)) + 1.0)[:, None]
            assert_allclose(own, of_force[: len(times)], rtol=0, atol=1e-12 * np.abs(of_force).max())
    assert motion.part(2, 5).u_stages.shape == (3, len(times), 6)


SMALL = {"dt": 0.03, "steps": 3}
CHAIN_Q, CHAIN_V = np.array([0.3, -0.4, 0.5]), np.array([1.0, -0.5, 0.8])


def push(t):
    return np.array([3.0 * np.sin(9.0 * t + 1.0), 0.2 + 0.02 * np.sin(7.0 * t), np.sin(5.0 * t + 1.0)])


@pytest.mark.parametrize(("stages", "balance"), [(2, 1e-3), (3, 1e-7)])
def test_derivatives_of_steps_in_parts_against_differences(stages, balance):
    servo, friction = vp.PositionServo({"joint2": 40.0}, 1.0, 25.0), vp.CoulombFriction({"joint1": 0.4}, 3.0)
    scene = vp.Scene(vp.planar_chain(3), damping=0.3, forces=[servo, friction])
    integrator = vp.Gauss(stages, guard=vp.Guard(energy_balance=balance))
    n, dt = 3, SMALL["dt"]
    motion = vp.simulate(scene, CHAIN_Q, CHAIN_V, controls=vp.OpenLoop(push), integrator=integrator, **SMALL)
    assert motion.statistics.split_steps > 0
    lin = vp.linearize(scene, motion)
    for k in range(motion.steps):

        def end(z, k=k):
            q, p, shift, ramp = motion.q[k] + z[:n], motion.p[k] + z[n : 2 * n], z[2 * n : 3 * n], z[3 * n :]
            v = np.linalg.solve(vp.lagrangian_jet(scene, q, np.zeros(n)).Lvv, p)
            force = vp.OpenLoop(lambda t: push(k * dt + t) + shift + ramp * t / dt)
            own = vp.simulate(scene, q, v, dt=dt, steps=1, controls=force, integrator=integrator, check=False)
            assert own.statistics.substeps[0] == motion.statistics.substeps[k], "the difference crosses a guard"
            return np.concatenate([own.q[1], own.p[1]])

        given = np.hstack([lin.A[k], lin.B[k], lin.ramp[k]])
        for c, e in enumerate(np.eye(4 * n)):
            found = slope(end, np.zeros(4 * n), e, 4e-5 if c < 2 * n else 4e-4)
            assert_allclose(given[:, c], found, rtol=0, atol=1e-8)


@pytest.mark.parametrize(("stages", "balance"), [(2, 1e-10), (3, 1e-13)])
def test_steps_in_parts_keep_the_order(stages, balance):
    scene = vp.Scene(vp.planar_chain(3))
    options = {"duration": 0.48, "controls": vp.OpenLoop(push), "check": False}
    end = vp.simulate(scene, CHAIN_Q, CHAIN_V, steps=96, integrator=vp.Gauss(5), **options).q[-1]
    cut, errors = vp.Gauss(stages, guard=vp.Guard(energy_balance=balance)), []
    for steps in (6, 12):
        motion = vp.simulate(scene, CHAIN_Q, CHAIN_V, steps=steps, integrator=cut, **options)
        assert motion.statistics.split_steps == steps
        errors.append(np.abs(motion.q[-1] - end).max())
        whole = vp.simulate(scene, CHAIN_Q, CHAIN_V, steps=steps, integrator=vp.Gauss(stages), **options)
        assert errors[-1] < 0.5 * np.abs(whole.q[-1] - end).max()
    assert np.log2(errors[0] / errors[1]) > 2 * stages - 0.5, errors


RISE = np.array([0.5, -0.2, 0.1])


def rising(t):
    t = np.asarray(t)[..., None]
    return RISE * (1.0 + 2.0 * t * t)


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(3), vp.Radau(2), vp.RungeKutta4()])
def test_a_function_of_many_times_makes_the_motion_of_one_of_each(integrator):
    scene, called = vp.Scene(vp.planar_chain(3)), []

    def plain(t):
        assert isinstance(t, float)
        called.append(t)
        return rising(t)

    def lists(t):
        return rising(t).tolist()

    def vectorized(t):
        assert t.ndim == 1
        called.append(t)
        return rising(t)

    options = {"dt": 0.01, "steps": 7, "integrator": integrator}
    motion = vp.simulate(scene, CHAIN_Q, CHAIN_V, controls=vp.OpenLoop(plain), check=False, **options)
    assert called == sorted(set(called)), "a time is asked for twice, or before an earlier one"
    called.clear()
    for controls in (vp.OpenLoop(lists), vp.OpenLoop(vectorized, vectorized=True)):
        again = vp.simulate(scene, CHAIN_Q, CHAIN_V, controls=controls, **options)
        assert_array_equal(again.u, motion.u)
        assert_array_equal(again.q, motion.q)
    # For the motion, for its means, and for its repetition: the first time of each is alone.
    assert len(called) <= 6


def test_where_a_function_of_many_times_fails():
    scene = vp.Scene(vp.planar_chain(3))
    options = {"dt": 0.01, "steps": 7, "integrator": vp.Gauss(2)}
    at = float(3 + vp.Gauss(2).stage_times[1]) * 0.01

    def failed(f, *facts):
        with refused(vp.ControlError, facts) as info:
            vp.simulate(scene, CHAIN_Q, CHAIN_V, controls=vp.OpenLoop(f, vectorized=True), **options)
        return info.value

    def raises(t):
        if (t >= at).any():
            raise RuntimeError("no more")
        return rising(t)

    vanishes = lambda t: np.where((t >= at)[:, None], np.nan, rising(t))  # noqa: E731
    for f, words in ((raises, "RuntimeError"), (vanishes, "[0, 0]")):
        error = failed(f, words)
        assert (error.step, error.trajectory.steps) == (3, 3)
        assert at <= error.time < 0.04
    assert failed(lambda t: rising(t).T, "(1, 3)", "(3, 1)").step == 0
    assert failed(lambda t: rising(t[0]), "(1, 3)", "(3,)").step == 0
    failed(lambda t: rising(t)[:3], "times")
    with refused(vp.InputError, "vectorized"):
        vp.OpenLoop(rising, vectorized="no")
    # As many times as controls: rows and columns look alike.
    options["steps"] = 2
    failed(lambda t: rising(t).T, "(1, 3)", "(3, 1)")
