"""The base class of variational integrators: state, noise impulses, guards."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from varpin.arrays import Floats
from varpin.core import Guards, Outcome, Parameters, Rollout, Steps, filter_variational
from varpin.core.arrays import FilterArrays, FilterLog, RolloutArrays
from varpin.errors import InputError, LinearizationError, SingularMassMatrix
from varpin.integrators.base import Integrator, Run, Segment, Varied, drifts, forces, gears, without_inputs, written
from varpin.integrators.tableau import Scheme
from varpin.mechanics.forces import limited_servos
from varpin.mechanics.scene import Scene, refuse_constraints
from varpin.signals.commands import cubics
from varpin.support.checks import count, fraction, positive, word
from varpin.support.differences import FOURTH, slopes
from varpin.trajectory import Trajectory

# Largest number of halvings of a step.
_MOST_HALVINGS = 30
# Tolerance of an energy balance that is not checked.
_UNCHECKED = 1e300

# Steps of differences for second derivatives under constraints [rad or m, and of momenta and forces by speeds].
_SHIFT = 2.5e-4

REASONS: dict[int, str] = {
    Outcome.diverged: "Newton's iteration does not contract, in parts of the step either",
    Outcome.not_finite: "the step equation gives values that are not finite",
    Outcome.fold: "the step is at a fold of the step equation's solutions (its branch margin is not positive)",
    Outcome.energy: "the energy balance of the step does not close",
    Outcome.singular: "the mass matrix at the end of the step is not positive definite",
    Outcome.toggle: "constraints are about to depend on each other, as at a toggle point, or cease to",
    Outcome.assembly: "the constraints turn so far that the step may end in another assembly",
}


@dataclass(frozen=True)
class Guard:
    """Conditions on accepted variational steps. A step that is not accepted is halved, repeatedly if need be.

    The step equation has other roots than the one that is connected to dt -> 0, and Newton's method may find them
    (docs/mathematics.md, "The principal branch").

    Args:
        branch_margin: Required distance of a root from the fold of solutions, in [0, 1): the destabilising term of the
            step equation's Jacobian is multiplied by 1 / (1 - branch_margin).
        energy_balance: Largest error in the energy balance of a substep, relative to the energy that it converts.
        energy_budget: Largest sum of these errors over all substeps, relative to the largest kinetic energy so far
            (plus the work done by forces). The closer the sum is to the budget, the smaller the errors of the same sign
            that are accepted.
        max_halvings: Most halvings of a step, at most 30. A step has at most 1024 parts, however short.

    Raises:
        InputError: A value is out of its range.
    """

    branch_margin: float = 0.5
    energy_balance: float = 0.005
    energy_budget: float = 0.02
    max_halvings: int = 20

    def __post_init__(self) -> None:
        if fraction("branch_margin", self.branch_margin) == 1.0:
            raise InputError("branch_margin must be in [0, 1), got 1")
        positive("energy_balance", self.energy_balance, "1")
        positive("energy_budget", self.energy_budget, "1")
        if count("max_halvings", self.max_halvings) > _MOST_HALVINGS:
            raise InputError(f"max_halvings must be at most {_MOST_HALVINGS}, got {self.max_halvings}")

    def __repr__(self) -> str:
        text = written(self)
        return text if text.endswith(")") else f"{text}()"


class Variational(Integrator):
    """A variational integrator on (q, p) with guarded steps and noise impulses."""

    guard: Guard | None
    tolerance: float

    variational = True
    reasons = REASONS
    # Factors of the guard's energy balance and energy budget, of methods with more than one stage.
    shares: ClassVar[tuple[float, float]] = (1.0, 1.0)

    @property
    @abstractmethod
    def scheme(self) -> Scheme:
        """The points and coefficients of the method."""

    def __post_init__(self) -> None:
        if not (self.guard is None or isinstance(self.guard, Guard)):
            raise InputError(f"guard must be a varpin.Guard, or None for no guards, got {self.guard!r}")
        positive("tolerance", self.tolerance, "rounding units")
        word("kick", self.kick, ("left", "split", "held"))

    def halving(self, most: int) -> Self:
        if self.guard is None:
            return self
        own: Any = self  # a dataclass, as all that are made
        made: Self = replace(own, guard=replace(self.guard, max_halvings=min(self.guard.max_halvings, most)))
        return made

    def damped(self, z: Floats) -> tuple[Floats, Floats]:
        _, a, b, c, *_ = self.scheme
        stages = np.linalg.solve(np.eye(len(c)) + z[:, None, None] * a, np.stack([np.ones_like(c), c], axis=1))
        kept, held = (1.0 - z[:, None] * (b @ stages)).T
        return kept, held if self.holds_noise else self.left * kept + (1.0 - self.left)

    @property
    def keeps_constraints(self) -> bool:
        return self.scheme.places is not None

    @property
    def stage_times(self) -> tuple[float, ...]:
        times: list[float] = self.scheme.times.tolist()
        return tuple(times) if len(times) > 1 else ()

    def _places(self, scene: Scene) -> Floats:
        """The points where constraints hold, checked for a scene with constraints.

        Raises:
            InputError: The method takes no constraints, or the scene has noise that does not go with them.
        """
        places = self.scheme.places
        if places is None:
            refuse_constraints(scene, self)
            raise InputError(f"{self} keeps no constraints")
        if scene.processes and self.left < 1.0:
            raise InputError("kick='split' does not go with constraints: take kick='left' or kick='held'")
        if scene.noise.arrays.control[:, :, scene.prescribed].any():
            raise InputError(
                "ControlNoise is proportional to forces, and the control of a KinematicInput is a position: its "
                "intensity (n, k, m) must be 0 there"
            )
        if scene.noise.velocity_dependent:
            raise InputError("noise whose fields depend on the velocity does not go with constraints")
        return places

    def _guards(self, guard: Guard | None, *, energy: bool = True) -> Guards:
        """A guard for the core; None accepts every root.

        Without ``energy`` the balance is not checked: kinematic inputs exchange energy.
        """
        given = guard or Guard(max_halvings=0)
        balance, budget = self.shares if len(self.scheme.times) > 1 else (1.0, 1.0)
        return Guards.make(
            active=guard is not None,
            branch_margin=float(given.branch_margin),
            energy_balance=balance * float(given.energy_balance) if energy else _UNCHECKED,
            energy_budget=budget * float(given.energy_budget) if energy else _UNCHECKED,
            most_halvings=int(given.max_halvings),
        )

    def begun(self, scene: Scene, q0: Floats, v0: Floats) -> Run:
        guards = self._guards(self.guard, energy=not scene.inputs)
        places = self._places(scene) if scene.constraints else None
        method = scene.core, self.scheme.tableau, float(self.tolerance), guards, self.left
        rollout = Rollout(*method, len(q0), self.holds_noise, places)
        if not rollout.begin(q0, v0):
            raise SingularMassMatrix(scene.robot.joint_names, q0)
        return Run(rollout, len(q0), bool(scene.inputs))

    def fork(self, state: Run) -> Run:
        return replace(state, paths=state.paths.fork(self._guards(self.guard, energy=not state.driven)))

    def _segments(self, scene: Scene, paths: Any, nodes: RolloutArrays) -> list[Segment]:
        found = super()._segments(scene, paths, nodes)
        if not scene.constraints:
            return found
        return [_constrained(scene, paths, i, segment) for i, segment in enumerate(found)]

    def linearize(
        self, scene: Scene, trajectory: Trajectory, *, ramps: bool = False
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """See :meth:`Integrator.linearize`; the state is (q, p).

        Divided steps are repeated in the same parts, and the derivatives of the parts are multiplied.
        """
        ramp = ramps and bool(self.stage_times)
        Jx, Jf, Jr, _ = self._derivatives(scene, trajectory, ramp=ramp)
        return Jx, Jf, self._kicks(scene, trajectory, Jx, Jf), Jr if ramp else 0.5 * Jf

    def in_parameters(self, scene: Scene, trajectory: Trajectory, varied: Sequence[Varied]) -> Floats:
        pairs = [(each.above.core, each.below.core) for each in varied]
        distance = np.array([each.distance for each in varied])
        return self._derivatives(scene, trajectory, parameters=Parameters(pairs, distance, gears(scene, varied)))[3]

    def _kicks(self, scene: Scene, trajectory: Trajectory, Jx: Floats, Jf: Floats) -> Floats:
        """The derivatives in the noise impulse, from those in the state and in a constant force."""
        n = scene.robot.dof
        if self.holds_noise:
            # Drives limit the force of the controls, not the noise.
            limits = bool(limited_servos(scene.elements))
            of_noise = self._derivatives(scene, trajectory, external=True)[1] if limits else Jf
            return without_inputs(scene, of_noise[:, :, :n] / trajectory.dt)
        kicks = Jx[:, :, n:]
        if max(scene.rates, default=-1) >= 0:
            # A noise impulse does not change the velocity of a joint with a cubic input.
            kicks = kicks @ _along(scene, trajectory.q[:-1])
        return kicks

    def _derivatives(
        self,
        scene: Scene,
        trajectory: Trajectory,
        *,
        ramp: bool = False,
        external: bool = False,
        parameters: Parameters | None = None,
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Derivatives of each step in (q, p), in a constant force, in one that grows linearly from 0, in parameters.

        Without ``ramp`` the third array is empty. With ``external`` the force is one that drives do not limit. The
        columns of velocities of cubic inputs follow those of the force, as in :attr:`Scene.transmission`.
        """
        given: dict[str, Any] = {"ramp": ramp, "external": external, "parameters": parameters}
        cubic: list[int] = []
        if scene.constraints:
            given["rates"], cubic = _rates(scene, trajectory)
            given["places"] = self._places(scene)
        steps = Steps(**self._steps(scene, trajectory))
        Jx, Jf, Jr, by_rate, Jp, outcome, done = steps.derivatives(**given)
        _require_solved(trajectory, outcome, done)
        if cubic:
            Jf = np.concatenate([Jf, by_rate[:, :, cubic]], axis=2)
            Jr = np.concatenate([Jr, by_rate[:, :, cubic]], axis=2) if ramp else Jr
        return Jx, Jf, Jr, Jp

    def _contract_by_differences(self, scene: Scene, trajectory: Trajectory, z: Floats) -> Floats:
        """:meth:`contract` under constraints, by differences of z' J with exact derivatives J, scaled by M."""
        n, N = scene.robot.dof, trajectory.steps
        rates, cubic = _rates(scene, trajectory)
        wide = 3 * n + len(cubic)
        steps, places = self._steps(scene, trajectory), self._places(scene)
        M, _ = scene.core.jets(trajectory.q[:-1], trajectory.v[:-1])
        S = np.zeros((N, wide, wide))
        S[:] = np.eye(wide)
        S[:, n : 2 * n, n : 2 * n] = M
        S[:, 2 * n : 3 * n, 2 * n : 3 * n] = M / trajectory.dt
        for c in scene.inputs.values():
            # The control of a kinematic input is a position, not a force.
            S[:, 2 * n + c, 2 * n : 3 * n] = S[:, 2 * n : 3 * n, 2 * n + c] = 0.0
            S[:, 2 * n + c, 2 * n + c] = 1.0

        def gradients(y: Floats) -> Floats:
            shift, by = S @ y, rates.copy()
            by[:, cubic] += shift[:, 3 * n :]
            at = {"q": steps["q"] + shift[:, :n], "p": steps["p"] + shift[:, n : 2 * n]}
            at["force"] = steps["force"] + shift[:, None, 2 * n : 3 * n]
            Jx, Jf, _, Jr, _, outcome, done = Steps(**(steps | at)).derivatives(places=places, rates=by)
            _require_solved(trajectory, outcome, done)
            J = np.concatenate([Jx, Jf, Jr[:, :, cubic]], axis=2)
            found: Floats = np.einsum("Na,Nab->Nb", z, J)
            return found

        towards = slopes(gradients, np.zeros(wide), _SHIFT, FOURTH)
        H = np.swapaxes(np.linalg.solve(np.swapaxes(S, 1, 2), np.swapaxes(towards, 1, 2)), 1, 2)
        symmetric: Floats = 0.5 * (H + np.swapaxes(H, 1, 2))
        return symmetric

    def contract(self, scene: Scene, trajectory: Trajectory, z: Floats) -> Floats:
        """See :meth:`Integrator.contract`; divided steps are treated as in :meth:`linearize`."""
        if scene.custom is not None:
            raise InputError("second derivatives are not there for a scene with a CustomForce")
        if scene.constraints:
            return self._contract_by_differences(scene, trajectory, z)
        H, outcome, done = Steps(**self._steps(scene, trajectory)).curvatures(z)
        _require_solved(trajectory, outcome, done)
        return H

    def quiet_ends(self, scene: Scene, trajectory: Trajectory) -> tuple[Floats, Floats]:
        """See :meth:`Integrator.quiet_ends`; the steps are those that :meth:`linearize` differentiates."""
        q, v, outcome, done = Steps(**self._steps(scene, trajectory)).ends()
        _require_solved(trajectory, outcome, done)
        return q, v

    def filtered(self, scene: Scene, log: FilterLog) -> FilterArrays:
        """See :meth:`Integrator.filtered`; the state is (q, p)."""
        guards = self._guards(self.guard or Guard(), energy=False)
        found = filter_variational(scene.core, self.scheme.tableau, float(self.tolerance), guards, log)
        return self._reached(found, log, REASONS)

    def _steps(self, scene: Scene, trajectory: Trajectory) -> dict[str, Any]:
        """Arguments of the core, by name, to repeat every step at dw = 0."""
        statistics = trajectory.statistics
        drift = self.drift_share * drifts(scene, trajectory)
        force = forces(scene, trajectory, drift)
        arrays = {
            "q": trajectory.q[:-1],
            "p": trajectory.p[:-1],
            "force": force,
            "substeps": np.maximum(statistics.substeps, 1),
            "halvings": statistics.halvings,
            "guess": self._guess(trajectory),
        }
        return {
            "mechanism": scene.core,
            "tableau": self.scheme.tableau,
            "tolerance": float(self.tolerance),
            # Without noise the steps are the same, and there is nothing to check. Otherwise they differ by the noise
            # impulses, and their roots must lie on the branch that is connected to dt -> 0.
            "guards": self._guards(self.guard if trajectory.noisy else None, energy=False),
            "dt": float(trajectory.dt),
            **arrays,
        }

    def _guess(self, trajectory: Trajectory) -> Floats:
        """Stage velocities (N, s, n) at dw = 0 from the cubic through both nodes; with noise, those at the starts."""
        v, moved, times = trajectory.v, np.diff(trajectory.q, axis=0), self.scheme.times
        if trajectory.noisy:
            return np.repeat(v[:-1, None], len(times), axis=1)
        if len(times) == 1:
            return (moved / trajectory.dt)[:, None]  # the exact root for one stage
        along = cubics(times, trajectory.dt)[:, 5:]
        guess: Floats = np.einsum("se,kne->ksn", along, np.stack([v[:-1], moved, v[1:]], axis=2))
        return guess


