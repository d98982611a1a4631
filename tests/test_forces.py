"""Forces on joints and between frames, and those of a user: by their formulas, and what scenes say of them."""

import gc
import itertools
import weakref

import numpy as np
import pinocchio as pin
import pytest
from findings import about
from oracles import Mechanism, slope
from refusals import refused, unnamed

import varpin as vp

CASES = {
    "spring": vp.JointSpring(3.0, 0.4),
    "damper": vp.JointDamper(0.7),
    "friction": vp.CoulombFriction(0.5, 0.1),
    "breakaway": vp.CoulombFriction(0.5, 0.1, 0.9, 0.3),
    "stops": vp.JointStop(50.0, 3.0, -1.0, 1.0, 0.2),
    "one stop": vp.JointStop(50.0, 0.0, -np.inf, 0.5, 0.2),
    "servo": vp.PositionServo(2.0, 0.3, 2.0),
}


@pytest.mark.parametrize("name", CASES)
def test_each_against_its_formula(name):
    robot, one = vp.planar_chain(1), np.ones(1)
    scene, bare = vp.Scene(robot, forces=CASES[name]), vp.Scene(robot)
    plain, drive = Mechanism(scene).forces, np.array([0.7])
    for q, v in [(-1.35, 0.4), (-1.05, -0.2), (0.1, 0.03), (0.6, -0.3), (1.15, 0.9), (1.6, -0.05), (3.0, 0.0)]:
        at, rate = np.array([q]), np.array([v])
        own, other = vp.lagrangian_jet(scene, at, rate), vp.lagrangian_jet(bare, at, rate)
        V, pull, rest = plain(at, rate, drive)
        assert pytest.approx(V, rel=1e-12, abs=1e-13) == other.L - own.L
        assert own.Lq - other.Lq == pytest.approx(pull, rel=1e-12, abs=1e-13)
        bend = slope(lambda x, rate=rate: plain(x, rate, drive)[1], at, one, 1e-4)
        assert own.Lqq[0] - other.Lqq[0] == pytest.approx(bend, rel=1e-9, abs=1e-9)
        arrays = scene.core.forces(at[None], rate[None], drive[None])
        value, by_q, by_v, lost = (array[0] for array in arrays)
        assert value == pytest.approx(rest - drive, rel=1e-13, abs=1e-15)
        found = slope(lambda x, rate=rate: plain(x, rate, drive)[2], at, one, 1e-3)
        assert by_q == pytest.approx(found, rel=1e-9, abs=1e-11)
        found = slope(lambda x, at=at: plain(at, x, drive)[2], rate, one, 1e-3)
        assert by_v == pytest.approx(found, rel=1e-9, abs=1e-11)
        assert lost[0] >= 0.0
        if name != "servo":
            assert lost == pytest.approx((drive - rest) * rate, rel=1e-13, abs=1e-15)


def test_what_holds_an_arm_on_servos_is_a_position():
    robot = vp.load_robot("ur5")
    q = np.array([0.1, -0.8, 1.1, 0.2, -0.4, 0.3])
    scene = vp.Scene(robot, forces=vp.PositionServo({"elbow_joint": 900.0, "shoulder_lift_joint": 700.0}, 1.0, 1000.0))
    u = scene.holding_controls(q)
    motion = vp.simulate(scene, q, np.zeros(6), dt=1e-2, steps=20, controls=u)
    np.testing.assert_allclose(motion.q, np.tile(q, (21, 1)), atol=1e-9)
    torque = scene.holding_torque(q)
    assert u[2] == pytest.approx(q[2] + torque[2] / 900.0, rel=1e-12)
    assert u[3] == pytest.approx(torque[3], rel=1e-12)
    weak = vp.Scene(robot, forces=vp.PositionServo({"shoulder_lift_joint": 900.0}, effort=1.0))
    with refused(vp.InputError, "shoulder_lift_joint"):
        weak.holding_controls(q)


def test_a_servo_has_a_control_of_its_own():
    robot = vp.planar_chain(2)
    for forces, actuation, joint in (
        (vp.PositionServo(1.0), ["joint1"], "'joint2'"),
        (vp.PositionServo({"joint1": 1.0}), [[1.0], [1.0]], "'joint1'"),
        (vp.PositionServo({"joint1": 1.0}), [[2.0, 0.0], [0.0, 1.0]], "'joint1'"),
        ([vp.PositionServo(1.0), vp.PositionServo({"joint2": 1.0})], None, "'joint2'"),
    ):
        with refused(vp.InputError, joint):
            vp.Scene(robot, forces=forces, actuation=actuation)
    scene = vp.Scene(robot, forces=vp.PositionServo({"joint2": 50.0}), actuation=["joint2"])
    np.testing.assert_array_equal(scene.actuation, [[0.0], [50.0]])


