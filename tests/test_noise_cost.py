"""What noise costs a plan: exact values, paths, fine steps, lines, and the warning of long steps."""

import dataclasses

import numpy as np
import pytest
from findings import about
from numpy.testing import assert_allclose, assert_array_equal
from oracles import jacobian, lines
from plan_problems import linear

import varpin as vp
from varpin.control.noise import left_within_steps, noise_cost
from varpin.control.stages import Feedback, Steps
from varpin.mechanics.noise import ito_drift, over_steps

CONTROL, STATE = vp.ControlNoise(0.3), vp.StateNoise(3.0, center=np.zeros(2))
SLIDING = vp.CustomNoise(
    lambda q, v, u: np.array([[0.2 * v[0] + 0.1 * u[1]], [0.3 + 0.1 * v[1]]]),
    1,
    dv=lambda q, v, u: np.array([[[0.2, 0.0]], [[0.0, 0.1]]]),
    du=lambda q, v, u: np.array([[[0.0, 0.1]], [[0.0, 0.0]]]),
)


def reach(noise, **options):
    cost = vp.ControlCost(0.05) + vp.VelocityCost(0.1)
    cost += vp.Terminal(vp.TrackingCost([0.5, -0.5], 20.0) + vp.VelocityCost(5.0))
    scene = vp.Scene(vp.planar_chain(2), damping=0.2, noise=noise)
    given = {"dt": 0.08, "steps": 5, **options}
    return vp.OptimalControlProblem(scene, cost, np.full(2, 0.2), np.zeros(2), **given)


def of(solution):
    return Steps(solution.problem, solution.trajectory), Feedback(solution.gains, solution.previous_gains)


@pytest.mark.parametrize(
    ("more", "options"),
    [
        (None, {"hold": 2, "integrator": vp.Gauss(2)}),
        (None, {"hold": 3, "integrator": vp.RungeKutta4(), "sampling": "start"}),
        (vp.ControlRateCost(1e-2), {"hold": 2, "integrator": vp.Midpoint(kick="split")}),
        (None, {"controls": "linear", "integrator": vp.Gauss(2, kick="split")}),
        (vp.ControlRateCost(1e-2), {"controls": "linear", "integrator": vp.Gauss(2)}),
    ],
    ids=["held", "explicit", "changes of controls", "linear", "linear, changes of controls"],
)
def test_it_is_that_of_each_impulse(more, options):
    """Of a linear system the cost is quadratic in the increments."""
    plan = vp.solve(linear(more, noise=vp.AdditiveNoise(0.3), **options), check=False)
    problem, expected = plan.problem, 0.0

    def cost(w):
        return problem.cost_of(problem.simulate(plan.policy, increments=w.reshape(problem.steps, 2)))

    least = cost(np.zeros(2 * problem.steps))
    for w in np.eye(2 * problem.steps):
        expected += problem.dt * 0.5 * (cost(w) + cost(-w) - 2.0 * least)
    assert plan.noise_cost == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("noise", [vp.AdditiveNoise(0.3), CONTROL + STATE, SLIDING], ids=["white", "core", "python"])
@pytest.mark.parametrize("kick", ["left", "split", "held"])
@pytest.mark.parametrize("options", [{"hold": 2}, {"controls": "linear"}], ids=["held", "linear"])
def test_forward_and_backward_it_is_the_same(options, kick, noise):
    problem = reach(noise, integrator=vp.Gauss(2, kick=kick), steps=6, **options)
    u = np.random.default_rng(1).normal(size=(problem.decisions, 2))
    plan = vp.solve(problem, u, max_iterations=0, check=False)
    assert noise_cost(*of(plan)) == pytest.approx(plan.noise_cost, rel=1e-9)


@pytest.mark.parametrize("integrator", [vp.Gauss(2, kick="held"), vp.RungeKutta4()], ids=["core", "python"])
def test_paths_cost_what_the_plan_expects(integrator):
    """Path by path, with what no path shows; on average the table of plans has it."""
    plan = vp.solve(reach(SLIDING, integrator=integrator, controls="linear"), check=False)
    again = [
        plan.problem.cost_of(plan.problem.simulate(plan.policy, rng=child))
        for child in np.random.default_rng(0).spawn(2)
    ]
    within = left_within_steps(*of(plan))
    assert (within > 0.0) == integrator.holds_noise
    found = plan.monte_carlo(2, rng=0)
    assert found.cost == pytest.approx(np.mean(again) + within, rel=1e-12)
    assert found.standard_error == pytest.approx(np.ptp(again) / 2.0, rel=1e-9)


def in_parts(plan, parts=16):
    problem, held = plan.problem, np.repeat(plan.trajectory.u, parts, axis=0)
    fine = problem.at(dt=problem.dt / parts, hold=parts * problem.hold)
    return noise_cost(Steps(fine, fine.simulate(held)), of(plan)[1])


