"""Noise models: diffusion fields F_i(q, v, u), one for each of k independent Wiener processes.

They add the generalized force sum_i F_i o dw_i / dt (Stratonovich) to the equations of motion. The sum of models,
``AdditiveNoise(1e-3) + ControlNoise(0.1)``, has the processes of all of them, independent of each other.

Paths converge with strong order 1 in the time step: half the step, half the error of a path. If a field depends on the
velocity, which only :class:`CustomNoise` allows, the strong order is 1/2.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Floats, Integers
from varpin.core.arrays import Diffusion
from varpin.errors import InputError
from varpin.support.checks import (
    JointValues,
    as_floats,
    broadcast_array,
    count,
    finite_array,
    joint_array,
    require_finite,
    returned,
)
from varpin.support.differences import slopes
from varpin.support.frozen import Frozen


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
    def bind(self, actuation: Floats) -> BoundNoise:
        """The model on a robot of n coordinates and m controls, with its actuation matrix (n, m).

        Raises:
            InputError: Its parameters do not fit the robot.
        """

    def __add__(self, other: Noise) -> NoiseSum:
        if not isinstance(other, Noise):
            return NotImplemented
        return NoiseSum((*_terms(self), *_terms(other)))


class BoundNoise(Frozen, ABC):
    """A noise model on a robot."""

    @property
    @abstractmethod
    def processes(self) -> int:
        """k, the number of Wiener processes."""

    @property
    def velocity_dependent(self) -> bool:
        """Whether a field depends on the velocity, so that the Stratonovich and Ito equations differ."""
        return False

    @property
    def diffusion(self) -> Diffusion | None:
        """The fields in the form of the core, or None for fields in Python."""
        return None

    @property
    def sloped(self) -> Integers:
        """The processes whose strength depends on the control; they see its slope within a step."""
        if self.diffusion is None:
            return np.arange(self.processes)
        return np.flatnonzero(self.diffusion.control.any(axis=(0, 2)))

    def curvature(self, weight: Floats) -> Floats:
        """Second derivatives of sum_i weight_i . F_i in q (N, n, n), weights (N, n, k); zero for fields in Python."""
        return np.zeros((len(weight), weight.shape[1], weight.shape[1]))

    @abstractmethod
    def fields(self, q: Floats, v: Floats, u: Floats, start: Floats) -> Fields:
        """F and its derivatives at q (N, n), v (N, n), u (N, m); ``start`` (n,) is q at the start of the motion."""


@dataclass(frozen=True, eq=False)
class CompiledFields(BoundNoise):
    """Fields in the form of the core: constant, linear in u, quadratic in q."""

    arrays: Diffusion

    @property
    def diffusion(self) -> Diffusion:
        return self.arrays

    @property
    def processes(self) -> int:
        return int(self.arrays.constant.shape[1])

    def curvature(self, weight: Floats) -> Floats:
        second: Floats = 2.0 * (self.arrays.quadratic * weight).sum(axis=2)
        return second[:, :, None] * np.eye(second.shape[1])

    def fields(self, q: Floats, v: Floats, u: Floats, start: Floats) -> Fields:  # noqa: ARG002
        arrays = self.arrays
        n, k = arrays.constant.shape
        offset = q[:, :, None] - np.where(np.isnan(arrays.center), start[:, None], arrays.center)
        F = arrays.constant + np.einsum("ikm,Nm->Nik", arrays.control, u) + arrays.quadratic * offset**2
        Fq = np.zeros((len(q), n, k, n))
        Fq[:, np.arange(n), :, np.arange(n)] = np.moveaxis(2.0 * arrays.quadratic * offset, 1, 0)
        return Fields(F, Fq, None, np.broadcast_to(arrays.control, (len(q), *arrays.control.shape)))


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


@dataclass(frozen=True, eq=False)
class CompositeFields(BoundNoise):
    """The concatenated processes of several bound models, some of them in Python."""

    parts: tuple[BoundNoise, ...]

    @property
    def processes(self) -> int:
        return sum(part.processes for part in self.parts)

    @property
    def velocity_dependent(self) -> bool:
        return any(part.velocity_dependent for part in self.parts)

    @property
    def sloped(self) -> Integers:
        first = np.cumsum([0, *(part.processes for part in self.parts)])
        return np.concatenate([start + part.sloped for start, part in zip(first[:-1], self.parts, strict=True)])

    def curvature(self, weight: Floats) -> Floats:
        ends = np.cumsum([part.processes for part in self.parts])
        columns = np.split(weight, ends[:-1], axis=2)
        total: Floats = sum(
            (part.curvature(column) for part, column in zip(self.parts, columns, strict=True)),
            np.zeros((len(weight), weight.shape[1], weight.shape[1])),
        )
        return total

    def fields(self, q: Floats, v: Floats, u: Floats, start: Floats) -> Fields:
        parts = [part.fields(q, v, u, start) for part in self.parts]
        Fv = None
        if any(part.Fv is not None for part in parts):
            Fv = np.concatenate([np.zeros_like(part.Fq) if part.Fv is None else part.Fv for part in parts], axis=2)
        return Fields(
            np.concatenate([part.F for part in parts], axis=2),
            np.concatenate([part.Fq for part in parts], axis=2),
            Fv,
            np.concatenate([part.Fu for part in parts], axis=2),
        )


def _compiled(n: int, m: int, k: int, **given: Floats) -> CompiledFields:
    """Fields in the form of the core, zero where they are not given."""
    nothing = {"constant": (n, k), "control": (n, k, m), "quadratic": (n, k), "center": (n, k)}
    values = {name: given.get(name, np.zeros(shape)) for name, shape in nothing.items()}
    return CompiledFields(Diffusion(**{name: np.ascontiguousarray(value) for name, value in values.items()}))


@dataclass(frozen=True, eq=False)
class AdditiveNoise(Noise):
    """Forces of constant intensity: F is constant.

    Attributes:
        intensity: One number C for F_i = C e_i; (n,), or by joint name, for F_i = C_i e_i; or the matrix F (n, k)
            itself [N m s^0.5 or N s^0.5].
    """

    intensity: JointValues

    def bind(self, actuation: Floats) -> CompiledFields:
        n, m = actuation.shape
        values = require_finite("AdditiveNoise intensity", as_floats("AdditiveNoise intensity", self.intensity))
        if values.ndim == 2:
            F = finite_array("AdditiveNoise intensity", values, (n, values.shape[1]))
        else:
            F = np.diag(broadcast_array("AdditiveNoise intensity", values, n))
        return _compiled(n, m, F.shape[1], constant=F)


@dataclass(frozen=True, eq=False)
class ControlNoise(Noise):
    """Forces proportional to the controls: F_i = C_i b_i u_i, where b_i is column i of the actuation matrix.

    Attributes:
        intensity: One number or (m,) [s^0.5]; or an array (n, k, m) with F_i = sum_j intensity[:, i, j] u_j. The
            control of a :class:`varpin.KinematicInput` is a position, and has no noise.
    """

    intensity: ArrayLike

    def bind(self, actuation: Floats) -> CompiledFields:
        n, m = actuation.shape
        values = require_finite("ControlNoise intensity", as_floats("ControlNoise intensity", self.intensity))
        if values.ndim == 3:
            field = finite_array("ControlNoise intensity", values, (n, values.shape[1], m))
        else:
            strength = broadcast_array("ControlNoise intensity", values, m)
            field = np.zeros((n, m, m))
            field[:, np.arange(m), np.arange(m)] = actuation * strength
        return _compiled(n, m, field.shape[1], control=field)


@dataclass(frozen=True, eq=False)
class StateNoise(Noise):
    """Forces that grow with the distance from a posture: F_i = C_i e_i (q_i - center_i)^2.

    Attributes:
        intensity: One number, (n,) or by joint name [N m s^0.5 / rad^2 or N s^0.5 / m^2].
        center: One number, (n,) or by joint name [rad or m]; the initial configuration of the motion if None.
    """

    intensity: JointValues
    center: JointValues | None = None

    def bind(self, actuation: Floats) -> CompiledFields:
        n, m = actuation.shape
        strength = np.diag(broadcast_array("StateNoise intensity", self.intensity, n))
        center = np.full(n, np.nan) if self.center is None else broadcast_array("StateNoise center", self.center, n)
        return _compiled(n, m, n, quadratic=strength, center=np.repeat(center[:, None], n, axis=1))


Field = Callable[[Floats, Floats, Floats], ArrayLike]


@dataclass(frozen=True, eq=False)
class CustomNoise(Noise):
    """A diffusion field that you write in Python. Motions with it run in Python, not in compiled code.

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

    def bind(self, actuation: Floats) -> CustomFields:
        count("CustomNoise processes", self.processes)
        for name in ("field", "dq", "dv", "du"):
            value = getattr(self, name)
            if not callable(value) and (value is not None or name == "field"):
                raise InputError(f"CustomNoise {name} must be a function of (q, v, u), got {value!r}")
        bound = CustomFields(self, *actuation.shape)
        if self.check:
            bound.check()
        return bound


