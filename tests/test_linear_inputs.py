"""Plans whose controls are linear between nodes beside kinematic inputs: a hand and a motor."""

import numpy as np
import pytest

import varpin as vp


def hand_and_motor(
    interpolation: str = "linear", *, steps: int = 6, noise: vp.Noise | None = None, **options: object
) -> vp.OptimalControlProblem:
    """A joint moved by hand, and a motor on the next one."""
    cubic = [1e-2] if interpolation == "cubic" else []
    scene = vp.Scene(
        vp.planar_chain(3, length=0.5), gravity=False, damping=0.2, actuation=["joint1", "joint2", "joint3"],
        constraints=vp.KinematicInput("joint1", interpolation), noise=noise,
    )  # fmt: skip
    cost = vp.ControlRateCost([0.3, 0.0, 0.0, *cubic]) + vp.ControlCost([0.1, 1e-2, 2e-2, *cubic])
    cost += vp.Terminal(vp.TrackingCost([0.4, -0.6, 0.2], 50.0) + vp.VelocityCost([0.0, 5.0, 5.0]))
    given = {"dt": 0.08, "steps": steps, "integrator": vp.Gauss(2), "controls": "linear"} | options
    return vp.OptimalControlProblem(scene, cost, [0.1, 0.2, 0.3], np.zeros(3), **given)


def line(problem: vp.OptimalControlProblem, u: np.ndarray) -> vp.LinearPolicy:
    N, (n, m) = problem.steps, (problem.scene.robot.dof, problem.scene.controls)
    return vp.LinearPolicy(u[1:], np.zeros((N, m, 2 * n)), np.zeros((N, 2 * n)), before=u[0], linear=True)


def start_of(problem: vp.OptimalControlProblem) -> np.ndarray:
    u = 0.3 * np.random.default_rng(0).normal(size=(problem.decisions, problem.scene.controls))
    u[0, 0] = problem.q0[0]
    if problem.scene.controls > 3:
        u[0, 3] = problem.v0[0]
    return u


@pytest.mark.parametrize("second_order", [False, True])
@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_the_gradient_is_that_of_the_cost(interpolation: str, second_order: bool) -> None:
    problem = hand_and_motor(interpolation)
    u = start_of(problem)
    plan = vp.solve(problem, u, max_iterations=0, second_order=second_order, check=False)
    np.testing.assert_allclose(plan.controls, u, atol=1e-12)
    found, step = np.zeros_like(u), 1e-5
    for index in np.ndindex(u.shape):
        away = np.zeros_like(u)
        away[index] = step
        values = [problem.cost_of(problem.simulate(line(problem, u + sign * away))) for sign in (1.0, -1.0)]
        found[index] = (values[0] - values[1]) / (2.0 * step)
    # Where the hand begins is given.
    given = [0] if interpolation == "linear" else [0, 3]
    assert not plan.gradient[0, given].any()
    found[0, given] = 0.0
    np.testing.assert_allclose(plan.gradient, found, atol=1e-6 * np.abs(found).max())


def test_paths_cost_what_the_plan_expects() -> None:
    problem = hand_and_motor(noise=vp.ControlNoise(0.05) + vp.AdditiveNoise(0.01))
    plan = vp.solve(problem, check=False)
    told = plan.monte_carlo(800, rng=0)
    assert plan.noise_cost > 0.02 * plan.cost
    assert abs(told.cost - told.predicted) < 3.0 * told.standard_error


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_a_controller_takes_them(interpolation: str) -> None:
    problem = hand_and_motor(interpolation, steps=12, dt=0.04)
    run = vp.Mpc(problem).run(vp.Plant(problem.scene, substeps=3), duration=1.2)
    np.testing.assert_allclose(run.motion.q[1:, 0], run.motion.u[:, 0], atol=1e-12)
    np.testing.assert_allclose(run.motion.q[-1], [0.4, -0.6, 0.2], atol=0.1)


