"""The whole message of one error of every class. All other tests look at its facts (see refusals.py)."""

import re

import numpy as np
import pinocchio as pin
import pytest

import varpin as vp

CHAIN = vp.planar_chain(2)
BALL = pin.Inertia.FromSphere(1.0, 0.1)
AWAY = vp.PointOnPoint("tip", [3.0, 0.0, 0.0], axes="xz")


def broken(*_):
    raise RuntimeError("no value")


def late(q):
    return 1.0 - q[:1] if q[1] < 0.21 else broken(q)


def drag(q, v):
    return -v if q[1] < 0.21 else broken(q)


def run(state=(1.0, 0.2), steps=3, **options):
    made = {name: options.pop(name) for name in ("forces", "noise", "constraints") if name in options}
    return vp.simulate(vp.Scene(CHAIN, **made), state, [0.0, 1.0], dt=0.01, steps=steps, **options)


def massless():
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelRY(), pin.SE3.Identity(), "j1")
    model.addJoint(joint, pin.JointModelRY(), pin.SE3.Identity(), "j2")
    model.appendBodyToJoint(joint, BALL, pin.SE3.Identity())
    return vp.load_robot(model)


def freeflyer():
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root")
    model.appendBodyToJoint(joint, BALL, pin.SE3.Identity())
    return vp.load_robot(model)


def abs_drag(q, v):
    return -np.abs(v) * v


def plan():
    cost = vp.CustomCost(lambda t, q, v, u: q, name="mine")
    return vp.solve(vp.OptimalControlProblem(vp.Scene(CHAIN), cost, [0, 0], [0, 0], dt=0.1, steps=3))


def scene_file(tmp_path):
    path = tmp_path / "arm.toml"
    path.write_text('[robot]\nsource = "finger"\n[horizon]\ndt = 0.01\nstep = 10\n')
    return vp.load_scene(path)


