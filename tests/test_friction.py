"""What integrates a motion where nobody says what; and dry friction that is too fast for steps."""

from dataclasses import replace

import numpy as np
import pytest
from findings import about
from oracles import exact

import varpin as vp
from varpin.control.search import Search
from varpin.control.solving import _gentler
from varpin.mechanics.forces import drive_forces
from varpin.simulation.choice import STIFF
from varpin.simulation.spectrum import rate_at_rest


def block(width, level=1.0):
    return vp.Scene(vp.planar_chain(1), gravity=False, forces=vp.CoulombFriction(level, width))


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(2), vp.Gauss(4), vp.Radau(2), vp.Radau(3)], ids=str)
@pytest.mark.parametrize("width", [1e-1, 1e-3, 1e-5])
def test_friction_never_adds_energy(integrator, width):
    for v0 in (2.0, 2.005, 2.013):
        motion = vp.simulate(block(width), [0.0], [v0], dt=1e-2, steps=120, integrator=integrator)
        assert np.diff(motion.energy).max() <= 1e-14


LEVELS = [8.0, 8.0, 5.0, 2.0, 2.0, 1.0]
BEGIN, SPEED = np.array([0.0, -1.2, 1.5, -0.5, 0.3, 0.2]), np.array([1.0, 1.0, -1.0, 1.0, 2.0, 2.0])


def test_friction_so_fast_that_steps_take_very_short_parts():
    scene = vp.Scene(vp.load_robot("ur5"), forces=vp.CoulombFriction(LEVELS, 1e-5))
    stopped = vp.simulate(scene, BEGIN, SPEED, dt=1e-2, steps=60, integrator=vp.Radau(3))
    assert stopped.statistics.halvings.max() > 12
    assert stopped.statistics.substeps.max() < 100
    assert np.abs(stopped.v[10:, 5]).max() < 1e-3
    motion = vp.simulate(scene, BEGIN, SPEED, dt=2e-2, steps=30, integrator=vp.RungeKutta4())
    # Friction holds the last joint after 0.08 s.
    assert np.abs(motion.v[5:, 5]).max() > 0.3
    assert about(motion.warnings, "error")


def test_joints_that_do_not_stop_are_quiet():
    sliding = vp.simulate(block(1e-5, 0.1), [0.0], [2.0], dt=1e-2, steps=100)
    resting = vp.simulate(block(1e-5), [0.0], [0.0], dt=1e-2, steps=100)
    assert about(sliding.warnings, "error") == about(resting.warnings, "error") == []


def problem(width, dt=0.02):
    scene = vp.Scene(vp.planar_chain(2), gravity=False, forces=vp.CoulombFriction(0.5, width))
    cost = vp.ControlCost(1e-2) + vp.Terminal(vp.TrackingCost([0.6, -0.4], 1e3) + vp.VelocityCost(10.0))
    return vp.OptimalControlProblem(scene, cost, [0.0, 0.0], [0.0, 0.0], dt=dt, steps=round(0.6 / dt))


def test_problems_take_an_integrator_that_friction_is_not_too_fast_for():
    assert problem(0.1).integrator == vp.Gauss(3)
    rough = problem(1e-4)
    assert rough.dt * rate_at_rest(rough.scene, rough.q0) > 10.0
    assert rough.integrator == vp.Radau(4)
    assert rough.at(dt=0.01).integrator == vp.Radau(4)
    # Another step chooses anew.
    assert 1e-4 * rate_at_rest(rough.scene, rough.q0) < 10.0
    assert rough.at(dt=1e-4).integrator == vp.Gauss(4)
    given = vp.OptimalControlProblem(
        rough.scene, rough.cost, rough.q0, rough.v0, dt=0.02, steps=30, integrator=vp.Gauss(2)
    )
    assert given.integrator == vp.Gauss(2)


