"""The core's own sines, exponentials and tangents: right to rounding, and the same bytes with and without FMA."""

import os
import subprocess
import sys

import numpy as np
import pytest

import varpin as vp

LINK = vp.Scene(vp.planar_chain(1))


def gravity(q):
    """The generalized force of gravity on a link that is horizontal at q = 0."""
    return vp.lagrangian_jet(LINK, [q], [0.0]).Lq[0]


def test_cosines_of_any_angle():
    rng = np.random.default_rng(0)
    sizes = 10.0 ** rng.uniform(-9.0, 6.0, 400)
    angles = np.concatenate([sizes * rng.choice([-1.0, 1.0], 400), np.pi / 2 * np.arange(-20, 21), [0.0, 1.6e6, 1e9]])
    largest = gravity(0.0)
    expected = largest * np.cos(angles.astype(np.longdouble))
    found = np.array([gravity(q) for q in angles])
    np.testing.assert_allclose(found, expected.astype(float), rtol=4e-16, atol=1e-16 * abs(largest))


RUN = """
import hashlib
import numpy as np
import varpin as vp
robot = vp.planar_chain(3)
forces = [vp.CoulombFriction(0.4, width=0.1), vp.FrameSpring("tip", [1.0, 0.0, -1.0], 5.0, rotational_stiffness=2.0)]
digest = hashlib.sha256()
for integrator in (vp.Midpoint(), vp.Gauss(2), vp.RungeKutta4()):
    motion = vp.simulate(
        vp.Scene(robot, forces=forces), [0.3, -0.2, 2.9], [1.0, 2.0, -3.0], dt=0.01, steps=60, integrator=integrator
    )
    digest.update(motion.q.tobytes() + motion.p.tobytes())
print(digest.hexdigest())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the switch is glibc's")
def test_the_same_bytes_without_fused_multiplications():
    """The C library takes other functions where the processor is said to have no FMA."""
    bytes_of = [
        subprocess.run(
            [sys.executable, "-c", RUN], env=os.environ | tunables, capture_output=True, text=True, check=True
        ).stdout
        for tunables in ({}, {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-FMA4,-AVX2,-AVX2_Usable,-FMA_Usable"})
    ]
    assert bytes_of[0] == bytes_of[1]
