"""Chaotic motions under constraints: told where the errors of steps grow, against small steps of high order."""

import numpy as np
import pytest
from findings import about

import varpin as vp
from varpin.mechanics.assembly import along_constraints


def five_bar(torque):
    """Two motors pull at a five-bar in opposite ways."""
    scene = vp.Scene(vp.planar_chain(4), constraints=vp.PointOnPoint("tip", (1.6, 0.0, 0.3), axes="xz"))
    q = vp.assemble(scene, [-1.0, 1.0, 1.0, 1.0])
    return (
        scene,
        q,
        along_constraints(scene, q, np.array([2.0, -1.0, 3.0, 1.0])),
        torque * np.array([1.0, -1.0, 1.0, -1.0]),
    )


@pytest.mark.parametrize(("torque", "steps", "integrator"), [
    (12.0, 20, vp.Gauss(2)), (12.0, 300, vp.Midpoint()), (0.0, 300, vp.Gauss(3)),
], ids=str)  # fmt: skip
def test_errors_that_grow_are_told(torque, steps, integrator):
    scene, q, v, force = five_bar(torque)
    motion = vp.simulate(scene, q, v, duration=2.0, steps=steps, controls=force, integrator=integrator)
    parts = 2400 // steps
    fine = vp.simulate(
        scene, q, v, duration=2.0, steps=steps * parts, controls=force, integrator=vp.Gauss(5), check=False
    )
    exact = fine.q[::parts]
    off = np.abs(motion.q - exact).max() / np.ptp(exact, axis=0).max()
    assert off > 0.05 or off < 1e-4
    assert bool(motion.warnings) == (off > 0.05), (off, motion.warnings)


def test_growth_without_freedom():
    """All joints are held: nothing can grow, and nothing fails."""
    scene = vp.Scene(vp.planar_chain(2), constraints=vp.PointOnPoint("tip", (1.2, 0.0, 0.4), axes="xz"))
    q = vp.assemble(scene, [-0.5, 1.0])
    motion = vp.simulate(scene, q, np.zeros(2), dt=0.01, steps=60)
    np.testing.assert_allclose(motion.q, np.tile(q, (61, 1)), atol=1e-12)
    assert not about(motion.warnings, "growth")
