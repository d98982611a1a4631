"""What is said of joint values: limits that are passed and degrees, each in the units of its joints."""

import numpy as np
import pinocchio as pin
import pytest
from findings import about
from refusals import naming, refused, unnamed

import varpin as vp
from varpin.cli import main
from varpin.control.checks import foreseen

HOME = np.array([0.0, -90.0, 90.0, 0.0, 45.0, 0.0])
FACTS = ("'shoulder_lift_joint'", "-90 rad", "14 turns", "looks like degrees", "np.deg2rad")
REST = np.zeros(6)
UR5 = vp.load_robot("ur5")
FLOATING = vp.Scene(UR5, gravity=False)
SHORT = {"dt": 1e-3, "steps": 2}
SLIDE, TURN, WHEEL = pin.JointModelPX(), pin.JointModelRY(), pin.JointModelRUBY()


def arm(*joints, lower=-9.0, upper=9.0):
    """Rods of 1 m on joints, with limits of 9 N m and 9 rad/s beside those of the positions."""
    model, place = pin.Model(), 0
    sides = np.array([9.0]), np.array([9.0]), np.array([lower]), np.array([upper])
    for k, kind in enumerate(joints):
        limits = () if kind == WHEEL else sides
        place = model.addJoint(place, kind, pin.SE3.Identity(), f"joint{k + 1}", *limits)
        rod = pin.Inertia(1.0, np.array([0.5, 0.0, 0.0]), np.diag([0.001, 0.083, 0.083]))
        model.appendBodyToJoint(place, rod, pin.SE3.Identity())
    return vp.load_robot(model)


def moved(scene, q0=REST, v0=REST, **options):
    return vp.simulate(scene, q0, v0, **SHORT | options).warnings


def planned(scene, q0, v0, *constraints):
    given = {"dt": 0.05, "steps": 2, "constraints": constraints}
    return foreseen(vp.OptimalControlProblem(scene, vp.ControlCost(1e-3), q0, v0, **given))


CRANE, CHAIN = arm(TURN, SLIDE), arm(TURN, TURN)


@pytest.mark.parametrize(
    ("constraint", "unit"),
    [
        (vp.WithinVelocityLimits(CHAIN, (-1.0, 1.0)), "rad/s"),
        (vp.WithinVelocityLimits(CRANE, (-1.0, 1.0)), "rad/s or m/s"),
        # Only joints with a limit count.
        (vp.WithinJointLimits(CRANE, (-np.inf, [np.inf, 1.0])), "m"),
        (vp.WithinJointLimits(CRANE, (-np.inf, 1.0)), "rad or m"),
    ],
)
def test_limits_are_in_the_units_of_their_joints(constraint, unit):
    (told,) = about(
        planned(vp.Scene(constraint.robot), [2.0, 2.0], [2.0, 2.0], constraint), "start outside constraints"
    )
    assert told.unit == unit
    assert not unnamed(told, unit)


@pytest.mark.parametrize(
    ("kind", "sides", "q", "v", "pull", "kinds"),
    [
        (WHEEL, (), 0.0, 50.0, 500.0, set()),
        (TURN, (0.0, 0.0), 0.0, 5.0, 0.0, set()),
        (TURN, (1.0, -1.0), 0.0, 5.0, 0.0, set()),
        (TURN, (-0.5, 1.0), 1.0 + 1e-9, 0.0, 0.0, set()),
        (TURN, (-0.5, 1.0), 0.0, 0.0, 9.0, set()),
        (TURN, (-0.5, 1.0), -0.45, -5.0, 0.0, {"position limits"}),
        (TURN, (-0.5, 1.0), 0.0, 10.0, 10.0, {"velocity limits", "effort limits"}),
        (TURN, (-0.5, 1.0), 1.1, 10.0, 10.0, {"position limits", "velocity limits", "effort limits"}),
    ],
    ids=["none", "zeros", "the wrong way round", "rounding", "a motor at its limit", "lower", "two", "three"],
)
def test_limits_that_are_passed_are_told_and_counted(kind, sides, q, v, pull, kinds):
    scene = vp.Scene(arm(kind, **dict(zip(("lower", "upper"), sides, strict=False))), gravity=False)
    motion = vp.simulate(scene, [q], [v], dt=1e-3, steps=20, controls=[pull])
    assert {told.kind for told in motion.warnings} == kinds
    count = {0: ")", 1: ", 1 warning)"}.get(len(kinds), f", {len(kinds)} warnings)")
    assert repr(motion).endswith(count)
    assert ("warning" in repr(motion)) == bool(kinds)


