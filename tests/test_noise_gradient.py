"""The gradient of what noise adds to the cost of a motion, and plans that follow it."""

import numpy as np
import pytest
from expected_cost import expected_cost_slopes
from refusals import refused
from varpin.control.backward import backward

import varpin as vp
from varpin.control.moments import noise_cost
from varpin.control.spread import Feedback
from varpin.control.within_steps import mean_of_decay, mean_of_decay_slopes

CONTROL, STATE = vp.ControlNoise(0.3), vp.StateNoise(3.0, center=np.zeros(2))


def reach(
    noise: object,
    *,
    steps: int = 6,
    dt: float = 0.08,
    rate: float = 0.0,
    damping: float = 0.2,
    place: bool = False,
    forces: tuple = (),
    **options: object,
):
    cost = vp.ControlCost(0.05) + vp.VelocityCost(0.1)
    cost += vp.Terminal(vp.TrackingCost([0.5, -0.5], 20.0) + vp.VelocityCost(5.0))
    if rate:
        cost += vp.ControlRateCost(rate)
    robot = vp.planar_chain(2)
    if place:
        # Hessians that depend on the configuration.
        cost += vp.FramePositionCost(robot, "tip", [0.5, 0.0, -1.0], 3.0)
        cost += vp.Terminal(vp.FramePositionCost(robot, "tip", [0.5, 0.0, -1.0], 10.0))
    scene = vp.Scene(robot, damping=damping, noise=noise, forces=forces)
    return vp.OptimalControlProblem(scene, cost, [0.2, 0.2], [0.0, 0.0], dt=dt, steps=steps, **options)


@pytest.mark.parametrize(
    ("noise", "options"),
    [
        (CONTROL, {"integrator": vp.Gauss(2)}),
        (CONTROL, {"integrator": vp.Midpoint(), "sampling": "midpoint"}),
        (CONTROL, {"integrator": vp.RungeKutta4()}),
        (CONTROL, {"integrator": vp.Gauss(2), "hold": 2}),
        (CONTROL, {"integrator": vp.Gauss(2), "hold": 3, "rate": 1e-2, "sampling": "start"}),
        (STATE, {"integrator": vp.Gauss(2)}),
        (STATE, {"integrator": vp.Gauss(2, kick="split")}),
        (CONTROL, {"integrator": vp.Gauss(2, kick="held"), "hold": 2}),
        (STATE, {"integrator": vp.Gauss(2, kick="held")}),
        (CONTROL, {"integrator": vp.Radau(2, kick="held"), "damping": 1.0}),
        (CONTROL, {"integrator": vp.Gauss(2, kick="held"), "forces": (vp.CoulombFriction(0.5, 0.5),)}),
        (STATE, {"integrator": vp.Gauss(2, kick="held"), "forces": (vp.FrameDamper("tip", (0.5, 0.0, -1.0), 2.0),)}),
        (CONTROL, {"integrator": vp.Gauss(2, kick="held"), "forces": (vp.CustomForce(lambda q, v: -v * abs(v)),)}),
        (STATE, {"integrator": vp.RungeKutta4()}),
        (vp.AdditiveNoise(0.5), {"integrator": vp.Gauss(2)}),
        (CONTROL, {"integrator": vp.Gauss(2, kick="held"), "place": True}),
        (CONTROL, {"integrator": vp.Gauss(2), "place": True, "sampling": "start"}),
    ],
)
def test_it_is_that_of_the_expected_cost(noise: object, options: dict) -> None:
    """By differences of the cost and the noise's share, each with a backward pass of its own."""
    problem = reach(noise, **options)
    u = 2.0 * np.random.default_rng(0).normal(size=(problem.decisions, 2))

    def made(controls: np.ndarray) -> vp.Trajectory:
        return problem.simulate(np.repeat(controls, problem.hold, axis=0))

    whole, found, held = expected_cost_slopes(problem, made, u)
    np.testing.assert_allclose(whole, found, atol=2e-8 * np.abs(found).max())
    assert np.abs(held - found).max() > 1e-3 * np.abs(found).max()


