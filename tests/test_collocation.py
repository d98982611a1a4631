"""Collocation, the midpoint rule among it: closed forms, what guards and iterations promise; integrators as text."""

import dataclasses
import math
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
import zoo
from mechanisms import slider
from refusals import refused
from scipy.interpolate import pade

import varpin as vp
from varpin.integrators import BY_NAME, integrator_of
from varpin.io.scenefile.kinds import INTEGRATORS
from varpin.model.names import FIXED_BASE

GRAVITY = 9.81
ALL = [1, 2, 3, 4, 5, 6]


def oscillator(stiffness):
    return vp.Scene(slider(), stiffness=stiffness, gravity=False)


@pytest.mark.parametrize("stages", [1, 2, 3])
def test_energy_round_off_walks_at_random(stages):
    """A mass on a spring: Gauss collocation conserves quadratic energies exactly, so what is left is rounding."""
    motion = vp.simulate(
        oscillator(3.0), [1.0], [0.3], dt=2e-2, steps=200_000, integrator=vp.Gauss(stages), check=False
    )
    assert np.abs(motion.energy / motion.energy[0] - 1.0).max() < 50 * np.finfo(float).eps


@pytest.mark.parametrize("stages", ALL)
@pytest.mark.parametrize("kind", [vp.Gauss, vp.Radau])
def test_a_damper_is_slowed_by_the_pade_approximant(kind, stages):
    """One step multiplies v by that of exp(z), z = -h d / I, whose numerator has a degree less for Radau's methods."""
    scene = vp.Scene(vp.planar_chain(1), gravity=False, damping=1.0)
    degree = stages - (kind is vp.Radau)
    inertia = vp.lagrangian_jet(scene, [0.0], [0.0]).Lvv[0, 0]
    for z in (-0.3, -5.0, -3e3):
        motion = vp.simulate(
            scene, [0.0], [1.0], dt=-z * inertia, steps=1, integrator=kind(stages, guard=None), check=False
        )
        series = [1.0 / math.factorial(k) for k in range(stages + degree + 1)]
        above, below = pade(series, stages, degree)
        assert motion.v[-1, 0] == pytest.approx(above(z) / below(z), rel=1e-9, abs=1e-12)


def test_one_stage_is_the_implicit_euler_method():
    """p1 = p0 + h (L_q + F) at the end of the step."""
    scene, h = vp.Scene(vp.planar_chain(3), damping=0.1), 2e-3
    start = np.zeros(3), np.ones(3)
    motion = vp.simulate(scene, *start, dt=h, steps=1, integrator=vp.Radau(1, guard=None))
    v = (motion.q[1] - motion.q[0]) / h
    slope = vp.lagrangian_jet(scene, motion.q[1], v).Lq - 0.1 * v
    np.testing.assert_allclose(motion.p[1] - motion.p[0], h * slope, rtol=0, atol=1e-12)


@pytest.mark.parametrize("damping", [0.0, 1.0, 100.0])
def test_one_stage_moves_from_rest_under_the_default_guard(damping):
    """It loses a part of what a first step from rest gains, which is its first order and no fault of the step."""
    scene = vp.Scene(vp.planar_chain(3), damping=damping)
    motion = vp.simulate(scene, np.zeros(3), np.zeros(3), dt=1e-3, steps=100, integrator=vp.Radau(1), check=False)
    assert motion.statistics.substeps.max() == 1
    free = vp.simulate(scene, np.zeros(3), np.zeros(3), dt=1e-3, steps=100, integrator=vp.Radau(1, guard=None))
    np.testing.assert_allclose(motion.q, free.q, rtol=0, atol=1e-12)


# Integrators, links of chains that fall from rest, steps [s], largest error of the energy in units of g L^2 / 2.
COARSE = [(vp.Gauss(s), (2, 3, 5), (0.02, 0.05, 0.1, 0.2, 0.5), 0.05 if s == 1 else 0.01) for s in (1, 2, 3, 4, 6)]
COARSE += [(vp.Midpoint(alpha=alpha), (3,), (0.01, 0.05, 0.2), 0.2) for alpha in (0.0, 0.25, 0.45, 0.75, 1.0)]


@pytest.mark.parametrize("duration", [20.0, pytest.param(1000.0, marks=pytest.mark.slow)], ids=["20 s", "1000 s"])
@pytest.mark.parametrize(("integrator", "chains", "dts", "limit"), COARSE, ids=[str(own[0]) for own in COARSE])
def test_no_silent_energy_jump_at_coarse_steps(integrator, chains, dts, limit, duration):
    for links in chains:
        scene, still = vp.Scene(vp.planar_chain(links)), np.zeros(links)
        for dt in dts:
            motion = vp.simulate(scene, still, still, dt=dt, steps=int(duration / dt), integrator=integrator)
            assert np.abs(motion.energy - motion.energy[0]).max() < limit * GRAVITY * links**2 / 2
            assert motion.statistics.branch_margin.min() > 0.0
            if dt > 0.1:
                assert motion.statistics.split_steps > 0