def test_short_forms_are_the_same_elements():
    robot = vp.load_robot("ur5")
    short = vp.Scene(robot, damping=0.3, stiffness={"elbow_joint": 2.0}, rest=0.1)
    long = vp.Scene(robot, forces=[vp.JointSpring({"elbow_joint": 2.0}, 0.1), vp.JointDamper(np.full(6, 0.3))])
    assert short.elements == long.elements
    for name in ("damping", "stiffness"):
        assert getattr(short, name).tobytes() == getattr(long, name).tobytes()
    assert long.rest[2] == 0.1
    several = vp.Scene(robot, damping=0.3, forces=[vp.JointDamper(0.2), vp.JointSpring(1.0, 1.0), vp.JointSpring(3.0)])
    np.testing.assert_allclose([several.damping[0], several.stiffness[0], several.rest[0]], [0.5, 4.0, 0.25])


def test_stops_are_where_the_description_has_limits():
    robot = vp.load_robot("panda")
    stops = vp.Scene(robot, forces=vp.JointStop(100.0)).elements
    assert [own.coordinate for own in stops] == list(range(robot.dof))
    np.testing.assert_array_equal(np.array([own.values[:2] for own in stops]).T, robot.position_limits)
    one = vp.Scene(robot, forces=vp.JointStop(100.0, lower={"panda_joint2": 0.1}, upper={})).elements
    assert [(own.coordinate, own.values[:2]) for own in one] == [(1, (0.1, np.inf))]


def test_scenes_show_their_forces():
    forces = [vp.CoulombFriction({"elbow_joint": 0.5}), vp.JointStop(1e3, np.full(6, 2.0)), vp.Armature(0.1)]
    forces += [vp.FrameSpring("tool0", ("forearm_link", [0.05, 0.1, 0.0]), 8.0)]
    scene = vp.Scene(vp.load_robot("ur5"), forces=forces, noise=vp.AdditiveNoise(0.1))
    assert "CoulombFriction, JointStop, Armature, FrameSpring, noise of 6 processes" in repr(scene)
    assert "FrameSpring(a='tool0', b=('forearm_link', [0.05, 0.1, 0.0]), stiffness=8.0, rest=0.0)" in repr(scene.forces)
    assert "CoulombFriction(level={'elbow_joint': 0.5}, width=0.01)" in repr(scene.forces)
    assert "CoulombFriction" in scene._repr_html_()


