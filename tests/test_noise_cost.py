"""What noise costs a plan, against the exact covariance in continuous time; and the warning where steps are long."""

import numpy as np
import pinocchio as pin
import pytest
from findings import about
from scipy.linalg import expm

import varpin as vp
from varpin.control.noise import noise_cost
from varpin.control.stages import Feedback, Steps

LEVEL, DAMPING = 0.3, 1.5
WEIGHTS = {"q": 5.0, "v": 1.0, "u": 0.05}


def plan(dt: float, hold: int = 1, **options: object) -> vp.Solution:
    """One joint without gravity, held at rest: the noise cost is the whole cost."""
    scene = vp.Scene(vp.planar_chain(1), gravity=False, damping=DAMPING, noise=vp.AdditiveNoise(LEVEL))
    cost = vp.TrackingCost([0.0], WEIGHTS["q"]) + vp.VelocityCost(WEIGHTS["v"]) + vp.ControlCost(WEIGHTS["u"])
    problem = vp.OptimalControlProblem(
        scene,
        cost + vp.Terminal(vp.VelocityCost(0.1)),
        [0.0],
        [0.0],
        dt=dt,
        steps=round(1.0 / dt),
        hold=hold,
        **options,
    )
    return vp.solve(problem)


def exact(solution: vp.Solution) -> float:
    """E[cost] from the moments of (q, v, u), whose equations are linear, by the matrix exponential."""
    model = solution.problem.scene.robot.model
    inertia = pin.crba(model, model.createData(), pin.neutral(model))[0, 0]
    A = np.array([[0.0, 1.0, 0.0], [0.0, -DAMPING / inertia, 1.0 / inertia], [0.0, 0.0, 0.0]])
    kick = np.diag([0.0, (LEVEL / inertia) ** 2, 0.0])
    rates = np.zeros((11, 11))
    rates[:9, :9] = np.kron(A, np.eye(3)) + np.kron(np.eye(3), A)
    rates[:9, 10] = kick.ravel()
    rates[9, :9] = np.diag(list(WEIGHTS.values())).ravel()
    interval = expm(rates * solution.problem.dt * solution.problem.hold)
    S, total = np.zeros((3, 3)), 0.0
    for gain in solution.gains[:, 0]:
        decide = np.eye(3)
        decide[2] = gain[0], gain[1] * inertia, 0.0
        S = decide @ S @ decide.T
        end = interval @ np.concatenate([S.ravel(), [0.0, 1.0]])
        S, total = end[:9].reshape(3, 3), total + end[9]
    return total + 0.1 * S[1, 1]


@pytest.mark.parametrize("kick", ["left", "split", "held"])
@pytest.mark.parametrize("noise", [vp.AdditiveNoise(0.3), vp.ControlNoise(0.2) + vp.StateNoise(0.5, center=[0.1, 0.1])])
def test_it_is_that_of_the_backward_pass(noise, kick):
    scene = vp.Scene(vp.planar_chain(2), damping=0.4, noise=noise)
    cost = vp.TrackingCost([0.5, 0.2], 5.0) + vp.VelocityCost(0.3) + vp.ControlCost(0.01)
    problem = vp.OptimalControlProblem(
        scene, cost + vp.Terminal(vp.VelocityCost(1.0)), [0.2, 0.1], [0.0, 0.0], dt=0.05, steps=12, hold=2,
        integrator=vp.Gauss(2, kick=kick),
    )  # fmt: skip
    found = vp.solve(problem, check=False)
    own = noise_cost(Steps(problem, found.trajectory), Feedback(found.gains, found.previous_gains))
    assert own == pytest.approx(found.noise_cost, rel=1e-9)


def test_costs_of_velocities_are_close_in_long_steps_too():
    """Of the default, without and with control noise; monte_carlo has the same share within steps."""
    long = plan(0.1)
    assert long.noise_cost == pytest.approx(exact(long), rel=0.05)
    assert not about(long.warnings, "noise within steps")
    estimate = long.monte_carlo(400, rng=0)
    assert abs(estimate.cost - estimate.predicted) < 4.0 * estimate.standard_error


def test_a_plan_whose_steps_are_long_for_the_noise_says_so():
    """With the paper's impulse."""
    long = plan(0.1, integrator=vp.Gauss(4))
    assert abs(long.noise_cost / exact(long) - 1.0) > 0.15
    (sentence,) = about(long.warnings, "noise within steps")
    halves = float(sentence.split()[2])
    assert abs(halves - exact(long)) < 0.6 * abs(long.noise_cost - exact(long))
    assert "problem.at(dt=0.05, hold=2) is closer" in sentence
    # Whether paths agree with the linear model is not known without them.
    assert "agrees" not in sentence


@pytest.mark.parametrize("damping", [0.0, 2.0, 20.0])
def test_in_the_long_steps_of_a_plan_it_is_close_to_that_of_fine_steps(damping):
    """The default's, of position costs; an impulse before each step costs half as much again and more."""
    noise = vp.AdditiveNoise(0.1) + vp.ControlNoise(0.05)
    scene = vp.Scene(vp.planar_chain(2), gravity=False, damping=damping, stiffness=5.0, noise=noise)
    cost = vp.TrackingCost([0.5, 0.2], 10.0) + vp.ControlCost(1e-2)
    found = vp.solve(vp.OptimalControlProblem(scene, cost, [0.3, 0.1], [0.0, 0.0], dt=0.04, steps=25), check=False)
    feedback = Feedback(found.gains, found.previous_gains)
    fine = found.problem.at(dt=0.04 / 16, hold=16)
    there = noise_cost(Steps(fine, fine.simulate(np.repeat(found.trajectory.u, 16, axis=0))), feedback)
    assert found.problem.integrator.kick == "held"
    assert found.noise_cost == pytest.approx(there, rel=0.05)
    left = found.problem.at(integrator=type(found.problem.integrator)(stages=4))
    assert noise_cost(Steps(left, left.simulate(found.trajectory.u)), feedback) > 1.02 * there


