"""Model predictive control: plans are those of solve, decisions those of plans, times the plant's."""

import numpy as np
import pytest
from findings import about
from mechanisms import slider
from numpy.testing import assert_allclose, assert_array_equal
from plan_problems import TWO, swing, wave
from refusals import naming, refused, unnamed

import varpin as vp
import varpin.control.mpc


def cart(steps=40, **options):
    cost = vp.TrackingCost([0.0], 1.0) + vp.VelocityCost(0.1) + vp.ControlCost(1e-2)
    return vp.OptimalControlProblem(
        vp.Scene(slider(), stiffness=3.0, gravity=False), cost, [1.0], [0.3], dt=0.05, steps=steps, **options
    )


def target(t):
    return [0.8 * np.sin(1.5 * t), 0.4]


def test_a_linear_system_under_a_quadratic_cost_is_a_linear_feedback():
    """The horizon's gain is then the same in every tick, so the run is one under that gain."""
    mpc = vp.Mpc(cart(), iterations=3, tolerance=1e-12)
    plant = vp.Plant(vp.Scene(mpc.problem.scene.robot, gravity=False, stiffness=mpc.problem.scene.stiffness))
    run = mpc.run(plant, duration=1.0)
    first = run.plans[0].policy_on("velocity")
    motion, x = [], np.array([1.0, 0.3])
    for _ in range(20):
        # About 0, where nothing is to be done: the feed-forward part is the gain's.
        u = first.u[0] + first.gains[0] @ (x - first.reference[0])
        part = vp.simulate(plant.scene, x[:1], x[1:], dt=5e-3, steps=10, controls=u, integrator=plant.integrator)
        motion.append(part.q[1:, 0])
        x = np.concatenate([part.q[-1], part.v[-1]])
    assert_allclose(run.motion.q[1:, 0], np.concatenate(motion), rtol=0, atol=1e-9)
    assert run.motion.steps == 200
    assert run.motion.t[-1] == pytest.approx(1.0)


def test_what_is_planned_begins_where_the_plant_is():
    run = vp.Mpc(wave(t0=0.7)).run(vp.Plant(wave().scene, substeps=4), duration=0.8)
    assert len(run.plans) == 10
    ticks = run.motion.q[::4]
    assert_allclose(run.planned(0.0)[:-1], ticks[:-1], rtol=0, atol=1e-12)
    for k, plan in enumerate(run.plans):
        assert_allclose(run.planned(0.4)[k], plan.trajectory.q[5], rtol=0, atol=1e-12)
        assert_allclose(run.planned()[k], plan.trajectory.q[-1], rtol=0, atol=1e-12)
        assert_array_equal(run.planned(9.0)[k], plan.trajectory.q[-1])
    assert_allclose(run.planned(0.4)[-1], run.plans[-1].trajectory.q[6], rtol=0, atol=1e-12)


def test_ctrl_c_ends_a_run_while_it_plans():
    calls, last = [], [np.inf]

    def interrupted(t, q, v, u):
        calls.append(len(t))
        if len(calls) > last[0]:
            last[0] = np.inf
            raise KeyboardInterrupt
        return (q[:, 0] - 1.0) ** 2

    within = vp.WithinVelocityLimits(TWO, (-0.5, 0.5))
    problem = swing(within, steps=6).at(cost=vp.CustomCost(interrupted, name="goal") + vp.ControlCost(1e-2))
    controller = vp.Mpc(problem, iterations=2)
    last[0] = 4
    with pytest.raises(KeyboardInterrupt) as first:
        controller.run(duration=0.3)
    assert not isinstance(first.value, vp.Interrupted)
    calls.clear()

    def soon(done, _):
        if done == 3:
            last[0] = len(calls) + 2

    with pytest.raises(vp.Interrupted) as caught:
        controller.run(duration=0.3, progress=soon)
    assert caught.value.trajectory.t[-1] == pytest.approx(3 * 0.03)