@pytest.mark.parametrize(
    ("make", "facts"),
    [
        (lambda: vp.JointDamper(-1.0), ("damping[0]", "-1.0", "0")),
        (lambda: vp.JointDamper(None), ("damping", "None")),
        (lambda: vp.Armature([1.0, 2.0]), ("inertia", "(6,)")),
        (lambda: vp.CoulombFriction(1.0, width=0.0), ("width[0]", "0.0", "0")),
        (lambda: vp.CoulombFriction(1.0, breakaway=2.0), ("breakaway", "stribeck_velocity")),
        (lambda: vp.CoulombFriction(1.0, 0.1, 0.5, 1.0), ("breakaway[0]", "0.5")),
        (lambda: vp.JointStop(1.0, lower=1.0, upper=-1.0), ("lower[0]", "1.0", "upper")),
        (lambda: vp.JointStop(1.0, lower=np.inf), ("lower[0]", "inf")),
        (lambda: "friction", "forces"),
        (lambda: [vp.JointDamper(1.0), 3.0], ("forces", "3.0")),
        (lambda: vp.FrameWrench("base_link", np.ones(6)), "'base_link'"),
        (lambda: vp.FrameWrench("tool0", np.ones(3)), ("wrench", "(6,)")),
        (lambda: vp.FrameWrench([0.5, 0.0, 0.4], np.ones(6)), ("frame", "[0.5, 0.0, 0.4]")),
        (lambda: vp.FrameWrench("tool0", np.ones(6), "local"), ("axes", "'world'", "'frame'", "'local'")),
        (lambda: vp.FrameSpring("tool0", [0, 0], 1.0), ("b", "(2,)")),
        (lambda: vp.FrameSpring([0, 0, 0], "base_link", 1.0), ("FrameSpring", "'ur5'")),
        (lambda: vp.FrameSpring("tool0", [0, 0, 0], -1.0), ("stiffness", "-1.0")),
        (lambda: vp.FrameSpring("tool0", [0, 0, 0], 1.0, -0.1), ("rest", "-0.1")),
        (lambda: vp.FrameSpring("tool0", [0, 0, 0], [1, 1, 1], 0.1), "stiffness"),
        (lambda: vp.FrameSpring("tool0", [0, 0, 0], 1.0, rest_rotation=np.eye(3)), "rest_rotation"),
        (
            lambda: vp.FrameSpring("tool0", [0, 0, 0], 1.0, 0.0, 1.0, np.diag([1.0, 1.0, -1.0])),
            "rest_rotation",
        ),
        (lambda: vp.FrameSpring("base_link", [0, 0, 0], 0.0, 0.0, 1.0), ("FrameSpring", "'ur5'")),
        (lambda: vp.FrameDamper("tool0", [0, 0, 0], 1.0, np.nan), ("rotational_damping", "nan")),
        (lambda: vp.FrameDamper(("tool0", [0, 0]), [0, 0, 0], 1.0), "(3,)"),
        (lambda: vp.FrameDamper("tool0", [0, 0, 0], [1, np.inf, 1]), ("damping", "[1.0, inf, 1.0]")),
    ],
)
def test_what_is_no_force_is_refused(make, facts):
    with refused(vp.InputError, facts):
        vp.Scene(vp.load_robot("ur5"), forces=make())


def test_stops_ends_and_servos_are_said():
    chain = vp.planar_chain(2)
    with refused(vp.InputError, "'joint1'", "'joint2'", "lower", "upper"):
        vp.Scene(chain, forces=[vp.JointStop(1e3)])
    servos = [vp.PositionServo(100.0, 5.0, effort=50.0)]
    with refused(vp.InputError, "'joint1'"):
        vp.Scene(chain, forces=servos, noise=vp.AdditiveNoise(0.1) + vp.ControlNoise(0.1))
    cost = vp.ControlCost(1e-2) + vp.Terminal(vp.TrackingCost([1.0, 0.5], 50.0))
    plan = vp.solve(vp.OptimalControlProblem(vp.Scene(chain, damping=0.1), cost, [0, 0], [0, 0], dt=0.02, steps=30))
    served = vp.Scene(chain, damping=0.1, forces=servos)
    with refused(vp.InputError, "servos", "no joint", "joint1, joint2"):
        vp.simulate(served, [0, 0], [0, 0], dt=0.02, steps=30, controls=plan.policy, integrator=vp.Gauss(4))
    with refused(vp.InputError, "joint1", "joint2"):
        vp.Mpc(plan.problem).run(vp.Plant(served), duration=0.1)


def test_limits_are_held_against_what_drives_and_stops_do():
    robot = vp.load_robot("ur5")
    servo = vp.PositionServo({"elbow_joint": 1e4}, {"elbow_joint": 100.0})
    scene, q = vp.Scene(robot, gravity=False, forces=[servo]), [0, 0, 0.5, 0, 0, 0]

    def said(scene, q, v, steps, **options):
        return vp.simulate(scene, q, v, dt=1e-3, steps=steps, **options).warnings

    assert not about(said(scene, q, np.zeros(6), 20, controls={"elbow_joint": 0.5}), "effort limits")
    (told,) = about(said(scene, q, np.zeros(6), 20, controls={"elbow_joint": 0.0}), "effort limits")
    assert not unnamed(told, "'elbow_joint'", "150 N m", "4.85e+03")
    stiff = vp.Scene(robot, gravity=False, forces=[vp.JointStop(1e5, 1e3)])
    for side in (1.0, -1.0):
        assert not about(said(stiff, [0, 0, 3.0 * side, 0, 0, 0], [0, 0, side, 0, 0, 0], 400), "position limits")


