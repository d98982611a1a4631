"""Errors of single steps that add up or grow over a whole motion.

Where disturbances grow a thousandfold, steps that are right to five digits make a motion that is right to two. A step
in which a force has a kink has a far larger error than its neighbours. Repeated steps give the error of a step, and the
fastest modes of the linearized motion bound its growth. Only where the product is large, the whole motion is repeated
by a method of more stages, in smaller steps at kinks.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats, Integers
from varpin.core.arrays import Commands
from varpin.errors import LinearizationError
from varpin.integrators import Gauss, Integrator, Radau, Reference
from varpin.integrators.base import open_loop
from varpin.integrators.collocation import MOST_STAGES
from varpin.integrators.within import Times
from varpin.mechanics.scene import Scene
from varpin.simulation.accuracy import ROUNDING, travel_scales
from varpin.simulation.kinks import kinks
from varpin.simulation.modes import first_order, linearized, of_inputs, rate_bounds
from varpin.simulation.record import Motions
from varpin.simulation.retaking import Finer, finer, impulses_of_parts, noise_left_out, shortest_parts, taken_again
from varpin.trajectory import Trajectory

# First words of the warning, where errors grow and where they only add up.
WORDS, ADDED = "disturbances grow here", "errors of steps add up here"

# Number of repeated steps; fewest steps and most joints of an examined motion.
_NODES, FEWEST, JOINTS = 6, 8, 60
# Number of further steps: those with the largest changes of velocity, such as jumps of controls.
_VIOLENT = 4
# Most steps with a kink that are repeated one by one, and their parts; also the parts of all of them in a repetition of
# the whole motion.
_KINKS, _PARTS = 12, 8
# Thresholds of the warning, as shares of the largest joint travel, where errors grow and where kinks make them; and the
# part of them from which a motion is repeated.
WARNED, _KINKED, NEAR = 0.01, 0.003, 0.6
# Errors at the end that are larger than this multiple of the sum of all steps' errors have grown.
_AMPLIFIED = 2.0
# A joint travel below this counts as no motion [rad or m].
_SHORTEST = 1e-8
# The share of the fastest mode's exponent by which a disturbance grows: at most half in 60 motions of arms and chains,
# because modes turn. The exponent is the integral of the rate, which is unsteady: of the nodes the mean counts. And the
# largest exponent that is computed.
ALIGNED, _MOST = 0.5, 60.0


class Growth(NamedTuple):
    """The error of a motion in which the errors of steps have grown.

    Attributes:
        joint: The coordinate with the largest error.
        off: The error [rad or m].
        share: The error as a share of the joint's scale, see :func:`travel_scales`.
        time: When the error reaches the threshold of the warning [s].
        step: The largest error of a single step [rad or m].
        causes: What happens in steps with a kink, in words, if most of the error comes from them; else empty.
        kinks: Number of steps with a kink.
        grows: Whether errors have grown; else they have added up.
    """

    joint: int
    off: float
    share: float
    time: float
    step: float
    causes: tuple[str, ...] = ()
    kinks: int = 0
    grows: bool = True


def growth_bound(scene: Scene, trajectory: Trajectory) -> float:
    """An estimate of the largest factor by which a disturbance grows over a motion.

    It comes from the fastest mode at two nodes; more would take longer than many a motion. It is 1 where
    :func:`grown_error` is None for every motion, and infinite where the linearization fails.
    """
    if _unknown(scene, trajectory) or _few(trajectory):
        return 1.0
    try:
        slopes = _slopes(scene, trajectory, np.array([trajectory.steps // 3, 2 * trajectory.steps // 3]))
    except LinearizationError:
        return np.inf
    if not slopes[0].shape[1]:
        return 1.0
    return _factor(float(_modes(*slopes).max()), trajectory)


def grown_error(
    scene: Scene, integrator: Integrator, trajectory: Trajectory, *, predictable: bool = False
) -> Growth | None:
    """The error of a motion after errors of its steps have added up or grown; None below the threshold of the warning.

    If the motion is known to be ``predictable`` apart from kinks, only steps with kinks are examined. All steps are
    repeated with the noise of the motion. Also None with forces or noise in Python, and for an integrator that chooses
    its own steps.
    """
    if isinstance(integrator, Reference) or _unknown(scene, trajectory):
        return None
    kinked = kinks(scene, trajectory)
    even = not (predictable or _few(trajectory) or len(kinked.steps) == trajectory.steps)
    if not (even or len(kinked.steps)):
        return None
    other = finer(integrator, trajectory, damped=False, pulled=False)
    travel = _travel(scene, trajectory)
    at = _nodes(trajectory)
    by_steps, by_kinks, largest = 0.0, 0.0, 0.0
    if even:
        # A few violent steps may have larger errors than all others together. Steps with kinks are counted below.
        change = np.abs(np.diff(trajectory.v, axis=0)).max(axis=1)
        change[kinked.steps] = -1.0
        spread = np.setdiff1d(at, kinked.steps)
        violent = change.argsort()[-_VIOLENT:]
        violent = violent[change[violent] >= 0.0]
        off = _steps_off(scene, integrator, trajectory, other, np.append(spread, violent), 1)
        if off is None:
            return None
        shares = ((off[0] + off[1] * trajectory.dt) / travel).max(axis=1)
        usual, rare = shares[: len(spread)], shares[len(spread) :]
        by_steps = max(trajectory.steps * float(usual.max(initial=0.0)), float(rare.sum()))
        largest = float(off[0].max(initial=0.0))
    if len(kinked.steps):
        chosen = kinked.steps[np.unique(np.linspace(0, len(kinked.steps) - 1, _KINKS).astype(np.int64))]
        off = _steps_off(scene, integrator, trajectory, other, chosen, _PARTS)
        if off is None:
            return None
        # Errors of velocities may last to the end.
        left = trajectory.dt * (trajectory.steps - chosen)[:, None]
        by_kinks = len(kinked.steps) * float(((off[0] + off[1] * left) / travel).max(axis=1).mean())
        largest = max(largest, float(off[0].max()))
    # Errors of kinks grow, too.
    small = NEAR * WARNED / max(by_steps + by_kinks, 1e-300)
    add_up = by_kinks > NEAR * _KINKED
    if not add_up and (_few(trajectory) or _grows_less(scene, trajectory, at, small)):
        return None
    mostly_kinks = by_kinks > by_steps
    least = _KINKED if mostly_kinks else WARNED
    for closer in (other, _closer(other)):
        found = _whole_off(scene, trajectory, closer, integrator.stage_times, kinked.steps)
        if found is None:
            return None
        apart = found
        shares = apart / travel
        joint = int(shares.max(axis=0).argmax())
        share = float(shares[:, joint].max())
        grows = share > _AMPLIFIED * (by_steps + by_kinks)
        # Where errors grow, so do those of the repetition: near the threshold a still better one decides.
        if not (grows and NEAR * least < share <= least):
            break
    if share <= least:
        return None
    first = float(trajectory.t[(shares[:, joint] > least).argmax()])
    causes = kinked.causes if mostly_kinks else ()
    return Growth(joint, float(apart[:, joint].max()), share, first, largest, causes, len(kinked.steps), grows)


def better(integrator: Integrator, trajectory: Trajectory) -> Finer:
    """A method of far more stages than a motion's, for :func:`whole_error`."""
    return _closer(finer(integrator, trajectory, damped=False, pulled=False))