def test_a_run_that_ends_early_tells_of_ticks_without_a_plan():
    def stop(done, _):
        if done == 5:
            raise KeyboardInterrupt

    link = vp.planar_chain(1)
    problem = vp.OptimalControlProblem(vp.Scene(link), vp.ControlCost(), [0.0], [0.0], dt=0.05, steps=4)
    for pull, kind in ((100.0, vp.StepFailure), (9.81, vp.Interrupted)):
        fails = vp.Midpoint(guard=vp.Guard(max_halvings=0))
        with pytest.raises(kind) as caught:
            vp.Mpc(problem, budget=1e-9).run(
                vp.Plant(vp.Scene(link, gravity=(0.0, 0.0, -pull)), fails, 1), duration=1.0, progress=stop
            )
        assert about(caught.value.trajectory.warnings, "late plans")
        assert bool(about(caught.value.trajectory.warnings, "plan at its end")) == (kind is vp.Interrupted)


@pytest.mark.parametrize("controls", ["held", "linear"])
def test_a_plan_that_has_no_successor_acts_to_its_end_and_is_held_there(controls):
    usual, done = cart(steps=8), []

    def field(q, v, u):
        if done:
            raise ValueError("no such noise")
        return 1e-3 * np.eye(1)

    scene = vp.Scene(slider(), stiffness=3.0, gravity=False, noise=vp.CustomNoise(field, 1))
    failing = vp.OptimalControlProblem(scene, usual.cost, usual.q0, usual.v0, dt=usual.dt, steps=8, controls=controls)
    for mpc, kind in ((vp.Mpc(failing), "failed ticks"), (vp.Mpc(failing, budget=1e-9), "late plans")):
        done.clear()
        run = mpc.run(vp.Plant(usual.scene), duration=2.0, progress=lambda tick, _: done.append(tick))
        (told,) = about(run.warnings, kind)
        assert "in 39 of 39 ticks" in told
        assert ((run.late, run.failed)[kind == "failed ticks"] == (np.arange(40) > 0)).all()
        assert all(plan is run.plans[0] for plan in run.plans)
        assert naming(run.warnings, "whole horizon", "t = 0.4 s")
        policy, motion, end = run.plans[0].policy_on("velocity"), run.motion, run.plans[0].trajectory
        row, reference = 7, policy.reference[7]
        if controls == "linear":
            row, reference = 4, np.append(end.q[-1], end.v[-1])
        held = policy.u[7] + policy.gains[row] @ (np.append(motion.q[120], motion.v[120]) - reference)
        found = motion.u[129]
        if controls == "linear":
            # Steps have the means of the line over the tick, which begins where the one before ended.
            begin, found = (1.5 * motion.u[k - 1] - 0.5 * motion.u[k - 2] for k in (120, 130))
            held = held + policy.previous_gains[row] @ (begin - policy.u[7])
        assert_allclose(found, held, rtol=0, atol=1e-9)
        assert np.abs(run.motion.q[-1]).max() < 1.5


def test_a_cost_that_fails_keeps_the_motion_of_all_ticks_before():
    """In the plan of the tick whose horizon first reaches beyond 0.5 s."""
    usual = cart(steps=8)
    whole = vp.Mpc(usual.at(cost=usual.cost + vp.TrackingCost([0.0])), iterations=1).run(duration=0.3)
    broken = vp.TrackingCost(lambda t: [0.0 if t <= 0.51 else np.nan])
    with pytest.raises(vp.CostError) as caught:
        vp.Mpc(usual.at(cost=usual.cost + broken), iterations=1).run(duration=0.5)
    motion, cause = caught.value.trajectory, caught.value.__cause__
    assert motion.steps == 30
    assert_allclose(motion.q, whole.motion.q[:31], rtol=0, atol=1e-12)
    assert not unnamed(str(caught.value), "error.trajectory")
    assert isinstance(cause, vp.CostError)
    assert cause.trajectory is None
    assert caught.value.cost == cause.cost


