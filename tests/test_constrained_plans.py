"""Plans, controllers and choices of steps under constraints, against DOP853 on Pinocchio and differences."""

import numpy as np
import pinocchio as pin
import pytest
from findings import about
from oracles import exact, kkt, off_constraints
from refusals import naming, refused

import varpin as vp
from varpin.mechanics.assembly import along_constraints

MASSES, STIFFNESS, DAMPING = np.array([1.0, 2.0, 0.7]), np.array([3.0, 0.0, 5.0]), np.array([0.4, 0.2, 0.3])
ACTUATION = np.array([[1.0, 0.0], [0.0, 0.5], [0.3, -1.0]])
ROW = np.array([[1.0, -1.5, 0.5]])


def rails():
    model = pin.Model()
    for k, mass in enumerate(MASSES):
        place = pin.SE3(np.eye(3), np.array([0.0, float(k), 0.0]))
        joint = model.addJoint(0, pin.JointModelPX(), place, f"slide{k}")
        model.appendBodyToJoint(joint, pin.Inertia.FromSphere(mass, 0.1), pin.SE3.Identity())
    tie = vp.CustomConstraint(1, lambda q: ROW @ q - 0.2, lambda _: ROW, lambda _q, _w: np.zeros((3, 3)))
    return vp.Scene(
        vp.load_robot(model),
        gravity=False,
        stiffness=STIFFNESS,
        damping=DAMPING,
        actuation=ACTUATION,
        constraints=tie,
    )


def test_a_linear_quadratic_plan_is_optimal_and_so_is_its_feedback():
    """From other starts along the constraint the optimum begins as the gains say; across it they do nothing."""
    scene = rails()
    q0 = vp.assemble(scene, [0.1, 0.2, 0.3])
    v0 = along_constraints(scene, q0, np.array([0.3, -0.5, 0.2]))
    goal = np.array([1.0, 0.2, -0.4])
    cost = vp.TrackingCost(goal, [4.0, 2.0, 1.0]) + vp.VelocityCost([0.1, 0.2, 0.3]) + vp.ControlCost(0.05)
    cost += vp.Terminal(vp.TrackingCost(goal, [30.0, 10.0, 20.0]))
    problem = vp.OptimalControlProblem(
        scene, cost, q0, v0, dt=0.125, steps=8, integrator=vp.Midpoint(), sampling="midpoint"
    )
    plan = vp.solve(problem, np.zeros(2), tolerance=1e-14)
    assert plan.status.converged
    assert kkt(plan) < 1e-8
    away = along_constraints(scene, q0, np.array([0.01, 0.02, -0.03]))
    faster = along_constraints(scene, q0, np.array([-0.02, 0.03, 0.01]))
    other = vp.solve(problem.at(q0=q0 + away, v0=v0 + faster), plan, tolerance=1e-14)
    expected = plan.controls[0] + plan.gains[0] @ np.append(away, MASSES * faster)
    np.testing.assert_allclose(other.controls[0], expected, rtol=0, atol=1e-11)
    assert np.abs(other.controls[0] - plan.controls[0]).max() > 1e-2
    np.testing.assert_allclose(plan.gains[0][:, 3:] @ ROW[0], 0.0, atol=1e-10)


def five_bar(damping=0.1, **options):
    closed = vp.PointOnPoint("tip", (1.6, 0.0, 0.3), axes="xz")
    options |= {"constraints": closed, "actuation": ["joint1", "joint4"], "damping": damping}
    scene = vp.Scene(vp.planar_chain(4), **options)
    return scene, vp.assemble(scene, [-1.0, 1.0, 1.0, 1.0])


def reach(integrator=None, **options):
    scene, q0 = five_bar(**options)
    goal = vp.assemble(scene, q0 + 0.3 * np.eye(4)[0])
    cost = vp.ControlCost(1e-3) + vp.Terminal(vp.TrackingCost(goal, 1e3) + vp.VelocityCost(10.0))
    still = np.zeros(4)
    problem = vp.OptimalControlProblem(scene, cost, q0, still, dt=0.02, steps=50, integrator=integrator)
    return problem, goal


def test_a_five_bar_reaches_from_a_cold_start_and_holds():
    problem, goal = reach()
    plan = vp.solve(problem)
    assert plan.status.converged
    assert not plan.warnings
    assert np.abs(plan.trajectory.q[-1] - goal).max() < 0.01
    again = problem.simulate(plan.policy)
    np.testing.assert_allclose(plan.trajectory.constraint_forces, again.constraint_forces, rtol=0, atol=1e-6)
    assert plan.trajectory.constraint_labels == problem.scene.constraint_labels
    seen = plan.verify()
    assert max(abs(seen.closed_loop_loss), abs(seen.open_loop_loss)) < 1e-8
    motion = exact(problem.scene, problem.q0, problem.v0, plan.trajectory.t, lambda k, q, v: lambda t: plan.controls[k])
    np.testing.assert_allclose(plan.trajectory.q[-1], motion.q[-1], atol=1e-8)
    np.testing.assert_allclose(plan.trajectory.v[-1], motion.v[-1], atol=1e-7)
    assert max(off_constraints(problem.scene, plan.trajectory)) < 1e-13


