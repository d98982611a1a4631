"""Motions that are clearly right: the residual of their equations against SciPy and Pinocchio, and what it clears."""

from __future__ import annotations

from itertools import product

import numpy as np
import pinocchio as pin
import pytest
import scipy

import varpin as vp
from varpin.integrators.tableau import gauss_coefficients, radau_coefficients, stability
from varpin.simulation import clearance
from varpin.simulation.damping import fast_damping
from varpin.simulation.soundness import energy_defects, motion_error

N, T = 12, 0.6


@pytest.fixture(scope="module")
def scene():
    return vp.Scene(vp.load_robot("ur5"), damping=[4.0, 4.0, 2.0, 0.3, 0.2, 0.05])


def torques(t):
    return np.array([10.0, -30.0, -8.0, 0.5, 0.3, 0.1]) * np.sin(5.0 * t[:, None] + np.arange(6))


Q0 = np.array([0.3, -1.2, 1.4, -0.5, 0.8, 0.1])


def moved(scene, integrator, controls, steps=N):
    options = {"duration": T, "steps": steps, "controls": controls, "integrator": integrator, "check": False}
    return vp.simulate(scene, Q0, np.zeros(6), **options)


@pytest.fixture
def limits(monkeypatch):
    """Change limits of the core's decision; those that are not given are infinite."""
    core = clearance.clear_growth
    names = ("energy", "damping", "travel", "velocity", "whole", "grown")

    def change(**given):
        own = dict.fromkeys(names, 1e12) | given
        monkeypatch.setattr(clearance, "clear_growth", lambda *args, **keys: core(*args, **(keys | own)))

    return change


def looked_at(degree):
    """Points around the middle of two steps whose polynomials have integrals that are exact up to a degree on each."""
    weights = np.arange(2 if degree == 8 else 1) / 2

    def integrals(roots):
        """Of (z - 1) (z - r1) ... z^w over [0, 1], z the squared distance from the middle."""
        own = np.polynomial.Polynomial.fromroots([1.0, *roots]).coef
        return [(own / (np.arange(len(own)) + 1.0 + w)).sum() for w in weights]

    around = np.sqrt(scipy.optimize.fsolve(integrals, [0.1, 0.6][: len(weights)], xtol=1e-13))
    return np.sort([0.0, 1.0, 2.0, *(1.0 - around), *(1.0 + around)])


def stretches(motion, *, pairs):
    """First step and number of steps of each polynomial, and its steps that count: two where controls do not jump."""
    found, k, last = [], 0, motion.steps - 1

    def alike(k):
        return motion.u_stages.shape[1] > 0 or (motion.u[k] == motion.u[k + 1]).all()

    while k <= last:
        if pairs and k < last and alike(k):
            found.append((k, 2, (0, 1)))
        elif pairs and k and alike(k - 1):
            found.append((k - 1, 2, (1,)))
        else:
            found.append((k, 1, (0,)))
        k += len(found[-1][2])
    return found


