"""Joints that are moved by hand: against inverse dynamics, SciPy and differences, in plans, loops and noise."""

import numpy as np
import pytest
import zoo
from numpy.testing import assert_allclose
from oracles import exact, jacobian, lines
from plan_problems import hand
from refusals import refused

import varpin as vp

over_interpolations = pytest.mark.parametrize("interpolation", ["linear", "cubic"])


def test_a_joint_that_goes_on_steadily_needs_the_torque_of_inverse_dynamics():
    robot = vp.planar_chain(2)
    scene = vp.Scene(robot, constraints=[vp.KinematicInput(name) for name in robot.joint_names])
    v = np.array([0.7, -1.1])
    path = np.array([0.2, 0.5]) + np.linspace(0.0, 1.0, 1001)[:, None] * v
    motion = vp.simulate(scene, path[0], v, dt=1e-3, steps=1000, controls=path[1:], integrator=vp.Gauss(2))
    np.testing.assert_allclose(motion.q, path, atol=1e-12)
    jets = (vp.lagrangian_jet(vp.Scene(robot), q, v) for q in 0.5 * (path[:-1] + path[1:]))
    np.testing.assert_allclose(motion.constraint_forces, [jet.Lvq @ v - jet.Lq for jet in jets], atol=1e-4)


FIVE, HAND = zoo.ZOO["cranked five-bar"], vp.KinematicInput("joint1")


def cranked(interpolation="linear", **options):
    """A five-bar whose crank is moved by hand."""
    constraints = [FIVE.scene.constraints[0], vp.KinematicInput("joint1", interpolation)]
    return vp.Scene(FIVE.scene.robot, constraints=constraints, **options)


def test_a_kick_leaves_the_velocity_of_a_cubic_input():
    """K is the slope of a step in impulses, of which those on the joint are absorbed."""
    scene, q = cranked("cubic", noise=vp.AdditiveNoise(np.eye(4))), FIVE.q0
    controls = np.array([[q[0] + 0.004, 0.0, 0.0, 0.0, 1.1]])
    options = {"dt": 4e-3, "steps": 1, "controls": controls, "integrator": vp.Gauss(2)}
    still = vp.simulate(scene, q, FIVE.v0, increments=0.0, **options)

    def end(dw):
        motion = vp.simulate(scene, q, FIVE.v0, increments=dw[None], **options)
        return np.append(motion.q[1], motion.p[1])

    slopes = jacobian(end, np.zeros(4), 1e-2)
    np.testing.assert_allclose(vp.linearize(scene, still).K[0], slopes, atol=1e-8 * np.abs(slopes).max())


BEGIN, GOAL = np.array([0.5 * np.pi, 0.0]), np.array([0.5 * np.pi + 0.8, -0.8])


def swing(interpolation, dt, steps, **options):
    """A pole that hangs from a joint moved by hand, which is to swing to the side."""
    cubic = interpolation == "cubic"
    scene = vp.Scene(vp.planar_chain(2), actuation=["joint1"], constraints=vp.KinematicInput("joint1", interpolation))
    if cubic:
        cost = vp.VelocityCost(0.05) + vp.ControlRateCost([[0.0, 0.0], [0.0, 0.02]], before=[BEGIN[0], 0.0])
    else:
        cost = vp.VelocityCost([0.0, 0.05]) + vp.ControlRateCost(0.05, before=[BEGIN[0]])
    cost += vp.Terminal(vp.TrackingCost(GOAL, 100.0) + vp.VelocityCost(10.0 if cubic else [0.0, 10.0]))
    return vp.OptimalControlProblem(scene, cost, BEGIN, np.zeros(2), dt=dt, steps=steps, **options)