@pytest.mark.parametrize(("slow", "told"), [(20, True), (3, True), (1, False), (0, False)])
def test_a_controller_that_cannot_keep_up_says_so(slow, told, monkeypatch):
    spans = iter([0.08] * slow + [0.01] * (20 - slow))
    now = [0.0, False]

    def clock():
        # Asked before a plan and after it.
        now[0] += next(spans) if now[1] else 0.0
        now[1] = not now[1]
        return now[0]

    class Clock:
        perf_counter = staticmethod(clock)

    monkeypatch.setattr(varpin.control.mpc, "time", Clock)
    run = vp.Mpc(cart(steps=8), iterations=1).run(duration=1.05)
    said = [sentence for sentence in run.warnings if "longer than 50 ms" in sentence]
    assert bool(said) == told
    assert not told or f"in {slow} of 20 ticks ({1e3 * run.seconds[1:].mean():.3g} ms in the mean)" in said[0]


def test_what_plan_and_motion_have_in_common_is_told_once():
    robot = vp.load_robot("ur5")
    cost = vp.VelocityCost(1e-3) + vp.ControlCost(1e-5) + vp.TrackingCost(lambda t: np.full(6, 20.0 * t**2), 10.0)
    problem = vp.OptimalControlProblem(
        vp.Scene(robot, gravity=False), cost, np.zeros(6), np.zeros(6), dt=0.02, steps=10
    )
    run = vp.Mpc(problem, iterations=1).run(duration=0.2)
    first = about(run.plans[0].warnings, "velocity limits")
    (told,) = about(run.warnings, "velocity limits")
    assert first
    assert told in run.motion.warnings
    # A run that ends before the plan gets that far tells it of the plan.
    short = vp.Mpc(problem, iterations=1).run(duration=0.02)
    assert [f"the first plan: {sentence}" for sentence in first] == about(short.warnings, "velocity limits")


@pytest.mark.parametrize(
    "cost",
    [
        vp.TrackingCost(target, 2.0) + vp.Terminal(vp.TrackingCost(target)),
        vp.TrackingCost(np.linspace([0.0, 0.0], [1.0, 2.0], 21)) + 2.0 * vp.VelocityCost(0.1),
        vp.CustomCost(lambda t, q, v, u: t * (q**2).sum(axis=-1)) + vp.ControlRateCost(0.1, [0.1, 0.2]),
        vp.Terminal(vp.FramePositionCost(vp.planar_chain(2), "tip", lambda t: [t, 0.0, 1.0])),
        vp.Terminal(vp.FrameOrientationCost(vp.planar_chain(2), "tip", np.eye(3))),
    ],
    ids=["path", "rows", "custom", "frame", "turn"],
)
def test_a_problem_at_another_time_and_state_is_that_of_its_grid(cost):
    cost = vp.ControlCost(0.1) + cost
    scene, grid = vp.Scene(vp.planar_chain(2)), {"dt": 0.05, "steps": 20, "control_limits": (-3.0, 4.0)}
    made = vp.OptimalControlProblem(scene, cost, [0.1, 0.2], [0.3, 0.4], t0=0.7, **grid)
    own = vp.OptimalControlProblem(scene, cost, [1.0, 2.0], [3.0, 4.0], t0=-0.2, **grid).at(
        q0=[0.1, 0.2], v0={"joint1": 0.3, "joint2": 0.4}, t0=0.7
    )
    motion = made.simulate(np.random.default_rng(1).normal(size=(20, 2)))
    assert own.cost_of(motion) == made.cost_of(motion)
    for name in ("q0", "v0", "t0", "dt", "steps", "control_limits"):
        assert_array_equal(getattr(own, name), getattr(made, name))
    assert not own.q0.flags.writeable
    with refused(vp.InputError, "q0"):
        own.at(q0=[0.1])
    with refused(vp.InputError, "t0"):
        own.at(t0="now")


