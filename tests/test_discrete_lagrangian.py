from __future__ import annotations

import naive
import numpy as np
import pinocchio as pin
import pytest
from mechanisms import random_tree
from scipy.integrate import solve_ivp

import varpin as vp


@pytest.fixture(scope="module")
def tree_scene() -> vp.Scene:
    robot = vp.load_robot(random_tree(2, 5))
    return vp.Scene(robot, gravity=(1.0, -2.0, -9.0), stiffness=1.5, rest=0.2)


class TestLegendreTransforms:
    """Orders along an exact motion, q0 = q(0), q1 = q(h).

    With L = m v^2 / 2 - V and m v' = -V', expanding about t = 0:

        -D1 Ld = m (q1 - q0) / h + h (1 - a) V'(q_m) = p(0) + h (1/2 - a) V' + O(h^2),

    and for a = 1/2 the h^2 term is V'' v (1/4 - 1/6) = V'' v / 12, not zero. D2 Ld alike at t = h, with h (1/2 - a) V'
    in the same sense. So each transform alone is of order 1, and of order 2 for a = 1/2; their errors at the two ends
    of a step differ by one power of h more, which is what makes the map that equates them of order 1 and 2.
    The action Ld misses the integral of L by O(h^2), and by O(h^3) for a = 1/2.
    """

    STEPS = 0.01 / 2.0 ** np.arange(5)

    def errors(self, scene: vp.Scene, alpha: float) -> np.ndarray:
        """Errors of -D1, of D2, of their difference, and of Ld; one row a step size."""
        robot, n = scene.robot, scene.robot.dof
        model = robot.model.copy()
        model.gravity = pin.Motion(scene.gravity, np.zeros(3))
        data = model.createData()
        rng = np.random.default_rng(9)
        q, v = rng.uniform(-1.0, 1.0, n), rng.normal(0.0, 1.0, n)

        def rate(t, x):
            force = -scene.stiffness * (x[:n] - scene.rest)
            acceleration = pin.aba(model, data, robot.configuration(x[:n]), x[n : 2 * n], force)
            return np.concatenate([x[n : 2 * n], acceleration, [naive.lagrangian(scene, x[:n], x[n : 2 * n])]])

        exact = solve_ivp(
            rate,
            (0.0, self.STEPS[0]),
            np.concatenate([q, v, [0.0]]),
            method="DOP853",
            t_eval=self.STEPS[::-1],
            rtol=1e-13,
            atol=1e-14,
        ).y.T[::-1]
        p0 = vp.lagrangian_jet(scene, q, v).Lv
        rows = []
        for h, x in zip(self.STEPS, exact, strict=True):
            slots = vp.discrete_lagrangian(scene, q, x[:n], h, alpha=alpha)
            start = -slots.D1 - p0
            end = slots.D2 - vp.lagrangian_jet(scene, x[:n], x[n : 2 * n]).Lv
            rows.append([*(np.linalg.norm(error) for error in (start, end, end - start)), abs(slots.Ld - x[-1])])
        return np.array(rows)

    @pytest.mark.parametrize(
        ("alpha", "orders"), [(0.5, (2, 2, 3, 3)), (0.25, (1, 1, 2, 2)), (0.0, (1, 1, 2, 2)), (1.0, (1, 1, 2, 2))]
    )
    def test_converge_at_their_order(self, tree_scene, alpha, orders):
        errors = self.errors(tree_scene, alpha)
        slopes = np.polyfit(np.log(self.STEPS[-3:]), np.log(errors[-3:]), 1)[0]
        np.testing.assert_allclose(slopes, orders, atol=0.05)

    def test_have_the_derived_constant_on_a_pendulum(self):
        robot = vp.planar_chain(1)
        scene = vp.Scene(robot)
        q, v, h = 0.6, 0.9, 1e-3
        inertia, weight = 1.0 / 3.0, 9.81 / 2.0
        # V = -weight sin(q): positive angles point down.
        V1, V2 = -weight * np.cos(q), weight * np.sin(q)
        a, jerk = -V1 / inertia, -V2 * v / inertia
        q1 = q + h * v + h**2 / 2 * a + h**3 / 6 * jerk
        p0 = inertia * v
        half = vp.discrete_lagrangian(scene, [q], [q1], h)
        assert (-half.D1[0] - p0) / h**2 == pytest.approx(V2 * v / 12, abs=2e-2)
        left = vp.discrete_lagrangian(scene, [q], [q1], h, alpha=0.0)
        assert (-left.D1[0] - p0) / h == pytest.approx(V1 / 2, abs=1e-2)
