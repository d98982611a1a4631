"""What a finished motion says of itself."""

from __future__ import annotations

import dataclasses
import logging
import math

import numpy as np
import pinocchio as pin
import pytest
from findings import about
from refusals import unnamed

import varpin as vp
from varpin.core import fastest_damping
from varpin.integrators import explicit, variational
from varpin.integrators.base import open_loop
from varpin.mechanics.wiener import wiener_increments
from varpin.model.chain import rod_chain
from varpin.simulation import limits
from varpin.simulation.accuracy import CLOSE, WRONG_MOTION, WRONG_POSITION, WRONG_VELOCITY, Window, examined_nodes
from varpin.simulation.chatter import alternation
from varpin.simulation.clearance import clearly_right
from varpin.simulation.retaking import shortest_parts, taken_again
from varpin.simulation.soundness import (
    CAUTION,
    LEAST_WORK,
    WORK,
    Finding,
    alternating,
    announce,
    energy_defects,
    energy_scale,
    examined,
    is_wrong,
    motion_error,
    resolution_of,
)

ROD = rod_chain([1.0], [1.0])
EXPLICIT = (vp.ExplicitEuler(), vp.SemiImplicitEuler(), vp.RungeKutta4())


def oscillator(h_omega, integrator, steps=100, dt=1e-2, check=True):
    """A rod on a spring, released: h_omega [rad] a step."""
    scene = vp.Scene(ROD, gravity=False, stiffness=(h_omega / dt) ** 2 / 3.0)
    return scene, vp.simulate(scene, [0.5], [0.0], dt=dt, steps=steps, integrator=integrator, check=check)


@pytest.mark.parametrize(
    ("integrator", "formula"),
    [
        # Over a period of q'' = -w^2 q, in units of the way to and fro: what the amplitude gains; what the phase loses,
        # by 2 pi z^2 / 12, at its worst a quarter before the end.
        (vp.ExplicitEuler(), lambda z: math.pi * z / 2),
        (vp.Midpoint(), lambda z: 0.75 * math.tau * z**2 / 24),
    ],
    ids=["Euler", "Midpoint"],
)
def test_the_error_of_a_motion_is_what_theory_says(integrator, formula):
    for z in (0.02, 0.05, 0.1):
        scene, motion = oscillator(z, integrator, steps=round(math.tau / z))
        error = motion_error(scene, integrator, motion).position
        assert 0.5 * formula(z) < error < 2.0 * formula(z)


@pytest.mark.parametrize(
    "integrator", [*EXPLICIT, vp.Midpoint(), vp.Midpoint(alpha=0.0), vp.Gauss(stages=2), vp.Gauss(stages=4)], ids=str
)
def test_steps_that_do_not_resolve_the_motion_are_spoken_of(integrator, caplog):
    with caplog.at_level(logging.WARNING, "varpin"):
        _, motion = oscillator(1e-3, integrator, steps=200)
        assert motion.warnings == ()
        assert not caplog.records
        _, motion = oscillator(1.9 if integrator.order < 6 else 6.0, integrator)
    assert about(motion.warnings, "coarse steps")
    assert [record.getMessage() for record in caplog.records] == list(motion.warnings)


@pytest.mark.parametrize(
    "integrator",
    [vp.ExplicitEuler(), vp.SemiImplicitEuler(), vp.RungeKutta4(), vp.Midpoint(), vp.Midpoint(0.0), vp.Gauss(2)],
    ids=str,
)
def test_where_it_matters_an_error_is_known_to_a_tenth(integrator):
    """A period of an oscillator against its closed form, around what is wrong; what is said begins just below that."""
    judged = 0
    for z in np.geomspace(2.0, 1e-2, 20):
        steps = max(1, round(math.tau / z))
        scene, motion = oscillator(z, integrator, steps=steps, check=False)
        t, error = np.arange(steps + 1), motion_error(scene, integrator, motion)
        q = np.abs(motion.q[:, 0] - 0.5 * np.cos(z * t)).max() / np.ptp(motion.q) / WRONG_MOTION
        v = np.abs(motion.v[:, 0] + 0.5 * z / motion.dt * np.sin(z * t)).max() / np.abs(motion.v).max() / WRONG_VELOCITY
        if 0.4 < error.worst < 2.5:
            judged += 1
            assert error.worst == pytest.approx(max(q, v), rel=0.1)
            assert error.settled
            assert is_wrong(error) == (error.worst > CAUTION)
    assert judged


@pytest.mark.parametrize("integrator", EXPLICIT, ids=str)
def test_energy_balance_of_explicit_methods(integrator):
    # Driven, damped and noisy: what is left is the method's own error, and goes with its order.
    scene = vp.Scene(rod_chain([1.0] * 2, [1.0] * 2), damping=0.3, noise=vp.AdditiveNoise(0.2))
    off = []
    for steps in (400, 1600):
        rng = np.random.default_rng(0).normal(size=(1600, 2)) * math.sqrt(1.0 / 1600)
        motion = vp.simulate(
            scene,
            np.zeros(2),
            np.zeros(2),
            dt=1.0 / steps,
            steps=steps,
            controls=np.array([2.0, -1.0]),
            increments=rng.reshape(steps, -1, 2).sum(axis=1),
            integrator=integrator,
        )
        np.testing.assert_array_equal(motion.statistics.energy_defect, energy_defects(scene, integrator, motion))
        off.append(np.abs(motion.statistics.energy_defect).max())
    # Forces, dampers and kicks account for most of what the energy does, and for all of it as dt shrinks.
    assert off[1] < 0.1 * np.abs(motion.energy - motion.energy[0]).max()
    assert off[1] < 0.4 * off[0]


