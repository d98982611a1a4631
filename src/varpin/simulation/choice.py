"""The integrator of a motion where none is given.

What is known before the motion is its start. Where damping or stops turn out to be faster than the step later on, the
motion is made anew.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from varpin.core import fastest_damping, pulls_fast
from varpin.integrators import Gauss, Integrator, Midpoint, Radau
from varpin.mechanics.forces import of_kind
from varpin.mechanics.scene import Scene
from varpin.simulation.damping import fast_damping, stops_ahead, turns_fast
from varpin.simulation.refinement import candidates, first_steps

Floats = NDArray[np.float64]

# What steps where no integrator is given; and under noise, for more stages do not raise the strong order.
_USUAL, _NOISY = Gauss(2), Midpoint()
# What steps where something turns by more than this in a step [rad], of which two stages lose 2e-4 rad a period. And
# where something damps this many times faster than the step: velocities of the others lag and ring, and three stages
# miss by a tenth what torques that jump do to them.
_SWINGING, _TURNS = Gauss(4), 0.4
_STOPPING, _RINGS = Radau(4), 2.0
# Of more joints than so many nobody asks, for that takes as long as a motion.
_ASKED = 200
# Who may be chosen for a tolerance as well, where something damps faster than the coarsest steps by this factor.
_STIFF, _FAR = (Radau(3), Radau(4)), 4.0


def usual_integrator(
    scene: Scene, q0: Floats, v0: Floats, dt: float, *, noisy: bool, ahead: bool = False
) -> Integrator:
    """The integrator of a motion where none is given; that of a plan is :func:`varpin.control.problem.integrator_for`.

    Under noise it is the midpoint rule: its positions have the right law where damping is faster than the step, and a
    warning tells of its velocities. Radau's velocities lose nearly all of the noise.

    ``ahead`` has it ready for all stops that joints may run into, where the motion cannot be made anew.
    """
    if noisy:
        return _NOISY
    # Radau's methods do not keep constraints.
    if not scene.constraints and _damps_faster(scene, q0, v0, _RINGS / dt, ahead=ahead):
        return _STOPPING
    return _SWINGING if _swings_faster(scene, q0, _TURNS / dt, ahead=ahead) else _USUAL


def changes_along(scene: Scene) -> bool:
    """Whether a motion without noise may ask for another integrator than its start."""
    if not scene.elements and not scene.couplings:
        return False
    stiffens = scene.couplings or of_kind(scene.elements, "JointStop")
    return bool((stiffens or scene.dissipates) and scene.custom is None and scene.robot.dof <= _ASKED)


def integrator_along(scene: Scene, integrator: Integrator, q: Floats, v: Floats, u: Floats, dt: float) -> Integrator:
    """What should have taken the steps of a motion for which :func:`usual_integrator` has chosen ``integrator``.

    q and v (N + 1, n) are those of the nodes, u (N, m) of the steps, of a scene that :func:`changes_along` motions.
    """
    if integrator.same_map(_STOPPING):
        return integrator
    if not scene.constraints and fast_damping(scene, q, v, u, dt).rate:
        return _STOPPING
    if integrator.same_map(_USUAL) and turns_fast(scene, q, v, u, dt / _TURNS):
        return _SWINGING
    return integrator


def stronger(chosen: Iterable[Integrator]) -> Integrator:
    """Of integrators that the functions above have chosen, for motions to be made by one, that which is right for all.

    Where there are none, that of a motion that asks for nothing.
    """
    ranks = {str(member): rank for rank, member in enumerate((_USUAL, _SWINGING, _STOPPING))}
    return max(chosen, key=lambda own: ranks[str(own)], default=_USUAL)


def tolerance_candidates(scene: Scene, q0: Floats, v0: Floats, duration: float) -> tuple[Integrator, ...]:
    """Integrators to choose from for a tolerance: Radau's, too, where something damps far faster than the arm moves."""
    if scene.constraints:
        return candidates(scene)
    moves = first_steps(scene, q0, v0, duration, 1) / duration
    return candidates(scene) + (_STIFF if _damps_faster(scene, q0, v0, _FAR * moves) else ())


def _damps_faster(scene: Scene, q0: Floats, v0: Floats, rate: float, *, ahead: bool = False) -> bool:
    """Whether dampers, dry friction or servos are faster than a rate [1/s] at the start, or would be at rest there."""
    # Forces of one's own are called by the motion alone, which says where they fail.
    if not scene.dissipates or scene.custom is not None or len(q0) > _ASKED:
        return False
    # At rest dry friction is fastest; servos do not saturate where they are.
    q = np.concatenate([np.tile(q0, (2, 1)), stops_ahead(scene, q0)]) if ahead else np.tile(q0, (2, 1))
    v = np.zeros_like(q)
    v[0] = v0
    forces = np.tile(scene.actuation @ scene.command_at(q0), (len(q), 1))
    return fastest_damping(scene.core, q, v, forces, rate) > 0.0


def _swings_faster(scene: Scene, q0: Floats, rate: float, *, ahead: bool) -> bool:
    """Whether springs, servos or gravity make a mode faster than a rate [rad/s] at rest at the start."""
    if scene.custom is not None or len(q0) > _ASKED:
        return False
    q = np.concatenate([q0[None], stops_ahead(scene, q0)]) if ahead else q0[None]
    forces = (scene.actuation @ scene.command_at(q0))[None]
    if ahead:
        forces = np.tile(forces, (len(q), 1))
    return bool(pulls_fast(scene.core, q, np.zeros_like(q), forces, 1.0 / rate))
