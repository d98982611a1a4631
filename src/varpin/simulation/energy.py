"""The energy ledger of a finished motion, for integrators that keep none of their own."""

from __future__ import annotations

import numpy as np

from varpin.arrays import Floats
from varpin.integrators import Integrator
from varpin.integrators.base import noise_impulses
from varpin.integrators.explicit import accelerations
from varpin.mechanics.scene import Scene
from varpin.signals.commands import cubics, shares
from varpin.trajectory import Trajectory


def energy_defects(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> Floats:
    """Energy defect after each step (N,) [J]: the change of energy less work of controls, dampers and kicks.

    It is computed from the record, for integrators without an energy balance of their own. The energy that dampers take
    is that of velocities linear over a step. Zeros with noise that only Python can evaluate.
    """
    if scene.noise.diffusion is None:
        return np.zeros(trajectory.steps)
    gained: Floats = trajectory.energy[1:] - trajectory.energy[0]
    acts = scene.dissipates or scene.couplings or scene.custom is not None
    if trajectory.u.any() or trajectory.u_stages.any() or trajectory.dw.any() or acts:
        kicked, given = _kicks(scene, trajectory)
        work, heat = _works(scene, integrator, trajectory, kicked)
        gained -= np.cumsum((work - heat + given).sum(axis=1))
    return gained if np.isfinite(gained).all() else np.nan_to_num(gained, nan=np.inf)


def _works(
    scene: Scene, integrator: Integrator, trajectory: Trajectory, kicked: Floats | float = 0.0
) -> tuple[Floats, Floats]:
    """Work of the controls, and the least energy that the dampers take, at each joint in each step (N, n) [J].

    Forces of servos count as dampers. The mean of a control over a step works on the step's displacement; its deviation
    from the mean, where controls change within steps, on the velocity of the cubic through both nodes. A kick of v
    (N, n) begins each step. Dampers, and all other friction, take least at constant velocity, which is the displacement
    over the step.
    """
    h, before, after = trajectory.dt, trajectory.v[:-1] + kicked, trajectory.v[1:]
    with np.errstate(over="ignore", invalid="ignore"):
        displacement = np.diff(trajectory.q, axis=0)
        force = np.ascontiguousarray(trajectory.u @ scene.actuation.T)
        work = force * displacement
        if trajectory.u_stages.shape[1]:
            rest = (trajectory.u_stages - trajectory.u[:, None]) @ scene.actuation.T
            along = cubics(np.array(integrator.stage_times), h)[:, 5:]
            speed = np.einsum("se,ekn->ksn", along, np.stack([before, displacement, after]))
            work = work + h * np.einsum("s,ksn->kn", shares(integrator.stage_times), rest * speed)
        even = (displacement / h) ** 2
        heat = h * np.minimum((before**2 + before * after + after**2) / 3.0, even) * scene.damping
        if scene.dissipates or scene.couplings:
            middle = 0.5 * (trajectory.q[1:] + trajectory.q[:-1])
            heat -= scene.core.forces(middle, displacement / h, force)[0] * displacement + h * even * scene.damping
    return work, heat


def _kicks(scene: Scene, trajectory: Trajectory) -> tuple[Floats | float, Floats | float]:
    """Change of v and of the energy [J] by each step's kick, at each joint (N, n), as if it came before the step."""
    if not trajectory.dw.any():
        return 0.0, 0.0
    q, v = trajectory.q[:-1], trajectory.v[:-1]
    impulse = noise_impulses(scene, trajectory, q, v)
    change = np.einsum("kij,kj->ki", accelerations(scene, q, v, np.zeros_like(q))[3], impulse)
    return change, impulse * (v + 0.5 * change)
