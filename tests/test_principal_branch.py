"""Steps against the root of their equation that is connected to dt = 0, followed there in small increments.

The equation is put together from Pinocchio's own algorithms, and its root followed as dt grows from nothing: where that
root meets another one and both vanish, no step is to be trusted whole.
"""

import numpy as np
import pytest

import varpin as vp


class Equation:
    """The midpoint step from q with p0 and the kick in ``impulse``: r(v) = 0 for the mean velocity of a step of h."""

    def __init__(self, scene, q, impulse, force):
        self.scene, self.q, self.impulse, self.force = scene, q, impulse, force

    def at(self, h, v):
        """r, its derivative and the size of its terms."""
        jet = vp.lagrangian_jet(self.scene, self.q + 0.5 * h * v, v, backend="pinocchio")
        damping = self.scene.damping
        r = self.impulse + 0.5 * h * (jet.Lq + self.force - damping * v) - jet.Lv
        slope = 0.5 * h * (0.5 * h * jet.Lqq + jet.Lvq.T - jet.Lvq - np.diag(damping)) - jet.Lvv
        return r, slope, np.abs(self.impulse) + np.abs(jet.Lvv) @ np.abs(v)

    def root(self, h, v):
        """Newton's root next to ``v``, before the determinant vanishes; None where it does not contract at once."""
        before = np.inf
        for _ in range(8):
            r, slope, scale = self.at(h, v)
            if (np.abs(r) <= 1e-12 * scale).all():
                return v if np.linalg.det(-slope) > 0.0 else None
            delta = np.linalg.solve(slope, -r)
            size = np.abs(delta).max()
            if not size <= 0.1 * before or size > 0.05 * (np.abs(v).max() + 1e-9):
                return None
            before, v = size, v + delta
        return None

    def connected_root(self, h, v):
        """The root at h on the branch that starts from v at h = 0; None where the branch ends before."""
        at, increment = 0.0, h / 16
        while at < h:
            increment = min(increment, h - at)
            found = self.root(at + increment, v)
            if found is None:
                increment /= 2
                if increment < 1e-7 * h:
                    return None
                continue
            v, at, increment = found, at + increment, 1.5 * increment
        return v


def violent(robot, forced, rng):
    """A scene in a random state: rates, torques, dampers and kicks over several decades, in units of the inertias."""
    n = robot.dof
    q, h = rng.uniform(-np.pi, np.pi, n), 10.0 ** rng.uniform(np.log10(0.02), np.log10(0.5))
    v = rng.normal(size=n) * 10.0 ** rng.uniform(-1.0, 1.3)
    inertia = np.diag(vp.lagrangian_jet(vp.Scene(robot), q, v, backend="pinocchio").Lvv)
    if not forced:
        return vp.Scene(robot), q, v, h, np.zeros(n), np.zeros(n)
    damping = inertia * 10.0 ** rng.uniform(-2.0, 1.0)
    force = inertia * rng.normal(size=n) * 10.0 ** rng.uniform(-1.0, 2.0)
    kick = inertia * rng.normal(size=n) * 10.0 ** rng.uniform(-1.0, 1.0)
    return vp.Scene(robot, damping=damping, noise=vp.AdditiveNoise(1.0)), q, v, h, force, kick


@pytest.mark.parametrize("forced", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["free", "forced"])
@pytest.mark.parametrize(
    "robot",
    [*(pytest.param(vp.planar_chain(n), marks=pytest.mark.slow) for n in (2, 3)), vp.load_robot("finger")],
    ids=lambda robot: robot.name,
)
def test_a_whole_step_is_on_the_branch_that_starts_at_nothing(robot, forced):
    rng, whole, cut, ended, gentle, refused = np.random.default_rng(5), 0, 0, 0, 0, 0
    for _ in range(40 if robot.name == "chain2" else 20):
        scene, q, v, h, force, kick = violent(robot, forced, rng)
        jet = vp.lagrangian_jet(scene, q, v, backend="pinocchio")
        equation, start = Equation(scene, q, jet.Lv + kick, force), np.linalg.solve(jet.Lvv, jet.Lv + kick)
        right = equation.connected_root(h, start)
        # Where the step changes little of the momentum, nothing is in the way of taking it whole.
        easy = np.abs(np.linalg.solve(jet.Lvv, -equation.at(h, start)[1]) - np.eye(len(q))).max() < 0.05
        gentle += easy
        given = {"dt": h, "steps": 1, "controls": force, "increments": kick[None] if forced else None}
        try:
            motion = vp.simulate(scene, q, v, integrator=vp.Midpoint(), check=False, **given)
        except vp.StepFailure:
            motion = None
        ended += right is None
        if motion is None or motion.statistics.substeps[0] > 1:
            cut += 1
            refused += easy
            continue
        whole += 1
        assert right is not None, "the branch ends before dt"
        assert np.abs((motion.q[1] - q) / h - right).max() <= 1e-8 * np.abs(right).max()
    # A solver that refuses what is easy proves nothing by what it takes.
    assert refused <= 0.3 * gentle
    assert min(whole, cut) >= 5
    # The cases are violent enough for the branch to end, where Newton alone may find another.
    assert ended >= 1
