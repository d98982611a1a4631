"""Linearizations of steps in parts and under noise, in the scene that made the motion, and their moments."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest
from findings import about
from mechanisms import random_tree
from oracles import Mechanism, slope
from refusals import refused, unnamed
from zoo import rough

import varpin as vp
from varpin.linearization import linearize_steps


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.RungeKutta4()], ids=str)
def test_velocity_dependent_fields(integrator):
    scene = vp.Scene(vp.load_robot("ur5"), damping=0.1, noise=rough(6, 6, 0.3))
    q, v, u, e, other = np.random.default_rng(0).uniform(-1, 1, (5, 6))
    options = {"dt": 1e-3, "steps": 1, "controls": u, "integrator": integrator, "check": False}
    motion = vp.simulate(scene, q, v, increments=0, **options)
    lin, momenta = vp.linearize(scene, motion), integrator.variational
    second = motion.p[0] if momenta else v

    def field(x):
        M = Mechanism(scene).mass_matrix(x[:6])
        F = scene.noise.fields(x[None, :6], (np.linalg.solve(M, x[6:]) if momenta else x[6:])[None], u[None], q).F[0]
        return lin.J[0] @ (F if momenta else np.linalg.solve(M, F))

    along = np.append(e, np.abs(second).max() * other)
    found = slope(field, np.append(q, second), along, 1e-2)
    np.testing.assert_allclose(lin.Gx[0] @ along, found, rtol=0, atol=1e-8 * np.abs(found).max())


@pytest.mark.parametrize("speed", [0.0, 1.0, 5.0])
@pytest.mark.parametrize(
    "integrator",
    [vp.Midpoint(kick="split"), vp.Gauss(2), vp.Midpoint(kick="held"), vp.ExplicitEuler(), vp.RungeKutta4()],
    ids=str,
)
def test_drift_at_rest_and_moving(integrator, speed):
    """Its derivative does not take the size of a step from a momentum or velocity that may be zero."""
    scene = vp.Scene(vp.load_robot("ur5"), damping=0.1, noise=rough(6, 6, 0.3))
    q, v, u = np.random.default_rng(0).uniform(-1, 1, (3, 6))
    # The check's step is in units of the largest momentum, which turns a light wrist by much more: at 5 rad/s too far.
    step = 2e-3 if speed == 5.0 else 5e-3
    found = vp.check_linearization(scene, q, speed * v, u, dt=1e-3, integrator=integrator, step=step)
    assert found.worst < 1e-8


@pytest.mark.parametrize("integrator", [vp.Midpoint(kick="split"), vp.Gauss(2, kick="held")], ids=str)
@pytest.mark.parametrize("custom", [False, True])
def test_noisy_motions_are_linearized_at_zero_noise(integrator, custom):
    """Each step of one as the step without noise from the same node: a split kick's second half at its end too."""
    noise = rough(6, 6, 0.3) if custom else vp.StateNoise(1.0) + vp.ControlNoise(0.2)
    scene = vp.Scene(vp.load_robot("ur5"), damping=0.1, noise=noise)
    q, v, u = np.random.default_rng(0).uniform(-1, 1, (3, 6))
    noisy = vp.simulate(scene, q, v, dt=1e-3, steps=4, controls=u, integrator=integrator, rng=1)
    lin = vp.linearize(scene, noisy, integrator=integrator)
    for j in range(noisy.steps):
        quiet = vp.simulate(scene, noisy.q[j], noisy.v[j], dt=1e-3, steps=1, controls=u, integrator=integrator)
        alone = linearize_steps(scene, quiet, integrator, noisy.q[0])
        assert np.abs(noisy.v[j + 1] - quiet.v[1]).max() > 1e-4
        for name in ("A", "B", "K", "F", "G", "Gx", "Gu"):
            expected = getattr(alone, name)[0]
            np.testing.assert_allclose(
                getattr(lin, name)[j], expected, rtol=0, atol=1e-10 * np.abs(expected).max(), err_msg=name
            )


