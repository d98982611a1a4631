"""Comparison of a linearization with differences of the steps, on a user's model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

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

# Central differences of eighth order.
_WEIGHTS = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}
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

    @property
    def verdict(self) -> str:
        """The result in words, with advice."""
        if self.holds:
            return f"the derivatives are those of the step, to {self.worst:.0e} of their size"
        parts = {"A": self.A, "B": self.B, "G": self.G}
        wrong = ", ".join(name for name, part in parts.items() if not _relative(part) <= _RIGHT)
        return (
            f"{wrong} and the differences of the step differ by {self.worst:.1e} of their size: another step= of the "
            "differences, or a smaller dt, shows which of them is wrong"
        )

    def __str__(self) -> str:
        rows = [
            f"{name}  error {error:.1e} of {norm:.3g}" if norm > 0.0 else f"{name}  error {error:.1e}, and none is 0"
            for name, (error, norm) in (("A", self.A), ("B", self.B), ("G", self.G))
        ]
        return "\n".join([*rows, self.verdict])


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
    Z = _kept_by_constraints(scene, q) if scene.constraints else np.eye(n)

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

    begins, after = np.split(_slope(along, np.zeros(2 * Z.shape[1]), step), 2)
    # A position at the end of the step, in a unit that moves the joint at 1 rad/s or m/s.
    of_controls = np.ones(m)
    of_controls[scene.prescribed[: len(scene.inputs)]] = dt
    by_u = _slope(lambda y: ends(q, v, y, zero), u, step * of_controls)[2 * n :]
    by_w = _slope(lambda y: ends(q, v, u, y), zero, step)[2 * n :]
    return LinearizationCheck(
        A=_largest(lin.A[0] @ begins, after, rows, np.ones(begins.shape[1])),
        B=_largest(lin.B[0], by_u, rows, of_controls),
        G=_largest(lin.G[0], by_w, rows, np.ones(k)),
    )


def _kept_by_constraints(scene: Scene, q: Floats) -> Floats:
    """An orthonormal basis (n, f) of the velocities at q (n,) that constraints allow, with kinematic inputs at will."""
    C = np.delete(scene.core.constraints(np.ascontiguousarray(q[None]))[2][0], list(scene.inputs), axis=0)
    _, sizes, basis = np.linalg.svd(C)
    rank = int((sizes > _RANK * sizes.max(initial=0.0)).sum())
    return np.ascontiguousarray(basis[rank:].T)


def _relative(part: tuple[float, float]) -> float:
    error, norm = part
    return error / norm if norm > 0.0 else error


def _slope(function: Callable[[Floats], Floats], x: Floats, step: Floats | float) -> Floats:
    """The derivative of a function by differences; ``step`` is that of each variable, or of all."""
    if not x.size:
        return np.zeros((len(function(x)), 0))
    derivative = []
    for e in np.diag(np.broadcast_to(step, x.shape)):
        total = sum(w * (function(x + i * e) - function(x - i * e)) for i, w in _WEIGHTS.items())
        derivative.append(total / e.max())
    found: Floats = np.array(derivative, dtype=np.float64).T.reshape(-1, x.size)
    return found


def _largest(given: Floats, derivative: Floats, rows: Floats, columns: Floats) -> tuple[float, float]:
    """The largest error of a derivative, and its largest entry."""
    scale = columns[None, :] / rows[:, None]
    return (
        float(np.abs((given - derivative) * scale).max(initial=0.0)),
        float(np.abs(derivative * scale).max(initial=0.0)),
    )