def test_a_slider_that_is_far_and_fast_does_not_hide_a_hinge():
    """Metres per second and radians per second do not compare: what turns is judged by what turns."""
    model = pin.Model()
    for k, kind in enumerate((pin.JointModelRY(), pin.JointModelPX())):
        joint = model.addJoint(0, kind, pin.SE3.Identity(), f"joint{k}")
        model.appendBodyToJoint(joint, pin.Inertia(1.0, np.array([0.5, 0.0, 0.0]), 0.1 * np.eye(3)), pin.SE3.Identity())
    scene = vp.Scene(vp.load_robot(model))
    for integrator, coarse in ((vp.ExplicitEuler(), True), (vp.Gauss(3), False)):
        calm, fast = (
            vp.simulate(scene, np.zeros(2), [0.0, speed], dt=0.05, steps=20, integrator=integrator)
            for speed in (0.0, 1e6)
        )
        said = [bool(about(motion.warnings, "coarse steps")) for motion in (calm, fast)]
        assert said == [coarse, coarse]


def test_energy_that_drifts_is_spoken_of():
    motion = vp.simulate(vp.Scene(ROD), [1.0], [0.0], dt=1e-3, steps=20_000, integrator=vp.ExplicitEuler())
    (sentence,) = motion.warnings
    drift = np.abs(motion.energy - motion.energy[0]).max()
    assert about(sentence, "energy")
    assert not unnamed(sentence, f"{drift:.3g} J")
    assert np.abs(motion.statistics.energy_defect).max() == pytest.approx(drift)
    assert vp.simulate(vp.Scene(ROD), [1.0], [0.0], dt=1e-3, steps=20_000).warnings == ()


def test_nothing_is_said_of_a_robot_at_rest():
    for integrator in (vp.Midpoint(), *EXPLICIT):
        for q in (0.5 * math.pi, -0.5 * math.pi):
            assert vp.simulate(vp.Scene(ROD), [q], [0.0], dt=0.01, steps=100, integrator=integrator).warnings == ()
    assert vp.simulate(vp.Scene(ROD), [0.0], [0.0], dt=0.01, steps=0).warnings == ()


def test_warnings_survive_the_disk(tmp_path):
    _, motion = oscillator(1.5, vp.Midpoint())
    assert motion.warnings
    assert vp.Trajectory.load(motion.save(tmp_path / "motion.npz")).warnings == motion.warnings


def test_an_interrupted_motion_tells_too():
    def interrupt(done, steps):
        raise KeyboardInterrupt

    with pytest.raises(vp.Interrupted) as caught:
        vp.simulate(vp.Scene(ROD), [0.0], [0.0], dt=0.3, steps=100_000, progress=interrupt, integrator=EXPLICIT[1])
    assert caught.value.trajectory.warnings


def test_a_loop_logs_each_kind_of_warning_once_for_a_scene_and_a_step(caplog):
    def logged(scene, dt, times):
        caplog.clear()
        with caplog.at_level(logging.WARNING, logger="varpin"):
            options = {"dt": dt, "steps": 20, "integrator": vp.Midpoint()}
            said = [vp.simulate(scene, [1.0], [0.0], **options).warnings for _ in range(times)]
        # The trajectories keep theirs, however often it was logged.
        assert all(about(each, "stiff damping") for each in said)
        return sum("damping is faster" in record.message for record in caplog.records)

    scene = vp.Scene(vp.planar_chain(1), damping=1e3)
    assert logged(scene, 1e-2, 5) == 1
    assert logged(scene, 1e-2, 1) == 0
    assert logged(scene, 2e-2, 1) == 1
    assert logged(vp.Scene(vp.planar_chain(1), damping=1e3), 1e-2, 1) == 1


def test_the_log_has_each_joint_once_whatever_the_numbers(caplog):
    scene = vp.Scene(vp.planar_chain(1))
    found = [Finding("kind", f"{number} of joint {joint}", joint) for number in range(3) for joint in (0, 1, None)]
    logger = logging.getLogger("varpin")
    with caplog.at_level(logging.WARNING, logger="varpin"):
        announce(logger, scene, 1e-2, found)
        announce(logger, scene, 1e-2, found)
    assert [record.message for record in caplog.records] == ["0 of joint 0", "0 of joint 1", "0 of joint None"]


@pytest.mark.parametrize("integrator", EXPLICIT, ids=str)
def test_controls_do_the_work_of_the_way(integrator):
    """A torque that flips at each step: its work is that of the recorded way, by Pinocchio's energies."""
    scene = vp.Scene(vp.planar_chain(2))
    controls = np.where(np.arange(200) % 2 == 0, 60.0, -60.0)[:, None] * np.ones(2)
    motion = vp.simulate(scene, [0.3, 0.3], [0.0, 0.0], dt=2e-3, steps=200, controls=controls, integrator=integrator)
    work = np.cumsum((controls * np.diff(motion.q, axis=0)).sum(axis=1))
    off = motion.energy[1:] - motion.energy[0] - work
    np.testing.assert_allclose(motion.statistics.energy_defect, off, rtol=0, atol=1e-9 * np.abs(off).max() + 1e-12)
    told = bool(about(motion.warnings, "energy"))
    assert told == (integrator.order == 1)


