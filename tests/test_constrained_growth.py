"""Chaotic motions under constraints: told where the errors of steps grow, against small steps of high order."""

import numpy as np
import pytest
from findings import about

import varpin as vp
from varpin.mechanics.assembly import along_constraints
from varpin.mechanics.inputs import held_in_parts


@pytest.mark.parametrize(("steps", "integrator", "grows"), [
    (20, vp.Gauss(2), True), (60, vp.Gauss(2), True), (1200, vp.Gauss(4), False),
], ids=str)  # fmt: skip
def test_errors_that_grow_are_told(steps, integrator, grows):
    """A five-bar whose motors pull it round and round."""
    scene = vp.Scene(vp.planar_chain(4), constraints=vp.PointOnPoint("tip", (1.6, 0.0, 0.3), axes="xz"), damping=0.1)
    q = vp.assemble(scene, [-1.0, 1.0, 1.0, 1.0])
    rng = np.random.default_rng(2)
    force = 3.0 * rng.normal(size=4)
    v = along_constraints(scene, q, 3.0 * rng.normal(size=4))
    motion = vp.simulate(scene, q, v, duration=1.0, steps=steps, controls=force, integrator=integrator)
    parts = 2400 // steps
    fine = vp.simulate(scene, q, v, duration=1.0, steps=2400, controls=force, integrator=vp.Gauss(5), check=False)
    off = np.abs(motion.q - fine.q[::parts]).max() / np.ptp(fine.q, axis=0).max()
    assert (off > 0.05) == grows
    assert bool(about(motion.warnings, "growth")) == grows, (off, motion.warnings)


@pytest.mark.parametrize(("interpolation", "rate", "width"), [("cubic", 10.0, 0.6)])
def test_errors_that_grow_are_told_where_a_joint_is_moved(interpolation, rate, width):
    """Five links swing on a crank that is moved to and fro."""
    loop, hand = vp.PointOnPoint("tip", (2.5, 0.0, 0.3), axes="xz"), vp.KinematicInput("joint1", interpolation)
    scene = vp.Scene(vp.planar_chain(6), constraints=[loop, hand], actuation=["joint1"])
    q, v = vp.assemble(scene, [-1.0, 0.8, 0.6, 0.6, 0.5, 0.4]), np.zeros(6)
    t = np.linspace(0.0, 2.0, 1001)[1:]
    turn = [q[0] + width * (1.0 - np.cos(rate * t)), width * rate * np.sin(rate * t)]
    rows = np.stack(turn[: scene.controls], axis=1)
    for integrator, fine, grows in ((vp.Gauss(2), 4, True), (vp.Gauss(5), 2, False)):
        motion = vp.simulate(scene, q, v, dt=2e-3, steps=1000, controls=rows, integrator=integrator)
        parts = held_in_parts(scene, rows, q, v, 2e-3, fine)
        given = {"dt": 2e-3 / fine, "steps": 1000 * fine, "integrator": vp.Gauss(5)}
        exact = vp.simulate(scene, q, v, controls=parts, check=False, **given).q[::fine]
        off = np.abs(motion.q - exact).max() / np.ptp(exact, axis=0).max()
        assert (off > 0.05) == grows
        assert bool(about(motion.warnings, "growth")) == grows, off


def test_growth_without_freedom():
    """All joints are held: nothing can grow, and nothing fails."""
    scene = vp.Scene(vp.planar_chain(2), constraints=vp.PointOnPoint("tip", (1.2, 0.0, 0.4), axes="xz"))
    q = vp.assemble(scene, [-0.5, 1.0])
    motion = vp.simulate(scene, q, np.zeros(2), dt=0.01, steps=60)
    np.testing.assert_allclose(motion.q, np.tile(q, (61, 1)), atol=1e-12)
    assert not about(motion.warnings, "growth")
