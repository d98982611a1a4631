"""Steps that the guards took in parts: what a motion keeps of the parts, and the derivatives of exactly these."""

from dataclasses import replace

import numpy as np
import pytest

import varpin as vp

WEIGHTS = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}

ARMS = {
    "double_pendulum": (0.1, 8.0, {"damping": 0.02}),
    "finger": (0.03, 12.0, {"stiffness": 1e-5}),
    "ur5": (0.15, 4.0, {"damping": 0.1, "stiffness": 1.0}),
}


def velocity(scene, q, p):
    return np.linalg.solve(vp.lagrangian_jet(scene, q, np.zeros_like(q)).Lvv, p)


def parts_of(motion):
    """The halvings of each step, none for one that was taken whole."""
    counts = np.where(motion.statistics.substeps > 1, motion.statistics.substeps, 0)
    return np.split(motion.statistics.halvings, np.cumsum(counts)[:-1])


def composed(scene, integrator, dt, halvings, q, p, u):
    """(q1, p1) of plain steps without guards, one after another."""
    plain = type(integrator)(**{**vars(integrator), "guard": None})
    for level in halvings:
        step = vp.simulate(
            scene, q, velocity(scene, q, p), dt=dt / 2.0**level, steps=1, controls=u, integrator=plain, check=False
        )
        q, p = step.q[1], step.p[1]
    return np.concatenate([q, p])


def units_of(scene, q, v):
    light = 0.5 / np.diag(np.linalg.inv(vp.lagrangian_jet(scene, q, v).Lvv))
    return np.concatenate([np.ones(len(q)), light, np.abs(scene.actuation.T) @ light])


def moving(name, integrator, seed, rng=None, **extras):
    dt, speed, surroundings = ARMS[name]
    scene = vp.Scene(vp.load_robot(name), **(surroundings | extras))
    n, drawn = scene.robot.dof, np.random.default_rng(seed)
    q, v = drawn.uniform(-1.5, 1.5, n), speed * drawn.normal(size=n)
    u = 0.1 * drawn.normal(size=(8, n)) * np.abs(vp.lagrangian_jet(scene, q, v).Lq).max()
    return scene, vp.simulate(scene, q, v, dt=dt, steps=8, controls=u, integrator=integrator, rng=rng, check=False)


CASES = [
    ("double_pendulum", vp.Midpoint(), 0),
    ("double_pendulum", vp.Midpoint(alpha=0.3), 1),
    ("double_pendulum", vp.Gauss(2), 1),
    ("finger", vp.Midpoint(), 1),
    ("finger", vp.Gauss(2), 1),
    ("finger", vp.Radau(2), 1),
    ("ur5", vp.Midpoint(), 0),
    ("ur5", vp.Gauss(2), 0),
]
each_case = pytest.mark.parametrize(("name", "integrator", "seed"), CASES, ids=str)


def taken_otherwise(scene, motion, integrator):
    """Steps in parts, of which a fresh start from their node would take others."""
    for k, halvings in enumerate(parts_of(motion)):
        if len(halvings):
            again = vp.simulate(
                scene, motion.q[k], motion.v[k], dt=motion.dt, steps=1, controls=motion.u[k], integrator=integrator,
                check=False,
            )  # fmt: skip
            if not np.array_equal(again.statistics.halvings, halvings):
                yield k


@each_case
def test_parts_are_those_of_the_motion(name, integrator, seed):
    """Plain steps of these lengths, one after another, lead from node to node."""
    scene, motion = moving(name, integrator, seed)
    assert motion.statistics.split_steps > 3
    parts = parts_of(motion)
    assert [max(len(halvings), 1) for halvings in parts] == motion.statistics.substeps.tolist()
    for k, halvings in enumerate(parts):
        lengths = halvings if len(halvings) else [0]
        end = composed(scene, integrator, motion.dt, lengths, motion.q[k], motion.p[k], motion.u[k])
        for found, node in zip(np.split(end, 2), (motion.q[k + 1], motion.p[k + 1]), strict=True):
            np.testing.assert_allclose(found, node, rtol=0, atol=1e-10 * np.abs(node).max())


