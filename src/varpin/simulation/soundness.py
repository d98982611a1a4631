"""What a finished motion says of itself: does its energy balance close, and is it the motion of the robot?

Both are asked of every integrator after the run, from its record and by taking parts of it again in smaller steps; what
the guards of a step let pass, and integrators without guards, are told of here. Whoever makes a motion that a user sees
calls :func:`examined`, and :func:`announce` for the log.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from varpin.core import energy_turnover, glance, windows_agree
from varpin.integrators import ExplicitEuler, Integrator, Reference
from varpin.integrators.base import open_loop
from varpin.integrators.explicit import accelerations
from varpin.integrators.within import changing, in_pairs, in_parts, shares
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.noise import impulses
from varpin.mechanics.scene import Scene
from varpin.simulation.accuracy import (
    EVEN,
    FIRST,
    LIGHT,
    LITTLE,
    WINDOW,
    WRONG_ENERGY,
    WRONG_MOTION,
    WRONG_VELOCITY,
    MotionError,
    Window,
    between,
    blows,
    disturbance,
    examined_nodes,
    grown,
    inertias,
)
from varpin.simulation.chatter import RUN, Alternation, alternation
from varpin.simulation.damping import Fast, fast_damping
from varpin.simulation.friction import Stop, rate_at_stops, stops
from varpin.simulation.growth import NEAR, SAID, grown_error, growth_bound
from varpin.simulation.growth import WARNED as GROWTH_WARNED
from varpin.simulation.limits import left as limits_left
from varpin.simulation.phase import SHOWS as PHASE_SHOWS
from varpin.simulation.phase import phase_lost
from varpin.simulation.retaking import Again, Finer, finer, stopping, taken_again
from varpin.simulation.saturation import bent
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# What is spoken of, as part of what is wrong: estimates are made good to some percent.
CAUTION = 0.95
# Estimates from fewer steps than a period has are spoken of from this part of what is wrong on.
_UNSETTLED = 0.7
# An error below which nothing more is asked of a window, and from which on more places are looked at, in units of what
# is wrong: from others than those looked at first it may be three times as large.
_SMALL, _NEAR = 0.2, 0.35
# How far off a motion is of which no more is needed, in units of its way. Ways that are none [rad or m].
_FAR, _SHORTEST = 0.3, 1e-8
# Places so near to each other, and within an eighth of a period, are one.
_NEAR_BY = 4
# Steps taken for all places at most: so many times the motion's own, parts counted, and so many.
WORK, LEAST_WORK = 50, 256
# Windows that are taken again in steps of twice the length, beside those where velocities change most; and how many
# times the error of a window counts, for over a period it grows.
_WINDOWS, _MARGIN = 16, 8.0
# The least steps of a window that another method takes; and how many times errors of velocities count after jumps.
_SHORT, _PASSING = 8, 1.25
# How many times the error of a window counts for each window that the whole motion is long.
_ADDS = 4.0
# Stages of what they are taken again with where dampers are faster than the step.
_STOPPING = 3
# Steps from where a joint comes to rest that are taken again with it, and in how many parts each; in more if it fails.
_SETTLING, _SETTLED = 6, (2, 16)
# What the velocity may be off by there: over several steps in widths of the friction; in one, of the largest velocity.
_RUBS, _FELT = 0.1, 1e-3
# Nodes at which mass matrices, and energies of single groups, are looked at.
_NODES = 16
# The window of a motion that has one.
_FROM_START = np.zeros(1, dtype=np.int64)
# Velocities below this count as none [rad/s or m/s]: what rounding leaves of a robot in equilibrium.
_STILL = 1e-9


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


def examined(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Trajectory, tuple[Finding, ...]]:
    """A motion with its energy balance, if the integrator keeps none, and its warnings; and what was found."""
    if not integrator.variational:
        defects = energy_defects(scene, integrator, trajectory)
        defects.setflags(write=False)
        trajectory = trajectory.changed(statistics=trajectory.statistics.changed(energy_defect=defects))
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
    seen = found.sentence(scene.robot.joint_names, trajectory.t)
    sentence = f"{seen}: dt = {trajectory.dt:g} s is too long for what is stiff, damped or fed back here"
    return (Finding("alternating velocities", sentence, found.joint),)


def _does_so_in_smaller_steps(scene: Scene, integrator: Integrator, trajectory: Trajectory, found: Alternation) -> bool:
    """Whether a stretch of alternating velocities alternates alike when its first steps are halved."""
    first, count = found.first, RUN + 1
    parts = 2 * int(np.maximum(trajectory.statistics.substeps[first : first + count], 1).max())
    if isinstance(integrator, Reference) or count * parts > max(4 * FIRST, int(trajectory.statistics.substeps.sum())):
        return False
    again = taken_again(scene, integrator, trajectory, integrator.stage_times, first, count, parts)
    if again is None:
        return False
    bends = np.diff(trajectory.v[first : first + count + 1, found.joint], n=2)
    return bool(np.abs(np.diff(again[1][:, found.joint], n=2) - bends).sum() <= 0.5 * np.abs(bends).sum())


def with_warnings(trajectory: Trajectory, found: Iterable[Finding]) -> Trajectory:
    """The motion with what was found as its warnings."""
    sentences = tuple(finding.sentence for finding in found)
    return trajectory.changed(warnings=sentences) if sentences else trajectory


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
    fast = _fast_damping(scene, trajectory)
    # With more stages what dampers are faster than a step leaves is less.
    if not integrator.l_stable and trajectory.dt * fast.rate > 2.0 * getattr(integrator, "stages", 1):
        found.append(_ringing(scene, fast, trajectory.dt))
    if split := _in_parts(trajectory):
        found.append(Finding("split steps", f"{split}: dt = {trajectory.dt:g} s is coarse here"))
    return (*found, *_beyond_limits(scene, trajectory))


def _beyond_limits(scene: Scene, trajectory: Trajectory) -> tuple[Finding, ...]:
    """Says what of the robot's description the motion leaves, limits and loops; the motion itself may be right."""
    return tuple(Finding(kind, sentence) for kind, sentence in limits_left(scene, trajectory))


