"""Numerical limits: far from the origin, after many turns, light on heavy, coarse, stiff and badly conditioned."""

import numpy as np
import pinocchio as pin
import pytest
from mechanisms import built, joint, link, mimic, random_tree, rod_chain, write_urdf
from oracles import assert_same_jet

import varpin as vp

GRAVITY = 9.81
EPS = np.finfo(float).eps


def rod(mass=1.0):
    return pin.Inertia(mass, np.array([0.5, 0.0, 0.0]), np.diag([0.0, mass / 12.0, mass / 12.0]))


def carriage(mass):
    return pin.Inertia.FromSphere(mass, 0.1)


def test_sliders_on_sliders_keep_their_digits_far_out():
    gantry = built(
        (pin.JointModelPX(), [0, 0, 0], carriage(3.0)),
        (pin.JointModelPY(), [0, 0, 5e3], carriage(2.0)),
        (pin.JointModelPZ(), [0, 0, 0], carriage(1.0)),
        (pin.JointModelRY(), [0.1, 0, 0], rod()),
        (pin.JointModelRZ(), [1.0, 0, 0], rod()),
    )
    scene = vp.Scene(gantry)
    q, v = np.array([0.0, 0.0, 0.0, 0.7, -0.4]), np.array([0.3, -2.0, 1.0, 3.0, -1.0])
    near = vp.lagrangian_jet(scene, q, v)
    far = vp.lagrangian_jet(scene, q + np.array([1e6, -3e6, 2e6, 0.0, 0.0]), v)
    assert_same_jet(far, near, rtol=1e-14)


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(2)])
def test_a_million_turns_change_nothing(integrator):
    scene, turns = vp.Scene(vp.planar_chain(2)), 2.0 * np.pi * 2.0**20
    home, away = (
        vp.simulate(scene, start, [0.0, 0.0], dt=1e-2, steps=100, integrator=integrator)
        for start in ([0.0, 0.0], [turns, -turns])
    )
    # What doubles near 6.6e6 can say of the start is all there is to lose, and the motion spreads it.
    np.testing.assert_allclose(away.p, home.p, rtol=0, atol=2e-6)
    np.testing.assert_allclose(away.q - [turns, -turns], home.q, rtol=0, atol=2e-6)
    assert away.statistics.residual.max() < 10.0
    assert np.abs(away.energy - home.energy).max() < 1e-6


def test_angles_are_continuous_over_turns():
    """A wheel at 300 rad/s without any force: q = v t, whatever turns are taken off inside."""
    scene = vp.Scene(vp.planar_chain(1), gravity=False)
    motion = vp.simulate(scene, [0.1], [300.0], dt=1e-2, steps=20_000)
    np.testing.assert_allclose(motion.q[:, 0], 0.1 + 300.0 * motion.t, rtol=4 * EPS)


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(2), vp.Gauss(3)])
@pytest.mark.parametrize("up", [False, True])
def test_mass_ratio_of_a_million(up, integrator):
    masses = np.logspace(0, 6, 20)
    scene = vp.Scene(rod_chain([1.0] * 20, masses if up else masses[::-1]))
    motion = vp.simulate(scene, np.zeros(20), np.zeros(20), dt=1e-3, steps=100, integrator=integrator)
    work = motion.statistics
    whole = work.substeps == 1
    assert whole.any()
    assert work.newton_iterations[whole].max() <= 10
    assert work.residual.max() < 10.0


@pytest.mark.parametrize("product", [1e-3, 0.1, 1.0, 2.4, 10.0, 1e2, pytest.param(1e3, marks=pytest.mark.slow), 1e4])
@pytest.mark.parametrize("how", ["springs", "dampers", "both"])
def test_stiff_finger_is_solved_or_refused(how, product):
    robot, q, dt = vp.load_robot("finger"), np.array([0.5, 0.3, 0.2]), 1e-3
    M = np.diag(vp.lagrangian_jet(vp.Scene(robot, gravity=False), q, np.zeros(3)).Lvv)
    options = {}
    if how != "dampers":
        options["stiffness"] = (product / dt) ** 2 * M
    if how != "springs":
        options["damping"] = product / dt * M
    scene = vp.Scene(robot, gravity=(0.0, -GRAVITY, 0.0), **options)
    try:
        # Springs that turn by a thousand radians in a step are solved in thousands of parts of it.
        motion = vp.simulate(scene, q, np.zeros(3), dt=dt, steps=20 if how == "springs" and product > 10.0 else 500)
    except vp.StepFailure as failure:
        motion = failure.trajectory
        # Only springs that turn by a radian and more in a step have no root near by.
        assert how != "dampers"
        assert product >= 1.0
    for values in (motion.q, motion.v, motion.p, motion.energy):
        assert np.isfinite(values).all()
    assert motion.energy.max() <= motion.energy[0] + 0.05 * abs(motion.energy[0])


