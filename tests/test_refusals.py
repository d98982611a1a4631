"""What is refused, by the names of arguments: of robots, scenes, motions, problems, costs, searches, controllers."""

import numpy as np
import pytest
from plan_problems import CAPSULES, REST, SMALL, TWO, linear, reach, small, wave
from refusals import refused, unnamed
from zoo import ZOO

import varpin as vp
from varpin import wiener

BEFORE = np.array([0.7, -0.3])
BALL = vp.Obstacle.sphere([1.0, 0.0, 0.0], 0.1, name="ball")
MOVING = BALL.moving(lambda t: [0.0, 0.0])


class Wrapped(vp.Cost):
    def bind(self, points):
        return vp.ControlRateCost(1.0).bind(points)


def policy(**options):
    return vp.LinearPolicy(np.zeros((3, 2)), np.zeros((3, 2, 4)), np.zeros((3, 4)), **options)


def rated(weight=1.0, before=None):
    return linear(vp.ControlRateCost(weight, before))


def clear(**given):
    return vp.KeepClear(TWO, **{"obstacles": [BALL], "capsules": CAPSULES, **given})


def mpc():
    return vp.Mpc(wave())


def plan():
    return vp.solve(reach(), max_iterations=1, check=False)


OF_PROBLEMS = [
    (lambda: small(dt=0.0), "dt"),
    (lambda: small(steps=0), ("steps", "1")),
    (lambda: small(hold=3), ("steps = 20", "hold = 3")),
    (lambda: small(hold=0), ("hold", "1")),
    (lambda: small(sampling="end"), "sampling"),
    (lambda: small(integrator="rk4"), "integrator"),
    (lambda: small(actuation=[]), "controls"),
    (lambda: small("cheap"), "cost"),
    (lambda: small().at(q0=[0.0]), "q0"),
    (lambda: small().at(v0=[0.0, np.inf]), "v0"),
    (lambda: small().cost_of(vp.simulate(small().scene, REST, REST, dt=0.05, steps=3)), "3 steps"),
    (lambda: small().cost_of(np.zeros((21, 2))), ("motion", "varpin.Trajectory")),
    (lambda: small().cost_of(vp.solve(wave(), max_iterations=0).trajectory), "joints"),
    (lambda: small(actuation=[[1.0], [0.0]]).cost_of(small().simulate([0, 0])), ("1", "2", "controls")),
    (lambda: small(controls="cubic"), ("controls", "'held'", "'linear'")),
    (lambda: small(controls="linear", hold=2), "hold"),
    # The optimum of a midpoint sum alternates freely: its controls cost nothing in the middle of a step.
    (lambda: small(controls="linear", sampling="midpoint"), ("'midpoint'", "linear")),
    (lambda: small(controls="linear", sampling="start"), ("'start'", "linear")),
    (lambda: reach(control_limits=(1.0, -1.0)), ("control_limits", "1", "-1", "0")),
    (lambda: reach(control_limits=(-1.0, np.nan)), ("control_limits", "upper[0]", "NaN")),
    (lambda: reach(control_limits=([-1.0] * 3, 1.0)), ("control_limits", "lower", "(2,)", "(3,)")),
    (lambda: reach(control_limits=3.0), ("control_limits", "pair")),
    (lambda: reach(control_limits=(np.inf, np.inf)), ("control_limits", "inf")),
    (lambda: vp.ControlRateCost(-1.0), ("ControlRateCost", "weight", "positive semidefinite")),
    (lambda: vp.Terminal(vp.ControlRateCost()), ("ControlRateCost", "terminal")),
    (lambda: linear(Wrapped()), "cost"),
    (lambda: rated([1.0, 1.0, 1.0]), ("2", "(3,)")),
    (lambda: rated(before=np.nan), ("ControlRateCost", "before", "nan")),
    (lambda: rated(before=np.zeros((2, 2))), ("before", "(2, 2)")),
    (lambda: rated(before=np.zeros(3)), ("before", "(2,)", "(3,)")),
    (lambda: rated().at(before=np.zeros(3)), ("before", "(2,)", "(3,)")),
    (lambda: linear(vp.ControlRateCost() + vp.ControlRateCost(1.0, BEFORE)), ("ControlRateCost", "before")),
    (lambda: linear().at(before=BEFORE), ("before", "ControlRateCost", "WithinControlRate")),
]
OF_COSTS = [
    (lambda: vp.TrackingCost(0.0, np.nan), ("TrackingCost", "weight", "nan")),
    (lambda: vp.TrackingCost(0.0, [1.0, np.inf]), ("weight[1]", "inf")),
    (lambda: vp.TrackingCost(0.0, [[1.0, 2.0], [2.0, 1.0]]), ("positive semidefinite", "-1")),
    (lambda: vp.ControlCost(np.ones((2, 3))), ("weight", "(2, 3)")),
    (lambda: vp.ControlCost("heavy"), ("ControlCost", "weight", "'heavy'")),
    (lambda: vp.TrackingCost("home"), ("TrackingCost", "reference", "'home'")),
    (lambda: vp.Terminal(vp.TrackingCost(0.0) + 2.0 * vp.ControlCost()), ("ControlCost", "terminal")),
    (lambda: vp.Terminal(vp.Terminal(vp.TrackingCost(0.0))), "Terminal"),
    (lambda: vp.Terminal(1.0), ("Terminal", "float")),
    (lambda: -1.0 * vp.TrackingCost(0.0), "-1"),
    (lambda: vp.CustomCost(3), ("CustomCost", "function", "3")),
    (lambda: vp.CustomCost(print, 3.0, name="mine"), ("mine", "derivatives")),
    (lambda: small(vp.ControlCost(1.0, np.zeros((19, 2)))), ("(20, 2)", "(19, 2)")),
    (lambda: small(vp.ControlCost([1.0, 1.0, 1.0])), ("weight", "2", "(3,)")),
    (lambda: small(vp.TrackingCost(np.zeros((20, 2)))), ("(21, 2)", "(20, 2)")),
    (lambda: small(vp.TrackingCost([0.0, 0.0, 0.0])), ("(2,)", "(21, 2)", "(3,)")),
    (lambda: vp.TrackingCost([0.0, np.nan]), ("TrackingCost", "reference[1]", "nan")),
    (lambda: vp.FrameOrientationCost(TWO, "tip", 2.0 * np.eye(3)), "rotation"),
    (lambda: vp.FrameOrientationCost(TWO, "tip", np.diag([1.0, 1.0, -1.0])), "rotation"),
    (lambda: vp.FrameOrientationCost(TWO, "tip", np.full((3, 3), np.nan)), "finite"),
    (lambda: vp.FrameOrientationCost(TWO, "tip", [np.eye(3), 2 * np.eye(3), np.eye(3)]), ("1", "rotation")),
]
OF_CONSTRAINTS = [
    (lambda: reach(vp.JointTie("joint1", "joint2")), "varpin.Scene"),
    (lambda: reach(vp.WithinJointLimits(vp.planar_chain(3), (-1, 1))), "robot"),
    (lambda: vp.WithinVelocityLimits(TWO), "limits"),
    (lambda: vp.ReachFrame(TWO, "tip"), ("position", "rotation")),
    (lambda: vp.ReachFrame(TWO, "tip", rotation=2.0 * np.eye(3)), "rotation matrix"),
    (lambda: vp.WithinControlRate(0.0), ("limit", "0")),
    (lambda: vp.WithinJointLimits(TWO, (-1, 1), margin=-1.0), ("margin", "0")),
    (lambda: reach(vp.WithinControlRate(1.0, before=np.nan)), ("before", "nan")),
    (lambda: reach(between_nodes="yes"), "between_nodes"),
    (lambda: clear(obstacles=None), "obstacles"),
    (lambda: clear(itself="no"), "itself"),
    (lambda: clear(links=["joint1", "joint1"]), "twice"),
    (lambda: clear(capsules={"joint1": 0.05}), "begin"),
    (lambda: clear(capsules=[0.05]), "capsules"),
    (lambda: BALL.moving([0.0, 0.0, 1.0]), "function"),
    (lambda: MOVING.moving(lambda t: [0.0, 0.0, 0.0]), "moves already"),
    (lambda: reach(clear(obstacles=[MOVING])), ("'ball'", "0.06")),
    (lambda: reach(vp.KeepOutOfSphere(TWO, "tip", lambda t: [np.nan, 0.0, 0.0], 0.1)), ("center", "finite")),
]
OF_SEARCHES = [
    (lambda: vp.solve("finger"), ("OptimalControlProblem", "str")),
    (lambda: vp.solve(small(), tolerance=0.0), "tolerance"),
    (lambda: vp.solve(small(), tolerance=np.nan), "tolerance"),
    (lambda: vp.solve(small(), regularization=-1.0), "regularization"),
    (lambda: vp.solve(small(), max_iterations=1.5), "max_iterations"),
    (lambda: vp.solve(small(), max_iterations=-1), ("max_iterations", "0")),
    (lambda: vp.solve(small(), time_limit=0.0), "time_limit"),
    (lambda: vp.solve(small(), true_cost=0.0), "true_cost"),
    (lambda: vp.solve(reach(), true_cost=0.1, resume=SMALL["held"].plan), ("resume", "true_cost")),
    (lambda: vp.solve(small(integrator=vp.ExplicitEuler()), second_order=True), "ExplicitEuler"),
    (lambda: vp.solve(small(hold=2), np.zeros((20, 2))), ("controls", "(10, 2)", "(20, 2)")),
    (lambda: vp.solve(small(), [np.nan, 0.0]), "controls"),
    (lambda: vp.solve(small(hold=2), vp.solve(small())), ("controls", "1", "2")),
    (lambda: vp.solve(small(steps=40), vp.solve(small())), ("20", "40")),
    (lambda: vp.solve(reach(), SMALL["linear"].plan), "linear"),
    *((lambda x=x: SMALL["held"].plan.shifted(x), "decisions") for x in (-1, 12, 1.5)),
    *((lambda x=x: plan().verify(tolerance=x), "tolerance") for x in (0.0, -1.0, np.nan, "tight")),
    *((lambda x=x: plan().monte_carlo(x, 0), "paths") for x in (1, 0, 2.5)),
    (lambda: vp.solve(reach(), SMALL["held"].plan, resume=SMALL["held"].plan), "resume"),
    (lambda: vp.solve(reach(), resume=SMALL["held"].plan.trajectory), "Solution"),
]
OF_CONTROLLERS = [
    (lambda: policy(previous_gains=np.eye(2)), ("previous_gains", "(3, 2, 2)", "(2, 2)")),
    (lambda: policy(previous=np.zeros((3, 2))), ("previous", "previous_gains")),
    (lambda: policy(before=[0.0]), ("before", "(2,)", "(1,)")),
    (lambda: policy(linear=True), "before"),
    (lambda: policy().control(3, np.zeros(4)), ("interval", "0", "2", "3")),
    (lambda: vp.FirstOrderHold(np.zeros(3)), ("node", "(3,)")),
    (lambda: vp.FirstOrderHold([[0.0], [np.nan]]), "finite"),
    (lambda: small().simulate(vp.FirstOrderHold(np.zeros((3, 2)))), ("FirstOrderHold", "u", "(21, 2)", "(3, 2)")),
    (lambda: vp.Mpc("x"), ("problem", "OptimalControlProblem", "str")),
    (lambda: vp.Mpc(wave(), iterations=0), "iterations"),
    (lambda: vp.Mpc(wave(), budget=-1.0), "budget"),
    (lambda: mpc().run(vp.Plant(vp.Scene(TWO)), duration=1.0), "joints"),
    (lambda: mpc().run(duration=0.16).planned(-0.1), ("ahead", "0")),
    (lambda: mpc().run(duration=0.16).planned(np.nan), ("ahead", "0")),
    (lambda: mpc().run(duration=0.0), "duration"),
    (lambda: mpc().run(wave().scene, duration=0.1), ("plant", "varpin.Plant")),
    (lambda: mpc().run(duration=0.1, rng="a"), "rng"),
    (lambda: mpc().plan(0.0, [0.0], np.zeros(3)), "q0"),
    (lambda: mpc().plan(0.05, np.zeros(3), np.zeros(3), 3), ("previous", "int")),
    (lambda: mpc().plan(0.05, np.zeros(3), np.zeros(3), None, -1), ("decisions", "-1")),
    (lambda: vp.Plant(wave().scene, "rk"), "integrator"),
]
OF_TIMES = [
    (lambda: small(dt=None, steps=None), "two of dt"),
    (lambda: small(duration=1.0), "two of dt"),
    (lambda: small(steps=None, duration=0.615), "0.615"),
    *((lambda x=x: small(steps=None, duration=x), "duration") for x in (-1.0, np.nan, "1 s")),
]


