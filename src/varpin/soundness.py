"""What a finished motion says of itself: does its energy balance close, and is it the motion of the robot?

Both are asked of every integrator after the run, from its record and by taking parts of it again in smaller steps; what
the guards of a step let pass, and integrators without guards, are told of here. Whoever makes a motion that a user sees
calls :func:`examined`, and :func:`announce` for the log.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from varpin.chatter import RUN, Alternation, alternation
from varpin.errors import SingularMassMatrix
from varpin.integrators import ExplicitEuler, Integrator, Reference
from varpin.integrators.base import open_loop
from varpin.integrators.explicit import accelerations
from varpin.lagrangian import lagrangian_jet
from varpin.scene import Scene
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# What is spoken of: error of the energy balance, in units of the energy that was turned over; of a joint's position, in
# units of its way over a period, and of the way of the joint that goes furthest; of its velocity, in units of its
# largest one: velocities have peaks, which a small shift in time moves by much. All are half of what is wrong by
# :mod:`varpin.extremes`, for an estimate is good to about a factor of two.
ENERGY_BUDGET = 0.05
COARSE, COARSE_WAY, COARSE_VELOCITY = 0.05, 0.025, 0.125
# Steps taken again at the start, and at each other place looked at.
_FIRST, _WINDOW = 384, 64
# Later on, errors in units of what is spoken of at the start: by then a motion has gone further than from there.
_LATER = 0.5
# Other places looked at: where velocities change most, and as many spread over the motion.
_VIOLENT, _SPREAD = 4, 3
# And where single steps have most of the energy's error.
_JUMPS = 2
# Steps after which a start is judged by its way so far; before that a method of first order is behind by half a step.
_SOON = (80, 160)
# Windows that are taken again in steps of twice the length, beside those where velocities change most; and how many
# times the error of a window counts, for over a period it grows.
_WINDOWS, _MARGIN = 16, 4.0
# Nodes on either side of a place within which a joint's period is looked for.
_HORIZON = 1024
# A small disturbance that grows by this is the motion's own doing: from there on no single motion can be told.
_PREDICTABLE, _DISTURBANCE = 10.0, 1e-7
# What a joint does that moves this much less than others of its kind, and with this much less speed than would have
# their energy, is measured in these parts of theirs.
_LITTLE, _LIGHT = 1e-2, 1e-2
# Part of a joint's motion so far below which what it does at one place is rest.
_REST = 1e-3
# Part of a speed that counts as changed if nothing changes it: a wheel that turns evenly turns over next to nothing.
_EVEN = 1e-3
# Nodes at which mass matrices, and energies of single groups, are looked at; and rates of dampers.
_NODES, _INERTIAS = 16, 4
# Velocities below this count as none [rad/s or m/s]: what rounding leaves of a robot in equilibrium.
_STILL = 1e-9

# The kind of finding that says nothing against the motion as a solution of its equations, and how its sentence begins.
JOINT_LIMITS = "joints leave their limits"
# Beyond its limit by more than this a joint is spoken of [rad or m]; and so many of them with numbers.
_OUTSIDE, _NAMED = 1e-6, 6


@dataclass(frozen=True)
class Finding:
    """One thing to be said about a motion.

    Attributes:
        kind: What it is about, in a word or two.
        sentence: For the user, with numbers.
        joint: The coordinate that it names, if it is about one; the log has each kind once for a scene, a time step
            and a joint.
    """

    kind: str
    sentence: str
    joint: int | None = None


@dataclass(frozen=True)
class MotionError:
    """How far a motion is from that of smaller steps, at its worst over the joints and the places looked at.

    Attributes:
        step: Where the place begins.
        joint: Which coordinate.
        position: Error of q there over a period, in units of the joint's way over it.
        velocity: Error of v, in units of the joint's largest.
        motion: Error of q, in units of the way of the joint that goes furthest.
    """

    step: int
    joint: int
    position: float
    velocity: float
    motion: float

    @property
    def worst(self) -> float:
        """The larger error, in units of what is spoken of."""
        return max(self.position / COARSE, self.velocity / COARSE_VELOCITY, self.motion / COARSE_WAY)


def examined(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Trajectory, tuple[Finding, ...]]:
    """A motion with its energy balance, if the integrator keeps none, and its warnings; and what was found."""
    if not integrator.variational:
        own = replace(trajectory.statistics, energy_defect=energy_defects(scene, trajectory))
        trajectory = replace(trajectory, statistics=own)
    found = (
        *_looked_for(scene, integrator, trajectory),
        *alternating(scene, integrator, trajectory),
        *_beyond_limits(scene, trajectory),
    )
    return with_warnings(trajectory, found), found


def alternating(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Finding, ...]:
    """Says if velocities alternate from step to step with neither controls nor noise that make them.

    What smaller steps do as well is the robot's own, seen at about two nodes a period.
    """
    found = None if trajectory.dw.any() else alternation(trajectory.v, trajectory.u)
    if found is None or _does_so_in_smaller_steps(scene, integrator, trajectory, found):
        return ()
    sentence = (
        f"the velocity of {scene.robot.joint_names[found.joint]} alternates from step to step, {found.changes} times "
        f"in a row from t = {trajectory.t[found.first]:.4g} s on: dt = {trajectory.dt:g} s is too long for what is "
        "stiff, damped or fed back here"
    )
    return (Finding("alternating velocities", sentence, found.joint),)


def _does_so_in_smaller_steps(scene: Scene, integrator: Integrator, trajectory: Trajectory, found: Alternation) -> bool:
    """Whether a stretch of alternating velocities alternates alike when its first steps are halved."""
    place, count = found.first, RUN + 1
    parts = 2 * int(np.maximum(trajectory.statistics.substeps[place : place + count], 1).max())
    if isinstance(integrator, Reference) or count * parts > max(4 * _FIRST, int(trajectory.statistics.substeps.sum())):
        return False
    try:
        again = _taken_again(scene, integrator, trajectory, place, count, parts)
    except SingularMassMatrix:
        return False
    if again is None:
        return False
    own = np.diff(trajectory.v[place : place + count + 1, found.joint], n=2)
    return bool(np.abs(np.diff(again[1][:, found.joint], n=2) - own).sum() <= 0.5 * np.abs(own).sum())


def with_warnings(trajectory: Trajectory, found: Iterable[Finding]) -> Trajectory:
    """The motion with what was found as its warnings."""
    sentences = tuple(finding.sentence for finding in found)
    return replace(trajectory, warnings=sentences) if sentences else trajectory


def announce(logger: logging.Logger, scene: Scene, dt: float, found: Iterable[Finding]) -> None:
    """Log what was found, each kind once for this scene, time step and joint, whatever its numbers."""
    for finding in found:
        key = finding.kind, dt, finding.joint
        if key not in scene.announced:
            scene.announced.add(key)
            logger.warning(finding.sentence)


def evident(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Finding, ...]:
    """What may be wrong, from the record alone: dampers faster than the step, steps taken in parts, limits left.

    For whoever does not take steps again; :func:`examined` says what is wrong.
    """
    found = []
    rate = _fast_damping(scene, trajectory)
    # With more stages what dampers are faster than a step leaves is less.
    if not integrator.l_stable and trajectory.dt * rate > 2.0 * getattr(integrator, "stages", 1):
        found.append(Finding("fast damping", _ringing(rate, trajectory.dt)))
    if split := _in_parts(trajectory):
        found.append(Finding("split steps", f"{split}: dt = {trajectory.dt:g} s is coarse here"))
    return (*found, *_beyond_limits(scene, trajectory))


def _beyond_limits(scene: Scene, trajectory: Trajectory) -> tuple[Finding, ...]:
    """Says which joints leave their limits, which no motion is stopped by; the motion itself may be right."""
    lower, upper = scene.robot.position_limits
    # Limits that leave no room are a fault of the description, which inspect_robot tells of.
    sound = lower < upper
    with np.errstate(invalid="ignore"):
        excess = np.where(sound, np.maximum(lower - trajectory.q, trajectory.q - upper), -np.inf)
    most = excess.max(axis=0)
    joints = [int(c) for c in np.argsort(-most, kind="stable") if most[c] > _OUTSIDE]
    if not joints:
        return ()
    tree = scene.robot.tree
    slides = np.isin(np.arange(len(most)), tree.coordinate[tree.prismatic > 0])
    parts = []
    for c in joints[:_NAMED]:
        first, peak = int(np.argmax(excess[:, c] > _OUTSIDE)), int(np.argmax(excess[:, c]))
        since = "from the start" if first == 0 else f"from t = {trajectory.t[first]:.4g} s"
        unit, t = "m" if slides[c] else "rad", trajectory.t[peak]
        name, side = scene.robot.joint_names[c], "above" if trajectory.q[peak, c] > upper[c] else "below"
        limit = upper[c] if side == "above" else lower[c]
        parts.append(f"{name!r} {since}, at most {most[c]:.3g} {unit} {side} {limit:.4g} at t = {t:.4g} s")
    more = f"; and {len(joints) - _NAMED} more" if len(joints) > _NAMED else ""
    return (Finding(JOINT_LIMITS, f"{JOINT_LIMITS}, which nothing stops: {'; '.join(parts)}{more}"),)


def _in_parts(trajectory: Trajectory) -> str:
    """How many steps were taken in parts, in words; empty if none."""
    split = trajectory.statistics.split_steps
    if not split:
        return ""
    most = trajectory.statistics.substeps.max()
    return f"{split} of {trajectory.steps} steps were taken in up to {most} parts"


def _fast_damping(scene: Scene, trajectory: Trajectory) -> float:
    """The fastest rate of the dampers [1/s] if a step cannot resolve it, else 0."""
    if not scene.damping.any():
        return 0.0
    # Rates change along the motion as the inertia does.
    at = np.unique(np.linspace(0, trajectory.steps, _INERTIAS).astype(np.int64))
    rates = np.linalg.solve(_masses(scene, trajectory.q[at]), np.diag(scene.damping))
    # None of them is negative, and none larger than their sum.
    if trajectory.dt * np.trace(rates, axis1=1, axis2=2).max() <= 2.0:
        return 0.0
    fastest = float(np.abs(np.linalg.eigvals(rates)).max()) if np.isfinite(rates).all() else np.inf
    return fastest if trajectory.dt * fastest > 2.0 else 0.0


def _fast_pull(scene: Scene, trajectory: Trajectory) -> bool:
    """Whether springs or gravity turn a mode by more than a radian a step, at the first node or the last."""
    still = np.zeros(scene.robot.dof)
    for q in trajectory.q[[0, -1]]:
        _, _, _, Lqq, _, M = scene.core.jet(np.ascontiguousarray(q), still)
        turns = trajectory.dt**2 * np.linalg.solve(M, Lqq)
        # A matrix is no larger than its rows.
        if np.abs(turns).sum(axis=1).max() <= 1.0:
            continue
        if not np.isfinite(turns).all() or np.abs(np.linalg.eigvals(turns)).max() > 1.0:
            return True
    return False


def _ringing(rate: float, dt: float) -> str:
    return (
        f"damping is faster than the step (dt * {rate:.3g}/s = {dt * rate:.3g} > 2): velocities that it should stop "
        "will ring; "
        f"dt below {2.0 / rate:.3g} s resolves it, varpin.Radau(3) stops them"
    )


def _masses(scene: Scene, q: Floats) -> Floats:
    """M at some configurations (K, n, n)."""
    q = np.ascontiguousarray(q)
    return scene.core.jets(q, np.zeros_like(q))[0]


def _inertias(scene: Scene, q: Floats) -> Floats:
    """What each joint has to move, its entry on the diagonal of M, at most at some configurations: (n,) of (K, n)."""
    largest: Floats = np.diagonal(_masses(scene, q), axis1=1, axis2=2).max(axis=0)
    return largest


def _looked_for(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Finding, ...]:
    """What the balance of the energy and steps taken again tell."""
    if not trajectory.steps:
        return ()
    found = [*_energy(scene, integrator, trajectory)]
    if resolved(scene, integrator, trajectory):
        return tuple(found)
    error = motion_error(scene, integrator, trajectory)
    if error is not None and not error.worst <= 1.0:
        dt, start = trajectory.dt, trajectory.t[error.step]
        off = (
            f"smaller steps from t = {start:.4g} s on move joint {trajectory.joint_names[error.joint]!r} by "
            f"{100 * error.position:.3g}% of its way over a period, and its velocity by {100 * error.velocity:.3g}%"
        )
        rate = 0.0 if integrator.l_stable else _fast_damping(scene, trajectory)
        if rate:
            found.append(Finding("fast damping", f"{_ringing(rate, dt)}; {off}", error.joint))
        else:
            split = f" ({_in_parts(trajectory)})" if _in_parts(trajectory) else ""
            sentence = f"dt = {dt:g} s is coarse for {integrator} here: {off}{split}"
            found.append(Finding("coarse steps", sentence, error.joint))
    return tuple(found)


def _energy(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Finding, ...]:
    """Says if the energy is off, of the whole robot or of a group of joints that moves by itself."""
    worst: tuple[float, int, float, float] | None = None
    for at, defect, scale in _balances(scene, integrator, trajectory):
        # Dampers take what a coarse step leaves too much of: what is lost to them is no error of the motion.
        off = np.maximum(defect, 0.0) if scene.damping.any() else np.abs(defect)
        last = int(np.argmax(off))
        rounding = 1e-12 * float(np.abs(trajectory.energy).max())
        # Written such that what is not finite is spoken of.
        if not off[last] <= ENERGY_BUDGET * scale + rounding:
            share = float(off[last] / scale) if scale > 0.0 else np.inf
            if worst is None or not share <= worst[0]:
                worst = share, int(at[last]), float(off[last]), scale
    if worst is None:
        return ()
    share, node, energy, scale = worst
    part = f", {100 * share:.3g}% of what was turned over" if np.isfinite(share) else ""
    return (
        Finding(
            "energy",
            f"the energy is off by {energy:.3g} J at t = {trajectory.t[node]:.4g} s{part}: "
            f"dt = {trajectory.dt:g} s is too long for {integrator}",
        ),
    )


def _balances(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> list[tuple[Integers, Floats, float]]:
    """Nodes, what the energy is off by there [J], and the energy turned over [J]: of all joints, and of each group.

    Guards hold the balance of every group in each step of a variational integrator.
    """
    at = np.arange(1, trajectory.steps + 1)
    found = [(at, trajectory.statistics.energy_defect, energy_scale(scene, trajectory))]
    tree = scene.robot.tree
    if integrator.variational or tree.groups < 2 or scene.noise.diffusion is None:
        return found
    turned = _turned_over(scene, trajectory)
    work, _ = _works(scene, trajectory)
    worked = np.abs(np.cumsum(work, axis=0)).max(axis=0, initial=0.0)
    some = np.unique(np.linspace(1, trajectory.steps, _NODES).astype(np.int64))
    for group in range(tree.groups):
        own = tree.group == group
        scale = float(turned[own].sum() + worked[own].sum())
        found.append((some, _defects_of(scene, trajectory, own)[some], scale))
    return found


def _defects_of(scene: Scene, trajectory: Trajectory, own: NDArray[np.bool_]) -> Floats:
    """What the energy of some joints is off by (N + 1,) [J]; they move by themselves. Zero but at some nodes."""
    kicked, given = _kicks(scene, trajectory)
    work, heat = _works(scene, trajectory, kicked)
    gained = np.append(0.0, np.cumsum((work - heat + given)[:, own].sum(axis=1)))
    kinetic = 0.5 * (trajectory.p * trajectory.v)[:, own].sum(axis=1)
    off = np.zeros(trajectory.steps + 1)
    still, rest = np.zeros(scene.robot.dof), trajectory.q[0]
    first = lagrangian_jet(scene, rest, still).L
    for node in np.unique(np.linspace(1, trajectory.steps, _NODES).astype(np.int64)):
        potential = first - lagrangian_jet(scene, np.where(own, trajectory.q[node], rest), still).L
        off[node] = kinetic[node] - kinetic[0] + potential - gained[node]
    return off


def energy_scale(scene: Scene, trajectory: Trajectory) -> float:
    """The energy that a motion turns over [J]: the kinetic energy that its joints gain or lose, and the controls' work.

    What turns evenly all the time, however fast, turns nothing over.
    """
    kinetic = 0.5 * np.einsum("ki,ki->k", trajectory.p, trajectory.v)
    work, _ = _works(scene, trajectory)
    turned = min(float(kinetic.max()), float(_turned_over(scene, trajectory).sum()))
    return turned + float(np.abs(np.cumsum(work.sum(axis=1))).max(initial=0.0))


def _turned_over(scene: Scene, trajectory: Trajectory) -> Floats:
    """Of each joint, the kinetic energy of the largest change of its velocity (n,) [J], for all it has to move."""
    at = np.unique(np.linspace(0, trajectory.steps, _NODES).astype(np.int64))
    inertia = _inertias(scene, trajectory.q[at])
    with np.errstate(over="ignore", invalid="ignore"):
        turned: Floats = 0.5 * inertia * _changed(trajectory.v) ** 2
    return turned


def _changed(v: Floats) -> Floats:
    """By how much each joint's velocity changes over some nodes (n,), at most the largest; of v (K, n)."""
    fastest = np.abs(v).max(axis=0)
    changed: Floats = np.clip(np.ptp(v, axis=0), _EVEN * fastest, fastest)
    return changed


