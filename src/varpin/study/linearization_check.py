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
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.scene import Scene, refuse_constraints, require_scene
from varpin.simulation.choice import usual_integrator
from varpin.simulation.run import simulate
from varpin.support.checks import JointValues, finite_array, joint_array, positive

# Central differences of eighth order.
_WEIGHTS = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}
# Relative errors up to which derivatives are right, and above which they are wrong.
_RIGHT, _NEAR = 1e-6, 1e-3


@dataclass(frozen=True)
class LinearizationCheck:
    """Errors of the derivatives of one step against differences of the step.

    Errors and norms are the largest entries, in units of the variables: 1 rad or m for positions, 1 / (M^-1)_ii for the
    momentum of joint i, which moves it alone at 1 rad/s or m/s, and 1 for velocities, controls and increments.

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
        if self.worst <= _NEAR:
            return (
                f"{wrong} and the differences agree only to {self.worst:.0e}: another step= of the differences, or a "
                "smaller dt, shows which of them is wrong"
            )
        return f"{wrong} is not the derivative of the step: it is off by {self.worst:.1e} of its size"

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

    Main args:
        scene: The scene.
        q: Configuration, (n,) or by joint name [rad or m].
        v: Velocity, (n,) or by joint name [rad/s or m/s].
        u: Controls (m,); zero if left out.
        dt: Time step [s].

    Other Args:
        integrator: By default that of :func:`varpin.simulate`.
        step: Step of the differences, in the units of :class:`LinearizationCheck`.

    Raises:
        InputError: Wrong shapes, or values that are not finite.
        StepFailure: A step of the differences cannot be taken; a smaller ``step`` or ``dt`` may help.
    """
    refuse_constraints(
        require_scene(scene),
        "check_linearization",
        "varpin.linearize does; its A and B are derivatives along the constraints, so compare them with steps between "
        "states that varpin.assemble has brought onto these",
    )
    n, m, k = require_scene(scene).robot.dof, scene.controls, scene.processes
    q, v = joint_array("q", q, scene.robot.joint_names), joint_array("v", v, scene.robot.joint_names)
    u = np.zeros(m) if u is None else finite_array("u", u, (m,))
    dt, step = positive("dt", dt, "s"), positive("step", step, "1")
    method = usual_integrator(scene, q, v, dt, noisy=k > 0) if integrator is None else integrator
    options: dict[str, Any] = {"dt": dt, "steps": 1, "integrator": method, "check": False}
    motion = simulate(scene, q, v, controls=u, increments=0.0, **options)
    lin = linearize(scene, motion, integrator=method)
    second = motion.p[0] if method.variational else v
    mass = lagrangian_jet(scene, q, np.zeros(n)).Lvv
    size = 1.0 / np.diag(np.linalg.inv(mass)) if method.variational else np.ones(n)
    rows = np.concatenate([np.ones(n), size])

    def take(x: Floats, control: Floats, dw: Floats) -> Floats:
        velocity = x[n:]
        if method.variational:
            M = lagrangian_jet(scene, x[:n], np.zeros(n)).Lvv
            velocity = np.asarray(np.linalg.solve(M, x[n:]), dtype=np.float64)
        end = simulate(scene, x[:n], velocity, controls=control, increments=dw[None], **options)
        return np.concatenate([end.q[1], end.p[1] if method.variational else end.v[1]])

    x, zero = np.concatenate([q, second]), np.zeros(k)
    return LinearizationCheck(
        A=_compare(lin.A[0], lambda y: take(y, u, zero), x, step, rows, rows),
        B=_compare(lin.B[0], lambda y: take(x, y, zero), u, step, rows, np.ones(m)),
        G=_compare(lin.G[0], lambda y: take(x, u, y), zero, step, rows, np.ones(k)),
    )


def _relative(part: tuple[float, float]) -> float:
    error, norm = part
    return error / norm if norm > 0.0 else error


def _compare(
    given: Floats, function: Callable[[Floats], Floats], x: Floats, step: float, rows: Floats, columns: Floats
) -> tuple[float, float]:
    """Largest error of a derivative and largest entry of the differences, in the units of rows and columns."""
    if not x.size:
        return 0.0, 0.0
    derivative = np.zeros_like(given)
    for j, size in enumerate(columns):
        e = np.zeros_like(x)
        e[j] = step * size
        total = sum(w * (function(x + i * e) - function(x - i * e)) for i, w in _WEIGHTS.items())
        derivative[:, j] = total / e[j]
    scale = columns[None, :] / rows[:, None]
    return float(np.abs((given - derivative) * scale).max()), float(np.abs(derivative * scale).max())
