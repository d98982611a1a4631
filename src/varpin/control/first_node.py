"""Constraints that no control meets at the first node after the start."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy

from varpin.arrays import Floats, Mask
from varpin.control.between_nodes import at_times
from varpin.control.constraints import BoundConstraint, BoundRate
from varpin.control.multipliers import REPORTED
from varpin.control.problem import OptimalControlProblem
from varpin.linearization import node_jets
from varpin.mechanics.forces import limited_servos
from varpin.mechanics.scene import quiet
from varpin.signals.commands import open_line, open_loop
from varpin.simulation.record import rollout
from varpin.trajectory import Trajectory

# Starts of the search for controls that meet the constraints: besides the motion's own and both limits, random ones.
_RANDOM = 4
# Greatest number of linear programs from each of them, lengths of their steps, and least decrease relative to a value.
_STEPS, _LENGTHS, _LITTLE = 8, (1.0, 0.5, 0.25, 0.1), 1e-4
# Share of the largest row, in scales, from which on another constraint's counts as well as it.
_TIED = 0.99
# Differences of controls, in ranges.
_DIFFERENCE = 1e-3
# Change of velocities [rad/s or m/s] by controls without limits, and the change of a row, relative to its constraint's
# scale, that shows that they reach it.
_SHIFT, _REACHED = 1.0, 1e-9


def out_of_reach(problem: OptimalControlProblem, motion: Trajectory) -> str:
    """Which constraint no control meets at the first node after the start, in words; empty if there is none.

    Rows that controls without limits reach can be met; those of the others are minimized within the limits of controls
    and of their rates, in one step of the motion. Margins for noise are left out. A constraint counts where a row stays
    violated by more than a thousandth of its range.

    Args:
        problem: The problem.
        motion: Any motion on the problem's grid, for controls to begin with.
    """
    bound = [item for item in problem.bound_constraints if _begins_after_start(item)]
    if not bound or limited_servos(problem.scene.elements):
        # A drive at its limit shows nothing of what other commands do.
        return ""
    step = _FirstStep(problem, bound)
    lower, upper = step.limits()
    if not (lower <= upper).all():
        return ""
    begin = np.clip(step.decided(motion), lower, upper)
    known = step.values(begin)
    if not known.max() > REPORTED:
        return ""
    always = "whatever the controls within their limits: begin inside, or widen the bound"
    for i, item in enumerate(bound):
        own = step.of == i
        least = step.least(begin, lower, upper, own) if known[own].max() > REPORTED else None
        if least is not None:
            return f"{problem.label_of(item.source)} cannot be met from here: {_told(item, least[own])}, {always}"
    whole = step.of >= 0
    least = step.least(begin, lower, upper, whole) if len(bound) > 1 else None
    if least is None:
        return ""
    together = np.unique(step.of[least >= _TIED * least.max()])
    labels = [problem.label_of(bound[i].source) for i in together]
    words = [_told(bound[i], least[step.of == i]) for i in together]
    return f"{' and '.join(labels)} cannot be met from here together: {' while '.join(words)}, {always}"


def _told(item: BoundConstraint, values: Floats) -> str:
    """The largest of a constraint's rows at its first node, in its scales, in words."""
    row, excess = item.rows[int(values.argmax())], values.max() * item.scale
    return f"{row} at the first node, t = {item.times[0]:.4g} s, stays violated by {excess:.3g} {item.unit}"


def _begins_after_start(item: BoundConstraint) -> bool:
    """Whether a constraint is an inequality of states that holds from the first node after the start on."""
    return not (item.of_controls or item.source.equality) and int(item.places[0]) == 1