@each_case
def test_derivatives_are_those_of_the_parts_taken(name, integrator, seed):
    """Against eighth-order differences of plain steps in the same parts, which a fresh start would not have taken."""
    scene, motion = moving(name, integrator, seed)
    k = next(taken_otherwise(scene, motion, integrator))
    lin = vp.linearize(scene, motion)
    n, u = scene.robot.dof, motion.u[k]
    units = units_of(scene, motion.q[k], motion.v[k])
    point = np.concatenate([motion.q[k], motion.p[k], u])
    given = np.hstack([lin.A[k], lin.B[k]]) * units / units[: 2 * n, None]
    sizes = 3e-3 / np.abs(given).max(axis=0)

    def end(y):
        return composed(scene, integrator, motion.dt, parts_of(motion)[k], y[:n], y[n : 2 * n], y[2 * n :])

    expected = np.zeros_like(given)
    for c, e in enumerate(np.diag(sizes * units)):
        slope = sum(w * (end(point + i * e) - end(point - i * e)) for i, w in WEIGHTS.items()) / sizes[c]
        expected[:, c] = slope / units[: 2 * n]
    for block in (slice(0, 2 * n), slice(2 * n, 3 * n)):
        error = np.abs(given[:, block] - expected[:, block]).max()
        assert error < 1e-8 * np.abs(expected[:, block]).max()
    np.testing.assert_array_equal(lin.K[k], lin.A[k][:, n:])


@pytest.mark.parametrize(("name", "integrator", "seed"), CASES[::3], ids=str)
def test_second_derivatives_are_those_of_the_parts_taken(name, integrator, seed):
    """Against differences of the first, the parts held."""
    scene, motion = moving(name, integrator, seed)
    k = next(taken_otherwise(scene, motion, integrator))
    step, n = motion.part(k, k + 1), scene.robot.dof
    units = units_of(scene, step.q[0], step.v[0])
    z = np.random.default_rng(seed).normal(size=2 * n) / units[: 2 * n]
    second = vp.second_order(scene, step, z)
    given = np.block([[second.xx[0], second.ux[0].T], [second.ux[0], second.uu[0]]]) * np.outer(units, units)
    A = vp.linearize(scene, step).A[0] * units[: 2 * n] / units[: 2 * n, None]
    size = 3e-3 / max(1.0, np.abs(A).max())

    def gradient(y):
        q, p = (np.vstack([y[i : i + n], y[i : i + n]]) for i in (0, n))
        lin = vp.linearize(scene, replace(step, q=q, p=p, u=y[None, 2 * n :]))
        return (z @ np.hstack([lin.A[0], lin.B[0]])) * units

    point = np.concatenate([step.q[0], step.p[0], step.u[0]])
    expected = np.array(
        [
            sum(w * (gradient(point + i * e) - gradient(point - i * e)) for i, w in WEIGHTS.items()) / size
            for e in size * np.diag(units)
        ]
    )
    assert np.abs(given - expected).max() < 1e-7 * np.abs(expected).max()


def test_parts_are_kept_however_a_motion_is_made():
    """In one rollout, a step at a time under a law, and up to a step that fails."""
    integrator = vp.Midpoint()
    scene, motion = moving("finger", integrator, 1)
    expected = motion.statistics
    start, options = (motion.q[0], motion.v[0]), {"dt": motion.dt, "steps": motion.steps, "check": False}
    law = {"controls": lambda t, q, v: motion.u[round(t / motion.dt)], "integrator": integrator}
    by_law = vp.simulate(scene, *start, **law, **options)
    np.testing.assert_array_equal(by_law.statistics.halvings, expected.halvings)
    strict = vp.Midpoint(guard=vp.Guard(max_halvings=2))
    with pytest.raises(vp.StepFailure) as failure:
        vp.simulate(scene, *start, controls=motion.u, integrator=strict, **options)
    before = failure.value.trajectory
    assert before.steps > 0
    np.testing.assert_array_equal(before.statistics.halvings, expected.part(0, before.steps).halvings)


@pytest.mark.parametrize("kick", ["left", "split"])
def test_noisy_steps_are_taken_in_parts_without_their_kick(kick):
    """Weak noise, by differences of the same parts from the node without its kick."""
    integrator = vp.Midpoint(kick=kick)
    scene, motion = moving("double_pendulum", integrator, 0, noise=vp.AdditiveNoise(0.05), rng=3)
    assert motion.dw.any()
    lin = vp.linearize(scene, motion)
    checked = 0
    for k, halvings in enumerate(parts_of(motion)[:4]):
        units = units_of(scene, motion.q[k], motion.v[k])[:4]
        point = np.concatenate([motion.q[k], motion.p[k]])
        lengths = halvings if len(halvings) else [0]
        size = 1e-3 / max(1.0, np.abs(lin.A[k] * units / units[:, None]).max())

        def end(y, k=k, lengths=lengths):
            return composed(scene, integrator, motion.dt, lengths, y[:2], y[2:], motion.u[k])

        slopes = [
            sum(w * (end(point + i * e) - end(point - i * e)) for i, w in WEIGHTS.items()) / size
            for e in size * np.diag(units)
        ]
        expected = np.transpose(slopes) / units
        np.testing.assert_allclose(lin.A[k], expected, rtol=0, atol=1e-7 * np.abs(expected).max())
        checked += len(halvings) > 1
    assert checked > 1
