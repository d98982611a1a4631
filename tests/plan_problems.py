"""Named problems of plans, each with the least cost that is known: what any search has to reach.

    case = plan_problems.CASES["held, speeds"]
    plan = vp.solve(case.problem, **case.options)

``SMALL`` are of two or three joints and a dozen decisions, for oracles that take many motions; ``ARMS`` are of robots,
and ``HARD`` leave hardly any room.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin
from mechanisms import random_axis, random_inertia
from oracles import placements

import varpin as vp


@dataclass(frozen=True, eq=False)
class Case:
    """A problem, and what holds of its plan.

    Attributes:
        build: Makes the problem.
        cost: The least cost known, noise included.
        options: Of :func:`varpin.solve`.
        kkt: What may be left of the Lagrangian's gradient (:func:`oracles.kkt`); None where that is not looked at.
        scipy: Whether SciPy's SLSQP is to find the same least cost from the first controls.
        within: The largest violation within steps: a thousandth of the range, with ``between_nodes`` a tenth of that.
    """

    build: Callable[[], vp.OptimalControlProblem]
    cost: float
    options: dict[str, object] = field(default_factory=dict)
    kkt: float | None = 1e-5
    scipy: bool = False
    within: float | None = None

    @functools.cached_property
    def problem(self):
        return self.build()

    @functools.cached_property
    def plan(self):
        return vp.solve(self.problem, check=False, **self.options)


TWO, THREE = vp.planar_chain(2), vp.planar_chain(3)
CAPSULES = {f"joint{k}": ([0, 0, 0], [1, 0, 0], 0.05) for k in (1, 2)}
REST = np.zeros(2)


def reach(*constraints, more=None, scene=None, **options):
    """Two links that are to swing up a little, in 0.72 s and 12 steps."""
    cost = vp.ControlCost(1e-2) + vp.VelocityCost(1e-2)
    cost += vp.Terminal(vp.TrackingCost([1.0, 0.5], 100.0) + vp.VelocityCost(10.0))
    given = {"dt": 0.06, "steps": 12, "constraints": constraints, **options}
    return vp.OptimalControlProblem(
        scene or vp.Scene(TWO, damping=0.1), cost if more is None else cost + more, REST, REST, **given
    )


def tip(z=-0.9):
    return vp.ReachFrame(TWO, "tip", position=[1.2, 0.0, z])


def speeds(most):
    return vp.WithinVelocityLimits(TWO, (-most, most))


def noisy(noise):
    return vp.Scene(TWO, damping=0.5, noise=noise)


def tracking(t):
    return 0.3 * np.sin(4.0 * np.asarray(t)[..., None] + np.arange(3))


def wave(*constraints, scene=None, **options):
    """Three links that follow a wave."""
    cost, given = vp.TrackingCost(tracking, 50.0) + vp.ControlCost(1e-3), {"dt": 0.08, "steps": 10, **options}
    scene = scene or vp.Scene(THREE, damping=0.2)
    return vp.OptimalControlProblem(scene, cost, tracking(0.0), np.zeros(3), constraints=constraints, **given)


def swing(*constraints, scene=None, **options):
    """Two links that are to follow a wave faster than their limits allow."""
    cost = vp.TrackingCost(lambda t: [0.5 * np.sin(3.0 * t), 0.3 * np.sin(4.0 * t)], 100.0)
    cost += vp.ControlCost(1e-4) + vp.VelocityCost(1e-2)
    given = {"dt": 0.03, "steps": 15, "constraints": constraints, **options}
    return vp.OptimalControlProblem(scene or vp.Scene(TWO, damping=0.3), cost, REST, REST, **given)


def sliders(count):
    """A chain of oblique prismatic joints: its mass matrix is constant, and full."""
    rng, model = np.random.default_rng(0), pin.Model()
    for k in range(count):
        joint = pin.JointModelPrismaticUnaligned(random_axis(rng))
        new = model.addJoint(k, joint, pin.SE3.Identity(), f"joint{k}")
        model.appendBodyToJoint(new, random_inertia(rng), pin.SE3.Identity())
    return vp.load_robot(model)


def small(cost=None, *, actuation=None, **options):
    """Two sliders to (1, 0) in a second."""
    goal = vp.TrackingCost([1.0, 0.0])
    cost = goal + vp.ControlCost(0.1) + vp.Terminal(goal) if cost is None else cost
    scene, given = vp.Scene(sliders(2), gravity=False, actuation=actuation), {"dt": 0.05, "steps": 20, **options}
    return vp.OptimalControlProblem(scene, cost, [0.3, 0.1], [0, 0], **given)


def linear(more=None, *, noise=None, q0=(0.3, -0.4), **options):
    """Two sliders with springs, which follow a wave and end at rest: a linear system under squares."""
    given = {"damping": [0.3, 0.1], "stiffness": [1.0, 0.0], "rest": [0.1, -0.2], "noise": noise}
    scene = vp.Scene(sliders(2), gravity=False, actuation=((1.0, 0.4), (-0.2, 1.3)), **given)
    cost = vp.TrackingCost(lambda t: [np.sin(3 * t), 0.2], [[2.0, 0.3], [0.3, 1.0]])
    cost += vp.ControlCost([0.05, 0.02], reference=[0.3, -0.1])
    cost += vp.Terminal(vp.TrackingCost([1.0, 0.5], 3.0) + vp.VelocityCost(0.7))
    return vp.OptimalControlProblem(
        scene, cost if more is None else cost + more, q0, [0.5, 0.1], **{"dt": 0.05, "steps": 24, **options}
    )


def hand(interpolation, **options):
    """A joint moved by hand, and motors on the next ones, all linear between nodes."""
    cubic = [1e-2] if interpolation == "cubic" else []
    moved = vp.KinematicInput("joint1", interpolation)
    robot = vp.planar_chain(3, length=0.5)
    scene = vp.Scene(
        robot, gravity=False, damping=0.2, actuation=robot.joint_names, constraints=moved,
        noise=options.pop("noise", None),
    )  # fmt: skip
    cost = vp.ControlRateCost([0.3, 0.0, 0.0, *cubic]) + vp.ControlCost([0.1, 1e-2, 2e-2, *cubic])
    cost += vp.Terminal(vp.TrackingCost([0.4, -0.6, 0.2], 50.0) + vp.VelocityCost([0.0, 5.0, 5.0]))
    given = {"dt": 0.08, "steps": 6, "integrator": vp.Gauss(2), "controls": "linear"} | options
    return vp.OptimalControlProblem(scene, cost, [0.1, 0.2, 0.3], np.zeros(3), **given)


def served():
    """Servos whose drives are too weak for the first moments of a reach."""
    scene = vp.Scene(TWO, forces=[vp.PositionServo(200.0, 20.0, [30.0, 12.0])])
    cost = vp.ControlCost(1e-1, reference=[0.6, 0.3]) + vp.Terminal(
        vp.TrackingCost([0.6, 0.3], 1e2) + vp.VelocityCost(1.0)
    )
    return vp.OptimalControlProblem(scene, cost, REST, REST, dt=0.06, steps=12, constraints=[speeds(1.6)])


def loop():
    """A closed loop of three links, driven by its crank within speeds."""
    tied = vp.PointOnPoint("tip", (1.8, 0.0, -0.5), "xz")
    scene = vp.Scene(THREE, damping=0.1, constraints=tied, actuation=["joint1"])
    begin = vp.assemble(scene, [-0.9, 1.6, 0.9])
    cost = vp.ControlCost(1e-2) + vp.Terminal(vp.TrackingCost(begin + np.array([0.6, 0.0, 0.0]), [50.0, 0.0, 0.0]))
    cost += vp.Terminal(vp.VelocityCost(1.0))
    within = vp.WithinVelocityLimits(THREE, ([-1.2, -9.0, -9.0], [1.2, 9.0, 9.0]))
    return vp.OptimalControlProblem(scene, cost, begin, np.zeros(3), dt=0.06, steps=12, constraints=[within])


def row(cost, *constraints, solving=None, **options):
    """A case of ``reach``, whose gradient of the Lagrangian is looked at but where constraints hold within steps."""
    own = {name: options.pop(name) for name in ("kkt", "scipy", "within") if name in options}
    given = {"kkt": None} if "within" in own else {}
    return Case(lambda: reach(*constraints, **options), cost, solving or {}, **given | own)


HAND_SPEEDS = vp.WithinVelocityLimits(vp.planar_chain(3, length=0.5), (-1.7, 1.7))
LIMITS = {"control_limits": ([-20.0, -6.0], [20.0, 6.0])}
FINER, LINES = {"dt": 0.03, "steps": 24}, {"controls": "linear"}
BETWEEN = {"between_nodes": True, "dt": 0.09, "steps": 8}
LINE = np.linspace(0.0, 1.0, 13)[:, None] * np.array([1.0, 0.5])
JOINTS, GOAL = vp.WithinJointLimits(TWO, (-0.05, [0.9, 2.0])), tip()
SPHERE = vp.KeepOutOfSphere(TWO, "tip", [1.3, 0.0, -1.3], 0.3)
CLEAR = vp.KeepClear(TWO, [vp.Obstacle.sphere([1.5, 0.0, -1.25], 0.15)], 0.05, capsules=CAPSULES)
WAY = vp.Obstacle.sphere([0.0, 0.0, -0.95], 0.15).moving(lambda t: [0.5 * t - 2.49, 0.0, 0.0])
MOVING = vp.KeepClear(TWO, [WAY], 0.05, capsules=CAPSULES)
CHANGES = vp.ControlRateCost(1e-4, before=[14.0, 4.0])
SECOND = {"second_order": True}
ADDED, STEERED = noisy(vp.AdditiveNoise(0.3)), noisy(vp.ControlNoise(0.03))

SMALL = {
    "held": row(2.1247274, scipy=True),
    "held, torques": row(2.8690354, scipy=True, **LIMITS),
    "held, joints": row(3.6725869, JOINTS, scipy=True),
    "held, speeds": row(3.5426741, speeds(1.8), scipy=True),
    "held, speeds and torques": row(9.1687277, speeds(2.2), scipy=True, **LIMITS),
    "held, rates": row(2.2275035, vp.WithinControlRate(150.0, before=[14.0, 4.0])),
    "held, goal": row(208.03691, GOAL, scipy=True),
    "held, goal and rates": row(208.03742, GOAL, vp.WithinControlRate(90.0)),
    "held, half-space": row(14.163062, vp.KeepInHalfSpace(TWO, "tip", [0, 0, 2], -3.0)),
    "held, box": row(9.3523701, vp.KeepInBox(TWO, "tip", [0.0, -np.inf, -1.6], [2.5, np.inf, np.inf])),
    "held, in a sphere": row(3.8353273, vp.KeepInSphere(TWO, "tip", [1.5, 0.0, -0.5], 1.4)),
    "held, out of a sphere": row(31.868422, SPHERE, scipy=True),
    "held, out of a moving sphere": row(
        2.1928645, vp.KeepOutOfSphere(TWO, "tip", lambda t: [0.4 * t - 1.95, 0.0, -1.0], 0.2), t0=5.0
    ),
    "held, clear of a ball": row(2.288535, CLEAR, kkt=1e-4),
    "held, clear of a moving ball": row(2.774077, MOVING, t0=5.0),
    "held, change of controls": row(3.7537843, speeds(2.2), more=CHANGES),
    "held over 3 steps": row(9.465277, speeds(2.2), hold=3, kkt=1e-4, scipy=True, **FINER, **LIMITS),
    "held over 2 steps, rates": row(2.1258071, vp.WithinControlRate(110.0), hold=2, **FINER),
    "held, between nodes": row(3.5974214, speeds(1.8), within=3.6e-4, **BETWEEN),
    "held, speeds and a reference in rows": row(
        3.7236627, speeds(1.8), more=vp.TrackingCost(LINE, 10.0), kkt=1e-4, scipy=True
    ),
    "held over 2 steps, between nodes": row(3.6647232, speeds(1.8), between_nodes=True, hold=2, within=3.6e-4),
    "held, sphere between nodes": row(31.882135, SPHERE, within=1e-4, **BETWEEN),
    "held, clear of a ball between nodes": row(40.01867, CLEAR, within=1e-4, **BETWEEN),
    "linear": row(2.1082305, scipy=True, **LINES),
    "linear, second order": row(2.1082305, solving=SECOND, **LINES),
    "linear, torques": row(2.7921344, scipy=True, **LINES, **LIMITS),
    "linear, rates and goal": row(208.02676, GOAL, vp.WithinControlRate(120.0), **LINES),
    "linear, change of controls": row(4.2462364, more=CHANGES, **LINES, **LIMITS),
    "linear, speeds": row(3.5263477, speeds(1.8), within=3.6e-3, **LINES),
    "linear, between nodes": row(3.533591, speeds(1.8), within=3.6e-4, **BETWEEN, **LINES),
    "linear, speeds and torques": row(9.1274867, speeds(2.2), within=4.4e-3, **LINES, **LIMITS),
    "linear, joints": row(3.6565019, JOINTS, within=1e-3, **LINES),
    "linear, out of a sphere": row(31.86263, SPHERE, within=1e-3, **LINES),
    "linear, clear of a ball": row(39.999934, CLEAR, within=1e-3, **LINES),
    "from states": row(3.5426741, speeds(1.8), solving={"states": LINE}),
    "second order": row(3.0291445, solving=SECOND, integrator=vp.Midpoint(), **LIMITS),
    "explicit steps": row(3.5426051, speeds(1.8), integrator=vp.RungeKutta4(), scipy=True),
    "midpoint rule": row(3.5644662, speeds(1.8), integrator=vp.SemiImplicitEuler(), sampling="midpoint"),
    "midpoint rule over 2 steps": row(
        2.1356254, integrator=vp.Midpoint(alpha=0.4), sampling="midpoint", hold=2, **FINER
    ),
    "start rule over 2 steps": row(2.1258443, integrator=vp.ExplicitEuler(), sampling="start", hold=2, **FINER),
    "noise of constant strength": row(6.1839502, scene=ADDED),
    "noise of the controls": row(2.7760496, scene=STEERED, kkt=None),
    "noise of the controls, linear": row(2.9337302, scene=STEERED, kkt=None, **LINES),
    # Noise counts by the present cost to go: a swing that costs less without it. Another one costs 3.574 in all.
    "noise of the controls, torques": row(3.7558, scene=STEERED, kkt=None, control_limits=([-24.0, -8.0], [24.0, 8.0])),
    "noise beside an input": Case(
        lambda: hand("linear", noise=vp.ControlNoise(0.05) + vp.AdditiveNoise(0.01)), 0.16340668, kkt=None
    ),
    "an input, linear": Case(lambda: hand("linear"), 0.11032363),
    "an input, cubic": Case(lambda: hand("cubic"), 0.084316886, SECOND),
    "an input, held": Case(lambda: hand("linear", controls="held"), 0.031895044),
    "an input, held, cubic": Case(lambda: hand("cubic", controls="held"), 0.027552717, kkt=1e-4),
    "an input, speeds between nodes": Case(
        lambda: hand("linear", constraints=[HAND_SPEEDS], between_nodes=True), 0.30936308, kkt=None, within=3.4e-3
    ),
    "an input, cubic, speeds": Case(
        lambda: hand("cubic", constraints=[HAND_SPEEDS], between_nodes=True), 0.37374939, kkt=None
    ),
    "three links": Case(
        lambda: wave(control_limits=(-12.0, 12.0)), 9.6697064, {"tolerance": 1e-10}, kkt=1e-4, scipy=True
    ),
    "three links, speeds": Case(lambda: wave(vp.WithinVelocityLimits(THREE, (-0.9, 0.9))), 2.6048773),
    "servos at their limits": Case(served, 0.0035311108, kkt=1e-4),
    "closed loop": Case(loop, 5.2016894),
    "closed loop, second order": Case(loop, 5.2016894, SECOND),
}


def arm(name, begin, move, constraints, **options):
    """A reach of an arm from rest in 1.2 s; ``constraints`` are of the robot, its begin and its goal."""
    robot = vp.load_robot(name, lock={"panda": {"panda_finger_joint1": 0.02}, "z1": {"jointGripper": 0.0}}.get(name))
    start, end = np.array(begin), np.array(begin) + move
    cost = vp.ControlCost(1.0 / robot.effort_limit**2) + vp.VelocityCost(0.1)
    cost += vp.Terminal(vp.TrackingCost(end, 50.0) + vp.VelocityCost(10.0))
    given = {"dt": 0.04, "steps": 30, "constraints": constraints(robot, start, end), **options}
    return vp.OptimalControlProblem(vp.Scene(robot, damping=0.1), cost, start, np.zeros(robot.dof), **given)


def at(robot, q, frame=None):
    return robot.frame_positions(q, frame or robot.end_effector)


UR5 = ("ur5", [0.0, -1.2, 1.4, -1.8, -1.57, 0.0], [1.0, 0.2, -0.3, 0.2, 0.3, 0.4])
PANDA = ("panda", [0.0, -0.6, 0.0, -2.2, 0.0, 1.8, 0.7], [0.9, 0.4, 0.2, 0.4, -0.2, 0.3, 0.4])
KINOVA = ("kinova", [0.3, 2.6, 1.6, 0.5, 1.0, 0.5], [0.7, -0.2, 0.3, 0.4, 0.3, 0.2])
Z1 = ("z1", [0.0, 1.5, -1.5, 0.0, 0.0, 0.0], [0.6, 0.4, -0.3, 0.3, 0.2, 0.4])


def ur5_torques():
    torques = np.array([20.0, 60.0, 25.0, 8.0, 1.0, 0.5])
    return arm(*UR5, most(0.85), control_limits=(-torques, torques))


def pose(robot, _, end):
    c, s = np.cos(0.3), np.sin(0.3)
    (tool,) = placements(robot, end[None], "tool0")
    turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ tool.rotation
    return [vp.ReachFrame(robot, "tool0", tool.translation, turned)]


def hasty(goal, duration, steps, speed, torque):
    """Joints that move at their greatest speed with little torque to spare."""
    cost = vp.ControlCost(1e-6) + vp.VelocityCost(1e-2) + vp.Terminal(vp.TrackingCost(goal, 1e2) + vp.VelocityCost(1.0))
    given = {"dt": duration / steps, "steps": steps, "control_limits": (-torque, torque)}
    return vp.OptimalControlProblem(vp.Scene(TWO, damping=0.1), cost, REST, REST, constraints=[speeds(speed)], **given)


def panda_at_speed():
    """A goal of the tool that joints reach at their greatest speeds."""
    robot = vp.load_robot("panda", lock={"panda_finger_joint1": 0.0})
    cost = vp.ControlCost(0.1 / robot.effort_limit**2) + vp.VelocityCost(0.1) + vp.Terminal(vp.VelocityCost(10.0))
    rules = [
        vp.ReachFrame(robot, robot.end_effector, [-0.49, -0.19, 0.41]),
        vp.WithinVelocityLimits(robot, (-1.0, 1.0)),
    ]
    begin = [-0.85, -0.88, -0.71, -1.45, -1.24, 0.85, 1.23]
    given = {"dt": 1.0 / 60, "steps": 24, "integrator": vp.RungeKutta4(), "constraints": rules}
    return vp.OptimalControlProblem(vp.Scene(robot, damping=0.1), cost, begin, np.zeros(7), **given)


def kinova_near_speeds():
    """A joint keeps to its greatest speed for eight nodes, at most of them by a hair."""
    robot = vp.load_robot("kinova")
    begin = [-0.0711748649960309, 1.9930761174675944, 1.7271682700264162, 0.07818165024080687, 1.8578307798284002]
    goal = [-0.3670625074091858, 1.691437829695649, 1.2497085561698789, 0.09824501637093636, 1.936600800564796]
    cost = vp.ControlCost(0.1 / robot.effort_limit**2)
    cost += vp.Terminal(vp.TrackingCost([*goal, 0.13025307794264052], 1e3) + vp.VelocityCost(10.0))
    given = {"dt": 0.025, "steps": 40, "constraints": [vp.WithinVelocityLimits(robot, (-0.8, 0.8))]}
    scene = vp.Scene(robot, damping=0.5)
    return vp.OptimalControlProblem(scene, cost, [*begin, -0.09503175088201599], np.zeros(6), **given)


def kinova_that_falls():
    """A first motion that costs ten thousand times what the plan does."""
    robot, rest = vp.load_robot("kinova"), np.zeros(6)
    cost = vp.ControlCost(1e-3) + vp.Terminal(vp.TrackingCost(rest + 0.3, 100.0) + vp.VelocityCost(1.0))
    given = {"dt": 0.05, "steps": 10, "constraints": [vp.WithinVelocityLimits(robot, (-1.0, 1.0))]}
    return vp.OptimalControlProblem(vp.Scene(robot), cost, rest, rest, **given)


def nearly_free():
    """A goal beyond a limit, without which it would cost next to nothing."""
    cost = vp.ControlCost(1e-7) + vp.Terminal(vp.TrackingCost([1.3], 100.0) + vp.VelocityCost(1.0))
    robot = vp.planar_chain(1)
    given = {"dt": 0.02, "steps": 40, "constraints": [vp.WithinJointLimits(robot, (-6.0, 1.0))]}
    return vp.OptimalControlProblem(vp.Scene(robot, damping=0.5), cost, [0.0], [0.0], **given)


def nothing_at_first():
    """A goal, and a first motion that costs next to nothing."""
    cost = vp.ControlCost(0.1, reference=[1e-6, 0.0]) + vp.VelocityCost(0.02) + vp.Terminal(vp.VelocityCost(10.0))
    goal = vp.ReachFrame(TWO, "tip", position=TWO.frame_positions([1.0, 0.5], "tip"))
    scene, given = vp.Scene(TWO, gravity=False, damping=0.1), {"dt": 0.05, "steps": 24, "constraints": [goal]}
    return vp.OptimalControlProblem(scene, cost, [0.0, 0.1], REST, **given)


def most(speed):
    return lambda robot, *_: [vp.WithinVelocityLimits(robot, (-speed, speed))]


def rates_and_goal(robot, _, end):
    return [vp.WithinControlRate(400.0), vp.ReachFrame(robot, "tool0", at(robot, end))]


def goal_and_joints(robot, _, end):
    free = [np.inf] * 6
    within = vp.WithinJointLimits(robot, ([-0.1, *np.negative(free)], [end[0] - 0.05, *free]))
    return [vp.ReachFrame(robot, robot.end_effector, at(robot, end)), within]


def sphere(robot, begin, end):
    middle = at(robot, 0.5 * (begin + end)) + np.array([0.0, 0.0, 0.02])
    return [vp.KeepOutOfSphere(robot, robot.end_effector, middle, 0.06)]


ARMS = {
    "UR5, speeds": Case(lambda: arm(*UR5, most(0.8)), 0.45339862),
    "UR5, speeds and torques": Case(ur5_torques, 0.28243473),
    "UR5, pose of the tool": Case(lambda: arm(*UR5, pose), 5.8381014),
    "UR5, rates and goal, linear": Case(lambda: arm(*UR5, rates_and_goal, controls="linear"), 0.20467992),
    "Panda, speeds": Case(lambda: arm(*PANDA, most(0.7)), 0.69038677),
    "Panda, goal and joints": Case(lambda: arm(*PANDA, goal_and_joints), 0.53737641),
    "Kinova, sphere": Case(lambda: arm(*KINOVA, sphere), 0.10137364),
    "Kinova, sphere between nodes": Case(lambda: arm(*KINOVA, sphere, between_nodes=True), 0.10137404, within=1e-4),
    "Z1, speeds, linear": Case(lambda: arm(*Z1, most(0.45), controls="linear"), 0.45452603, within=9e-4),
}
# Those at the edge of what limits allow, where feedback has no room.
HARD = {
    "one torque fixed": row(50.619309, speeds(2.2), control_limits=([-40.0, -3.0], [40.0, -3.0])),
    "two links in haste": Case(lambda: hasty([0.38, -1.25], 0.67, 16, 1.71, 43.0), 2.9835572),
    "two links in more haste": Case(lambda: hasty([1.32, 1.05], 0.95, 19, 1.4, 29.0), 0.63806531),
    "Panda, goal at greatest speeds": Case(panda_at_speed, 0.13662213),
    "Kinova, speeds met by a hair": Case(kinova_near_speeds, 0.0023766076),
    "Kinova, a fall at first": Case(kinova_that_falls, 0.0025351367),
    "a limit before a goal": Case(nearly_free, 9.0074427),
    "no cost at first": Case(nothing_at_first, 16.0767),
}
CASES = SMALL | ARMS | HARD
