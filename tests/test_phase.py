"""What oscillations lose over a whole motion, against closed forms and SciPy on Pinocchio's forward dynamics."""

import numpy as np
import pinocchio as pin
import pytest
from findings import about
from scipy.integrate import solve_ivp

import varpin as vp
from varpin.simulation.phase import phase_lost

METHODS = [
    vp.Midpoint(guard=None), vp.Gauss(2, guard=None), vp.Gauss(3, guard=None), vp.Radau(2, guard=None),
    vp.Radau(3, guard=None), vp.RungeKutta4(), vp.SemiImplicitEuler(),
]  # fmt: skip


@pytest.mark.parametrize("integrator", METHODS, ids=str)
@pytest.mark.parametrize("damping", [0.0, 8.0])
def test_one_step_multiplies_a_mode_by_the_amplification(integrator, damping):
    """The eigenvalues of the step of a joint on a spring, which is linear without gravity."""
    robot = vp.planar_chain(1)
    inertia = vp.lagrangian_jet(vp.Scene(robot), np.zeros(1), np.zeros(1)).Lvv[0, 0]
    scene = vp.Scene(robot, gravity=False, stiffness=inertia * 30.0**2, damping=inertia * damping)
    ends = []
    for start in np.eye(2):
        motion = vp.simulate(scene, start[:1], start[1:], dt=0.02, steps=1, integrator=integrator, check=False)
        ends.append([motion.q[-1, 0], motion.v[-1, 0]])
    made = np.linalg.eigvals(np.array(ends).T)
    rate = -0.5 * damping + 1j * np.sqrt(30.0**2 - 0.25 * damping**2)
    assert np.abs(made - integrator.amplification(np.array([0.02 * rate]))).min() <= 1e-9


@pytest.mark.parametrize(("damping", "dt", "integrator"), [
    (0.0, 5e-4, vp.Midpoint()), (2.0, 5e-4, vp.Midpoint()), (0.0, 2e-3, vp.Gauss(2)), (2.0, 2e-3, vp.Gauss(2)),
])  # fmt: skip
def test_the_loss_of_one_oscillation(damping, dt, integrator):
    rate, robot = 444.0, vp.planar_chain(1)
    inertia = vp.lagrangian_jet(vp.Scene(robot), np.zeros(1), np.zeros(1)).Lvv[0, 0]
    scene = vp.Scene(robot, gravity=False, stiffness=inertia * rate**2, damping=inertia * damping)
    motion = vp.simulate(scene, [0.1], [0.0], dt=dt, steps=round(0.5 / dt), integrator=integrator)
    slow, fast = 0.5 * damping, np.sqrt(rate**2 - 0.25 * damping**2)
    exact = 0.1 * np.exp(-slow * motion.t) * (np.cos(fast * motion.t) + slow / fast * np.sin(fast * motion.t))
    lost = phase_lost(scene, integrator, motion)
    assert lost.rate == pytest.approx(fast, rel=1e-3)
    assert lost.off == pytest.approx(np.abs(motion.q[:, 0] - exact).max(), rel=0.05)
    assert about(motion.warnings, "phase")
    finer = vp.simulate(scene, [0.1], [0.0], dt=dt / 8, steps=8 * motion.steps, integrator=integrator)
    assert finer.warnings == ()


def _sprung_arm():
    """An arm of seven joints on springs, its wrist a mode of some 400 rad/s, and a start off its rest."""
    robot = vp.load_robot("xarm7")
    inertia = np.diag(np.linalg.inv(vp.lagrangian_jet(vp.Scene(robot, damping=0), np.full(7, 0.3), np.zeros(7)).Lvv))
    scene = vp.Scene(robot, damping=0, stiffness=np.array([20, 20, 30, 30, 40, 60, 440.0]) ** 2 / inertia)
    return scene, np.array([0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.8])


@pytest.mark.parametrize(("integrator", "told"), [(vp.Midpoint(), True), (None, False)], ids=str)
def test_a_fast_spring_of_an_arm_is_followed_or_told_of(integrator, told):
    """A step of 0.5 ms, a thousand of them: the midpoint rule's wrist runs out of phase by a radian."""
    scene, q0 = _sprung_arm()
    model, data = scene.robot.model, scene.robot.model.createData()

    def slope(_, x):
        q, v = x[:7], x[7:]
        return np.append(v, pin.aba(model, data, q, v, -scene.stiffness * q))

    exact = solve_ivp(slope, (0.0, 0.5), np.append(q0, np.zeros(7)), "DOP853", rtol=1e-10, atol=1e-12).y[:7, -1]
    motion = vp.simulate(scene, q0, np.zeros(7), dt=5e-4, steps=1000, integrator=integrator)
    off = np.abs(motion.q[-1] - exact).max() / np.ptp(motion.q, axis=0).max()
    assert (off > 0.05) == told
    assert bool(about(motion.warnings, "phase")) == told


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(2), None], ids=str)
@pytest.mark.parametrize("rate", [10.0, 1e3])
def test_rounding_of_a_robot_at_rest_on_springs_is_no_oscillation(integrator, rate):
    robot = vp.load_robot("ur5")
    rest = np.full(6, 0.3)
    scene = vp.Scene(robot, stiffness=rate**2, rest=rest)
    controls = scene.holding_controls(rest)
    motion = vp.simulate(scene, rest, np.zeros(6), dt=1e-2, steps=100, controls=controls, integrator=integrator)
    assert np.abs(motion.q - rest).max() <= 1e-9
    assert motion.warnings == ()