def test_verification_under_friction_that_is_too_fast_for_explicit_steps():
    rough = problem(2e-4)
    plan = vp.solve(rough)
    found = plan.verify(tolerance=1e-5, max_substeps=256)
    assert found.integrator == str(vp.Radau(3))
    assert found.told
    assert "Radau" in str(found)
    times, u = rough.dt * np.arange(31), plan.controls
    held = lambda k, q, v: lambda t: u[k]  # noqa: E731
    motion = exact(rough.scene, rough.q0, rough.v0, times, held, stiff=True, rtol=1e-8)
    q, v = motion.q[-1], motion.v[-1]
    true = rough.dt * 1e-2 * (u**2).sum() + 1e3 * ((q - [0.6, -0.4]) ** 2).sum() + 10.0 * (v**2).sum()
    assert found.open_loop_cost == pytest.approx(true, rel=1e-4)


def arm(name, width=0.01, goal=0.4, **options):
    robot = vp.load_robot(name)
    q0 = np.full(robot.dof, 0.3)
    cost = vp.ControlCost(1e-3) + vp.VelocityCost(1e-2)
    cost += vp.Terminal(vp.TrackingCost(q0 + goal, 1e3) + vp.VelocityCost(100.0))
    scene = vp.Scene(robot, forces=vp.CoulombFriction(0.2, width))
    limits = -robot.effort_limit, robot.effort_limit
    given = {"dt": 0.02, "steps": 50, "control_limits": limits, "constraints": [vp.WithinVelocityLimits(robot)]}
    return vp.OptimalControlProblem(scene, cost, q0, np.zeros(robot.dof), **given | options)


@pytest.mark.parametrize("name", ["xarm7", "ur5"])
def test_plans_come_to_sharp_friction_from_wide_friction(name):
    sharp = arm(name)
    plan, wide = (vp.solve(own, max_iterations=60, check=False) for own in (sharp, arm(name, 0.05)))
    assert plan.violation <= 1e-6
    # Wider friction is no stronger at any speed.
    assert 0.97 * wide.cost < plan.cost < 1.1 * wide.cost
    # The goal is reached in steps of a tenth, too, which resolve the friction better.
    fine = sharp.at(dt=2e-3, hold=10, integrator=vp.Radau(3)).simulate(np.repeat(plan.controls, 10, axis=0))
    assert np.abs(fine.q[-1] - plan.trajectory.q[-1]).max() < 0.05


def test_friction_is_widened_until_the_step_resolves_it():
    assert _gentler(arm("xarm7").at(dt=1e-5, steps=3)) == []
    assert _gentler(problem(0.1)) == []
    sharp = problem(2e-4)
    row = _gentler(sharp)
    rates = [sharp.dt * rate_at_rest(own.scene, sharp.q0) / STIFF for own in (*row, sharp)]
    assert 1 / 3 < rates[0] <= 1.0 < rates[1]
    assert np.diff(np.log(rates)) == pytest.approx(np.log(3.0))
    assert {own.values[0] for one in row for own in one.scene.elements} == {0.5}


def test_ctrl_c_under_wider_friction_returns_a_motion(monkeypatch):
    def stopped(self, *options):
        if self.problem.scene is not sharp.scene:
            raise KeyboardInterrupt
        return run(self, *options)

    sharp, run = problem(2e-4), Search.run
    monkeypatch.setattr(Search, "run", stopped)
    plan = vp.solve(sharp, check=False)
    assert plan.status is vp.Status.INTERRUPTED
    assert plan.problem is sharp
    assert len(plan.history) == 1


