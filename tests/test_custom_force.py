"""Forces that a user writes: against varpin's own, Pinocchio's aba, and differences."""

import gc
import itertools
import weakref

import numpy as np
import pytest
from refusals import refused, unnamed

import varpin as vp

ROBOT = vp.planar_chain(3)
NAMES = ROBOT.joint_names
Q0, V0 = np.array([0.3, -0.4, 0.5]), np.array([1.0, -0.5, 0.8])
D = np.array([[0.5, 0.1, 0.0], [0.1, 0.4, -0.1], [0.0, -0.1, 0.3]])


def drag(q, v):
    """Full in its matrices, and neither linear nor a gradient."""
    return -D @ v * (1.0 + 0.3 * np.sin(q)) + np.array([0.5 * q[1] * q[2], -q[0], np.cos(q[0]) * v[1]])


def slopes(q, v):
    by_q = -np.diag(D @ v * 0.3 * np.cos(q))
    by_q += np.array([[0.0, 0.5 * q[2], 0.5 * q[1]], [-1.0, 0.0, 0.0], [-np.sin(q[0]) * v[1], 0.0, 0.0]])
    by_v = -(1.0 + 0.3 * np.sin(q))[:, None] * D
    by_v[2, 1] += np.cos(q[0])
    return by_q, by_v


def simulate(own, **options):
    given = {"dt": 0.01, "steps": 5, "controls": [1.0, 0.5, -0.2], "check": False}
    return vp.simulate(own, Q0, V0, **(given | options))


@pytest.mark.parametrize("derivatives", ["complex", None])
def test_all_derivatives_agree(derivatives):
    given, other = (vp.CustomForce(drag, how) for how in (slopes, derivatives))
    for q, v in itertools.product(np.random.default_rng(0).normal(size=(3, 3)), repeat=2):
        for one, two in zip(given.slopes(q, v), other.slopes(q, v), strict=True):
            np.testing.assert_allclose(one, two, rtol=0, atol=1e-14 if derivatives else 1e-10)


def test_holding():
    own = vp.Scene(ROBOT, forces=vp.CustomForce(lambda q, v: np.array([1.0, -2.0, 0.5]) + v))
    torque = vp.Scene(ROBOT).holding_torque(Q0) - [1.0, -2.0, 0.5]
    np.testing.assert_allclose(own.holding_torque(Q0), torque, atol=1e-12)
    controls = own.holding_controls(Q0)
    held = vp.simulate(own, Q0, np.zeros(3), dt=0.01, steps=3, controls=controls, check=False)
    np.testing.assert_allclose(held.q, np.tile(Q0, (4, 1)), atol=1e-12)


@pytest.mark.parametrize(
    ("force", "facts"),
    [
        (vp.CustomForce(lambda q, v: np.zeros(2)), ("CustomForce <lambda>", "(3,)")),
        (vp.CustomForce(lambda q, v: 1j * v), ("CustomForce <lambda>", "real numbers")),
        (vp.CustomForce(lambda q, v: v / 0.0 if q[0] > 0.31 else v), ("CustomForce <lambda>", "finite", "q = ")),
        (vp.CustomForce(lambda q, v: 1 / 0), ("CustomForce <lambda>", "ZeroDivisionError")),
        (vp.CustomForce(drag, lambda q, v: np.eye(3)), "derivatives"),
        (vp.CustomForce(drag, lambda q, v: (np.eye(3), np.eye(2))), "derivatives"),
    ],
)
def test_what_is_no_force(force, facts):
    with refused(vp.ForceError, facts) as info, np.errstate(all="ignore"):
        simulate(vp.Scene(ROBOT, forces=force))
    assert info.value.trajectory.steps == info.value.step


def test_wrong_arguments():
    with refused(vp.InputError, "function"):
        vp.CustomForce(np.zeros(3))
    with refused(vp.InputError, "'exact'"):
        vp.CustomForce(drag, "exact")


def test_shown():
    assert repr(vp.CustomForce(drag, "complex")) == "CustomForce(drag, derivatives by complex steps)"


def test_differences_take_steps_smaller_than_what_they_look_at():
    """Friction that turns round within a ten-thousandth [rad/s]."""
    own = vp.CustomForce(lambda q, v: -0.5 * np.tanh(v / 1e-4))
    for v in (0.0, 2e-5, 1e-4, 3e-4, 0.01):
        _, by_v = own.slopes(np.zeros(3), np.full(3, v))
        exact = -0.5 / 1e-4 / np.cosh(v / 1e-4) ** 2
        np.testing.assert_allclose(by_v, exact * np.eye(3), rtol=0, atol=1e-6 * max(1.0, abs(exact)))