@pytest.mark.parametrize(("stages", "dt"), [(2, 0.02), (2, 0.05), (3, 0.1)])
def test_free_motions_keep_their_energy(stages, dt):
    """The guard's budget is a hundredth of the one of one stage: a thousandth of the kinetic energy is kept so."""
    scene = vp.Scene(vp.planar_chain(3), damping=0.0)
    options = {"dt": dt, "steps": round(3.0 / dt), "integrator": vp.Radau(stages), "check": False}
    motion = vp.simulate(scene, [0.3, 1.2, -0.8], [2.0, -3.0, 4.0], **options)
    kinetic = [0.5 * v @ vp.lagrangian_jet(scene, q, v).Lvv @ v for q, v in zip(motion.q, motion.v, strict=True)]
    assert motion.statistics.split_steps > 0
    assert np.abs(motion.energy - motion.energy[0]).max() < 1e-3 * max(kinetic)


@pytest.mark.parametrize("links", [16, 32, pytest.param(100, marks=pytest.mark.slow)])
def test_long_chains_fall_for_ten_seconds(links):
    scene, still = vp.Scene(vp.planar_chain(links)), np.zeros(links)
    motion = vp.simulate(scene, still, still, dt=1e-2, steps=1000, integrator=vp.Midpoint())
    evaluations = motion.statistics.jets.sum() + motion.statistics.sweeps.sum()
    assert evaluations / motion.statistics.substeps.sum() <= 6.0
    assert np.abs(motion.energy - motion.energy[0]).max() < 0.05 * GRAVITY * links**2 / 2


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


def test_failure_keeps_what_was_done():
    scene = vp.Scene(vp.planar_chain(3))
    with refused(vp.StepFailure, "dt") as caught:
        vp.simulate(
            scene, np.zeros(3), np.zeros(3), dt=1e-2, steps=1000, controls=np.full(3, 1e5), integrator=vp.Midpoint()
        )
    error = caught.value
    assert error.trajectory.steps == error.step > 0
    assert error.time == pytest.approx(error.step * 1e-2)
    np.testing.assert_array_equal(error.q, error.trajectory.q[-1])
    np.testing.assert_array_equal(error.p, error.trajectory.p[-1])
    assert np.isfinite(error.trajectory.energy).all()
    assert str(error.step) in str(error)
    assert error.reason in str(error)


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


@pytest.mark.parametrize("links", [3, 7])
def test_few_evaluations(links):
    scene = vp.Scene(vp.planar_chain(links))
    for stages in ALL:
        motion = vp.simulate(scene, np.zeros(links), np.zeros(links), dt=2e-2, steps=50, integrator=vp.Gauss(stages))
        assert motion.statistics.jets.mean() / stages < 1.5
        assert motion.statistics.sweeps.mean() / stages < 3.0
        assert motion.statistics.residual.max() < 1.0


