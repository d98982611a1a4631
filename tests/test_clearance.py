"""Motions that are clearly right: the residual of their equations against SciPy and Pinocchio, and what it clears."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
import scipy
from scipy.interpolate import BPoly

import varpin as vp
from varpin.simulation import clearance
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


def residuals(scene, integrator, motion, points, weights):
    """Errors of q and v by the steps (N, 2, n), on SciPy's polynomials and Pinocchio's forward dynamics."""
    model = scene.robot.model
    data, h = model.createData(), motion.dt
    inside = motion.u_stages.shape[1] > 0

    def force(k, x):
        if not inside:
            return motion.u[k]
        times = np.array(integrator.stage_times)
        return np.polynomial.polynomial.polyval(
            x, np.linalg.solve(np.vander(times, increasing=True), motion.u_stages[k])
        )

    def acceleration(k, x, q, v):
        return pin.aba(model, data, q, v, force(k, x) - scene.damping * v)

    found = []
    for k in range(motion.steps):
        ends = [
            [motion.q[j], motion.v[j], acceleration(k, x, motion.q[j], motion.v[j])] for j, x in ((k, 0), (k + 1, 1))
        ]
        path = BPoly.from_derivatives([0.0, h], ends)
        rate = path.derivative()
        a = np.array([acceleration(k, x, path(x * h), rate(x * h)) for x in points])
        dv = motion.v[k + 1] - motion.v[k] - h * weights @ a
        dq = motion.q[k + 1] - motion.q[k] - h * motion.v[k] - h * h * (weights * (1.0 - points)) @ a
        found.append((np.abs(dq), np.abs(dv)))
    return np.array(found)


@pytest.mark.parametrize("integrator", [vp.Gauss(2), vp.Gauss(3), vp.RungeKutta4()], ids=str)
@pytest.mark.parametrize("controls", ["of time", "jumping"])
def test_the_residual_is_that_of_a_plain_version(scene, integrator, controls, limits):
    given = (
        vp.OpenLoop(torques, vectorized=True)
        if controls == "of time"
        else torques(np.repeat(np.arange(N // 2), 2).astype(float))
    )
    motion = moved(scene, integrator, given)
    rule = {"points": 4, "weights": [1, 5, 5, 1]} if integrator.order > 4 else {"points": 3, "weights": [1, 4, 1]}
    inner = np.polynomial.legendre.Legendre.basis(rule["points"] - 1).deriv().roots()
    points, weights = 0.5 + 0.5 * np.array([-1.0, *inner, 1.0]), np.array(rule["weights"]) / np.sum(rule["weights"])
    off = residuals(scene, integrator, motion, points, weights)
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
REST = np.zeros(3)


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(2), vp.Gauss(3), vp.RungeKutta4()], ids=str)
def test_no_wrong_motion_is_cleared(integrator):
    """From steps that resolve nothing to fine ones: what is cleared is not off by a tenth of a warning."""
    cleared = []
    for steps in (4, 6, 10, 16, 25, 40, 80, 160):
        motion = vp.simulate(CHAIN, REST, REST, duration=1.0, steps=steps, integrator=integrator, check=False)
        if not integrator.variational:
            defect = energy_defects(CHAIN, integrator, motion)
            motion = motion.changed(statistics=motion.statistics.changed(energy_defect=defect))
        cleared.append(clearance.clearly_right(CHAIN, integrator, motion))
        if cleared[-1]:
            assert motion_error(CHAIN, integrator, motion).worst < 0.1
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


@pytest.mark.parametrize(
    "options",
    [
        {"forces": [vp.CoulombFriction(0.1, width=0.1)]},
        {"noise": vp.AdditiveNoise(0.0)},
        {"forces": [vp.CustomForce(lambda q, v: -0.1 * v)]},
    ],
    ids=["friction", "noise", "force in Python"],
)
def test_what_nodes_do_not_tell_is_never_cleared(options):
    scene = vp.Scene(vp.planar_chain(3), **options)
    motion = vp.simulate(scene, REST, REST, dt=1e-3, steps=20, integrator=vp.Gauss(3), check=False)
    assert not clearance.clearly_right(scene, vp.Gauss(3), motion)


def test_a_known_error_stands_for_the_residual():
    """Of a motion whose steps are too coarse for the polynomials through its nodes."""
    motion = vp.simulate(CHAIN, REST, REST, duration=1.0, steps=20, integrator=vp.Gauss(5), check=False)
    assert not clearance.clearly_right(CHAIN, vp.Gauss(5), motion)
    error = np.abs(
        vp.simulate(CHAIN, REST, REST, duration=1.0, steps=40, integrator=vp.Gauss(5), check=False).q[::2] - motion.q
    ).max()
    assert clearance.clearly_right(CHAIN, vp.Gauss(5), motion, error)
    assert not clearance.clearly_right(CHAIN, vp.Gauss(5), motion, 1e-2)