class TestDerivativesThatAreWrong:
    def test_given_ones_are_named(self):
        def wrong(q, v):
            by_q, by_v = slopes(q, v)
            by_v[0, 1] += 0.3
            return by_q, by_v

        exact = slopes(Q0, V0)[1][0, 1]
        for start in (
            simulate,
            lambda own: simulate(own, integrator=vp.RungeKutta4()),
            lambda own: simulate(own, dt=None, steps=None, duration=0.1, tolerance=1e-4),
        ):
            values = f"{exact + 0.3:.8g}", f"{exact:.8g}"
            with refused(vp.CustomForceError, "CustomForce drag", "dF/dv[0, 1]", values, "q = [ 0.3 -0.4  0.5]"):
                start(vp.Scene(ROBOT, forces=vp.CustomForce(drag, wrong)))

    def test_complex_steps_are_tried_where_the_motion_starts(self):
        """Beyond a threshold the function drops imaginary parts, and near zero it does not."""

        def f(q, v):
            return -v * (np.abs(v) if v[0].real > 5.0 else 1.0)

        own = vp.Scene(ROBOT, forces=vp.CustomForce(f, "complex"))
        vp.simulate(own, Q0, V0, dt=1e-2, steps=2)
        with refused(vp.CustomForceError, "dF/dv[0, 0]"):
            vp.simulate(vp.Scene(ROBOT, forces=vp.CustomForce(f, "complex")), Q0, [6.0, 0, 0], dt=1e-2, steps=2)

    def test_jumps_at_the_start_are_no_fault(self):
        """A function without derivatives there, whose own are right elsewhere."""
        own = vp.CustomForce(lambda q, v: -np.sign(v), lambda q, v: (np.zeros((3, 3)), np.zeros((3, 3))))
        vp.Scene(ROBOT, forces=own).custom.check(Q0, np.zeros(3))


def breaks(q, v):
    """Not defined from some place on, where motions from Q0 and V0 come by."""
    if q[0] > 0.36:
        raise ValueError("beyond the table")
    return -v


def damps(q, v):
    return np.zeros((3, 3)), -np.eye(3)


class TestWhereItFails:
    own = staticmethod(lambda **options: vp.Scene(ROBOT, forces=vp.CustomForce(breaks, damps), **options))

    def check(self, error):
        assert error.trajectory.steps == error.step > 0
        assert not unnamed(str(error), "beyond the table", "q = [")
        assert error.time == error.trajectory.t[-1]

    def test_with_a_tolerance(self):
        with pytest.raises(vp.ForceError) as info:
            vp.simulate(self.own(), Q0, V0, duration=0.5, tolerance=1e-5)
        self.check(info.value)

    def test_coarse_steps_may_fail(self):
        reach = vp.simulate(vp.Scene(ROBOT, damping=1.0), Q0, V0, dt=1e-3, steps=100).q[:, 0].max() + 2e-3

        def edge(q, v):
            if q[0] > reach:
                raise ValueError("beyond the table")
            return -v

        motion = vp.simulate(vp.Scene(ROBOT, forces=vp.CustomForce(edge, damps)), Q0, V0, duration=0.1, tolerance=1e-5)
        assert motion.accuracy.met

    def test_in_a_plan(self):
        """On the first motion it is an error; later on it costs trials."""
        cost = vp.ControlCost(1e-3) + vp.TrackingCost([0.6, -0.4, 0.5], 10.0)
        problem = vp.OptimalControlProblem(self.own(gravity=False), cost, Q0, V0, dt=0.03, steps=10)
        with pytest.raises(vp.ForceError) as info:
            vp.solve(problem, np.zeros(3))
        self.check(info.value)
        still = problem.at(v0=np.zeros(3))
        plan = vp.solve(still, np.zeros(3), max_iterations=4, check=False)
        assert plan.trajectory.q[:, 0].max() <= 0.37
        assert plan.cost < still.cost_of(still.simulate(np.zeros((10, 3))))

    def test_newton_names_it(self):
        jumps = vp.CustomForce(lambda q, v: -200.0 * np.sign(v - 0.013))
        own = vp.Scene(ROBOT, gravity=False, forces=jumps)
        with refused(vp.StepFailure, "CustomForce <lambda>"):
            vp.simulate(own, Q0, V0, dt=0.01, steps=50, integrator=vp.Gauss(2), check=False)


@pytest.mark.parametrize("kind", ["force", "constraint"])
def test_a_scene_whose_function_knows_it_is_collected(kind):
    """The core's own reference is none that keeps it alive."""

    def made():
        box = []
        if kind == "force":
            scene = vp.Scene(ROBOT, forces=vp.CustomForce(lambda q, v: -0.1 * v * len(box)))
        else:
            own = vp.CustomConstraint(1, lambda q: [q[0] * len(box)], lambda q: [[1.0, 0.0, 0.0]])
            scene = vp.Scene(ROBOT, constraints=own)
        box.append(scene)
        vp.simulate(scene, np.zeros(3), np.zeros(3), dt=1e-2, steps=2)
        return weakref.ref(scene)

    gone = made()
    gc.collect()
    assert gone() is None