def test_what_an_input_does_is_what_the_energy_changes_by():
    """Also at the nodes, where the velocity of a joint on a line jumps."""
    scene = vp.Scene(vp.planar_chain(1), gravity=False, damping=0.0, constraints=vp.KinematicInput("joint1"))
    u = np.random.default_rng(0).normal(size=(10, 1))
    motion = vp.simulate(scene, [0.0], [0.5], dt=0.1, steps=10, controls=u, check=False)
    assert np.ptp(motion.energy) > 1.0
    assert np.abs(motion.statistics.energy_defect).max() <= 1e-12 * motion.energy.max()


@pytest.mark.parametrize(("interpolation", "dt", "steps"), [("linear", 0.02, 60), ("cubic", 0.08, 15)])
def test_a_plan_by_hand_holds_on_the_continuous_system(interpolation, dt, steps):
    """Between nodes the joint moves on its lines or cubics, in substeps as well; feedback is that of the policy."""
    problem = swing(interpolation, dt, steps)
    plan = vp.solve(problem)
    u, motion = plan.trajectory.u, plan.trajectory
    np.testing.assert_allclose(motion.q[1:, 0], u[:, 0], atol=1e-12)
    if interpolation == "cubic":
        np.testing.assert_allclose(motion.v[1:, 0], u[:, 1], atol=1e-9)
    assert abs(plan.verify(tolerance=1e-5).closed_loop_loss) < 2e-3
    assert np.abs(motion.q[-1] - GOAL).max() < 0.01
    options = {"dt": dt, "steps": steps, "integrator": problem.integrator}
    again = vp.simulate(problem.scene, BEGIN, np.zeros(2), controls=plan.policy, **options)
    np.testing.assert_array_equal(again.q, motion.q)
    off = BEGIN + np.array([0.0, 0.05])
    pushed, blind = (vp.simulate(problem.scene, off, np.zeros(2), controls=own, **options) for own in (plan.policy, u))
    assert problem.cost_of(pushed) < problem.cost_of(blind)


@over_interpolations
def test_a_controller_moves_a_joint_by_hand(interpolation):
    """The plant is heavier and damped; the joint goes on evenly from tick to tick, and the pole comes to hang."""
    cubic = [np.inf] if interpolation == "cubic" else []
    limits = ([BEGIN[0] - 0.1, *(-each for each in cubic)], [GOAL[0] + 0.1, *cubic])
    problem = swing(interpolation, 0.08, 12, control_limits=limits)
    given = {"actuation": ["joint1"], "constraints": problem.scene.constraints}
    heavy = vp.planar_chain(2, mass=1.4)
    run = vp.Mpc(problem).run(vp.Plant(vp.Scene(heavy, damping=[0.0, 0.01], **given), substeps=4), duration=2.4)
    motion = run.motion
    np.testing.assert_allclose(motion.q[-1], GOAL, atol=0.05)
    np.testing.assert_allclose(motion.q[1:, 0], motion.u[:, 0], atol=1e-12)
    assert (motion.q[:, 0] <= limits[1][0] + 1e-12).all()
    if cubic:
        np.testing.assert_allclose(motion.v[1:, 0], motion.u[:, 1], atol=1e-8)
    else:
        # Within a tick at one rate.
        np.testing.assert_allclose(np.diff(motion.q[:, 0], n=2)[[0, 1, 4, 5, 6, 8]], 0.0, atol=1e-12)
    # As many controls, but not the same ones.
    other = {"actuation": ["joint1", "joint2"], "constraints": HAND} if cubic else {"actuation": ["joint1"]}
    with refused(vp.InputError, "plant", "kinematic inputs"):
        vp.Mpc(problem).run(vp.Plant(vp.Scene(heavy, **other)), duration=0.1)


