"""The compiled look at a finished motion against the same in NumPy, matrix by matrix."""

from __future__ import annotations

import numpy as np
import pytest
import scipy
from mechanisms import random_tree
from refusals import refused

import varpin as vp
from varpin.core import energy_turnover, fastest_damping, glance, longest_alternation, pulls_fast, windows_agree

LOOKS, EVEN, LITTLE, LIGHT = 16, 1e-3, 1e-2, 1e-2


@pytest.fixture
def rng():
    return np.random.default_rng(3)


@pytest.fixture
def scene(rng):
    """Sliders and hinges with a damper each, two of them driven together."""
    robot = vp.load_robot(random_tree(4, 5))
    n = robot.dof
    actuation = np.eye(n)[:, :3]
    actuation[1, 0] = 0.5
    return vp.Scene(robot, damping=rng.uniform(0.1, 3.0, n), stiffness=rng.uniform(0.0, 5.0, n), actuation=actuation)


@pytest.fixture
def motion(scene, rng):
    n = scene.robot.dof
    return vp.simulate(
        scene,
        rng.normal(0.0, 0.5, n),
        rng.normal(0.0, 1.0, n),
        dt=2e-3,
        steps=40,
        controls=rng.normal(0.0, 1.0, (40, 3)),
        check=False,
    )


def masses(scene, q):
    return np.array([vp.lagrangian_jet(scene, at, np.zeros_like(at)).Lvv for at in q])


def still(q):
    """Velocities and forces of rest, beside q (K, n)."""
    return np.zeros((2, *q.shape))


def changed(v):
    fastest = np.abs(v).max(axis=0)
    return np.clip(np.ptp(v, axis=0), EVEN * fastest, fastest)


def test_the_fastest_damper_is_the_largest_eigenvalue(scene, motion):
    q = motion.q[::10]
    expected = max(scipy.linalg.eigh(np.diag(scene.damping), M, eigvals_only=True)[-1] for M in masses(scene, q))
    assert fastest_damping(scene.core, q, *still(q), 1e-3) == pytest.approx(expected, rel=1e-9)
    assert fastest_damping(scene.core, q, *still(q), 0.999 * expected) == pytest.approx(expected, rel=1e-9)
    assert fastest_damping(scene.core, q, *still(q), 1.001 * expected) == 0.0


def test_a_pull_is_fast_where_a_mode_turns_by_a_radian(scene, motion):
    for q in motion.q[[0, 20, -1]]:
        jet = vp.lagrangian_jet(scene, q, np.zeros_like(q))
        fastest = np.sqrt(np.abs(scipy.linalg.eigh(jet.Lqq, jet.Lvv, eigvals_only=True)).max())
        assert pulls_fast(scene.core, q[None], *still(q[None]), 1.001 / fastest)
        assert not pulls_fast(scene.core, q[None], *still(q[None]), 0.999 / fastest)


def test_a_glance_at_a_record(scene, motion):
    def seen(v=motion.v, u=motion.u, substeps=motion.statistics.substeps, dt=motion.dt):
        return glance(scene.core, motion.q, v, u, np.ascontiguousarray(substeps), dt)

    assert seen() == (np.abs(motion.v).max(), False, False, False)
    assert seen(u=np.broadcast_to(motion.u[0], motion.u.shape).copy())[2]
    parts = motion.statistics.substeps.copy()
    parts[-1] = 2
    assert seen(substeps=parts)[1]
    ends = motion.q[[0, -1]]
    for dt in (0.05, 0.3, 1.0):
        assert seen(dt=dt)[3] == pulls_fast(scene.core, ends, *still(ends), dt)
    assert seen(dt=1.0)[3]
    v = motion.v.copy()
    v[7, 2] = np.nan
    assert np.isnan(seen(v=v)[0])
    with refused(ValueError, "substeps"):
        seen(substeps=parts[1:])