@pytest.mark.parametrize("integrator", [None, vp.Gauss(4)], ids=["default", "impulses"])
def test_long_steps(integrator):
    """Of an impulse before each step, the paper's, a warning says what is closer."""
    scene = vp.Scene(vp.planar_chain(1), gravity=False, damping=1.5, noise=vp.AdditiveNoise(0.3))
    cost = vp.TrackingCost([0.0], 5.0) + vp.VelocityCost(1.0) + vp.ControlCost(0.05)
    cost += vp.Terminal(vp.VelocityCost(0.1))
    plan = vp.solve(vp.OptimalControlProblem(scene, cost, [0.0], [0.0], dt=0.1, steps=10, integrator=integrator))
    exact, told = in_parts(plan), about(plan.warnings, "noise within steps")
    assert bool(told) == (integrator is not None)
    if not told:
        assert plan.noise_cost == pytest.approx(exact, rel=0.05)
        estimate = plan.monte_carlo(400, rng=0)
        assert abs(estimate.cost - estimate.predicted) < 4.0 * estimate.standard_error
        return
    assert abs(plan.noise_cost / exact - 1.0) > 0.15
    assert abs(float(told[0].split()[2]) - exact) < 0.6 * abs(plan.noise_cost - exact)
    assert "problem.at(dt=0.05, hold=2) is closer" in told[0]


@pytest.mark.parametrize(("strength", "told"), [(5e-4, True), (5e-5, False)])
def test_feedback_as_fast_as_the_steps_is_told_of_where_noise_matters(strength, told):
    scene = vp.Scene(vp.load_robot("finger"), noise=vp.ControlNoise(strength))

    def reference(t):
        return [1 + 0.25 * np.sin(4 * np.pi * t), 0.3 + 0.1 * np.sin(2 * np.pi * t), 0.2]

    cost = vp.TrackingCost(reference, 10.0) + vp.ControlCost(0.1)
    start = {"q0": reference(0.0), "v0": [np.pi, 0.2 * np.pi, 0.0]}
    found = vp.solve(vp.OptimalControlProblem(scene, cost, **start, dt=4e-3, steps=50))
    in_halves = found.problem.at(dt=2e-3, hold=2, integrator=found.problem.integrator)
    finer = in_halves.simulate(found.policy)
    halves = noise_cost(Steps(in_halves, finer), of(found)[1])
    assert abs(halves - found.noise_cost) > 0.1 * halves
    assert abs(halves - found.noise_cost) < 0.05 * (found.cost + halves)
    assert (halves > 0.01 * (found.cost + halves)) == told
    assert bool(about(found.warnings, "noise within steps")) == told


def test_steps_in_which_noise_grows_without_bound_have_no_cost(recwarn):
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
    begin, goal = (
        np.array([0.4, -0.3, 0.2, -1.2, 0.1, 1.0, 0.3]),
        np.array([0.9, 0.2, -0.3, -0.8, 0.6, 1.4, -0.1]),
    )
    cost = vp.ControlCost(1e-2) + vp.VelocityCost(1.0) + vp.Terminal(vp.TrackingCost(goal, 10.0))

    def problem(noise):
        scene = vp.Scene(robot, damping=damping, noise=noise)
        return vp.OptimalControlProblem(scene, cost, begin, np.zeros(7), dt=0.05, steps=12)

    plan = dataclasses.replace(vp.solve(problem(None), check=False), problem=problem(vp.ControlNoise(0.05)))
    assert plan.problem.integrator.kick == "held"
    assert noise_cost(*of(plan)) == pytest.approx(in_parts(plan), rel=0.05)


@pytest.mark.parametrize("integrator", [None, vp.Gauss(2, kick="held"), vp.Radau(3, kick="held")])
@pytest.mark.parametrize("damping", [0.0, 0.05, 1.5, 30.0])
def test_what_velocities_cost_in_a_step_from_rest(damping, integrator):
    """The exact variance of white noise, its mean over the step and at its end."""
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


# --- along lines ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [CONTROL + STATE, SLIDING], ids=["core", "python"])
@pytest.mark.parametrize("kick", ["left", "split", "held"])
def test_the_effect_of_noise_along_a_line(noise, kick):
    integrator = vp.Gauss(2, kick=kick)
    problem = reach(noise, steps=1, integrator=integrator, controls="linear").at(q0=[0.3, -0.2], v0=[0.4, 0.7])
    scene, n, left = problem.scene, 2, integrator.left
    at = np.array([1.0, -2.0, 3.0, 0.5])
    motion = problem.simulate(lines(problem, at.reshape(2, 2)))
    lin = vp.linearize(scene, motion)

    def effect(ends):
        moved = problem.simulate(lines(problem, ends.reshape(2, 2)))

        def fields(k, u):
            return scene.noise.fields(moved.q[k, None], moved.v[k, None], u[None], problem.q0).F[0]

        def columns(k):
            sloped = (fields(k, ends[2:]) - fields(k, ends[:2])) / np.sqrt(12.0)
            # Noise of the state's alone sees no slope.
            return np.hstack([fields(k, 0.5 * (ends[:2] + ends[2:])), sloped[:, np.abs(sloped).any(axis=0)]])

        before, after = columns(0), columns(1)
        found = left * lin.J[0] @ before
        found[n:] += (1.0 - left) * after
        return found

    assert_allclose(lin.G[0], effect(at), atol=1e-12)
    derivatives = np.concatenate([lin.Gu - lin.Gramp, lin.Gramp], axis=3)[0]
    assert_allclose(derivatives, jacobian(effect, at, 1e-3), atol=1e-8)


