"""Variational integrators of high order: collocation at the Gauss points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from varpin.checks import count
from varpin.errors import InputError, LinearizationError
from varpin.integrators.base import Segment, drifts, read_only, segments_of, steps_of
from varpin.integrators.variational import REASONS, Variational, VariationalRun
from varpin.kernels import gauss as kernels
from varpin.kernels import gauss_equation as stage_equation
from varpin.kernels import midpoint_equation as equation
from varpin.kernels.gauss_linearize import linearize
from varpin.kernels.gauss_tableau import tableau
from varpin.kernels.tree import Commands, new_nodes
from varpin.scene import Scene
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]

MOST_STAGES = 6
# Of the energy errors that one stage is allowed, what is enough for more: steps of high order seldom need it.
BALANCE_SHARE, BUDGET_SHARE = 1 / 25, 1 / 100


@dataclass(frozen=True)
class Gauss(Variational):
    """Variational Gauss-Legendre collocation with s stages, in position-momentum form.

    Solves L_v(Q_i, V_i) = p0 + dt sum_j a_ij (L_q + F)(Q_j, V_j) with Q_i = q0 + dt sum_j a_ij V_j for the stage
    velocities V_i. Of order 2 s, symmetric, and symplectic where nothing is forced; one stage is ``Midpoint()``.

    Dampers and springs of the scene act at every stage and keep the order. Controls are constant over a step, and so
    the motion under a digital controller (a control law, a :class:`varpin.LinearPolicy`) is of order 2 s. Of a control
    that changes within the step the motion is right to second order only, whatever s, when it is sampled in the step's
    middle (:class:`varpin.OpenLoop`), and to first order when at its start. So put viscous friction into the scene,
    not into a control law.

    Steps are accepted or taken in parts as :class:`Midpoint` does.

    Main args:
        stages: s, from 1 to 6.

    Other Args:
        tolerance: As of :class:`Midpoint`, and so are the others.
        branch_margin: Of the stages' mean mass matrix and curvature.
        energy_balance: Largest error in the energy balance of a substep, in units of the energy it turns over; of more
            than one stage 1/25 of it is asked.
        energy_budget: The errors of all substeps together, in units of the largest kinetic energy so far; of more than
            one stage 1/100 of it is asked. That costs few substeps and keeps fifty times the energy: a chaotic
            motion gathers its energy error in a few violent moments.
        max_halvings: A step is never cut into more than 2**max_halvings parts.
        kick: When noise kicks the momentum, ``"left"`` or ``"split"``.
    """

    stages: int = 2
    tolerance: float = 0.5
    branch_margin: float = 0.5
    energy_balance: float = 0.005
    energy_budget: float = 0.02
    max_halvings: int = 12
    kick: Literal["left", "split"] = "left"

    named = ("stages",)

    def __post_init__(self) -> None:
        if count("stages", self.stages, 1) > MOST_STAGES:
            raise InputError(f"stages must be at most {MOST_STAGES}, got {self.stages}")
        super().__post_init__()

    @property
    def order(self) -> int:
        """See :meth:`Integrator.order`; 2 s."""
        return 2 * int(self.stages)

    def _gauss_options(self) -> equation.Options:
        options = self._options(0.5)
        if self.stages == 1:
            return options
        return options._replace(balance=BALANCE_SHARE * options.balance, budget=BUDGET_SHARE * options.budget)

    def _arrays(self, scene: Scene, paths: int) -> tuple[equation.State, stage_equation.Stages]:
        stages, dof = int(self.stages), scene.robot.dof
        processes, loads = scene.mechanism.diffusion.constant.shape[1], scene.robot.tree.loads.size
        state = stage_equation.new_gauss_state(stages, paths, dof, processes, loads)
        return state, stage_equation.new_stages(stages, dof)

    def rollout_compiled(
        self,
        scene: Scene,
        state: VariationalRun,
        commands: Commands,
        increments: Floats,
        drift: Floats,
        dt: float,
    ) -> list[Segment]:
        """See :meth:`Integrator.rollout_compiled`."""
        nodes = new_nodes(len(state.state.q), steps_of(commands), scene.robot.dof, scene.controls)
        kernels.rollout(
            scene.mechanism,
            tableau(int(self.stages)),
            self._gauss_options(),
            dt,
            commands,
            increments,
            drift,
            state.state,
            state.work,
            state.stages,
            nodes,
        )
        return segments_of(nodes, REASONS)

    def linearize(self, scene: Scene, trajectory: Trajectory) -> tuple[Floats, Floats, Floats]:
        """See :meth:`Integrator.linearize`; the state is (q, p).

        A step that was taken in parts is taken in parts again, and their derivatives are chained.
        """
        steps, n = trajectory.steps, scene.robot.dof
        q, p = (read_only(getattr(trajectory, name)[:-1]) for name in ("q", "p"))
        force = trajectory.u @ scene.actuation.T + self.drift_share * drifts(scene, trajectory)
        Jx, Jf = np.empty((steps, 2 * n, 2 * n)), np.empty((steps, 2 * n, n))
        state, stages = self._arrays(scene, 1)
        outcome, done = linearize(
            scene.mechanism,
            tableau(int(self.stages)),
            # A root that is known to 1e-10 is good enough for derivatives.
            self._gauss_options()._replace(tolerance=1e6),
            trajectory.dt,
            q,
            p,
            read_only(self._guess(trajectory)),
            read_only(force),
            read_only(trajectory.statistics.substeps),
            state,
            equation.new_work(scene.robot.tree.parent.size, n, scene.robot.tree.loads.size, derivatives=True),
            stages,
            Jx,
            Jf,
        )
        if outcome != equation.SOLVED:
            raise LinearizationError(done, done * trajectory.dt, REASONS[outcome])
        return Jx, Jf, Jx[:, :, n:]

    def _guess(self, trajectory: Trajectory) -> Floats:
        """Stage velocities (N, s, n) of the cubic through the nodes and their velocities.

        With noise the step at dw = 0 starts from another momentum, and its velocity is all there is to go by.
        """
        q, v = trajectory.q, trajectory.v
        c = tableau(int(self.stages)).c[None, :, None]
        if trajectory.dw.any():
            return v[:-1, None] + np.zeros_like(c)
        mean = (np.diff(q, axis=0) / trajectory.dt)[:, None]
        guess: Floats = (
            (1.0 - c) * (1.0 - 3.0 * c) * v[:-1, None] + c * (3.0 * c - 2.0) * v[1:, None] + 6.0 * c * (1.0 - c) * mean
        )
        return guess
