"""Controls that change within a step: their values and means, steps in parts, functions of time."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from oracles import slope
from refusals import refused

import varpin as vp

Q0 = np.array([0.3, -1.2, 0.8, 0.2, 0.5, -0.3])


def force(t):
    return np.array([40.0, 60.0, 30.0, 5.0, 4.0, 3.0]) * np.sin(np.arange(3.0, 9.0) * t + np.arange(6))


@pytest.fixture(scope="module")
def arm():
    return vp.Scene(vp.load_robot("ur5"))


def moments(force, begin, dt):
    """The moments of a function over a step by Legendre's polynomials of degree 0 to 3, and 40 points."""
    x, w = np.polynomial.legendre.leggauss(40)
    values = np.array([force(begin + 0.5 * dt * (1.0 + at)) for at in x])
    return 0.5 * np.polynomial.legendre.legvander(x, 3).T @ (w[:, None] * values)


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(1), vp.Radau(1), vp.ExplicitEuler()], ids=str)
def test_one_stage_holds_the_mean(arm, integrator):
    motion = vp.simulate(arm, Q0, np.zeros(6), dt=0.01, steps=5, controls=vp.OpenLoop(force), integrator=integrator)
    assert_allclose(motion.u, [moments(force, 0.01 * k, 0.01)[0] for k in range(5)], rtol=1e-13)
    assert motion.u_stages.shape == (5, 0, 6)


@pytest.mark.parametrize("integrator", [vp.Gauss(3), vp.Radau(2), vp.RungeKutta4()], ids=str)
def test_values_and_means(arm, integrator):
    motion = vp.simulate(arm, Q0, np.zeros(6), dt=0.01, steps=6, controls=vp.OpenLoop(force), integrator=integrator)
    times = 2.0 * np.array(integrator.stage_times) - 1.0
    for k in range(6):
        of_force = moments(force, 0.01 * k, 0.01)[: len(times)]
        through = np.polynomial.legendre.legfit(times, motion.u_stages[k], len(times) - 1)
        own = through / (2.0 * np.arange(len(times)) + 1.0)[:, None]
        assert_allclose(own, of_force, rtol=0, atol=1e-12 * np.abs(of_force).max())
        assert_allclose(motion.u[k], of_force[0], rtol=1e-12)
    assert motion.part(2, 5).u_stages.shape == (3, len(times), 6)


def stiff_scene():
    robot = vp.planar_chain(3)
    names = robot.joint_names
    return vp.Scene(
        robot,
        damping=0.3,
        forces=[
            vp.PositionServo({names[1]: 40.0}, damping=1.0, effort=25.0),
            vp.CoulombFriction({names[0]: 0.4}, width=3.0),
        ],
    )


SMALL = {"dt": 0.03, "steps": 3}
CHAIN_Q, CHAIN_V = np.array([0.3, -0.4, 0.5]), np.array([1.0, -0.5, 0.8])


def push(t):
    return np.array([3.0 * np.sin(9.0 * t + 1.0), 0.2 + 0.02 * np.sin(7.0 * t), np.sin(5.0 * t + 1.0)])


@pytest.mark.parametrize(("stages", "balance"), [(2, 1e-3), (3, 1e-7)])
def test_derivatives_of_steps_in_parts_against_differences(stages, balance):
    scene, integrator = stiff_scene(), vp.Gauss(stages, guard=vp.Guard(energy_balance=balance))
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

    for f, words in (
        (raises, "RuntimeError"),
        (lambda t: np.where((t >= at)[:, None], np.nan, rising(t)), "[0, 0]"),
    ):
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