@pytest.mark.parametrize("controls", [None, "constant", "changing"])
@pytest.mark.parametrize("integrator", [*EXPLICIT, vp.Midpoint(), vp.Gauss(4)], ids=str)
def test_what_doubled_steps_agree_with_needs_no_other_look(integrator, controls):
    """It is the motion of DOP853, whose error is far below what is spoken of; and a coarse motion does not pass."""
    scene, t = vp.Scene(vp.planar_chain(2), damping=0.1), np.arange(64) / 64
    rows = {None: None, "constant": np.array([3.0, -1.0]), "changing": np.sin(4.0 * t)[:, None] * [5.0, 2.0]}[controls]
    passed = []
    start = [0.3, 0.2], [0.5, 0.0]
    exact = vp.simulate(scene, *start, dt=1 / 64, steps=64, controls=rows, integrator=vp.Reference(rtol=1e-10))
    for every in (1, 4, 16):
        u = np.repeat(rows, every, axis=0) if controls == "changing" else rows
        options = {"dt": 1.0 / 64 / every, "steps": 64 * every, "controls": u, "check": False}
        motion = vp.simulate(scene, *start, integrator=integrator, **options)
        if resolution_of(scene, integrator, motion).resolved:
            passed.append(every)
            off = np.abs(motion.q[::every] - exact.q).max(axis=0) / np.ptp(exact.q, axis=0)
            assert off.max() < 0.25 * WRONG_POSITION
    assert 16 in passed or integrator.order == 1
    coarse = vp.simulate(scene, [0.3, 0.2], [0.5, 0.0], dt=0.1, steps=20, integrator=vp.ExplicitEuler(), check=False)
    assert not resolution_of(scene, vp.ExplicitEuler(), coarse).resolved


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(3), vp.Gauss(4), vp.Radau(3)], ids=str)
@pytest.mark.parametrize("speed", [0.0, 3.0])
def test_dampers_faster_than_the_step_need_no_other_look_where_they_are_followed(integrator, speed):
    """A chain that creeps down from rest passes with many stages; a speed that they let ring does not."""
    scene, dt, steps = vp.Scene(vp.planar_chain(3), damping=20.0), 0.05, 40
    start = np.array([0.3, 0.2, -0.4]), np.array([0.0, 0.0, speed])
    assert fastest_damping(scene.core, start[0][None], *np.zeros((2, 1, scene.robot.dof)), 2.0 / dt) > 0.0
    exact = vp.simulate(scene, *start, dt=dt, steps=steps, integrator=vp.Reference(rtol=1e-10))
    motion = vp.simulate(scene, *start, dt=dt, steps=steps, integrator=integrator, check=False)
    off = np.abs(motion.v - exact.v).max(axis=0) / np.abs(exact.v).max(axis=0)
    assert resolution_of(scene, integrator, motion).resolved == (speed == 0.0 and integrator.order > 2)
    assert not resolution_of(scene, integrator, motion).resolved or off.max() < 0.5 * WRONG_VELOCITY


@pytest.mark.parametrize(
    ("integrator", "right"), [(vp.Radau(3), True), (vp.Radau(4), True), (vp.Midpoint(), False)], ids=str
)
def test_jumping_torques_on_a_damped_chain_need_no_other_look_where_they_are_followed(monkeypatch, integrator, right):
    """Doubled steps share two torques and tell nothing; a better method in steps as long does."""
    scene, dt, steps = vp.Scene(vp.planar_chain(3), damping=20.0), 0.02, 120
    u = 10.0 * np.random.default_rng(0).uniform(-1.0, 1.0, (steps, 3))
    start = np.array([0.3, 0.2, -0.4]), np.zeros(3)
    assert fastest_damping(scene.core, start[0][None], *np.zeros((2, 1, 3)), 2.0 / dt) > 0.0
    motion = vp.simulate(scene, *start, dt=dt, steps=steps, controls=u, integrator=integrator, check=False)
    fine = vp.simulate(
        scene, *start, dt=dt / 8, steps=8 * steps, controls=np.repeat(u, 8, axis=0), integrator=vp.Radau(4), check=False
    )
    off_q = (np.abs(motion.q - fine.q[::8]).max(axis=0) / np.ptp(fine.q, axis=0)).max()
    off_v = (np.abs(motion.v - fine.v[::8]).max(axis=0) / np.abs(fine.v).max(axis=0)).max()
    assert (off_q < 0.5 * WRONG_POSITION and off_v < WRONG_VELOCITY) == right
    assert resolution_of(scene, integrator, motion).resolved == right
    if right:
        monkeypatch.setattr("varpin.simulation.soundness.motion_error", None)
        assert not vp.simulate(scene, *start, dt=dt, steps=steps, controls=u, integrator=integrator).warnings


@pytest.mark.parametrize(("turn", "stages", "right"), [(1.2, 2, False), (1.2, 4, True), (40.0, 4, False)])
def test_a_spring_faster_than_the_step_needs_no_other_look_where_it_is_followed(turn, stages, right):
    scene, motion = oscillator(turn, vp.Gauss(stages), steps=60)
    seen = resolution_of(scene, vp.Gauss(stages), motion)
    assert seen.resolved == right
    exact = 0.5 * np.cos(turn * np.arange(61))
    assert not seen.in_phase or np.abs(motion.q[:, 0] - exact).max() < 0.01


@pytest.mark.parametrize("steps", [2, 3, 8, 9])
def test_a_motion_that_one_window_has_all_of_is_looked_at(steps):
    scene, motion = oscillator(1.2, vp.Gauss(4), steps=steps)
    assert resolution_of(scene, vp.Gauss(4), motion).resolved


@pytest.mark.parametrize("frozen", [{"stiffness": 3e7}, {"damping": 1e7}, {"gravity": [0.0, 0.0, -1e8]}])
def test_what_stands_still_in_any_step_is_not_taken_for_resolved(frozen):
    """Modes far faster than the step hardly move with an even number of stages, in two steps or in one."""
    scene = vp.Scene(ROD, **({"gravity": False} | frozen))
    for stages in (2, 4):
        motion = vp.simulate(scene, [0.5], [0.1], dt=1e-2, steps=50, integrator=vp.Gauss(stages), check=False)
        assert not resolution_of(scene, vp.Gauss(stages), motion).resolved