@pytest.mark.parametrize("size", [1e-3, 0.5, 20.0])
def test_derivatives_of_the_mean_over_a_decay(size: float) -> None:
    rng = np.random.default_rng(0)
    Z, (H, pull) = size * (np.eye(3) + 0.3 * rng.normal(size=(2, 3, 3))), rng.normal(size=(2, 2, 3, 3))
    H, pull = (0.5 * (a + np.swapaxes(a, 1, 2)) for a in (H, pull))
    to_Z, to_H = mean_of_decay_slopes(Z, H, pull)
    step = 1e-3 * max(size, 1.0)
    for index in np.ndindex(3, 3):
        away = np.zeros((3, 3))
        away[index] = step
        near, far = (
            ((mean_of_decay(Z + k * away, H) - mean_of_decay(Z - k * away, H)) * pull).sum(axis=(1, 2)) for k in (1, 2)
        )
        np.testing.assert_allclose(
            to_Z[(..., *index)], (8.0 * near - far) / (12.0 * step), atol=1e-9 * np.abs(to_Z).max()
        )
        shift = 0.5 * (away + away.T)
        change = ((mean_of_decay(Z, H + shift) - mean_of_decay(Z, H)) * pull).sum(axis=(1, 2)) / step
        np.testing.assert_allclose(to_H[(..., *index)], change, atol=1e-11 * np.abs(to_H).max())


@pytest.mark.parametrize("noise", [CONTROL, STATE])
def test_plans_end_at_the_minimum_of_the_expected_cost(noise: object) -> None:
    problem = reach(noise, steps=12, dt=0.05, integrator=vp.Gauss(2))
    held, whole = (vp.solve(problem, noise=mode, tolerance=1e-11, check=False) for mode in ("held", None))
    assert held.status.converged
    assert whole.status.converged
    assert whole.expected_cost < (1.0 - 1e-5) * held.expected_cost
    # No controls nearby are expected to cost less.
    rng = np.random.default_rng(1)
    for _ in range(5):
        u = whole.controls + 1e-2 * rng.normal(size=whole.controls.shape)
        motion = problem.simulate(u)
        assert problem.cost_of(motion) + backward(problem, motion, 0.0).noise > whole.expected_cost
    start = np.abs(vp.solve(problem, max_iterations=0, check=False).gradient).max()
    assert np.abs(whole.gradient).max() < 1e-4 * start


@pytest.mark.parametrize("noise", [vp.ControlNoise(0.1), vp.ControlNoise(1.0), vp.StateNoise(20.0, center=np.zeros(2))])
def test_strong_noise_ends_converged_and_below_the_search_with_it_held(noise: object) -> None:
    problem = reach(noise, steps=20, dt=0.04)
    held, found = (vp.solve(problem, noise=mode, check=False) for mode in ("held", None))
    assert found.status.converged
    assert found.expected_cost < (1.0 - 1e-5) * held.expected_cost


def test_light_joints_in_long_steps_end_converged() -> None:
    """The joints of a finger: their momenta change with the inertias that they move, whatever their damping."""
    goal = np.array([0.3, 0.8, 0.9, -0.3, 0.2, 0.4])
    scene = vp.Scene(vp.load_robot("so100"), damping=0.01, noise=vp.ControlNoise(0.05))
    cost = vp.ControlCost(1e-2) + vp.VelocityCost(1e-2)
    cost += vp.Terminal(vp.TrackingCost(goal, 100.0) + vp.VelocityCost(1.0))
    begin = goal + np.array([0.4, -0.3, 0.3, 0.4, -0.4, 0.2])
    plan = vp.solve(vp.OptimalControlProblem(scene, cost, begin, np.zeros(6), dt=0.05, steps=12), check=False)
    assert plan.status is vp.Status.CONVERGED
    assert plan.iterations <= 60


def test_the_prediction_is_that_of_paths_where_noise_is_small() -> None:
    plan = vp.solve(reach(vp.ControlNoise(0.03), steps=12, dt=0.05, integrator=vp.Gauss(2)), check=False)
    found = plan.monte_carlo(4000, rng=0)
    assert abs(found.cost - plan.expected_cost) < 4.0 * found.standard_error + 1e-3 * plan.cost
    assert plan.noise_cost > 2.0 * found.standard_error


