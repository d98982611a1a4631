"""The bundled finger against numbers worked out here from lengths, radii and density."""

import numpy as np
import pinocchio as pin
import pytest

import varpin as vp
from varpin.model import bundled_robots, geometry

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


def test_masses_in_grams(finger):
    assert [round(1e3 * body.mass, 2) for body in list(finger.model.inertias)[1:]] == [14.95, 7.64, 4.59]


def test_stretched_along_x_with_the_tip_at_its_end(finger):
    data = finger.model.createData()
    pin.framesForwardKinematics(finger.model, data, np.zeros(3))
    tip = finger.model.getFrameId("tip", pin.FrameType.BODY)
    np.testing.assert_allclose(data.oMf[tip].translation, [sum(LENGTHS), 0.0, 0.0], rtol=1e-14)
    places = [data.oMi[joint].translation[0] for joint in (1, 2, 3)]
    np.testing.assert_allclose(places, [0.0, LENGTHS[0], LENGTHS[0] + LENGTHS[1]], rtol=1e-14)


def test_moves_in_the_horizontal_plane_and_gravity_along_z_does_no_work(finger):
    rng = np.random.default_rng(3)
    data = finger.model.createData()
    for q in rng.uniform(-2.0, 2.0, (5, 3)):
        np.testing.assert_array_equal(pin.computeGeneralizedGravity(finger.model, data, q), 0.0)
        pin.framesForwardKinematics(finger.model, data, q)
        assert [frame.translation[2] for frame in data.oMf] == [0.0] * len(data.oMf)
        J = pin.computeJointJacobians(finger.model, data, q)
        np.testing.assert_allclose(J[2:5], 0.0, atol=1e-15)
        np.testing.assert_allclose(J[5], 1.0, rtol=1e-15)


def test_positive_angles_flex_within_the_limits(finger):
    lower, upper = finger.position_limits
    np.testing.assert_allclose(np.degrees(lower), [-30.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(np.degrees(upper), [90.0, 100.0, 80.0], rtol=1e-14)
    assert (finger.effort_limit == 10.0).all()
    assert (finger.velocity_limit == 200.0).all()


def test_drawn_with_primitives_alone(finger):
    shapes = geometry(finger).geometryObjects
    assert {shape.parentJoint for shape in shapes} == {0, 1, 2, 3}
    assert all(not shape.meshPath or not shape.meshPath.endswith((".dae", ".stl", ".obj")) for shape in shapes)