def test_velocities_that_alternate_in_smaller_steps_too_are_the_robots_own():
    """A spring that turns by nearly half a turn a step: resolved by four stages it alternates, and that is right."""
    for integrator, right in ((vp.Gauss(4), True), (vp.Midpoint(), False)):
        scene, motion = oscillator(3.0, integrator, steps=12)
        exact = 0.5 * np.cos(3.0 * np.arange(13))
        assert (np.abs(motion.q[:, 0] - exact).max() < 0.01) == right
        assert alternation(motion.v) is not None or not right
        assert bool(alternating(scene, integrator, motion)) <= (not right)
        assert (motion.warnings == ()) == right


def test_a_single_bad_step_is_found():
    """One step of a long motion is off, where nothing is violent: its energy tells where to look."""
    scene, steps = vp.Scene(ROD), 4000
    motion = vp.simulate(scene, [0.3], [0.0], dt=1e-3, steps=steps)
    assert motion.warnings == ()
    later = vp.simulate(scene, motion.q[2501] + 0.15, motion.v[2501], dt=1e-3, steps=steps - 2501)
    energy = np.concatenate([motion.energy[:2501], later.energy])
    broken = dataclasses.replace(
        motion,
        q=np.concatenate([motion.q[:2501], later.q]),
        v=np.concatenate([motion.v[:2501], later.v]),
        p=np.concatenate([motion.p[:2501], later.p]),
        energy=energy,
        statistics=dataclasses.replace(motion.statistics, energy_defect=energy[1:] - energy[0]),
    )
    error = motion_error(scene, vp.Midpoint(), broken)
    assert error.step == 2500
    assert error.worst > 1.0


def test_where_errors_come_close_to_wrong_one_looks_closer(monkeypatch):
    """At evenly spread nodes that were not looked from; nowhere else, and not where errors are small."""
    looked = []

    def spy(scene, trajectory, step, at=Window.at):
        looked.append(step)
        return at(scene, trajectory, step)

    monkeypatch.setattr(Window, "at", spy)
    for z, close in ((0.05, False), (0.15, True)):
        scene, motion = oscillator(z, vp.SemiImplicitEuler(), steps=640, check=False)
        usual = examined_nodes(scene, motion)
        looked.clear()
        error = motion_error(scene, vp.SemiImplicitEuler(), motion)
        assert CLOSE < error.worst < CAUTION if close else error.worst < CLOSE
        more = np.setdiff1d(looked, usual)
        assert len(more) >= 10 if close else len(more) == 0
        assert np.diff([0, *sorted(looked[-len(more) :]), 640]).max() <= 640 / 15 + 64 or not close


def spindled(kind, *, spindle=True):
    """Two links of half a metre and a kilogram, and a spindle of 0.2 kg at their end."""
    model, joint = pin.Model(), 0
    for k in range(2):
        place = pin.SE3(np.eye(3), np.array([0.5 * (k > 0), 0.0, 0.0]))
        joint = model.addJoint(joint, pin.JointModelRY(), place, f"arm{k}")
        body = pin.Inertia(1.0, np.array([0.25, 0.0, 0.0]), np.diag([1e-3, 0.02, 0.02]))
        model.appendBodyToJoint(joint, body, pin.SE3.Identity())
    if spindle:
        joint = model.addJoint(joint, kind(), pin.SE3(np.eye(3), np.array([0.5, 0.0, 0.0])), "spindle")
        body = pin.Inertia(0.2, np.zeros(3), 1e-4 * np.eye(3))
        model.appendBodyToJoint(joint, body, pin.SE3.Identity())
    return vp.Scene(vp.load_robot(model))


@pytest.mark.parametrize("kind", [pin.JointModelRY, pin.JointModelRX], ids=["along", "across"])
def test_a_spindle_hides_nothing(kind):
    """What turns evenly at 3000 rad/s is far and fast, and has most of the energy; the arm's motion is told of."""
    scene, start = spindled(kind), ([0.3, 0.2, 0.0], [0.0, 0.0, 3000.0])
    exact = vp.simulate(scene, *start, dt=0.01, steps=100, integrator=vp.Reference(rtol=1e-9))
    for integrator, wrong in ((vp.ExplicitEuler(), True), (vp.RungeKutta4(), False), (vp.Midpoint(), False)):
        motion = vp.simulate(scene, *start, dt=0.01, steps=100, integrator=integrator)
        off = (np.abs(motion.q - exact.q).max(axis=0) / np.ptp(exact.q, axis=0))[:2].max()
        assert (off > 0.5) if wrong else (off < 0.01)
        assert any("'arm" in sentence for sentence in about(motion.warnings, "coarse steps")) == wrong
        if not wrong:
            assert motion.warnings == ()


def test_even_turning_turns_over_nothing():
    """Not the wheel's energy is what the arm's errors are measured by."""
    arm = np.array([0.3, 0.2])
    scales = []
    for spindle in (True, False):
        scene, extra = spindled(pin.JointModelRX, spindle=spindle), spindle * [0.0]
        motion = vp.simulate(scene, [*arm, *extra], [0.0, 0.0, *(spindle * [3000.0])], dt=1e-3, steps=500)
        scales.append(energy_scale(scene, motion))
        kinetic = 0.5 * (motion.p * motion.v).sum(axis=1).max()
    assert scales[0] < 3.0 * scales[1] < 1.05 * 3.0 * kinetic
    # 450 J in the wheel, some joules in the arm.
    assert scales[0] < 30.0