def ur5(**options):
    return lambda: vp.load_robot("ur5", **options)


def loaded(**options):
    return lambda: vp.load_robot("ur5", payload=vp.Payload(**{"frame": "tool0", "mass": 1.0} | options))


def together(*robots, **options):
    return lambda: vp.combine(TWO, *robots, **options)


OF_ROBOTS = [
    (ur5(keep="elbow_joint"), "keep"),
    (ur5(keep={"elbow_joint": 0.0}), "keep"),
    (ur5(keep=["elbow_joint"], lock={"elbow_joint": 0.1}), ("'elbow_joint'", "keep", "lock")),
    (lambda: vp.load_robot("panda", keep=["panda_finger_joint2"]), ("panda_finger_joint2", "panda_finger_joint1")),
    (
        lambda: vp.load_robot("panda", lock={"panda_finger_joint2": 0.0}),
        ("'panda_finger_joint2'", "'panda_finger_joint1'"),
    ),
    (ur5(base="round"), ("base", "'planar'", "'round'")),
    (ur5(base=np.eye(3)), ("base", "(3, 3)")),
    (ur5(base=2.0 * np.eye(4)), ("base", "rotation")),
    (ur5(base=np.diag([1.0, 1.0, -1.0, 1.0])), ("base", "rotation")),
    (ur5(inertia="mesh"), ("inertia", "'file'", "'meshes'")),
    (lambda: vp.load_robot(TWO.model, inertia="meshes"), "inertia"),
    (ur5(inertia="meshes", density=0.0), "density"),
    (loaded(frame="world"), ("'ur5'", "'world'")),
    (loaded(mass=0.0), ("payload mass", "0.0")),
    (loaded(center=[0.0, 1.0]), ("payload center", "(3,)", "(2,)")),
    (loaded(inertia=[1.0, 1.0, 3.0]), ("payload inertia", "1, 1, 3")),
    (loaded(inertia=2.0), ("payload inertia", "(3, 3)", "2")),
    (loaded(inertia=[[1.0, 0.5, 0], [0, 1.0, 0], [0, 0, 1.0]]), ("payload inertia", "symmetric")),
    (together(), "robots"),
    (together("ur5"), "robots"),
    (together(TWO, placements=[None]), ("placements", "2")),
    (together(TWO, placements=[None, "planar"]), "base="),
    (together(TWO, placements=[None, [2.0, 0.0, 0.0]]), ("placements", "'chain2'")),
    (together(TWO, placements=[None, 2.0 * np.eye(4)]), "rotation"),
    (together(TWO, prefixes="ab"), "prefixes"),
    (together(TWO, prefixes=["", ""]), "'joint1'"),
]
# Three coordinates, two controls: one joint is not actuated, and a control moves two joints.
ACTUATION = np.array([[1.0, 0.0], [0.0, 0.0], [0.5, 2.0]])


