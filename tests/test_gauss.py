"""Gauss collocation against a plain version of itself, closed forms, the midpoint rule, and its own promises."""

import numpy as np
import pytest
from mechanisms import slider
from refusals import refused
from scipy.optimize import root

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


@pytest.mark.parametrize("stages", [1, 2, 3, 5])
def test_one_step_solves_the_stage_equations(stages):
    """Against a plain solver: unknown positions of the stages, Pinocchio's derivatives, SciPy's root finder."""
    scene = vp.Scene(vp.load_robot("ur5"), damping=0.7, stiffness=3.0, rest=0.2)
    q0, v0, u = np.random.default_rng(3).normal(size=(3, 6))
    dt = 2e-2
    nodes, weights = np.polynomial.legendre.leggauss(stages)
    c, b = 0.5 + 0.5 * nodes, 0.5 * weights
    powers = np.vander(c, increasing=True)
    a = (c[:, None] * powers / np.arange(1, stages + 1)) @ np.linalg.inv(powers)
    p0 = vp.lagrangian_jet(scene, q0, v0, backend="pinocchio").Lv

    def at(x):
        Q = x.reshape(stages, 6)
        V = np.linalg.solve(a, Q - q0) / dt
        jets = [vp.lagrangian_jet(scene, *pair, backend="pinocchio") for pair in zip(Q, V, strict=True)]
        slope = np.array([jet.Lq for jet in jets]) + u - scene.damping * V
        return V, np.array([jet.Lv for jet in jets]), slope

    def equations(x):
        _, momenta, slope = at(x)
        return (p0 + dt * a @ slope - momenta).ravel()

    solution = root(equations, (q0 + dt * c[:, None] * v0).ravel(), tol=1e-13)
    V, _, slope = at(solution.x)
    end = vp.simulate(scene, q0, v0, dt=dt, steps=1, controls=u, integrator=vp.Gauss(stages), check=False)
    np.testing.assert_allclose(end.q[1], q0 + dt * b @ V, rtol=0, atol=1e-10)
    np.testing.assert_allclose(end.p[1], p0 + dt * b @ slope, rtol=0, atol=1e-9)


# For each arm: what to lock, the size of forces, how fast it starts, and how long [s]: in free fall the wrists of the
# heavier arms whip round ever faster, and no step is small enough for long.
ARMS = {
    "finger": (None, 1e-5, 10.0, 1.0),
    "ur5": (None, 1.0, 1.5, 1.0),
    "panda": ({"panda_finger_joint1": 0.02}, 0.05, 1.0, 0.4),
}


@pytest.mark.parametrize("name", ["finger", "ur5", "panda"])
def test_one_stage_is_the_midpoint_rule(name):
    lock, size, *_ = ARMS[name]
    robot = vp.load_robot(name, lock=lock)
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


def long_runs(integrator, dt, duration, starts):
    """Energy errors of chaotic runs in m g n^2 / 2, the share of split steps, and the jets taken."""
    scene, steps = vp.Scene(vp.planar_chain(3)), round(duration / dt)
    runs = [
        vp.simulate(scene, np.full(3, tilt), np.zeros(3), dt=dt, steps=steps, integrator=integrator) for tilt in starts
    ]
    split = sum(run.statistics.split_steps for run in runs) / (steps * len(runs))
    jets = sum(run.statistics.jets.sum() for run in runs)
    return np.array([run.energy - run.energy[0] for run in runs]) / (GRAVITY * 9 / 2), split, jets


@pytest.mark.slow
def test_energy_of_long_runs_has_no_trend_and_gauss_a_twentieth_of_the_midpoint_rules_error():
    """1000 s, chaotic, so eight starts within 1e-6 rad are eight independent runs; Gauss at twice the step."""
    starts = np.arange(8) * 1e-7
    errors, split, jets = long_runs(vp.Gauss(2), 2e-2, 1000.0, starts)
    midpoint, midpoint_split, midpoint_jets = long_runs(vp.Midpoint(), 1e-2, 1000.0, starts)
    assert split <= 0.05
    assert midpoint_split <= 0.01
    for each in (errors, midpoint):
        blocks = each[:, 1:].reshape(8, 20, -1).mean(axis=2)
        trends = np.polyfit(np.arange(20.0), blocks.T, 1)[0]
        assert abs(trends.mean()) < 3.5 * trends.std(ddof=1) / np.sqrt(8)
    assert np.abs(midpoint.mean(axis=1)).max() < 5e-3
    assert np.abs(midpoint).max() < 5e-2
    assert np.median(np.abs(errors)) <= np.median(np.abs(midpoint)) / 20
    assert np.sqrt((errors**2).mean()) <= np.sqrt((midpoint**2).mean()) / 20
    assert np.abs(errors).max() <= np.abs(midpoint).max() / 20
    assert jets <= 1.5 * midpoint_jets


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