def energy_defects(scene: Scene, trajectory: Trajectory) -> Floats:
    """What the energy is off by after each step (N,) [J], of what no control, damper or kick accounts for.

    From the record alone, for integrators that keep no ledger of their own. For what dampers take, velocities are taken
    for linear over a step. Zeros with noise that only Python can evaluate.
    """
    if scene.noise.diffusion is None:
        return np.zeros(trajectory.steps)
    kicked, given = _kicks(scene, trajectory)
    work, heat = _works(scene, trajectory, kicked)
    given_in_all = np.cumsum((work - heat + given).sum(axis=1))
    gained: Floats = trajectory.energy[1:] - trajectory.energy[0] - given_in_all
    return np.nan_to_num(gained, nan=np.inf)


def _works(scene: Scene, trajectory: Trajectory, kicked: Floats | float = 0.0) -> tuple[Floats, Floats]:
    """Work of the controls, and the least that the dampers can take, at each joint in each step (N, n) [J].

    Controls are constant over a step, and do the work of its way. A kick of v (N, n) begins each step. Dampers take
    least where the velocity is even, and q knows its mean.
    """
    h, before, after = trajectory.dt, trajectory.v[:-1] + kicked, trajectory.v[1:]
    with np.errstate(over="ignore", invalid="ignore"):
        way = np.diff(trajectory.q, axis=0)
        work = (trajectory.u @ scene.actuation.T) * way
        even = (way / h) ** 2
        heat = h * np.minimum((before**2 + before * after + after**2) / 3.0, even) * scene.damping
    return work, heat