def test_strong_noise_costs_what_the_plan_expects_in_fine_steps():
    """Controls that alternate do not escape it."""
    problem = reach(vp.ControlNoise(1.0), steps=10, controls="linear")
    plan = vp.solve(problem)
    assert plan.status.converged
    assert not about(plan.warnings, "noise within steps")
    fine = problem.at(dt=problem.dt / 4)
    given = {"dt": fine.dt, "steps": fine.steps, "controls": plan.policy, "integrator": problem.integrator}
    paths = [
        vp.simulate(problem.scene, problem.q0, problem.v0, rng=child, check=False, **given)
        for child in np.random.default_rng(3).spawn(200)
    ]
    costs = np.array([fine.cost_of(path) for path in paths])
    assert abs(costs.mean() - plan.expected_cost) < 3.0 * costs.std(ddof=1) / np.sqrt(len(costs))


@pytest.mark.parametrize(
    ("kick", "constrained"), [("left", False), ("split", False), ("held", False), ("left", True), ("held", True)]
)
def test_paths_on_lines_are_repeated_and_examined_with_their_noise(kick, constrained):
    noise = vp.ControlNoise(0.05) + vp.AdditiveNoise(0.01)
    limits = [vp.JointTie("joint2", "joint1")] if constrained else []
    scene = vp.Scene(vp.planar_chain(2), damping=0.2, noise=noise, constraints=limits)
    integrator = vp.Gauss(2, kick=kick)
    controls = vp.FirstOrderHold(20.0 * np.sin(np.linspace(0.0, 60.0, 201))[:, None] * [1.0, -0.5])
    given = {"dt": 2e-3, "steps": 200, "controls": controls, "integrator": integrator}
    motion = vp.simulate(scene, [0.2, 0.2], [0.0, 0.0], rng=1, **given)
    assert motion.dw.shape == (200, 6)
    unknown = ["error"] if constrained and kick == "left" else []  # the repetition cannot have its noise
    assert [finding.kind for finding in motion.warnings] == unknown
    again = vp.simulate(scene, [0.2, 0.2], [0.0, 0.0], increments=motion.dw, **given)
    assert_array_equal(again.q, motion.q)
    # Without those of slopes these are zero.
    means = vp.simulate(scene, [0.2, 0.2], [0.0, 0.0], increments=motion.dw[:, :4], **given)
    zeros = np.hstack([motion.dw[:, :4], np.zeros((200, 2))])
    assert_array_equal(means.q, vp.simulate(scene, [0.2, 0.2], [0.0, 0.0], increments=zeros, **given).q)
    assert np.abs(means.q - motion.q).max() > 1e-6


@pytest.mark.parametrize("integrator", [vp.Gauss(2), vp.Gauss(2, kick="held"), vp.RungeKutta4()], ids=str)
def test_the_drift_along_a_line_is_its_mean_over_the_step(integrator):
    sliding = vp.CustomNoise(
        lambda q, v, u: np.array([[0.2 * v[0] + 0.1 * u[1]], [0.3 + 0.1 * u[0] * v[1]]]),
        1,
        dv=lambda q, v, u: np.array([[[0.2, 0.0]], [[0.0, 0.1 * u[0]]]]),
        du=lambda q, v, u: np.array([[[0.0, 0.1]], [[0.1 * v[1], 0.0]]]),
        check=True,
    )
    problem = reach(sliding, steps=1, integrator=integrator, controls="linear").at(q0=[0.3, -0.2], v0=[0.4, 0.7])
    scene, u = problem.scene, np.array([1.0, -2.0, -3.0, 4.0])

    def end(u):
        motion = problem.simulate(lines(problem, u.reshape(2, 2)))
        return np.concatenate([motion.q[1], motion.p[1] if integrator.variational else motion.v[1]])

    def local(control, ends=None):
        q, v = problem.q0[None], problem.v0[None]
        return ito_drift(scene.core, q, v, over_steps(scene.noise, q, v, control[None], ends, problem.q0))[0]

    mean = 0.5 * (u[:2] + u[2:])
    found = local(mean, (u[None, :2], u[None, 2:]))
    assert_allclose(found, (local(u[:2]) + 4.0 * local(mean) + local(u[2:])) / 6.0, atol=1e-14)
    assert np.abs(found - local(mean)).max() > 1e-2
    lin = vp.linearize(scene, problem.simulate(lines(problem, u.reshape(2, 2))))
    by_control = np.concatenate([lin.B - lin.ramp, lin.ramp], axis=2)[0]
    assert_allclose(by_control, jacobian(end, u, 1e-3), atol=1e-8)