@dataclass(frozen=True, eq=False)
class CustomFields(BoundNoise):
    """A :class:`CustomNoise` on a robot."""

    noise: CustomNoise
    n: int
    m: int

    @property
    def processes(self) -> int:
        return self.noise.processes

    @property
    def velocity_dependent(self) -> bool:
        return self.noise.dv is not None

    @property
    def sloped(self) -> Integers:
        return np.arange(0 if self.noise.du is None else self.processes)

    def fields(self, q: Floats, v: Floats, u: Floats, start: Floats) -> Fields:  # noqa: ARG002
        """See :meth:`BoundNoise.fields`.

        Raises:
            NoiseFieldError: A function raised, or its result is not a finite array of the right shape.
        """
        shape = (self.n, self.processes)
        # Copies, so that a field that writes into its arguments cannot change the state of a motion.
        points = list(zip(q.copy(), v.copy(), u.copy(), strict=True))
        noise = self.noise
        return Fields(
            self._evaluate("field", noise.field, points, shape),
            self._evaluate("dq", noise.dq, points, (*shape, self.n)),
            None if noise.dv is None else self._evaluate("dv", noise.dv, points, (*shape, self.n)),
            self._evaluate("du", noise.du, points, (*shape, self.m)),
        )

    def _evaluate(
        self, name: str, function: Field | None, points: Sequence[tuple[Floats, Floats, Floats]], shape: tuple[int, ...]
    ) -> Floats:
        if function is None:
            return np.zeros((len(points), *shape))
        what = f"CustomNoise {name}(q, v, u)"
        rows = [returned(what, partial(function, *at), shape, error=NoiseFieldError) for at in points]
        return np.array(rows)

    def check(self) -> None:
        """Compare the derivatives with differences at three seeded random points.

        Raises:
            InputError: A derivative differs; the message names it, the point and the error.
        """
        rng, n, shape = np.random.default_rng(0), self.n, (self.n, self.processes)
        for _ in range(3):
            q, v, u = (rng.normal(size=size) for size in (n, n, self.m))
            given = self.fields(q[None], v[None], u[None], q)

            def field(x: Floats) -> Floats:
                at = x[:n], x[n : 2 * n], x[2 * n :]
                value: Floats = self._evaluate("field", self.noise.field, [at], shape)[0]
                return value

            found = np.split(slopes(field, np.concatenate([q, v, u]), 1e-3), [n, 2 * n], axis=2)
            derivatives = given.Fq, np.zeros_like(given.Fq) if given.Fv is None else given.Fv, given.Fu
            for name, derivative, differences in zip(("dq", "dv", "du"), derivatives, found, strict=True):
                off = np.abs(derivative[0] - differences)
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

    def bind(self, actuation: Floats) -> BoundNoise:
        return _together([term.bind(actuation) for term in self.terms])


