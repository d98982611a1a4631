"""Noise models: diffusion fields F_i(q, v, u), one for each of k independent Wiener processes.

They add the generalized force sum_i F_i o dw_i / dt (Stratonovich) to the equations of motion. The sum of models,
``AdditiveNoise(1e-3) + ControlNoise(0.1)``, has the processes of all of them, independent of each other.

Paths converge with strong order 1 in the time step: half the step, half the error of a path. If a field depends on the
velocity, which only :class:`CustomNoise` allows, the strong order is 1/2.
"""

from __future__ import annotations

import math
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Floats, Integers
from varpin.core import Mechanism
from varpin.core.arrays import Diffusion
from varpin.errors import InputError
from varpin.support.checks import (
    JointValues,
    as_floats,
    broadcast_array,
    count,
    finite_array,
    flag,
    joint_array,
    require_function,
    returned,
    tuple_of,
)
from varpin.support.differences import slopes
from varpin.support.frozen import Frozen

if TYPE_CHECKING:
    from varpin.mechanics.scene import Scene


class NoiseFieldError(InputError):
    """A function of a custom noise raised, or returned a wrong type, shape or value."""


@dataclass(frozen=True, eq=False)
class Fields:
    """Diffusion fields and their derivatives at N points.

    Attributes:
        F: (N, n, k) generalized force per square root of time [N m s^0.5 or N s^0.5].
        Fq: dF/dq (N, n, k, n).
        Fv: dF/dv (N, n, k, n), or None if no field depends on the velocity.
        Fu: dF/du (N, n, k, m).
        Fr: Of steps with linear controls, dF/du for a change of the control that grows linearly from 0 at the start of
            the step to du at its end (N, n, k, m); else None.
    """

    F: Floats
    Fq: Floats
    Fv: Floats | None
    Fu: Floats
    Fr: Floats | None = None


class Noise(ABC):
    """A diffusion model. A subclass provides ``bind``, which applies it to a robot."""

    @abstractmethod
    def bind(self, actuation: Floats, joints: Sequence[str]) -> BoundNoise:
        """The model on a robot of n ``joints`` and m controls, with its actuation matrix (n, m).

        Raises:
            InputError: Its parameters do not fit the robot.
            UnknownJoint: It names a joint that the robot does not have.
        """

    def __add__(self, other: Noise) -> NoiseSum:
        if not isinstance(other, Noise):
            return NotImplemented
        return NoiseSum(models_of((self, other)))


@dataclass(frozen=True, eq=False)
class BoundNoise(Frozen):
    """Noise models on a robot: k independent processes side by side.

    Attributes:
        arrays: Fields in the form of the core, zero for the processes of a :class:`CustomNoise`.
        own: Each :class:`CustomNoise`, with the index of its first process.
    """

    arrays: Diffusion
    own: tuple[tuple[int, CustomNoise], ...] = ()

    @property
    def processes(self) -> int:
        """k, the number of Wiener processes."""
        return int(self.arrays.constant.shape[1])

    @property
    def velocity_dependent(self) -> bool:
        """Whether a field depends on the velocity, so that the Stratonovich and Ito equations differ."""
        return any(noise.dv is not None for _, noise in self.own)

    @property
    def diffusion(self) -> Diffusion | None:
        """The fields in the form of the core, or None if some are in Python."""
        return None if self.own else self.arrays

    @property
    def sloped(self) -> Integers:
        """The processes whose strength depends on the control; they see its slope within a step."""
        depends = np.array(self.arrays.control.any(axis=(0, 2)))
        for first, noise in self.own:
            depends[first : first + noise.processes] = noise.du is not None
        return np.flatnonzero(depends)

    def fields(self, q: Floats, v: Floats, u: Floats, start: Floats) -> Fields:
        """F and its derivatives at q (N, n), v (N, n), u (N, m); ``start`` (n,) is q at the start of the motion.

        Raises:
            NoiseFieldError: A function of a custom noise raised, or its result is no finite array of the right shape.
        """
        arrays = self.arrays
        n, k = arrays.constant.shape
        offset = q[:, :, None] - np.where(np.isnan(arrays.center), start[:, None], arrays.center)
        F = arrays.constant + np.einsum("ikm,Nm->Nik", arrays.control, u) + arrays.quadratic * offset**2
        Fq = np.zeros((len(q), n, k, n))
        Fq[:, np.arange(n), :, np.arange(n)] = np.moveaxis(2.0 * arrays.quadratic * offset, 1, 0)
        Fv = np.zeros_like(Fq) if self.velocity_dependent else None
        Fu = np.broadcast_to(arrays.control, (len(q), *arrays.control.shape))
        Fu = Fu.copy() if self.own else Fu
        for first, noise in self.own:
            # Copies, so that a field that writes into its arguments cannot change the state of a motion.
            points = list(zip(q.copy(), v.copy(), u.copy(), strict=True))
            columns = slice(first, first + noise.processes)
            for name, values in (("field", F), ("dq", Fq), ("dv", Fv), ("du", Fu)):
                if getattr(noise, name) is not None and values is not None:
                    values[:, :, columns] = noise.at(name, points, values[0, :, columns].shape)
        return Fields(F, Fq, Fv, Fu)