def test_noise_beyond_the_width_of_friction_is_reported():
    """Linearized friction damps noise that the friction hardly feels."""
    robot = vp.planar_chain(2)

    def plan(noise):
        forces = [vp.CoulombFriction(0.3, 0.02)]
        scene = vp.Scene(robot, gravity=False, forces=forces, noise=vp.AdditiveNoise(noise))
        cost = vp.ControlCost(1.0) + vp.TrackingCost([0.0, 0.0], 1.0)
        problem = vp.OptimalControlProblem(scene, cost, [0.0, 0.0], [0.0, 0.0], dt=0.01, steps=30)
        return vp.solve(problem)

    loud, calm = plan(0.3), plan(1e-4)
    paths = loud.monte_carlo(paths=100, rng=0)
    assert paths.cost > 3.0 * paths.predicted
    told = [any(told.kind == "friction under noise" for told in found.warnings) for found in (loud, calm)]
    assert told == [True, False]
    paths = calm.monte_carlo(paths=100, rng=0)
    assert paths.cost == pytest.approx(paths.predicted, abs=4.0 * paths.standard_error)


def test_an_arm_comes_to_rest():
    scene = vp.Scene(vp.load_robot("ur5"), gravity=False, forces=vp.CoulombFriction(LEVELS, 1e-2))
    true = exact(scene, BEGIN, SPEED, np.linspace(0.0, 0.6, 13), stiff=True, rtol=1e-8).q
    for integrator, error in ((vp.Radau(3), 2e-6), (vp.Gauss(3), 2e-6), (vp.Midpoint(), 2e-5)):
        motion = vp.simulate(scene, BEGIN, SPEED, dt=1e-3, steps=600, integrator=integrator)
        np.testing.assert_allclose(motion.q[::50], true, atol=error)
        assert np.abs(motion.v[-1]).max() < 1e-6
        assert np.diff(motion.energy).max() <= 1e-12 * motion.energy[0]


CHAIN = vp.planar_chain(2)
DT, STEPS = 0.01, 100
ENDS = {"lower": {"joint1": -9.0, "joint2": -9.0}, "upper": {"joint1": 9.0, "joint2": 0.5}}


def stopped():
    stop = vp.JointStop(1e3, 300.0, **ENDS, width=0.05)
    scene = vp.Scene(CHAIN, gravity=False, damping=0.3, forces=[stop])
    controls = np.random.default_rng(0).uniform(-6.0, 6.0, (STEPS, 2)) + np.array([0.0, 5.0])
    return scene, [0.0, 0.0], [0.5, 0.0], controls


def test_stops_ahead():
    scene, q0, v0, controls = stopped()
    options = {"dt": DT, "steps": STEPS, "controls": controls}
    usual = vp.simulate(scene, q0, v0, **options)
    named = vp.simulate(scene, q0, v0, **options, integrator=vp.Gauss(2), check=False)
    assert (usual.integrator, named.integrator) == ("Radau(stages=4)", "Gauss(stages=2)")
    assert usual.warnings == ()
    fine = {"dt": DT / 32, "steps": 32 * STEPS, "controls": np.repeat(controls, 32, axis=0)}
    true = vp.simulate(scene, q0, v0, **fine, integrator=vp.Radau(3), check=False)
    q, v = true.q[::32], true.v[::32]
    assert np.abs(usual.q - q).max() < 1e-3 * np.ptp(q, axis=0).max()
    assert np.abs(usual.v - v).max() < 3e-3 * np.abs(v).max() < 0.15 * np.abs(named.v - v).max()


def test_a_stop_between_two_nodes():
    stop = vp.JointStop(1e6, 500.0, **ENDS, width=1e-3)
    scene = vp.Scene(CHAIN, gravity=False, forces=[stop])
    # The nodes lie 0.005 rad before the stop and behind it.
    motion = vp.simulate(scene, [0.0, 0.445], [0.0, 5.0], dt=DT, steps=4)
    assert motion.q[:, 1].max() < 0.5
    assert motion.integrator == "Radau(stages=4)"


def test_a_stiff_stop():
    scene = vp.Scene(CHAIN, gravity=False, forces=[vp.JointStop(1e4, 0.0, **ENDS)])
    for speed in (2.0, 0.2):
        motion = vp.simulate(scene, [0.0, 0.3], [0.0, speed], dt=DT, steps=60, check=False)
        assert motion.integrator == "Gauss(stages=4)"