def _named(noise: Noise, joints: Sequence[str]) -> Noise:
    """The model with arrays in the order of ``joints`` in place of numbers by joint name.

    Raises:
        UnknownJoint: A name is not in ``joints``.
    """
    if isinstance(noise, NoiseSum):
        return NoiseSum(tuple(_named(term, joints) for term in noise.terms))
    given: dict[str, Floats] = {}
    for item in fields(noise) if is_dataclass(noise) else ():  # type: ignore[var-annotated]
        value = getattr(noise, item.name)
        if "JointValues" in str(item.type) and isinstance(value, Mapping):
            given[item.name] = joint_array(f"{type(noise).__name__} {item.name}", value, joints)
    return replace(noise, **given) if given else noise  # type: ignore[type-var]


def _together(parts: Sequence[BoundNoise]) -> BoundNoise:
    """The concatenated processes of several bound models; in the form of the core if all are."""
    arrays = [part.diffusion for part in parts if part.diffusion is not None]
    if len(parts) == 1 or len(arrays) < len(parts):
        return parts[0] if len(parts) == 1 else CompositeFields(tuple(parts))
    return CompiledFields(Diffusion(*(np.concatenate(columns, axis=1) for columns in zip(*arrays, strict=True))))


def _terms(noise: Noise) -> tuple[Noise, ...]:
    return noise.terms if isinstance(noise, NoiseSum) else (noise,)


def _sound(model: Noise, bound: BoundNoise, n: int, m: int) -> BoundNoise:
    """``bound``, the result of a model's ``bind``, checked for type, shapes and finite values."""
    name = type(model).__name__
    if not isinstance(bound, BoundNoise):
        raise InputError(f"bind of {name} must return a BoundNoise, got {type(bound).__name__}")
    k = count(f"processes of {name}", bound.processes)
    if bound.diffusion is not None:
        shapes = ((n, k), (n, k, m), (n, k), (n, k))
        for field, array, shape in zip(Diffusion._fields, bound.diffusion, shapes, strict=True):
            if not isinstance(array, np.ndarray) or array.shape != shape or array.dtype != np.float64:
                raise InputError(f"the diffusion of {name} has a field {field!r} that is no float64 array {shape}")
            # NaN in a center means the initial configuration.
            if not (np.isfinite(array).all() or field == "center"):
                raise InputError(f"the diffusion of {name} has a field {field!r} that is not finite")
    return bound


def bind(noise: Noise | Sequence[Noise] | None, actuation: Floats, joints: Sequence[str] | None = None) -> BoundNoise:
    """No noise model, one, or several, on a robot with this actuation matrix (n, m) and these joint names.

    Raises:
        UnknownJoint: A model names a joint that is not in ``joints``.
        InputError: Not a noise model, or parameters that do not fit the robot.
    """
    if noise is None or (isinstance(noise, Sequence) and not noise):
        n, m = actuation.shape
        return _compiled(n, m, 0)
    models: Sequence[Noise] = [noise] if isinstance(noise, Noise) or not isinstance(noise, Sequence) else noise
    bound = []
    for model in models:
        if not isinstance(model, Noise):
            raise InputError(f"noise must be a varpin noise model or several of them, got {type(model).__name__}")
        known = model if joints is None else _named(model, joints)
        bound.append(_sound(known, known.bind(actuation), *actuation.shape))
    return _together(bound)
