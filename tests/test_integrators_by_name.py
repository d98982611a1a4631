"""Integrators as text, in the record of a motion too; what they refuse, and motions that run away."""

import dataclasses

import numpy as np
import pytest
from refusals import refused

import varpin as vp
from varpin.integrators import BY_NAME, integrator_of
from varpin.io.scenefile.kinds import INTEGRATORS

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


def test_the_reference_takes_no_noise():
    noisy = vp.Scene(vp.load_robot("finger"), noise=vp.AdditiveNoise(1e-3))
    with refused(vp.InputError, "noise"):
        vp.simulate(noisy, np.zeros(3), np.zeros(3), dt=1e-3, steps=1, rng=0, integrator=vp.Reference())


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
    assert np.isfinite(caught.value.trajectory.energy).all()