def test_groups_that_couplings_join():
    robot, tip, other = vp.combine(vp.planar_chain(3), vp.planar_chain(4), prefixes=["a_", "b_"]), "a_tip", "b_tip"
    spring = vp.FrameSpring(tip, other, 5.0)
    assert vp.Scene(robot).group.tolist() == [0, 0, 0, 1, 1, 1, 1]
    assert vp.Scene(robot, forces=vp.FrameSpring(tip, [0.0, 0.0, 0.0], 5.0)).group.max() == 1
    assert vp.Scene(robot, forces=spring).group.tolist() == [0] * 7
    q, v = np.random.default_rng(3).normal(size=(2, 7))
    scene = vp.Scene(robot, forces=spring)
    A = vp.linearize(scene, vp.simulate(scene, q, v, dt=1e-3, steps=1)).A[0]
    assert np.abs(A[7:10, 3:7]).min() > 0.0
    # Errors of the energy that passes between arms are no errors.
    motion = vp.simulate(scene, q, np.zeros(7), dt=1e-3, steps=300, integrator=vp.RungeKutta4())
    assert not about(motion.warnings, "error")


def carrier():
    model = pin.Model()
    parent = 0
    for k, mass in enumerate((500.0, 0.01, 0.01)):
        parent = model.addJoint(parent, pin.JointModelRY(), pin.SE3(np.eye(3), np.array([0.3 * k, 0, 0])), f"j{k}")
        model.appendBodyToJoint(parent, pin.Inertia.FromSphere(mass, 0.2), pin.SE3(np.eye(3), np.array([0.2, 0, 0])))
        placement = pin.SE3(np.eye(3), np.array([0.3, 0, 0]))
        model.addFrame(pin.Frame(f"tip{k}", parent, 0, placement, pin.FrameType.OP_FRAME))
    return vp.load_robot(model)


@pytest.mark.parametrize("ends", [("tip2", "tip0"), ("tip2", [0.5, 0.0, -0.8]), ("tip2", "tip1")])
def test_light_parts_balance_with_springs(ends):
    robot = carrier()
    assert robot.tree.loads.size
    scene = vp.Scene(robot, forces=[vp.FrameSpring(*ends, 2.0), vp.FrameDamper(*ends, 0.002)])
    q, v = np.array([0.1, 0.8, -0.5]), np.array([0.4, 0.0, 1.0])
    motion = vp.simulate(scene, q, v, dt=2e-3, steps=500, integrator=vp.Gauss(2), check=False)
    assert motion.statistics.split_steps == 0


REST = [0.0, -1.0, 1.0, -0.5, 0.8, 0.0]


@pytest.fixture(scope="module")
def served():
    scene = vp.Scene(vp.load_robot("ur5"), forces=[vp.PositionServo(2000.0, 200.0)])
    return scene, vp.simulate(scene, REST, np.zeros(6), dt=1e-3, steps=200, integrator=vp.Radau(3))


def test_servos_that_are_told_nothing_stay(served):
    scene, motion = served
    np.testing.assert_array_equal(motion.u, np.tile(REST, (200, 1)))
    # They give way to gravity alone, by what a spring would.
    sag = scene.holding_torque(REST) / 2000.0
    assert np.abs(motion.q - REST).max() < 2.0 * np.abs(sag).max()


def test_ensembles_and_advice_take_the_same(served):
    scene, motion = served
    paths = vp.simulate_ensemble(scene, REST, np.zeros(6), dt=1e-3, steps=200, paths=1, rng=0, integrator=vp.Radau(3))
    np.testing.assert_allclose(paths.statistics.mean[-1, :6], motion.q[-1], rtol=0, atol=1e-12)
    with refused(vp.InputError, "controls", "servos"):
        vp.simulate_ensemble(scene, [REST, np.zeros(6)], np.zeros(6), dt=1e-3, steps=2, paths=2, rng=0)


def test_commands_are_not_coloured_as_torques(served, tmp_path):
    scene, motion = served
    with refused(vp.InputError, "controls", "servos"):
        vp.replay(scene.robot, motion, html=tmp_path / "served.html", marks=vp.Marks(torques=True))


# --- those that a user writes ----------------------------------------------------------------------------------------


ROBOT = vp.planar_chain(3)
NAMES = ROBOT.joint_names
Q0, V0 = np.array([0.3, -0.4, 0.5]), np.array([1.0, -0.5, 0.8])
D = np.array([[0.5, 0.1, 0.0], [0.1, 0.4, -0.1], [0.0, -0.1, 0.3]])


def drag(q, v):
    """Full in its matrices, and neither linear nor a gradient."""
    return -D @ v * (1.0 + 0.3 * np.sin(q)) + np.array([0.5 * q[1] * q[2], -q[0], np.cos(q[0]) * v[1]])


