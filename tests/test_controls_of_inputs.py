"""Controls of scenes with kinematic inputs: functions of time, lines, policies, and plans on lines."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import exact, lines, slope
from plan_problems import hand

import varpin as vp

SPAN = 0.8


def path(t):
    return 0.3 + 0.4 * np.sin(3.0 * t)


def rate(t):
    return 1.2 * np.cos(3.0 * t)


def torque(t):
    return 1.5 * np.sin(5.0 * t + 0.4)


def arm(interpolation):
    hand = vp.KinematicInput("joint1", interpolation)
    return vp.Scene(vp.planar_chain(3), actuation=["joint1", "joint2"], constraints=hand)


def wanted(scene, t):
    cubic = [rate(t)] if scene.controls == 3 else []
    return np.array([path(t), torque(t), *cubic])


Q0, V0 = np.array([path(0.0), 0.5, -0.4]), np.array([rate(0.0), 0.0, 0.0])


def test_a_motion_under_a_function_of_time_is_linearized():
    scene = arm("cubic")
    begin = wanted(scene, 0.01)

    def step(u):
        controls = vp.OpenLoop(lambda t: u + np.array([0.0, 3.0 * t, 0.0]))
        return vp.simulate(scene, Q0, V0, dt=0.01, steps=1, controls=controls, integrator=vp.Gauss(2), check=False)

    lin = vp.linearize(scene, step(begin))

    def end(u):
        return np.append(step(u).q[1], step(u).p[1])

    for c, size in enumerate((1e-4, 1e-2, 1e-2)):
        found = slope(end, begin, np.eye(3)[c], size)
        assert_allclose(lin.B[0, :, c], found, atol=1e-8 * np.abs(lin.B[0]).max())


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_a_tolerance_divides_lines_as_the_input_moves(interpolation):
    scene = arm(interpolation)
    nodes = np.array([wanted(scene, x) for x in np.linspace(0.0, SPAN, 9)])
    coarse = vp.FirstOrderHold(nodes)
    found = vp.simulate(scene, Q0, V0, duration=SPAN, tolerance=1e-7, controls=coarse)
    fine = vp.simulate(scene, Q0, V0, dt=SPAN / 8, steps=8, controls=coarse, integrator=vp.Gauss(6), check=False)
    assert_allclose(found.q[-1], fine.q[-1], atol=1e-6)


def test_a_tolerance_follows_a_function_of_time():
    scene = arm("cubic")
    controls = vp.OpenLoop(lambda t: wanted(scene, t))
    found = vp.simulate(scene, Q0, V0, duration=SPAN, tolerance=1e-6, controls=controls)

    def way(t):
        return np.array([path(t)]), np.array([rate(t)]), np.array([-3.6 * np.sin(3.0 * t)])

    own = exact(scene, Q0, V0, [0.0, SPAN], lambda k, q, v: lambda t: wanted(scene, t), path=way)
    assert np.abs(found.q[-1] - own.q[-1]).max() < 1e-6


@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("hold", [1, 3])
def test_a_policy_moves_an_input_over_its_intervals(hold, linear):
    scene = arm("linear")
    dt, N = 0.01, 10
    t = hold * dt * np.arange(N + 1)
    u = np.array([wanted(scene, x) for x in t])
    gains = np.zeros((N, 2, 6))
    gains[:, 0, 1], gains[:, 1, 2] = 0.05, -2.0
    reference = np.tile(np.append(Q0, np.zeros(3)), (N, 1))
    policy = vp.LinearPolicy(u[1:], gains, reference, hold, "momentum", before=u[0], linear=linear)
    given = {"dt": dt, "steps": N * hold, "integrator": vp.Gauss(2)}
    motion = vp.simulate(scene, Q0, V0, controls=policy, **given)
    at = np.arange(0, N * hold, hold)
    goals = u[1:, 0] + 0.05 * (motion.q[at, 1] - Q0[1])
    assert_allclose(motion.q[at + hold, 0], goals, atol=1e-13)
    assert_allclose(motion.u[:, 0], motion.q[1:, 0], atol=1e-13)
    evenly = np.diff(motion.q[:, 0]).reshape(N, hold)
    assert_allclose(evenly, np.broadcast_to(evenly[:, :1], evenly.shape), atol=1e-13)
    if not linear:
        again = vp.simulate(scene, Q0, V0, controls=motion.u, **given)
        assert_allclose(again.q, motion.q, atol=1e-12)
        paths = vp.simulate_ensemble(scene, Q0, V0, paths=2, rng=0, controls=policy, **given)
        assert_allclose(paths.q[0], motion.q, atol=1e-13)
        assert_allclose(paths.u[0], motion.u, atol=1e-13)
    assert_allclose(vp.linearize(scene, motion).B[:, 0, 0], 1.0, atol=1e-12)


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_a_controller_takes_them(interpolation):
    problem = hand(interpolation, steps=12, dt=0.04)
    run = vp.Mpc(problem).run(vp.Plant(problem.scene, substeps=3), duration=1.2)
    assert_allclose(run.motion.q[1:, 0], run.motion.u[:, 0], atol=1e-12)
    assert_allclose(run.motion.q[-1], [0.4, -0.6, 0.2], atol=0.1)


@pytest.mark.parametrize("controls", ["held", "linear"])
@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_searches_start_on_states(interpolation, controls):
    problem = hand(interpolation, controls=controls)
    own = vp.solve(problem, tolerance=1e-12, check=False)
    share = np.linspace(0.0, 1.0, problem.steps + 1)[:, None]
    states = problem.q0 + share * (np.array([0.3, -0.4, 0.1]) - problem.q0)
    found = vp.solve(problem, states=states, tolerance=1e-12, check=False)
    assert found.status.converged
    assert found.cost == pytest.approx(own.cost, rel=1e-9)
    assert_allclose(found.trajectory.q, own.trajectory.q, atol=1e-5)
    # The first motion of no iterations is on the states.
    first = vp.solve(problem, states=own.trajectory, max_iterations=0, check=False)
    assert_allclose(first.trajectory.q[:, 0], own.trajectory.q[:, 0], atol=1e-12)


def test_noise_of_the_position_of_an_input_is_differentiated_at_the_end_of_the_step():
    own = vp.CustomNoise(
        lambda q, v, u: np.array([[0.0], [u[0] * u[1]], [u[0] ** 2]]),
        1,
        du=lambda q, v, u: np.array([[[0.0] * 3], [[u[1], u[0], 0.0]], [[2.0 * u[0], 0.0, 0.0]]]),
        check=True,
    )
    problem = hand("linear", steps=1, noise=own)
    u, step = np.array([0.1, -0.2, 0.3, 0.5, 0.1, -0.3]), 1e-5

    def linearized(ends):
        return vp.linearize(problem.scene, problem.simulate(lines(problem, ends.reshape(2, 3))))

    lin = linearized(u)
    first = lin.F[0, :, 0]
    assert_allclose(first, [0.0, u[3] * 0.5 * (u[1] + u[4]), u[3] ** 2], atol=1e-12)
    slope = np.array([0.0, u[3] * (u[4] - u[1]), 0.0]) / np.sqrt(12.0)
    assert_allclose(lin.G[0], lin.J[0] @ np.stack([first, slope], axis=1), atol=1e-12)
    for c in range(6):
        away = step * np.eye(6)[c]
        # The Jacobian of the step stays: it is the fields that are differentiated.
        fields = []
        for at in (u + away, u - away):
            mean, last = 0.5 * (at[1] + at[4]), at[3]
            fields.append(np.array([[0.0, last * mean, last**2], [0.0, last * (at[4] - at[1]) / np.sqrt(12.0), 0.0]]).T)
        expected = lin.J[0] @ (fields[0] - fields[1]) / (2.0 * step)
        found = (lin.Gramp if c >= 3 else lin.Gu - lin.Gramp)[0, :, :, c % 3]
        assert_allclose(found, expected, atol=1e-8)