def whole_error(scene: Scene, trajectory: Trajectory, other: Finer, times: Times) -> tuple[int, float, float] | None:
    """The largest error of a motion by repeating all of it: its coordinate, the error [rad or m], and its share.

    The share is that of the joint's scale, see :func:`travel_scales`. ``times`` are those of the motion's controls at
    stages. None where the motion cannot be repeated, as under noise in Python.
    """
    if noise_left_out(scene, other.method, trajectory):
        return None
    apart = _whole_off(scene, trajectory, other, times, kinks(scene, trajectory).steps)
    if apart is None:
        return None
    most = apart.max(axis=0)
    shares = most / _travel(scene, trajectory)
    joint = int(shares.argmax())
    return joint, float(most[joint]), float(shares[joint])


def corrected(scene: Scene, integrator: Integrator, trajectory: Trajectory, commands: Commands) -> bool:
    """Whether feedback corrects the errors of a motion's steps, so that they neither add up nor grow.

    The motion is integrated again by a method of far more stages under the same ``commands``, whose feedback acts on
    its own state, and the same noise; the two then agree. False where that is not known.
    """
    other = better(integrator, trajectory)
    method, linear = other.method, len(commands.stage_times) > 0
    if other.parts > 1 or linear or method.variational != integrator.variational or _in_python(scene, trajectory):
        return False
    drawn = trajectory.dw if trajectory.dw.any() else None
    again, failure = Motions(scene, method, trajectory.q[0], trajectory.v[0], trajectory.dt).under(
        commands, increments=drawn
    )
    if failure is not None or again.steps != trajectory.steps:
        return False
    return bool((np.abs(again.q - trajectory.q) <= WARNED * _travel(scene, trajectory)).all())


def _whole_off(scene: Scene, trajectory: Trajectory, other: Finer, times: Times, kinked: Integers) -> Floats | None:
    """Errors of q at all nodes (N + 1, n), with ``kinked`` steps in more parts; None if the first step fails."""
    parts = other.parts * shortest_parts(trajectory)
    parts[kinked] = np.maximum(parts[kinked], _PARTS)
    again = taken_again(scene, other.method, trajectory, times, 0, trajectory.steps, parts)
    # Unknown from where a step of the repetition fails.
    return None if again is None else np.nan_to_num(np.abs(again[0] - trajectory.q)) / (1.0 - other.left)