@pytest.mark.parametrize(("end", "words"), [(None, "nothing stops it"), (0.9, "nothing stops it"), (0.5, "gives way")])
def test_a_passed_limit_is_that_of_the_robot(end, words):
    """Also beside a stop, which gives way: the depth is counted from the description's limit."""
    forces = [] if end is None else vp.JointStop(20.0, 1.0, lower=-2.0, upper=end)
    scene = vp.Scene(arm(TURN, lower=-2.0, upper=0.5), gravity=False, forces=forces)
    motion = vp.simulate(scene, [0.0], [2.0], dt=1e-3, steps=1000)
    (told,) = about(motion.warnings, "position limits")
    depth = motion.q.max() - 0.5
    assert not unnamed(told, "0.5 rad", f"by up to {depth:.3g} (t = ", words)
    assert told.value == pytest.approx(depth, rel=1e-12)


def test_forces_beyond_effort_limits_are_told_of_by_what_reaches_the_joint():
    # One control pulls at both joints: a gear of 3 and one of -1/2.
    scene = vp.Scene(arm(SLIDE, TURN), gravity=False, actuation=[[3.0], [-0.5]])
    pull = np.linspace(0.0, 4.0, 50)[:, None]
    (told,) = moved(scene, np.zeros(2), np.zeros(2), steps=50, controls=pull)
    assert (told.kind, told.joint, told.unit) == ("effort limits", "joint1", "N")
    assert told.value == pytest.approx(3.0)
    assert told.time == pytest.approx(0.049)
    assert not unnamed(told, "'joint1'", "9 N", "by up to 3", "t = 0.049 s")


def test_the_effort_of_a_servo_is_its_drive_s_not_what_its_gains_ask_for():
    scene = vp.Scene(arm(TURN), gravity=False, forces=vp.PositionServo(100.0, effort=12.0))
    (told,) = about(moved(scene, [0.0], [0.0], controls=[5.0]), "effort limits")
    assert told.value == pytest.approx(3.0)


def test_plans_ensembles_and_controllers_tell_of_all_limits():
    scene = vp.Scene(arm(TURN), gravity=False)
    cost = vp.ControlCost(1e-6) + vp.Terminal(vp.TrackingCost([2.0], 1e3) + vp.VelocityCost(1.0))
    problem = vp.OptimalControlProblem(scene, cost, [0.0], [0.0], dt=1e-2, steps=20)
    plan, run = vp.solve(problem), vp.Mpc(problem).run(duration=0.05)
    ensemble = vp.simulate_ensemble(scene, [0.0], [20.0], dt=1e-3, steps=9, paths=2, rng=0, controls=[50.0])
    for told in (plan.warnings, run.warnings, ensemble.warnings):
        for kind in ("velocity limits", "effort limits"):
            assert about(told, kind), told


def test_a_start_in_degrees(capsys):
    assert not unnamed(moved(FLOATING, HOME)[0], FACTS)
    assert not naming(moved(FLOATING, np.deg2rad(HOME)), "degrees")
    ensemble = vp.simulate_ensemble(FLOATING, HOME, REST, **SHORT, paths=2, rng=0, workers=1)
    assert not unnamed(ensemble.warnings[0], FACTS)
    assert main(["simulate", "ur5", "--steps", "2", "--q0", *map(str, HOME)]) == 0
    assert not unnamed(" ".join(capsys.readouterr().err.split()), FACTS)


