"""Trial motions of a search: rollouts with their running cost, stopped early where they cannot be accepted.

One call of the core integrates a motion, sums its cost and stops where it takes too many substeps or costs more than
any step of the search would accept.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from varpin.arrays import Floats
from varpin.control.problem import OptimalControlProblem
from varpin.core import Watch
from varpin.core.arrays import Bytes, Commands, RolloutArrays
from varpin.integrators import Integrator
from varpin.integrators.base import Failure, statistics_of
from varpin.signals.commands import Lines, lines
from varpin.signals.inputs import with_ends
from varpin.trajectory import Trajectory

# Arrays that are the same for all whole motions of a problem under held controls, without constraints.
_SHARED = ("t", "dw", "masses", "u_stages", "u_nodes", "constraint_forces")


class Attempt(NamedTuple):
    """A trial motion.

    Attributes:
        failure: Why a step failed, or None.
        verdict: Why the motion was stopped; ``going`` where it was not.
    """

    trials: Trials
    nodes: tuple[Floats, Floats, Floats, Floats]  # q, v, p and energy, the first node included
    u: Floats
    written: RolloutArrays
    halvings: Bytes
    values: Floats
    impulses: Floats  # of the constraints (N, c)
    failure: Failure | None
    verdict: Watch.Verdict
    line: Lines | None = None  # its controls, where they are linear between nodes

    @property
    def whole(self) -> bool:
        """Whether it reached the end of the horizon."""
        return self.failure is None and self.verdict is Watch.Verdict.going

    def shares(self) -> Floats:
        """The terms of its cost, as :meth:`OptimalControlProblem.shares`; only for a whole motion."""
        q, v, _, _ = self.nodes
        problem = self.trials.problem
        if self.line is not None:
            u = self.line.nodes
            return problem.shares_along(q, v, u, problem.running.compiled.values(*problem.samples(q, v, u)))
        return problem.shares_along(q, v, self.u, self.values)

    def trajectory(self) -> Trajectory:
        """The motion up to where it ended."""
        trials, done = self.trials, int(self.written.done[0])
        scene, known = trials.problem.scene, trials.whole
        for array in (self.written.tally, self.written.quality, self.halvings):
            # So are the views of them that the statistics have.
            array.setflags(write=False)
        statistics = statistics_of(self.written, 0, done, self.halvings)
        if known is not None and self.whole and self.line is None:
            # Checked once: all whole motions of a problem have the same shapes.
            q, v, p, energy = self.nodes
            # Views of what does not change: the arrays of each motion are its own objects, pickled or not.
            own = {"q": q, "v": v, "p": p, "energy": energy, "u": self.u}
            if scene.constraints:
                own["constraint_forces"] = self.impulses / trials.problem.dt
            for array in own.values():
                array.setflags(write=False)
            shared = {name: getattr(known, name)[:] for name in _SHARED if name not in own}
            return known.changed(**own, **shared, statistics=statistics)
        q, v, p, energy = (nodes[: done + 1] for nodes in self.nodes)
        made = Trajectory(
            t=trials.times[: done + 1],
            q=q,
            v=v,
            p=p,
            energy=energy,
            u=self.u[:done] if self.line is None else self.line.mean[:done],
            dw=trials.silence[:done],
            masses=trials.masses.copy(),
            dt=trials.problem.dt,
            integrator=trials.text,
            robot=scene.robot.name,
            joint_names=scene.robot.joint_names,
            statistics=statistics,
            scene_values=scene.values,
            u_stages=np.zeros((done, 0, scene.controls)) if self.line is None else self.line.stages[:done],
            u_nodes=np.zeros((done + 1, 0)) if self.line is None else self.line.nodes[: done + 1],
            constraint_forces=self.impulses[:done] / trials.problem.dt,
            constraint_labels=scene.constraint_labels,
        )
        if self.whole and self.line is None:
            trials.whole = made
        return made


class Trials:
    """Motions of a problem without noise, under commands of any kind.

    Attributes:
        times: Times of the nodes (N + 1,) [s].
        whole: The first of them that reached the end, under held controls; later ones share what does not change.
    """

    def __init__(self, problem: OptimalControlProblem) -> None:
        self.problem = problem
        scene = problem.scene
        self._state, (self._first,) = problem.integrator.start(scene, problem.q0[None], problem.v0[None])
        self.times = np.arange(problem.steps + 1, dtype=np.float64) * problem.dt
        self.silence = np.zeros((problem.steps, scene.processes))
        self.masses = scene.robot.tree.mass.copy()
        self.text = str(problem.integrator)
        self.whole: Trajectory | None = None
        self._weight = problem.dt * float(problem.rule[0, 0])
        # Early on, the cost so far is a poor bound.
        self._third = problem.decisions // 3 * problem.hold or problem.steps + 1

    @property
    def third(self) -> int:
        """Number of steps before the first check of a motion."""
        return self._third

    def attempt(
        self, commands: Commands, *, integrator: Integrator | None = None, most: float = np.inf, parts: float = np.inf
    ) -> Attempt:
        """Integrate the motion under commands for all steps.

        Args:
            commands: The commands.
            integrator: The problem's integrator with other options; by default itself.
            most: Bound on the running cost, checked from a third of the motion on.
            parts: Bound on the substeps of that third.
        """
        problem, scene = self.problem, self.problem.scene
        N, n, m = problem.steps, scene.robot.dof, scene.controls
        integrator = problem.integrator if integrator is None else integrator
        q, v, p = np.empty((N + 1, n)), np.empty((N + 1, n)), np.empty((N + 1, n))
        energy, u = np.empty(N + 1), np.empty((N, m))
        first = self._first
        q[0], v[0], p[0], energy[0] = first.q[0], first.v[0], first.p[0], first.energy[0]
        nodes = RolloutArrays(
            q=q[None, 1:],
            p=p[None, 1:],
            v=v[None, 1:],
            energy=energy[None, 1:],
            u=u[None],
            tally=np.zeros((1, N, 4), dtype=np.int64),
            quality=np.zeros((1, N, 3)),
            ended=np.zeros(1, dtype=np.int64),
            done=np.zeros(1, dtype=np.int64),
        )
        if problem.linear:
            return self._on_lines(commands, integrator, (q, v, p, energy), nodes)
        terms = problem.running.compiled
        values = np.empty((N * len(problem.rule), terms.count))
        watch = Watch(terms.core, problem.rule, q, v, u, values)
        watch.ask(self._weight, most, self._third, parts)
        state = integrator.fork(self._state)
        impulses = np.zeros((N, len(scene.constraint_order)))
        failure, halvings = integrator.watched(scene, state, commands, problem.dt, nodes, watch, impulses)
        return Attempt(self, (q, v, p, energy), u, nodes, halvings, values, impulses, failure, watch.verdict)

    def _on_lines(
        self,
        commands: Commands,
        integrator: Integrator,
        into: tuple[Floats, Floats, Floats, Floats],
        nodes: RolloutArrays,
    ) -> Attempt:
        """Integrate the motion under controls that are linear between nodes, without early stops."""
        scene = self.problem.scene
        (segment,) = integrator.rollout(scene, integrator.fork(self._state), commands, scene.silence, self.problem.dt)
        done, statistics = len(segment.u), segment.statistics
        for array, found in zip(into, (segment.q, segment.v, segment.p, segment.energy), strict=True):
            array[1 : done + 1] = found
        nodes.tally[0, :done] = np.stack(
            [statistics.newton_iterations, statistics.jets, statistics.sweeps, statistics.substeps], axis=1
        )
        nodes.quality[0, :done] = np.stack(
            [statistics.residual, statistics.branch_margin, statistics.energy_defect], axis=1
        )
        nodes.done[0] = done
        line = lines(commands, segment.u, self.problem.integrator.stage_times)
        line = line._replace(
            mean=with_ends(scene, line.mean, segment.u), stages=with_ends(scene, line.stages, segment.u)
        )
        impulses = np.zeros((done, 0)) if segment.impulses is None else segment.impulses
        return Attempt(
            self,
            into,
            segment.u,
            nodes,
            statistics.halvings,
            np.zeros((0, 0)),
            impulses,
            segment.failure,
            Watch.Verdict.going,
            line,
        )