def ito_drift(core: Mechanism, q: Floats, v: Floats, fields: Fields) -> Floats:
    """The Ito correction (N, n) of fields at (q, v) (N, n): the drift from Stratonovich to Ito [N m or N].

    It is (1/2) sum_i (dF_i/dv) M^-1 F_i, equation (N1) and (1.3) of the paper; zero where no field depends on v.
    """
    if fields.Fv is None:
        return np.zeros_like(q)
    drift: Floats = 0.5 * np.einsum("Nikj,Njk->Ni", fields.Fv, np.linalg.solve(core.jets(q, v)[0], fields.F))
    return drift


class StepNoise:
    """The noise of a scene's steps where fields are in Python, in the form that the core calls."""

    def __init__(self, scene: Scene) -> None:
        # The scene owns this object, which would be a cycle for good.
        self._scene = weakref.proxy(scene)

    def __call__(
        self, q: Floats, v: Floats, center: Floats, u: Floats, change: Floats, dw: Floats
    ) -> tuple[Floats, Floats]:
        """The impulse (n,) of increments (K,), (0,) for none, and the drift (n,), (0,) if no field depends on v.

        They are at the state q, v (n,), with ``center`` (n, k) for this motion, the mean control u (m,) over the step
        and its change (m,), (0,) where the noise does not see it.
        """
        scene, ends = self._scene, None
        if change.size:
            # A kinematic input is where it is at the end of the step.
            u[scene.prescribed] += 0.5 * change[scene.prescribed]
            change[scene.prescribed] = 0.0
            ends = (u - 0.5 * change)[None], (u + 0.5 * change)[None]
        noise = scene.noise.changed(arrays=scene.noise.arrays._replace(center=center))
        fields = over_steps(noise, q[None], v[None], u[None], ends, q)
        drift = np.zeros(0) if fields.Fv is None else ito_drift(scene.core, q[None], v[None], fields)[0]
        return fields.F[0, :, : dw.size] @ dw, drift


def over_steps(
    noise: BoundNoise, q: Floats, v: Floats, u: Floats, ends: tuple[Floats, Floats] | None, start: Floats
) -> Fields:
    """The fields of a step's increments, (N3): those of its mean control, then those of the slope of its control.

    A control that is linear over a step is mean + (s - 1/2) (after - before) at the share s of it. Noise in proportion
    to it has the impulse F(mean) dw + (F(after) - F(before)) / sqrt(12) dw', with independent dw and dw' ~ N(0, dt).

    Args:
        noise: The noise.
        q: Configurations (N, n) [rad or m].
        v: Velocities (N, n) [rad/s or m/s].
        u: Mean controls (N, m).
        ends: Controls at the begin and at the end of each step, each (N, m), where they are linear over it; else None.
        start: Configuration (n,) at the start of the motion.
    """
    mean, sloped = noise.fields(q, v, u, start), noise.sloped
    if ends is None or not sloped.size:
        return mean
    before, after = (noise.fields(q, v, end, start) for end in ends)
    share = 1.0 / math.sqrt(12.0)

    def joined(name: str) -> Floats:
        added = share * (getattr(after, name) - getattr(before, name))[:, :, sloped]
        return np.concatenate([getattr(mean, name), added], axis=2)

    return Fields(
        joined("F"),
        joined("Fq"),
        None if mean.Fv is None else joined("Fv"),
        joined("Fu"),
        np.concatenate([0.5 * mean.Fu, share * after.Fu[:, :, sloped]], axis=2),
    )