@over_interpolations
def test_noise_of_the_other_controls(interpolation):
    """The hand moves as told, the motor's noise is as in a scene whose hand has no control, and a plan knows it."""
    hand = vp.KinematicInput("joint1", interpolation)
    given = {"gravity": False, "damping": 0.2, "actuation": ["joint1", "joint2"], "constraints": hand}
    robot = vp.planar_chain(2)
    scene = vp.Scene(robot, noise=vp.ControlNoise(0.4), **given)
    cost = vp.ControlCost([300.0, 1e-3, *([300.0] if interpolation == "cubic" else [])])
    cost += vp.Terminal(vp.TrackingCost([0.0, -1.5], 20.0) + vp.VelocityCost([0.0, 2.0]))
    problem = vp.OptimalControlProblem(scene, cost, [0.0, 0.2], [0, 0], dt=0.08, steps=6, integrator=vp.Gauss(2))
    plan = vp.solve(problem, check=False)
    assert plan.noise_cost > 0.1 * plan.cost
    told = plan.monte_carlo(1500, rng=0)
    assert abs(told.cost - told.predicted) < 3.0 * told.standard_error
    motion = problem.simulate(plan.policy, rng=0)
    np.testing.assert_allclose(motion.q[1:, 0], motion.u[:, 0], atol=1e-12)
    # The same impulses as torques of the motor.
    field = np.zeros((2, 1, motion.u.shape[1]))
    field[1, 0, 1] = 0.4
    alone = vp.Scene(robot, noise=vp.ControlNoise(field), **given)
    options = {"dt": 0.08, "steps": 6, "integrator": problem.integrator, "increments": motion.dw[:, 1:2]}
    again = vp.simulate(alone, [0.0, 0.2], [0.0, 0.0], controls=motion.u, **options)
    np.testing.assert_allclose(again.q, motion.q, atol=1e-12)
    white = vp.Scene(robot, noise=vp.AdditiveNoise(0.3), **given)
    del options["increments"]
    paths = vp.simulate_ensemble(white, [0.0, 0.2], [0.0, 0.0], controls=motion.u, paths=5, rng=0, **options)
    np.testing.assert_allclose(paths.q[:, 1:, 0], np.tile(motion.u[:, 0], (5, 1)), atol=1e-12)
    assert np.ptp(paths.q[:, -1, 1]) > 1e-3


CRANK = cranked()
OWN = vp.CustomNoise(lambda q, v, u: np.ones((4, 1)), 1, dv=lambda q, v, u: np.zeros((4, 1, 4)))
SERVO = vp.PositionServo({"joint1": 10.0}, {"joint1": 1.0})
MORE = [vp.KinematicInput("joint2"), vp.KinematicInput("joint3")]
BY_POSITION = vp.ControlNoise(np.full((4, 2, 4), 0.1))


def planned(scene, **options):
    vp.OptimalControlProblem(scene, vp.ControlCost(1.0), FIVE.q0, FIVE.v0, dt=0.01, steps=3, **options)


def run(scene, **options):
    vp.simulate(scene, FIVE.q0, FIVE.v0, dt=0.01, steps=3, **options)


@pytest.mark.parametrize(
    ("call", "facts"),
    [
        (lambda: planned(CRANK, hold=3), "hold"),
        (lambda: planned(cranked("cubic"), sampling="midpoint"), ("KinematicInput", "cubic", "'midpoint'", "'gauss'")),
        (lambda: planned(cranked("cubic"), sampling="start"), ("KinematicInput", "cubic", "'start'", "'gauss'")),
        (lambda: cranked("spline"), ("interpolation", "'linear'", "'cubic'", "'spline'")),
        (lambda: run(CRANK, integrator=vp.RungeKutta4()), "constraints"),
        (lambda: run(cranked(noise=BY_POSITION), rng=0), ("ControlNoise", "KinematicInput", "position")),
        (lambda: run(cranked(noise=OWN), rng=0), ("noise", "velocity", "constraints")),
        (lambda: cranked(actuation=["joint2"]), "control"),
        (lambda: cranked(actuation=2.0 * np.eye(4)), "control"),
        (lambda: cranked(actuation=np.ones((4, 1))), "control"),
        (lambda: cranked(forces=SERVO), ("PositionServo", "KinematicInput")),
        (lambda: run(vp.Scene(CRANK.robot, constraints=[*CRANK.constraints, *MORE])), "KinematicInput(joint='joint3')"),
    ],
)
def test_what_does_not_know_inputs_refuses_them(call, facts):
    with refused(vp.InputError, facts):
        call()
    with pytest.raises(vp.UnknownJoint):
        vp.Scene(CRANK.robot, constraints=vp.KinematicInput("joint9"))


