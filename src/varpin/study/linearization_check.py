"""Comparison of a linearization with differences of the steps, on a user's model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import null_space

from varpin.arrays import Floats
from varpin.integrators import Integrator
from varpin.linearization import linearize
from varpin.mechanics.assembly import along_constraints, nearest
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.scene import Scene, require_scene
from varpin.simulation.choice import usual_integrator
from varpin.simulation.simulate import simulate
from varpin.simulation.start import on_constraints
from varpin.support.checks import JointValues, finite_array, joint_array, positive
from varpin.support.differences import slopes

# Relative errors up to which derivatives are right.
_RIGHT = 1e-6
# Rank tolerance of the constraints, relative to their largest singular value.
_RANK = 1e-9


@dataclass(frozen=True)
class LinearizationCheck:
    """Errors of the derivatives of one step against differences of the step.

    Errors and norms are the largest entries, in units of the variables: 1 rad or m for positions, 1 / (M^-1)_ii for the
    momentum of joint i, and 1 for velocities, controls and increments; dt for positions of kinematic inputs. A is taken
    along positions and velocities, under constraints along those that these allow.

    Attributes:
        A: Error and norm of dx1/dx0.
        B: Error and norm of dx1/du.
        G: Error and norm of dx1/dw.
    """

    A: tuple[float, float]
    B: tuple[float, float]
    G: tuple[float, float]

    @property
    def worst(self) -> float:
        """The largest error relative to its norm."""
        return max(map(_relative, (self.A, self.B, self.G)))

    @property
    def holds(self) -> bool:
        """Whether the derivatives are those of the step, to six digits."""
        return self.worst <= _RIGHT

    def __str__(self) -> str:
        parts = {"A": self.A, "B": self.B, "G": self.G}
        rows = [
            f"{name}  error {error:.1e} of {norm:.3g}" if norm > 0.0 else f"{name}  error {error:.1e}, and none is 0"
            for name, (error, norm) in parts.items()
        ]
        if self.holds:
            return "\n".join([*rows, f"the derivatives are those of the step, to {self.worst:.0e} of their size"])
        wrong = ", ".join(name for name, part in parts.items() if not _relative(part) <= _RIGHT)
        verdict = (
            f"{wrong} and the differences of the step differ by {self.worst:.1e} of their size: another step= of the "
            "differences, or a smaller dt, shows which of them is wrong"
        )
        return "\n".join([*rows, verdict])


def check_linearization(
    scene: Scene,
    q: JointValues,
    v: JointValues,
    u: ArrayLike | None = None,
    *,
    dt: float,
    integrator: Integrator | None = None,
    step: float = 1e-2,
) -> LinearizationCheck:
    """Compare :func:`varpin.linearize` with eighth-order differences of the step from (q, v).

    Under constraints A is compared along curves of states that keep them.

    Main args:
        scene: The scene.
        q: Configuration, (n,) or by joint name [rad or m].
        v: Velocity, (n,) or by joint name [rad/s or m/s].
        u: Controls (m,); zero if left out, and the present position for a :class:`varpin.KinematicInput`.
        dt: Time step [s].

    Other Args:
        integrator: By default that of :func:`varpin.simulate`.
        step: Step of the differences, in the units of :class:`LinearizationCheck`.

    Raises:
        InputError: Wrong shapes, or values that are not finite.
        StepFailure: A step of the differences cannot be taken; a smaller ``step`` or ``dt`` may help.
    """
    n, m, k = require_scene(scene).robot.dof, scene.controls, scene.processes
    q, v = joint_array("q", q, scene.robot.joint_names), joint_array("v", v, scene.robot.joint_names)
    if u is None and scene.inputs:
        u = scene.command_at(q)
    u = np.zeros(m) if u is None else finite_array("u", u, (m,))
    dt, step = positive("dt", dt, "s"), positive("step", step, "1")
    if scene.constraints:
        q, v, _ = on_constraints(scene, q, v)
    method = usual_integrator(scene, q, v, dt, noisy=k > 0) if integrator is None else integrator
    options: dict[str, Any] = {"dt": dt, "steps": 1, "integrator": method, "check": False}
    motion = simulate(scene, q, v, controls=u, increments=0.0, **options)
    lin = linearize(scene, motion, integrator=method)
    size = np.ones(n)
    if method.variational:
        size = 1.0 / np.diag(np.linalg.inv(lagrangian_jet(scene, q, np.zeros(n)).Lvv))
    rows, zero = np.concatenate([np.ones(n), size]), np.zeros(k)
    Z = np.eye(n)
    if scene.constraints:
        # The velocities that constraints allow, with kinematic inputs at will.
        C = scene.core.constraints(q[None])[2][0]
        Z = null_space(np.delete(C, list(scene.inputs), axis=0), rcond=_RANK)

    def ends(at: Floats, velocity: Floats, control: Floats, dw: Floats) -> Floats:
        """The state at both ends of the step (4n,)."""
        taken = simulate(scene, at, velocity, controls=control, increments=dw[None], **options)
        return np.concatenate([taken.q, taken.p if method.variational else taken.v], axis=1).ravel()

    def along(y: Floats) -> Floats:
        at, velocity = q + Z @ y[: Z.shape[1]], v + Z @ y[Z.shape[1] :]
        if scene.constraints:
            at = nearest(scene, at)
            velocity = along_constraints(scene, at, velocity)
        return ends(at, velocity, u, zero)

    begins, after = np.split(slopes(along, np.zeros(2 * Z.shape[1]), step), 2)
    # A position at the end of the step, in a unit that moves the joint at 1 rad/s or m/s.
    of_controls = np.ones(m)
    of_controls[scene.prescribed[: len(scene.inputs)]] = dt

    def errors(given: Floats, function: Callable[[Floats], Floats], x: Floats, columns: Floats) -> tuple[float, float]:
        """The largest error of a derivative at x, and its largest entry."""
        if not x.size:
            return 0.0, 0.0
        return _largest(given, slopes(function, x, step * columns)[2 * n :], columns / rows[:, None])

    return LinearizationCheck(
        A=_largest(lin.A[0] @ begins, after, 1.0 / rows[:, None]),
        B=errors(lin.B[0], lambda y: ends(q, v, y, zero), u, of_controls),
        G=errors(lin.G[0], lambda y: ends(q, v, u, y), zero, np.ones(k)),
    )


def _relative(part: tuple[float, float]) -> float:
    error, norm = part
    return error / norm if norm > 0.0 else error


def _largest(given: Floats, derivative: Floats, scale: Floats) -> tuple[float, float]:
    return float(np.abs((given - derivative) * scale).max()), float(np.abs(derivative * scale).max())