@pytest.mark.parametrize("name", ["ur5", "panda"])
def test_a_fast_joint_of_any_robot_hides_nothing(load, name):
    """A joint near the end of an arm at 50 rad/s: the others are judged as without it."""
    robot = load(name)
    scene, n = vp.Scene(robot), robot.dof
    q0, v0 = np.full(n, 0.3), np.zeros(n)
    calm = vp.simulate(scene, q0, v0, dt=0.02, steps=40, integrator=vp.ExplicitEuler())
    v0[5 if name == "ur5" else 6] = 50.0
    fast = vp.simulate(scene, q0, v0, dt=0.02, steps=40, integrator=vp.ExplicitEuler(), check=False)
    error = motion_error(scene, vp.ExplicitEuler(), fast)
    assert about(calm.warnings, "coarse steps")
    assert error.worst > 1.0


def test_a_mechanism_of_its_own_hides_nothing():
    """A heavy wheel beside a pendulum, both on the ground: the pendulum's energy drifts, period by period unseen."""
    model = pin.Model()
    for name, inertia in (
        ("wheel", pin.Inertia(1e3, np.zeros(3), 1e4 * np.eye(3))),
        ("rod", pin.Inertia(1.0, np.array([0.5, 0.0, 0.0]), np.diag([1e-3, 1 / 12, 1 / 12]))),
    ):
        joint = model.addJoint(0, pin.JointModelRY(), pin.SE3.Identity(), name)
        model.appendBodyToJoint(joint, inertia, pin.SE3.Identity())
    scene = vp.Scene(vp.load_robot(model))
    # The wheel is pushed to and fro.
    push = 1e5 * np.sin(2.0 * np.arange(20_000) * 1e-3)
    controls = np.column_stack([push, np.zeros(20_000)])
    motion = vp.simulate(
        scene, [0.0, 1.0], [0.0, 0.0], dt=1e-3, steps=20_000, controls=controls, integrator=vp.ExplicitEuler()
    )
    alone = vp.simulate(vp.Scene(ROD), [1.0], [0.0], dt=1e-3, steps=20_000, integrator=vp.ExplicitEuler())
    for warnings in (motion.warnings, alone.warnings):
        assert about(warnings, "energy")


def test_the_work_of_the_controls_is_turned_over():
    """A cart driven evenly against its damper: nothing but work and heat."""
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), "cart")
    model.appendBodyToJoint(joint, pin.Inertia.FromSphere(1.0, 0.1), pin.SE3.Identity())
    scene = vp.Scene(vp.load_robot(model), gravity=False, damping=2.0)
    motion = vp.simulate(scene, [0.0], [3.0], dt=0.01, steps=500, controls=np.array([6.0]))
    np.testing.assert_allclose(motion.v, 3.0)
    # 6 N over 15 m.
    assert energy_scale(scene, motion) == pytest.approx(90.0, rel=1e-3)


def test_a_short_blow_in_a_long_quiet_motion_is_found():
    """Five steps of the thousand are far too coarse: nothing of it shows at the start or at even distances."""
    scene = vp.Scene(vp.planar_chain(2), gravity=False, damping=2.0)
    for at in (537, 611, 903):
        controls = np.zeros((1200, 2))
        controls[at : at + 4] = np.array([[150.0, -150.0], [-150.0, 150.0], [150.0, -150.0], [-150.0, 150.0]])
        motion = vp.simulate(
            scene, [0.0, 0.7], [1e-3, 0.0], dt=0.02, steps=1200, controls=controls, integrator=vp.SemiImplicitEuler()
        )
        quiet = vp.simulate(scene, [0.0, 0.7], [1e-3, 0.0], dt=0.02, steps=1200, integrator=vp.SemiImplicitEuler())
        assert not {*quiet.warnings} - {*about(quiet.warnings, "adding up")}
        error = motion_error(scene, vp.SemiImplicitEuler(), motion)
        assert error.worst > 1.0
        assert at - 100 < error.step <= at + 4


def test_friction_takes_of_the_errors_of_the_energy_too():
    """What the balance of a damped pendulum is off by on its way fades with what is left of its motion."""
    scene = vp.Scene(ROD, damping=0.3)
    motion = vp.simulate(scene, [0.0], [0.0], dt=0.05, steps=300, integrator=vp.Midpoint())
    assert motion.statistics.split_steps == 0
    off = np.abs(motion.statistics.energy_defect)
    assert off.max() > 1e-3
    assert off[-1] < 0.01 * off.max()


@pytest.mark.parametrize("robot", ["chain2", "chain3", "ur5"])
def test_accurate_motions_are_quiet(load, robot):
    """Where DOP853 agrees to a thousandth of each joint's way, nothing is said."""
    known = vp.planar_chain(int(robot[-1])) if robot.startswith("chain") else load(robot)
    n, quiet = known.dof, 0
    for seed, options in enumerate(({}, {"damping": 0.2}, {"gravity": False})):
        rng = np.random.default_rng(seed)
        scene = vp.Scene(known, **options)
        start = rng.uniform(-1.0, 1.0, n), rng.uniform(-1.0, 1.0, n)
        exact = vp.simulate(scene, *start, dt=0.01, steps=50, integrator=vp.Reference(rtol=1e-10))
        for integrator in (vp.Midpoint(), vp.Gauss(2), vp.RungeKutta4(), vp.ExplicitEuler()):
            for every in (1, 5):
                steps = 50 * every
                motion = vp.simulate(scene, *start, dt=0.01 / every, steps=steps, integrator=integrator)
                off = np.abs(motion.q[::every] - exact.q).max(axis=0) / np.ptp(exact.q, axis=0)
                if off.max() < 1e-3:
                    quiet += 1
                    said = [sentence for sentence in motion.warnings if not sentence.startswith(limits.KINDS)]
                    assert not said, (options, integrator, every, off)
    assert quiet >= 6