def carousel(links, inertia=1e6):
    """Light links on hinges, 1 m from the axis of a heavy wheel."""
    wheel = pin.Inertia(1.0, np.zeros(3), inertia * np.eye(3))
    hinges = ((pin.JointModelRY(), [1.0, 0, 0], rod()) for _ in range(links))
    return built((pin.JointModelRZ(), [0, 0, 0], wheel), *hinges)


@pytest.mark.parametrize("ratio", [1.0, -2.5])
@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(2)], ids=str)
def test_a_light_part_on_a_joint_that_follows_has_a_sound_balance(integrator, ratio, tmp_path):
    """A gram on a link of 10 kg that turns two and a half times as fast as what it rides on, the other way round."""
    inertial = (
        '<inertial><mass value="{m}"/><origin xyz="0.3 0 0"/>'
        '<inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial>'
    )
    links = [link(name, inertial.format(m=m, i=i)) for name, m, i in (("a", 10, 1), ("b", 10, 1), ("c", 1e-3, 1e-4))]
    joints = [
        joint("first", "base", "a", kind="continuous"),
        joint("second", "a", "b", kind="continuous", inside=mimic("first", ratio)),
        joint("light", "b", "c", kind="continuous"),
    ]
    robot = vp.load_robot(write_urdf(tmp_path, *links, *joints))
    assert robot.tree.carried.tolist() == [[0, 1]]
    motion = vp.simulate(vp.Scene(robot), [0.3, 0.5], [1.0, -2.0], dt=1e-3, steps=20, integrator=integrator)
    assert motion.statistics.split_steps == 0


@pytest.mark.parametrize("dt", [0.05, 0.1, 0.2])
def test_a_heavy_wheel_does_not_hide_what_it_carries(dt):
    scene, rate = vp.Scene(carousel(2)), 0.5
    assert scene.robot.tree.carried.tolist() == [[0, 1, 1]]
    motion = vp.simulate(scene, np.zeros(3), [rate, 0.0, 0.0], dt=dt, steps=2000)
    energies = []
    for q, v in zip(motion.q[::5], motion.v[::5], strict=True):
        relative = np.array([0.0, v[1], v[2]])
        jet = vp.lagrangian_jet(scene, q, relative)
        energies.append(relative @ jet.Lvv @ relative - jet.L - 0.5 * rate**2 * jet.Lvv[0, 0])
    unit = GRAVITY * 4 / 2
    assert np.abs(np.array(energies) - energies[0]).max() < 0.1 * unit


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(2)], ids=str)
def test_light_parts_that_slide_and_turn_have_sound_balances(integrator):
    rng, parts = np.random.default_rng(0), 0
    for seed in range(40):
        robot = vp.load_robot(random_tree(seed, 2 + seed % 4, armature=False, ratio=1e-6))
        parts += robot.tree.loads.size
        scene, n = vp.Scene(robot, gravity=6.0 * rng.normal(size=3), damping=1e-6), robot.dof
        q, v = rng.uniform(-1.0, 1.0, (2, n))
        motion = vp.simulate(scene, q, v, dt=1e-3, steps=20, integrator=integrator)
        assert motion.statistics.split_steps == 0
    assert parts > 20


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(2)], ids=str)
@pytest.mark.parametrize("rate", [1.0, 2.5, 10.0])
def test_what_dies_out_ends_at_rest(integrator, rate):
    scene = vp.Scene(vp.planar_chain(1), gravity=False, damping=rate * 100.0 / 3.0)
    motion = vp.simulate(scene, [0.0], [100.0], dt=1e-2, steps=2000, integrator=integrator)
    assert abs(motion.v[-1, 0]) < 1e-280
    assert motion.q[-1, 0] == pytest.approx(1.0 / rate, rel=1e-9)


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(2), vp.Radau(2)], ids=str)
@pytest.mark.parametrize(
    ("options", "controls", "end"),
    [
        ({"stiffness": 100.0, "damping": 10.0, "rest": 0.25}, None, 0.25),
        ({"forces": [vp.PositionServo(500.0, 30.0)]}, [1.0], 1.0),
    ],
    ids=["spring", "servo"],
)
def test_what_dies_out_away_from_zero_ends_at_rest(integrator, options, controls, end):
    """Where rounding of q and of the forces that cancel moves more than there is left."""
    scene = vp.Scene(vp.planar_chain(1), gravity=False, **options)
    motion = vp.simulate(scene, [0.0], [0.0], dt=5e-3, steps=4000, controls=controls, integrator=integrator)
    assert motion.q[-1, 0] == pytest.approx(end, abs=1e-14)
    assert abs(motion.v[-1, 0]) < 1e-13
    assert motion.statistics.split_steps == 0