def slopes(q, v):
    by_q = -np.diag(D @ v * 0.3 * np.cos(q))
    by_q += np.array([[0.0, 0.5 * q[2], 0.5 * q[1]], [-1.0, 0.0, 0.0], [-np.sin(q[0]) * v[1], 0.0, 0.0]])
    by_v = -(1.0 + 0.3 * np.sin(q))[:, None] * D
    by_v[2, 1] += np.cos(q[0])
    return by_q, by_v


def simulate(own, **options):
    given = {"dt": 0.01, "steps": 5, "controls": [1.0, 0.5, -0.2], "check": False}
    return vp.simulate(own, Q0, V0, **(given | options))


@pytest.mark.parametrize("derivatives", ["complex", None])
def test_all_derivatives_agree(derivatives):
    given, other = (vp.CustomForce(drag, how) for how in (slopes, derivatives))
    for q, v in itertools.product(np.random.default_rng(0).normal(size=(3, 3)), repeat=2):
        for one, two in zip(given.slopes(q, v), other.slopes(q, v), strict=True):
            np.testing.assert_allclose(one, two, rtol=0, atol=1e-14 if derivatives else 1e-10)


def test_holding():
    own = vp.Scene(ROBOT, forces=vp.CustomForce(lambda q, v: np.array([1.0, -2.0, 0.5]) + v))
    torque = vp.Scene(ROBOT).holding_torque(Q0) - [1.0, -2.0, 0.5]
    np.testing.assert_allclose(own.holding_torque(Q0), torque, atol=1e-12)
    controls = own.holding_controls(Q0)
    held = vp.simulate(own, Q0, np.zeros(3), dt=0.01, steps=3, controls=controls, check=False)
    np.testing.assert_allclose(held.q, np.tile(Q0, (4, 1)), atol=1e-12)


@pytest.mark.parametrize(
    ("force", "facts"),
    [
        (vp.CustomForce(lambda q, v: np.zeros(2)), ("CustomForce <lambda>", "(3,)")),
        (vp.CustomForce(lambda q, v: 1j * v), ("CustomForce <lambda>", "real numbers")),
        (vp.CustomForce(lambda q, v: v / 0.0 if q[0] > 0.31 else v), ("CustomForce <lambda>", "finite", "q = ")),
        (vp.CustomForce(lambda q, v: 1 / 0), ("CustomForce <lambda>", "ZeroDivisionError")),
        (vp.CustomForce(drag, lambda q, v: np.eye(3)), "derivatives"),
        (vp.CustomForce(drag, lambda q, v: (np.eye(3), np.eye(2))), "derivatives"),
    ],
)
def test_what_is_no_force(force, facts):
    with refused(vp.ForceError, facts) as info, np.errstate(all="ignore"):
        simulate(vp.Scene(ROBOT, forces=force))
    assert info.value.trajectory.steps == info.value.step


def test_shown():
    assert repr(vp.CustomForce(drag, "complex")) == "CustomForce(drag, derivatives by complex steps)"


def test_differences_take_steps_smaller_than_what_they_look_at():
    """Friction that turns round within a ten-thousandth [rad/s]."""
    own = vp.CustomForce(lambda q, v: -0.5 * np.tanh(v / 1e-4))
    for v in (0.0, 2e-5, 1e-4, 3e-4, 0.01):
        _, by_v = own.slopes(np.zeros(3), np.full(3, v))
        exact = -0.5 / 1e-4 / np.cosh(v / 1e-4) ** 2
        np.testing.assert_allclose(by_v, exact * np.eye(3), rtol=0, atol=1e-6 * max(1.0, abs(exact)))