@pytest.mark.parametrize("robot", ["chain2", "chain3", "ur5"])
def test_wrong_motions_are_told_of(load, robot):
    """Where DOP853 finds any joint off by a fifth of its travel, something is said."""
    known = vp.planar_chain(int(robot[-1])) if robot.startswith("chain") else load(robot)
    n, told = known.dof, 0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        scene = vp.Scene(known)
        start = rng.uniform(-1.0, 1.0, n), rng.uniform(-1.0, 1.0, n)
        exact = vp.simulate(scene, *start, dt=0.05, steps=12, integrator=vp.Reference(rtol=1e-10))
        for integrator in (vp.Midpoint(), vp.ExplicitEuler(), vp.SemiImplicitEuler()):
            try:
                motion = vp.simulate(scene, *start, dt=0.05, steps=12, integrator=integrator)
            except vp.StepFailure:
                continue
            off = np.abs(motion.q - exact.q).max(axis=0) / np.ptp(exact.q, axis=0)
            if off.max() > 0.2:
                told += 1
                said = [sentence for sentence in motion.warnings if not sentence.startswith(limits.KINDS)]
                assert said, (seed, integrator, off)
    assert told >= 1


def test_dampers_that_nothing_excites_are_quiet():
    """A damper far faster than the step, and a motion that it has long stopped or that never began."""
    scene = vp.Scene(ROD, gravity=False, damping=1e3)
    options = {"dt": 1e-2, "steps": 50, "integrator": vp.Midpoint()}
    assert vp.simulate(scene, [1.0], [0.0], **options).warnings == ()
    ringing = vp.simulate(scene, [1.0], [1.0], **options)
    assert about(ringing.warnings, "stiff damping")


def test_parts_of_steps_are_no_reason_to_warn():
    """Three links that whip: a few steps are taken in two parts, and each period is right to a thousandth.

    Over 20 s such motions part all the same.
    """
    scene, rest = vp.Scene(vp.planar_chain(3)), np.zeros(3)
    motion = vp.simulate(scene, rest, rest, dt=0.1, steps=200, integrator=vp.Gauss(4))
    assert motion.statistics.split_steps > 0
    (told,) = motion.warnings
    assert about(told, "growth")
    unchecked = vp.simulate(scene, rest, rest, dt=0.1, steps=200, integrator=vp.Gauss(4), check=False)
    assert about(unchecked.warnings, "steps in parts")


@pytest.fixture
def evaluations(monkeypatch):
    """How often dynamics were evaluated in all rollouts since the last call."""
    made = []
    for module in (explicit, variational):

        def new(*shape, own=module.new_nodes):
            made.append(own(*shape))
            return made[-1]

        monkeypatch.setattr(module, "new_nodes", new)

    def spent():
        total = sum(int(nodes.tally[..., 1:3].sum()) for nodes in made)
        made.clear()
        return total

    return spent


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(2), vp.Gauss(4), vp.RungeKutta4()], ids=str)
@pytest.mark.parametrize("links", [3, 7])
def test_what_a_look_costs(links, integrator, evaluations):
    """Less than the motion where steps resolve it; where they do not, forty times its evaluations at most."""
    scene, rest = vp.Scene(vp.planar_chain(links)), np.zeros(links)
    for steps, most in ((10, 40), (20, 40), (320, 0.9)):
        motion = vp.simulate(scene, rest, rest, dt=1.0 / steps, steps=steps, integrator=integrator, check=False)
        own = int((motion.statistics.jets + motion.statistics.sweeps).sum())
        evaluations()
        examined(scene, integrator, motion)
        spent = evaluations()
        assert spent <= most * own
        # Motions that are clearly right are told without a step.
        assert (spent == 0) == clearly_right(scene, integrator, motion)


def test_the_steps_of_a_look_are_bounded(monkeypatch):
    """Of a motion that is close to wrong everywhere, where all places are looked at."""
    taken = []

    def spy(self, scene, state, commands, *given, own=vp.Gauss.rollout_compiled):
        taken.append(len(commands.u))
        return own(self, scene, state, commands, *given)

    monkeypatch.setattr(variational.Variational, "rollout_compiled", spy)
    # The whole motion is repeated once at most, whatever its parts take.
    monkeypatch.setattr("varpin.simulation.soundness.grown_error", lambda *_, **__: None)
    scene, rest = vp.Scene(vp.planar_chain(7)), np.zeros(7)
    motion = vp.simulate(scene, rest, rest, dt=0.05, steps=20, integrator=vp.RungeKutta4(), check=False)
    for work, least in ((WORK, LEAST_WORK), (4, 10), (0, 5)):
        monkeypatch.setattr("varpin.simulation.soundness.WORK", work)
        monkeypatch.setattr("varpin.simulation.soundness.LEAST_WORK", least)
        taken.clear()
        examined(scene, vp.RungeKutta4(), motion)
        assert len(taken) > (10 if work == WORK else 0)
        assert sum(taken) <= work * 20 + least


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(2), vp.Radau(3), vp.RungeKutta4()], ids=str)
def test_a_single_step_is_held_against_two_of_half_its_length(integrator, evaluations):
    """For the price of those where it resolves the motion; where it does not, that is told."""
    scene, motion = oscillator(1e-3, integrator, steps=1, check=False)
    evaluations()
    assert examined(scene, integrator, motion)[1] == ()
    assert evaluations() <= 3 * int((motion.statistics.jets + motion.statistics.sweeps).sum())
    scene, motion = oscillator(1.5, vp.Midpoint(), steps=1, check=False)
    (found,) = examined(scene, vp.Midpoint(), motion)[1]
    assert about(found.sentence, "coarse steps")


