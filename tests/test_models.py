"""The bundled finger against numbers worked out here from lengths, radii and density."""

import numpy as np
import pinocchio as pin
import pytest

import varpin as vp
from varpin.model import bundled_robots

LENGTHS = (0.0431, 0.0344, 0.0270)
RADII = (0.010, 0.008, 0.007)
DENSITY = 1104.0


@pytest.fixture(scope="module")
def finger():
    return vp.load_robot("finger")


def test_bundled_and_named(finger):
    assert "finger" in bundled_robots()
    assert finger.joint_names == ("mcp", "pip", "dip")
    assert finger.dof == finger.model.nq == 3


@pytest.mark.parametrize("link", range(3))
def test_mass_and_inertia_of_a_uniform_cylinder(finger, link):
    L, R = LENGTHS[link], RADII[link]
    mass = DENSITY * np.pi * R**2 * L
    across, along = mass * (3.0 * R**2 + L**2) / 12.0, mass * R**2 / 2.0
    body = finger.model.inertias[link + 1]
    np.testing.assert_allclose(body.mass, mass, rtol=1e-14)
    np.testing.assert_allclose(body.lever, [L / 2.0, 0.0, 0.0], rtol=1e-14)
    np.testing.assert_allclose(body.inertia, np.diag([along, across, across]), rtol=1e-13, atol=1e-30)


def test_stretched_along_x_with_the_tip_at_its_end(finger):
    data = finger.model.createData()
    pin.framesForwardKinematics(finger.model, data, np.zeros(3))
    tip = finger.model.getFrameId("tip", pin.FrameType.BODY)
    np.testing.assert_allclose(data.oMf[tip].translation, [sum(LENGTHS), 0.0, 0.0], rtol=1e-14)
    places = [data.oMi[joint].translation[0] for joint in (1, 2, 3)]
    np.testing.assert_allclose(places, [0.0, LENGTHS[0], LENGTHS[0] + LENGTHS[1]], rtol=1e-14)