def _constrained(scene: Scene, paths: Rollout, i: int, segment: Segment) -> Segment:
    """The segment with the impulses of path ``i`` and, in its failure, the constraint that stopped the path."""
    failure = segment.failure
    if failure is not None and failure.reason in (REASONS[Outcome.toggle], REASONS[Outcome.assembly]):
        label = scene.bound_constraints.labels[paths.weakest(i)]
        failure = replace(failure, reason=f"{failure.reason}: {label}")
    return replace(segment, impulses=paths.impulses(i)[:, scene.constraint_order], failure=failure)


def _rates(scene: Scene, trajectory: Trajectory) -> tuple[Floats, list[int]]:
    """Velocities that inputs have at the ends of steps (N, i), zero for those on lines; and which inputs have one."""
    cubic = [k for k, rate in enumerate(scene.rates) if rate >= 0]
    rates = np.zeros((trajectory.steps, len(scene.rates)))
    rates[:, cubic] = trajectory.u[:, [scene.rates[k] for k in cubic]]
    return rates, cubic


def _along(scene: Scene, q: Floats) -> Floats:
    """Projection 1 - C' (C M^-1 C')^-1 C M^-1 (N, n, n) of impulses onto the constraints at configurations (N, n)."""
    M, _ = scene.core.jets(q, np.zeros_like(q))
    C = scene.core.constraints(q)[2]
    eased = np.linalg.solve(M, C.transpose(0, 2, 1))
    found: Floats = np.eye(q.shape[1]) - C.transpose(0, 2, 1) @ np.linalg.pinv(C @ eased, rcond=1e-9) @ eased.transpose(
        0, 2, 1
    )
    return found


def _require_solved(trajectory: Trajectory, outcome: int, done: int) -> None:
    if outcome in REASONS:
        raise LinearizationError(done, done * trajectory.dt, REASONS[outcome])