@pytest.mark.parametrize("integrator", EXPLICIT, ids=str)
def test_many_motions_of_an_explicit_method_at_once(integrator):
    scene, rng = vp.Scene(vp.planar_chain(2), damping=0.1), np.random.default_rng(5)
    q0, v0, drift = rng.normal(size=(3, 2)), rng.normal(size=(3, 2)), rng.normal(size=(3, 4, 2))
    q, v = integrator.motions(scene, q0, v0, open_loop(np.zeros((4, 2))), drift, 0.02)
    for i in range(3):
        motion = vp.simulate(scene, q0[i], v0[i], dt=0.02, steps=4, controls=drift[i], integrator=integrator)
        np.testing.assert_array_equal(q[i], motion.q[1:])
        np.testing.assert_array_equal(v[i], motion.v[1:])


def fields(n, by_controls, rng):
    """Noise of n processes across the joints, and more that grows with the controls."""
    return vp.AdditiveNoise(0.1 * rng.normal(size=(n, n))) + (
        vp.ControlNoise(0.1) if by_controls else vp.StateNoise(0.2)
    )


@pytest.mark.parametrize("by_controls", [False, True], ids=["state", "control"])
@pytest.mark.parametrize("kick", ["left", "split"])
def test_impulses_by_hand_are_those_of_the_noise(kick, by_controls):
    """Jumps of the momenta before and after each step make the motion that the noise made, step by step."""
    rng, n, steps = np.random.default_rng(8), 3, 12
    scene = vp.Scene(vp.planar_chain(n), damping=0.1, noise=fields(n, by_controls, rng))
    u = rng.normal(size=(steps, n))
    start = rng.normal(size=(1, n)), rng.normal(size=(1, n))
    for integrator in (vp.Midpoint(kick=kick), vp.Gauss(2, kick=kick), vp.RungeKutta4(), vp.SemiImplicitEuler()):
        left = integrator.left
        motion = vp.simulate(
            scene, start[0][0], start[1][0], dt=0.01, steps=steps, controls=u, integrator=integrator, rng=2, check=False
        )
        jumps = np.empty((1, steps, 2, n))
        for k, (share, node) in enumerate(((left, motion.q[:-1]), (1.0 - left, motion.q[1:]))):
            F = scene.noise.fields(node, np.zeros_like(node), u, motion.q[0]).F
            jumps[0, :, k] = share * np.einsum("Nik,Nk->Ni", F, motion.dw)
        q, v = integrator.motions(scene, *start, open_loop(u), np.zeros((0, 0, n)), 0.01, jumps)
        np.testing.assert_allclose(q[0], motion.q[1:], rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(v[0], motion.v[1:], rtol=0.0, atol=1e-11)


def test_steps_under_constraints_take_no_impulses_by_hand():
    """They would be left out in silence."""
    robot = vp.planar_chain(2)
    scene = vp.Scene(robot, constraints=[vp.JointTie("joint1", "joint2")], noise=vp.AdditiveNoise(0.1))
    start, u, n = (np.zeros((1, 2)), np.zeros((1, 2))), np.zeros((4, 2)), 2
    jumps = np.ones((1, 4, 2, n))
    assert vp.Midpoint().motions(scene, *start, open_loop(u), np.zeros((0, 0, n)), 0.01) is not None
    assert vp.Midpoint().motions(scene, *start, open_loop(u), np.zeros((0, 0, n)), 0.01, jumps) is None


@pytest.mark.parametrize("controls", ["held", "changing", "none"])
@pytest.mark.parametrize(
    "integrator",
    [
        vp.Midpoint(),
        vp.Midpoint(kick="split"),
        vp.Gauss(2),
        vp.Gauss(2, kick="held"),
        vp.Radau(2),
        vp.RungeKutta4(),
        vp.ExplicitEuler(),
    ],
    ids=str,
)
def test_noisy_motions_pass_where_smaller_steps_under_the_same_kicks_agree(integrator, controls):
    """And not where they do not; the kicks of a step come at its ends, whatever parts it is taken in."""
    rng = np.random.default_rng(4)
    scene = vp.Scene(vp.planar_chain(2), damping=0.2, noise=fields(2, controls != "none", rng))
    start, left = ([0.3, 0.2], [0.5, 0.0]), 0.0 if integrator == vp.ExplicitEuler() else integrator.left
    passed = []
    for dt in (0.2, 0.02, 0.002):
        steps = max(40, round(0.5 / dt))
        u = {"none": np.zeros((steps, 2)), "held": np.full((steps, 2), 0.3), "changing": rng.normal(size=(steps, 2))}
        given = {"controls": u[controls], "check": False}
        try:
            motion = vp.simulate(scene, *start, dt=dt, steps=steps, integrator=integrator, rng=3, **given)
        except vp.StepFailure:
            continue
        if not resolution_of(scene, integrator, motion).resolved:
            continue
        passed.append(dt)
        q, v = (np.array([x]) for x in start)
        off = 0.0
        for k in range(steps):
            ends, force = np.zeros((1, 16, 2, 2)), np.zeros((0, 0, 2))
            at = motion.q[k : k + 1], motion.v[k : k + 1], motion.u[k : k + 1], motion.q[0]
            ends[0, 0, 0] = left * scene.noise.fields(*at).F[0] @ motion.dw[k]
            at = motion.q[k + 1 : k + 2], *at[1:]
            ends[0, -1, 1] = (1.0 - left) * scene.noise.fields(*at).F[0] @ motion.dw[k]
            if integrator.holds_noise:
                force, ends = np.tile(ends[:, :1, 0] / dt, (1, 16, 1)), 0.0 * ends
            parts = open_loop(np.repeat(motion.u[k : k + 1], 16, axis=0))
            fine = vp.Gauss(3).motions(scene, q, v, parts, force, dt / 16, ends)
            q, v = fine[0][:, -1], fine[1][:, -1]
            off = max(off, np.abs((q[0] - motion.q[k + 1]) / np.ptp(motion.q, axis=0)).max())
        assert off < WRONG_POSITION
    assert 0.2 not in passed
    assert 0.002 in passed or integrator.order == 1


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Midpoint(kick="held")], ids=str)
def test_the_look_at_a_noisy_motion_takes_less_than_the_motion(evaluations, integrator):
    scene = vp.Scene(vp.planar_chain(3), noise=vp.AdditiveNoise(1e-2))
    start = np.full(3, 0.4), np.zeros(3)
    motion = vp.simulate(scene, *start, dt=1e-3, steps=2000, rng=0, integrator=integrator, check=False)
    evaluations()
    assert examined(scene, integrator, motion)[1] == ()
    assert evaluations() <= 0.75 * int((motion.statistics.jets + motion.statistics.sweeps).sum())