# What a correction leaves is estimated where inertia and gravity alone bend the step equation. Scenes, steps [s], and
# whether corrections go unseen.
UNSEEN = {
    "chain": (lambda: vp.Scene(vp.planar_chain(3)), 5e-4, True),
    "long chain, eliminated": (lambda: vp.Scene(vp.planar_chain(30)), 5e-4, True),
    "springs and dampers": (lambda: vp.Scene(vp.load_robot("ur5"), damping=0.5, stiffness=2.0, rest=0.1), 5e-4, True),
    "on a rail": (lambda: zoo.ZOO["cart"].scene, 5e-4, True),
    "sliders on an arm": (lambda: zoo.ZOO["panda"].scene, 5e-4, False),
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


# --- integrators as text, what they refuse, and motions that run away ------------------------------------------------


MADE = [
    vp.Midpoint(),
    vp.Midpoint(alpha=1 / 3, kick="split", guard=vp.Guard(max_halvings=3), tolerance=1e-300),
    vp.Gauss(),
    vp.Gauss(4, vp.Guard(energy_budget=1e-3), kick="split"),
    vp.Radau(3, kick="held"),
    vp.ExplicitEuler(),
    vp.SemiImplicitEuler(),
    vp.RungeKutta4(),
    vp.Reference(),
    vp.Reference(rtol=1e-9, atol=2.5e-10),
]


@pytest.mark.parametrize("made", MADE, ids=str)
def test_text_makes_it_again(made):
    assert integrator_of(str(made)) == made
    assert integrator_of(repr(made)) == made
    assert type(made) is BY_NAME[type(made).__name__]


def test_every_integrator_is_known_and_has_a_name_in_scene_files():
    own = {kind for kind in vars(vp).values() if isinstance(kind, type) and issubclass(kind, vp.Integrator)}
    assert set(BY_NAME.values()) == own - {vp.Integrator}
    names = ["midpoint", "gauss", "radau", "explicit_euler", "semi_implicit_euler", "runge_kutta_4"]
    assert list(INTEGRATORS) == names
    assert integrator_of(" Gauss(3, kick='split') ") == vp.Gauss(3, kick="split")
    # Without quotes, as on the command line and in older files of motions.
    assert integrator_of("Midpoint(alpha=0.5, kick=held)") == vp.Midpoint(kick="held")


@pytest.mark.parametrize(
    ("text", "facts"),
    [
        ("", "''"),
        ("Gauss(", "'Gauss('"),
        ("os.system('x')", "os.system"),
        ("Verlet", ("'Verlet'", "Midpoint", "Gauss", "Radau")),
        ("Gauss(alpha=0.5)", ("Gauss", "'alpha'", "stages")),
        ("RungeKutta4(4)", "RungeKutta4"),
        ("varpin.Gauss(3)", ("written as a name", "Gauss(stages=3)")),
        ("Gauss(2, stages=3)", "Gauss"),
        ("Gauss(stages=9)", ("stages", "6", "9")),
        ("Gauss(stages=len([]))", "'len"),
    ],
)
def test_other_texts_are_refused(text, facts):
    with refused(vp.InputError, facts):
        integrator_of(text)


class Own(vp.Midpoint):
    """Somebody's integrator, which nobody else can make."""


def test_what_made_a_motion_is_held_against_what_is_given():
    scene = vp.Scene(vp.planar_chain(1))
    motion = vp.simulate(scene, [0.4], [1.0], dt=0.01, steps=3, integrator=vp.Midpoint())
    # Guards decide which steps are cut, not what a step is.
    strict = vp.linearize(scene, motion, integrator=vp.Midpoint(guard=vp.Guard(max_halvings=0)))
    np.testing.assert_array_equal(strict.A, vp.linearize(scene, motion).A)
    for other in (vp.Gauss(), vp.Midpoint(alpha=0.4), vp.Midpoint(kick="split"), vp.RungeKutta4()):
        with refused(vp.InputError, "Midpoint(alpha=0.5)"):
            vp.linearize(scene, motion, integrator=other)
    with refused(vp.InputError, "integrator"):
        vp.linearize(scene, motion, integrator="midpoint")
    explicit = vp.simulate(scene, [0.4], [1.0], dt=0.01, steps=3, integrator=vp.RungeKutta4())
    with refused(vp.InputError, "second-order"):
        vp.second_order(scene, explicit, np.zeros(2))

    foreign = dataclasses.replace(motion, integrator=str(Own()))
    with refused(vp.InputError, "Own(alpha=0.5)", "integrator="):
        vp.linearize(scene, foreign)
    np.testing.assert_array_equal(vp.linearize(scene, foreign, integrator=Own()).A, vp.linearize(scene, motion).A)


def test_the_reference_keeps_to_its_tolerances():
    """Ten periods of an oscillator in one step."""
    scene, given = vp.Scene(vp.planar_chain(1), gravity=False, stiffness=3.0), {"dt": 20.0 * np.pi / 3.0, "steps": 1}
    for own, least, most in (((1e-13,), 0.0, 2e-12), ((1e-6,), 1e-9, 1e-4), ((1e-13, 1e-6), 1e-9, 1e-4)):
        motion = vp.simulate(scene, [0.7], [0.3], integrator=vp.Reference(*own), **given)
        assert least <= abs(motion.q[-1, 0] - 0.7) < most
    for name, wrong in (("rtol", 1e-15), ("rtol", 0.5), ("atol", 0.0)):
        with refused(vp.InputError, name, repr(wrong)):
            vp.Reference(**{name: wrong})


def test_runaway_is_a_step_failure():
    """Negative damping is not to be had, but a feedback of the wrong sign is."""
    scene = vp.Scene(vp.planar_chain(1), gravity=False)
    policy = vp.LinearPolicy(np.zeros((60, 1)), np.tile([[1e3, 1e3]], (60, 1, 1)), np.zeros((60, 2)))
    with refused(vp.StepFailure) as caught:
        vp.simulate(scene, [1.0], [1.0], dt=10.0, steps=60, controls=policy, integrator=vp.Reference())
    assert np.isfinite(caught.value.trajectory.q).all()


@pytest.mark.parametrize(
    ("integrator", "damping", "dt"), [(vp.ExplicitEuler(), 0.0, 0.5), (vp.RungeKutta4(), 500.0, 0.05)], ids=str
)
def test_blow_up_is_a_step_failure(integrator, damping, dt):
    scene = vp.Scene(vp.planar_chain(3), damping=damping)
    with refused(vp.StepFailure, "runs away") as caught:
        vp.simulate(scene, np.full(3, 0.4), np.zeros(3), dt=dt, steps=10_000, integrator=integrator)
    assert "mass matrix" not in str(caught.value)
    assert ("Damping" in caught.value.advice) == (damping > 0.0)
    assert np.isfinite(caught.value.trajectory.energy).all()