def test_moments_against_samples():
    noise = vp.AdditiveNoise(3e-6) + vp.StateNoise(2e-4, center=0.0)
    scene = vp.Scene(vp.load_robot("finger"), damping=1e-6, stiffness=5e-6, noise=noise)
    motion = vp.simulate(scene, [0.4, 0.3, 0.2], [0.0, 0.0, 0.0], dt=5e-3, steps=12)
    lin = vp.linearize(scene, motion)
    mean, spread = np.full(6, 1e-2), 1e-2
    mean[3:] = 1e-8
    covariance = np.diag([spread**2] * 3 + [1e-16] * 3)
    moments = vp.propagate_moments(lin, mean, covariance)
    rng = np.random.default_rng(0)
    samples = 50_000
    x = mean + rng.normal(size=(samples, 6)) * np.sqrt(np.diag(covariance))
    for j in range(lin.steps):
        dw = np.sqrt(lin.dt) * rng.normal(size=(samples, scene.processes))
        x = x @ lin.A[j].T + np.einsum("sai,si->sa", lin.G[j] + np.einsum("aib,sb->sai", lin.Gx[j], x), dw)
    deviation = x - x.mean(axis=0)
    products = deviation[:, :, None] * deviation[:, None, :]
    error = np.abs(x.mean(axis=0) - moments.mean[-1]) / (x.std(axis=0) / np.sqrt(samples))
    assert error.max() < 4.0
    error = np.abs(products.mean(axis=0) - moments.covariance[-1]) / (products.std(axis=0) / np.sqrt(samples))
    assert error.max() < 4.0


def test_what_is_no_covariance_is_refused():
    scene = vp.Scene(vp.planar_chain(1))
    lin = vp.linearize(scene, vp.simulate(scene, [0.1], [0.0], dt=0.01, steps=2))
    for wrong, facts in (
        (-np.eye(2), ("positive semidefinite", "-1")),
        ([[1.0, 2.0], [2.0, 1.0]], ("positive semidefinite", "-1")),
        ([[0.0, 1.0], [1.0, 0.0]], "positive semidefinite"),
        ([[1.0, 0.5], [0.4, 1.0]], "symmetric"),
    ):
        with refused(vp.InputError, facts):
            vp.propagate_moments(lin, covariance=wrong)
    # Units of momentum may be tiny beside those of angles, and a matrix of rank one is no less a covariance.
    direction = np.array([1.0, 1e-9])
    given = np.outer(direction, direction)
    np.testing.assert_array_equal(vp.propagate_moments(lin, covariance=given).covariance[0], given)


ARMS = {
    "double_pendulum": (0.1, 8.0, {"damping": 0.02}),
    "finger": (0.03, 12.0, {"stiffness": 1e-5}),
    "ur5": (0.15, 4.0, {"damping": 0.1, "stiffness": 1.0}),
}


def parts_of(motion):
    """The halvings of each step, none for one that was taken whole."""
    counts = np.where(motion.statistics.substeps > 1, motion.statistics.substeps, 0)
    return np.split(motion.statistics.halvings, np.cumsum(counts)[:-1])


def composed(scene, integrator, dt, halvings, q, p, u):
    plain = type(integrator)(**{**vars(integrator), "guard": None})
    for level in halvings:
        v = np.linalg.solve(vp.lagrangian_jet(scene, q, np.zeros_like(q)).Lvv, p)
        given = {"dt": dt / 2.0**level, "steps": 1, "controls": u, "integrator": plain}
        step = vp.simulate(scene, q, v, check=False, **given)
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
    """Against differences of plain steps in the same parts, which a fresh start would not have taken."""
    scene, motion = moving(name, integrator, seed)
    k = next(taken_otherwise(scene, motion, integrator))
    lin, n, rng = vp.linearize(scene, motion), scene.robot.dof, np.random.default_rng(0)
    units = units_of(scene, motion.q[k], motion.v[k])
    point = np.concatenate([motion.q[k], motion.p[k], motion.u[k]])
    given = np.hstack([lin.A[k], lin.B[k]]) * units / units[: 2 * n, None]

    def end(y):
        q, p, u = np.split(y, 3)
        return composed(scene, integrator, motion.dt, parts_of(motion)[k], q, p, u)

    for block in (slice(0, 2 * n), slice(2 * n, 3 * n)):
        e = np.zeros(3 * n)
        e[block] = rng.uniform(-1.0, 1.0, e[block].size)
        expected = slope(end, point, e * units, 3e-3 / np.abs(given[:, block]).max()) / units[: 2 * n]
        np.testing.assert_allclose(given @ e, expected, rtol=0, atol=1e-8 * np.abs(expected).max())
    np.testing.assert_array_equal(lin.K[k], lin.A[k][:, n:])