def test_a_shifted_plan_of_linear_controls_is_the_rest_of_it():
    plan = vp.solve(wave(controls="linear", steps=8), tolerance=1e-10, check=False)
    motion, N = plan.trajectory, 8
    for by in (0, 3, N):
        at = {"q0": motion.q[by], "v0": motion.v[by], "t0": by * 0.08}
        again = plan.problem.at(**at).simulate(plan.shifted(by))
        assert_allclose(again.u_nodes[: N + 1 - by], plan.controls[by:], rtol=0, atol=1e-8)
        assert_allclose(again.q[: N + 1 - by], motion.q[by:], rtol=0, atol=1e-11)
    last = plan.shifted(N)
    assert_array_equal(last.u, np.tile(plan.controls[-1], (N, 1)))
    assert_array_equal(last.previous, np.tile(plan.controls[-1], (N, 1)))
    assert_array_equal(plan.shifted(2, before=[1.0, 2.0, 3.0]).before, [1.0, 2.0, 3.0])
    with refused(vp.InputError, "decisions", "8"):
        plan.shifted(N + 1)


@pytest.mark.parametrize("rate", [False, True])
def test_a_tick_with_linear_controls_is_its_problem_solved_anew(rate):
    problem = wave(controls="linear", control_limits=(-15.0, 15.0), steps=8)
    if rate:
        problem = problem.at(cost=problem.cost + vp.ControlRateCost(1e-6), control_limits=(-np.inf, np.inf))
    mpc = vp.Mpc(problem, iterations=50, tolerance=1e-13)
    first = mpc.plan(0.0, problem.q0, problem.v0)
    q, v = first.trajectory.q[1] + 0.01, first.trajectory.v[1] - 0.02
    tick = mpc.plan(0.08, q, v, previous=first)
    before = first.controls[1] if rate else None
    anew = vp.solve(problem.at(q0=q, v0=v, t0=0.08, before=before), tolerance=1e-13, check=False)
    assert tick.status.converged
    # Costs agree to the tenth digit: controls to the fifth of theirs.
    assert_allclose(tick.controls, anew.controls, rtol=0, atol=1e-5 * 15.0)
    assert tick.cost == pytest.approx(anew.cost, rel=1e-10)
    # One iteration has one backward pass, and leaves a part of what the shifted plan has too much.
    start = vp.solve(anew.problem, first.shifted(1, before), max_iterations=0, check=False)
    quick = vp.Mpc(problem, iterations=1).plan(0.08, q, v, previous=first)
    assert sum(item.backward_passes for item in quick.history) == quick.iterations == 1
    assert anew.cost < quick.cost < anew.cost + 0.2 * (start.cost - anew.cost)


def test_a_fault_of_the_plant_is_logged_once(caplog):
    robot = vp.planar_chain(2)
    plain, rough = (vp.Scene(robot, gravity=False, friction=level) for level in (0.0, 0.5))
    cost = vp.ControlCost(1e-2) + vp.Terminal(vp.TrackingCost([0.6, -0.4], 1e3) + vp.VelocityCost(10.0))
    problem = vp.OptimalControlProblem(plain, cost, np.zeros(2), np.zeros(2), dt=0.05, steps=8)
    run = vp.Mpc(problem, iterations=1).run(vp.Plant(rough, vp.ExplicitEuler(), substeps=1), duration=0.4)
    assert about(run.warnings, "error")
    assert len(about(caplog.messages, "error")) == 1
    assert not [record for record in caplog.records if record.name == "varpin.simulation.simulate"]


