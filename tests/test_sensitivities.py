"""Sensitivities of motions in parameters, against differences of motions."""

import numpy as np
import pytest
from oracles import slope
from refusals import refused
from zoo import ZOO

import varpin as vp
from varpin.estimation.parameters import parameters_of

JOINTS = np.array([0.3, -0.5, 0.4, 0.2, -0.6, 0.5])


def differenced(scene, names, motion):
    """Derivatives of q, v and p (3, N + 1, n, P) by differences of fourth order, one-sided at the least values."""
    of = parameters_of(scene, names)
    found = []
    for k, value in enumerate(of.values):
        apart = 1e-3 * max(abs(value), 0.1)

        def at(shift, k=k, apart=apart):
            moved = of.values.copy()
            moved[k] += shift * apart
            again = motion(of.scene_with(moved))
            return np.array([again.q, again.v, again.p])

        if value - 2.0 * apart < of.least[k]:
            weights = {0: -25.0, 1: 48.0, 2: -36.0, 3: 16.0, 4: -3.0}
        else:
            weights = {-2: 1.0, -1: -8.0, 1: 8.0, 2: -1.0}
        found.append(sum(weight * at(shift) for shift, weight in weights.items()) / (12.0 * apart))
    return np.stack(found, axis=3)


def agree(found, wanted, within=1e-7):
    """Each parameter's q, v and p agree relative to their largest; rounding of differences is up to 1e-8."""
    sizes = np.abs(wanted).max(axis=(1, 2))
    off = np.abs(found - wanted).max(axis=(1, 2))
    assert sizes.max() > 1e-3
    assert (off <= within * np.maximum(sizes, 1e-2 * sizes.max(axis=0)) + 1e-8).all(), (off / sizes).round(10)


def shaken(scene, integrator, dt=5e-3, steps=40, q0=JOINTS, v0=0.5, size=0.3, *, line=False):
    rng = np.random.default_rng(3)
    u = size * rng.standard_normal((steps + line, scene.controls))
    u = vp.FirstOrderHold(u) if line else u
    start = {"q0": q0, "v0": np.full(scene.robot.dof, v0)}
    return lambda of: vp.simulate(of, **start, dt=dt, steps=steps, controls=u, integrator=integrator, check=False)


def compare(scene, names, motion):
    of = motion(scene)
    found = vp.sensitivities(scene, of, names)
    agree(np.array([found.q, found.v, found.p]), differenced(scene, names, motion))
    return of, found


FORCES = [vp.JointSpring(3.0, 0.1), vp.Armature(0.01), vp.CoulombFriction(0.5, width=0.5, breakaway=0.7,
                                                                          stribeck_velocity=0.6)]  # fmt: skip
NAMES = ["damping", "friction:elbow_joint", "stiffness", "rest:elbow_joint", "armature", "payload"]
NAMES += ["inertia:forearm_link"]


@pytest.mark.parametrize(
    "integrator",
    [vp.Midpoint(), vp.Gauss(2), vp.Radau(2), vp.RungeKutta4(), vp.SemiImplicitEuler(), vp.ExplicitEuler()],
    ids=str,
)
def test_derivatives_are_those_of_differences(integrator):
    scene = vp.Scene(vp.load_robot("ur5"), damping=0.3, forces=FORCES)
    motion, found = compare(scene, NAMES, shaken(scene, integrator))
    assert len(found.names) == 6 + 1 + 6 + 1 + 6 + 1 + 10
    # The adjoint pass against the forward one; start and controls against differences.
    rng = np.random.default_rng(5)
    losses = rng.standard_normal((3, *motion.q.shape))
    gradient = found.gradient(losses[0], loss_v=losses[1], loss_p=losses[2])
    forward = sum(
        np.einsum("ka,kap->p", loss, own) for loss, own in zip(losses, (found.q, found.v, found.p), strict=True)
    )
    np.testing.assert_allclose(gradient.parameters, forward, rtol=0.0, atol=1e-12 * np.abs(forward).max())
    along = rng.standard_normal(6), rng.standard_normal(6), rng.standard_normal(motion.u.shape)

    def loss(size):
        start = {"q0": motion.q[0] + size * along[0], "v0": motion.v[0] + size * along[1]}
        again = vp.simulate(scene, **start, dt=5e-3, steps=40, controls=motion.u + size * along[2],
                            integrator=integrator, check=False)  # fmt: skip
        return sum(np.sum(loss * own) for loss, own in zip(losses, (again.q, again.v, again.p), strict=True))

    parts = gradient.q0 @ along[0] + gradient.v0 @ along[1] + np.sum(gradient.u * along[2])
    assert parts == pytest.approx(slope(loss, 0.0, 1.0, 1e-4), rel=1e-7)


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(2), vp.RungeKutta4()], ids=str)
@pytest.mark.parametrize(("effort", "line"), [(np.inf, False), (5.0, False), (np.inf, True)])
def test_gains_of_servos(integrator, effort, line):
    servo = vp.PositionServo([100.0, 60.0, 10.0], [6.0, 3.0, 0.3], effort)
    scene = vp.Scene(vp.planar_chain(3), damping=0.1, forces=servo)
    names = ["servo_stiffness", "servo_damping", "damping"]
    compare(scene, names, shaken(scene, integrator, q0=JOINTS[:3], size=0.1, line=line))


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(2)], ids=str)
@pytest.mark.parametrize("name", ["five-bar", "steered joint", "cranked five-bar", "weld"])
def test_motions_under_constraints(name, integrator):
    case = ZOO[name]
    scene = case.scene
    frame = scene.robot.model.frames[-1].name
    shape = (30, scene.controls)
    u = np.zeros(shape) if not scene.inputs else np.tile(scene.command_at(case.q0), (30, 1))
    start = {"q0": case.q0, "v0": case.v0}
    compare(
        scene,
        ["damping", "armature", f"payload:{frame}"],
        lambda of: vp.simulate(of, **start, dt=5e-3, steps=30, controls=u, integrator=integrator, check=False),
    )


def test_divided_steps():
    scene = vp.Scene(vp.planar_chain(3), damping=0.05)
    motion = shaken(scene, vp.Midpoint(), dt=0.1, steps=8, q0=np.array([2.0, 1.0, -1.0]), v0=4.0)
    of, _ = compare(scene, ["damping", "payload"], motion)
    assert of.statistics.split_steps > 0


def test_what_is_refused():
    scene = vp.Scene(vp.load_robot("ur5"), damping=0.1, noise=vp.AdditiveNoise(0.1))
    motion = vp.simulate(scene, q0=JOINTS, v0=np.zeros(6), dt=5e-3, steps=3, rng=1)
    with refused(vp.InputError, "noise"):
        vp.sensitivities(scene, motion, "damping")
    quiet = vp.simulate(scene, q0=JOINTS, v0=np.zeros(6), dt=5e-3, steps=3)
    for names, facts in {
        "dampin": ("dampin", "damping", "payload"),
        "servo_stiffness": ("servo_stiffness", "PositionServo"),
        "rest:elbow_joint": ("elbow_joint", "JointSpring"),
        "inertia:base_link": ("base_link", "base"),
        "inertia:forearm_link:Izx": ("Izx", "Ixz"),
    }.items():
        with refused(vp.InputError, *facts):
            vp.sensitivities(scene, quiet, names)
    with refused(vp.InputError, "damping:elbow_joint", "twice"):
        vp.sensitivities(scene, quiet, ["damping", "damping:elbow_joint"])
    with refused(vp.UnknownJoint, "elbow"):
        vp.sensitivities(scene, quiet, "damping:elbow")