def test_energy_that_is_turned_over(scene, motion):
    kinetic, work, turned, worked = energy_turnover(
        scene.core, motion.q, motion.v, motion.p, motion.u, motion.dt, even=EVEN, looks=LOOKS
    )
    done = (motion.u @ scene.actuation.T) * np.diff(motion.q, axis=0)
    at = np.unique(np.linspace(0, motion.steps, LOOKS).astype(int))
    inertia = np.diagonal(masses(scene, motion.q[at]), axis1=1, axis2=2).max(axis=0)
    assert kinetic == pytest.approx(0.5 * (motion.p * motion.v).sum(axis=1).max())
    assert work == pytest.approx(np.abs(np.cumsum(done.sum(axis=1))).max())
    np.testing.assert_allclose(turned, 0.5 * inertia * changed(motion.v) ** 2)
    np.testing.assert_allclose(worked, np.abs(np.cumsum(done, axis=0)).max(axis=0))


def test_the_work_of_servos_is_that_of_their_drives():
    """Not stiffness times command times way, which is far more and depends on where 0 is."""
    forces = vp.PositionServo({"joint1": 400.0}, {"joint1": 40.0}, {"joint1": 20.0})
    scene = vp.Scene(vp.planar_chain(2), forces=forces)
    u = np.tile([2.7, 0.3], (200, 1))
    motion = vp.simulate(scene, [2.5, 0.2], [0.0, 0.0], dt=5e-3, steps=200, controls=u, check=False)
    _, work, _, worked = energy_turnover(
        scene.core, motion.q, motion.v, motion.p, motion.u, motion.dt, even=EVEN, looks=LOOKS
    )
    way = np.diff(motion.q, axis=0)
    force = np.tile(u[0], (200, 1))
    wanted = 400.0 * (u[:, 0] - 0.5 * (motion.q[1:, 0] + motion.q[:-1, 0])) - 40.0 * way[:, 0] / motion.dt
    force[:, 0] = 20.0 * np.sign(wanted) * np.interp(np.abs(wanted) / 20.0, (y := np.linspace(0, 1.2, 4801)), bent(y))
    done = force * way
    assert (np.abs(wanted) > 22.0).any()
    assert work == pytest.approx(np.abs(np.cumsum(done.sum(axis=1))).max(), rel=1e-5)
    np.testing.assert_allclose(worked, np.abs(np.cumsum(done, axis=0)).max(axis=0), rtol=1e-5)


def bent(y):
    """What a drive makes of a wanted force, both in units of the effort."""
    return np.where(y < 0.9, y, np.where(y < 1.1, y - 2.5 * (y - 0.9) ** 2, 1.0))


def test_energy_that_is_turned_over_is_no_number_where_the_motion_is_none(scene, motion):
    v = motion.v.copy()
    v[7, 2] = np.nan
    kinetic, _, turned, _ = energy_turnover(
        scene.core, motion.q, v, motion.p, motion.u, motion.dt, even=EVEN, looks=LOOKS
    )
    assert np.isnan(kinetic)
    assert np.isnan(turned).tolist() == [False, False, True, False, False]


def agreement(scene, q, v, begins, length, dt, again, travel, velocity):
    """The largest error in units of what is allowed."""
    tree = scene.robot.tree
    slides = np.isin(np.arange(q.shape[1]), tree.coordinate[tree.prismatic > 0])
    nodes = begins[:, None] + np.arange(length + 1)
    q, v = q[nodes], v[nodes]
    root = np.sqrt(np.diagonal(masses(scene, q[:, 0]), axis1=1, axis2=2))
    light = LIGHT * (root * [changed(part) for part in v]).max(axis=1)[:, None] / root
    found = []
    for own, other, unit, least, part in (
        (q, again[0], np.ptp(q, axis=1), light * length * dt, travel),
        (v, again[1], np.abs(v).max(axis=1), light, velocity),
    ):
        for kind in (slides, ~slides):
            others = LITTLE * unit[:, kind].max(axis=1, initial=0.0)
            unit[:, kind] = np.maximum(unit[:, kind], np.minimum(others[:, None], least[:, kind]))
        every = length // other.shape[1]
        found.append((np.abs(other - own[:, every::every]).max(axis=1) / (part * unit)).max())
    return max(found)