def test_paths_without_noise_are_those_of_simulate():
    scene, q0, v0, controls = stopped()
    options = {"dt": DT, "steps": STEPS, "controls": controls}
    alone = vp.simulate(scene, q0, v0, **options)
    paths = vp.simulate_ensemble(scene, q0, v0, **options, paths=2, rng=0)
    assert paths.integrator == alone.integrator == "Radau(stages=4)"
    assert paths.integrator in repr(paths)
    np.testing.assert_array_equal(paths.q[1], alone.q)
    # Those that start away from the stop, which later ones come to.
    q0 = np.linspace([0.0, -3.0], [0.0, 0.3], 32)
    assert vp.simulate_ensemble(scene, q0, [0.0, 3.0], dt=DT, steps=10, paths=32, rng=0).integrator == alone.integrator
    noisy = vp.Scene(CHAIN, gravity=False, damping=0.3, noise=vp.AdditiveNoise(0.1))
    assert vp.simulate_ensemble(noisy, q0[:2], [0.0, 0.5], dt=DT, steps=10, paths=2, rng=0).integrator.startswith("Mid")


@pytest.mark.parametrize(
    ("scene", "rng", "chosen"),
    [
        ({"damping": 0.3}, None, "Gauss(stages=2)"),
        ({"damping": [0.3, 200.0]}, None, "Radau(stages=4)"),
        ({"damping": 0.3, "forces": [vp.JointStop(1e3, 300.0, **ENDS)]}, None, "Radau(stages=4)"),
        ({"damping": 0.3, "forces": vp.FrameDamper("tip", np.zeros(3), [0, 0, 1e4])}, None, "Gauss(stages=2)"),
        ({"damping": 0.3, "forces": vp.FrameDamper("tip", np.zeros(3), [1e4, 0, 0])}, None, "Radau(stages=4)"),
        ({"damping": 0.3, "noise": vp.AdditiveNoise(0.1)}, None, 'Gauss(stages=2, kick="held")'),
        ({"damping": 0.3, "noise": vp.AdditiveNoise(0.1)}, 0, 'Midpoint(alpha=0.5, kick="held")'),
    ],
    ids=["light", "damped", "stops", "no lever", "lever", "no noise", "noise"],
)
def test_a_plant_takes_that_of_simulate(scene, rng, chosen):
    """As its start, its stops and the first plan ask for it, at its own steps."""
    cost = vp.TrackingCost(lambda t: [1.57 - t, 0.0], 100.0) + vp.ControlCost(1e-3)
    start = [1.57, 0.0], [0.0, 0.0]
    problem = vp.OptimalControlProblem(vp.Scene(CHAIN, gravity=False), cost, *start, dt=0.05, steps=10)
    plant = vp.Plant(vp.Scene(CHAIN, gravity=False, **scene), substeps=5)
    assert vp.Mpc(problem).run(plant, duration=0.1, rng=rng).motion.integrator == chosen
    named = replace(plant, integrator=vp.RungeKutta4(), substeps=50)
    if chosen != "Radau(stages=4)":
        assert vp.Mpc(problem).run(named, duration=0.1, rng=rng).motion.integrator == "RungeKutta4"


# --- arms as people have them, under their files' damping and on servos ----------------------------------------------


# Robots of example-robot-data whose files declare damping; some of those with dry friction, too.
RUBBING = ["xarm7", "z1", "talos_arm", "allegro_left_hand"]
DAMPED = ["allegro_right_hand", "tiago_no_hand", "tiago_pro", "panda", "panda_collision", "baxter"]
DAMPED += ["double_pendulum", "double_pendulum_continuous", "double_pendulum_simple"]
DAMPED += ["alex_sake_hands", "alex_nub_hands", "alex_psyonic_hands"]
EVERY = [(name, share, False, 10) for name in RUBBING + DAMPED for share in (0.05, 0.2)]
EVERY += [(name, share, True, 10) for name in RUBBING for share in (0.05, 0.2)]


