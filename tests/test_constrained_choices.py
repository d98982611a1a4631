"""Tolerances, advice and measurements of work and precision under constraints, against DOP853 on Pinocchio's calls."""

import functools

import numpy as np
import pytest
from battery.loops import LOOPS
from findings import about
from refusals import refused

import varpin as vp
from varpin.mechanics.assembly import along_constraints


def four_bar(**options):
    scene = vp.Scene(vp.planar_chain(3), constraints=vp.PointOnPoint("tip", (1.3, 0.0, 0.2), axes="xz"), **options)
    q = vp.assemble(scene, [-1.5, 1.5, 1.5])
    return scene, q, along_constraints(scene, q, np.array([1.0, 0.0, 0.0]))


@functools.cache
def exact(number, times=17):
    """A loop without controls, a state in it, and its motion by DOP853 at 1e-12."""
    loop = LOOPS[number]()
    assert loop.controls is None
    return loop, *loop.state(), loop.motion(times)[0]


@pytest.mark.parametrize("number", [0, 13, 14])
@pytest.mark.parametrize("tolerance", [1e-3, 1e-8])
def test_tolerances_are_met(number, tolerance):
    loop, q, v, truth = exact(number)
    motion = vp.simulate(loop.scene, q, v, duration=loop.duration, tolerance=tolerance)
    assert {told.kind for told in motion.warnings} <= {"position limits", "velocity limits"}
    assert motion.accuracy.met
    off = np.abs(motion.q[-1] - truth[-1]).max()
    assert off < max(tolerance, 1e-10)
    assert off < 1.5 * motion.accuracy.error + 1e-10


def test_a_tolerance_with_a_start_off_the_constraints_says_that_it_was_moved():
    scene, q, v = four_bar()
    motion = vp.simulate(scene, q + 1e-3, v, duration=0.2, tolerance=1e-6)
    assert about(motion.warnings, "start off the constraints")


def test_methods_that_keep_no_constraints_are_refused_with_a_tolerance():
    scene, q, v = four_bar()
    with refused(vp.InputError, "Radau"):
        vp.simulate(scene, q, v, duration=0.2, tolerance=1e-6, integrator=vp.Radau(3))


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_a_tolerance_beside_a_joint_that_is_moved_by_hand_keeps_its_path(interpolation):
    hand = vp.KinematicInput("joint1", interpolation)
    scene = vp.Scene(vp.planar_chain(3), actuation=["joint1"], constraints=hand)
    t = np.linspace(0.0, 1.0, 9)[1:]
    u = np.column_stack([0.5 * (1.0 - np.cos(3.0 * t)), 1.5 * np.sin(3.0 * t)])[:, : scene.controls]
    start = np.array([0.0, 1.5, 0.0]), np.zeros(3)
    motion = vp.simulate(scene, *start, duration=1.0, tolerance=1e-7, controls=u)
    assert motion.accuracy.met
    np.testing.assert_allclose(motion.q[:: motion.steps // 8][1:, 0], u[:, 0], atol=1e-13)
    fine = vp.simulate(scene, *start, duration=1.0, tolerance=1e-11, controls=u, integrator=vp.Gauss(3))
    assert np.abs(motion.q[-1] - fine.q[-1]).max() < 1e-7


def test_a_custom_constraint_that_fails_under_a_tolerance_is_an_error_with_the_motion():
    def value(q):
        if q[0] > 0.6:
            raise ValueError("too far")
        return [q[0] - 0.5 * q[1]]

    own = vp.CustomConstraint(1, value, lambda q: [[1.0, -0.5]])
    scene = vp.Scene(vp.planar_chain(2), gravity=False, constraints=own)
    with refused(vp.ConstraintError, "too far") as caught:
        vp.simulate(scene, [0.5, 1.0], [1.0, 2.0], duration=0.5, tolerance=1e-4)
    assert 0.5 < caught.value.trajectory.q[-1, 0] < 0.61


def test_work_and_precision_under_constraints():
    scene, q, v = four_bar(damping=0.1)
    record = vp.work_precision(scene, q, v, duration=0.4, dts=[0.01, 0.005], repeats=1)
    assert {run.integrator for run in record.runs} == {
        "Midpoint(alpha=0.5)", *(f"Gauss(stages={stages})" for stages in (2, 3, 4, 5))
    }  # fmt: skip
    assert record.reference == "Gauss(stages=4) in ever smaller steps"
    assert record.reference_error < 1e-12
    # A damped motion keeps no energy.
    assert all(np.isnan(run.energy_error) for run in record.runs)
    coarse, fine = (run for run in record.runs if run.order == 2)
    assert np.log2(coarse.error / fine.error) == pytest.approx(2.0, abs=0.3)
    with refused(vp.InputError, "RungeKutta4", "constraints"):
        vp.work_precision(scene, q, v, duration=0.4, integrators=[vp.RungeKutta4()])


def test_advice_under_constraints():
    loop, q, v, truth = exact(13)
    advice = vp.advise(loop.scene, q, v, duration=loop.duration, tolerance=1e-6)
    assert advice.reached
    motion = vp.simulate(
        loop.scene, q, v, dt=advice.best.dt, steps=advice.best.steps, integrator=advice.best.integrator
    )
    assert np.abs(motion.q[-1] - truth[-1]).max() < 2e-6


def test_advice_says_in_the_log_that_the_start_was_moved(caplog):
    scene, q, v = four_bar()
    vp.advise(scene, q + 1e-3, v, duration=0.1, tolerance=1e-3)
    assert about(caplog.messages, "start off the constraints")


def test_plans_of_a_loop_by_different_integrators():
    robot = vp.planar_chain(4)
    drives = np.zeros((4, 2))
    drives[0, 0] = drives[3, 1] = 1.0
    loop = vp.PointOnPoint("tip", (1.6, 0.0, 0.3), axes="xz")
    scene = vp.Scene(robot, constraints=loop, actuation=drives, damping=0.1)
    q0 = vp.assemble(scene, [-1.0, 1.0, 1.0, 1.0])
    goal = vp.assemble(scene, q0 + np.array([0.3, 0.0, 0.0, 0.0]))
    cost = vp.ControlCost(1e-3) + vp.Terminal(vp.TrackingCost(goal, 1e3) + vp.VelocityCost(10.0))
    problem = vp.OptimalControlProblem(scene, cost, q0, np.zeros(4), dt=0.04, steps=10)
    record = vp.optimal_control_tradeoff(problem, integrators=[vp.Midpoint(), vp.Gauss(2)], dts=[0.04], repeats=1)
    rough, good = record.runs
    assert not rough.failure
    assert abs(good.closed_loop_cost / good.planned_cost - 1.0) < abs(rough.closed_loop_cost / rough.planned_cost - 1.0)
