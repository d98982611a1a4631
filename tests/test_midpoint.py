"""The midpoint integrator against exact solutions, a plain version of itself, and what its structure promises."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
import scipy.linalg
from refusals import refused, unnamed

import varpin as vp
from varpin.model.example_robot_data import FIXED_BASE

GRAVITY = 9.81


@pytest.mark.parametrize("links", [16, 32, pytest.param(100, marks=pytest.mark.slow)])
def test_long_chains_fall_for_ten_seconds(links):
    motion = vp.simulate(
        vp.Scene(vp.planar_chain(links)),
        np.zeros(links),
        np.zeros(links),
        dt=1e-2,
        steps=1000,
        integrator=vp.Midpoint(),
    )
    evaluations = motion.statistics.jets.sum() + motion.statistics.sweeps.sum()
    assert evaluations / motion.statistics.substeps.sum() <= 6.0
    assert np.abs(motion.energy - motion.energy[0]).max() < 0.05 * GRAVITY * links**2 / 2


def test_without_the_energy_guard_there_are_silent_jumps():
    """What the guard is for: without it runs at coarse steps jump to other branches of solutions."""
    unguarded = vp.Midpoint(guard=vp.Guard(energy_balance=1e12, energy_budget=1e12))
    scene = vp.Scene(vp.planar_chain(2))
    try:
        motion = vp.simulate(scene, np.zeros(2), np.zeros(2), dt=0.1, steps=2000, integrator=unguarded)
    except vp.StepFailure as failure:
        motion = failure.trajectory
    assert np.abs(motion.energy - motion.energy[0]).max() > 20.0 * GRAVITY * 4 / 2


@pytest.mark.parametrize("name", [*(name for name in FIXED_BASE if not name.startswith("bravo7")), "finger"])
def test_few_iterations_from_rest_under_gravity(name):
    robot = vp.load_robot(name)
    tilted = vp.Scene(robot, gravity=[3.0, -5.0, -8.0])
    for scene, q0 in ((vp.Scene(robot), 0.0), (tilted, 0.5)):
        motion = vp.simulate(
            scene, np.full(robot.dof, q0), np.zeros(robot.dof), dt=1e-3, steps=300, integrator=vp.Midpoint()
        )
        assert motion.statistics.newton_iterations.mean() <= 3.0
        assert motion.statistics.residual.max() < 20.0


def test_failure_keeps_what_was_done():
    scene = vp.Scene(vp.planar_chain(3))
    with refused(vp.StepFailure, "dt") as caught:
        vp.simulate(
            scene, np.zeros(3), np.zeros(3), dt=1e-2, steps=1000, controls=np.full(3, 1e6), integrator=vp.Midpoint()
        )
    error = caught.value
    assert error.trajectory.steps == error.step > 0
    assert error.time == pytest.approx(error.step * 1e-2)
    np.testing.assert_array_equal(error.q, error.trajectory.q[-1])
    np.testing.assert_array_equal(error.p, error.trajectory.p[-1])
    assert np.isfinite(error.trajectory.energy).all()
    assert str(error.step) in str(error)
    assert error.reason in str(error)


def test_split_steps_are_reported():
    motion = vp.simulate(
        vp.Scene(vp.planar_chain(3)), np.zeros(3), np.zeros(3), dt=0.1, steps=100, integrator=vp.Midpoint()
    )
    assert motion.statistics.split_steps > 0
    assert not unnamed(repr(motion), str(motion.statistics.split_steps))


def test_branch_margin_bounds_the_smallest_eigenvalue():
    """The recorded margin against dense eigenvalues of M^-1 (M - h^2/4 L_qq / (1 - 1/2)) at the root."""
    scene = vp.Scene(vp.planar_chain(3))
    unguarded = vp.Midpoint(guard=vp.Guard(energy_balance=1e12, energy_budget=1e12))
    rng = np.random.default_rng(0)
    margins = []
    for _ in range(40):
        q, v, dt = rng.uniform(-2, 2, 3), rng.normal(size=3) * 10, rng.uniform(1e-2, 0.1)
        motion = vp.simulate(scene, q, v, dt=dt, steps=1, integrator=unguarded)
        if motion.statistics.split_steps:
            continue
        jet = vp.lagrangian_jet(scene, 0.5 * (motion.q[0] + motion.q[1]), (motion.q[1] - motion.q[0]) / dt)
        smallest = scipy.linalg.eigh(jet.Lvv - dt**2 / 2 * jet.Lqq, jet.Lvv, eigvals_only=True)[0]
        assert 0.0 < smallest <= motion.statistics.branch_margin[0] * (1.0 + 1e-2)
        margins.append(smallest)
    assert min(margins) < 0.5
    assert len(margins) > 20


def test_interruption_keeps_what_was_done():
    scene = vp.Scene(vp.planar_chain(3))

    def stop(done, total):
        if done > 20_000:
            raise KeyboardInterrupt

    with pytest.raises(vp.Interrupted) as caught:
        vp.simulate(scene, np.zeros(3), np.zeros(3), dt=1e-3, steps=100_000, progress=stop, integrator=vp.Midpoint())
    done = caught.value.trajectory
    assert 20_000 < done.steps < 100_000
    whole = vp.simulate(scene, np.zeros(3), np.zeros(3), dt=1e-3, steps=done.steps, integrator=vp.Midpoint())
    np.testing.assert_array_equal(done.q, whole.q)


@pytest.mark.parametrize("alpha", [0.0, 0.25, 0.45, 0.75, 1.0])
@pytest.mark.parametrize("dt", [0.01, 0.05, 0.2])
def test_no_silent_energy_jump_off_the_middle(alpha, dt):
    scene = vp.Scene(vp.planar_chain(3))
    motion = vp.simulate(
        scene, np.zeros(3), np.zeros(3), dt=dt, steps=int(100 / dt), integrator=vp.Midpoint(alpha=alpha)
    )
    assert np.abs(motion.energy - motion.energy[0]).max() < 0.2 * GRAVITY * 9 / 2


def test_a_heavy_part_does_not_hide_a_light_one():
    """A slider of 1000 kg falls beside three links of 1 kg: the links' own energy is kept as if they were alone."""
    chain = vp.planar_chain(3)
    model = chain.model.copy()
    joint = model.addJoint(0, pin.JointModelPZ(), pin.SE3.Identity(), "slide")
    model.appendBodyToJoint(joint, pin.Inertia.FromSphere(1000.0, 0.1), pin.SE3.Identity())
    both = vp.Scene(vp.load_robot(model))
    assert both.robot.joint_names[-1] == "slide"
    motion = vp.simulate(both, np.zeros(4), np.zeros(4), dt=0.1, steps=200, integrator=vp.Midpoint())
    alone = vp.Scene(chain)
    jets = [vp.lagrangian_jet(alone, q[:3], v[:3]) for q, v in zip(motion.q, motion.v, strict=True)]
    energy = np.array([jet.Lv @ v[:3] - jet.L for jet, v in zip(jets, motion.v, strict=True)])
    assert np.abs(energy - energy[0]).max() < 0.05 * GRAVITY * 9 / 2


