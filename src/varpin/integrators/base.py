"""The contract of every integrator.

Equation (N1) of docs/mathematics.md, the Ito correction; (1.3) of the paper.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, ClassVar, Literal, NamedTuple, Self

import numpy as np

from varpin.arrays import Floats, Integers
from varpin.core.arrays import Commands, FilterArrays, FilterLog, RolloutArrays, new_nodes
from varpin.errors import InputError, LinearizationError, SingularMassMatrix
from varpin.mechanics.noise import Fields, ito_drift, over_steps
from varpin.mechanics.scene import Scene
from varpin.signals.commands import contiguous, steps_of, with_ends
from varpin.trajectory import STEP_NUMBERS, StepStatistics, Trajectory, joined

# Fields of a segment with one row for each node.
_ARRAYS = ("q", "p", "v", "u", "energy")


@dataclass(frozen=True)
class Failure:
    """Why a rollout stopped before its end, and its last residual, in units of the rounding error."""

    reason: str
    residual: float


@dataclass(frozen=True, eq=False)
class Segment:
    """Consecutive steps of a rollout: the node after each step, and solver statistics.

    Attributes:
        q: Configurations (k, n) [rad or m].
        p: Momenta (k, n).
        v: Velocities (k, n) [rad/s or m/s].
        u: Controls applied (k, m).
        energy: Energies (k,) [J].
        statistics: Statistics of the k steps.
        failure: Why the next step failed, or None.
        impulses: Constraint impulses over each step (k, c) [N s or N m s], or None without constraints.
    """

    q: Floats
    p: Floats
    v: Floats
    u: Floats
    energy: Floats
    statistics: StepStatistics
    failure: Failure | None = None
    impulses: Floats | None = None

    def part(self, steps: int) -> Segment:
        """The first steps, as views."""
        values = {name: getattr(self, name)[:steps] for name in _ARRAYS}
        impulses = None if self.impulses is None else self.impulses[:steps]
        return Segment(**values, statistics=self.statistics.part(0, steps), impulses=impulses)


class Varied(NamedTuple):
    """A parameter: scenes with a greater and with a smaller value of it."""

    above: Scene
    below: Scene
    distance: float  # between their values


@dataclass(frozen=True)
class Run:
    """State of a rollout."""

    paths: Any  # with the methods ``first_nodes``, ``roll`` and ``copy``, as those of the core; it has work arrays
    count: int  # P
    driven: bool = False  # whether the scene has kinematic inputs


class Integrator(ABC):
    """A one-step method.

    A subclass provides

    1. ``begun``, the paths of a rollout at (q0, v0);
    2. ``linearize``, the derivatives of its steps, and ``quiet_ends`` if it applies noise after a step too;
    3. ``variational``, True if it maps (q, p) and False if it maps (q, v), ``order``, and ``reasons``.
    """

    variational: bool
    # Texts of the outcomes that end a rollout.
    reasons: ClassVar[Mapping[int, str]]
    # Whether fast damped modes are at rest after one step.
    l_stable: ClassVar[bool] = False
    # When the noise impulse of a step acts, see :class:`Midpoint`.
    kick: Literal["left", "split", "held"] = "left"
    # Whether a step's noise impulse acts after the step as a whole, by the fields at its start.
    kicks_after: ClassVar[bool] = False
    # Options that the text names even at their defaults.
    named: ClassVar[tuple[str, ...]] = ()

    def __str__(self) -> str:
        """Name and options that are not the default, in the form of :func:`varpin.integrators.integrator_of`.

        A trajectory stores it.
        """
        return written(self, self.named)

    def same_map(self, other: Integrator) -> bool:
        """Whether ``other`` has the same step map for undivided steps, whatever its guard and tolerance."""
        mine, others = ({k: v for k, v in vars(x).items() if k not in ("guard", "tolerance")} for x in (self, other))
        return type(self) is type(other) and mine == others

    @property
    @abstractmethod
    def order(self) -> int:
        """The order of the error in dt without noise and with controls that are constant over each step."""

    @property
    def keeps_constraints(self) -> bool:
        """Whether it integrates scenes with constraints."""
        return False

    @property
    def stage_times(self) -> tuple[float, ...]:
        """Times in a unit step at which controls that change within it are evaluated; empty if their mean is held.

        A method with one stage holds the control at the middle of the step.
        """
        return ()

    @property
    def left(self) -> float:
        """The share of a step's noise impulse that acts before the step; the rest acts after it."""
        return 0.5 if self.kick == "split" else 1.0

    @property
    def holds_noise(self) -> bool:
        """Whether the noise of a step is a force that is constant over it, instead of impulses at its ends."""
        return self.kick == "held"

    @property
    def drift_share(self) -> float:
        """The share of the Ito correction that has to be added as a drift.

        The part of the noise impulse after the step sees the velocity after the first part, which gives the rest.
        """
        return 1.0 - 2.0 * self.left * (1.0 - self.left)

    def damped(self, z: Floats) -> tuple[Floats, Floats]:
        """What a step leaves of velocities whose damping has rates z (k,) in units of 1 / dt, and of noise impulses."""
        return np.exp(-z), np.exp(-z)

    def start(self, scene: Scene, q0: Floats, v0: Floats) -> tuple[Run, list[Segment]]:
        """The state of a rollout of P paths at (q0, v0), each (P, n), and a segment of the first node of each.

        Raises:
            SingularMassMatrix: M(q0) is not positive definite.
        """
        run, nodes = self.begun(scene, q0, v0), new_nodes(len(q0), 1, scene.robot.dof, scene.controls)
        if scene.custom is not None:
            scene.custom.check(q0, v0)
        if not run.paths.first_nodes(nodes):
            raise SingularMassMatrix(scene.robot.joint_names, q0)
        return run, segments_of(nodes, self.reasons)

    def halving(self, most: int) -> Self:  # noqa: ARG002 - only guards halve steps
        """The same method, whose guard halves a step at most this often."""
        return self

    @abstractmethod
    def begun(self, scene: Scene, q0: Floats, v0: Floats) -> Run:
        """The state of a rollout of P paths at (q0, v0), each (P, n).

        Raises:
            InputError: The method does not take the scene.
            SingularMassMatrix: As :meth:`start`, at the latest there.
        """

    def fork(self, state: Run) -> Run:
        """An independent copy of a state, with this integrator's guard and shared work arrays."""
        return replace(state, paths=state.paths.copy())

    def rollout(
        self,
        scene: Scene,
        state: Run,
        commands: Commands,
        increments: Floats,
        dt: float,
        *,
        drift: Floats | None = None,
        impulses: Floats | None = None,
    ) -> list[Segment]:
        """Advance ``state`` by the N steps of ``commands``, each of length ``dt`` [s]; a segment for each path.

        ``increments`` are the Wiener increments (P, N, k) [s^0.5], or (0, 0, k) for none; (P, N, K), those of slopes
        included (:meth:`Scene.increments`), for controls that are linear between nodes. ``drift`` is a force (P, N, n)
        instead of the drift of the noise. ``impulses`` (P, N, 2, n) are added to the momenta before and after each
        step, but not under constraints; an integrator that holds the noise spreads them over the step.
        """
        nodes = new_nodes(state.count, steps_of(commands), scene.robot.dof, scene.controls)
        drift = scene.no_drift if drift is None else drift
        state.paths.roll(dt, contiguous(commands), increments, drift, nodes, impulses=impulses)
        return self._segments(scene, state.paths, nodes)

    def _segments(self, scene: Scene, paths: Any, nodes: RolloutArrays) -> list[Segment]:  # noqa: ARG002
        """A segment for each of the paths, which have written ``nodes``."""
        return segments_of(nodes, self.reasons, paths)

    def motions(
        self, scene: Scene, q0: Floats, v0: Floats, commands: Commands, dt: float
    ) -> tuple[Floats, Floats] | None:
        """Configurations and velocities (P, N, n) after each step of P motions from (q0, v0) (P, n), without noise.

        ``commands`` are as for :meth:`rollout`. Returns None if a motion fails.
        """
        try:
            state = self.begun(scene, q0, v0)
        except SingularMassMatrix:
            return None
        nodes = new_nodes(len(q0), steps_of(commands), scene.robot.dof, scene.controls)
        state.paths.roll(dt, commands, scene.silence, scene.no_drift, nodes)
        return None if nodes.ended.any() else (nodes.q, nodes.v)

    def quiet_ends(self, scene: Scene, trajectory: Trajectory) -> tuple[Floats, Floats]:
        """The ends of the steps at dw = 0, q and v (N, n), for integrators that apply noise after the step.

        Raises:
            LinearizationError: A step has no solution at dw = 0.
        """
        raise NotImplementedError(f"{self} does not kick after the step")

    @abstractmethod
    def linearize(
        self, scene: Scene, trajectory: Trajectory, *, ramps: bool = False
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Derivatives of each step at dw = 0.

        They are taken in the state (N, 2n, 2n), in a constant force (N, 2n, n), in the noise impulse (N, 2n, n), a
        jump of the momentum, or of the velocity for integrators on (q, v), and, with ``ramps``, in the end of a force
        that grows linearly over the step from 0 (N, 2n, n): half of that in a constant force for methods that hold the
        mean force. For integrators that hold the noise of a step, those in the noise impulse are those in the impulse
        of a constant force.

        Raises:
            LinearizationError: A step has no solution at dw = 0.
        """

    def in_parameters(self, scene: Scene, trajectory: Trajectory, varied: Sequence[Varied]) -> Floats:  # noqa: ARG002
        """Derivatives of each step at dw = 0 in P parameters (N, 2n, P), at fixed state and controls.

        Raises:
            InputError: The integrator does not provide them.
            LinearizationError: A step has no solution at dw = 0.
        """
        raise InputError(
            f"{self} has no derivatives in parameters; variational and explicit integrators have, such as "
            "varpin.Midpoint()"
        )

    def contract(self, scene: Scene, trajectory: Trajectory, z: Floats) -> Floats:  # noqa: ARG002
        """Second derivatives sum_a z_a d2 x1_a of each step at dw = 0 in (x0, f), (N, 3n, 3n), for z (N, 2n).

        Raises:
            InputError: The integrator does not provide them.
            LinearizationError: A step has no solution at dw = 0.
        """
        raise InputError(
            f"{self} has no second-order linearization; variational integrators have, such as varpin.Gauss(...)"
        )

    def filtered(self, scene: Scene, log: FilterLog) -> FilterArrays:  # noqa: ARG002
        """The extended Kalman filter over a log, by the derivatives of this method's steps, without constraints.

        Raises:
            InputError: The integrator does not provide it.
            LinearizationError: A step has no solution; its index is that of the sample before.
        """
        raise InputError(f"{self} has no Kalman filter; the others have, such as varpin.Gauss(stages=2)")

    def _reached(self, found: tuple[Any, ...], log: FilterLog, reasons: Mapping[int, str]) -> FilterArrays:
        """The arrays of the core's filter, which ended early if a step has no solution."""
        *arrays, outcome, done = found
        if outcome in reasons:
            time = float(log.parts[: done - 1] @ log.h[: done - 1])
            raise LinearizationError(done - 1, time, reasons[outcome])
        return FilterArrays(*arrays)


def written(made: object, named: Sequence[str] = ()) -> str:
    """A dataclass as the text of its constructor call, with the options in ``named`` and those not at their default."""
    given: dict[str, Any] = {item.name: item.default for item in fields(made)} if is_dataclass(made) else {}
    options = [
        f"{option}={_text(getattr(made, option))}"
        for option, default in given.items()
        if option in named or getattr(made, option) != default
    ]
    name = type(made).__name__
    return f"{name}({', '.join(options)})" if options else name


def _text(value: object) -> str:
    """A value as Python reads it."""
    return f'"{value}"' if isinstance(value, str) else str(value)


def join(segments: Sequence[Segment]) -> Segment:
    """Consecutive segments as one."""
    statistics = joined([segment.statistics for segment in segments])
    nodes = {name: np.concatenate([getattr(s, name) for s in segments]) for name in _ARRAYS}
    parts = [s.impulses for s in segments if s.impulses is not None]
    impulses = np.concatenate(parts) if parts else None
    return Segment(**nodes, statistics=statistics, failure=segments[-1].failure, impulses=impulses)


def drifts(scene: Scene, trajectory: Trajectory) -> Floats | float:
    """The drift of :func:`ito_drift` at the start of every step (N, n), or 0 where none has any."""
    if not scene.noise.velocity_dependent:
        return 0.0
    q, v = trajectory.q[:-1], trajectory.v[:-1]
    return ito_drift(scene.core, q, v, noise_fields(scene, trajectory, q, v, trajectory.q[0]))


def noise_fields(
    scene: Scene, trajectory: Trajectory, q: Floats, v: Floats, first: Floats, steps: slice | Integers = slice(None)
) -> Fields:
    """The diffusion fields at (q, v) of the increments of some steps of a motion that began at ``first`` (n,).

    With controls that are linear between nodes they are those of :func:`varpin.mechanics.noise.over_steps`.
    """
    nodes, u, ends = trajectory.u_nodes, trajectory.u[steps], None
    if nodes.shape[1]:
        # The noise sees positions of kinematic inputs at the end of a step.
        ends = with_ends(scene, nodes[:-1][steps], u), with_ends(scene, nodes[1:][steps], u)
    return over_steps(scene.noise, q, v, u, ends, first)


def noise_impulses(
    scene: Scene, trajectory: Trajectory, q: Floats, v: Floats, steps: slice | Integers = slice(None)
) -> Floats:
    """The impulses (N, n) of the noise of some steps of a motion, with its fields at (q, v) (N, n)."""
    dw = trajectory.dw[steps]
    F = noise_fields(scene, trajectory, q, v, trajectory.q[0], steps).F
    found: Floats = np.einsum("Nik,Nk->Ni", F[:, :, : dw.shape[1]], dw)
    return found


def without_inputs(scene: Scene, values: Floats) -> Floats:
    """Values (..., n) with zeros for joints of kinematic inputs."""
    if scene.inputs:
        values = values.copy()
        values[..., list(scene.inputs.values())] = 0.0
    return values


def forces(scene: Scene, trajectory: Trajectory, drift: Floats | float = 0.0) -> Floats:
    """Forces of the controls plus a drift (N, n): (N, 1, n), or (N, s, n) for controls that change within steps."""
    drift = drift[:, None] if isinstance(drift, np.ndarray) else drift
    u = trajectory.u_stages if trajectory.u_stages.shape[1] else trajectory.u[:, None]
    return (u if scene.direct else u @ scene.actuation.T) + drift


def gears(scene: Scene, varied: Sequence[Varied]) -> Floats:
    """Factors (P, 2, n) by which controls of ``scene`` exert more force in other scenes, whose servos are stiffer."""
    others = np.array([[each.above.actuation, each.below.actuation] for each in varied])
    before, after = (np.abs(each).sum(axis=-1) for each in (scene.actuation, others))
    factors: Floats = np.divide(after, before, out=np.ones_like(after), where=before > 0.0)
    return factors


def segments_of(nodes: RolloutArrays, reasons: Mapping[int, str], paths: Any = None) -> list[Segment]:
    """A segment for each path, with views of the arrays that the core wrote.

    ``paths`` are those of the core, asked for the halvings of divided steps.
    """
    segments = []
    for i, done in enumerate(nodes.done.tolist()):
        tally, quality, ended = nodes.tally[i, :done], nodes.quality[i, :done], int(nodes.ended[i])
        split = done > 0 and tally[:, 3].max() > 1
        halvings = paths.halvings(i) if split else np.zeros(0, dtype=np.uint8)
        # The core writes the numbers in the order of the fields.
        numbers = dict(zip(STEP_NUMBERS, (*tally.T, *quality.T), strict=True))
        statistics = StepStatistics(**numbers, halvings=halvings)
        own = {name: getattr(nodes, name)[i, :done] for name in _ARRAYS}
        failure = Failure(reasons[ended], float(nodes.quality[i, done, 0])) if ended in reasons else None
        segments.append(Segment(**own, statistics=statistics, failure=failure))
    return segments
