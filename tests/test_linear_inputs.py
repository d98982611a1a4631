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


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_a_plan_is_the_optimum_and_holds_between_nodes(interpolation: str) -> None:
    problem = hand_and_motor(interpolation, steps=16, dt=0.03, integrator=vp.Gauss(3))
    plan = vp.solve(problem, tolerance=1e-13, check=False)
    assert plan.status.converged
    np.testing.assert_allclose(plan.controls[:, 0], plan.trajectory.q[:, 0], atol=1e-12)
    again = vp.simulate(
        problem.scene, problem.q0, problem.v0, dt=problem.dt, steps=problem.steps, integrator=problem.integrator,
        controls=vp.FirstOrderHold(plan.controls),
    )  # fmt: skip
    np.testing.assert_allclose(again.q, plan.trajectory.q, atol=1e-10)
    np.testing.assert_allclose(problem.simulate(plan.policy).u_nodes, plan.controls, atol=1e-9)
    rng = np.random.default_rng(1)
    for _ in range(3):
        other = plan.controls + 1e-2 * rng.normal(size=plan.controls.shape)
        other[0] = plan.controls[0]
        assert problem.cost_of(problem.simulate(line(problem, other))) > plan.cost
    told = plan.verify(tolerance=1e-6)
    assert abs(told.closed_loop_loss) < 5e-3
    assert abs(told.open_loop_loss) < 5e-3


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