def _noise(n: int, m: int, k: int, **given: Floats) -> BoundNoise:
    """Noise whose fields in the form of the core are zero where they are not given."""
    nothing = {"constant": (n, k), "control": (n, k, m), "quadratic": (n, k), "center": (n, k)}
    return BoundNoise(Diffusion(**{name: given.get(name, np.zeros(shape)) for name, shape in nothing.items()}))


@dataclass(frozen=True, eq=False)
class AdditiveNoise(Noise):
    """Forces of constant intensity: F is constant.

    Attributes:
        intensity: One number C for F_i = C e_i; (n,), or by joint name, for F_i = C_i e_i; or the matrix F (n, k)
            itself [N m s^0.5 or N s^0.5].
    """

    intensity: JointValues

    def bind(self, actuation: Floats, joints: Sequence[str]) -> BoundNoise:
        name, (n, m) = "AdditiveNoise intensity", actuation.shape
        given = self.intensity if isinstance(self.intensity, Mapping) else as_floats(name, self.intensity)
        if isinstance(given, np.ndarray) and given.ndim == 2:
            F = finite_array(name, given, (n, given.shape[1]))
        else:
            F = np.diag(joint_array(name, given, joints, uniform=True))
        return _noise(n, m, F.shape[1], constant=F)


@dataclass(frozen=True, eq=False)
class ControlNoise(Noise):
    """Forces proportional to the controls: F_i = C_i b_i u_i, where b_i is column i of the actuation matrix.

    Attributes:
        intensity: One number or (m,) [s^0.5]; or an array (n, k, m) with F_i = sum_j intensity[:, i, j] u_j. The
            control of a :class:`varpin.KinematicInput` is a position, and has no noise.
    """

    intensity: ArrayLike

    def bind(self, actuation: Floats, joints: Sequence[str]) -> BoundNoise:  # noqa: ARG002
        name, (n, m) = "ControlNoise intensity", actuation.shape
        field = as_floats(name, self.intensity)
        if field.ndim == 3:
            field = finite_array(name, field, (n, field.shape[1], m))
        else:
            strength = broadcast_array(name, field, m)
            field = np.zeros((n, m, m))
            field[:, np.arange(m), np.arange(m)] = actuation * strength
        return _noise(n, m, field.shape[1], control=field)


@dataclass(frozen=True, eq=False)
class StateNoise(Noise):
    """Forces that grow with the distance from a posture: F_i = C_i e_i (q_i - center_i)^2.

    Attributes:
        intensity: One number, (n,) or by joint name [N m s^0.5 / rad^2 or N s^0.5 / m^2].
        center: One number, (n,) or by joint name [rad or m]; the initial configuration of the motion if None.
    """

    intensity: JointValues
    center: JointValues | None = None

    def bind(self, actuation: Floats, joints: Sequence[str]) -> BoundNoise:
        n, m = actuation.shape
        strength = joint_array("StateNoise intensity", self.intensity, joints, uniform=True)
        center = np.full(n, np.nan)
        if self.center is not None:
            center = joint_array("StateNoise center", self.center, joints, uniform=True)
        return _noise(n, m, n, quadratic=np.diag(strength), center=np.repeat(center[:, None], n, axis=1))


Field = Callable[[Floats, Floats, Floats], ArrayLike]


