"""Velocities under noise: whether an integrator gives them their spread where damping is fast for the step.

Without springs a mode of M w' = -D w + F dW/dt with rate l has the variance g^2 (1 - exp(-2 l t)) / (2 l) after a time
t, and under an integrator that keeps R of a velocity in a step of h, and N of an impulse, h g^2 N^2 (1 - R^(2 k)) /
(1 - R^2) after k steps.
"""

from __future__ import annotations

import numpy as np

from varpin.arrays import Floats
from varpin.finding import Finding
from varpin.integrators import Integrator, Midpoint
from varpin.integrators.base import noise_fields
from varpin.mechanics.scene import Scene
from varpin.simulation.spectrum import damping_matrices, masses
from varpin.trajectory import Trajectory

# Share by which a standard deviation is off that is told.
_OFF = 0.1
# Nodes of a motion at which covariances are looked at.
_NODES = 12
# Least rate, as a share of one over the duration: slower modes differ by nothing.
_SLOWEST = 1e-6
# Least variance, as a share of the largest: rounding.
_NOTHING = 1e-12


def wrong_spread(
    scene: Scene, integrator: Integrator, trajectory: Trajectory, smaller: str = "a smaller dt"
) -> tuple[Finding, ...]:
    """A warning if the noise of the scene gives a velocity a standard deviation that is off by more than a tenth.

    ``smaller`` is what the caller gives for shorter steps.
    """
    if not (scene.dissipates and scene.processes and trajectory.steps):
        return ()
    with np.errstate(all="ignore"):
        right, own, rate = _covariances(scene, integrator, trajectory)
        ratios = np.sqrt(own / np.where(right > _NOTHING * right.max(), right, np.inf))
    off = np.where((ratios > 0.0) & np.isfinite(ratios), np.abs(ratios - 1.0), 0.0)
    joint = int(off.argmax())
    if not off[joint] > _OFF:
        return ()
    other = Midpoint(kick="held")
    cure = smaller if integrator.same_map(other) else "integrator=varpin.Midpoint(kick='held')"
    name, share = trajectory.joint_names[joint], float(ratios[joint])
    text = (
        f"noise gives the velocity of joint {name!r} {share:.2g} times its standard deviation, as damping "
        f"({rate:.3g}/s) is fast for the step. Use {cure}"
    )
    return (Finding("noise of velocities", text, name, value=share),)


def _covariances(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Floats, Floats, float]:
    """Variances of velocities (n,) at the end of a motion, as they are and by an integrator; and the fastest rate."""
    at = np.unique(np.linspace(0, trajectory.steps - 1, _NODES).astype(np.int64))
    q, v, dt, steps = trajectory.q[at], trajectory.v[at], trajectory.dt, trajectory.steps
    F = noise_fields(scene, trajectory, q, v, trajectory.q[0], at).F[:, :, : scene.processes]
    M, D = masses(scene, q), damping_matrices(scene, q, v, trajectory.u[at] @ scene.actuation.T, custom=True)
    one = free = np.eye(q.shape[1])
    if scene.constraints:
        C = scene.core.constraints(q)[2]
        free = one - np.linalg.pinv(C) @ C
    # What constraints hold has a unit mass, no damper and no noise.
    root = np.linalg.cholesky(free @ M @ free + one - free)
    white = np.linalg.solve(root, np.swapaxes(np.linalg.solve(root, free @ D @ free), 1, 2))
    rates, modes = np.linalg.eigh(white)
    rates = np.maximum(rates, _SLOWEST / (steps * dt))
    modes = free @ np.linalg.solve(np.swapaxes(root, 1, 2), modes)
    kept, added = (factor.reshape(rates.shape) for factor in integrator.damped(dt * rates.ravel()))
    excited = np.swapaxes(modes, 1, 2) @ F
    excited = excited @ np.swapaxes(excited, 1, 2)

    def pairs(factor: Floats) -> Floats:
        return factor[:, :, None] * factor[:, None]

    both = rates[:, :, None] + rates[:, None]
    own = dt * pairs(added) * (1.0 - pairs(kept) ** steps) / (1.0 - pairs(kept))
    right = -np.expm1(-both * steps * dt) / both
    variances = (((modes @ (excited * sums)) * modes).sum(axis=(0, 2)) for sums in (right, own))
    return *variances, float(rates.max())
