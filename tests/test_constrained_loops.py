"""Control loops of robots under constraints: told when they are unstable at their period, and no others."""

import numpy as np
import pytest
from findings import about

import varpin as vp


def mechanism(name):
    """A scene, a configuration next to its goal, the goal, and the driven joints."""
    if name == "crank":  # one degree of freedom
        robot, closed, seed = vp.planar_chain(3), ((1.3, 0.0, 0.2), "xz"), [-1.5, 1.5, 1.5]
        driven = ["joint1"]
    else:  # two
        robot, closed, seed = vp.planar_chain(4), ((1.6, 0.0, 0.3), "xyz"), [-1.0, 1.0, 1.0, 1.0]
        driven = ["joint1", "joint4"]
    loop = vp.PointOnPoint("tip", closed[0], axes=closed[1])
    scene = vp.Scene(robot, damping=0.05, constraints=loop, actuation=driven)
    goal = vp.assemble(scene, seed)
    return scene, vp.assemble(scene, goal + 0.02 * np.arange(1, robot.dof + 1)), goal


def radius(scene, rest, u, kp, kd, period):
    """Of one period at rest, from the steps' derivatives, along the constraints: x = (q, v), p = M v."""
    n = scene.robot.dof
    motion = vp.simulate(
        scene, rest, np.zeros(n), dt=period / 8, steps=8, controls=u, integrator=vp.Gauss(4), check=False
    )
    lin = vp.linearize(scene, motion)
    A, B = np.eye(2 * n), np.zeros((2 * n, scene.controls))
    for k in range(8):
        A, B = lin.A[k] @ A, lin.A[k] @ B + lin.B[k]
    M = vp.lagrangian_jet(scene, rest, np.zeros(n)).Lvv
    gains = np.concatenate([-kp * scene.actuation.T, -kd * scene.actuation.T @ np.linalg.inv(M)], axis=1)
    return np.abs(np.linalg.eigvals(A + B @ gains)).max()


def at_rest(scene, goal, kp):
    """Where the springs of the law hold the mechanism, and their torques."""
    drive = scene.actuation
    held = vp.Scene(
        scene.robot, constraints=scene.constraints, damping=20.0, stiffness=kp * drive.sum(axis=1), rest=goal
    )
    q = vp.simulate(held, goal, np.zeros(goal.size), dt=0.05, steps=400, integrator=vp.Midpoint(), check=False).q[-1]
    return q, kp * drive.T @ (goal - q)


@pytest.mark.parametrize("name", ["crank", "five-bar"])
def test_a_digital_loop_is_told_when_it_is_unstable(name):
    scene, start, goal = mechanism(name)
    kp, period = 300.0 if name == "crank" else 30.0, 0.02
    rest, u = at_rest(scene, goal, kp)
    seen = []
    for kd in (1.0, 40.0, 160.0):
        wanted = radius(scene, rest, u, kp, kd, period)
        if abs(wanted - 1.0) < 0.002:
            continue

        def law(t, q, v, kd=kd):
            return scene.actuation.T @ (kp * (goal - q) - kd * v)

        try:
            motion = vp.simulate(
                scene, start, np.zeros(goal.size), dt=0.01, steps=80, controls=law, period=2, integrator=vp.Gauss(2)
            )
        except vp.StepFailure as failure:
            motion = failure.trajectory
        assert bool(about(motion.warnings, "unstable loop")) == (wanted > 1.0), (kd, wanted, motion.warnings)
        seen.append(wanted > 1.0)
    assert any(seen)
    assert not all(seen)