@pytest.mark.parametrize(
    ("speed", "told"), [(90.0, True), (-22.5, True), (22.51234, False), (3.1, False), (12.5, False)]
)
def test_a_speed_beyond_its_limit_in_degrees(speed, told):
    v0 = speed * np.eye(6)[1]
    found = naming(moved(FLOATING, v0=v0, dt=1e-4), "looks like degrees")
    assert [not unnamed(text, "v0", "'shoulder_lift_joint'", f"{speed:g} rad/s") for text in found] == [True] * told
    free = UR5.model.copy()
    free.velocityLimit = np.full(6, np.inf)
    assert not naming(moved(vp.Scene(vp.load_robot(free)), v0=v0, dt=1e-4), "looks like degrees")


def test_positions_for_servos_in_degrees():
    servos = vp.Scene(UR5, gravity=False, damping=1.0, forces=[vp.PositionServo(100.0, 10.0)])
    for controls in (HOME, lambda t, q, v: HOME):
        assert not unnamed(moved(servos, controls=controls)[0], ("controls", *FACTS))
    assert not naming(moved(FLOATING, controls=HOME), "degrees")
    assert not naming(moved(servos, controls=np.deg2rad(HOME)), "degrees")
    assert len(naming(moved(servos, HOME), "degrees")) == 1


@pytest.mark.parametrize(("q", "told"), [(90.0, 1), (-22.5, 1), (12.5, 0), (33.3333333, 0), (1e3 / 7.0, 0)])
def test_joints_without_limits_may_have_turned_many_times(q, told):
    """A wheel that has turned is no mistake; a number of one decimal is typed."""
    wheel, slide = (vp.Scene(arm(kind, lower=-np.inf, upper=np.inf), gravity=False) for kind in (WHEEL, SLIDE))
    assert len(naming(moved(wheel, [q], [0.0]), "degrees")) == told
    assert not naming(moved(slide, [q], [0.0]), "degrees")


def test_other_positions_in_degrees(caplog):
    vp.load_robot("ur5", lock={"elbow_joint": 90})
    vp.load_robot(arm(WHEEL, WHEEL).model, lock={"joint1": 57.2957795})
    vp.Scene(UR5, stiffness=1.0, rest=HOME)
    elbow, wheel, rest = caplog.messages
    assert not unnamed(elbow, ("elbow_joint", "90", "looks like degrees"))
    assert not unnamed(wheel, ("57.2958", "looks like degrees"))
    assert not unnamed(rest, ("rest", *FACTS))
    with refused(vp.InputError, "q0", *FACTS):
        moved(vp.Scene(UR5, constraints=[vp.PointOnPoint("tool0", [0.8, 0.1, 0.2])]), HOME)


def test_stops_in_degrees(caplog):
    robot = vp.load_robot("so100")
    vp.Scene(robot, forces=[vp.JointStop(1e3, 5.0), vp.JointStop(1e3, lower=-1.5, upper={"shoulder_lift": 1.5})])
    assert not caplog.records
    vp.Scene(robot, forces=[vp.JointStop(1e3, 5.0, lower=-90.0, upper=90.0)])
    assert [told.partition(" of the JointStop")[0] for told in caplog.messages] == ["lower", "upper"]
    assert naming(caplog.messages, "looks like degrees") == caplog.messages


def test_references_along_a_plan_are_looked_at_too():
    goal, cost = np.array([0.0, -90.0, 90.0, 0.0, 45.0, 0.0]), vp.ControlCost(1e-3)
    problem = vp.OptimalControlProblem(FLOATING, cost, REST, REST, dt=0.05, steps=4)
    for scale, told in ((1.0, True), (np.pi / 180.0, False)):
        for reference in (scale * goal, [scale * goal] * 5, lambda t, goal=scale * goal: goal):
            found = foreseen(problem.at(cost=cost + vp.TrackingCost(reference)))
            assert any(not unnamed(warning, FACTS) for warning in found) == told


# --- joint values by name, holding torques and gravity ---------------------------------------------------------------