def test_plans_begin_on_the_constraints(caplog):
    scene, q0 = five_bar()
    cost = vp.ControlCost(1.0)
    problem = vp.OptimalControlProblem(scene, cost, q0 + 1e-3, np.ones(4), dt=0.02, steps=5)
    assert naming(caplog.messages, "constraints", "v0")
    assert np.abs(scene.constraint_values(problem.q0)[0]).max() < 1e-14
    moved = problem.at(q0=q0 - 1e-3)
    assert np.abs(scene.constraint_values(moved.q0)[0]).max() < 1e-14
    assert np.abs(scene.constraint_values(moved.q0)[1] @ moved.v0).max() < 1e-13
    with refused(vp.InputError, "q0", "PointOnPoint", "assemble"):
        problem.at(q0=q0 + 0.3)


def test_noise_costs_what_the_plan_says():
    problem, _ = reach(vp.Midpoint(), noise=vp.AdditiveNoise(0.05))
    paths = vp.solve(problem, check=False).monte_carlo(300, rng=1)
    assert abs(paths.cost - paths.predicted) < 4.0 * paths.standard_error


def test_a_controller_keeps_a_closed_loop_on_its_way():
    scene, q0 = five_bar()
    goal = vp.assemble(scene, q0 + 0.15 * np.eye(4)[0])
    cost = vp.TrackingCost(goal, 100.0) + vp.VelocityCost(1.0) + vp.ControlCost(1e-4, scene.holding_controls(goal))
    problem = vp.OptimalControlProblem(scene, cost, q0, np.zeros(4), dt=0.02, steps=20, integrator=vp.Midpoint())
    heavier = vp.Scene(
        scene.robot, constraints=scene.constraints, actuation=scene.actuation, damping=0.5, noise=vp.AdditiveNoise(0.02)
    )
    run = vp.Mpc(problem).run(vp.Plant(heavier, substeps=2), duration=0.8, rng=0)
    assert np.abs(run.motion.q[-1] - goal).max() < 0.05
    assert np.abs(scene.core.constraints(run.motion.q)[0]).max() < 1e-12


@pytest.mark.parametrize("fast", [{"damping": 1e5}, {"forces": vp.CoulombFriction(1.0, width=1e-4)}])
def test_problems_of_closed_loops_take_an_integrator_that_keeps_them(fast):
    scene, q0 = five_bar(**fast)
    problem = vp.OptimalControlProblem(scene, vp.ControlCost(1.0), q0, np.zeros(4), dt=0.05, steps=4)
    assert problem.integrator == vp.Gauss(4)
    motion = vp.simulate(scene, q0, np.zeros(4), dt=0.05, steps=4, integrator=problem.integrator)
    assert np.abs(scene.core.constraints(motion.q)[0]).max() < 1e-12
    assert not any("Radau" in sentence for sentence in motion.warnings)


# --- choices of steps ------------------------------------------------------------------------------------------------


def test_of_a_start_off_the_constraints_it_is_said_that_it_was_moved(caplog):
    (scene, q), (other, _) = five_bar(), five_bar()
    motion = vp.simulate(scene, q + 1e-3, np.zeros(4), duration=0.2, tolerance=1e-6)
    assert about(motion.warnings, "start off the constraints")
    caplog.clear()
    vp.advise(other, q + 1e-3, np.zeros(4), duration=0.1, tolerance=1e-3)
    assert about(caplog.messages, "start off the constraints")
    starts, options = q + np.array([[0.0], [1e-3]]), {"dt": 0.01, "steps": 2}
    paths = vp.simulate_ensemble(scene, starts, np.zeros(4), paths=2, rng=0, **options)
    assert about(paths.warnings, "start off the constraints")
    alone = vp.simulate(scene, starts[1], np.zeros(4), **options)
    np.testing.assert_allclose(paths.q[1], alone.q, rtol=0, atol=1e-12)


def test_work_and_precision_under_constraints():
    scene, q = five_bar()
    v = along_constraints(scene, q, np.array([1.0, 0.0, 0.0, 2.0]))
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


def test_plans_by_different_integrators():
    problem = reach()[0].at(dt=0.04, steps=10)
    record = vp.optimal_control_tradeoff(problem, integrators=[vp.Midpoint(), vp.Gauss(2)], dts=[0.04], repeats=1)
    rough, good = record.runs
    assert not rough.failure
    off = [abs(run.closed_loop_cost / run.planned_cost - 1.0) for run in (good, rough)]
    assert off[0] < off[1]