def test_modes_that_do_not_turn_within_the_motion_are_no_oscillations():
    """Weak servos that let an arm fall: modes near zero, whose heights are what cancels."""
    robot = vp.load_robot("ur5")
    scene = vp.Scene(robot, forces=[vp.PositionServo(2000.0, 100.0, 20.0)])
    q0 = np.array([0.0, -1.0, 1.0, 0.0, 0.0, 0.0])
    start = {"q0": q0, "v0": np.zeros(6), "controls": q0 + 0.05}
    motion = vp.simulate(scene, **start, dt=5e-3, steps=400)
    fine = vp.simulate(scene, **start, dt=5e-3 / 16, steps=16 * 400, integrator=vp.Radau(4), check=False)
    assert np.abs(motion.q - fine.q[::16]).max() <= 0.02 * np.ptp(fine.q, axis=0).max()
    assert not about(motion.warnings, "phase")


@pytest.mark.parametrize("seed", [0, 5, 8, 11])
def test_a_joint_that_nothing_holds_is_no_oscillation(seed):
    """A drive at its limit pushes evenly, about the vertical: an eigenvalue zero, twice, which rounding splits."""
    rng = np.random.default_rng(seed)
    robot = vp.load_robot("kinova")
    q0 = np.clip(rng.uniform(-1.0, 1.0, 6), *robot.position_limits)
    inertia = np.diag(vp.lagrangian_jet(vp.Scene(robot, damping=0), q0, np.zeros(6)).Lvv)
    servos = vp.PositionServo(inertia * 120.0**2, 1.4 * inertia * 120.0, inertia * rng.uniform(2.0, 40.0))
    scene = vp.Scene(robot, damping=0, forces=[servos])

    def moved(dt):
        return vp.simulate(
            scene, q0, np.zeros(6), dt=dt, duration=0.5, controls=q0 + 0.3, integrator=vp.Gauss(4), check=False
        )

    motion, finer = moved(5e-3), moved(1.25e-3)
    # The joint that was said to be off is right to a thousandth or so of the largest joint travel.
    assert np.abs(motion.q - finer.q[::4])[:, 0].max() <= 2e-3 * np.ptp(finer.q, axis=0).max()
    assert phase_lost(scene, vp.Gauss(4), motion) is None


def test_nothing_is_said_of_what_is_not_known():
    """Gravity alone, noise in Python, and methods whose stability function nobody has worked out."""
    chain = vp.planar_chain(2)
    trembling = vp.CustomNoise(lambda q, v, u: 0.1 * np.eye(2), 2)
    for scene, integrator, rng in (
        (vp.Scene(chain), vp.Midpoint(), None),
        (vp.Scene(chain, stiffness=1e3, noise=trembling), vp.Midpoint(), 0),
        (vp.Scene(chain, stiffness=1e3), vp.Midpoint(alpha=0.3), None),
    ):
        motion = vp.simulate(scene, [0.3, 0.3], [0, 0], dt=1e-2, steps=200, integrator=integrator, rng=rng, check=False)
        assert phase_lost(scene, integrator, motion) is None


@pytest.mark.parametrize("name", ["talos_arm", "xarm7"])
def test_nothing_is_said_of_an_arm_that_is_held_at_rest(name):
    """Torques that balance gravity and springs to rounding: what swings is rounding, too."""
    robot = vp.load_robot(name)
    for posture in (np.zeros(7), np.full(7, 0.3)):
        scene = vp.Scene(robot, damping=0.5, stiffness=30.0)
        motion = vp.simulate(
            scene, posture, np.zeros(7), dt=4e-3, steps=250, controls=scene.holding_controls(posture)
        )  # fmt: skip
        assert np.ptp(motion.q, axis=0).max() <= 1e-12
        assert not about(motion.warnings, "phase")


