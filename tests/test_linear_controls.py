"""Plans whose controls are linear in time between nodes."""

import numpy as np
import pytest
from refusals import refused

import varpin as vp

N = 8


def links(*, cost: vp.Cost | None = None, **options: object) -> vp.OptimalControlProblem:
    """Two links that reach."""
    if cost is None:
        end = vp.TrackingCost([0.6, -0.4], 1e3) + vp.VelocityCost(1e2)
        cost = vp.ControlCost(1e-2) + vp.VelocityCost(0.1) + vp.Terminal(end)
    given = {"dt": 0.1, "steps": N, "controls": "linear"} | options
    return vp.OptimalControlProblem(vp.Scene(vp.planar_chain(2), damping=0.1), cost, [0.1, 0.2], [0.0, 0.0], **given)


def test_the_optimum_of_a_double_integrator_is_the_continuous_one() -> None:
    """Least effort from rest to rest is linear in time: two intervals hold it exactly."""
    robot = vp.planar_chain(1)
    scene = vp.Scene(robot, gravity=False)
    inertia = float(vp.lagrangian_jet(scene, np.zeros(1), np.zeros(1)).Lvv[0, 0])
    r, w, T = 0.3, 50.0, 1.2
    cost = vp.ControlCost(r) + vp.Terminal(vp.TrackingCost([1.0], w) + vp.VelocityCost(w))
    problem = vp.OptimalControlProblem(scene, cost, [0.0], [0.0], dt=T / 2, steps=2, controls="linear")
    plan = vp.solve(problem, check=False)
    # u = a + b t under (q, v)(T) = G (a, b), by hand.
    G = np.array([[T**2 / 2, T**3 / 6], [T, T**2 / 2]]) / inertia
    E = r * np.array([[T, T**2 / 2], [T**2 / 2, T**3 / 3]])
    a, b = np.linalg.solve(E + w * G.T @ G, w * G.T @ [1.0, 0.0])
    end = G @ [a, b]
    least = np.array([a, b]) @ E @ [a, b] + w * ((end[0] - 1.0) ** 2 + end[1] ** 2)
    assert plan.status.converged
    np.testing.assert_allclose(plan.controls[:, 0], a + b * np.array([0.0, T / 2, T]), rtol=1e-9)
    assert plan.cost == pytest.approx(least, rel=1e-12)
    held = vp.solve(problem.at(controls="held"), check=False)
    assert held.cost > 1.01 * least


def test_feedback_is_that_of_the_optimum_from_another_state() -> None:
    """Of a linear system under squares the optimum is linear in the state, and the policy is that optimum."""
    cost = vp.ControlCost(0.1) + vp.VelocityCost(0.2) + vp.Terminal(vp.TrackingCost([1.0], 50.0) + vp.VelocityCost(5.0))
    cost += vp.ControlRateCost(1e-2)
    scene = vp.Scene(vp.planar_chain(1), gravity=False, damping=0.3)
    problem = vp.OptimalControlProblem(scene, cost, [0.0], [0.0], dt=0.2, steps=N, controls="linear")
    plan = vp.solve(problem, tolerance=1e-13, check=False)
    moved = problem.at(q0=[0.3])
    best = vp.solve(moved, tolerance=1e-13, check=False)
    own = plan.policy
    first = plan.controls[0] + plan.gains[0] @ [0.3, 0.0]
    np.testing.assert_allclose(best.controls[0], first, rtol=1e-8)
    policy = vp.LinearPolicy(
        own.u, own.gains, own.reference, on=own.on, previous_gains=own.previous_gains, before=first,
        previous=own.previous, linear=True,
    )  # fmt: skip
    np.testing.assert_allclose(moved.simulate(policy).u_nodes, best.controls, atol=1e-8)
    # Without a say in the first control, feedback still does most of it.
    fed, alone = moved.cost_of(moved.simulate(own)), moved.cost_of(moved.simulate(own.without_feedback()))
    assert fed - best.cost < 0.05 * (alone - best.cost)


def test_refusals() -> None:
    with refused(vp.InputError, "controls", "'held'", "'linear'"):
        links(controls="cubic")
    with refused(vp.InputError, "hold"):
        links(hold=2)
    # The optimum of a midpoint sum alternates freely: its controls cost nothing in the middle of a step.
    for sampling in ("midpoint", "start"):
        with refused(vp.InputError, repr(sampling), "linear"):
            links(sampling=sampling)
    problem = links()
    plan = vp.solve(problem, check=False)
    with refused(vp.InputError, "linear"):
        vp.solve(problem.at(controls="held"), plan)
    with refused(vp.InputError, "before"):
        vp.LinearPolicy(np.zeros((2, 1)), np.zeros((2, 1, 2)), np.zeros((2, 2)), linear=True)
