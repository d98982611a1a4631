"""The textbook against the rest of the library, which shares no code with it, and against differences."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from refusals import refused

import varpin as vp
from varpin import textbook

rng = np.random.default_rng(20)


def pair(robot, *, noise=None, fields=textbook.no_noise, gravity=(0.0, 0.0, -9.81), **surroundings):
    model = robot.model.copy()
    model.gravity = pin.Motion(np.array(gravity), np.zeros(3))
    scene = vp.Scene(robot, gravity=gravity, noise=noise, **surroundings)
    return scene, textbook.system(model, fields=fields, **surroundings)


@pytest.fixture(scope="module", params=["finger", "ur5", "chain"])
def arm(request):
    robot = vp.planar_chain(3) if request.param == "chain" else vp.load_robot(request.param)
    n = robot.dof
    return pair(robot, damping=np.linspace(0.0, 0.02, n), stiffness=np.linspace(0.3, 0.0, n), rest=0.2)


@pytest.mark.parametrize("alpha", [0.5, 0.2])
def test_motions_and_linearizations_are_those_of_the_textbook(arm, alpha):
    scene, system = arm
    # The finger's inertias are a millionth of the others': 0.1 ms are to it what 2 ms are to them.
    n, N, h = scene.robot.dof, 20, 1e-4 if scene.robot.name == "finger" else 2e-3
    q0, v0 = 0.3 * rng.normal(size=(2, n))
    scale = np.abs(vp.lagrangian_jet(scene, q0, v0).Lq).max()
    u = 0.1 * scale * rng.normal(size=(N, n))
    ours = vp.simulate(scene, q0, v0, dt=h, steps=N, controls=u, integrator=vp.Midpoint(alpha), check=False)
    assert ours.statistics.split_steps == 0
    theirs = textbook.rollout(system, q0, v0, u, h, a=alpha)
    assert np.abs(ours.q - theirs.q).max() <= 1e-11 * np.abs(theirs.q).max()
    assert np.abs(ours.p - theirs.p).max() <= 1e-10 * np.abs(theirs.p).max()
    lin = vp.linearize(scene, ours, integrator=vp.Midpoint(alpha))
    for k in (0, N - 1):
        own = textbook.linearize_step(system, theirs.q[k], theirs.q[k + 1], u[k], h, alpha)
        for name in ("A", "B", "K"):
            expected = getattr(own, name)
            # Blocks of x = (q, p) have units of their own.
            for part in (slice(0, n), slice(n, 2 * n)):
                gap = np.abs(getattr(lin, name)[k][part] - expected[part]).max()
                assert gap <= 1e-8 * np.abs(expected[part]).max(), (name, k)


NOISES = {
    "white": (vp.AdditiveNoise(1e-2), textbook.white_noise(1e-2)),
    "control": (vp.ControlNoise(3e-2), textbook.control_noise(3e-2)),
    "state": (vp.StateNoise(5e-2), textbook.state_noise(5e-2, np.array([0.4, 0.1, -0.2]))),
}


@pytest.mark.parametrize("name", NOISES)
def test_noise_acts_as_in_the_textbook(name):
    noise, fields = NOISES[name]
    scene, system = pair(vp.planar_chain(3), noise=noise, fields=fields)
    q0, h, N = np.array([0.4, 0.1, -0.2]), 5e-3, 20
    u, dw = rng.normal(size=(N, 3)), np.sqrt(h) * rng.normal(size=(N, 3))
    given = {"dt": h, "steps": N, "controls": u, "increments": dw, "integrator": vp.Midpoint()}
    ours = vp.simulate(scene, q0, np.zeros(3), check=False, **given)
    theirs = textbook.rollout(system, q0, np.zeros(3), u, h, dw=dw)
    assert np.abs(ours.q - theirs.q).max() <= 1e-11
    # What noise adds to a step, (1.7), against differences of the step itself.
    own = textbook.linearize_step(system, *textbook.rollout(system, q0, np.zeros(3), u[:1], h).q, u[0], h)
    for i in range(3):
        e = 1e-2 * np.eye(3)[i]
        ends = [np.concatenate(textbook.step(system, q0, np.zeros(3), u[0], h, dw=s * e)) for s in (1.0, -1.0)]
        assert np.abs((ends[0] - ends[1]) / 2e-2 - own.K @ own.F[:, i]).max() <= 1e-7 * np.abs(own.K).max()


@pytest.mark.parametrize("name", ["white", "control"])
def test_a_plan_is_that_of_the_textbook(name):
    noise, fields = NOISES[name]
    scene, system = pair(vp.planar_chain(2), noise=noise, fields=fields, gravity=(0.0, 0.0, 0.0))

    def reference(t):
        return np.array([1.0 + 0.25 * np.sin(4 * np.pi * t), 0.1 * np.sin(2 * np.pi * t)])

    h, N, q0 = 0.02, 40, np.array([0.8, 0.1])
    plan = textbook.solve(system, textbook.TrackingCost(reference), q0, np.zeros(2), np.zeros((N, 2)), h)
    cost = vp.TrackingCost(reference, 10.0) + vp.ControlCost(0.1) + vp.Terminal(vp.TrackingCost(reference))
    problem = vp.OptimalControlProblem(
        scene, cost, q0, np.zeros(2), dt=h, steps=N, integrator=vp.Midpoint(), sampling="start"
    )
    ours = vp.solve(problem, np.zeros(2), tolerance=1e-9)
    assert ours.status.converged
    assert ours.cost == pytest.approx(plan.cost, rel=1e-6)
    assert ours.noise_cost == pytest.approx(plan.noise_cost, rel=1e-4)
    assert np.abs(ours.controls - plan.motion.u).max() <= 1e-3 * np.abs(plan.motion.u).max()
    assert np.abs(ours.gains - plan.policy.feedback).max() <= 1e-3 * np.abs(plan.policy.feedback).max()


def test_models_of_joints_with_two_variables_are_refused():
    model = pin.Model()
    model.addJoint(0, pin.JointModelRUBZ(), pin.SE3.Identity(), "continuous")
    with refused(vp.InputError, "variable"):
        textbook.system(model)
