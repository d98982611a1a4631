"""Small errors that grow over a motion: told of where they come to something, and nowhere else."""

from __future__ import annotations

import dataclasses

import numpy as np
import pinocchio as pin
import pytest
from findings import about
from refusals import naming

import varpin as vp
from varpin.model import longest_reach
from varpin.simulation.accuracy import Window, travel_scales
from varpin.simulation.soundness import examined


def jumping(robot, seed, steps, share):
    """Torques about those that hold the middle of a robot's range, which jump at each step."""
    lower, upper = robot.position_limits
    q0 = 0.5 * (np.nan_to_num(lower, neginf=-1.0) + np.nan_to_num(upper, posinf=1.0))
    scene, rng = vp.Scene(robot), np.random.default_rng(seed)
    noise = rng.normal(size=(steps, robot.dof)) * np.minimum(robot.effort_limit, 50.0)
    return scene, q0, scene.holding_torque(q0) + share * noise


def off(scene, q0, motion):
    """By how much a motion is off, of the largest joint travel."""
    fine = {"dt": motion.dt / 8, "steps": 8 * motion.steps, "controls": np.repeat(motion.u, 8, axis=0)}
    true = vp.simulate(scene, q0, motion.v[0], **fine, integrator=vp.Gauss(5), check=False).q[::8]
    return np.abs(motion.q - true).max() / np.ptp(true, axis=0).max()


@pytest.mark.parametrize(("name", "seed"), [("panda", 0), ("panda", 1), ("ur5", 0), ("ur10", 1)])
def test_arms_under_torques_that_jump(load, name, seed):
    """A panda at 20 ms is off by 4 to 30 % and says so; at 2 ms, and other arms, are not."""
    for dt, steps in ((0.02, 50), (0.002, 100)):
        scene, q0, controls = jumping(load(name), seed, steps, 0.2)
        motion = vp.simulate(scene, q0, np.zeros(len(q0)), dt=dt, steps=steps, controls=controls)
        told = about(motion.warnings, "growth")
        wrong = off(scene, q0, motion)
        assert (wrong > 0.01) == bool(told) == ((name, dt) == ("panda", 0.02))


@pytest.mark.parametrize("q0", [[2.0, -1.0, 1.5], [0.1, 0.0, -0.1]], ids=["high", "low"])
def test_a_chain_that_falls(q0):
    """From high up it is chaotic; near rest it swings, and loses phase in ten seconds."""
    scene = vp.Scene(vp.planar_chain(3))
    motion = vp.simulate(scene, q0, np.zeros(3), dt=0.01, steps=1000)
    told = about(motion.warnings, "growth")
    wrong = off(scene, q0, motion)
    assert (wrong > 0.01) == bool(told)
    if told:
        (percent,) = (float(part.split("%")[0]) for part in told[0].split(", ") if "% of the largest" in part)
        assert 0.3 * wrong < percent / 100.0 < 3.0 * wrong


def test_one_violent_step(load):
    """A kinova that falls is off by half of its travel for steps in which it whips about; others are right to 1e-9."""
    damping = [1.136e-2, 1.614e-2, 7.62e-3, 5.4e-4, 1.82e-3, 7e-5]
    scene, q0 = vp.Scene(load("kinova"), damping=damping), np.array([-0.92, 0.87, 0.38, 0.91, 0.62, 0.21])
    v0 = [1.4, 1.9, -1.2, -0.2, 1.0, 0.4]
    motion = vp.simulate(scene, q0, v0, dt=0.002, steps=1368, integrator=vp.RungeKutta4())
    assert off(scene, q0, motion) > 0.2
    assert about(motion.warnings, "growth")


@pytest.mark.parametrize(("name", "dt", "steps", "seed"), [("panda", 0.05, 35, 0), ("kinova", 0.02, 25, 0)])
def test_short_motions_are_told_of_too(load, name, dt, steps, seed):
    """Of a few steps, under torques that jump in each, with the default integrator."""
    scene, q0, controls = jumping(load(name), seed, steps, 0.2)
    motion = vp.simulate(scene, q0, np.zeros(len(q0)), dt=dt, steps=steps, controls=controls)
    assert off(scene, q0, motion) > 0.02
    assert about(motion.warnings, "growth", "coarse steps")


@pytest.mark.parametrize(("dt", "wrong"), [(0.02, True), (0.01, False)])
def test_errors_that_only_add_up_are_told_of_as_such(dt, wrong):
    """A damped chain by a method of first order: off by 1.6 % at 20 ms, by half of it at 10 ms."""
    scene, q0 = vp.Scene(vp.planar_chain(2), gravity=False, damping=2.0), [0.0, 0.7]
    motion = vp.simulate(scene, q0, [1e-3, 0.0], dt=dt, duration=6.0, integrator=vp.SemiImplicitEuler())
    share = off(scene, q0, motion)
    assert (share > 0.01) == wrong
    told = about(motion.warnings, "adding up")
    assert bool(told) == wrong
    assert not about(motion.warnings, "growth")
    if wrong:
        assert f"{100 * share:.2g}% of the largest joint travel" in told[0]


def test_the_scale_of_a_joint_that_hardly_moves_is_that_of_the_others(load):
    """A lift under an arm: a hundredth of what the arm moves at its reach, unless the lift moves more."""
    scene = vp.Scene(load("tiago_no_hand"))
    slides, reach = scene.robot.slides, longest_reach(scene.robot)
    q = np.zeros((3, scene.robot.dof))
    q[1, ~slides], q[1, slides] = 0.5, 1e-5
    np.testing.assert_allclose(travel_scales(scene, q), np.where(slides, 0.005 * reach, 0.5))
    q[1, slides] = 0.3
    np.testing.assert_allclose(travel_scales(scene, q), np.where(slides, 0.3, 0.5))
    q[1, ~slides] = 1e-5
    np.testing.assert_allclose(travel_scales(scene, q), np.where(slides, 0.3, 0.003 / reach))
    chain = vp.Scene(vp.planar_chain(2))
    np.testing.assert_array_equal(travel_scales(chain, np.array([[0.0, 0.0], [1.0, 2.0]])), [2.0, 2.0])