def _in_parts(trajectory: Trajectory) -> str:
    """How many steps were taken in parts, in words; empty if none."""
    split = trajectory.statistics.split_steps
    if not split:
        return ""
    most = trajectory.statistics.substeps.max()
    return f"{split} of {trajectory.steps} steps were taken in up to {most} parts"


def _fast_damping(scene: Scene, trajectory: Trajectory) -> Fast:
    """The fastest of the dampers if a step cannot resolve it."""
    return fast_damping(scene, trajectory.q, trajectory.v, trajectory.u, trajectory.dt)


def _applied(scene: Scene, trajectory: Trajectory) -> Floats:
    """Constant forces of the controls in each step (N, n)."""
    return np.ascontiguousarray(trajectory.u @ scene.actuation.T)


def _ringing(scene: Scene, fast: Fast, dt: float, off: str = "", joint: int | None = None) -> Finding:
    """Says that something damps faster than the step, and of what joint."""
    times = f"(dt * {fast.rate:.3g}/s = {dt * fast.rate:.3g} > 2)"
    cure = f"dt below {2.0 / fast.rate:.3g} s resolves it"
    if fast.stop is None:
        does = f"damping is faster than the step {times}: velocities that it should stop will ring; {cure}"
        # Radau's methods do not keep constraints.
        method = "" if scene.constraints else ", varpin.Radau(3) stops them"
        return Finding("fast damping", f"{does}{method}{off}", joint)
    name, wide = scene.robot.joint_names[fast.stop.joint], 0.5 * dt * fast.rate * fast.stop.width
    method = "" if scene.constraints else ", and varpin.Radau(3) stops it"
    return Finding(
        "fast friction",
        f"dry friction is faster than the step where joint {name!r} comes to rest or turns back {times}: its velocity "
        f"may ring or creep there; {cure}, so does a width above {wide:.3g} rad/s or m/s{method}{off}",
        fast.stop.joint if joint is None else joint,
    )