@pytest.mark.parametrize("dt", [0.05, 0.2])
def test_a_constant_torque_is_guarded_like_a_potential(dt):
    """The same physics twice: springs slack at 1.5 rad, and springs slack at 0 and a torque."""
    chain, start = vp.planar_chain(3), (np.zeros(3), np.zeros(3))
    steps = int(200 / dt)
    spring = vp.simulate(
        vp.Scene(chain, stiffness=20.0, rest=1.5), *start, dt=dt, steps=steps, integrator=vp.Midpoint()
    )
    torque = vp.simulate(
        vp.Scene(chain, stiffness=20.0), *start, dt=dt, steps=steps, controls=np.full(3, 30.0), integrator=vp.Midpoint()
    )
    for energy in (spring.energy, torque.energy - 30.0 * torque.q.sum(axis=1)):
        assert np.abs(energy - energy[0]).max() < 0.1 * GRAVITY * 9 / 2
    errors = np.abs(torque.energy - 30.0 * torque.q.sum(axis=1) - torque.energy[0])
    np.testing.assert_allclose(torque.statistics.energy_defect, errors[1:], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("option", "facts"),
    [
        ({"alpha": 1.5}, ("alpha", "[0, 1]", "1.5")),
        ({"tolerance": 0.0}, ("tolerance", "0.0")),
        ({"kick": "right"}, ("kick", "'left'", "'split'", "'right'")),
    ],
)
def test_options_out_of_range(option, facts):
    with refused(vp.InputError, facts):
        vp.Midpoint(**option)