def residuals(scene, integrator, motion):
    """Errors of q and v by the steps (N, 2, n), on SciPy's polynomials and Pinocchio's forward dynamics."""
    model = scene.robot.model
    data, h, fine = model.createData(), motion.dt, integrator.order > 4
    inside = motion.u_stages.shape[1] > 0
    times = np.array(integrator.stage_times)
    found = []
    for k, count, counted in stretches(motion, pairs=not (inside and {0.0, 1.0} <= set(times))):
        own = np.concatenate([j + times for j in range(count)])
        samples = motion.u_stages[k : k + count].reshape(len(own), -1) if inside else None

        def acceleration(x, q, v, k=k, own=own, samples=samples):
            u = motion.u[k] if samples is None else scipy.interpolate.KroghInterpolator(own, samples)(x)
            return pin.aba(model, data, q, v, u - scene.damping * v)

        nodes = [
            (motion.q[k + j], motion.v[k + j], acceleration(j, motion.q[k + j], motion.v[k + j]))
            for j in range(count + 1)
        ]
        path = scipy.interpolate.KroghInterpolator(np.repeat(np.arange(count + 1) * h, 3), np.concatenate(nodes))
        if count == 1:
            inner = np.polynomial.legendre.Legendre.basis(3 if fine else 2).deriv().roots()
            points = 0.5 + 0.5 * np.array([-1.0, *inner, 1.0])
        else:
            points = looked_at(8 if fine else 5)
        a = np.array([acceleration(x, path(x * h), path.derivative(x * h)) for x in points])
        # The polynomial through the accelerations, and that times the time which is left.
        through = np.polynomial.polynomial.polyfit(points, a, len(points) - 1)
        for j in counted:
            moments = np.array([np.polynomial.polynomial.polymul(part, [j + 1.0, -1.0]) for part in through.T]).T
            if count == 1:
                # Lobatto's rule is exact for products of higher degree.
                weights = np.array([1, 5, 5, 1] if fine else [1, 4, 1]) / (12 if fine else 6)
                gained, moved = weights @ a, (weights * (1.0 - points)) @ a
            else:
                whole = [np.polynomial.polynomial.polyint(p, lbnd=j) for p in (through, moments)]
                gained, moved = (np.polynomial.polynomial.polyval(j + 1.0, p) for p in whole)
            q, v = motion.q[k + j :], motion.v[k + j :]
            found.append((np.abs(q[1] - q[0] - h * v[0] - h * h * moved), np.abs(v[1] - v[0] - h * gained)))
    return np.array(found)


@pytest.mark.parametrize("integrator", [vp.Gauss(2), vp.Gauss(3), vp.RungeKutta4()], ids=str)
@pytest.mark.parametrize("controls", ["of time", "jumping"])
def test_the_residual_is_that_of_a_plain_version(scene, integrator, controls, limits):
    given = (
        vp.OpenLoop(torques, vectorized=True)
        if controls == "of time"
        else torques(np.repeat(np.arange(5.0), [2, 1, 3, 2, 4]))
    )
    motion = moved(scene, integrator, given)
    off = residuals(scene, integrator, motion)
    left = motion.dt * np.arange(N)[::-1, None]
    M = np.diag(vp.lagrangian_jet(scene, motion.q[0], np.zeros(6)).Lvv)
    energy = (np.sqrt(M) * np.ptp(motion.v, axis=0)).max()
    for name, errors, unit, time in (
        ("travel", (off[:, 0] + left * off[:, 1]).sum(axis=0), np.ptp(motion.q, axis=0), T),
        ("velocity", off[:, 1].sum(axis=0), np.abs(motion.v).max(axis=0), 1.0),
    ):
        least = np.minimum(1e-2 * unit.max(), 1e-2 * energy / np.sqrt(M) * time)
        share = (errors / np.maximum(unit, least)).max()
        limits(**{name: 1.001 * share})
        assert clearance.clearly_right(scene, integrator, motion)
        limits(**{name: 0.999 * share})
        assert not clearance.clearly_right(scene, integrator, motion)
    # The whole motion is one window here.
    limits(whole=0.0)
    assert not clearance.clearly_right(scene, integrator, motion)