def _looked_for(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Finding, ...]:
    """What the balance of the energy and steps taken again tell."""
    if not trajectory.steps:
        return ()
    # Whatever moves a joint by hand gives and takes energy.
    found = [] if scene.inputs else [*_energy(scene, integrator, trajectory)]
    unsettled = _unsettled(scene, integrator, trajectory)
    seen = looked_again(scene, integrator, trajectory)
    if seen.resolved:
        more = () if found else _adding_up(scene, integrator, trajectory, seen)
        return (*found, *more, *unsettled)
    error = motion_error(scene, integrator, trajectory)
    if error is not None and spoken_of(error):
        dt, start = trajectory.dt, trajectory.t[error.step]
        off = (
            f"smaller steps from t = {start:.4g} s on move joint {trajectory.joint_names[error.joint]!r} by "
            f"{100 * error.position:.3g}% of its way over a period, and its velocity by {100 * error.velocity:.3g}%"
        )
        fast = Fast(0.0) if integrator.l_stable else _fast_damping(scene, trajectory)
        if fast.rate:
            found.append(_ringing(scene, fast, dt, f"; {off}", error.joint))
        else:
            split = f" ({_in_parts(trajectory)})" if _in_parts(trajectory) else ""
            sentence = f"dt = {dt:g} s is coarse for {integrator} here: {off}{split}"
            found.append(Finding("coarse steps", sentence, error.joint))
    elif (
        error is None
        and not (integrator.l_stable or isinstance(integrator, Reference))
        and (fast := _fast_damping(scene, trajectory)).rate
    ):
        # No other method gets through these steps: whether they ring has to be seen in the motion itself.
        before, after = trajectory.v[:-1], trajectory.v[1:]
        if ((before * after < 0.0) & (np.abs(before) > _STILL) & (np.abs(after) > 0.5 * np.abs(before))).any():
            found.append(_ringing(scene, fast, trajectory.dt))
    if scene.constraints and not found:
        found.extend(_not_told(scene, integrator, trajectory))
    if not found:
        found.extend(_adding_up(scene, integrator, trajectory, Seen(False)))
    return (*found, *(finding for finding in unsettled if finding.kind not in {other.kind for other in found}))


def _not_told(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Finding, ...]:
    """Says if dampers are too fast for the steps that a motion under constraints is taken again in."""
    other = finer(integrator, trajectory, damped=True, pulled=True, constrained=True)
    fast = _fast_damping(scene, trajectory)
    resolves = 2.0 * getattr(other.method, "stages", 1) * other.parts
    return (_ringing(scene, fast, trajectory.dt),) if trajectory.dt * fast.rate > resolves else ()


def _adding_up(scene: Scene, integrator: Integrator, trajectory: Trajectory, seen: Seen) -> tuple[Finding, ...]:
    """Warnings about errors that add up or grow over a motion whose steps resolve each period."""
    phase = () if seen.stays else _out_of_phase(scene, integrator, trajectory)
    found = (*phase, *_at_limits_of_drives(scene, integrator, trajectory))
    return found or (() if seen.predictable else _growing(scene, integrator, trajectory))


def _growing(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Finding, ...]:
    """Says if errors of single steps, small as they are, grow to what shows."""
    found = grown_error(scene, integrator, trajectory)
    if found is None:
        return ()
    sentence = (
        f"{SAID}: single steps of dt = {trajectory.dt:g} s by {integrator} are off by about "
        f"{found.step:.1g} rad or m, and a method of more stages puts joint {trajectory.joint_names[found.joint]!r} "
        f"elsewhere by up to {found.off:.2g} rad or m, {100 * found.share:.2g}% of the longest way of a joint, from "
        f"t = {found.time:.4g} s on; smaller steps or more stages tell the motion for longer"
    )
    return (Finding("growing errors", sentence, found.joint),)


def _at_limits_of_drives(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Finding, ...]:
    """Says if servos come to the limits of their drives, or leave them, in steps that are too long for that."""
    found = bent(scene, integrator, trajectory)
    if found is None:
        return ()
    sentence = (
        f"servos come to the limits of their drives, or leave them, in {found.steps} steps: dt = {trajectory.dt:g} s "
        f"is coarse for {integrator} there, and joint {trajectory.joint_names[found.joint]!r} may be off by "
        f"{found.off:.2g} rad or m, {100 * found.share:.2g}% of the longest way of a joint; smaller steps mend it"
    )
    return (Finding("servos at their limits", sentence, found.joint),)


def _out_of_phase(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Finding, ...]:
    """Says if oscillations on springs lose more over the whole motion than can be told from a period."""
    lost = phase_lost(scene, integrator, trajectory)
    if lost is None:
        return ()
    sentence = (
        f"oscillations of {lost.rate / (2.0 * np.pi):.3g} Hz lose phase or height: over the motion, steps of "
        f"dt = {trajectory.dt:g} s by {integrator} put them off by about {100 * lost.turned:.2g}% of their height, "
        f"and joint {trajectory.joint_names[lost.joint]!r} by {lost.off:.2g} rad or m, {100 * lost.share:.2g}% of the "
        "longest way of a joint; smaller steps or more stages keep them"
    )
    return (Finding("phase", sentence, lost.joint),)


