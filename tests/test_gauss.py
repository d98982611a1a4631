"""Gauss collocation against a plain version of itself, closed forms, the midpoint rule, and its own promises."""

import numpy as np
import pytest
from mechanisms import slider
from refusals import refused

import varpin as vp
from varpin.integrators.tableau import gauss_coefficients

GRAVITY = 9.81
ALL = [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize("stages", ALL)
def test_tableau(stages):
    """Quadrature of order 2s, collocation of order s, and symplectic: b_i a_ij + b_j a_ji = b_i b_j."""
    a, b, c = gauss_coefficients(stages)
    for k in range(1, 2 * stages + 1):
        assert b @ c ** (k - 1) == pytest.approx(1 / k, rel=1e-15)
    for k in range(1, stages + 1):
        np.testing.assert_allclose(a @ c ** (k - 1), c**k / k, rtol=0, atol=1e-15)
    weighted = b[:, None] * a
    np.testing.assert_allclose(weighted + weighted.T, np.outer(b, b), rtol=0, atol=1e-16)


@pytest.mark.parametrize(("name", "size"), [("finger", 1e-5), ("ur5", 1.0), ("panda", 0.05)])
def test_one_stage_is_the_midpoint_rule(name, size):
    robot = vp.load_robot(name)
    n = robot.dof
    scene = vp.Scene(robot, damping=0.1 * size, stiffness=size, rest=0.3)
    u = size * np.random.default_rng(0).normal(size=(100, n))
    start = np.linspace(0.2, 0.6, n), np.linspace(0.5, -0.5, n)
    runs = [
        vp.simulate(scene, *start, dt=2e-3, steps=100, controls=u, integrator=integrator)
        for integrator in (vp.Midpoint(), vp.Gauss(1))
    ]
    for quantity in ("q", "p", "v"):
        one, other = (getattr(run, quantity) for run in runs)
        np.testing.assert_allclose(other, one, rtol=0, atol=1e-12 * np.abs(one).max())
    np.testing.assert_allclose(runs[1].statistics.branch_margin, runs[0].statistics.branch_margin, rtol=1e-3, atol=0)
    lin, same = (
        vp.linearize(scene, run, integrator=integrator)
        for run, integrator in zip(runs, (vp.Midpoint(), vp.Gauss(1)), strict=True)
    )
    for quantity in ("A", "B", "K"):
        one, other = getattr(lin, quantity), getattr(same, quantity)
        np.testing.assert_allclose(other, one, rtol=0, atol=1e-10 * np.abs(one).max())


def oscillator(stiffness):
    """A mass of 1 kg on a spring, nothing else."""
    return vp.Scene(slider(), stiffness=stiffness, gravity=False)


@pytest.mark.parametrize("stages", ALL)
def test_a_spring_is_turned_by_the_pade_approximant(stages):
    """One step of the oscillator is the diagonal Pade approximant of exp(h [[0, 1], [-k, 0]]), stiff or not."""
    for product in (0.3, 5.0, 400.0):  # h sqrt(k)
        motion = vp.simulate(
            oscillator(product**2), [1.0], [0.7], dt=1.0, steps=1, integrator=vp.Gauss(stages), check=False
        )
        assert motion.statistics.split_steps == 0
        Z = np.array([[0.0, 1.0], [-(product**2), 0.0]])
        factors = [1.0]
        for j in range(1, stages + 1):
            factors.append(factors[-1] * (stages - j + 1) / (j * (2 * stages - j + 1)))
        # Scaled, so that the powers of a stiff spring's matrix stay of one size.
        S = np.diag([1.0, product])
        Y = np.linalg.solve(S, Z @ S)
        powers = [np.linalg.matrix_power(Y, j) for j in range(stages + 1)]
        P = sum(f * power for f, power in zip(factors, powers, strict=True))
        N = sum(f * (-1) ** j * power for j, (f, power) in enumerate(zip(factors, powers, strict=True)))
        expected = np.linalg.solve(N, P @ [1.0, 0.7 / product])
        given = np.array([motion.q[1, 0], motion.v[1, 0] / product])
        np.testing.assert_allclose(given, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("stages", [1, 2, 3])
def test_energy_round_off_walks_at_random(stages):
    """A mass on a spring: Gauss collocation conserves quadratic energies exactly, so what is left is rounding."""
    motion = vp.simulate(
        oscillator(3.0), [1.0], [0.3], dt=2e-2, steps=200_000, integrator=vp.Gauss(stages), check=False
    )
    assert np.abs(motion.energy / motion.energy[0] - 1.0).max() < 50 * np.finfo(float).eps


@pytest.mark.parametrize("stages", [1, 2, 3, 4, 6])
@pytest.mark.parametrize("duration", [20.0, pytest.param(1000.0, marks=pytest.mark.slow)], ids=["20 s", "1000 s"])
def test_no_silent_energy_jump_at_coarse_steps(stages, duration):
    limit = 0.05 if stages == 1 else 0.01
    for links in (2, 3, 5):
        scene = vp.Scene(vp.planar_chain(links))
        for dt in (0.02, 0.05, 0.1, 0.2, 0.5):
            motion = vp.simulate(
                scene, np.zeros(links), np.zeros(links), dt=dt, steps=int(duration / dt), integrator=vp.Gauss(stages)
            )
            assert np.abs(motion.energy - motion.energy[0]).max() < limit * GRAVITY * links**2 / 2
            assert motion.statistics.branch_margin.min() > 0.0
            if dt > 0.1:
                assert motion.statistics.split_steps > 0


@pytest.mark.parametrize("links", [3, 7])
def test_few_evaluations(links):
    """One jet a stage on most steps, and first-order sweeps for the rest."""
    scene = vp.Scene(vp.planar_chain(links))
    for stages in ALL:
        motion = vp.simulate(scene, np.zeros(links), np.zeros(links), dt=2e-2, steps=50, integrator=vp.Gauss(stages))
        assert motion.statistics.jets.mean() / stages < 1.5
        assert motion.statistics.sweeps.mean() / stages < 3.0
        assert motion.statistics.residual.max() < 1.0


@pytest.mark.parametrize("stages", [1, 2, 3, 6])
@pytest.mark.parametrize("stiffness", [1e-2, 1e2, 1e4])
@pytest.mark.parametrize("damping", [0.0, 1e-2, 1e4])
def test_stiff_springs_and_dampers(stages, stiffness, damping):
    """Springs and dampers far faster than the step: finite, bounded, and dissipating what they should."""
    scene = vp.Scene(vp.load_robot("finger"), gravity=False, stiffness=stiffness, damping=damping)
    motion = vp.simulate(
        scene, [0.1, 0.1, 0.1], np.zeros(3), dt=1e-2, steps=100, integrator=vp.Gauss(stages), check=False
    )
    assert np.isfinite(motion.q).all()
    if damping == 0.0:
        assert np.abs(motion.energy / motion.energy[0] - 1.0).max() < 0.1
    else:
        assert motion.energy[-1] < motion.energy[0]
        assert motion.energy.max() <= motion.energy[0] * (1.0 + 1e-9)


@pytest.mark.parametrize(
    ("option", "facts"),
    [
        ({"stages": 0}, ("stages", "1", "0")),
        ({"stages": 7}, ("stages", "6", "7")),
        ({"stages": 2.5}, ("stages", "2.5")),
        ({"stages": "two"}, ("stages", "'two'")),
        ({"tolerance": 0.0}, ("tolerance", "0.0")),
        ({"guard": 3}, ("guard", "varpin.Guard", "None", "3")),
        ({"kick": "right"}, ("kick", "'left'", "'split'", "'right'")),
    ],
)
@pytest.mark.parametrize("kind", [vp.Gauss, vp.Radau])
def test_options_out_of_range(kind, option, facts):
    with refused(vp.InputError, facts):
        kind(**option)


def test_a_trajectory_knows_its_integrator():
    scene = vp.Scene(vp.planar_chain(2))
    motion = vp.simulate(scene, np.zeros(2), np.zeros(2), dt=1e-2, steps=2, integrator=vp.Gauss(stages=3))
    assert motion.integrator == "Gauss(stages=3)"
    assert str(vp.Gauss(2, kick="split")) == 'Gauss(stages=2, kick="split")'
    with refused(vp.InputError, "Gauss(stages=3)", "Gauss(stages=2)"):
        vp.linearize(scene, motion, integrator=vp.Gauss(2))