@dataclass(frozen=True, eq=False)
class CustomNoise(Noise):
    """A diffusion field that you write in Python; steps call it once, or twice with ``kick="split"``.

    Attributes:
        field: Function of (q (n,), v (n,), u (m,)) that returns F (n, k) [N m s^0.5 or N s^0.5].
        processes: k.
        dq: Function of the same arguments that returns dF/dq (n, k, n); None if F does not depend on q.
        dv: dF/dv (n, k, n); None if F does not depend on v. With it, the drift (1/2) sum_i (dF_i/dv) M^-1 F_i converts
            the Stratonovich equation to the Ito equation that is integrated, with strong order 1/2 instead of 1.
        du: dF/du (n, k, m); None if F does not depend on u.
        check: Compare the derivatives with differences when a scene is made with the noise.
    """

    field: Field
    processes: int
    dq: Field | None = None
    dv: Field | None = None
    du: Field | None = None
    check: bool = False

    def bind(self, actuation: Floats, joints: Sequence[str]) -> BoundNoise:  # noqa: ARG002
        count("CustomNoise processes", self.processes)
        for name in ("field", "dq", "dv", "du"):
            require_function(f"CustomNoise {name}", getattr(self, name), "(q, v, u)", optional=name != "field")
        n, m = actuation.shape
        if flag("CustomNoise check", self.check):
            self._compare(n, m)
        return BoundNoise(_noise(n, m, self.processes).arrays, ((0, self),))

    def at(self, name: str, points: Sequence[tuple[Floats, Floats, Floats]], shape: tuple[int, ...]) -> Floats:
        """Values (N, ...) of one of the functions at N points (q, v, u); 0 for a function that is left out.

        Raises:
            NoiseFieldError: It raised, or its result is not a finite array of this shape.
        """
        function, what = getattr(self, name), f"CustomNoise {name}(q, v, u)"
        if function is None:
            return np.zeros((len(points), *shape))
        return np.array([returned(what, partial(function, *at), shape, error=NoiseFieldError) for at in points])

    def _compare(self, n: int, m: int) -> None:
        """Refuse derivatives that differ from differences at three seeded random points."""
        rng, shape = np.random.default_rng(0), (n, self.processes)
        for _ in range(3):
            q, v, u = (rng.normal(size=size) for size in (n, n, m))

            def field(x: Floats) -> Floats:
                value: Floats = self.at("field", [(x[:n], x[n : 2 * n], x[2 * n :])], shape)[0]
                return value

            found = np.split(slopes(field, np.concatenate([q, v, u]), 1e-3), [n, 2 * n], axis=2)
            for name, differences in zip(("dq", "dv", "du"), found, strict=True):
                off = np.abs(self.at(name, [(q, v, u)], differences.shape)[0] - differences)
                wrong = off > 1e-6 * np.maximum(1.0, np.abs(differences))
                if wrong.any():
                    raise InputError(
                        f"CustomNoise {name}(q, v, u) differs from differences of the field by {off[wrong].max():.3g} "
                        f"in [:, :, {int(np.argwhere(wrong)[0, 2])}] at q = {q}, v = {v}, u = {u}"
                    )


@dataclass(frozen=True, eq=False)
class NoiseSum(Noise):
    """The sum of several models with independent processes."""

    terms: tuple[Noise, ...]

    def bind(self, actuation: Floats, joints: Sequence[str]) -> BoundNoise:
        return bind(self.terms, actuation, joints)


def models_of(noise: Noise | Sequence[Noise] | None) -> tuple[Noise, ...]:
    """The models of the argument of a scene, and of sums among them.

    Raises:
        InputError: It is neither a noise model nor a sequence of them.
    """
    models = () if noise is None else tuple_of("noise models", noise, Noise)
    return tuple(term for model in models for term in (model.terms if isinstance(model, NoiseSum) else (model,)))


def bind(models: Sequence[Noise], actuation: Floats, joints: Sequence[str]) -> BoundNoise:
    """Noise models on a robot with this actuation matrix (n, m) and these joints; those of users are checked here.

    Raises:
        UnknownJoint: A model names a joint that is not in ``joints``.
        InputError: Parameters do not fit the robot, or ``bind`` of a model returned arrays that do not.
    """
    n, m = actuation.shape
    parts = [_noise(n, m, 0), *(model.bind(actuation, joints) for model in models)]
    for name, part in zip((type(model).__name__ for model in models), parts[1:], strict=True):
        if not isinstance(part, BoundNoise):
            raise InputError(f"bind of {name} must return a BoundNoise, got {type(part).__name__}")
        k = part.processes
        for field, array, shape in zip(
            Diffusion._fields, part.arrays, ((n, k), (n, k, m), (n, k), (n, k)), strict=True
        ):
            # NaN in a center means the initial configuration.
            known = np.nan_to_num(array, posinf=np.inf, neginf=-np.inf) if field == "center" else array
            finite_array(f"{field} of {name}", known, shape)
    firsts = np.cumsum([0, *(part.processes for part in parts)]).tolist()
    own = [(first + k, noise) for first, part in zip(firsts, parts, strict=False) for k, noise in part.own]
    columns = zip(*(part.arrays for part in parts), strict=True)
    return BoundNoise(Diffusion(*(np.concatenate(column, axis=1) for column in columns)), tuple(own))