def _unsettled(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Finding, ...]:
    """Says if joints do not come to rest as dry friction has it, however little that is of their motion.

    Their friction is wrong by itself where a velocity near rest is off by a part of the width over which it turns
    round.
    """
    kicked = trajectory.dw.any() and scene.noise.diffusion is None
    if integrator.l_stable or isinstance(integrator, Reference) or kicked:
        return ()
    for stop in stops(scene, trajectory.v):
        rate = rate_at_stops(scene, trajectory.q, trajectory.v, trajectory.u, [stop], 2.0 / trajectory.dt)
        count = min(_SETTLING, trajectory.steps - stop.step)
        if not rate or count < _SETTLING // 2:
            continue
        off = _off_rest(scene, integrator, trajectory, stop, count)
        if len(off) < _SETTLING // 2:
            # What nothing gets through cannot be seen to be right.
            return (_ringing(scene, Fast(rate, stop), trajectory.dt),)
        lasting, most = float(np.median(off)), float(off.max())
        speed = float(np.abs(trajectory.v[:, stop.joint]).max())
        if lasting > _RUBS * stop.width or (most > stop.width and most > _FELT * speed):
            since = f"; after t = {trajectory.t[stop.step]:.4g} s it is off by up to {most:.3g} rad/s or m/s"
            return (_ringing(scene, Fast(rate, stop), trajectory.dt, since),)
    return ()


def _off_rest(scene: Scene, integrator: Integrator, trajectory: Trajectory, stop: Stop, count: int) -> Floats:
    """How far a joint's velocity is from the right one in the steps after it stops, as many as are known."""
    off, method = np.zeros(0), stopping(scene, _STOPPING)
    for parts in _SETTLED[1:] if scene.constraints else _SETTLED:
        again = taken_again(scene, method, trajectory, integrator.stage_times, stop.step, count, parts)
        if again is not None:
            off = np.abs(again[1] - trajectory.v[stop.step : stop.step + count + 1])[1:, stop.joint]
            off = off[np.isfinite(off)]
        if len(off) >= _SETTLING // 2:
            break
    return off


def _energy(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Finding, ...]:
    """Says if the energy is off, of the whole robot or of a group of joints that moves by itself."""
    worst: tuple[float, int, float, float] | None = None
    for at, defect, scale in _balances(scene, integrator, trajectory):
        # Dampers take what a coarse step leaves too much of: what is lost to them is no error of the motion.
        off = np.maximum(defect, 0.0) if scene.dissipates else np.abs(defect)
        last = int(np.argmax(off))
        rounding = 1e-12 * float(np.abs(trajectory.energy).max())
        # Written such that what is not finite is spoken of.
        if not off[last] <= CAUTION * WRONG_ENERGY * scale + rounding:
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
    groups = int(scene.group.max()) + 1
    if integrator.variational or groups < 2 or scene.noise.diffusion is None:
        return found
    _, turned, worked = _turnover(scene, trajectory)
    some = np.unique(np.linspace(1, trajectory.steps, _NODES).astype(np.int64))
    for group in range(groups):
        joints = scene.group == group
        scale = float(turned[joints].sum() + worked[joints].sum())
        found.append((some, _defects_of(scene, integrator, trajectory, joints)[some], scale))
    return found


def _defects_of(scene: Scene, integrator: Integrator, trajectory: Trajectory, joints: NDArray[np.bool_]) -> Floats:
    """What the energy of some joints is off by (N + 1,) [J]; they move by themselves. Zero but at some nodes."""
    kicked, given = _kicks(scene, trajectory)
    work, heat = _works(scene, integrator, trajectory, kicked)
    gained = np.append(0.0, np.cumsum((work - heat + given)[:, joints].sum(axis=1)))
    kinetic = 0.5 * (trajectory.p * trajectory.v)[:, joints].sum(axis=1)
    off = np.zeros(trajectory.steps + 1)
    still, rest = np.zeros(scene.robot.dof), trajectory.q[0]
    first = lagrangian_jet(scene, rest, still).L
    for node in np.unique(np.linspace(1, trajectory.steps, _NODES).astype(np.int64)):
        potential = first - lagrangian_jet(scene, np.where(joints, trajectory.q[node], rest), still).L
        off[node] = kinetic[node] - kinetic[0] + potential - gained[node]
    return off


def energy_scale(scene: Scene, trajectory: Trajectory) -> float:
    """The energy that a motion turns over [J]: the kinetic energy that its joints gain or lose, and the controls' work.

    What turns evenly all the time, however fast, turns nothing over.
    """
    return _turnover(scene, trajectory)[0]