@pytest.mark.parametrize(("dt", "steps"), [(1e-3, 100), (1e-2, 100)])
def test_rounding_of_joints_that_a_falling_lift_carries_is_no_motion(dt, steps):
    """They have no weight in its fall, and stay where they are."""
    model, joint = pin.Model(), 0
    for kind in (pin.JointModelPZ(), pin.JointModelRX(), pin.JointModelRY(), pin.JointModelRZ()):
        joint = model.addJoint(joint, kind, pin.SE3(np.eye(3), np.array([0.1, 0.2, 0.3])), f"joint{joint}")
        inertia = pin.Inertia(20.0 / 3.0**joint, np.array([0.05, 0.1, 0.07]), np.diag([0.01, 0.02, 0.015]))
        model.appendBodyToJoint(joint, inertia, pin.SE3.Identity())
    scene, q = vp.Scene(vp.load_robot(model)), np.array([0.0, 0.3, -0.8, 0.5])
    motion = vp.simulate(scene, q, np.zeros(4), dt=dt, steps=steps)
    assert motion.q[-1, 0] == pytest.approx(-0.5 * 9.81 * (dt * steps) ** 2, rel=1e-9)
    assert 0.0 < np.abs(motion.v[:, 1:]).max() < 1e-12
    assert motion.warnings == ()


def test_parts_of_unequal_length_are_repeated_as_short_as_the_shortest():
    """Under violent noise guards make parts of 1/16 to 1/256 of a step: the mean of them is too long."""
    scene = vp.Scene(rod_chain([1.0] * 2, [1.0] * 2), noise=vp.AdditiveNoise(1000.0))
    dw = wiener_increments(2, 1e-2, 200, 0)
    motion = vp.simulate(scene, np.zeros(2), np.zeros(2), dt=1e-2, steps=200, increments=dw, integrator=vp.Gauss(4))
    parts = shortest_parts(motion)
    numbers = motion.statistics
    split = numbers.substeps > 1
    ends = np.cumsum(numbers.substeps[split])
    deepest = np.array([int(own.max()) for own in np.split(numbers.halvings, ends[:-1])])
    assert (parts[~split] == 1).all()
    assert (parts[split] <= 1 << deepest).all()
    assert np.mean(parts[split] == 1 << deepest) > 0.9
    assert motion.warnings
    # As many equal parts, where they are longer than the shortest, are far further off. Single windows differ by how
    # rounding falls.
    times, fine_off, coarse_off = vp.Gauss(4).stage_times, [], []
    for at in range(0, 196, 4):
        own = parts[at : at + 3]
        mean = int(2 ** np.ceil(np.log2(numbers.substeps[at : at + 24].mean())))
        if mean >= own.min():
            continue
        fine, right, coarse = (taken_again(scene, vp.Gauss(5), motion, times, at, 3, n)[0] for n in (own, 1024, mean))
        off = np.abs(motion.q[at : at + 4] - right).max()
        fine_off.append(np.abs(fine - right).max() / off)
        coarse_off.append(np.abs(coarse - right).max() / off)
    assert len(fine_off) > 10
    assert np.median(fine_off) < 0.1
    assert np.median(np.divide(coarse_off, fine_off)) > 10.0


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("integrator", "forces", "torque", "noise"),
    [
        (vp.ExplicitEuler(), [vp.PositionServo(1e5, 100.0)], None, 1.0),
        (vp.ExplicitEuler(), [], None, 1.0),
        (vp.SemiImplicitEuler(), [], 1e155, None),
        (vp.ExplicitEuler(), [vp.CoulombFriction(1.0)], 1e155, None),
    ],
    ids=["servo", "noise", "force", "friction"],
)
@pytest.mark.parametrize("steps", [1, 2, 3, 150])
def test_squares_that_overflow_are_no_warnings_of_numpy(integrator, forces, torque, noise, steps):
    """Velocities near the square root of the largest number: the motion ends or is warned of, in words of varpin's."""
    scene = vp.Scene(
        vp.planar_chain(1), gravity=(0.0, 0.0, 0.0), forces=forces, noise=noise and vp.AdditiveNoise(noise)
    )
    given = {"controls": None if torque is None else [torque], "rng": None if noise is None else 0}
    try:
        motion = vp.simulate(scene, [0.0], [1e154], dt=0.01, steps=steps, integrator=integrator, **given)
    except vp.StepFailure:
        return
    # A free joint keeps its velocity; all else has to be warned of.
    free = not forces and torque is None
    assert np.isfinite(motion.v).all()
    assert motion.warnings or (free and np.abs(motion.v - 1e154).max() < 1e140)