def noisy(noise):
    return lambda: vp.Scene(vp.planar_chain(3), actuation=ACTUATION, noise=noise)


def field(q, v, u):
    return np.eye(3)


OF_NOISE = [
    (noisy(vp.AdditiveNoise([1.0, 2.0])), ("AdditiveNoise intensity", "(3,)", "(2,)")),
    (noisy(vp.AdditiveNoise(np.ones((2, 4)))), ("AdditiveNoise intensity", "(3, 4)", "(2, 4)")),
    (noisy(vp.ControlNoise(np.ones((3, 4, 3)))), ("ControlNoise intensity", "(3, 4, 2)")),
    (noisy(vp.ControlNoise(np.full((3, 1, 2), np.nan))), ("ControlNoise intensity[0, 0, 0]", "nan")),
    (noisy(3.0), ("noise", "3.0")),
    (noisy([vp.AdditiveNoise(1.0), 0.5]), ("noise", "0.5")),
    (noisy(vp.CustomNoise(field, 3.0)), ("CustomNoise processes", "3.0")),
    (noisy(vp.CustomNoise(None, 3)), ("CustomNoise field", "None")),
    (noisy(vp.CustomNoise(field, 3, dv=0.0)), "CustomNoise dv"),
    (lambda: vp.simulate(NOISY, REST, REST, dt=1e-3, steps=9, increments=1.0), ("increments", "(9, 2)")),
    (lambda: wiener.coarsen(np.zeros((9, 1)), 2), ("number", "9", "2")),
    (lambda: wiener.coarsen(np.zeros(8)), ("increments", "(8,)")),
    (lambda: wiener.wiener_increments(2, 0.1, 3, increments=np.zeros((3, 1))), ("(3, 2)", "(3, 1)")),
    (lambda: wiener.wiener_increments(1, 0.1, 1, 0, np.zeros((1, 1))), ("rng", "increments")),
]
SCENE, NOISY = vp.Scene(TWO), vp.Scene(TWO, noise=vp.AdditiveNoise(0.1))
MOTION = vp.simulate(SCENE, REST, REST, dt=1e-3, steps=2)
OTHER_Z = np.array([[0.0] * 4, [0.0, 0.0, np.nan, 0.0]])