def _kicks(scene: Scene, trajectory: Trajectory) -> tuple[Floats | float, Floats | float]:
    """What each step's kick does to v and to the energy [J], at each joint (N, n), if it comes all at once before."""
    if not trajectory.dw.any():
        return 0.0, 0.0
    q, v = trajectory.q[:-1], trajectory.v[:-1]
    fields = scene.noise.fields(q, v, trajectory.u, trajectory.q[0]).F
    impulse = np.einsum("kij,kj->ki", fields, trajectory.dw)
    change = np.einsum("kij,kj->ki", accelerations(scene, q, v, np.zeros_like(q))[3], impulse)
    return change, impulse * (v + 0.5 * change)


def resolved(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> bool:
    """Whether even steps of twice the length make the same motion, so that there is nothing more to look for.

    Windows all over the motion, or some of them, are taken again from their first nodes, all at once. That takes half
    as long as the motion, or less; a motion of whole steps without noise or fast dampers can pass.
    """
    steps, n = trajectory.steps, scene.robot.dof
    # Windows of like lengths, which are even.
    pieces = min(-(-steps // _WINDOW), _WINDOWS)
    length = min(_WINDOW, 2 * -(-steps // (2 * pieces)), steps - steps % 2) if pieces else 0
    if isinstance(integrator, Reference) or not length or trajectory.dw.any() or scene.noise.diffusion is None:
        return False
    if not np.abs(trajectory.v).max() > _STILL:
        return True
    # Dampers and springs far faster than the step do as little in two.
    if (trajectory.statistics.substeps > 1).any() or _fast_damping(scene, trajectory) or _fast_pull(scene, trajectory):
        return False
    begins = np.unique(np.linspace(0, steps - length, max(pieces, 1 + steps % 2)).astype(np.int64))
    if pieces == _WINDOWS:
        begins = np.union1d(begins, _blows(trajectory.v, length))
    nodes = begins[:, None] + np.arange(length + 1)
    q, v, u = trajectory.q[nodes], trajectory.v[nodes], trajectory.u
    commands, drift = open_loop(u[:length:2]), np.zeros((0, 0, n))
    if np.ptp(u, axis=0).any():
        # Commands are the same for all paths; their forces need not be.
        force = u[nodes[:, :-1]].reshape(len(begins), length // 2, 2, -1).mean(axis=2) @ scene.actuation.T
        commands, drift = open_loop(np.zeros_like(u[:length:2])), np.ascontiguousarray(force)
    try:
        state, _ = integrator.start(scene, np.ascontiguousarray(q[:, 0]), np.ascontiguousarray(v[:, 0]))
    except SingularMassMatrix:
        return False
    again = integrator.rollout_compiled(scene, state, commands, scene.silence, drift, 2.0 * trajectory.dt)
    if any(len(part.q) < length // 2 for part in again):
        return False
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.array(
            [
                np.abs(np.array([part.q for part in again]) - q[:, 2::2]).max(axis=1),
                np.abs(np.array([part.v for part in again]) - v[:, 2::2]).max(axis=1),
            ]
        )
        way, speed = np.ptp(q, axis=1), np.abs(v).max(axis=1)
        root = np.sqrt(_inertias(scene, q[:, 0]))
        light = _LIGHT * (root * np.clip(np.ptp(v, axis=1), _EVEN * speed, speed)).max(axis=1)[:, None] / root
        for values, least in ((way, light * length * trajectory.dt), (speed, light)):
            for kind in (slides := _slides(scene), ~slides):
                others = _LITTLE * values[:, kind].max(axis=1, initial=0.0)
                values[:, kind] = np.maximum(values[:, kind], np.minimum(others[:, None], least[:, kind]))
        rounding = 1e3 * np.finfo(np.float64).eps * (1.0 + np.abs(q[:, 0]).max(axis=1))[:, None]
        off[0] = np.where(off[0] <= rounding, 0.0, off[0])
        allowed = np.array([COARSE_WAY * way, COARSE_VELOCITY * speed])
        return bool((_MARGIN * off <= (2.0**integrator.order - 1.0) * allowed).all())


def motion_error(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> MotionError | None:
    """The error of a motion, by taking parts of it again from their first nodes, in steps of half the length.

    The start, the places where velocities change most and some spread over the motion are looked at, over a period of
    each joint or what can be had of it. Each joint is judged in units of its own motion. It says nothing of how errors
    grow over many periods. None where nothing moves, and for an integrator that chooses its own steps.
    """
    moved = np.abs(trajectory.v).max(initial=0.0)
    if isinstance(integrator, Reference) or not trajectory.steps or not moved > _STILL:
        return None
    worst = None
    # Where a joint goes to and fro within the first steps, what comes after is to be looked at, too.
    first = _judged(*_periods(scene, trajectory.q[: _HORIZON + 1], trajectory.v[: _HORIZON + 1])).min()
    places = _places(trajectory.v, trajectory.statistics.energy_defect, min(_FIRST, int(first)))
    inertia = _inertias(scene, trajectory.q[places])
    # Half a step is as little as a whole one to dampers that are far faster.
    fast = trajectory.dt * _fast_damping(scene, trajectory)
    finer = int(2 ** np.clip(np.ceil(np.log2(max(1.0, fast))), 0, 3))
    for place in places:
        try:
            found = _error_at(scene, integrator, trajectory, int(place), inertia, finer)
        except SingularMassMatrix:
            continue
        if found is not None and (worst is None or not found.worst <= worst.worst):
            worst = found
    return worst


def _places(v: Floats, defect: Floats, first: int) -> Integers:
    """Where a motion is looked at: the first steps of its windows (K,); of v (N + 1, n) and of the energy defect (N,).

    One window has the ``first`` steps.
    """
    steps = len(v) - 1
    seen = np.zeros(steps, dtype=bool)
    seen[:first] = True
    found = [0, *_blows(v, _WINDOW, seen)]
    for place in np.linspace(0, max(0, steps - _WINDOW), _SPREAD + 1)[1:].astype(np.int64):
        if not seen[place : place + _WINDOW].all():
            found.append(int(place))
    # Single steps that are worse than others, as a whole one is among steps in parts.
    jumps = np.abs(np.diff(defect, prepend=0.0))
    found += np.argsort(-np.nan_to_num(jumps, nan=np.inf), kind="stable")[:_JUMPS].tolist()
    return np.unique(found)


def _blows(v: Floats, length: int, seen: NDArray[np.bool_] | None = None) -> list[int]:
    """The first steps of windows of some length about the largest changes of v (N + 1, n); they are marked as seen."""
    steps = len(v) - 1
    seen = np.zeros(steps, dtype=bool) if seen is None else seen
    change = np.abs(np.diff(v, axis=0))
    most = change.max(axis=0)
    # A joint's changes in units of its own largest.
    change = ((change / np.where(most > 0.0, most, np.inf)) ** 2).sum(axis=1)
    found: list[int] = []
    for _ in range(_VIOLENT):
        if seen.all():
            break
        peak = int(np.argmax(np.where(seen, -1.0, change)))
        found.append(min(max(0, peak - length // 4), max(0, steps - length)))
        seen[found[-1] : found[-1] + length] = True
    return found


def _error_at(
    scene: Scene, integrator: Integrator, trajectory: Trajectory, place: int, inertia: Floats, finer: int
) -> MotionError | None:
    """The error at one place; None where steps cannot be taken again."""
    ahead = slice(place, place + _HORIZON + 1)
    span, whole = _periods(scene, trajectory.q[ahead], trajectory.v[ahead])
    variation = np.abs(np.diff(trajectory.v[ahead], axis=0)).cumsum(axis=0)
    judged = _judged(span, whole)
    count, parts = _affordable(trajectory, place, int(judged.max()), finer)
    if not parts:
        return None
    again = _taken_again(scene, integrator, trajectory, place, count, parts)
    if again is None:
        return None
    recorded = trajectory.q[place : place + count + 1], trajectory.v[place : place + count + 1]
    if scene.noise.diffusion is None and trajectory.dw.any():
        # Kicks that only Python knows are left out of both.
        plain = _taken_again(scene, integrator, trajectory, place, count, parts // (2 * finer))
        if plain is None:
            return None
        recorded = plain
    # The part of the error that is left with the smaller steps.
    taken = np.maximum(trajectory.statistics.substeps[place : place + count], 1)
    left = float(parts) ** -integrator.order / np.mean(1.0 / taken.astype(float) ** integrator.order)

    def error(until: int) -> MotionError:
        here = np.minimum(judged, until)
        # What cannot be told any more is no part of the way.
        end = span if until == count else np.minimum(span, until)
        units = _units(scene, trajectory, place, end, whole | (end < span), inertia)
        joints = np.arange(len(span))
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            off = [
                np.maximum.accumulate(np.abs(a - b), axis=0)[here, joints] / (1.0 - left)
                for a, b in zip(recorded, again, strict=True)
            ]
            # Errors grow in the course of a period as the motion goes on.
            so_far = variation[here - 1, joints]
            growth = np.where(so_far > 0.0, variation[judged - 1, joints] / so_far, np.inf)
            growth = np.minimum(growth, judged / here)
            growth = np.where(until == count, np.maximum(growth, 1.0), 1.0)
            rounding = 1e3 * np.finfo(np.float64).eps * (1.0 + np.abs(trajectory.q[place]).max())
            position = np.where(off[0] <= rounding, 0.0, off[0] * growth / units[0])
            velocity = np.where(off[1] <= 1e-9 * units[1], 0.0, off[1] / units[1])
            motion = position * units[0] / units[0].max()
            errors = np.array([position, velocity, motion]) * (_LATER if place else 1.0)
            shares = errors / np.array([[COARSE], [COARSE_VELOCITY], [COARSE_WAY]])
        joint = int(np.argmax(np.nan_to_num(shares, nan=np.inf).max(axis=0)))
        return MotionError(place, joint, *errors[:, joint].tolist())

    known = _predictable(scene, integrator, trajectory, place, count)
    # What dies out soon is judged by the way that it takes, too.
    untils = [until for until in _SOON if until < known] if place == 0 else []
    return max((error(until) for until in (*untils, known)), key=lambda found: np.nan_to_num(found.worst, nan=np.inf))


def _periods(scene: Scene, q: Floats, v: Floats) -> tuple[Integers, NDArray[np.bool_]]:
    """Over how many steps each joint goes to and fro, or right round (n,), for q and v (K + 1, n).

    All of them where it does not, which the second value says. Where a joint turns back the way is as long as there and
    back, and the velocity small; one and a half ways to and fro, with all that the velocity does, are no such place.
    """
    gone = np.abs(np.diff(q, axis=0)).cumsum(axis=0)
    wide = (np.maximum.accumulate(q, axis=0) - np.minimum.accumulate(q, axis=0))[1:]
    varied = np.abs(np.diff(v, axis=0)).cumsum(axis=0)
    fastest = np.maximum.accumulate(np.abs(v), axis=0)[1:]
    round_once = ~_slides(scene) & (wide >= 2.0 * np.pi)
    over = ((gone >= 3.0 * wide) | round_once) & (varied >= 4.0 * fastest) & (wide > 0.0)
    whole = np.asarray(over.any(axis=0))
    span: Integers = np.where(whole, over.argmax(axis=0) + 1, len(q) - 1)
    return span, whole


def _judged(span: Integers, whole: NDArray[np.bool_]) -> Integers:
    """Over how many steps errors count (n,), of what :func:`_periods` gives: a period is two thirds of it."""
    judged: Integers = np.where(whole, (2 * span + 2) // 3, span)
    return judged


def _affordable(trajectory: Trajectory, place: int, span: int, finer: int) -> tuple[int, int]:
    """How many steps are taken again, each in how many parts; (0, 0) for none.

    These are half of what they were taken in, or that part of it again where dampers are faster.

    The work is at most that of some tens of steps, or an eighth of the motion's own.
    """
    length = _FIRST if place == 0 else _WINDOW
    substeps = np.maximum(trajectory.statistics.substeps, 1)
    most = max(4 * length, int(substeps.sum()) // 8)
    parts = 2 * finer * np.maximum.accumulate(substeps[place : place + min(length, span)])
    affordable = parts * np.arange(1, len(parts) + 1) <= most
    if not affordable[0]:
        return 0, 0
    count = len(parts) if affordable.all() else int(affordable.argmin())
    return count, int(parts[count - 1])


def _units(
    scene: Scene, trajectory: Trajectory, place: int, span: Integers, whole: NDArray[np.bool_], inertia: Floats
) -> tuple[Floats, Floats]:
    """In what each joint's errors of q and v are measured (n,): its way over a period, and its largest velocity.

    A joint that hardly moves and has little energy is measured by the others.
    """
    n = len(span)
    behind = slice(max(0, place - _HORIZON), place + 1)
    before = np.zeros(n, dtype=np.int64)
    if place:
        before = _periods(scene, trajectory.q[behind][::-1], trajectory.v[behind][::-1])[0]
    # Where the motion ends within a period, what came before completes it.
    begin = place - np.where(whole, 0, before)
    way, speed, change = np.empty(n), np.empty(n), np.empty(n)
    for i in range(n):
        nodes = slice(begin[i], place + span[i] + 1)
        way[i], speed[i] = np.ptp(trajectory.q[nodes, i]), np.abs(trajectory.v[nodes, i]).max()
        change[i] = _changed(trajectory.v[nodes, i : i + 1])[0]
        so_far = slice(0, place + span[i] + 1)
        way[i] = max(way[i], _REST * np.ptp(trajectory.q[so_far, i]))
        speed[i] = max(speed[i], _REST * np.abs(trajectory.v[so_far, i]).max())
    root = np.sqrt(inertia)
    light = _LIGHT * (root * change).max() / root
    least = np.minimum(_LITTLE * _of_its_kind(scene, speed), light)
    least_way = np.minimum(_LITTLE * _of_its_kind(scene, way), light * span * trajectory.dt)
    tiny = np.finfo(np.float64).tiny
    return np.maximum(way, np.maximum(least_way, tiny)), np.maximum(speed, np.maximum(least, tiny))


def _predictable(scene: Scene, integrator: Integrator, trajectory: Trajectory, place: int, count: int) -> int:
    """Steps, one at least, until a small disturbance of q has grown out of hand."""
    nodes = trajectory.q[place : place + count + 1]
    moved = _DISTURBANCE * max(1.0, float(np.abs(trajectory.q[place]).max()))
    # In v, by what the same part of the motion has.
    way = max(float(np.ptp(nodes, axis=0).max()), moved)
    faster = _DISTURBANCE * float(np.abs(trajectory.v[place : place + count + 1]).max()) / max(1.0, way)
    other = _taken_again(scene, integrator, trajectory, place, count, 1, (moved, faster))
    if other is None:
        return 1
    with np.errstate(over="ignore", invalid="ignore"):
        grown = ~(np.abs(other[0] - nodes).max(axis=1) <= _PREDICTABLE * moved)
    return max(1, int(grown.argmax())) if grown.any() else count


def _slides(scene: Scene) -> NDArray[np.bool_]:
    """Which coordinates slide (n,)."""
    tree = scene.robot.tree
    slides = np.zeros(scene.robot.dof, dtype=bool)
    slides[tree.coordinate[tree.prismatic > 0]] = True
    return slides


def _of_its_kind(scene: Scene, values: Floats) -> Floats:
    """For each coordinate (n,), the largest value of all that turn, or of all that slide: units do not compare."""
    slides = _slides(scene)
    largest: Floats = np.where(slides, values[slides].max(initial=0.0), values[~slides].max(initial=0.0))
    return largest


def _taken_again(
    scene: Scene,
    integrator: Integrator,
    trajectory: Trajectory,
    place: int,
    count: int,
    parts: int,
    moved: tuple[float, float] = (0.0, 0.0),
) -> tuple[Floats, Floats] | None:
    """``count`` steps from a node on, q and v of their nodes (count + 1, n); each in parts, under the same forces.

    NaN from where they fail; None if the first does. ``moved`` is added to q and v at first.
    """
    steps = slice(place, place + count)
    q, v = trajectory.q[place][None] + moved[0], trajectory.v[place][None] + moved[1]
    drawn = scene.silence
    if trajectory.dw.any() and scene.noise.diffusion is not None:
        drawn = np.zeros((1, count * parts, trajectory.dw.shape[1]))
        if isinstance(integrator, ExplicitEuler):
            # Its kicks come after the step.
            drawn[0, parts - 1 :: parts] = trajectory.dw[steps]
        else:
            drawn[0, ::parts] += integrator.left * trajectory.dw[steps]
            drawn[0, parts - 1 :: parts] += (1.0 - integrator.left) * trajectory.dw[steps]
    state, _ = integrator.start(scene, q, v)
    # Impulses of noise depend on the controls, too.
    commands = open_loop(np.repeat(trajectory.u[steps], parts, axis=0))
    no_drift = np.zeros((0, 0, scene.robot.dof))
    (segment,) = integrator.rollout_compiled(scene, state, commands, drawn, no_drift, trajectory.dt / parts)
    done = len(segment.q) // parts
    if not done:
        return None
    nodes = np.full((2, count + 1, q.shape[1]), np.nan)
    for row, start, values in zip(nodes, (q, v), (segment.q, segment.v), strict=True):
        row[0], row[1 : done + 1] = start[0], values[parts - 1 :: parts][:done]
    return nodes[0], nodes[1]