@over_interpolations
def test_a_file_moves_a_joint_to_where_its_sine_is_at_the_nodes(tmp_path, interpolation):
    path = tmp_path / "hand.toml"
    path.write_text(
        '[robot]\nsource = "finger"\n[initial]\nq = 0.5\n[horizon]\ndt = 0.01\nsteps = 10\n'
        f'[[constraint]]\ntype = "kinematic_input"\njoint = "mcp"\ninterpolation = "{interpolation}"\n'
        '[simulate.controls]\noffset = { mcp = 0.5 }\nsines = [{ of = "mcp", amplitude = 0.1, frequency = 2.0 }]\n'
    )
    motion = vp.load_scene(path).simulate()
    c = motion.joint_names.index("mcp")
    np.testing.assert_allclose(motion.q[:, c], 0.5 + 0.1 * np.sin(4.0 * np.pi * motion.t), atol=1e-12)
    if interpolation == "cubic":
        rate = 0.4 * np.pi * np.cos(4.0 * np.pi * motion.t[1:])
        np.testing.assert_allclose(motion.v[1:, c], rate, atol=1e-9)


def test_derivatives_of_a_crank_that_starts_from_rest():
    """Velocities are at their root from the start there, impulses are not."""
    slot, chain = vp.PointOnPoint("tip", (0.0, 0.0, 0.0), axes="z"), vp.planar_chain(2, length=0.3, mass=0.5)
    scene = vp.Scene(chain, actuation=["joint1"], constraints=[slot, HAND], damping=0.01)
    begin = vp.assemble(scene, [-0.6, 1.2])
    turn = begin[0] + 0.5 * (1.0 - np.cos(np.pi * 2e-3 * np.arange(1, 4)))
    motion = vp.simulate(scene, begin, np.zeros(2), dt=2e-3, steps=3, controls=turn[:, None], integrator=vp.Gauss(2))
    # Both links are as long, so the second turns twice as far the other way.
    np.testing.assert_allclose(vp.linearize(scene, motion).B[:, :2, 0], [[1.0, -2.0]] * 3, atol=1e-8)


@pytest.mark.parametrize("stages", [2, 4])
@pytest.mark.parametrize("joints", [2, 4])
def test_a_robot_that_is_held_at_rest_with_its_driven_joint_at_zero(joints, stages):
    """Where q and v of the driven joint are zero, its row has no terms to measure rounding by."""
    scene = vp.Scene(vp.planar_chain(joints), damping=0.1, constraints=[vp.KinematicInput("joint1")])
    q0 = np.full(joints, 0.1)
    q0[0] = 0.0
    for dt in (0.05, 0.02, 0.01, 0.001):
        motion = vp.simulate(scene, q0, np.zeros(joints), dt=dt, steps=3, integrator=vp.Gauss(stages))
        np.testing.assert_allclose(motion.q[:, 0], 0.0, rtol=0.0, atol=1e-15)
        u = scene.holding_controls(q0)
        held = vp.simulate(scene, q0, np.zeros(joints), dt=dt, steps=3, controls=u, integrator=vp.Gauss(stages))
        np.testing.assert_allclose(held.q, np.tile(q0, (4, 1)), rtol=0.0, atol=1e-13)


# --- functions of time, lines, policies, and plans on lines ----------------------------------------------------------


SPAN = 0.8


def path(t):
    return 0.3 + 0.4 * np.sin(3.0 * t)


def rate(t):
    return 1.2 * np.cos(3.0 * t)