class TestDerivativesThatAreWrong:
    def test_given_ones_are_named(self):
        def wrong(q, v):
            by_q, by_v = slopes(q, v)
            by_v[0, 1] += 0.3
            return by_q, by_v

        exact = slopes(Q0, V0)[1][0, 1]
        for start in (
            simulate,
            lambda own: simulate(own, integrator=vp.RungeKutta4()),
            lambda own: simulate(own, dt=None, steps=None, duration=0.1, tolerance=1e-4),
        ):
            values = f"{exact + 0.3:.8g}", f"{exact:.8g}"
            with refused(vp.CustomForceError, "CustomForce drag", "dF/dv[0, 1]", values, "q = [ 0.3 -0.4  0.5]"):
                start(vp.Scene(ROBOT, forces=vp.CustomForce(drag, wrong)))

    def test_complex_steps_are_tried_where_the_motion_starts(self):
        """Beyond a threshold the function drops imaginary parts, and near zero it does not."""

        def f(q, v):
            return -v * (np.abs(v) if v[0].real > 5.0 else 1.0)

        own = vp.Scene(ROBOT, forces=vp.CustomForce(f, "complex"))
        vp.simulate(own, Q0, V0, dt=1e-2, steps=2)
        with refused(vp.CustomForceError, "dF/dv[0, 0]"):
            vp.simulate(vp.Scene(ROBOT, forces=vp.CustomForce(f, "complex")), Q0, [6.0, 0, 0], dt=1e-2, steps=2)

    def test_jumps_at_the_start_are_no_fault(self):
        """A function without derivatives there, whose own are right elsewhere."""
        own = vp.CustomForce(lambda q, v: -np.sign(v), lambda q, v: (np.zeros((3, 3)), np.zeros((3, 3))))
        vp.Scene(ROBOT, forces=own).custom.check(Q0, np.zeros(3))


def breaks(q, v):
    """Not defined from some place on, where motions from Q0 and V0 come by."""
    if q[0] > 0.36:
        raise ValueError("beyond the table")
    return -v


def damps(q, v):
    return np.zeros((3, 3)), -np.eye(3)


class TestWhereItFails:
    own = staticmethod(lambda **options: vp.Scene(ROBOT, forces=vp.CustomForce(breaks, damps), **options))

    def check(self, error):
        assert error.trajectory.steps == error.step > 0
        assert not unnamed(str(error), "beyond the table", "q = [")
        assert error.time == error.trajectory.t[-1]

    def test_with_a_tolerance(self):
        with pytest.raises(vp.ForceError) as info:
            vp.simulate(self.own(), Q0, V0, duration=0.5, tolerance=1e-5)
        self.check(info.value)

    def test_coarse_steps_may_fail(self):
        reach = vp.simulate(vp.Scene(ROBOT, damping=1.0), Q0, V0, dt=1e-3, steps=100).q[:, 0].max() + 2e-3

        def edge(q, v):
            if q[0] > reach:
                raise ValueError("beyond the table")
            return -v

        motion = vp.simulate(vp.Scene(ROBOT, forces=vp.CustomForce(edge, damps)), Q0, V0, duration=0.1, tolerance=1e-5)
        assert motion.accuracy.met

    def test_in_a_plan(self):
        """On the first motion it is an error; later on it costs trials."""
        cost = vp.ControlCost(1e-3) + vp.TrackingCost([0.6, -0.4, 0.5], 10.0)
        problem = vp.OptimalControlProblem(self.own(gravity=False), cost, Q0, V0, dt=0.03, steps=10)
        with pytest.raises(vp.ForceError) as info:
            vp.solve(problem, np.zeros(3))
        self.check(info.value)
        still = problem.at(v0=np.zeros(3))
        plan = vp.solve(still, np.zeros(3), max_iterations=4, check=False)
        assert plan.trajectory.q[:, 0].max() <= 0.37
        assert plan.cost < still.cost_of(still.simulate(np.zeros((10, 3))))

    def test_newton_names_it(self):
        jumps = vp.CustomForce(lambda q, v: -200.0 * np.sign(v - 0.013))
        own = vp.Scene(ROBOT, gravity=False, forces=jumps)
        with refused(vp.StepFailure, "CustomForce <lambda>"):
            vp.simulate(own, Q0, V0, dt=0.01, steps=50, integrator=vp.Gauss(2), check=False)


@pytest.mark.parametrize("kind", ["force", "constraint"])
def test_a_scene_whose_function_knows_it_is_collected(kind):
    """The core's own reference is none that keeps it alive."""

    def made():
        box = []
        if kind == "force":
            scene = vp.Scene(ROBOT, forces=vp.CustomForce(lambda q, v: -0.1 * v * len(box)))
        else:
            own = vp.CustomConstraint(1, lambda q: [q[0] * len(box)], lambda q: [[1.0, 0.0, 0.0]])
            scene = vp.Scene(ROBOT, constraints=own)
        box.append(scene)
        vp.simulate(scene, np.zeros(3), np.zeros(3), dt=1e-2, steps=2)
        return weakref.ref(scene)

    gone = made()
    gc.collect()
    assert gone() is None
