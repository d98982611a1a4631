"""The integrator of a motion where none is given, chosen once, by the rates at the start and in all joint stops."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Literal

import numpy as np

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.integrators import Gauss, Integrator, Midpoint, Radau
from varpin.mechanics.scene import Scene
from varpin.signals.policy import LinearPolicy
from varpin.simulation.spectrum import fastest_damping, pulls_fast, rate_at_rest, stops_ahead

# The default, and the default under noise, where more stages do not raise the strong order.
_USUAL, _NOISY = Gauss(2), Midpoint(kick="held")
# The integrator where a mode turns by more than this in a step [rad]: there two stages lose 2e-4 rad a period.
_SWINGING, _TURNS = Gauss(4), 0.4
# The integrator where damping is this many times faster than the step: there velocities of other methods lag and ring,
# and with three stages the response to jumping torques is wrong by a tenth.
_STOPPING, _RINGS = Radau(4), 2.0
# Greatest rate of dampers and dry friction, times the step, for a method that is not L-stable; from 5 to 20.
STIFF = 10.0
# Stages of the default integrator. Two match the cost's order; four resolve friction up to ten times as fast as the
# step, for a third more time.
STAGES = 4
# Most joints of a robot for which rates are computed: for more it takes as long as a motion.
_MOST_JOINTS = 200


def given_integrator(integrator: object, controls: object = None) -> Integrator | None:
    """The integrator that is given, else that of a policy; None where it is to be chosen."""
    if integrator is None and isinstance(controls, LinearPolicy):
        integrator = controls.integrator
    if integrator is not None and not isinstance(integrator, Integrator):
        raise InputError(f"integrator must be one of varpin's, for example varpin.Midpoint(), got {integrator!r}")
    return integrator


def usual_integrator(scene: Scene, q0: Floats, v0: Floats, dt: float, *, noisy: bool) -> Integrator:
    """The integrator of a motion where none is given; that of a plan is :func:`integrator_for`.

    Under noise it is the midpoint rule with the noise held over the step, whose stationary distributions are those of
    the continuous system also where damping is faster than the step; Radau's velocities lose nearly all of the noise.
    """
    if noisy:
        return _NOISY
    chosen: Gauss | Radau = _USUAL
    # Custom forces are called in the motion alone, where an error has its step.
    if scene.custom is None and len(q0) <= _MOST_JOINTS:
        q = np.concatenate([np.tile(q0, (2, 1)), stops_ahead(scene, q0)])
        v = np.zeros_like(q)
        # At rest servos that hold q0 do not saturate.
        forces = np.tile(scene.actuation @ scene.holding @ q0, (len(q), 1))
        if pulls_fast(scene, q[1:], forces[1:], dt / _TURNS):
            chosen = _SWINGING
        # Radau's methods do not keep constraints. Dry friction is steepest at rest.
        v[0] = v0
        if scene.dissipates and not scene.constraints and fastest_damping(scene, q, v, forces, _RINGS / dt) > 0.0:
            chosen = _STOPPING
    # A motion without the noise of its scene may be linearized.
    return replace(chosen, kick=usual_kick(scene))


def integrator_for(scene: Scene, q0: Floats, dt: float) -> Gauss | Radau:
    """The integrator of a problem that gives none: Gauss's, with three stages in calm steps, or the L-stable one.

    A mode z times as fast as the step decays by the factor 1 - 40 / z in a step of Gauss(4), and rings after each jump
    of a held control. Radau's methods do not support constraints of the scene. Noise is held over the step: in the long
    steps of plans an impulse costs two to five times as much.
    """
    kick = usual_kick(scene)
    if not scene.constraints and dt * rate_at_rest(scene, q0) > STIFF:
        return Radau(STAGES, kick=kick)
    if scene.constraints or scene.custom is not None:
        return Gauss(STAGES, kick=kick)
    usual = usual_integrator(scene, q0, np.zeros_like(q0), dt, noisy=False)
    return Gauss(3 if usual == Gauss(2, kick=kick) else STAGES, kick=kick)


def usual_kick(scene: Scene) -> Literal["left", "held"]:
    """How noise acts where no integrator is given."""
    return "held" if scene.processes else "left"


def stronger(chosen: Iterable[Integrator]) -> Integrator:
    """The one of some integrators chosen above that is right for all their motions; the default for none."""
    ranks = {str(member): rank for rank, member in enumerate((_NOISY, _USUAL, _SWINGING, _STOPPING))}
    return max(chosen, key=lambda own: ranks[str(own)], default=_USUAL)