@pytest.mark.parametrize(("name", "integrator", "seed"), CASES[::3], ids=str)
def test_second_derivatives_are_those_of_the_parts_taken(name, integrator, seed):
    scene, motion = moving(name, integrator, seed)
    k = next(taken_otherwise(scene, motion, integrator))
    step, n, rng = motion.part(k, k + 1), scene.robot.dof, np.random.default_rng(seed)
    units = units_of(scene, step.q[0], step.v[0])
    z = rng.normal(size=2 * n) / units[: 2 * n]
    e, other = rng.uniform(-1.0, 1.0, (2, 3 * n)) * units
    second = vp.second_order(scene, step, z)
    given = np.block([[second.xx[0], second.ux[0].T], [second.ux[0], second.uu[0]]])

    def gradient(y):
        q, p = (np.vstack([y[i : i + n], y[i : i + n]]) for i in (0, n))
        lin = vp.linearize(scene, replace(step, q=q, p=p, u=y[None, 2 * n :]))
        return z @ np.hstack([lin.A[0], lin.B[0]]) @ other

    A = vp.linearize(scene, step).A[0] * units[: 2 * n] / units[: 2 * n, None]
    point = np.concatenate([step.q[0], step.p[0], step.u[0]])
    expected = slope(gradient, point, e, 3e-3 / max(1.0, np.abs(A).max()))
    assert abs(other @ given @ e - expected) < 1e-7 * np.abs(given * np.outer(units, units)).max()


def test_parts_are_kept_however_a_motion_is_made():
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
    integrator = vp.Midpoint(kick=kick)
    scene, motion = moving("double_pendulum", integrator, 0, noise=vp.AdditiveNoise(0.05), rng=3)
    assert motion.dw.any()
    lin = vp.linearize(scene, motion)
    checked = 0
    for k, halvings in enumerate(parts_of(motion)[:4]):
        units = units_of(scene, motion.q[k], motion.v[k])[:4]
        e = units * np.random.default_rng(k).uniform(-1.0, 1.0, 4)
        lengths = halvings if len(halvings) else [0]

        def end(y, k=k, lengths=lengths):
            return composed(scene, integrator, motion.dt, lengths, y[:2], y[2:], motion.u[k])

        size = 1e-3 / max(1.0, np.abs(lin.A[k] * units / units[:, None]).max())
        expected = slope(end, np.append(motion.q[k], motion.p[k]), e, size)
        np.testing.assert_allclose(lin.A[k] @ e, expected, rtol=0, atol=1e-7 * np.abs(expected).max())
        checked += len(halvings) > 1
    assert checked > 1


# --- in the scene that made a motion, and no other -------------------------------------------------------------------


UR5 = {"damping": 0.1, "stiffness": 2.0, "rest": 0.3, "noise": vp.AdditiveNoise(1e-3)}
PUSH = vp.FrameWrench("tool0", [3.0, -2.0, 5.0, 0.0, 0.0, 0.0])
SPRING = vp.FrameSpring("tool0", ("forearm_link", [0.05, 0.1, 0.0]), 8.0)
OTHERS = {
    "damping": {"damping": [0.1, 0.1, 0.4, 0.1, 0.1, 0.1]},
    "stiffness": {"stiffness": 3.0},
    "rest": {"rest": 0.2},
    "gravity": {"gravity": False},
    "actuation": {"actuation": 2.0 * np.eye(6)},
    "armature": {"forces": vp.Armature(0.1)},
    "CoulombFriction": {"friction": 1.0},
    "FrameLoad": {"forces": PUSH},
    "FrameSpring": {"forces": SPRING},
    "functions": {"forces": vp.CustomForce(lambda q, v: -5.0 * v)},
    "constraints.ties": {"constraints": vp.JointTie("wrist_3_joint", "wrist_2_joint")},
    "constraints.between": {"constraints": vp.PointOnPlane("tool0", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))},
}


def motion_of(scene, **options):
    n = scene.robot.dof
    return vp.simulate(scene, np.full(n, 0.2), np.full(n, 0.5), dt=1e-3, steps=5, **options)