@pytest.mark.parametrize(
    ("name", "share", "friction", "steps"),
    [
        ("xarm7", 0.2, True, 4),
        ("z1", 0.05, False, 4),
        *(pytest.param(*values, marks=pytest.mark.slow) for values in EVERY),
    ],
)
def test_torques_that_jump_on_robots_as_they_are(load, name, share, friction, steps):
    """With nothing said of the integrator: within 1 % of the way and 10 % of the largest velocity of each joint."""
    robot, rng = load(name), np.random.default_rng(1)
    forces = [vp.CoulombFriction(robot.friction)] if friction else []
    scene, rest = vp.Scene(robot, damping="robot", forces=forces), np.zeros(robot.dof)
    lower, upper = (np.nan_to_num(limit, posinf=1.0, neginf=-1.0) for limit in robot.position_limits)
    q0 = 0.5 * (lower + upper)
    rows = scene.holding_torque(q0) + share * rng.normal(size=(steps, robot.dof)) * np.minimum(robot.effort_limit, 50.0)
    times = 1e-2 * np.arange(steps + 1)
    own = exact(scene, q0, rest, times, lambda k, q, v: lambda t: rows[k], stiff=True)
    motion = vp.simulate(scene, q0, rest, dt=1e-2, steps=steps, controls=rows)
    assert (np.abs(motion.q - own.q).max(axis=0) <= 0.01 * np.abs(own.q - q0).max(axis=0)).all()
    assert (np.abs(motion.v - own.v).max(axis=0) <= 0.10 * np.abs(own.v).max(axis=0)).all()


TIE = vp.JointTie("wrist_1_joint", "elbow_joint")


@pytest.mark.parametrize(
    ("name", "options", "dt", "integrator"),
    [
        ("xarm7", {"damping": "robot"}, 1e-2, "Radau(stages=4)"),
        ("xarm7", {"damping": "robot"}, 5e-5, "Gauss(stages=2)"),
        ("xarm7", {"damping": "robot", "noise": vp.AdditiveNoise(0.1)}, 1e-2, 'Midpoint(alpha=0.5, kick="held")'),
        ("ur5", {}, 1e-2, "Gauss(stages=2)"),
        ("ur5", {"damping": 1e3, "constraints": TIE}, 1e-2, "Gauss(stages=2)"),
        ("ur5", {"forces": vp.CoulombFriction(1.0)}, 1e-2, "Radau(stages=4)"),
        ("ur5", {"stiffness": 1e4}, 1e-2, "Gauss(stages=4)"),
        ("ur5", {"stiffness": 1e4}, 1e-4, "Gauss(stages=2)"),
    ],
)
def test_who_integrates_where_nobody_is_named(load, name, options, dt, integrator):
    """Dampers and springs faster than the step change it; Radau goes neither with noise nor with constraints."""
    scene = vp.Scene(load(name), **options)
    rest, seed = np.zeros(scene.robot.dof), 0 if "noise" in options else None
    assert vp.simulate(scene, rest, rest, dt=dt, steps=1, rng=seed).integrator == integrator


START = np.array([0.0, -1.2, 1.4, -1.0, -1.57, 0.0])


def served_arm(robot, frequency, effort=np.inf):
    """A UR5 on servos of a natural frequency [Hz] at a posture, damped by 0.7."""
    rate, mass = 2.0 * np.pi * frequency, np.diag(vp.lagrangian_jet(vp.Scene(robot), START, np.zeros(6)).Lvv)
    return vp.Scene(robot, forces=[vp.PositionServo(mass * rate**2, 1.4 * mass * rate, effort)])


def finely(scene, rows, parts):
    """Commands of 5 ms by Radau in steps of a part of that."""
    finer = {"dt": 5e-3 / parts, "steps": parts * len(rows), "controls": np.repeat(rows, parts, axis=0)}
    return vp.simulate(scene, START, np.zeros(6), integrator=vp.Radau(3), check=False, **finer)