def arm(interpolation):
    hand = vp.KinematicInput("joint1", interpolation)
    return vp.Scene(vp.planar_chain(3), actuation=["joint1", "joint2"], constraints=hand)


def wanted(scene, t):
    cubic = [rate(t)] if scene.controls == 3 else []
    return np.array([path(t), 1.5 * np.sin(5.0 * t + 0.4), *cubic])


Q0, V0 = np.array([path(0.0), 0.5, -0.4]), np.array([rate(0.0), 0.0, 0.0])


@pytest.mark.parametrize("divided", [False, True], ids=["a function of time", "in parts"])
def test_steps_are_linearized(divided):
    scene, dt, v0 = arm("cubic"), 0.2 if divided else 0.01, [V0[0], 0.0, 8.0 * divided]
    begin = np.array([path(dt), 20.0, rate(dt)]) if divided else wanted(scene, dt)

    def step(u):
        controls = u[None] if divided else vp.OpenLoop(lambda t: u + np.array([0.0, 3.0 * t, 0.0]))
        return vp.simulate(scene, Q0, v0, dt=dt, steps=1, controls=controls, integrator=vp.Gauss(2), check=False)

    def end(u):
        moved = step(u)
        return np.append(moved.q[1], moved.p[1])

    motion = step(begin)
    assert (motion.statistics.substeps[0] > 1) == divided
    slopes = jacobian(end, begin, 1e-4)
    assert_allclose(vp.linearize(scene, motion).B[0], slopes, atol=1e-8 * np.abs(slopes).max())


