"""Steps against the root of their equation that is connected to dt = 0, followed there in small increments.

The equation is put together from Pinocchio's own algorithms, and its root followed as dt grows from nothing: where that
root meets another one and both vanish, no step is to be trusted whole.
"""

import numpy as np
import pytest

import varpin as vp


def equation(scene, q, impulse, force, h, v):
    """The midpoint step's r(v), p0 and the kick in ``impulse``, and its derivative."""
    jet = vp.lagrangian_jet(scene, q + 0.5 * h * v, v, backend="pinocchio")
    r = impulse + 0.5 * h * (jet.Lq + force - scene.damping * v) - jet.Lv
    skew = jet.Lvq.T - jet.Lvq
    slope = 0.5 * h * (0.5 * h * jet.Lqq + skew - np.diag(scene.damping)) - jet.Lvv
    return r, slope, np.abs(impulse) + np.abs(jet.Lvv) @ np.abs(v)


def corrected(scene, q, impulse, force, h, v):
    """Newton's root next to ``v`` and the determinant there; None where it does not contract at once."""
    before = np.inf
    for _ in range(8):
        r, slope, scale = equation(scene, q, impulse, force, h, v)
        if (np.abs(r) <= 1e-12 * scale).all():
            return v, np.linalg.det(-slope)
        delta = np.linalg.solve(slope, -r)
        size = np.abs(delta).max()
        if not size <= 0.1 * before or size > 0.05 * (np.abs(v).max() + 1e-9):
            return None
        before, v = size, v + delta
    return None


def connected_root(scene, q, impulse, force, h):
    """The root at h on the branch that starts from M^-1 impulse at h = 0; None where the branch ends before."""
    v = np.linalg.solve(vp.lagrangian_jet(scene, q, np.zeros_like(q), backend="pinocchio").Lvv, impulse)
    at, increment = 0.0, h / 16
    while at < h:
        increment = min(increment, h - at)
        found = corrected(scene, q, impulse, force, at + increment, v)
        if found is None or not found[1] > 0.0:
            increment /= 2
            if increment < 1e-7 * h:
                return None
            continue
        v, at = found[0], at + increment
        increment *= 1.5
    return v


def newton_alone(scene, q, impulse, force, h, v):
    """Where plain Newton from ``v`` ends, guarded by nothing."""
    for _ in range(50):
        r, slope, scale = equation(scene, q, impulse, force, h, v)
        if not np.isfinite(r).all():
            return None
        if (np.abs(r) <= 1e-11 * scale).all():
            return v
        v = v + np.linalg.solve(slope, -r)
    return None


def violent(robot, forced, rng):
    """A scene in a random state: rates, torques, dampers and kicks over several decades, in units of the inertias."""
    n = robot.dof
    q, h = rng.uniform(-np.pi, np.pi, n), 10.0 ** rng.uniform(np.log10(0.02), np.log10(0.5))
    v = rng.normal(size=n) * 10.0 ** rng.uniform(-1.0, 1.3)
    inertia = np.diag(vp.lagrangian_jet(vp.Scene(robot), q, v, backend="pinocchio").Lvv)
    options, force, kick = {}, np.zeros(n), np.zeros(n)
    if forced:
        options["damping"] = inertia * 10.0 ** rng.uniform(-2.0, 1.0)
        options["noise"] = vp.AdditiveNoise(inertia)
        force = inertia * rng.normal(size=n) * 10.0 ** rng.uniform(-1.0, 2.0)
        kick = rng.normal(size=n) * 10.0 ** rng.uniform(-1.0, 1.0)
    return vp.Scene(robot, **options), q, v, h, force, kick, inertia * kick


def check(name, forced, cases, seed):
    """Counts of steps taken whole, of those cut or refused, of those where Newton alone jumps, and of gentle ones.

    Gentle are those in which the branch is followed easily; the last count is of those among them not taken whole.
    """
    robot = vp.load_robot(name) if name == "finger" else vp.planar_chain(int(name[-1]))
    rng = np.random.default_rng(seed)
    whole = cut = jumps = gentle = refused = 0
    for case in range(cases):
        scene, q, v, h, force, dw, kick = violent(robot, forced, rng)
        increments = dw[None] if forced else None
        jet = vp.lagrangian_jet(scene, q, v, backend="pinocchio")
        impulse = jet.Lv + kick
        # Where the step changes little of the momentum, nothing is in the way of taking it whole.
        _, slope, _ = equation(scene, q, impulse, force, h, np.linalg.solve(jet.Lvv, impulse))
        easy = np.abs(np.linalg.solve(jet.Lvv, -slope) - np.eye(len(q))).max() < 0.05
        gentle += easy
        right = connected_root(scene, q, impulse, force, h)
        alone = newton_alone(scene, q, impulse, force, h, v)
        jumps += alone is not None and (right is None or np.abs(alone - right).max() > 1e-3 * np.abs(right).max())
        try:
            options = {"dt": h, "steps": 1, "controls": force, "increments": increments, "integrator": vp.Midpoint()}
            motion = vp.simulate(scene, q, v, **options)
        except vp.StepFailure:
            cut += 1
            refused += easy
            continue
        if motion.statistics.substeps[0] > 1:
            cut += 1
            refused += easy
            continue
        whole += 1
        assert right is not None, (case, "the branch ends before dt")
        taken = (motion.q[1] - q) / h
        assert np.abs(taken - right).max() <= 1e-8 * np.abs(right).max(), case
    return whole, cut, jumps, gentle, refused


@pytest.mark.parametrize("forced", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["free", "forced"])
@pytest.mark.parametrize(
    "name", [*(pytest.param(name, marks=pytest.mark.slow) for name in ("chain2", "chain3")), "finger"]
)
def test_a_whole_step_is_on_the_branch_that_starts_at_nothing(name, forced):
    whole, cut, jumps, gentle, refused = check(name, forced, 40 if name == "chain2" else 20, seed=5)
    # A solver that refuses what is easy proves nothing by what it takes.
    assert refused <= 0.3 * gentle
    assert whole >= 5
    assert cut >= 5
    # The cases are violent enough for Newton alone to end on other branches.
    assert jumps >= 1