def moved(**controls):
    return lambda: vp.simulate(SCENE, REST, REST, dt=1e-3, steps=5, **controls)


def looped(name="four-bar", **options):
    case = ZOO[name]
    return lambda: vp.simulate(case.scene, case.q0, case.v0, dt=1e-2, steps=2, **options)


LOOP = ZOO["four-bar"]
FREE_ALONE = vp.Radau(2), vp.Midpoint(0.4), vp.RungeKutta4(), vp.SemiImplicitEuler(), vp.ExplicitEuler(), vp.Reference()
OF_MOTIONS = [
    *((looped(integrator=own), (type(own).__name__, "constraints", "Gauss")) for own in FREE_ALONE),
    (looped("trembling loop", rng=0, integrator=vp.Midpoint(kick="split")), ("kick", "'split'", "constraints")),
    (lambda: vp.discrete_lagrangian(LOOP.scene, LOOP.q0, LOOP.q0, 1e-2), "constraints"),
    *(
        (lambda kind=kind, own=own: kind(**own), facts)
        for kind in (vp.Gauss, vp.Radau)
        for own, facts in (
            ({"stages": 0}, ("stages", "1", "0")),
            ({"stages": 7}, ("stages", "6", "7")),
            ({"stages": 2.5}, ("stages", "2.5")),
            ({"stages": "two"}, ("stages", "'two'")),
            ({"guard": 3}, ("guard", "varpin.Guard", "None", "3")),
        )
    ),
    (lambda: vp.Guard(max_halvings=31), ("max_halvings", "30", "31")),
    (lambda: vp.Radau(kick="right"), ("kick", "'left'", "'split'", "'right'")),
    (lambda: vp.CustomForce(np.zeros(3)), "function"),
    (lambda: vp.CustomForce(lambda q, v: v, "exact"), "'exact'"),
    (lambda: vp.Scene(TWO, gravity=-9.81), ("gravity", "(0, 0, -9.81)")),
    (lambda: vp.second_order(SCENE, MOTION, np.zeros((3, 4))), ("z", "(2, 4)", "(3, 4)")),
    (lambda: vp.second_order(SCENE, MOTION, OTHER_Z), ("z[1, 2]", "nan")),
    *(
        (lambda call=call, x=x: call(SCENE, x), ("motion", "varpin.Trajectory"))
        for x in (None, np.zeros((3, 1)))
        for call in (vp.linearize, lambda scene, motion: vp.second_order(scene, motion, np.zeros(4)))
    ),
    (lambda: vp.simulate(NOISY, REST, REST, duration=1.0, tolerance=1e-3), "noise"),
    (lambda: vp.simulate(NOISY, REST, REST, dt=1e-3, steps=1, rng=0, integrator=vp.Reference()), "noise"),
    (lambda: vp.OpenLoop(lambda t, q, v: [0.0, 0.0]), ("(t, q, v)", "controls=law")),
    (lambda: vp.OpenLoop(lambda: [0.0, 0.0]), ("OpenLoop", "time")),
    (lambda: vp.OpenLoop([0.0, 0.0]), ("OpenLoop", "[0.0, 0.0]")),
    (moved(controls=[0.1, 0.2], period=2), "period = 2"),
    (moved(controls=vp.OpenLoop(lambda t: [0.1, 0.2]), period=2), "period = 2"),
    *(
        (lambda call=call, x=x: call(x), "path")
        for x in (3, None, "a\0b", b"a")
        for call in (MOTION.save, vp.Trajectory.load)
    ),
]
# Names that a robot has not, with the nearest one that it has.
UR5, PANDA = vp.load_robot("ur5"), vp.load_robot("panda")
OF_NAMES = [
    (ur5(lock={"elbow_joit": 0.0}), ("'ur5'", "'elbow_joit'", "'elbow_joint'")),
    (ur5(lock={3: 0.0}), ("'3'", "'wrist_3_joint'")),
    (ur5(keep=["elbow"]), ("keep", "'elbow'", "'elbow_joint'")),
    *(
        (lambda x=x: vp.Scene(TWO, actuation=x), ("'chain2'", "'jont2'", "'joint2'"))
        for x in ("jont2", ["joint1", "jont2"])
    ),
    (lambda: vp.KeepInBox(TWO, "hand", 0, 1), ("'chain2'", "'hand'")),
    (lambda: PANDA.frame_positions(np.zeros(8), "hand"), ("'panda'", "'hand'", "'panda_hand'")),
    (lambda: vp.FramePositionCost(UR5, "tool", [0, 0, 0]), ("'ur5'", "'tool'", "'tool0'")),
    (lambda: vp.FramePositionCost(UR5, [0, 0, 0], "tip"), ("'ur5'", "'[0, 0, 0]'")),
]
TABLES = [OF_PROBLEMS, OF_COSTS, OF_CONSTRAINTS, OF_SEARCHES, OF_CONTROLLERS, OF_TIMES, OF_ROBOTS, OF_NOISE, OF_MOTIONS]


@pytest.mark.parametrize(("make", "facts"), [row for table in TABLES for row in table])
def test_it_is_refused(make, facts):
    with refused(vp.InputError, facts):
        make()


@pytest.mark.parametrize(("make", "facts"), OF_NAMES)
def test_names_that_are_not_there(make, facts):
    with pytest.raises((vp.UnknownJoint, vp.UnknownFrame)) as info:
        make()
    assert not unnamed(str(info.value), facts)
    assert {f"'{name}'" for name in info.value.matches[:1]} <= {*facts}