@pytest.mark.parametrize(
    "integrator", [vp.Midpoint(kick="held"), vp.Midpoint(), vp.SemiImplicitEuler(), vp.ExplicitEuler()], ids=str
)
@pytest.mark.parametrize("q0", [[2.0, -1.0, 1.5], [0.1, 0.0, -0.1]], ids=["high", "low"])
@pytest.mark.parametrize(("dt", "steps"), [(0.01, 600), (0.002, 500)])
def test_motions_under_noise(integrator, q0, dt, steps):
    """A chain that falls from high up, or swings; true is the motion under the same forces or kicks in fine steps."""
    robot, parts = vp.planar_chain(3), 8
    scene, plain = vp.Scene(robot, noise=vp.AdditiveNoise(0.02)), vp.Scene(robot)
    motion = vp.simulate(scene, q0, np.zeros(3), dt=dt, steps=steps, rng=1, integrator=integrator)
    fine = {"dt": dt / parts, "steps": steps * parts, "integrator": vp.Gauss(4), "check": False}
    if integrator.holds_noise:
        forces = np.repeat(0.02 * motion.dw / dt, parts, axis=0)
        true = vp.simulate(plain, q0, np.zeros(3), controls=forces, **fine).q[::parts]
    else:
        # A kick after a step is one before the next.
        late = integrator == vp.ExplicitEuler()
        kicks = np.zeros((steps * parts, 3))
        kicks[::parts] = np.roll(motion.dw, 1, axis=0) if late else motion.dw
        kicks[0] *= not late
        true = vp.simulate(scene, q0, np.zeros(3), increments=kicks, **fine).q[::parts]
    wrong = np.abs(motion.q - true).max() / np.ptp(true, axis=0).max()
    told = about(motion.warnings, "growth", "adding up", "coarse steps", "energy")
    assert (wrong > 0.01) == bool(told)
    assert integrator.order == 1 or (wrong > 0.01) == (dt > 0.005)


@pytest.mark.parametrize("far", [0.02, 30.0])
def test_errors_of_joints_that_slide_are_no_shares_of_what_others_turn(far):
    """A cart with a pendulum: 7 % of the way of either is wrong, however far the other one moves."""
    model = pin.Model()
    for k, kind in enumerate((pin.JointModelPX(), pin.JointModelRY())):
        joint = model.addJoint(k, kind, pin.SE3.Identity(), f"joint{k}")
        model.appendBodyToJoint(
            joint, pin.Inertia(1.0, np.array([0.0, 0.0, -0.5]), 0.1 * np.eye(3)), pin.SE3.Identity()
        )
    scene = vp.Scene(vp.load_robot(model), gravity=False)
    motion = vp.simulate(scene, [0.0, 0.0], [far, 1.0], dt=0.01, steps=100, check=False)
    window, travel = Window.at(scene, motion, 0), np.ptp(motion.q, axis=0)
    for joint in (0, 1):
        off = np.zeros((2, 101, 2))
        off[0, -1, joint] = 0.07 * travel[joint]
        error = window.error(scene, motion, np.ones(2), tuple(off), cut=False)
        assert error.joint == joint
        assert error.motion == pytest.approx(0.07, rel=1e-9)
        assert error.worst > 1.0


@pytest.mark.parametrize("noise", [None, 1e-2])
def test_errors_that_feedback_corrects_are_not_said_to_grow(noise):
    """Upright, the recorded torques let the arm fall; under its feedback it is that of a far better method."""
    robot, up = vp.planar_chain(2), np.array([-np.pi / 2, 0.0])
    scene = vp.Scene(robot, damping=0.1, noise=None if noise is None else vp.AdditiveNoise(noise))
    cost = vp.TrackingCost(up, 10.0) + vp.VelocityCost(0.1) + vp.ControlCost(1e-2)
    q0, coarse = np.add(up, [0.1, 0.0]), vp.Midpoint(kick="held")
    options = {"dt": 0.005, "steps": 600}
    problem = vp.OptimalControlProblem(scene, cost, q0, np.zeros(2), hold=10, integrator=coarse, **options)
    plan = vp.solve(problem, check=False)

    def moved(policy, method):
        options["rng"] = None if noise is None else 0
        return vp.simulate(scene, q0, np.zeros(2), **options, controls=policy, integrator=method)

    motion, better = (moved(plan.policy, method) for method in (coarse, vp.Gauss(5, kick="held")))
    np.testing.assert_allclose(motion.q, better.q, rtol=0, atol=1e-5)
    assert [finding.kind for finding in examined(scene, coarse, motion)[1]] == ["growing errors"]
    assert motion.warnings == ()
    if noise is None:
        # Its controls alone let it fall, and where it falls to is wrong: 8 rad.
        assert naming(moved(plan.policy.without_feedback(), coarse).warnings, "disturbances grow")
        # So does a feedback that corrects nothing.
        weak = dataclasses.replace(plan.policy, gains=1e-9 * plan.policy.gains)
        assert naming(moved(weak, coarse).warnings, "disturbances grow")
    else:
        assert not naming(plan.monte_carlo(2, rng=0).warnings, "grow")
