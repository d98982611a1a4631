"""Checks of the force that docs/extending.md adds to the core. test_docs.py runs them behind the page's code."""

import numpy as np
import pytest

import varpin as vp
from varpin.core import element_kinds

K, C, D = 3.0, 5.0, 0.7
BUSH = RubberBush(K, C, D)  # noqa: F821


def energy(q):
    return (0.5 * K * q**2 + 0.25 * C * q**4).sum()


def force(q, v):
    return -D * q**2 * v


def slopes(f, x):
    """The derivative of f in each entry of x, along the first axis, by complex steps."""
    return np.array([f(x + 1e-30j * e).imag / 1e-30 for e in np.eye(x.size)])


def check_formula():
    """Jet and force against the formula, its derivatives by complex steps."""
    assert element_kinds()["RubberBush"] == (3, True, True)
    robot = vp.load_robot("ur5")
    bare, scene = vp.Scene(robot), vp.Scene(robot, forces=BUSH)
    rng = np.random.default_rng(0)
    q, v = rng.normal(size=(2, 6))
    jet, base = vp.lagrangian_jet(scene, q, v), vp.lagrangian_jet(bare, q, v)
    np.testing.assert_allclose(jet.L - base.L, -energy(q), rtol=1e-12)
    pull = slopes(lambda x: -energy(x), q)
    np.testing.assert_allclose(jet.Lq - base.Lq, pull, atol=1e-12)
    bend = slopes(lambda x: -(K * x + C * x**3), q)
    np.testing.assert_allclose(jet.Lqq - base.Lqq, bend, atol=1e-12)
    value, by_q, by_v, heat = (x[0] for x in scene.core.forces(q[None], v[None], np.zeros((1, 6))))
    np.testing.assert_allclose(value, force(q, v), rtol=1e-14)
    np.testing.assert_allclose(np.diag(by_q), slopes(lambda x: force(x, v), q), rtol=1e-14)
    np.testing.assert_allclose(np.diag(by_v), slopes(lambda x: force(q, x), v), rtol=1e-14)
    np.testing.assert_allclose(heat, -force(q, v) * v, rtol=1e-14)


def check_motion():
    """Steps against those of the formula in Python, a loss of energy, and derivatives of steps against differences."""
    robot = vp.planar_chain(1)
    scene = vp.Scene(robot, forces=BUSH)
    assert scene.dissipates
    twin = vp.Scene(robot, forces=vp.CustomForce(lambda q, v: -K * q - C * q**3 + force(q, v), "complex"))
    options = {"dt": 1e-2, "steps": 200, "integrator": vp.Gauss(3)}
    motion, plain = (vp.simulate(own, [1.0], [2.0], **options) for own in (scene, twin))
    np.testing.assert_allclose(motion.q, plain.q, atol=1e-9)
    assert motion.energy[-1] < motion.energy[0] - 0.1
    arm = vp.Scene(vp.load_robot("ur5"), forces=BUSH)
    q, v = np.random.default_rng(1).normal(size=(2, 6))
    for integrator in (vp.Midpoint(), vp.Gauss(2), vp.RungeKutta4()):
        assert vp.check_linearization(arm, q, v, dt=5e-3, integrator=integrator).worst < 1e-8


def check_record(folder):
    """Motions keep its numbers, and what does not know it says so."""
    scene = vp.Scene(vp.planar_chain(1), forces=BUSH)
    vp.simulate(scene, [0.1], [0.0], dt=1e-2, steps=1).save(folder / "bush.npz")
    kept = vp.Trajectory.load(folder / "bush.npz").scene_values["RubberBush"]
    np.testing.assert_array_equal(kept, [[0, K, C, D]])
    with pytest.raises(vp.InputError, match="RubberBush"):
        vp.lagrangian_jet(scene, [0.1], [0.0], backend="pinocchio")


if __name__ == "__main__":
    import sys
    from pathlib import Path

    check_formula()
    check_motion()
    check_record(Path(sys.argv[0]).parent)
