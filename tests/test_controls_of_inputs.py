"""Controls of scenes with kinematic inputs: functions of time, lines, laws and policies, beside forces."""

import functools

import numpy as np
import pytest
from scipy.integrate import solve_ivp

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


@functools.cache
def truth():
    """(q, v) at the end, by DOP853 with the acceleration of the first joint given."""
    free = vp.Scene(vp.planar_chain(3))

    def slope(t, x):
        q, v = x[:3].copy(), x[3:].copy()
        q[0], v[0] = path(t), rate(t)
        jet = vp.lagrangian_jet(free, q, v)
        bias = jet.Lq - jet.Lvq @ v + np.array([0.0, torque(t), 0.0])
        a = np.array([-3.6 * np.sin(3.0 * t), 0.0, 0.0])
        a[1:] = np.linalg.solve(jet.Lvv[1:, 1:], bias[1:] - jet.Lvv[1:, 0] * a[0])
        return np.append(v, a)

    return solve_ivp(slope, (0.0, SPAN), np.append(Q0, V0), "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]


def test_a_motion_under_a_function_of_time_is_linearized():
    """Against differences in the position and the velocity at the end of the step, and in a force held over it."""
    scene = arm("cubic")
    begin = wanted(scene, 0.01)

    def step(u):
        controls = vp.OpenLoop(lambda t: u + np.array([0.0, 3.0 * t, 0.0]))
        return vp.simulate(scene, Q0, V0, dt=0.01, steps=1, controls=controls, integrator=vp.Gauss(2), check=False)

    lin = vp.linearize(scene, step(begin))
    for c, size in enumerate((1e-4, 1e-2, 1e-2)):
        e = size * np.eye(3)[c]
        slope = np.zeros(6)
        for k, w in {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}.items():
            ends = [step(begin + s * k * e) for s in (1, -1)]
            slope += w / size * (np.append(ends[0].q[1], ends[0].p[1]) - np.append(ends[1].q[1], ends[1].p[1]))
        np.testing.assert_allclose(lin.B[0, :, c], slope, atol=1e-8 * np.abs(lin.B[0]).max())


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_a_tolerance_divides_lines_as_the_input_moves(interpolation):
    scene = arm(interpolation)
    nodes = np.array([wanted(scene, x) for x in np.linspace(0.0, SPAN, 9)])
    coarse = vp.FirstOrderHold(nodes)
    found = vp.simulate(scene, Q0, V0, duration=SPAN, tolerance=1e-7, controls=coarse)
    fine = vp.simulate(scene, Q0, V0, dt=SPAN / 8, steps=8, controls=coarse, integrator=vp.Gauss(6), check=False)
    np.testing.assert_allclose(found.q[-1], fine.q[-1], atol=1e-6)


def test_a_tolerance_follows_a_function_of_time():
    scene = arm("cubic")
    controls = vp.OpenLoop(lambda t: wanted(scene, t))
    found = vp.simulate(scene, Q0, V0, duration=SPAN, tolerance=1e-6, controls=controls)
    assert np.abs(found.q[-1] - truth()[:3]).max() < 1e-6


@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("hold", [1, 3])
def test_a_policy_moves_an_input_over_its_intervals(hold, linear):
    """With feedback of the free joints on the position; rows of the record repeat the motion."""
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
    np.testing.assert_allclose(motion.q[at + hold, 0], goals, atol=1e-13)
    np.testing.assert_allclose(motion.u[:, 0], motion.q[1:, 0], atol=1e-13)
    evenly = np.diff(motion.q[:, 0]).reshape(N, hold)
    np.testing.assert_allclose(evenly, np.broadcast_to(evenly[:, :1], evenly.shape), atol=1e-13)
    if not linear:
        again = vp.simulate(scene, Q0, V0, controls=motion.u, **given)
        np.testing.assert_allclose(again.q, motion.q, atol=1e-12)
        paths = vp.simulate_ensemble(scene, Q0, V0, paths=2, rng=0, controls=policy, **given)
        np.testing.assert_allclose(paths.q[0], motion.q, atol=1e-13)
        np.testing.assert_allclose(paths.u[0], motion.u, atol=1e-13)
    np.testing.assert_allclose(vp.linearize(scene, motion).B[:, 0, 0], 1.0, atol=1e-12)
