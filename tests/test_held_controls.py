"""What controls that are constant over a step do to the order: control laws, and torques of time alone.

Against DOP853 on Pinocchio's forward dynamics, where such forces act at every instant.
"""

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

import varpin as vp

DURATION = 1.0
MEMBERS = [vp.Midpoint(), *(vp.Gauss(s) for s in (2, 3, 4))]
DAMPING = np.array([0.8, 0.5, 0.3])
Q0, V0 = np.array([0.3, -0.4, 0.5]), np.array([1.0, -0.5, 0.8])
GAIN = np.array([2.0, 1.0, 0.5])


@pytest.fixture(scope="module")
def scene():
    return vp.Scene(vp.planar_chain(3), damping=DAMPING, stiffness=1.5)


def law(t, q, v):
    """A motor that tries to swing, a drag that grows with the square of the speed, and a spring of its own."""
    return np.array([3.0, 2.0, 1.0]) * np.sin(7.0 * t) - GAIN * v * np.abs(v) - 2.0 * q


def swing(t):
    return np.array([3.0, 2.0, 1.0]) * np.sin(7.0 * t)


def exact(scene, force, begin=0.0, end=DURATION, state=None):
    """(q, v) at the end under force(t, q, v), and the scene's own springs and dampers."""
    model, n = scene.robot.model, 3
    data = model.createData()

    def rate(t, x):
        q, v = x[:n], x[n:]
        total = force(t, q, v) - scene.damping * v - scene.stiffness * q
        return np.concatenate([v, pin.aba(model, data, q, v, total)])

    start = np.concatenate([Q0, V0]) if state is None else state
    return solve_ivp(rate, (begin, end), start, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]


def orders(scene, integrator, controls, end, counts):
    errors = []
    for steps in counts:
        motion = vp.simulate(
            scene, Q0, V0, dt=DURATION / steps, steps=steps, controls=controls(steps), integrator=integrator
        )
        assert motion.statistics.split_steps == 0
        errors.append(np.abs(motion.q[-1] - end[:3]).max())
    return np.log(np.divide(errors[:-1], errors[1:])) / np.log(np.divide(counts[1:], counts[:-1])), errors