@over_interpolations
@pytest.mark.parametrize("kind", ["rows", "lines"])
def test_a_tolerance_divides_steps_as_the_input_moves(kind, interpolation):
    scene = arm(interpolation)
    nodes = np.array([wanted(scene, x) for x in np.linspace(0.0, SPAN, 9)])
    given = nodes[1:] if kind == "rows" else vp.FirstOrderHold(nodes)
    found = vp.simulate(scene, Q0, V0, duration=SPAN, tolerance=1e-7, controls=given, integrator=vp.Gauss(2))
    assert found.accuracy.met
    assert found.steps > 8
    assert_allclose(found.q[:: found.steps // 8][1:, 0], nodes[1:, 0], atol=1e-13)
    fine = vp.simulate(scene, Q0, V0, dt=SPAN / 8, steps=8, controls=given, integrator=vp.Gauss(6), check=False)
    assert_allclose(found.q[-1], fine.q[-1], atol=1e-7)


def test_a_tolerance_follows_a_function_of_time():
    scene = arm("cubic")
    controls = vp.OpenLoop(lambda t: wanted(scene, t))
    found = vp.simulate(scene, Q0, V0, duration=SPAN, tolerance=1e-6, controls=controls)

    def way(t):
        return np.array([path(t)]), np.array([rate(t)]), np.array([-3.6 * np.sin(3.0 * t)])

    own = exact(scene, Q0, V0, [0.0, SPAN], lambda k, q, v: lambda t: wanted(scene, t), path=way)
    assert np.abs(found.q[-1] - own.q[-1]).max() < 1e-6


@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("hold", [1, 3])
def test_a_policy_moves_an_input_over_its_intervals(hold, linear):
    scene = arm("linear")
    dt, N = 0.01, 10
    t = hold * dt * np.arange(N + 1)
    u = np.array([wanted(scene, x) for x in t])
    gains = np.zeros((N, 2, 6))
    gains[:, 0, 1], gains[:, 1, 2] = 0.05, -2.0
    reference = np.tile(np.append(Q0, np.zeros(3)), (N, 1))
    policy = vp.LinearPolicy(u[1:], gains, reference, hold, "momentum", before=u[0], linear=linear)
    given = {"dt": dt, "steps": N * hold, "integrator": vp.Gauss(2)}
    motion = vp.simulate(scene, Q0, V0, controls=policy, **given)
    at = np.arange(0, N * hold, hold)
    goals = u[1:, 0] + 0.05 * (motion.q[at, 1] - Q0[1])
    assert_allclose(motion.q[at + hold, 0], goals, atol=1e-13)
    assert_allclose(motion.u[:, 0], motion.q[1:, 0], atol=1e-13)
    evenly = np.diff(motion.q[:, 0]).reshape(N, hold)
    assert_allclose(evenly, np.broadcast_to(evenly[:, :1], evenly.shape), atol=1e-13)
    if not linear:
        again = vp.simulate(scene, Q0, V0, controls=motion.u, **given)
        assert_allclose(again.q, motion.q, atol=1e-12)
        paths = vp.simulate_ensemble(scene, Q0, V0, paths=2, rng=0, controls=policy, **given)
        assert_allclose(paths.q[0], motion.q, atol=1e-13)
        assert_allclose(paths.u[0], motion.u, atol=1e-13)
    assert_allclose(vp.linearize(scene, motion).B[:, 0, 0], 1.0, atol=1e-12)


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_a_controller_takes_them(interpolation):
    problem = hand(interpolation, steps=12, dt=0.04)
    run = vp.Mpc(problem).run(vp.Plant(problem.scene, substeps=3), duration=1.2)
    assert_allclose(run.motion.q[1:, 0], run.motion.u[:, 0], atol=1e-12)
    assert_allclose(run.motion.q[-1], [0.4, -0.6, 0.2], atol=0.1)


@pytest.mark.parametrize("controls", ["held", "linear"])
@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_searches_start_on_states(interpolation, controls):
    problem = hand(interpolation, controls=controls)
    own = vp.solve(problem, tolerance=1e-12, check=False)
    share = np.linspace(0.0, 1.0, problem.steps + 1)[:, None]
    states = problem.q0 + share * (np.array([0.3, -0.4, 0.1]) - problem.q0)
    found = vp.solve(problem, states=states, tolerance=1e-12, check=False)
    assert found.status.converged
    assert found.cost == pytest.approx(own.cost, rel=1e-9)
    assert_allclose(found.trajectory.q, own.trajectory.q, atol=1e-5)
    # The first motion of no iterations is on the states.
    first = vp.solve(problem, states=own.trajectory, max_iterations=0, check=False)
    assert_allclose(first.trajectory.q[:, 0], own.trajectory.q[:, 0], atol=1e-12)


def test_noise_of_the_position_of_an_input_is_differentiated_at_the_end_of_the_step():
    own = vp.CustomNoise(
        lambda q, v, u: np.array([[0.0], [u[0] * u[1]], [u[0] ** 2]]),
        1,
        du=lambda q, v, u: np.array([[[0.0] * 3], [[u[1], u[0], 0.0]], [[2.0 * u[0], 0.0, 0.0]]]),
        check=True,
    )
    problem = hand("linear", steps=1, noise=own)
    u = np.array([0.1, -0.2, 0.3, 0.5, 0.1, -0.3])
    lin = vp.linearize(problem.scene, problem.simulate(lines(problem, u.reshape(2, 3))))

    def fields(u):
        """Of the mean over the step, and of the slope."""
        mean, last = 0.5 * (u[1] + u[4]), u[3]
        return np.array([[0.0, last * mean, last**2], [0.0, last * (u[4] - u[1]) / np.sqrt(12.0), 0.0]]).T

    assert_allclose(lin.F[0, :, 0], fields(u)[:, 0], atol=1e-12)
    assert_allclose(lin.G[0], lin.J[0] @ fields(u), atol=1e-12)
    # The Jacobian of the step stays: it is the fields that are differentiated.
    found, moved = np.concatenate([lin.Gu - lin.Gramp, lin.Gramp], axis=3)[0], jacobian(fields, u, 1e-3)
    assert_allclose(found, np.einsum("ij,jkc->ikc", lin.J[0], moved), atol=1e-8)