def moved_arm(scene, rows, integrator):
    return vp.simulate(scene, START, np.zeros(6), dt=5e-3, steps=len(rows), controls=rows, integrator=integrator)


@pytest.mark.parametrize("frequency", [20, 100, 500, 2000, 5000])
def test_steps_of_servos_of_any_stiffness(load, frequency):
    """Commands that jump, at a step of 5 ms: the end by Radau in finer steps, and where each servo sags to."""
    scene = served_arm(load("ur5"), frequency)
    goal = START + np.array([0.05, -0.04, 0.03, 0.05, -0.05, 0.1])
    rows = np.repeat([goal, START + 0.02, goal], 20, axis=0)
    end = finely(scene, rows, 16).q[-1]
    if frequency >= 100:
        stiffness = scene.actuation.diagonal()
        np.testing.assert_allclose(end, goal - scene.holding_torque(end) / stiffness, atol=1e-6)
        for integrator in (vp.RungeKutta4(), vp.SemiImplicitEuler()):
            with pytest.raises(vp.StepFailure):
                moved_arm(scene, rows, integrator)
    for integrator in (None, vp.Midpoint(), vp.Gauss(2), vp.Gauss(3), vp.Gauss(4), vp.Radau(2)):
        motion = moved_arm(scene, rows, integrator)
        # The midpoint rule is A-stable only: what a jump excites far above its step's rate rings on, and it says so.
        rings = isinstance(integrator, vp.Midpoint) and frequency > 100
        assert np.abs(motion.q[-1] - end).max() <= (1e-2 if rings else 1e-3)
        assert not rings or about(motion.warnings, "error")


@pytest.mark.parametrize("frequency", [20, 500, 5000])
def test_servos_at_their_limits(load, frequency):
    """Commands beyond the motors for a while: within 1e-3 rad in the end, or so far off as the check says."""
    scene = served_arm(load("ur5"), frequency, 0.3 * load("ur5").effort_limit)
    rows = np.tile(START + np.array([0.3, 0.1, -0.1, 0.0, 0.0, 0.0]), (100, 1))
    fine = finely(scene, rows, 64)
    drives = drive_forces(scene.elements, fine.q[:-1], fine.v[:-1], fine.u @ scene.actuation)
    assert np.abs(drives).max() > 0.29 * 150.0
    for integrator in (None, vp.Midpoint(), vp.Gauss(2), vp.Gauss(4)):
        motion = moved_arm(scene, rows, integrator)
        assert np.abs(motion.q[-1] - fine.q[-1]).max() <= max(1e-3, 2.5 * motion.error.max())


@pytest.mark.parametrize("integrator", [None, vp.Midpoint(), vp.Gauss(2), vp.Gauss(4)], ids=str)
def test_smooth_commands_of_a_servo_of_100_hertz_take_whole_steps(load, integrator):
    scene = served_arm(load("ur5"), 100.0)
    swing = np.array([0.3, 0.15, -0.15, 0.1, 0.06, 0.3])
    commands = vp.OpenLoop(lambda t: START + swing * (1.0 - np.cos(2.0 * t)))
    options = {"dt": 5e-3, "steps": 200, "controls": commands, "integrator": integrator}
    work = vp.simulate(scene, START, np.zeros(6), **options).statistics
    assert (work.split_steps, work.substeps.max()) == (0, 1)


def test_a_step_may_need_hundreds_of_parts():
    robot = vp.load_robot("panda", lock={"panda_finger_joint1": 0.0})
    scene = vp.Scene(robot, forces=vp.CoulombFriction(3.0, 1e-4), damping=0.0)
    q0, v0 = np.linspace(-1.0, 1.0, robot.dof), np.zeros(robot.dof)
    motion = vp.simulate(scene, q0, v0, dt=0.02, steps=50, integrator=vp.Midpoint())
    assert motion.statistics.substeps.max() > 256