NAMES = UR5.joint_names
SCENE = vp.Scene(UR5, damping=0.1)
POSE = {"elbow_joint": 1.1, "shoulder_lift_joint": 0.7}
ROW = np.array([0.0, 0.7, 1.1, 0.0, 0.0, 0.0])
STEPS = {"dt": 2e-3, "steps": 10}
# Margins of limits in which the motion is.
WIDE, WIDE_ROW = {"elbow_joint": 3.1, "shoulder_lift_joint": 6.2}, np.array([0.0, 6.2, 3.1, 0.0, 0.0, 0.0])


def motion(q=ROW, v=ROW, scene=SCENE, **options):
    return vp.simulate(scene, q, v, **STEPS, **options)


def problem(q=ROW, v=ROW, cost=None, scene=SCENE, **options):
    cost = vp.ControlCost(1.0) if cost is None else cost + vp.ControlCost(1.0)
    return vp.OptimalControlProblem(scene, cost, q, v, **STEPS, **options)


def value(cost):
    task = problem(cost=cost)
    return task.cost_of(task.simulate(np.linspace(0.0, 1.0, task.scene.controls)))


# What is computed of joint values: the same whether they are given by name or as a row.
SAME = {
    "start": lambda x: motion(x, x).p,
    "paths": lambda x: vp.simulate_ensemble(SCENE, x, x, paths=2, rng=0, workers=1, **STEPS).q[1],
    "torques": lambda x: motion(controls=x).u,
    "torques of paths": lambda x: vp.simulate_ensemble(SCENE, ROW, ROW, controls=x, paths=1, rng=0, **STEPS).u[0],
    "problem": lambda x: [problem(x, x).q0, problem(x, x).v0, problem().at(q0=x).q0],
    "jet": lambda x: [vp.lagrangian_jet(SCENE, x, x, backend=name).Lq for name in ("compiled", "pinocchio")],
    "report": lambda x: vp.inspect_robot(UR5, q=x).q,
    "discrete Lagrangian": lambda x: vp.discrete_lagrangian(SCENE, x, x, 0.01).D1,
    "noise": lambda x: motion(scene=vp.Scene(UR5, noise=vp.AdditiveNoise(x) + vp.StateNoise(x, 0.1)), rng=5).q,
    "noise's middle": lambda x: motion(scene=vp.Scene(UR5, noise=vp.StateNoise(1.0, x)), rng=5).q,
    "tracking": lambda x: value(vp.TrackingCost(x, x)),
    "speeds": lambda x: value(vp.VelocityCost(x, x)),
    "barrier": lambda x: value(vp.JointLimitBarrier(UR5, x, WIDE if x is POSE else WIDE_ROW)),
    "control cost": lambda x: value(vp.ControlCost(x, x)),
    "rate cost": lambda x: value(vp.ControlRateCost(x, x)),
}


@pytest.mark.parametrize("use", SAME)
def test_values_by_name_are_those_of_a_row(use):
    found = np.array(SAME[use](POSE))
    np.testing.assert_array_equal(found, SAME[use](ROW))
    assert np.abs(found - SAME[use](0.5 * ROW)).max() > 1e-6
    assert repr(vp.TrackingCost(0.0, POSE)) == f"TrackingCost(weight={POSE})"


@pytest.mark.parametrize(
    "call",
    [
        lambda value: vp.Scene(UR5, damping=value),
        lambda value: vp.Scene(UR5, noise=vp.AdditiveNoise(value)),
        lambda value: vp.JointLimitBarrier(UR5, value),
        motion,
        lambda value: vp.simulate_ensemble(SCENE, ROW, value, paths=1, rng=0, **STEPS),
        problem,
        lambda value: vp.lagrangian_jet(SCENE, value, ROW),
        SCENE.holding_torque,
        lambda value: vp.inspect_robot(UR5, q=value),
        lambda value: vp.advise(SCENE, value, ROW, duration=1.0, tolerance=1e-3),
    ],
)
def test_names_and_numbers_that_are_none_are_named(call):
    with refused(vp.UnknownJoint, "'elbow'", "'elbow_joint'") as caught:
        call({"elbow": 1.0})
    assert (caught.value.matches[0], caught.value.known) == ("elbow_joint", NAMES)
    for value, facts in ((np.nan, ("'elbow_joint'", "nan")), ("a", "'a'")):
        with refused(vp.InputError, facts):
            call({"elbow_joint": value})