def test_errors_of_steps_do_not_add_up_in_the_loop():
    """Upright, the recorded torques alone let the arm fall; the loop of a far better plant is the same."""
    robot, up = vp.planar_chain(2), np.array([-np.pi / 2, 0.0])
    cost = vp.TrackingCost(up, 10.0) + vp.VelocityCost(0.1) + vp.ControlCost(1e-2)
    problem = vp.OptimalControlProblem(
        vp.Scene(robot, damping=0.1), cost, np.add(up, [0.1, 0.0]), np.zeros(2), dt=0.05, steps=12
    )
    noisy, coarse = vp.Scene(robot, damping=0.1, noise=vp.AdditiveNoise(1e-2)), vp.Midpoint(kick="held")
    run, better = (
        vp.Mpc(problem, iterations=1).run(vp.Plant(noisy, integrator=method), duration=3.0, rng=0)
        for method in (coarse, vp.Gauss(4, kick="held"))
    )
    assert_allclose(run.motion.q, better.motion.q, rtol=0, atol=1e-4)
    motion = run.motion
    given = {"dt": motion.dt, "steps": motion.steps, "controls": motion.u, "increments": motion.dw}
    assert about(vp.simulate(noisy, motion.q[0], motion.v[0], **given, integrator=coarse).warnings, "error")
    assert run.warnings == ()


def reach(robot, q0, goal, **grid):
    cost = vp.ControlCost(1e-2) + vp.Terminal(vp.TrackingCost(goal, 1e3) + vp.VelocityCost(10.0))
    return vp.OptimalControlProblem(vp.Scene(robot, damping=1.0), cost, q0, np.zeros(robot.dof), **grid)


def test_a_loop_that_keeps_what_begins_together_together_is_not_told_of():
    """With a payload that the plans do not know: they are made anew before they get to where their gains would lead."""
    q0 = np.array([0.35, -0.74, 0.22, -0.71, -0.39, -0.27, 0.24, -0.74])
    problem = reach(vp.load_robot("panda"), q0, [-0.09, -0.35, 0.52, -0.78, -0.70, 0.0, 0.14, -1.0], dt=0.01, steps=30)
    load = vp.Payload("panda_hand_tcp", 2.0, [0.05, 0.05, 0.1])
    scene = vp.Scene(vp.load_robot("panda", payload=load), damping=1.0, noise=vp.AdditiveNoise(0.02))
    plant, moved = vp.Plant(scene, substeps=5), 1e-7 * np.sin(np.arange(8))
    run, other = (
        vp.Mpc(each, iterations=1).run(plant, duration=0.4, rng=2) for each in (problem, problem.at(q0=q0 + moved))
    )
    assert np.abs(run.motion.q - other.motion.q).max() < 1e-6
    assert not about(run.warnings, "unstable loop")


@pytest.mark.parametrize(("rotors", "unstable"), [(0.05, False), (0.3, True)])
@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("controls", ["held", "linear"])
def test_gains_that_are_too_high_for_the_plant_are_told_of(rotors, unstable, noise, controls):
    """Plans are for rotors [kg m^2] that the plant has not, and of too many all runs away."""
    q0 = np.array([0.3, -1.2, 1.2, -0.5, -1.0, 0.2])
    problem = reach(vp.load_robot("ur5", armature=rotors), q0, q0 + 0.1, dt=0.01, steps=20, controls=controls)
    plant = vp.Scene(vp.load_robot("ur5"), damping=1.0, noise=vp.AdditiveNoise(noise))
    run = vp.Mpc(problem, iterations=1).run(vp.Plant(plant, substeps=5), duration=0.12, rng=1)
    assert (np.abs(run.motion.v).max() > 100.0) == unstable
    assert bool(about(run.warnings, "unstable loop")) == unstable
    if unstable:
        strict = vp.Midpoint(guard=vp.Guard(max_halvings=0), kick="held")
        with pytest.raises(vp.StepFailure) as caught:
            vp.Mpc(problem, iterations=1).run(vp.Plant(plant, strict, substeps=5), duration=1.0, rng=1)
        assert about(caught.value.trajectory.warnings, "unstable loop")