@pytest.mark.parametrize("name", OTHERS)
def test_another_scene_is_refused_by_what_differs(load, name, tmp_path):
    """Whichever of the two has it, and where the motion has been in a file."""
    robot = load("ur5")
    one, other = vp.Scene(robot, **UR5), vp.Scene(robot, **UR5 | OTHERS[name])
    motion = motion_of(one)
    for calls in (vp.linearize, lambda scene, motion: vp.second_order(scene, motion, np.ones(12))):
        with refused(vp.InputError, name) as caught:
            calls(other, vp.Trajectory.load(motion.save(tmp_path / "motion.npz")))
    assert "differs in " + name + ". " in str(caught.value)
    if not other.constraints:
        with refused(vp.InputError, name):
            vp.linearize(one, motion_of(other))


def test_another_function_is_refused_by_what_it_makes_of_the_first_step():
    one, other = (vp.Scene(vp.planar_chain(2), forces=vp.CustomForce(lambda q, v, k=k: k * v)) for k in (-0.5, -0.6))
    assert vp.linearize(one, motion_of(one)).steps == 5
    with refused(vp.InputError, "first step differs"):
        vp.linearize(other, motion_of(one))


@pytest.mark.parametrize("rows", [[], [[0.0, 3.0, 5.0, 0.7]]], ids=["idle", "acting"])
def test_forces_of_another_core_are_refused_by_name(load, rows, tmp_path):
    """A core with a force of one's own stores it under its name, without rows where it did not act."""
    scene = vp.Scene(load("ur5"))
    motion = motion_of(scene)
    values = {**motion.scene_values, "RubberBush": np.array(rows)}
    loaded = vp.Trajectory.load(replace(motion, scene_values=values).save(tmp_path / "motion.npz"))
    np.testing.assert_array_equal(loaded.scene_values["RubberBush"], rows)
    with refused(vp.InputError, "RubberBush") if rows else contextlib.nullcontext():
        assert vp.linearize(scene, loaded).A.shape == (5, 12, 12)


@pytest.mark.parametrize("fact", ["masses", "translation", "inertia", "armature", ""])
def test_robots_of_the_same_joints_are_told_apart(fact):
    model = random_tree(3, bodies=3)
    motion, other = motion_of(vp.Scene(vp.load_robot(model))), model.copy()
    body, place = other.inertias[2], other.jointPlacements[2]
    if fact == "masses":
        body.mass *= 1.5
    elif fact == "translation":
        place.translation = 1.1 * place.translation
    elif fact == "inertia":
        body.inertia = 1.2 * body.inertia
    elif fact == "armature":
        other.armature = other.armature + np.array([0.0, 0.0, 0.5])
    scene = vp.Scene(vp.load_robot(other))
    with refused(vp.InputError, fact) if fact else contextlib.nullcontext():
        assert vp.linearize(scene, motion).steps == 5


def test_scenes_that_are_alike_are_the_same(load, tmp_path):
    """Other objects of the same numbers, rounding apart, a motion that has been away, noise of which none was drawn."""
    motion = motion_of(vp.Scene(load("ur5"), **UR5))
    back = vp.Trajectory.load(motion.save(tmp_path / "motion.npz"))
    for name, values in motion.scene_values.items():
        np.testing.assert_array_equal(back.scene_values[name], values)
    again = vp.Scene(vp.load_robot("ur5"), **UR5 | {"damping": 0.1 * (1.0 + 1e-13)})
    stronger = vp.Scene(load("ur5"), **UR5 | {"noise": vp.AdditiveNoise(0.1)})
    exact = vp.linearize(vp.Scene(load("ur5"), **UR5), motion)
    for given in (motion, back, motion.part(1, 4)):
        assert vp.linearize(again, given).steps == given.steps
    np.testing.assert_array_equal(vp.linearize(stronger, motion).A, exact.A)
    kicked = motion_of(vp.Scene(load("ur5"), **UR5), rng=0)
    with refused(vp.InputError, "noise"):
        vp.linearize(stronger, kicked)


def test_a_checked_linearization_has_a_verdict():
    chain, q, v = vp.planar_chain(2), [0.3, -0.2], [1.0, 0.5]
    good = vp.check_linearization(vp.Scene(chain, damping=0.1), q, v, dt=1e-2)
    assert good.holds
    assert about(str(good).splitlines()[-1], "right derivatives")
    coarse = vp.check_linearization(vp.Scene(chain, damping=0.1), q, v, dt=1e-2, step=1.0)
    assert not coarse.holds
    assert about(str(coarse), "another difference")
    wrong = type(good)(A=good.A, B=(0.5, 1.0), G=good.G)
    assert not unnamed(str(wrong).splitlines()[-1], "B", "5.0e-01")
