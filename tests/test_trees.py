"""What holds for every robot, on random trees: branching or not, all kinds of joints and axes, light and heavy ends."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanisms import random_tree
from scipy.linalg import block_diag

import varpin as vp

INTEGRATORS = [vp.Midpoint(), vp.Gauss(1), vp.Gauss(2), vp.Gauss(3)]
RATIOS = [1e-4, 1e-2, 1.0, 1e2, 1e4]


@dataclasses.dataclass(frozen=True)
class Case:
    """A scene on a random tree and a state of it."""

    seed: int
    bodies: int
    branching: bool
    armature: bool
    ratio: float
    integrator: vp.Midpoint | vp.Gauss
    dt: float = 1e-3

    @property
    def rng(self) -> np.random.Generator:
        return np.random.default_rng(self.seed)

    @property
    def scene(self) -> vp.Scene:
        robot = vp.load_robot(
            random_tree(self.seed, self.bodies, branching=self.branching, armature=self.armature, ratio=self.ratio)
        )
        return vp.Scene(robot, gravity=self.rng.normal(0.0, 6.0, 3), stiffness=0.5, rest=0.2)

    @property
    def state(self) -> np.ndarray:
        return self.rng.uniform(-1.0, 1.0, (2, self.bodies))


cases = st.builds(
    Case,
    seed=st.integers(0, 2**32 - 1),
    bodies=st.integers(1, 8),
    branching=st.booleans(),
    armature=st.booleans(),
    ratio=st.sampled_from(RATIOS),
    integrator=st.sampled_from(INTEGRATORS),
)


def jet_is_pinocchio_s(case: Case) -> None:
    scene, (q, v) = case.scene, case.state
    compiled = vp.lagrangian_jet(scene, q, v)
    reference = vp.lagrangian_jet(scene, q, v, backend="pinocchio")
    # The momentum in the place of what vanishes on a tree of single joints side by side.
    least = np.abs(reference.Lv).max()
    for name in ("Lq", "Lv", "Lqq", "Lvq", "Lvv"):
        expected = getattr(reference, name)
        room = 1e-12 * max(np.abs(expected).max(), least)
        np.testing.assert_allclose(getattr(compiled, name), expected, rtol=0, atol=room, err_msg=name)


def is_symplectic(case: Case) -> None:
    """A'JA = J where M / h is the identity: in sqrt(M / h) q and its dual, which a step moves by their own size."""
    scene, (q, v) = case.scene, case.state
    motion = vp.simulate(scene, q, v, dt=case.dt, steps=4, integrator=case.integrator, check=False)
    n = case.bodies
    root = np.linalg.cholesky(vp.lagrangian_jet(scene, q, v).Lvv / case.dt).T
    size = block_diag(root, np.linalg.inv(root).T)
    J = np.kron([[0.0, 1.0], [-1.0, 0.0]], np.eye(n))
    for A in vp.linearize(scene, motion, integrator=case.integrator).A:
        scaled = size @ A @ np.linalg.inv(size)
        assert 0.5 < np.abs(scaled).max() < 5.0
        assert np.abs(scaled.T @ J @ scaled - J).max() < 1e-12


PROPERTIES = [jet_is_pinocchio_s, is_symplectic]


@pytest.mark.parametrize("check", PROPERTIES, ids=lambda check: check.__name__)
def test_on_a_few(check):
    settings(max_examples=15, deadline=None, derandomize=True, database=None)(given(cases)(check))()