def test_of_a_coarse_plant_the_substeps_are_named_that_cure_it():
    scene = vp.Scene(slider(), stiffness=900.0, gravity=False, noise=vp.AdditiveNoise(0.01))

    def told(substeps):
        return about(vp.Mpc(cart()).run(vp.Plant(scene, substeps=substeps), duration=0.5, rng=1).warnings, "error")

    assert not told(int(told(2)[0].split("Use Plant(substeps=")[1].rstrip(")")))


# --- within constraints ----------------------------------------------------------------------------------------------


def bounded(constraints, **options):
    cost = vp.TrackingCost(target, 100.0) + vp.ControlCost(1e-4) + vp.VelocityCost(1e-2)
    given = {"dt": 0.03, "steps": 16, "constraints": constraints, **options}
    return vp.OptimalControlProblem(vp.Scene(TWO, damping=0.3), cost, [0.0, 0.4], [0.0, 0.0], **given)


SPEEDS = [vp.WithinVelocityLimits(TWO, (-0.8, 0.8))]


def test_ticks_that_find_no_plan_are_told_of():
    far = vp.Mpc(bounded([vp.ReachFrame(TWO, "tip", position=[2.2, 0.0, 0.0])])).run(duration=0.3)
    assert far.infeasible.sum() > 3
    assert naming(far.warnings, "no plan", "ReachFrame('tip')")
    # One iteration leaves a little of a violation that has a plan.
    assert not vp.Mpc(bounded(SPEEDS), iterations=1).run(duration=0.6).infeasible.any()
    assert not unnamed(str(far), "ReachFrame('tip')")
    assert np.isfinite(far.plans[-1].multipliers.values).all()


def test_what_the_plant_violates_is_told_of():
    noisy = vp.Plant(vp.Scene(TWO, damping=0.3, noise=vp.AdditiveNoise(0.1)))
    run, again = (vp.Mpc(bounded(SPEEDS)).run(noisy, duration=0.6, rng=1) for _ in range(2))
    assert_array_equal(run.motion.q, again.motion.q)
    assert 0.05 < run.constraints[0].violation < 0.4
    assert naming(run.warnings, "motion violates", "WithinVelocityLimits", "margin=", "narrower")


def test_ticks_within_speeds_are_close_to_their_optimum():
    """Of a UR3 most of whose joints are at their limits all the time."""
    robot, begin = vp.load_robot("ur3"), np.array([0.0, -1.2, 1.2, -0.5, -1.0, 0.0])
    scene = vp.Scene(robot, damping=0.1)
    cost = vp.TrackingCost(lambda t: begin + 0.35 * np.sin(2.0 * t) * np.cos(np.arange(6)), 100.0)
    cost += vp.VelocityCost(0.05) + vp.ControlCost(1e-4, scene.holding_torque(begin))
    problem = vp.OptimalControlProblem(
        scene,
        cost,
        begin,
        np.zeros(6),
        dt=0.02,
        steps=25,
        constraints=[vp.WithinVelocityLimits(robot, (-0.3, 0.3))],
    )
    one, three = (vp.Mpc(problem, iterations=count).run(duration=0.6) for count in (1, 3))
    costs = [np.mean([plan.cost for plan in run.plans]) for run in (one, three)]
    assert costs[0] <= 1.05 * costs[1]
    assert one.constraints[0].violation <= 3e-3


def test_between_nodes_ticks_keep_to_the_middles_of_long_steps():
    sphere, found = vp.KeepOutOfSphere(TWO, "tip", [1.6, 0.0, -1.2], 0.25), {}
    for between in (False, True):
        problem = bounded([sphere], between_nodes=between).at(dt=0.06, steps=8)
        found[between] = vp.Mpc(problem).run(duration=1.2).constraints[0].violation
    assert found[False] > 1e-3
    assert found[True] < 1e-4