def _turnover(scene: Scene, trajectory: Trajectory) -> tuple[float, Floats, Floats]:
    """:func:`energy_scale`; and of each joint (n,) [J] the energies that it is made of.

    The kinetic energy of the largest change of its velocity, for all it has to move; and the controls' work.
    """
    kinetic, work, turned, worked = energy_turnover(
        scene.core, trajectory.q, trajectory.v, trajectory.p, trajectory.u, trajectory.dt, even=EVEN, looks=_NODES
    )
    return min(kinetic, float(turned.sum())) + work, turned, worked


def energy_defects(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> Floats:
    """What the energy is off by after each step (N,) [J], of what no control, damper or kick accounts for.

    From the record alone, for integrators that keep no ledger of their own. For what dampers take, velocities are taken
    for linear over a step. Zeros with noise that only Python can evaluate.
    """
    if scene.noise.diffusion is None:
        return np.zeros(trajectory.steps)
    gained: Floats = trajectory.energy[1:] - trajectory.energy[0]
    acts = scene.dissipates or scene.couplings or scene.custom is not None
    if trajectory.u.any() or trajectory.u_stages.any() or trajectory.dw.any() or acts:
        kicked, given = _kicks(scene, trajectory)
        work, heat = _works(scene, integrator, trajectory, kicked)
        gained -= np.cumsum((work - heat + given).sum(axis=1))
    return gained if np.isfinite(gained).all() else np.nan_to_num(gained, nan=np.inf)


def _works(
    scene: Scene, integrator: Integrator, trajectory: Trajectory, kicked: Floats | float = 0.0
) -> tuple[Floats, Floats]:
    """Work of the controls, and the least that the dampers can take, at each joint in each step (N, n) [J].

    What servos make of their controls counts among what is taken.

    Controls that are constant over a step do the work of its way; of others the rest works on velocities that the cubic
    through both nodes has. A kick of v (N, n) begins each step. Dampers take
    least where the velocity is even, and q knows its mean: so does all other friction there.
    """
    h, before, after = trajectory.dt, trajectory.v[:-1] + kicked, trajectory.v[1:]
    with np.errstate(over="ignore", invalid="ignore"):
        way = np.diff(trajectory.q, axis=0)
        force = _applied(scene, trajectory)
        work = force * way
        if trajectory.u_stages.shape[1]:
            c = np.array(integrator.stage_times)[:, None]
            rest = (trajectory.u_stages - trajectory.u[:, None]) @ scene.actuation.T
            speed = (1.0 - c) * (1.0 - 3.0 * c) * before[:, None] + c * (3.0 * c - 2.0) * after[:, None]
            speed = speed + 6.0 * c * (1.0 - c) * (way / h)[:, None]
            work = work + h * np.einsum("s,ksn->kn", shares(integrator.stage_times), rest * speed)
        even = (way / h) ** 2
        heat = h * np.minimum((before**2 + before * after + after**2) / 3.0, even) * scene.damping
        if scene.dissipates or scene.couplings:
            middle = 0.5 * (trajectory.q[1:] + trajectory.q[:-1])
            heat -= scene.core.forces(middle, way / h, force)[0] * way + h * even * scene.damping
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


class Seen(NamedTuple):
    """What windows of a motion tell that were taken again.

    Attributes:
        resolved: Whether even steps of twice the length, or those of a better method, make the same motion, so that
            there is nothing more to look for over a period.
        stays: Whether errors are so small that over the whole motion, too, they do not add up to a word.
        predictable: Whether they stay below the threshold of a warning even if they grow as the fastest mode does.
    """

    resolved: bool
    stays: bool = False
    predictable: bool = False


def looked_again(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> Seen:
    """Whether even steps of twice the length, or a better method, make the same of a motion.

    Windows all over the motion, or some of them, are taken again from their first nodes, all at once, under the kicks
    that noise gave it. That takes half as long as the motion, or less; a motion of whole steps can pass whose noise
    the core knows.
    """
    steps, q, v, u = trajectory.steps, trajectory.q, trajectory.v, trajectory.u
    if isinstance(integrator, Reference) or not steps or scene.noise.diffusion is None:
        return Seen(False)
    noisy = bool(trajectory.dw.any())
    fastest, split, steady, pulled = glance(scene.core, q, v, u, trajectory.statistics.substeps, trajectory.dt)
    if not fastest > _STILL:
        return Seen(True)
    if split:
        return Seen(False)
    damped = bool(_fast_damping(scene, trajectory).rate)
    # Under constraints nothing stops what dampers do in one step; and what a hand does in two is another motion.
    if scene.inputs or (scene.constraints and damped):
        return Seen(False)
    if steps == 1:
        return Seen(not (damped or noisy or pulled) and _halves_agree(scene, integrator, trajectory))
    # Springs and dampers far faster than the step do as little in two, and controls that jump at nodes are others
    # there, which methods for such dampers follow. A better method is held against that in steps as long as theirs.
    jumps = not (steady or trajectory.u_stages.shape[1])
    other, times = integrator, 2
    if damped and not (integrator.l_stable or pulled):
        other, times = stopping(scene, _STOPPING), 1
    elif pulled or (damped and jumps):
        better = finer(integrator, trajectory, damped=damped, pulled=pulled)
        if better.parts != 1:
            return Seen(False)
        other, times = better.method, 1
    # What rings after a start or a jump may do so for long.
    begins, length = _windows(trajectory, every=times == 2 or not (pulled or integrator.l_stable))
    commands, drift = open_loop(u[:length:times]), np.zeros((0, 0, scene.robot.dof))
    if not steady:
        # Commands are the same for all paths; their forces need not be.
        held = u[begins[:, None] + np.arange(length)].reshape(len(begins), length // times, times, -1)
        commands, drift = open_loop(np.zeros_like(u[:length:times])), held.mean(axis=2) @ scene.actuation.T
    kicks = _kicks_of(scene, integrator, trajectory, begins, length, times) if noisy else None
    if trajectory.u_stages.shape[1]:
        again = _windows_under(scene, integrator, trajectory, begins, length, other, times, kicks)
    else:
        again = other.motions(scene, q[begins], v[begins], commands, drift, times * trajectory.dt, kicks)
    if times == 1 and not (jumps or pulled) and again is not None:
        # What a start off the slow motion leaves of itself after a single step is not to be held against it.
        again = np.ascontiguousarray(again[0][:, 1::2]), np.ascontiguousarray(again[1][:, 1::2])
    if again is None:
        return Seen(False)

    def agree(gain: float, gain_of_velocity: float) -> bool:
        return _agree(scene, (q, v), begins, length, trajectory.dt, again, gain, gain_of_velocity)

    # How much less the error is in steps of half the length; of another method nothing is known. What jumps do to
    # velocities that are damped is over soon, and does not grow; what lasts moves joints.
    less = 1.0 if damped or times == 1 else 2.0**integrator.order - 1.0
    of_velocity = 1.0 / _PASSING if damped and jumps and not pulled else less / _MARGIN
    if not agree(less / _MARGIN, of_velocity):
        return Seen(False)
    # A whole motion is so many windows long, and errors of oscillations may add up from each to the next.
    windows = length / steps
    stays = agree(less * PHASE_SHOWS / WRONG_MOTION * windows / _ADDS, of_velocity)
    most = less * NEAR * GROWTH_WARNED / WRONG_MOTION * windows
    predictable = stays and agree(most / growth_bound(scene, trajectory), of_velocity)
    return Seen(True, stays, predictable)


def _windows(trajectory: Trajectory, *, every: bool) -> tuple[Integers, int]:
    """Where windows of a motion begin (K,), and how many steps each has: of like lengths, which are even.

    All over the motion, up to a number of them; or some of it, where it takes longer than half of the motion to take
    them again.
    """
    steps, v = trajectory.steps, trajectory.v
    if every:
        pieces = min(-(-steps // WINDOW), _WINDOWS)
        length = min(WINDOW, 2 * -(-steps // (2 * pieces)), steps - steps % 2)
    else:
        pieces = min(max(1, steps // (4 * WINDOW)), _WINDOWS)
        length = min(WINDOW, max(_SHORT, 2 * (steps // 12)), steps - steps % 2)
    apart = max(pieces, 1 + steps % 2 if every else 1) - 1
    begins = np.array([i * (steps - length) // apart for i in range(apart + 1)]) if apart else _FROM_START
    if pieces == _WINDOWS:
        begins = np.union1d(begins, blows(v, length))
    elif not every:
        seen = np.zeros(steps, dtype=np.bool_)
        for begin in begins.tolist():
            seen[begin : begin + length] = True
        begins = np.union1d(begins, np.array(blows(v, length, seen)[:1], dtype=np.int64))
    return begins, length


def _kicks_of(
    scene: Scene, integrator: Integrator, trajectory: Trajectory, begins: Integers, length: int, times: int
) -> Floats:
    """Impulses of the noise in windows of a motion, before and after each step of ``times`` of its own (P, K, 2, n).

    In a step of twice the length half of what kicked in its middle comes before it and half after it: its end is then
    at the same place, with the same momentum, to first order in the step.
    """
    diffusion, first = scene.noise.diffusion, trajectory.q[0]
    assert diffusion is not None
    step = begins[:, None] + np.arange(length)
    # Explicit Euler's kicks come after the step.
    left = 0.0 if isinstance(integrator, ExplicitEuler) else integrator.left
    n = trajectory.q.shape[1]

    def part(share: float, node: Integers) -> Floats:
        if share == 0.0:
            return np.zeros((*step.shape, n))
        rows = trajectory.q[node.ravel()], trajectory.u[step.ravel()], trajectory.dw[step.ravel()]
        return share * impulses(diffusion, *rows, first).reshape(*step.shape, n)

    before, after = part(left, step), part(1.0 - left, step + 1)
    if times == 2:
        half = 0.5 * (after[:, ::2] + before[:, 1::2])
        before, after = before[:, ::2] + half, half + after[:, 1::2]
    return np.stack([before, after], axis=2)


def _agree(
    scene: Scene,
    nodes: tuple[Floats, Floats],
    begins: Integers,
    length: int,
    dt: float,
    again: tuple[Floats, Floats],
    gain: float,
    gain_of_velocity: float,
) -> bool:
    """Whether windows of q and v are what was made of them ``again``, within so much of what is wrong.

    That has nodes after each step, or after each second one.
    """
    return windows_agree(
        scene.core,
        *nodes,
        begins,
        length,
        dt,
        *again,
        way=gain * WRONG_MOTION,
        velocity=gain_of_velocity * WRONG_VELOCITY,
        little=LITTLE,
        light=LIGHT,
        even=EVEN,
    )


def _halves_agree(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> bool:
    """:func:`looked_again` of a single step: two of half its length make the same motion."""
    q, v, u, half = trajectory.q, trajectory.v, trajectory.u, 0.5 * trajectory.dt
    commands = open_loop(np.concatenate([u, u]))
    if trajectory.u_stages.shape[1]:
        times = integrator.stage_times
        commands = changing(in_parts(trajectory.u_stages, times, 2, times), times)
    again = integrator.motions(scene, q[:1], v[:1], commands, np.zeros((0, 0, scene.robot.dof)), half)
    if again is None:
        return False
    fine = np.concatenate([q[:1], again[0][0]]), np.concatenate([v[:1], again[1][0]])
    gain = (1.0 - 2.0**-integrator.order) / _MARGIN
    return _agree(scene, fine, _FROM_START, 2, half, (q[None, 1:], v[None, 1:]), gain, gain)


def _windows_under(
    scene: Scene,
    integrator: Integrator,
    trajectory: Trajectory,
    begins: Integers,
    length: int,
    other: Integrator,
    times: int,
    kicks: Floats | None,
) -> tuple[Floats, Floats] | None:
    """Windows of a motion whose controls change within steps, by another method, or in steps of twice the length."""
    at, mine, found = other.stage_times, integrator.stage_times, []
    for window, begin in enumerate(begins):
        values = trajectory.u_stages[begin : begin + length]
        commands = changing(in_parts(values, mine, 1, at) if times == 1 else in_pairs(values, mine, at), at)
        node = slice(begin, begin + 1)
        given = commands, np.zeros((0, 0, scene.robot.dof)), times * trajectory.dt
        kick = None if kicks is None else kicks[window : window + 1]
        again = other.motions(scene, trajectory.q[node], trajectory.v[node], *given, kick)
        if again is None:
            return None
        found.append(again)
    q, v = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return q, v


def motion_error(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> MotionError | None:
    """The error of a motion, by taking parts of it again from their first nodes by a method of more stages.

    The start, the places where velocities change most and some spread over the motion are looked at, over a period of
    each joint or what can be told of it; more places where errors come close to what is wrong. Each joint is judged in
    units of its own motion. The first error that is worth a word ends the search, and so does a number of steps in
    proportion to the motion's own. It says nothing of how errors grow over many periods. None where nothing moves, and
    for an integrator that chooses its own steps.
    """
    if isinstance(integrator, Reference) or not trajectory.steps:
        return None
    substeps = trajectory.statistics.substeps
    fastest, _, _, pulled = glance(scene.core, trajectory.q, trajectory.v, trajectory.u, substeps, trajectory.dt)
    if not fastest > _STILL:
        return None
    damped = bool(_fast_damping(scene, trajectory).rate)
    other = finer(integrator, trajectory, damped=damped, pulled=pulled, constrained=bool(scene.constraints))
    first = examined_nodes(scene, trajectory)
    inertia = inertias(scene, trajectory.q[first])
    # Steps whose error is known to be small.
    small = np.zeros(trajectory.steps, dtype=np.bool_)
    left = LEAST_WORK + WORK * int(np.maximum(substeps, 1).sum())
    # Nodes beside which one was looked from.
    seen = np.zeros(trajectory.steps + 1, dtype=np.bool_)
    worst = None
    for chosen in (first, between(trajectory.steps, first)):
        for step in chosen.tolist():
            if seen[step] or (chosen is first and small[step:].all()):
                continue
            window = Window.at(scene, trajectory, step)
            if chosen is first and small[step : step + int(window.judged.max())].all():
                continue
            look = _look(scene, integrator, trajectory, window, inertia, other, left)
            if look is None:
                continue
            near = min(_NEAR_BY, int(window.judged.max()) // 8)
            seen[max(0, step - near) : step + near + 1] = True
            left -= look.work
            if worst is None or look.error.worst > worst.worst:
                worst = look.error
            if spoken_of(look.error) or left <= 0:
                return worst
            if look.error.worst < _SMALL:
                small[step : step + look.known] = True
        if worst is None or worst.worst < _NEAR:
            break
    return worst


def spoken_of(error: MotionError) -> bool:
    """Whether an error is worth a word."""
    return not error.worst <= (CAUTION if error.settled else _UNSETTLED)


@dataclass(frozen=True)
class _Look:
    """An estimate of the error at one window.

    Attributes:
        error: The error.
        known: How many steps can be told.
        work: Steps taken for it.
    """

    error: MotionError
    known: int
    work: int


def _look(
    scene: Scene,
    integrator: Integrator,
    trajectory: Trajectory,
    window: Window,
    inertia: Floats,
    other: Finer,
    most: int,
) -> _Look | None:
    """The error at one window, by so many steps at most; None where none can be told."""
    times = integrator.stage_times
    judged = int(window.judged.max())
    taken = np.maximum(trajectory.statistics.substeps[window.step : window.step + judged], 1)
    # Where guards took steps in parts, they are as short as these.
    parts = other.parts * int(2 ** np.ceil(np.log2(taken.mean())))
    # Twice, for whether that motion can be told takes as many steps again.
    count = min(judged, max(1, most // (2 * parts)))
    q, v = (values[window.step : window.step + count + 1] for values in (trajectory.q, trajectory.v))
    if scene.noise.diffusion is None and trajectory.dw.any():
        # Kicks that only Python knows are left out of both.
        plain = taken_again(scene, integrator, trajectory, times, window.step, count, parts // other.parts)
        if plain is None:
            return None
        q, v = plain
    again = Again(scene, other.method, trajectory, times, window.step, count, parts)
    far = _FAR * float(np.ptp(q, axis=0).max())
    # What is far off is wrong or cannot be told, and no more is needed of it.
    while not again.ended and np.abs(again.q[again.done] - q[again.done]).max() <= far:
        again.go_on()
    known, work = again.done, again.done * parts
    if not known:
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        off = [np.abs(a - b) / (1.0 - other.left) for a, b in ((q, again.q), (v, again.v))]
    # A part of a period stands for the whole only if no steps are left for the rest.
    cut = known < count
    error = window.error(scene, trajectory, inertia, (off[0][: known + 1], off[1][: known + 1]), cut=cut)
    if not error.worst < _SMALL:
        shift = disturbance(trajectory, window.step, known)
        beside = Again(scene, other.method, trajectory, times, window.step, known, parts, shift)
        told = 0
        while not beside.ended and told == beside.done:
            beside.go_on()
            # Constraints may move the start by more.
            apart = max(shift[0], float(np.abs(beside.q[0] - again.q[0]).max()))
            told = grown(again.q[: beside.done + 1], beside.q[: beside.done + 1], apart)
        work += beside.done * parts
        if told < known:
            known, cut = max(1, told), True
            error = window.error(scene, trajectory, inertia, (off[0][: known + 1], off[1][: known + 1]), cut=True)
    if max(float(np.ptp(x[: known + 1], axis=0).max()) for x in (q, again.q)) < _SHORTEST:
        return None
    return _Look(replace(error, settled=cut or count == judged), known, work)