class _FirstStep:
    """The values of constraints after the first step as a function of its controls, one after another (c,)."""

    def __init__(self, problem: OptimalControlProblem, bound: list[BoundConstraint]) -> None:
        self.problem, self.bound, self.scene = problem, bound, quiet(problem.scene)
        # Of which constraint each row is.
        self.of = np.repeat(np.arange(len(bound)), [len(item.rows) for item in bound])
        self.ends = 2 if problem.linear else 1

    def decided(self, motion: Trajectory) -> Floats:
        """The controls of a motion's first step."""
        found: Floats = self.problem.decided(motion)[: self.ends].ravel()
        return found

    def limits(self) -> tuple[Floats, Floats]:
        """Least and greatest controls: by their limits, by a given first one, and by limits of the rate from there."""
        problem = self.problem
        lower, upper = (np.tile(side, (self.ends, 1)) for side in problem.control_limits)
        begin = problem.begin
        if begin is not None:
            given = ~np.isnan(begin)
            lower[0, given] = upper[0, given] = begin[given]
        for item in problem.bound_constraints:
            if isinstance(item, BoundRate) and item.before is not None:
                before = item.before if begin is None else np.where(np.isnan(begin), item.before, begin)
                most = item.limit * item.period
                lower[-1] = np.maximum(lower[-1], before - most)
                upper[-1] = np.minimum(upper[-1], before + most)
        return lower.ravel(), upper.ravel()

    def values(self, u: Floats) -> Floats:
        """All rows, in scales of their constraints; NaN where the step fails."""
        problem, controls = self.problem, u.reshape(self.ends, -1)
        line = problem.linear
        commands = open_line(controls, problem.integrator.stage_times) if line else open_loop(controls)
        motion, failure = rollout(self.scene, problem.integrator, problem.q0, problem.v0, commands, problem.dt)
        if failure is not None:
            return np.full(len(self.of), np.nan)
        found = [
            at_times(problem, item.source, item.times[:1]).value(motion.q, motion.v, controls)[0] / item.scale
            for item in self.bound
        ]
        return np.concatenate(found)

    def least(self, begin: Floats, lower: Floats, upper: Floats, chosen: Mask) -> Floats | None:
        """All rows where the largest of the ``chosen`` ones that stay is least, others -inf; None where it is little.

        Rows that controls without limits reach can be met, and are left out.
        """
        known, rng = self.values(begin), np.random.default_rng(0)
        endless = ~(np.isfinite(lower) & np.isfinite(upper))
        stays = chosen & np.isfinite(known)
        if endless.any():
            for shift in self._shifts(endless, rng):
                # Where the step fails, nothing is known.
                stays &= np.abs(self.values(np.clip(begin + shift, lower, upper)) - known) <= _REACHED
        if not (stays.any() and known[stays].max() > REPORTED):
            return None
        free = ~endless & (lower < upper)
        low, high = lower[free], upper[free]

        def rows(part: Floats) -> Floats:
            u = begin.copy()
            u[free] = part
            return self.values(u)[stays]

        best = known[stays]
        for start in (begin[free], low, high, *rng.uniform(low, high, (_RANDOM, len(low)))) if free.any() else ():
            after = _least_maximum(rows, start, low, high)
            if after.max() < best.max():
                best = after
            if not best.max() > REPORTED:
                return None
        found = np.full(len(known), -np.inf)
        found[stays] = best
        return found

    def _shifts(self, endless: Mask, rng: np.random.Generator) -> Floats:
        """Changes (2, c) of controls without limits that change the fastest joint's velocity by _SHIFT."""
        problem, scene = self.problem, self.scene
        M, _ = node_jets(scene, problem.q0[None], problem.v0[None])
        speeds = np.abs(problem.dt * np.linalg.solve(M[0], scene.actuation)).max(axis=0)
        size = _SHIFT / np.where(speeds > 0.0, speeds, 1.0)
        size[scene.prescribed] = _SHIFT * problem.dt
        drawn: Floats = np.tile(size, self.ends) * endless * rng.uniform(0.5, 1.0, (2, len(endless)))
        return drawn


def _least_maximum(f: Callable[[Floats], Floats], x: Floats, low: Floats, high: Floats) -> Floats:
    """The f (a,) of least maximum near ``x`` (k,) within limits, by linear programs for its linearization."""
    size, c = high - low, f(x)
    for _ in range(_STEPS):
        # Differences go inwards.
        shifts = np.where(x - low > 0.5 * size, -_DIFFERENCE, _DIFFERENCE)
        J = np.stack([f(x + s * size[i] * np.eye(len(x))[i]) - c for i, s in enumerate(shifts)], axis=1) / shifts
        if not np.isfinite(J).all():
            # The step fails under these controls.
            break
        # In ranges of the controls, and the maximum.
        found = scipy.optimize.linprog(
            np.append(np.zeros(len(x)), 1.0),
            A_ub=np.hstack([J, -np.ones((len(c), 1))]),
            b_ub=J @ (x / size) - c,
            bounds=[*zip(low / size, high / size, strict=True), (None, None)],
        )
        if found.x is None:
            break
        ahead = found.x[:-1] * size - x
        for length in _LENGTHS:
            after = f(np.clip(x + length * ahead, low, high))
            if after.max() < c.max() - _LITTLE * abs(c.max()):
                x, c = np.clip(x + length * ahead, low, high), after
                break
        else:
            break
    return c