@pytest.mark.parametrize(("strength", "told"), [(5e-4, True), (5e-5, False)])
def test_feedback_as_fast_as_the_steps_is_told_of_where_noise_matters(strength, told):
    """The rest of the noise, beside its mean over a step, costs a fifth of it; a small part of the expected cost."""
    scene = vp.Scene(vp.load_robot("finger"), noise=vp.ControlNoise(strength))

    def reference(t):
        return [1 + 0.25 * np.sin(4 * np.pi * t), 0.3 + 0.1 * np.sin(2 * np.pi * t), 0.2]

    cost = vp.TrackingCost(reference, 10.0) + vp.ControlCost(0.1)
    start = {"q0": reference(0.0), "v0": [np.pi, 0.2 * np.pi, 0.0]}
    found = vp.solve(vp.OptimalControlProblem(scene, cost, **start, dt=4e-3, steps=50))
    in_halves = found.problem.at(dt=2e-3, hold=2, integrator=found.problem.integrator)
    finer = in_halves.simulate(found.policy_on("momentum", 2))
    halves = noise_cost(Steps(in_halves, finer), Feedback(found.gains, found.previous_gains))
    assert abs(halves - found.noise_cost) > 0.1 * halves
    assert abs(halves - found.noise_cost) < 0.05 * (found.cost + halves)
    assert (halves > 0.01 * (found.cost + halves)) == told
    assert bool(about(found.warnings, "noise within steps")) == told


def test_steps_in_which_noise_grows_without_bound_have_no_cost(recwarn):
    """As those of a force that drives: no warning of NumPy, and an error that rejects the trial."""
    cost = vp.VelocityCost(1.0) + vp.ControlCost(1.0)

    def problem(*forces):
        scene = vp.Scene(vp.planar_chain(2), noise=vp.AdditiveNoise(0.1), forces=forces)
        return vp.OptimalControlProblem(
            scene, cost, np.zeros(2), np.zeros(2), dt=0.05, steps=4, integrator=vp.Gauss(2, kick="held")
        )

    damped = problem()
    motion = damped.simulate(np.zeros((4, 2)))
    driven = Steps(problem(vp.CustomForce(lambda q, v: 1e5 * v)), motion)
    vars(driven)["lin"] = Steps(damped, motion).lin
    with pytest.raises(vp.LinearizationError, match="without bound"):
        driven.kicked  # noqa: B018 - made as it is read
    assert not recwarn.list


@pytest.mark.parametrize("damping", [0.01, 1.0])
def test_in_fast_motions_of_arms_it_is_that_of_fine_steps(damping):
    """A Panda at 2.5 rad/s turns by 0.1 rad in a step: its inertias change, and with them momenta."""
    robot = vp.load_robot("panda", lock={"panda_finger_joint1": 0.02})
    begin, goal = np.array([0.4, -0.3, 0.2, -1.2, 0.1, 1.0, 0.3]), np.array([0.9, 0.2, -0.3, -0.8, 0.6, 1.4, -0.1])
    cost = vp.ControlCost(1e-2) + vp.VelocityCost(1.0) + vp.Terminal(vp.TrackingCost(goal, 10.0))

    def problem(noise):
        scene = vp.Scene(robot, damping=damping, noise=noise)
        return vp.OptimalControlProblem(scene, cost, begin, np.zeros(7), dt=0.05, steps=12)

    plan = vp.solve(problem(None), check=False)
    noisy, feedback = problem(vp.ControlNoise(0.05)), Feedback(plan.gains, plan.previous_gains)
    fine = noisy.at(dt=0.05 / 16, hold=16)
    there = noise_cost(Steps(fine, fine.simulate(np.repeat(plan.controls, 16, axis=0))), feedback)
    assert noisy.integrator.kick == "held"
    assert noise_cost(Steps(noisy, plan.trajectory), feedback) == pytest.approx(there, rel=0.05)


@pytest.mark.parametrize("integrator", [None, vp.Gauss(2, kick="held"), vp.Radau(3, kick="held")])
@pytest.mark.parametrize("damping", [0.0, 0.05, 1.5, 30.0])
def test_what_velocities_cost_in_a_step_from_rest(damping, integrator):
    """The exact variance of white noise over a step: its mean within the step, and at the end of the last one."""
    level, dt = 0.3, 0.1
    scene = vp.Scene(vp.planar_chain(1), gravity=False, damping=damping, noise=vp.AdditiveNoise(level))
    inertia = vp.lagrangian_jet(scene, [0.0], [0.0]).Lvv[0, 0]
    rate = 2.0 * damping / inertia
    left = -np.expm1(-rate * dt) / rate if damping else dt
    within = (dt - left) / rate if damping else 0.5 * dt**2
    for cost, exact in ((vp.VelocityCost(1.0), within), (vp.Terminal(vp.VelocityCost(2.0)), 2.0 * left)):
        given = {"dt": dt, "steps": 1, "integrator": integrator}
        problem = vp.OptimalControlProblem(scene, vp.ControlCost(1.0) + cost, [0.0], [0.0], **given)
        found = noise_cost(Steps(problem, problem.simulate(np.zeros((1, 1)))), Feedback(np.zeros((1, 1, 2)), None))
        assert found == pytest.approx((level / inertia) ** 2 * exact, rel=1e-5)