@pytest.mark.parametrize("integrator", MEMBERS, ids=str)
def test_dampers_and_springs_of_the_scene_keep_the_whole_order(scene, integrator):
    """They act at every stage, and so do torques that change only between steps: four pieces of the swing."""
    pieces = [swing((k + 0.5) * DURATION / 4) for k in range(4)]
    end = None
    for k, piece in enumerate(pieces):
        end = exact(scene, lambda t, q, v, piece=piece: piece, k * DURATION / 4, (k + 1) * DURATION / 4, end)
    counts = {2: (128, 256), 4: (64, 96, 128), 6: (32, 40, 48, 64), 8: (28, 32, 36, 40)}[integrator.order]
    slopes, errors = orders(scene, integrator, lambda steps: np.repeat(pieces, steps // 4, axis=0), end, counts)
    np.testing.assert_allclose(slopes, integrator.order, atol=0.12, err_msg=str(errors))


@pytest.mark.parametrize("integrator", MEMBERS, ids=str)
def test_torques_of_time_held_from_the_middle_are_of_second_order(scene, integrator):
    """Whatever the integrator: what is held over a step is right to second order, and no more."""
    end = exact(scene, lambda t, q, v: swing(t))

    def middles(steps):
        return np.array([swing((k + 0.5) * DURATION / steps) for k in range(steps)])

    slopes, errors = orders(scene, integrator, middles, end, (400, 800, 1600))
    np.testing.assert_allclose(slopes, 2.0, atol=0.1, err_msg=str(errors))


def test_an_open_loop_is_its_rows(scene):
    steps, options = 70, {"dt": 0.01, "steps": 70, "integrator": vp.Midpoint()}
    rows = np.array([swing((k + 0.5) * 0.01) for k in range(steps)])
    by_rows = vp.simulate(scene, Q0, V0, controls=rows, **options)
    by_time = vp.simulate(scene, Q0, V0, controls=vp.OpenLoop(swing), **options)
    np.testing.assert_array_equal(by_time.q, by_rows.q)
    np.testing.assert_array_equal(by_time.u, by_rows.u)
    noisy = vp.Scene(scene.robot, noise=vp.AdditiveNoise(0.1))
    one, other = (
        vp.simulate_ensemble(noisy, Q0, V0, controls=controls, paths=3, rng=0, **options)
        for controls in (rows, vp.OpenLoop(swing))
    )
    np.testing.assert_array_equal(one.q, other.q)


@pytest.mark.parametrize("integrator", [*MEMBERS, vp.RungeKutta4(), vp.ExplicitEuler()], ids=str)
def test_a_law_is_a_digital_controller(scene, integrator):
    """Called once where each period begins, with what is there; under its held controls every order is whole."""
    periods = 10
    length = 0.5 / periods
    state, called = np.concatenate([Q0, V0]), []
    for k in range(periods):
        u = law(k * length, state[:3], state[3:])
        state = exact(scene, lambda t, q, v, u=u: u, 0.0, length, state)

    def recorded(t, q, v):
        called.append((t, q, v))
        return law(t, q, v)

    errors = []
    counts = {1: (64, 128), 2: (8, 16), 4: (4, 6), 6: (2, 3), 8: (1, 2)}[integrator.order]
    for parts in counts:
        called.clear()
        motion = vp.simulate(
            scene, Q0, V0, dt=length / parts, steps=periods * parts, controls=recorded, period=parts,
            integrator=integrator, check=True,
        )  # fmt: skip
        assert len(called) == periods
        for k, (t, q, v) in enumerate(called):
            assert t == pytest.approx(k * length, abs=1e-12)
            np.testing.assert_array_equal(q, motion.q[k * parts])
            np.testing.assert_array_equal(v, motion.v[k * parts])
        np.testing.assert_array_equal(np.diff(motion.u.reshape(periods, parts, 3), axis=1), 0.0)
        errors.append(np.abs(motion.q[-1] - state[:3]).max())
    slope = np.log(errors[0] / errors[1]) / np.log(counts[1] / counts[0])
    assert slope == pytest.approx(integrator.order, abs=0.5) or errors[1] < 1e-11, errors


def test_a_period_that_the_steps_do_not_fill_is_cut(scene):
    called = []
    motion = vp.simulate(
        scene, Q0, V0, dt=0.01, steps=17, controls=lambda t, q, v: called.append(t) or law(t, q, v), period=5
    )
    np.testing.assert_allclose(called, [0.0, 0.05, 0.1, 0.15])
    assert motion.steps == 17
    assert [len(np.unique(motion.u[k : k + 5, 0])) for k in (0, 5, 10, 15)] == [1, 1, 1, 1]


def test_the_hold_alone_is_to_blame(scene):
    """Under the controls it did apply, held, the motion of a high order is exact; the law itself is missed by dt."""
    steps = 40
    dt = DURATION / steps
    motion = vp.simulate(scene, Q0, V0, dt=dt, steps=steps, controls=law, integrator=vp.Gauss(4))
    state = np.concatenate([Q0, V0])
    for k, u in enumerate(motion.u):
        state = exact(scene, lambda t, q, v, u=u: u, k * dt, (k + 1) * dt, state)
    held = np.abs(motion.q[-1] - state[:3]).max()
    missed = np.abs(motion.q[-1] - exact(scene, law)[:3]).max()
    assert held < 1e-10
    assert 1e-4 < missed < 1.0


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(3)], ids=str)
def test_policies_and_laws_are_of_first_order(scene, integrator):
    """As a digital controller is: it acts on the state that was, for the whole of the step."""

    def feedback(t, q, v):
        return -GAIN * v

    end = exact(scene, feedback)
    robot = scene.robot
    data = robot.model.createData()
    gain_on_velocity = np.diag(GAIN)

    def errors_of(run):
        return np.array([np.abs(run(steps).q[-1] - end[:3]).max() for steps in (200, 400, 800)])

    starts = errors_of(
        lambda steps: vp.simulate(
            scene, Q0, V0, dt=DURATION / steps, steps=steps, controls=feedback, integrator=integrator
        )
    )
    # -K v as a policy on (q, p), linear about the motion: v = M(q)^-1 p to first order there.
    model = robot.model

    def policy(steps):
        near = vp.simulate(scene, Q0, V0, dt=DURATION / steps, steps=steps, controls=feedback, integrator=integrator)
        gains, u = np.empty((steps, 3, 6)), np.empty((steps, 3))
        for k in range(steps):
            q, p, v = near.q[k], near.p[k], near.v[k]
            M = np.array(pin.crba(model, data, q))
            M = np.triu(M) + np.triu(M, 1).T
            A = vp.lagrangian_jet(scene, q, v).Lvq
            gains[k] = -gain_on_velocity @ np.linalg.solve(M, np.hstack([-A, np.eye(3)]))
            u[k] = -GAIN * v
            assert p == pytest.approx(M @ v, rel=1e-9, abs=1e-12)
        own = vp.LinearPolicy(u, gains, np.hstack([near.q, near.p]), on="momentum")
        return vp.simulate(scene, Q0, V0, dt=DURATION / steps, steps=steps, controls=own, integrator=integrator)

    for errors in (starts, errors_of(policy)):
        np.testing.assert_allclose(np.log2(errors[:-1] / errors[1:]), 1.0, atol=0.1)