def test_growth_is_bounded_by_no_less_than_the_fastest_mode(scene, limits, monkeypatch):
    """And by no more than the logarithmic norm allows, at two nodes; the modes themselves are looked at beyond that."""
    monkeypatch.setattr(clearance, "growth_bound", lambda *_: np.inf)
    integrator = vp.Gauss(3)
    motion = moved(scene, integrator, torques(np.arange(N) * 0.1))

    def least(name):
        """The limit from which on the motion is cleared, by bisection."""
        low, high = 1e-15, 1e6
        while high > 1.0001 * low:
            middle = np.sqrt(low * high)
            limits(**{name: middle})
            low, high = (low, middle) if clearance.clearly_right(scene, integrator, motion) else (middle, high)
        return high

    factor, rates, modes = least("grown") / least("travel"), [], []
    model, n = scene.robot.model, 6
    data = model.createData()
    for k in (N // 3, 2 * N // 3):
        q, v, tau = motion.q[k], motion.v[k], motion.u[k] - scene.damping * motion.v[k]
        pin.computeABADerivatives(model, data, q, v, tau)
        aq, M = data.ddq_dq.copy(), np.linalg.inv(np.triu(data.Minv) + np.triu(data.Minv, 1).T)
        av = data.ddq_dv - np.linalg.inv(M) * scene.damping
        A = np.block([[np.zeros((n, n)), np.eye(n)], [aq, av]])
        modes.append(np.linalg.eigvals(A).real.max())

        def norm(r, M=M, A=A):
            P = scipy.linalg.block_diag(r * r * M, M)
            return scipy.linalg.eigh(0.5 * (P @ A + A.T @ P), P, eigvals_only=True)[-1]

        rates.append(scipy.optimize.brentq(lambda r: r - norm(r), 1e-3, 1e3))
    assert np.log(factor) == pytest.approx(0.5 * max(rates) * T, abs=1e-3)
    assert max(rates) >= max(modes)
    monkeypatch.undo()
    factor = least("grown") / least("travel")
    assert np.log(factor) == pytest.approx(0.5 * max(modes) * T, abs=1e-3)


CHAIN = vp.Scene(vp.planar_chain(3))
RUBBING = vp.Scene(vp.planar_chain(3), forces=[vp.CoulombFriction([3.0, 2.0, 1.0], width=1.0)])
REST = np.zeros(3)


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(2), vp.Gauss(3), vp.RungeKutta4()], ids=str)
@pytest.mark.parametrize("scene", [CHAIN, RUBBING], ids=["free", "friction"])
def test_no_wrong_motion_is_cleared(integrator, scene):
    """From steps that resolve nothing to fine ones: what is cleared is not off by a tenth of a warning."""
    cleared = []
    for steps in (4, 6, 10, 16, 25, 40, 80, 160):
        motion = vp.simulate(scene, REST, REST, duration=1.0, steps=steps, integrator=integrator, check=False)
        if not integrator.variational:
            defect = energy_defects(scene, integrator, motion)
            motion = motion.changed(statistics=motion.statistics.changed(energy_defect=defect))
        cleared.append(clearance.clearly_right(scene, integrator, motion))
        if cleared[-1]:
            assert motion_error(scene, integrator, motion).worst < 0.1
    assert not cleared[0]
    assert cleared[-1] or integrator.order == 2


def test_a_wrong_step_is_not_cleared():
    """A small jump of the velocity, or of the position, anywhere in a motion that is clearly right without it."""
    motion = vp.simulate(CHAIN, REST, REST, duration=1.0, steps=80, integrator=vp.Gauss(4), check=False)
    assert clearance.clearly_right(CHAIN, vp.Gauss(4), motion)
    for name in ("q", "v"):
        for node in (1, 40, 80):
            values = getattr(motion, name).copy()
            values[node:, 1] += 0.02 * np.ptp(values[:, 1])
            assert not clearance.clearly_right(CHAIN, vp.Gauss(4), motion.changed(**{name: values}))