@pytest.mark.parametrize("controls", ["held", "linear"])
@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_searches_start_on_states(interpolation: str, controls: str) -> None:
    """The inputs follow the states, forces of the other joints make up for what the motors lack: the same optimum."""
    problem = hand_and_motor(interpolation, controls=controls)
    own = vp.solve(problem, tolerance=1e-12, check=False)
    share = np.linspace(0.0, 1.0, problem.steps + 1)[:, None]
    states = problem.q0 + share * (np.array([0.3, -0.4, 0.1]) - problem.q0)
    found = vp.solve(problem, states=states, tolerance=1e-12, check=False)
    assert found.status.converged
    assert found.cost == pytest.approx(own.cost, rel=1e-9)
    np.testing.assert_allclose(found.trajectory.q, own.trajectory.q, atol=1e-5)
    # The first motion of no iterations is on the states.
    first = vp.solve(problem, states=own.trajectory, max_iterations=0, check=False)
    np.testing.assert_allclose(first.trajectory.q[:, 0], own.trajectory.q[:, 0], atol=1e-12)


def test_noise_of_the_position_of_an_input_is_differentiated_at_the_end_of_the_step() -> None:
    """Its derivatives in the controls at both ends of a line, by differences of the fields there."""
    own = vp.CustomNoise(
        lambda q, v, u: np.array([[0.0], [u[0] * u[1]], [u[0] ** 2]]),
        1,
        du=lambda q, v, u: np.array([[[0.0] * 3], [[u[1], u[0], 0.0]], [[2.0 * u[0], 0.0, 0.0]]]),
        check=True,
    )
    problem = hand_and_motor(steps=1, noise=own)
    u, step = start_of(problem).ravel(), 1e-5
    u[3] += 0.4

    def linearized(ends: np.ndarray) -> vp.Linearization:
        return vp.linearize(problem.scene, problem.simulate(line(problem, ends.reshape(2, 3))))

    lin = linearized(u)
    first = lin.F[0, :, 0]
    np.testing.assert_allclose(first, [0.0, u[3] * 0.5 * (u[1] + u[4]), u[3] ** 2], atol=1e-12)
    slope = np.array([0.0, u[3] * (u[4] - u[1]), 0.0]) / np.sqrt(12.0)
    np.testing.assert_allclose(lin.G[0], lin.J[0] @ np.stack([first, slope], axis=1), atol=1e-12)
    for c in range(6):
        away = step * np.eye(6)[c]
        # The Jacobian of the step stays: it is the fields that are differentiated.
        fields = []
        for at in (u + away, u - away):
            mean, last = 0.5 * (at[1] + at[4]), at[3]
            fields.append(np.array([[0.0, last * mean, last**2], [0.0, last * (at[4] - at[1]) / np.sqrt(12.0), 0.0]]).T)
        expected = lin.J[0] @ (fields[0] - fields[1]) / (2.0 * step)
        found = (lin.Gramp if c >= 3 else lin.Gu - lin.Gramp)[0, :, :, c % 3]
        np.testing.assert_allclose(found, expected, atol=1e-8)


@pytest.mark.parametrize(("interpolation", "least"), [("linear", 0.309358), ("cubic", 0.373650)])
def test_speeds_hold_between_nodes(interpolation: str, least: float) -> None:
    """A hand may jump in velocity at a node, and with it the joints after it; to the least cost known."""
    problem = hand_and_motor(interpolation)
    within = vp.WithinVelocityLimits(problem.scene.robot, (-1.7, 1.7))
    plan = vp.solve(hand_and_motor(interpolation, constraints=[within], between_nodes=True), check=False)
    assert plan.status is vp.Status.CONVERGED
    assert plan.iterations <= 30
    assert plan.violation <= 1e-6
    assert plan.cost == pytest.approx(least, rel=1e-3)
    assert plan.verify().constraints[0].closed_loop < 4e-3