def test_an_arm_stays_under_its_holding_torque_and_controls():
    gear = np.diag([100.0, 50.0, 60.0, 20.0, 20.0, 10.0])
    scene = vp.Scene(UR5, actuation=gear, stiffness={"elbow_joint": 3.0})
    controls = scene.holding_controls(POSE)
    np.testing.assert_allclose(gear @ controls, scene.holding_torque(POSE), atol=1e-12)
    held = vp.simulate(scene, POSE, {}, dt=1e-3, steps=50, controls=controls)
    np.testing.assert_allclose(held.q, np.tile(ROW, (51, 1)), atol=1e-9)


def test_controls_that_cannot_hold_are_refused():
    scene = vp.Scene(vp.planar_chain(2), actuation=["joint2"])
    with refused(vp.InputError, "'joint1'"):
        scene.holding_controls([1.0, 0.3])
    # Upright nothing pulls but rounding.
    np.testing.assert_allclose(scene.holding_controls([0.5 * np.pi, 0.0]), 0.0, atol=1e-12)


def test_torques_of_some_joints_in_another_order_take_names():
    driven = ("wrist_1_joint", "elbow_joint", "wrist_3_joint")
    scene = vp.Scene(UR5, actuation=list(driven))
    assert (scene.control_joints, vp.Scene(UR5).control_joints) == (driven, NAMES)
    named = motion(scene=scene, controls={"elbow_joint": 3.0, "wrist_1_joint": -1.0})
    assert named.u[4].tolist() == [-1.0, 3.0, 0.0]
    limits = ({"elbow_joint": -2.0}, {"elbow_joint": 2.5, "wrist_1_joint": np.inf})
    task = problem(scene=scene, control_limits=limits)
    assert task.control_limits.tolist() == [[-np.inf, -2.0, -np.inf], [np.inf, 2.5, np.inf]]
    start = vp.solve(task, {"elbow_joint": 3.0}, max_iterations=0, check=False)
    assert start.controls[3].tolist() == [0.0, 2.5, 0.0]


USES = [
    lambda scene, value: motion(scene=scene, controls=value),
    lambda scene, value: problem(cost=vp.ControlCost(value), scene=scene),
    lambda scene, value: problem(cost=vp.ControlRateCost(value), scene=scene),
    lambda scene, value: problem(scene=scene, control_limits=(-np.inf, value)),
]


@pytest.mark.parametrize("use", USES)
def test_names_of_controls_that_have_none_are_refused(use):
    shared = np.eye(6)
    shared[1, 2] = 0.5
    for actuation in (shared, 2.0 * np.eye(6), np.ones((6, 1))):
        scene = vp.Scene(UR5, actuation=actuation)
        assert scene.control_joints is None
        with refused(vp.InputError, "joint name"):
            use(scene, {"elbow_joint": 1.0})
    with refused(vp.UnknownJoint, "'elbow_joint'"):
        use(vp.Scene(UR5, actuation=["wrist_1_joint"]), {"elbow_joint": 1.0})
    with refused(vp.InputError, "'elbow_joint'", "'a'"):
        use(vp.Scene(UR5), {"elbow_joint": "a"})


def test_a_posture_by_its_name_is_told_how_to_be_given():
    """The command line takes names of postures; from Python they are positions of the robot's."""
    scene = vp.Scene(vp.planar_chain(2))
    for call in (
        lambda: vp.simulate(scene, "home", [0, 0], dt=0.01, steps=2),
        lambda: vp.OptimalControlProblem(scene, vp.ControlCost(1.0), "home", [0, 0], dt=0.1, steps=2),
        lambda: scene.holding_torque("home"),
    ):
        with refused(vp.InputError, "(2,)", "robot.posture('home')"):
            call()