@pytest.mark.parametrize("every", [1, 2])
@pytest.mark.parametrize("which", ["travel", "velocity"])
def test_windows_agree_up_to_what_is_allowed(scene, motion, rng, which, every):
    length, begins = 8, np.array([0, 11, 32])
    nodes = begins[:, None] + np.arange(every, length + 1, every)
    again = [values[nodes] + rng.normal(0.0, 1e-3, (3, length // every, 5)) for values in (motion.q, motion.v)]
    # What hardly moves is measured by others.
    q, v = motion.q.copy(), motion.v.copy()
    q[:, 1], v[:, 1] = q[0, 1], 1e-7 * v[:, 1]
    parts = {"travel": 0.1, "velocity": 0.1} | {which: 1e-4}
    worst = agreement(scene, q, v, begins, length, motion.dt, again, **parts)
    for scale, agrees in ((1.001, True), (0.999, False)):
        allowed = {name: scale * worst * part for name, part in parts.items()}
        assert agrees == windows_agree(
            scene.core, q, v, begins, length, motion.dt, *again, **allowed, little=LITTLE, light=LIGHT, even=EVEN
        )


def test_windows_that_are_no_numbers_do_not_agree(scene, motion):
    again = [values[None, 2:9:2].copy() for values in (motion.q, motion.v)]
    limits = {"travel": 1.0, "velocity": 1.0, "little": LITTLE, "light": LIGHT, "even": EVEN}
    begins = np.zeros(1, dtype=np.int64)
    assert windows_agree(scene.core, motion.q, motion.v, begins, 8, motion.dt, *again, **limits)
    again[1][0, 2, 3] = np.nan
    assert not windows_agree(scene.core, motion.q, motion.v, begins, 8, motion.dt, *again, **limits)
    with refused(ValueError, "motion"):
        windows_agree(scene.core, motion.q, motion.v, begins + 33, 8, motion.dt, *again, **limits)
    with refused(ValueError, "looks", "window"):
        windows_agree(scene.core, motion.q, motion.v, begins, 7, motion.dt, *again, **limits)


def longest_in_numpy(v, u, counts, idle, even):
    fastest = np.abs(v).max(axis=0)
    bend = np.diff(v, n=2, axis=0)
    size = np.abs(bend)
    large = (size > counts * fastest) & (size > idle * fastest.max())
    alike = (size[1:] < even * size[:-1]) & (size[:-1] < even * size[1:])
    turns = (bend[1:] * bend[:-1] < 0.0) & large[1:] & large[:-1] & alike
    jump = np.diff(u, axis=0)
    driven = (jump[1:] * jump[:-1] < 0.0) & (np.abs(jump[1:]) > counts * np.abs(u).max(axis=0))
    turns &= ~driven.any(axis=1, keepdims=True)
    nodes = np.arange(1, len(turns) + 1)[:, None]
    rows = nodes - np.maximum.accumulate(np.where(turns, 0, nodes), axis=0)
    last, joint = np.unravel_index(int(rows.argmax()), rows.shape)
    changes = int(rows[last, joint])
    return int(joint), changes, int(last) + 1 - changes


def test_the_longest_alternation(rng):
    found = []
    for _ in range(30):
        v, u = rng.normal(size=(60, 3)), np.repeat(rng.normal(size=(20, 2)), 3, axis=0)[:59]
        v[:, 1] += 2.0 * (-1.0) ** np.arange(60)
        found.append(longest_alternation(v, u, counts=2e-3, idle=1e-6, even=2.0))
        assert found[-1] == longest_in_numpy(v, u, 2e-3, 1e-6, 2.0)
        assert longest_alternation(v, None, counts=0.3, idle=1e-6, even=2.0) == longest_in_numpy(
            v, np.zeros((59, 0)), 0.3, 1e-6, 2.0
        )
    assert len(set(found)) > 10
    assert longest_alternation(np.zeros((1, 2)), None, counts=2e-3, idle=1e-6, even=2.0)[1] == 0