def test_where_it_stays_held() -> None:
    """Within limits, and for noise of constant strength beside another."""
    limited = reach(CONTROL, integrator=vp.Gauss(2), control_limits=(-5.0, 5.0))
    held, whole = (vp.solve(limited, noise=mode, check=False) for mode in ("held", "whole"))
    np.testing.assert_array_equal(held.controls, whole.controls)
    both = vp.solve(
        reach(CONTROL + vp.AdditiveNoise(5.0), integrator=vp.Gauss(2)), noise="whole", tolerance=1e-11, check=False
    )
    one = vp.solve(reach(CONTROL, integrator=vp.Gauss(2)), noise="whole", tolerance=1e-11, check=False)
    np.testing.assert_allclose(both.controls, one.controls, atol=1e-4)


def test_a_wrong_choice() -> None:
    with refused(vp.InputError, "noise", "'held'", "'whole'"):
        vp.solve(reach(CONTROL), noise="some")


def test_a_search_does_not_go_on_under_other_noise():
    def problem(strength):
        scene = vp.Scene(vp.planar_chain(2), noise=vp.ControlNoise(strength))
        cost = vp.ControlCost(1.0) + vp.Terminal(vp.TrackingCost([0.5, 0.2], 100.0))
        return vp.OptimalControlProblem(scene, cost, [0, 0], [0, 0], dt=0.05, steps=6)

    plan = vp.solve(problem(0.1), max_iterations=1, check=False)
    with refused(vp.InputError, "noise"):
        vp.solve(problem(0.2), resume=plan)


@pytest.mark.parametrize("integrator", [None, vp.Radau(2, kick="held")])
def test_the_cost_that_a_plan_reports_has_no_slope_at_the_plan(integrator: vp.Integrator | None) -> None:
    """What velocities cost within steps included, by differences of the whole."""
    problem = reach(CONTROL, damping=2.0, integrator=integrator)

    def total(u: np.ndarray) -> float:
        motion = problem.simulate(u)
        plan = backward(problem, motion, 0.0)
        return problem.cost_of(motion) + noise_cost(problem, motion, Feedback(plan.feedback, plan.previous))

    def slope(u: np.ndarray, way: np.ndarray) -> float:
        near, far = (total(u + k * way) - total(u - k * way) for k in (1, 2))
        return (8.0 * near - far) / 12.0

    plan = vp.solve(problem, noise="whole", tolerance=1e-10, check=False)
    assert plan.status is vp.Status.CONVERGED
    assert plan.expected_cost == pytest.approx(total(plan.controls), rel=1e-12)
    ways = 1e-3 * np.random.default_rng(0).normal(size=(6, *plan.controls.shape))
    slopes, others = ([abs(slope(u, way)) for way in ways] for u in (plan.controls, 0.99 * plan.controls))
    assert max(slopes) < 1e-3 * max(others)


def test_rounding_does_not_grow_over_many_steps_of_held_decisions() -> None:
    """A finger under stiff gains: errors of the value function that were not symmetric grew by a tenth each step."""
    scene, begin = vp.load_scene("finger_noise").scene, np.array([1.0, 0.3, 0.2])
    path = lambda t: begin + 0.25 * np.sin(4.0 * np.pi * np.asarray(t))[..., None] * np.array([1.0, 0.4, 0.0])  # noqa: E731
    cost = vp.TrackingCost(path, 10.0) + vp.ControlCost(0.1) + vp.Terminal(vp.TrackingCost(begin, 1.0))
    problem = vp.OptimalControlProblem(scene, cost, begin, np.zeros(3), dt=1e-3, steps=1200, hold=2)
    plan = vp.solve(problem, check=False, max_iterations=5)
    assert plan.status.converged
    held = vp.solve(problem, check=False, noise="held")
    assert plan.cost + plan.noise_cost <= held.cost + held.noise_cost
