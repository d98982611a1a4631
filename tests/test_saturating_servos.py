"""Plans of arms whose servos come to the limits of their drives."""

import numpy as np
import pytest

import varpin as vp
from varpin.simulation.spectrum import rate_at_rest

GOAL = np.array([1.0, -0.7])
STIFFNESS, DAMPING = np.array([400.0, 200.0]), np.array([40.0, 15.0])


def reach(effort, **options):
    """Two links of 1 m on servos, in a horizontal plane."""
    servos = vp.PositionServo(STIFFNESS, DAMPING, [3.0 * effort, effort])
    scene = vp.Scene(vp.planar_chain(2), forces=[servos], gravity=[0.0, 0.0, 0.0])
    cost = vp.ControlCost(1e-3, reference=GOAL) + vp.VelocityCost(1e-2)
    cost += vp.Terminal(vp.TrackingCost(GOAL, 1e3) + vp.VelocityCost(10.0))
    return vp.OptimalControlProblem(scene, cost, np.zeros(2), np.zeros(2), dt=0.02, steps=40, **options)


@pytest.fixture(scope="module")
def plan():
    return vp.solve(reach(35.0), check=False)


def test_the_search_ends_at_an_optimum(plan):
    """By first derivatives alone it takes over 200 iterations."""
    assert plan.status.converged
    assert plan.iterations <= 40
    problem, motion = plan.problem, plan.trajectory
    demand = (STIFFNESS * (motion.u - motion.q[:-1]) - DAMPING * motion.v[:-1]) / [105.0, 35.0]
    assert np.abs(demand).max() > 1.1

    def cost(u):
        options = {"dt": problem.dt, "steps": problem.steps, "integrator": problem.integrator, "check": False}
        return problem.cost_of(vp.simulate(problem.scene, problem.q0, problem.v0, controls=u, **options))

    for seed in range(3):
        way = np.random.default_rng(seed).normal(size=motion.u.shape)
        ahead, behind = (cost(motion.u + step * way) for step in (1e-5, -1e-5))
        assert abs(ahead - behind) / 2e-5 < 1e-3 * np.linalg.norm(way)


def test_the_history_tells_from_where_on_second_derivatives_are_used(plan):
    orders = [row.second_order for row in plan.history]
    assert not orders[0]
    assert orders[-1]
    assert [str(row).endswith("*") for row in plan.history] == orders


def test_drives_below_their_limits_change_no_search():
    below, endless = (vp.solve(reach(effort), check=False) for effort in (400.0, np.inf))
    assert below.cost == pytest.approx(endless.cost, rel=1e-12)
    assert [row.step for row in below.history] == [row.step for row in endless.history]
    assert not any(row.second_order for row in below.history)


def test_a_search_goes_on_from_a_file(plan, tmp_path):
    begun = vp.solve(plan.problem, check=False, max_iterations=plan.iterations - 3)
    read = vp.Solution.load(begun.save(tmp_path / "plan.npz"), plan.problem)
    assert read.history == begun.history
    assert read.search.second_order
    assert vp.solve(plan.problem, resume=read, check=False).cost == plan.cost


def test_linear_controls_at_the_limits_of_drives():
    """By first derivatives alone 200 iterations are not enough."""
    found = vp.solve(reach(35.0, controls="linear"), check=False, max_iterations=100)
    assert found.status.converged
    assert found.history[-1].second_order


def test_dampers_of_servos_count_where_the_arm_begins():
    """A drive that is told to go to 0 from there is at its limit, and damps nothing."""
    begin = np.array([0.8, -0.5])
    servos = vp.PositionServo(STIFFNESS, [500.0, 300.0], [20.0, 10.0])
    scene = vp.Scene(vp.planar_chain(2), forces=[servos], gravity=False)
    M = vp.lagrangian_jet(scene, begin, np.zeros(2)).Lvv
    rate = np.linalg.eigvals(np.linalg.solve(M, np.diag([500.0, 300.0]))).real.max()
    assert rate_at_rest(scene, begin) == pytest.approx(rate, rel=1e-12)
    cost = vp.ControlCost(1e-3, reference=GOAL) + vp.Terminal(vp.TrackingCost(GOAL, 1e3))
    found = vp.OptimalControlProblem(scene, cost, begin, np.zeros(2), dt=0.02, steps=40)
    assert 0.02 * rate > 10.0
    assert found.integrator == vp.Radau(4)