@pytest.mark.parametrize("stages", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("method", ["gauss", "radau"])
def test_over_two_steps_no_wrong_mode_of_a_damper_has_a_small_residual(method, stages, monkeypatch):
    """Modes exp(z t) of x'' + d x' + k x = 0 over steps of unit length, as a method integrates them.

    Springs that turn a mode by more than a radian in a step are left to the check.
    """
    if method == "radau" and stages == 1:
        return
    a, b, _ = {"gauss": gauss_coefficients, "radau": radau_coefficients}[method](stages)
    monkeypatch.setattr(clearance.Stretch, "make", lambda **arrays: arrays)
    _, wide = clearance._stretches.__wrapped__((), 2 * stages <= 4)
    (values, slopes), (gains, moves) = wide["curves"], wide["sums"]
    for d, k in product([0.0, *np.geomspace(0.1, 1e4, 60)], [-1.0, -0.3, 0.0, 0.3, 1.0]):
        z = np.roots([1.0, d, k]).astype(complex)
        z = z[np.abs(z) > 1e-9]
        if not len(z):
            continue
        factor = stability(a, b, z)
        # Rows for the nodes.
        v = factor ** np.arange(3)[:, None]
        q = v / z
        data = np.stack([q, v, -k * q - d * v], axis=1).reshape(9, -1)
        acceleration = -k * values @ data - d * slopes @ data
        off_v = v[1:] - v[:-1] - gains @ acceleration
        off_q = q[1:] - q[:-1] - v[:-1] - moves @ acceleration
        seen = np.maximum(np.abs(off_v), np.abs(off_q)).max(axis=0)
        error = np.abs(factor - np.exp(z))
        assert (seen >= 0.5 * np.where(error > 1e-3, error, 0.0)).all()


def test_dampers_that_are_faster_than_the_step():
    """Cleared where velocities follow, and not where they ring after jumps of the torque, or in single steps."""
    scene = vp.Scene(vp.planar_chain(3), damping=[2.0, 2.0, 2.0], gravity=[0.0, 0.0, 0.0])
    assert fast_damping(scene, REST[None], REST[None], REST[None], 0.1).rate > 5.0 / 0.1
    torque = np.array([2.0, 1.3, 0.7])
    smooth = vp.OpenLoop(lambda t: torque * np.sin(t) ** 2)
    jumping = np.where((np.arange(30) // 5 % 2)[:, None], torque, -torque)
    given = {"dt": 0.1, "check": False}
    for integrator in (vp.Gauss(2), vp.Gauss(3)):
        motion = vp.simulate(scene, REST, REST, steps=30, controls=smooth, integrator=integrator, **given)
        assert clearance.clearly_right(scene, integrator, motion)
        assert motion_error(scene, integrator, motion).worst < 0.1
        motion = vp.simulate(scene, REST, REST, steps=30, controls=jumping, integrator=integrator, **given)
        assert not clearance.clearly_right(scene, integrator, motion)
        motion = vp.simulate(scene, REST, REST, steps=1, controls=smooth, integrator=integrator, **given)
        assert not clearance.clearly_right(scene, integrator, motion)


@pytest.mark.parametrize(
    "options",
    [
        {"forces": [vp.CoulombFriction(0.1, width=1e-3)]},
        {"forces": [vp.CoulombFriction(0.1, width=1.0, breakaway=0.2, stribeck_velocity=1.0)]},
        {"noise": vp.AdditiveNoise(0.0)},
        {"forces": [vp.CustomForce(lambda q, v: -0.1 * v)]},
    ],
    ids=["narrow friction", "Stribeck's effect", "noise", "force in Python"],
)
def test_what_nodes_do_not_tell_is_never_cleared(options):
    scene = vp.Scene(vp.planar_chain(3), **options)
    motion = vp.simulate(scene, REST, REST, dt=1e-3, steps=20, integrator=vp.Gauss(3), check=False)
    assert not clearance.clearly_right(scene, vp.Gauss(3), motion)


def test_a_known_error_stands_for_the_residual():
    """Of a motion whose steps are too coarse for the polynomials through its nodes."""
    motion = vp.simulate(CHAIN, REST, REST, duration=1.0, steps=12, integrator=vp.Gauss(5), check=False)
    assert not clearance.clearly_right(CHAIN, vp.Gauss(5), motion)
    error = np.abs(
        vp.simulate(CHAIN, REST, REST, duration=1.0, steps=24, integrator=vp.Gauss(5), check=False).q[::2] - motion.q
    ).max()
    assert clearance.clearly_right(CHAIN, vp.Gauss(5), motion, error)
    assert not clearance.clearly_right(CHAIN, vp.Gauss(5), motion, 1e-2)