@pytest.mark.parametrize(
    ("option", "facts"),
    [
        ({"branch_margin": 1.0}, ("branch_margin", "[0, 1)", "1")),
        ({"energy_balance": -1.0}, ("energy_balance", "-1.0")),
        ({"energy_budget": np.nan}, ("energy_budget", "nan")),
        ({"max_halvings": 31}, ("max_halvings", "30", "31")),
        ({"max_halvings": 1.5}, ("max_halvings", "1.5")),
    ],
)
def test_options_of_a_guard_out_of_range(option, facts):
    with refused(vp.InputError, facts):
        vp.Guard(**option)


def test_without_a_guard_no_step_is_cut():
    scene = vp.Scene(vp.planar_chain(3))
    start = {"q0": np.zeros(3), "v0": np.full(3, 8.0), "dt": 0.1, "steps": 20}
    guarded = vp.simulate(scene, **start)
    assert guarded.statistics.split_steps > 0
    try:
        plain = vp.simulate(scene, **start, integrator=vp.Midpoint(guard=None))
    except vp.StepFailure as failure:
        plain = failure.trajectory
    assert (plain.statistics.substeps <= 1).all()
    assert np.isinf(plain.statistics.branch_margin).all()


def arm_on(slider):
    """Two joints that turn, and one that slides on them or below them."""
    joints = [pin.JointModelRY(), pin.JointModelRY()]
    joints.insert({"an arm": 2, "a rail": 0}[slider], pin.JointModelPX())
    model, parent = pin.Model(), 0
    for k, joint in enumerate(joints):
        placement = pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.5 * (k > 0)]))
        parent = model.addJoint(parent, joint, placement, f"joint{k}")
        body = pin.Inertia(1.0, np.array([0.05, 0.0, 0.2]), 0.02 * np.eye(3))
        model.appendBodyToJoint(parent, body, pin.SE3.Identity())
    return vp.load_robot(model)


# What a correction leaves is estimated where inertia and gravity alone bend the step equation. Scenes, steps [s], and
# whether corrections go unseen.
UNSEEN = {
    "chain": (lambda: vp.Scene(vp.planar_chain(3)), 5e-4, True),
    "long chain, eliminated": (lambda: vp.Scene(vp.planar_chain(30)), 5e-4, True),
    "springs and dampers": (lambda: vp.Scene(vp.load_robot("ur5"), damping=0.5, stiffness=2.0, rest=0.1), 5e-4, True),
    "on a rail": (lambda: vp.Scene(arm_on("a rail")), 5e-4, True),
    "slider on an arm": (lambda: vp.Scene(arm_on("an arm")), 5e-3, False),
    "friction": (lambda: vp.Scene(vp.planar_chain(3), forces=[vp.CoulombFriction(0.1)]), 5e-3, False),
}


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(2)], ids=str)
@pytest.mark.parametrize("name", UNSEEN)
def test_a_correction_that_leaves_nothing_is_not_looked_at(name, integrator):
    """And the motion is, to rounding, that of steps each of which is looked at until it stagnates."""
    make, dt, unseen = UNSEEN[name]
    scene = make()
    q0 = np.random.default_rng(5).uniform(0.0, 0.5, scene.robot.dof)

    def motion(integrator):
        return vp.simulate(scene, q0, np.zeros_like(q0), dt=dt, steps=100, integrator=integrator, check=False)

    own, seen = motion(integrator), motion(replace(integrator, tolerance=1e-300))
    stages = getattr(integrator, "stages", 1)
    late = own.statistics.sweeps[20:]
    assert np.mean(late == 0) > 0.9 if unseen else np.any(late >= stages)
    assert np.mean(seen.statistics.sweeps >= stages) > 0.9
    for ours, theirs in ((own.q, seen.q), (own.p, seen.p)):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=2e-13 * np.abs(theirs).max())