def _travel(scene: Scene, trajectory: Trajectory) -> Floats:
    """Scales of errors (n,), see :func:`travel_scales`: rounding alone is no motion."""
    rounding = ROUNDING * (1.0 + float(np.abs(trajectory.q).max()))
    return np.maximum(travel_scales(scene, trajectory.q), max(_SHORTEST, rounding))


def _closer(other: Finer) -> Finer:
    """A method with two stages more than another, or in half its steps."""
    method = other.method
    if not isinstance(method, Gauss | Radau) or method.stages + 2 > MOST_STAGES:
        return Finer(method, 2 * other.parts, 0.5 * other.left)
    return Finer(replace(method, stages=method.stages + 2), other.parts, 0.0)


def _steps_off(
    scene: Scene, integrator: Integrator, trajectory: Trajectory, other: Finer, at: Integers, parts: int
) -> tuple[Floats, Floats] | None:
    """The errors of q and v (K, n) after single steps, by a better method in some parts; None where it fails."""
    q, v = trajectory.q, trajectory.v
    if scene.inputs:
        again = [taken_again(scene, other.method, trajectory, integrator.stage_times, int(k), 1, parts) for k in at]
        ends = [(each[0][1], each[1][1]) for each in again if each is not None]
        if len(ends) < len(at):
            return None
        after_q, after_v = np.array([q for q, _ in ends]), np.array([v for _, v in ends])
    else:
        # The mean control of the step stands for controls that change within it.
        forces, kicks, parts = trajectory.u[at] @ scene.actuation.T, None, parts * other.parts
        if trajectory.dw.any():
            kicks = impulses_of_parts(scene, integrator, trajectory, at, parts)
        held = np.repeat(forces[:, None], parts, axis=1)
        nothing = open_loop(np.zeros((parts, scene.controls)))
        once = other.method.motions(scene, q[at], v[at], nothing, held, trajectory.dt / parts, kicks)
        if once is None:
            return None
        after_q, after_v = once[0][:, -1], once[1][:, -1]
    # With impulses, Euler's own method in halves is the better one.
    share = 1.0 - other.left
    return np.abs(after_q - q[at + 1]) / share, np.abs(after_v - v[at + 1]) / share


def _grows_less(scene: Scene, trajectory: Trajectory, at: NDArray[np.int64], factor: float) -> bool:
    """Whether disturbances grow by less than a factor over a motion, or by how much is unknown."""
    if factor > np.exp(_MOST):
        return True
    try:
        aq, av = _slopes(scene, trajectory, at)
    except LinearizationError:
        return True
    if not aq.shape[1]:
        return True
    if factor > _factor(float(rate_bounds(aq, av).mean()), trajectory):
        return True
    # Eigenvalues take longer than all else: at half of the nodes.
    typical = float(_modes(aq[::2], av[::2]).mean())
    if scene.constraints:
        # Loops pass configurations with much faster modes than elsewhere.
        typical = max(typical, float(np.maximum(_modes(aq, av), 0.0).mean()))
    return factor > _factor(typical, trajectory)


def _unknown(scene: Scene, trajectory: Trajectory) -> bool:
    """Whether errors of steps are unknown: with noise or forces in Python, or for many joints."""
    unknown = scene.custom is not None or _in_python(scene, trajectory) or not trajectory.steps
    return unknown or scene.robot.dof > JOINTS


def _in_python(scene: Scene, trajectory: Trajectory) -> bool:
    """Whether a motion has noise that only Python can evaluate."""
    return scene.noise.diffusion is None and bool(trajectory.dw.any())


def _few(trajectory: Trajectory) -> bool:
    """Whether a motion has too few steps, parts of divided ones included, for disturbances to grow."""
    return int(np.maximum(trajectory.statistics.substeps, 1).sum()) < FEWEST


def _nodes(trajectory: Trajectory) -> NDArray[np.int64]:
    """Nodes of the motion at which it is linearized."""
    return np.linspace(0, trajectory.steps - 1, _NODES + 2).astype(np.int64)[1:-1]


def _slopes(scene: Scene, trajectory: Trajectory, at: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Derivatives of the accelerations in q and in v (K, n, n), under constraints on the tangent space (K, f, f).

    Raises:
        LinearizationError: There are none.
    """
    forces = np.ascontiguousarray(trajectory.u[at] @ scene.actuation.T)
    given = trajectory.q[at], trajectory.v[at], forces
    found = linearized(scene, *given, of_inputs(scene, trajectory, at))
    return found.aq, found.av


def _modes(aq: Floats, av: Floats) -> Floats:
    """The rate at which the fastest mode of the linearized accelerations grows at each node (K,) [1/s]."""
    rates: Floats = np.linalg.eigvals(first_order(aq, av)).real.max(axis=1)
    return rates


def _factor(rate: float, trajectory: Trajectory) -> float:
    """The factor by which a disturbance grows over a motion whose fastest mode has this rate [1/s]."""
    length = float(trajectory.t[-1] - trajectory.t[0])
    return float(np.exp(min(ALIGNED * rate * length, _MOST)))