def _loop_on_springs(inputs=False):
    """A loop of links on springs, displaced a little from its rest; with ``inputs`` its crank is held."""
    robot = vp.planar_chain(5 if inputs else 4)
    closed = vp.PointOnPoint("tip", (1.6, 0.0, 0.3), axes="xz")
    constraints = [closed, *([vp.KinematicInput("joint1")] if inputs else [])]
    scene = vp.Scene(robot, stiffness=1e3, constraints=constraints, actuation=["joint1"])
    q0 = vp.assemble(scene, ([-1.0, 1.0, 1.0, 1.0, 0.4] if inputs else [-1.0, 1.0, 1.0, 1.0]))
    sprung = vp.Scene(
        robot,
        stiffness=2e4 if inputs else 3e3,
        rest=q0,
        damping=0.02,
        constraints=constraints,
        actuation=["joint1"],
        gravity=False,
    )
    moved = vp.assemble(sprung, q0 + 0.02 * np.arange(robot.dof))
    return sprung, moved


@pytest.mark.parametrize("inputs", [False, True], ids=["free", "held"])
@pytest.mark.parametrize(("integrator", "dt", "told"), [
    (vp.Midpoint(), 1e-3, True), (vp.Gauss(2), 4e-3, True), (vp.Gauss(3), 1e-3, False),
], ids=str)  # fmt: skip
def test_a_loop_on_springs_is_told_when_it_loses_phase(inputs, integrator, dt, told):
    """Against the same loop by Gauss(4) in small steps."""
    scene, q0 = _loop_on_springs(inputs)
    given = {"duration": 2.0, "check": True}
    motion = vp.simulate(scene, q0, np.zeros(q0.size), dt=dt, integrator=integrator, **given)
    exact = vp.simulate(scene, q0, np.zeros(q0.size), dt=1e-3, integrator=vp.Gauss(4), duration=2.0, check=False)
    off = np.abs(motion.q - exact.q[:: round(dt / 1e-3)]).max()
    share = off / np.ptp(exact.q, axis=0).max()
    lost = phase_lost(scene, integrator, motion)
    assert (share > 0.02) == told
    assert (lost is not None) == told
    assert bool(about(motion.warnings, "phase")) == told
    if told:
        assert lost.off == pytest.approx(off, rel=0.35)


@pytest.mark.parametrize(("seed", "told"), [(64, True), (92, False)])
def test_what_is_told_is_the_error_of_the_motion(seed, told):
    """Servos of two links: the estimate is 1.6 and 1.9 times the error, of which one is above the threshold."""
    rng, robot = np.random.default_rng(seed), vp.planar_chain(2)
    q0 = rng.uniform(-1.0, 1.0, 2)
    inertia = np.diag(vp.lagrangian_jet(vp.Scene(robot), q0, np.zeros(2)).Lvv)
    rate, ratio = rng.uniform(10.0, 120.0), rng.choice([0.05, 0.3, 0.7, 1.0])
    scene = vp.Scene(robot, forces=[vp.PositionServo(inertia * rate**2, 2.0 * ratio * inertia * rate)])
    dt = rng.choice([0.1, 0.2, 0.4, 0.8]) / rate
    steps, goal = int(rng.uniform(0.3, 2.0) / dt) + 8, q0 + rng.uniform(-0.5, 0.5, 2)
    start = {"q0": q0, "v0": np.zeros(2), "controls": goal}
    motion = vp.simulate(scene, **start, dt=dt, steps=steps, integrator=vp.Midpoint())
    fine = vp.simulate(scene, **start, dt=dt / 16, steps=16 * steps, integrator=vp.Gauss(5), check=False).q[::16]
    off = np.abs(motion.q - fine).max() / np.ptp(fine, axis=0).max()
    assert phase_lost(scene, vp.Midpoint(), motion).share > 1.4 * off
    found = about(motion.warnings, "phase")
    assert bool(found) == told == (off > 0.01)
    if told:
        percent = float(found[0].split("% of the largest joint travel")[0].split()[-1])
        assert percent == pytest.approx(100.0 * off, rel=0.05)


def test_oscillations_under_noise_lose_phase_as_others_do():
    """One joint on a spring, under the forces of its noise, against finer steps."""
    rate, robot = 100.0, vp.planar_chain(1)
    inertia = vp.lagrangian_jet(vp.Scene(robot), np.zeros(1), np.zeros(1)).Lvv[0, 0]
    scene = vp.Scene(robot, gravity=False, stiffness=inertia * rate**2, noise=vp.AdditiveNoise(inertia))
    for dt, told in ((2e-3, True), (2e-4, False)):
        motion = vp.simulate(scene, [0.1], [0.0], dt=dt, duration=1.0, rng=0)
        held = np.repeat(inertia * motion.dw / dt, 8, axis=0)
        plain = vp.Scene(robot, gravity=False, stiffness=inertia * rate**2)
        fine = {"dt": dt / 8, "steps": 8 * motion.steps, "integrator": vp.Gauss(4), "check": False}
        true = vp.simulate(plain, [0.1], [0.0], controls=held, **fine).q[::8]
        assert (np.abs(motion.q - true).max() > 0.01 * np.ptp(true)) == told
        assert bool(about(motion.warnings, "phase")) == told