CASES = {
    vp.RobotError: (lambda _: vp.load_robot(pin.Model()), "robot 'model' has no joint that moves"),
    vp.RobotNotFound: (
        lambda _: vp.load_robot("Panda"),
        "no robot or URDF file 'Panda'; close matches: panda, panda_collision",
    ),
    vp.UnknownJoint: (
        lambda _: vp.Scene(CHAIN, damping={"jont2": 1.0}),
        "damping: the robot has no joint 'jont2'; did you mean 'joint2' or 'joint1'? joints: joint1, joint2",
    ),
    vp.UnsupportedJoint: (
        lambda _: freeflyer(),
        "joint 'root' is a JointModelFreeFlyer, which has no single coordinate in R: hold it with "
        "lock={'root': [7 numbers]}, or describe it as a chain of revolute and prismatic joints",
    ),
    vp.SingularMassMatrix: (
        lambda _: massless(),
        "the mass matrix is singular: motion of 'j2' carries no inertia; give the links it moves mass and inertia, "
        "give the joint an armature, or lock it",
    ),
    vp.InputError: (lambda _: vp.Scene(CHAIN, gravity=[0, 0]), "gravity must have shape (3,), got (2,)"),
    vp.UnknownFrame: (
        lambda _: vp.Scene(CHAIN, forces=vp.FrameWrench("tap", np.ones(6))),
        "robot 'chain2' has no frame 'tap'; did you mean 'tip'? frames: universe, joint1, joint2, tip",
    ),
    vp.UnknownPosture: (
        lambda _: CHAIN.posture("home"),
        "robot 'chain2' has no posture 'home'; postures, from load_robot(..., srdf=path): none",
    ),
    vp.AssemblyError: (
        lambda _: vp.assemble(vp.Scene(CHAIN, constraints=AWAY), [0.1, 0.2]),
        "the constraints cannot be assembled from this q: the closest that was found misses PointOnPoint(a='tip', "
        "b=[3.0, 0.0, 0.0], axes='xz') along x by 1 m or rad, at q = […]; give another q, or correct lengths and "
        "places",
    ),
    vp.FileError: (lambda _: vp.Trajectory.load("/nowhere/run.npz"), "there is no file /nowhere/run.npz"),
    vp.SceneFileError: (
        scene_file,
        "arm.toml: horizon.step: unknown key; did you mean 'steps'? keys: dt, steps, duration, hold, sampling, "
        "controls, between_nodes",
    ),
    vp.CostError: (lambda _: plan(), "mine: function(t, q, v, u) must return shape (6,), got (6, 2)"),
    vp.NoiseFieldError: (
        lambda _: vp.Scene(CHAIN, noise=vp.CustomNoise(broken, 2, check=True)),
        "CustomNoise field(q, v, u) raised RuntimeError('no value')",
    ),
    vp.CustomConstraintError: (
        lambda _: run(constraints=vp.CustomConstraint(1, broken, broken)),
        "the value of a CustomConstraint raised RuntimeError('no value') at q = [1.  0.2]",
    ),
    vp.CustomForceError: (
        lambda _: run(forces=vp.CustomForce(abs_drag, "complex")),
        "CustomForce abs_drag: f drops imaginary parts (abs, comparisons, float): leave derivatives='complex' out: "
        "dF/dv[1, 1] is …, and differences of f give …, at q = […], v = […]",
    ),
    vp.ControlError: (
        lambda _: run(controls=lambda t, q, v: [0.0]),
        "step 0 (t = 0 s): controls(t, q, v) must have shape (2,), got (1,); what came before is in error.trajectory",
    ),
    vp.NoiseError: (
        lambda _: run(noise=vp.CustomNoise(broken, 2), rng=0),
        "step 0 (t = 0 s): CustomNoise field(q, v, u) raised RuntimeError('no value'); what came before is in "
        "error.trajectory",
    ),
    vp.ForceError: (
        lambda _: run(forces=vp.CustomForce(drag)),
        "step 0 (t = 0 s): CustomForce drag: f(q, v) raised RuntimeError('no value') at q = […], v = […]; what came "
        "before is in error.trajectory",
    ),
    vp.ConstraintError: (
        lambda _: run(constraints=vp.CustomConstraint(1, late, lambda q: np.array([[-1.0, 0.0]]))),
        "step 0 (t = 0 s): the value of a CustomConstraint raised RuntimeError('no value') at q = […]; what came "
        "before is in error.trajectory",
    ),
    vp.StepFailure: (
        lambda _: run([1e308, 0.0]),
        "step 0 (t = 0 s) failed: the energy balance of the step does not close. Use a smaller dt. The motion so far "
        "is in error.trajectory",
    ),
}
FORMATTED = {
    vp.MissingDependency: (
        ("video", ["selenium"], 'pip install "varpin[video]"'),
        'video needs selenium: pip install "varpin[video]"',
    ),
    vp.LinearizationError: (
        (3, 0.03, "the correction does not contract"),
        "step 3 (t = 0.03 s) cannot be linearized: the correction does not contract; a smaller dt may help",
    ),
    vp.WorkersLost: (("killed",), "the executor has lost its workers: killed"),
    vp.ToleranceError: (
        (1e-6, 200.0, 4096, 0.5),
        "tolerance = 1e-06 cannot be met over 200 s: with 4096 steps the error in q is still 5.0e-01 rad or m. Give "
        "a shorter duration, as no method follows a chaotic motion to its end, or dt and steps",
    ),
}


@pytest.mark.parametrize("kind", CASES, ids=lambda kind: kind.__name__)
def test_message(kind, tmp_path):
    """As it is raised; an ellipsis stands for what rounding decides."""
    make, message = CASES[kind]
    with pytest.raises(kind) as info:
        make(tmp_path)
    assert type(info.value) is kind
    assert re.fullmatch(".*".join(map(re.escape, message.split("…"))), str(info.value)), str(info.value)


@pytest.mark.parametrize("kind", FORMATTED, ids=lambda kind: kind.__name__)
def test_message_of_attributes(kind):
    """Of those that take long or another environment to raise."""
    arguments, message = FORMATTED[kind]
    assert str(kind(*arguments)) == message


def test_every_public_kind_is_here():
    kinds = {kind for kind in vars(vp).values() if isinstance(kind, type) and issubclass(kind, vp.VarpinError)}
    assert kinds - {vp.VarpinError} == CASES.keys() | FORMATTED.keys()
