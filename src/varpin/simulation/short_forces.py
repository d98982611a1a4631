"""Custom forces that act for less than a step: their impulse at a method's stages is not that between them."""

from __future__ import annotations

import numpy as np

from varpin.finding import Finding
from varpin.integrators import Integrator
from varpin.mechanics.scene import Scene
from varpin.signals.commands import cubics, shares
from varpin.simulation.scales import travel_scales
from varpin.trajectory import Trajectory

# Points of a step at which the force is looked at: none are more than 8 % of the step's travel apart.
_POINTS = 20
# Most steps that are looked at, evenly spaced: each takes as many calls of the function as it has points.
_MOST = 2000
# Error of q by the impulse that stages miss, as a share of the largest travel, from which on it is told: see
# :data:`varpin.simulation.check.TOLD`.
_TOLD = 0.01


def short_forces(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Finding, ...]:
    """A warning if stages miss the impulse of a custom force on its way through a step.

    The force is evaluated along the cubics through the nodes. What the stages miss of its impulse changes velocities,
    and so q up to the end.

    Raises:
        CustomForceError: The function fails between the nodes.
    """
    force = scene.custom
    if force is None or not trajectory.steps:
        return ()
    times = integrator.stage_times or (0.5,)
    x, weights = np.polynomial.legendre.leggauss(_POINTS)
    q, v, dt = trajectory.q, trajectory.v, trajectory.dt
    along = cubics(np.concatenate([np.array(times), 0.5 * (1.0 + x)]), dt)
    missed = np.zeros((trajectory.steps, q.shape[1]))
    for k in np.unique(np.linspace(0, trajectory.steps - 1, _MOST).astype(np.int64)).tolist():
        ends = np.stack([v[k], q[k + 1] - q[k], v[k + 1]])
        at, rate = q[k] + along[:, 1:4] @ ends, along[:, 5:] @ ends
        found = np.array([force(*state, False)[0] for state in zip(at, rate, strict=True)])
        missed[k] = dt * (0.5 * weights @ found[len(times) :] - shares(times) @ found[: len(times)])
    speeds = np.abs(np.linalg.solve(scene.core.jets(q[:-1].copy(), v[:-1].copy())[0], missed[:, :, None])[:, :, 0])
    off = speeds * (trajectory.t[-1] - trajectory.t[:-1, None]) / travel_scales(scene, q)
    step, joint = divmod(int(off.argmax()), off.shape[1])
    if not off[step, joint] > _TOLD:
        return ()
    name, time = trajectory.joint_names[joint], float(trajectory.t[step])
    value, unit = float(np.abs(missed[step]).max()), "N s" if scene.robot.slides[joint] else "N m s"
    text = (
        f"CustomForce {force.names} acts for less than a step on joint {name!r} (t = {time:.3g} s): the stages miss "
        f"{value:.2g} {unit} of its impulse. Use a smaller dt"
    )
    return (Finding("short force", text, name, time=time, value=value, unit=unit),)
