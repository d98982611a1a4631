"""The look at finished motions under constraints: held against DOP853, and joints moved by hand in parts of steps."""

import numpy as np
import pytest
from battery.loops import LOOPS
from findings import about
from scipy.interpolate import CubicHermiteSpline

import varpin as vp
from varpin.mechanics.assembly import along_constraints
from varpin.mechanics.inputs import in_parts_of_steps
from varpin.simulation.retaking import taken_again
from varpin.simulation.soundness import motion_error, resolution_of


def four_bar(**options):
    scene = vp.Scene(vp.planar_chain(3), constraints=vp.PointOnPoint("tip", (1.3, 0.0, 0.2), axes="xz"), **options)
    q = vp.assemble(scene, [-1.5, 1.5, 1.5])
    return scene, q, along_constraints(scene, q, np.array([1.0, 0.0, 0.0]))


def test_coarse_steps_under_constraints_are_spoken_of_and_fine_ones_are_not():
    scene, q, v = four_bar()
    fine = vp.simulate(scene, q, v, duration=3.0, steps=1200, integrator=vp.Gauss(4), check=False)
    for steps, coarse in ((20, True), (100, True), (1200, False)):
        motion = vp.simulate(scene, q, v, duration=3.0, steps=steps, integrator=vp.Midpoint())
        off = np.abs(motion.q - fine.q[:: 1200 // steps]).max() / np.ptp(fine.q, axis=0).max()
        assert bool(about(motion.warnings, "coarse steps")) == coarse
        assert off > 0.05 if coarse else off < 0.01


def test_the_estimate_is_the_error():
    scene, q, v = four_bar()
    motion = vp.simulate(scene, q, v, duration=3.0, steps=100, integrator=vp.Midpoint(), check=False)
    error = motion_error(scene, vp.Midpoint(), motion)
    part = motion.part(error.step, motion.steps)
    fine = vp.simulate(scene, part.q[0], part.v[0], dt=3e-3, steps=10 * part.steps, integrator=vp.Gauss(4), check=False)
    off = np.abs(part.q - fine.q[::10])[:, error.joint].max() / np.ptp(part.q[:, error.joint])
    assert 0.5 * off < error.position < 2.0 * off
    assert off > 0.05


def test_fine_steps_are_known_by_steps_of_twice_the_length():
    scene, q, v = four_bar()
    motion = vp.simulate(scene, q, v, dt=1e-3, steps=400, integrator=vp.Gauss(2))
    assert resolution_of(scene, vp.Gauss(2), motion).resolved
    assert not motion.warnings


def test_a_loop_of_stiff_springs_is_not_wrong_in_silence():
    loop = LOOPS[16]()
    q = vp.assemble(loop.scene, loop.start)
    v = along_constraints(loop.scene, q, loop.push)
    motion = vp.simulate(loop.scene, q, v, duration=loop.duration, steps=6, integrator=vp.Midpoint())
    assert motion.statistics.split_steps == 0
    assert about(motion.warnings, "coarse steps")


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_joints_moved_by_hand_go_the_same_way_in_parts_of_steps(interpolation):
    scene = vp.Scene(
        vp.planar_chain(3), actuation=["joint3", "joint1"], constraints=vp.KinematicInput("joint1", interpolation)
    )
    t = 0.05 * np.arange(1, 5)
    u = np.column_stack([np.sin(9.0 * t), 0.3 + 0.4 * np.sin(3.0 * t), 1.2 * np.cos(3.0 * t)])[:, : scene.controls]
    q0, v0 = np.array([0.3, 0.5, -0.4]), np.array([1.2, 0.0, 0.0])
    motion = vp.simulate(scene, q0, v0, dt=0.05, steps=4, controls=u, integrator=vp.Gauss(3), check=False)
    fine = in_parts_of_steps(scene, u, motion.q[:-1], motion.v[:-1], 0.05, 3)
    at = 0.05 / 3.0 * np.arange(1, 13)
    nodes = np.append(0.0, t)
    if interpolation == "linear":
        np.testing.assert_allclose(fine[:, 1], np.interp(at, nodes, np.append(0.3, u[:, 1])), atol=1e-15)
    else:
        cubic = CubicHermiteSpline(nodes, np.append(0.3, u[:, 1]), np.append(1.2, u[:, 2]))
        np.testing.assert_allclose(fine[:, 1], cubic(at), atol=1e-14)
        np.testing.assert_allclose(fine[:, 2], cubic(at, 1), atol=1e-13)
    np.testing.assert_array_equal(fine[:, 0], np.repeat(u[:, 0], 3))
    again = taken_again(scene, vp.Gauss(4), motion, (), 1, 3, 3)
    np.testing.assert_allclose(again[0], motion.q[1:], atol=1e-6)
    np.testing.assert_allclose(again[1], motion.v[1:], atol=1e-4)


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_coarse_steps_beside_a_joint_that_is_moved_by_hand_are_spoken_of(interpolation):
    hand = vp.KinematicInput("joint1", interpolation)
    scene = vp.Scene(vp.planar_chain(3), actuation=["joint1"], constraints=hand)
    start = np.array([0.0, 1.5, 0.0]), np.zeros(3)
    for steps, coarse in ((20, True), (160, False)):
        t = np.linspace(0.0, 3.0, steps + 1)[1:]
        u = np.column_stack([0.5 * (1.0 - np.cos(3.0 * t)), 1.5 * np.sin(3.0 * t)])[:, : scene.controls]
        motion = vp.simulate(scene, *start, duration=3.0, steps=steps, controls=u, integrator=vp.Midpoint())
        assert bool(about(motion.warnings, "coarse steps")) == coarse
        parts = in_parts_of_steps(scene, u, motion.q[:-1], motion.v[:-1], 3.0 / steps, 20)
        fine = vp.simulate(
            scene, *start, duration=3.0, steps=20 * steps, controls=parts, integrator=vp.Gauss(3), check=False
        )
        off = np.abs(fine.q[::20] - motion.q).max()
        assert off > 0.1 if coarse else off < 0.01


def test_a_function_that_fails_in_the_look_leaves_the_motion():
    calls = [np.inf]

    def value(q):
        calls[0] -= 1
        if calls[0] < 0:
            raise ValueError("enough")
        return [q[0] - 0.5 * q[1]]

    def jacobian(q):
        value(q)
        return [[1.0, -0.5]]

    scene = vp.Scene(vp.planar_chain(2), constraints=vp.CustomConstraint(1, value, jacobian))
    start = np.array([0.5, 1.0]), np.array([0.1, 0.2])
    before = vp.simulate(scene, *start, dt=1e-2, steps=5, check=False)
    calls[0] = 0

    def count(scene, *, check):
        calls[0], first = 10**6, 10**6
        vp.simulate(scene, *start, dt=1e-2, steps=5, check=check)
        return first - calls[0]

    needed = count(scene, check=False)
    assert count(scene, check=True) > needed
    calls[0] = needed
    motion = vp.simulate(scene, *start, dt=1e-2, steps=5)
    np.testing.assert_array_equal(motion.q, before.q)
    assert about(motion.warnings[0], "unchecked")
