"""The check of a finished motion: does its energy balance close, and do its steps resolve the motion of the robot?

The check is the same for all integrators, with guards and without. It uses the motion's record and repeats parts of the
motion in smaller steps. Every function that returns a motion to the user calls :func:`examined`, and :func:`announce`
for the log.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats, Integers
from varpin.core import energy_turnover, glance, windows_agree
from varpin.integrators import Integrator, Reference
from varpin.integrators.base import noise_impulses, open_loop
from varpin.integrators.explicit import accelerations
from varpin.integrators.within import changing, in_pairs, in_parts, shares
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.scene import Scene
from varpin.model import joint_unit
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
    disturbance,
    examined_nodes,
    grown,
    inertias,
    nodes_between,
    violent_windows,
)
from varpin.simulation.chatter import RUN, Alternation, alternation
from varpin.simulation.clearance import clearly_right
from varpin.simulation.damping import Fast, damping_at_stop, damping_of, fast_damping
from varpin.simulation.friction import Stop, rate_at_stops, stops
from varpin.simulation.growth import ADDED as ADDED_WORDS
from varpin.simulation.growth import NEAR, better, grown_error, growth_bound, whole_error
from varpin.simulation.growth import WARNED as GROWTH_WARNED
from varpin.simulation.growth import WORDS as GROWTH_WORDS
from varpin.simulation.limits import left as limits_left
from varpin.simulation.phase import WARNED as PHASE_WARNED
from varpin.simulation.phase import phase_lost
from varpin.simulation.retaking import (
    Again,
    Finer,
    finer,
    impulses_at,
    noise_left_out,
    shortest_parts,
    stopping,
    taken_again,
)
from varpin.trajectory import Trajectory

# Errors are in units of the thresholds WRONG_ENERGY, WRONG_POSITION, WRONG_MOTION and WRONG_VELOCITY.
# Estimated error from which on a warning is given: estimates are accurate to some percent.
CAUTION = 0.95
# The same for estimates from fewer steps than a period, which are less accurate.
_CAUTION_IF_ROUGH = 0.7
# Error below which a window is accepted as it is, and error from which on more windows are examined: the error there
# may be three times as large as in the first windows.
_SMALL, _NEAR = 0.2, 0.35
# Distance from the repeated motion at which the repetition ends, as a share of the travel; travel that counts as no
# motion [rad or m].
_FAR, _SHORTEST = 0.3, 1e-8
# Windows that begin within this many nodes, and within an eighth of a period, are one.
_NEAR_BY = 4
# Most steps of all repetitions: this multiple of the motion's own steps, their parts counted, plus a constant.
WORK, LEAST_WORK = 50, 256
# Number of windows repeated in steps of twice the length, beside those where velocities change most; and the factor on
# the error of a window, which grows over a period.
_WINDOWS, _MARGIN = 16, 8.0
# Fewest steps of a window repeated by another method; and the factor on errors of velocities after jumps of a control.
_SHORT, _PASSING = 8, 1.25
# Factor on the error of a window for each window length of the whole motion.
_ADDS = 4.0
# Stages of the repeating method where dampers are faster than the step.
_STOPPING = 3
# Number of steps repeated from where a joint comes to rest, and the parts of each: the second number if the first
# fails.
_REST_STEPS, _REST_PARTS = 6, (2, 16)
# Largest error of the velocity there without a warning: the median in widths of the friction, and the largest as a
# share of the joint's largest velocity.
_MEDIAN_OFF, _MOST_OFF = 0.1, 1e-3
# Number of nodes at which mass matrices and energies of single groups are evaluated.
_NODES = 16
# First nodes of the windows of a motion that has one.
_FROM_START = np.zeros(1, dtype=np.int64)
# Kind of the finding about errors that add up or grow.
GROWING = "growing errors"
# Velocities below this count as zero [rad/s or m/s]: rounding in a robot in equilibrium.
_STILL = 1e-9


@dataclass(frozen=True)
class Finding:
    """A warning about a motion.

    Attributes:
        kind: Its subject in a word or two.
        sentence: For the user, with numbers.
        joint: The coordinate it names, None for none; the log has each kind once for a scene, a time step and a joint.
    """

    kind: str
    sentence: str
    joint: int | None = None


# Squares of the numbers of a motion that blows up may be infinite, and their differences undefined.
@np.errstate(over="ignore", invalid="ignore")
def examined(
    scene: Scene,
    integrator: Integrator,
    trajectory: Trajectory,
    error: float | None = None,
    *,
    corrected: bool = False,
) -> tuple[Trajectory, tuple[Finding, ...]]:
    """The motion with its energy balance, if the integrator keeps none, and its warnings; and the findings.

    ``error`` is the largest error of q at all nodes [rad or m], where it is known. ``corrected``: a controller acts on
    the state that has the errors of the steps before, so that they do not add up over the motion.
    """
    if not integrator.variational:
        defects = energy_defects(scene, integrator, trajectory)
        defects.setflags(write=False)
        trajectory = trajectory.changed(statistics=trajectory.statistics.changed(energy_defect=defects))
    right = clearly_right(scene, integrator, trajectory, error)
    errors = () if right else _errors_found(scene, integrator, trajectory, corrected=corrected)
    found = (
        *errors,
        *alternating(scene, integrator, trajectory),
        *_beyond_limits(scene, trajectory),
    )
    return with_warnings(trajectory, found), found


def alternating(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Finding, ...]:
    """A warning if velocities alternate from step to step, caused neither by controls nor by noise.

    Alternation that half steps show as well is an oscillation of the robot of about two nodes a period: no warning.
    """
    found = None if trajectory.dw.any() else alternation(trajectory.v, trajectory.u)
    if found is None or _alternates_in_half_steps(scene, integrator, trajectory, found):
        return ()
    seen = found.sentence(scene.robot.joint_names, trajectory.t)
    sentence = f"{seen}: dt = {trajectory.dt:g} s is too long for what is stiff, damped or fed back here"
    return (Finding("alternating velocities", sentence, found.joint),)


def _alternates_in_half_steps(scene: Scene, integrator: Integrator, trajectory: Trajectory, found: Alternation) -> bool:
    """Whether a stretch of alternating velocities alternates in the same way when its first steps are halved."""
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
    """The motion with the findings' sentences as its warnings."""
    sentences = tuple(finding.sentence for finding in found)
    return trajectory.changed(warnings=sentences) if sentences else trajectory


def announce(logger: logging.Logger, scene: Scene, dt: float, found: Iterable[Finding]) -> None:
    """Log findings, each kind once for this scene, time step and joint."""
    for finding in found:
        key = finding.kind, dt, finding.joint
        if key not in scene.announced:
            scene.announced.add(key)
            logger.warning(finding.sentence)


@np.errstate(over="ignore", invalid="ignore")
def findings_from_record(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Finding, ...]:
    """Possible errors from the record alone: dampers faster than the step, steps taken in parts, limits exceeded.

    Unlike :func:`examined` it repeats no steps.
    """
    found = []
    fast = _fast_damping(scene, trajectory)
    # Methods of more stages stop faster dampers.
    if not integrator.l_stable and trajectory.dt * fast.rate > 2.0 * getattr(integrator, "stages", 1):
        found.append(_ringing(scene, _damping_of(scene, trajectory), trajectory.dt))
    if split := _in_parts(trajectory):
        found.append(Finding("split steps", f"{split}: dt = {trajectory.dt:g} s is coarse here"))
    return (*found, *_beyond_limits(scene, trajectory))


def _beyond_limits(scene: Scene, trajectory: Trajectory) -> tuple[Finding, ...]:
    """Warnings of exceeded joint limits and open loops of the robot's description; the motion may still be right."""
    return tuple(Finding(kind, sentence) for kind, sentence in limits_left(scene, trajectory))


def _in_parts(trajectory: Trajectory) -> str:
    """The number of steps taken in parts, in words; empty if none."""
    split = trajectory.statistics.split_steps
    if not split:
        return ""
    most = trajectory.statistics.substeps.max()
    return f"{split} of {trajectory.steps} steps were taken in up to {most} parts"


def _fast_damping(scene: Scene, trajectory: Trajectory) -> Fast:
    """The fastest damping, if a step cannot resolve it."""
    return fast_damping(scene, trajectory.q, trajectory.v, trajectory.u, trajectory.dt)


def _damping_of(scene: Scene, trajectory: Trajectory, joint: int | None = None) -> Fast:
    """The damping to name: that of a joint, if a step cannot resolve it, else the fastest."""
    return damping_of(scene, trajectory.q, trajectory.v, trajectory.u, trajectory.dt, joint)


def _applied(scene: Scene, trajectory: Trajectory) -> Floats:
    """Constant forces of the controls in each step (N, n)."""
    return np.ascontiguousarray(trajectory.u @ scene.actuation.T)


def _ringing(scene: Scene, fast: Fast, dt: float, off: str = "", joint: int | None = None) -> Finding:
    """The warning that damping or dry friction is faster than the step; ``off`` ends it with the error."""
    times = f"(dt * {fast.rate:.3g}/s = {dt * fast.rate:.3g} > 2)"
    cure = f"dt below {2.0 / fast.rate:.3g} s resolves it"
    names = scene.robot.joint_names
    if fast.stop is None:
        where = "" if fast.joint is None else f" at joint {names[fast.joint]!r}"
        does = f"damping is faster than the step{where} {times}: velocities that it should stop will ring; {cure}"
        # Radau's methods do not keep constraints.
        method = "" if scene.constraints else ", varpin.Radau(3) stops them"
        return Finding("fast damping", f"{does}{method}{off}", fast.joint if joint is None else joint)
    wide = _resolved_width(scene, fast.stop, dt * fast.rate)
    wider = f", so does a width above {wide:.3g} rad/s or m/s" if wide < np.inf else ""
    method = "" if scene.constraints else ", and varpin.Radau(3) stops it"
    return Finding(
        "fast friction",
        f"dry friction is faster than the step where joint {names[fast.stop.joint]!r} comes to rest or turns back "
        f"{times}: its velocity may ring or creep there; {cure}{wider}{method}{off}",
        fast.stop.joint if joint is None else joint,
    )


def _resolved_width(scene: Scene, stop: Stop, turned: float) -> float:
    """The width from which on the step resolves a joint's friction beside its damper; infinite if there is none.

    ``turned`` is the rate of both times the step.
    """
    damper = float(scene.damping[stop.joint])
    left = 2.0 / turned * (stop.slope + damper) - damper
    return stop.slope * stop.width / left if left > 0.0 else np.inf


def _errors_found(
    scene: Scene, integrator: Integrator, trajectory: Trajectory, *, corrected: bool
) -> tuple[Finding, ...]:
    """Errors from the energy balance and from repeated steps."""
    if not trajectory.steps:
        return ()
    # A kinematic input does work that the balance does not have.
    found = [] if scene.inputs else [*_energy(scene, integrator, trajectory)]
    at_rest = _wrong_at_rest(scene, integrator, trajectory)
    resolution = resolution_of(scene, integrator, trajectory)
    if resolution.resolved:
        more = () if found or corrected else _accumulated(scene, integrator, trajectory, resolution)
        return (*found, *more, *at_rest)
    error = motion_error(scene, integrator, trajectory)
    if error is not None and is_wrong(error):
        dt, start = trajectory.dt, trajectory.t[error.step]
        off = (
            f"smaller steps from t = {start:.4g} s on move joint {trajectory.joint_names[error.joint]!r} by "
            f"{100 * error.position:.3g}% of its travel over a period, and its velocity by {100 * error.velocity:.3g}%"
        )
        if not integrator.l_stable and _fast_damping(scene, trajectory).rate:
            fast = _damping_of(scene, trajectory, error.joint)
            found.append(_ringing(scene, fast, dt, f"; {off}", error.joint))
        else:
            split = f" ({_in_parts(trajectory)})" if _in_parts(trajectory) else ""
            sentence = f"dt = {dt:g} s is coarse for {integrator} here: {off}{split}"
            found.append(Finding("coarse steps", sentence, error.joint))
    elif (
        error is None
        and not (integrator.l_stable or isinstance(integrator, Reference))
        and _fast_damping(scene, trajectory).rate
    ):
        # No other method integrates these steps: ringing is looked for in the motion itself.
        before, after = trajectory.v[:-1], trajectory.v[1:]
        if ((before * after < 0.0) & (np.abs(before) > _STILL) & (np.abs(after) > 0.5 * np.abs(before))).any():
            found.append(_ringing(scene, _damping_of(scene, trajectory), trajectory.dt))
    if scene.constraints and not found:
        found.extend(_unresolved_damping(scene, integrator, trajectory))
    if not (found or corrected):
        found.extend(_accumulated(scene, integrator, trajectory, Resolution(False)))
    return (*found, *(finding for finding in at_rest if finding.kind not in {other.kind for other in found}))


def _unresolved_damping(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Finding, ...]:
    """A warning if dampers are too fast even for the steps in which a motion under constraints is repeated."""
    other = finer(integrator, trajectory, damped=True, pulled=True, constrained=True)
    fast = _fast_damping(scene, trajectory)
    resolves = 2.0 * getattr(other.method, "stages", 1) * other.parts
    told = trajectory.dt * fast.rate > resolves
    return (_ringing(scene, _damping_of(scene, trajectory), trajectory.dt),) if told else ()


def _accumulated(
    scene: Scene, integrator: Integrator, trajectory: Trajectory, resolution: Resolution
) -> tuple[Finding, ...]:
    """Errors that add up or grow over a motion whose steps resolve each period.

    They come from a repetition of the whole motion under its recorded controls, without feedback.
    """
    phase = () if resolution.in_phase else _out_of_phase(scene, integrator, trajectory)
    return phase or _growing(scene, integrator, trajectory, resolution)


def _growing(
    scene: Scene, integrator: Integrator, trajectory: Trajectory, resolution: Resolution
) -> tuple[Finding, ...]:
    """A warning if errors of single steps add up or grow to large ones over the motion."""
    found = grown_error(scene, integrator, trajectory, predictable=resolution.predictable)
    if found is None:
        return ()
    share = share_in_words(scene, found.joint, found.off, found.share)
    off = f"joint {trajectory.joint_names[found.joint]!r} by up to {share}, from t = {found.time:.4g} s on"
    if found.causes:
        sentence = (
            f"{' and '.join(found.causes)} in {found.kinks} steps: dt = {trajectory.dt:g} s is coarse for {integrator} "
            f"there, and smaller steps move {off}"
        )
        return (Finding("kinks of forces", sentence, found.joint),)
    sentence = (
        f"{GROWTH_WORDS if found.grows else ADDED_WORDS}: single steps of dt = {trajectory.dt:g} s by {integrator} are "
        f"off by about {found.step:.1g} {joint_unit(scene.robot)}, and a method of more stages moves {off}; "
        "smaller steps or more stages keep the motion right for longer"
    )
    return (Finding(GROWING, sentence, found.joint),)


def share_in_words(scene: Scene, joint: int, off: float, share: float) -> str:
    """An error of a joint in words, with its unit and its share of the joint's scale."""
    sliding = scene.robot.slides
    unit = "m" if sliding[joint] else "rad"
    if sliding.all() or not sliding.any():
        return f"{off:.2g} {unit}, {100 * share:.2g}% of the largest joint travel"
    kind = "slide" if sliding[joint] else "turn"
    return f"{off:.2g} {unit}, {100 * share:.2g}% of {off / share:.2g} {unit}, the scale of joints that {kind}"


def _out_of_phase(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Finding, ...]:
    """A warning if errors in phase and amplitude of oscillations on springs add up over the whole motion.

    The estimate only tells whether to repeat the motion, which gives the error.
    """
    lost = phase_lost(scene, integrator, trajectory)
    if lost is None:
        return ()
    found = whole_error(scene, trajectory, better(integrator, trajectory), integrator.stage_times)
    joint, off, share = found or (lost.joint, lost.off, lost.share)
    if share < PHASE_WARNED:
        return ()
    sentence = (
        f"oscillations of {lost.rate / (2.0 * np.pi):.3g} Hz lose phase or amplitude: over the motion, steps of "
        f"dt = {trajectory.dt:g} s by {integrator} make an error of about {100 * lost.turned:.2g}% of their amplitude, "
        f"and a method of more stages moves joint {trajectory.joint_names[joint]!r} by up to "
        f"{share_in_words(scene, joint, off, share)}; smaller steps or more stages reduce it"
    )
    return (Finding("phase", sentence, joint),)


def _wrong_at_rest(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Finding, ...]:
    """A warning if a joint with dry friction does not come to rest correctly, however small the error in its motion.

    The friction force is wrong where a velocity near rest is wrong by a part of the width over which the force changes
    sign.
    """
    left_out = noise_left_out(scene, integrator, trajectory)
    if integrator.l_stable or isinstance(integrator, Reference) or left_out:
        return ()
    given = trajectory.q, trajectory.v, trajectory.u
    for stop in stops(scene, trajectory.v):
        rate = rate_at_stops(scene, *given, [stop], 2.0 / trajectory.dt)
        count = min(_REST_STEPS, trajectory.steps - stop.step)
        if not rate or count < _REST_STEPS // 2:
            continue
        off = _velocity_errors(scene, integrator, trajectory, stop, count)
        if len(off) < _REST_STEPS // 2:
            # No method integrates these steps, so their error is unknown.
            return (_ringing(scene, damping_at_stop(scene, *given, trajectory.dt, stop), trajectory.dt),)
        lasting, most = float(np.median(off)), float(off.max())
        speed = float(np.abs(trajectory.v[:, stop.joint]).max())
        if lasting > _MEDIAN_OFF * stop.width or (most > stop.width and most > _MOST_OFF * speed):
            fast = damping_at_stop(scene, *given, trajectory.dt, stop)
            which = "it" if fast.stop else f"the velocity of joint {trajectory.joint_names[stop.joint]!r}, which stops,"
            since = f"; after t = {trajectory.t[stop.step]:.4g} s {which} is off by up to {most:.3g} rad/s or m/s"
            return (_ringing(scene, fast, trajectory.dt, since, stop.joint),)
    return ()


def _velocity_errors(scene: Scene, integrator: Integrator, trajectory: Trajectory, stop: Stop, count: int) -> Floats:
    """The error of a joint's velocity after each step from where it stops, as far as the repetition goes."""
    off, method = np.zeros(0), stopping(scene, _STOPPING, integrator)
    for parts in _REST_PARTS[1:] if scene.constraints else _REST_PARTS:
        again = taken_again(scene, method, trajectory, integrator.stage_times, stop.step, count, parts)
        if again is not None:
            off = np.abs(again[1] - trajectory.v[stop.step : stop.step + count + 1])[1:, stop.joint]
            off = off[np.isfinite(off)]
        if len(off) >= _REST_STEPS // 2:
            break
    return off


def _energy(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Finding, ...]:
    """A warning if the energy of the whole robot, or of a group of joints without coupling to others, is wrong."""
    worst: tuple[float, int, float, float] | None = None
    for at, defect, scale in _balances(scene, integrator, trajectory):
        # Coarse steps may take too much energy out through dampers: a loss to them is no error of the motion.
        off = np.maximum(defect, 0.0) if scene.dissipates else np.abs(defect)
        last = int(np.argmax(off))
        rounding = 1e-12 * float(np.abs(trajectory.energy).max())
        # The comparison is negated, for values that are not finite.
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
    """Nodes, energy defects there [J], and the energy turned over [J]: of all joints, and of each group.

    Groups are left out for variational integrators, whose guards check the balance of each group in each step.
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
    """Energy defect (N + 1,) [J] of joints without coupling to others; zero except at some nodes."""
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

    A joint at constant velocity turns nothing over.
    """
    return _turnover(scene, trajectory)[0]


def _turnover(scene: Scene, trajectory: Trajectory) -> tuple[float, Floats, Floats]:
    """:func:`energy_scale`, and for each joint (n,) [J] its two parts.

    They are the kinetic energy of the largest change of its velocity, with its diagonal entry of M; and the controls'
    work.
    """
    kinetic, work, turned, worked = energy_turnover(
        scene.core, trajectory.q, trajectory.v, trajectory.p, trajectory.u, trajectory.dt, even=EVEN, looks=_NODES
    )
    return min(kinetic, float(turned.sum())) + work, turned, worked


def energy_defects(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> Floats:
    """Energy defect after each step (N,) [J]: the change of energy less work of controls, dampers and kicks.

    It is computed from the record, for integrators without an energy balance of their own. The energy that dampers take
    is that of velocities linear over a step. Zeros with noise that only Python can evaluate.
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
    """Work of the controls, and the least energy that the dampers take, at each joint in each step (N, n) [J].

    Forces of servos count as dampers. The mean of a control over a step works on the step's displacement; its deviation
    from the mean, where controls change within steps, on the velocity of the cubic through both nodes. A kick of v
    (N, n) begins each step. Dampers, and all other friction, take least at constant velocity, which is the displacement
    over the step.
    """
    h, before, after = trajectory.dt, trajectory.v[:-1] + kicked, trajectory.v[1:]
    with np.errstate(over="ignore", invalid="ignore"):
        displacement = np.diff(trajectory.q, axis=0)
        force = _applied(scene, trajectory)
        work = force * displacement
        if trajectory.u_stages.shape[1]:
            c = np.array(integrator.stage_times)[:, None]
            rest = (trajectory.u_stages - trajectory.u[:, None]) @ scene.actuation.T
            speed = (1.0 - c) * (1.0 - 3.0 * c) * before[:, None] + c * (3.0 * c - 2.0) * after[:, None]
            speed = speed + 6.0 * c * (1.0 - c) * (displacement / h)[:, None]
            work = work + h * np.einsum("s,ksn->kn", shares(integrator.stage_times), rest * speed)
        even = (displacement / h) ** 2
        heat = h * np.minimum((before**2 + before * after + after**2) / 3.0, even) * scene.damping
        if scene.dissipates or scene.couplings:
            middle = 0.5 * (trajectory.q[1:] + trajectory.q[:-1])
            heat -= scene.core.forces(middle, displacement / h, force)[0] * displacement + h * even * scene.damping
    return work, heat


def _kicks(scene: Scene, trajectory: Trajectory) -> tuple[Floats | float, Floats | float]:
    """Change of v and of the energy [J] by each step's kick, at each joint (N, n), as if it came before the step."""
    if not trajectory.dw.any():
        return 0.0, 0.0
    q, v = trajectory.q[:-1], trajectory.v[:-1]
    impulse = noise_impulses(scene, trajectory, q, v)
    change = np.einsum("kij,kj->ki", accelerations(scene, q, v, np.zeros_like(q))[3], impulse)
    return change, impulse * (v + 0.5 * change)


class Resolution(NamedTuple):
    """The result of repeating windows of a motion.

    Attributes:
        resolved: Whether steps of twice the length, or a better method, make the same motion: the steps resolve it
            over a period.
        in_phase: Whether the errors are so small that no warning is due even if they add up over the whole motion.
        predictable: Whether the errors are so small that no warning is due even if they grow as the fastest mode does.
    """

    resolved: bool
    in_phase: bool = False
    predictable: bool = False


def resolution_of(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> Resolution:
    """Whether steps of twice the length, or a better method, make the same motion.

    Windows of the motion are repeated from their first nodes, all at once, with the noise of the motion. That takes
    at most half as long as the motion. Only motions without divided steps, and without noise in Python, can pass.
    """
    steps, q, v, u = trajectory.steps, trajectory.q, trajectory.v, trajectory.u
    if isinstance(integrator, Reference) or not steps or scene.noise.diffusion is None:
        return Resolution(False)
    noisy = bool(trajectory.dw.any())
    fastest, split, steady, pulled = glance(scene.core, q, v, u, trajectory.statistics.substeps, trajectory.dt)
    if not fastest > _STILL:
        return Resolution(True)
    if split:
        return Resolution(False)
    damped = bool(_fast_damping(scene, trajectory).rate)
    # No method damps stiff modes in one step under constraints. A kinematic input of two steps is not that of a double
    # step.
    if scene.inputs or (scene.constraints and damped):
        return Resolution(False)
    if steps == 1:
        return Resolution(not (damped or noisy or pulled) and _halves_agree(scene, integrator, trajectory))
    # Springs and dampers far faster than the step do the same in a double step, which so shows no error of theirs; and
    # methods for such dampers follow jumps of the controls at nodes, which a double step averages. There the comparison
    # is with a better method in steps of the same length.
    jumps = not (steady or trajectory.u_stages.shape[1])
    other, times = integrator, 2
    if damped and not (integrator.l_stable or pulled):
        other, times = stopping(scene, _STOPPING, integrator), 1
    elif pulled or (damped and jumps):
        better = finer(integrator, trajectory, damped=damped, pulled=pulled)
        if better.parts != 1:
            return Resolution(False)
        other, times = better.method, 1
    # Ringing after the start or a jump may last long: windows all over the motion.
    begins, length = _windows(trajectory, every=times == 2 or not (pulled or integrator.l_stable))
    commands, drift = open_loop(u[:length:times]), np.zeros((0, 0, scene.robot.dof))
    if not steady:
        # All paths have the same commands; their forces may differ.
        held = u[begins[:, None] + np.arange(length)].reshape(len(begins), length // times, times, -1)
        commands, drift = open_loop(np.zeros_like(u[:length:times])), held.mean(axis=2) @ scene.actuation.T
    kicks = None
    if noisy:
        before, after = impulses_at(scene, integrator, trajectory, begins[:, None] + np.arange(length))
        if times == 2 and integrator.holds_noise:
            before, after = before[:, ::2] + before[:, 1::2], after[:, ::2]
        elif times == 2:
            # Half of the kick in the middle of a double step comes before and half after it, which gives the same
            # position and momentum at its end to first order in the step.
            half = 0.5 * (after[:, ::2] + before[:, 1::2])
            before, after = before[:, ::2] + half, half + after[:, 1::2]
        kicks = np.stack([before, after], axis=2)
    if trajectory.u_stages.shape[1]:
        again = _windows_under(scene, integrator, trajectory, begins, length, other, times, kicks)
    else:
        again = other.motions(scene, q[begins], v[begins], commands, drift, times * trajectory.dt, kicks)
    if times == 1 and not (jumps or pulled) and again is not None:
        # Every second node alone: after a single step the transient of a start off the slow motion remains.
        again = np.ascontiguousarray(again[0][:, 1::2]), np.ascontiguousarray(again[1][:, 1::2])
    if again is None:
        return Resolution(False)

    def agree(gain: float, gain_of_velocity: float) -> bool:
        return _agree(scene, (q, v), begins, length, trajectory.dt, again, gain, gain_of_velocity)

    # Factor between the difference and the motion's error: that of a double step, unknown of another method. Errors in
    # damped velocities after jumps decay soon; errors that last show in positions.
    less = 1.0 if damped or times == 1 else 2.0**integrator.order - 1.0
    of_velocity = 1.0 / _PASSING if damped and jumps and not pulled else less / _MARGIN
    if not agree(less / _MARGIN, of_velocity):
        return Resolution(False)
    # Errors of oscillations may add up from window to window over the whole motion.
    windows = length / steps
    in_phase = agree(less * PHASE_WARNED / WRONG_MOTION * windows / _ADDS, of_velocity)
    most = less * NEAR * GROWTH_WARNED / WRONG_MOTION * windows
    predictable = in_phase and agree(most / growth_bound(scene, trajectory), of_velocity)
    return Resolution(True, in_phase, predictable)


def _windows(trajectory: Trajectory, *, every: bool) -> tuple[Integers, int]:
    """First nodes of windows (K,) and their number of steps, which is even.

    With ``every``, windows cover the motion up to a largest number of them; else a part of it, where the repetition
    costs more a step.
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
        begins = np.union1d(begins, violent_windows(v, length))
    elif not every:
        seen = np.zeros(steps, dtype=np.bool_)
        for begin in begins.tolist():
            seen[begin : begin + length] = True
        begins = np.union1d(begins, np.array(violent_windows(v, length, seen)[:1], dtype=np.int64))
    return begins, length


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
    """Whether windows of q and v agree with their repetition ``again`` within ``gain`` times the error thresholds.

    The repetition has nodes after each step, or after each second one.
    """
    return windows_agree(
        scene.core,
        *nodes,
        begins,
        length,
        dt,
        *again,
        travel=gain * WRONG_MOTION,
        velocity=gain_of_velocity * WRONG_VELOCITY,
        little=LITTLE,
        light=LIGHT,
        even=EVEN,
    )


def _halves_agree(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> bool:
    """:func:`resolution_of` for a single step: two half steps make the same motion."""
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
    """Windows of a motion with controls that change within steps, repeated by another method or in double steps."""
    at, mine, found = other.stage_times, integrator.stage_times, []
    for window, begin in enumerate(begins):
        values = trajectory.u_stages[begin : begin + length]
        commands = changing(in_parts(values, mine, 1, at) if times == 1 else in_pairs(values, mine, at), at)
        node = slice(begin, begin + 1)
        given = commands, scene.no_drift, times * trajectory.dt
        kick = None if kicks is None else kicks[window : window + 1]
        again = other.motions(scene, trajectory.q[node], trajectory.v[node], *given, kick)
        if again is None:
            return None
        found.append(again)
    q, v = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return q, v


def motion_error(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> MotionError | None:
    """The largest error of a motion, from windows repeated from their first nodes by a method of more stages.

    Windows begin at the start, where velocities change most, and at nodes spread over the motion; more are examined if
    errors come close to the thresholds. Each covers a period of each joint, or as much as is predictable. Each joint's
    error is in units of its own motion. The search ends at the first error above its threshold, or after a number of
    steps in proportion to the motion's own. Growth of errors over many periods is not part of it. None where nothing
    moves, and for an integrator that chooses its own steps.
    """
    if isinstance(integrator, Reference) or not trajectory.steps:
        return None
    substeps = trajectory.statistics.substeps
    fastest, _, _, pulled = glance(scene.core, trajectory.q, trajectory.v, trajectory.u, substeps, trajectory.dt)
    if not fastest > _STILL:
        return None
    damped = bool(_fast_damping(scene, trajectory).rate)
    other = finer(integrator, trajectory, damped=damped, pulled=pulled, constrained=bool(scene.constraints))
    # Steps divided by guards are repeated in parts of the same length.
    parts = other.parts * shortest_parts(trajectory)
    first = examined_nodes(scene, trajectory)
    inertia = inertias(scene, trajectory.q[first])
    # Steps whose error is known to be small, and how large it may be there in q and in v.
    small, within = np.zeros(trajectory.steps, dtype=np.bool_), np.zeros((2, trajectory.q.shape[1]))
    left = LEAST_WORK + WORK * int(np.maximum(substeps, 1).sum())
    # Nodes near the first node of an examined window.
    seen = np.zeros(trajectory.steps + 1, dtype=np.bool_)
    worst = None
    for chosen in (first, nodes_between(trajectory.steps, first)):
        for step in chosen.tolist():
            if seen[step]:
                continue
            window = Window.at(scene, trajectory, step)
            if chosen is first and small[step : step + int(window.judged.max())].all():
                # An error that is small for this motion may be large for a slower one after it.
                units = window.units(scene, trajectory, inertia)
                if (within < _SMALL * units).all():
                    continue
            estimate = _estimate(scene, integrator, trajectory, window, inertia, other, parts, left)
            if estimate is None:
                continue
            near = min(_NEAR_BY, int(window.judged.max()) // 8)
            seen[max(0, step - near) : step + near + 1] = True
            left -= estimate.work
            if worst is None or estimate.error.worst > worst.worst:
                worst = estimate.error
            if is_wrong(estimate.error) or left <= 0:
                return worst
            if estimate.error.worst < _SMALL:
                small[step : step + estimate.known] = True
                units = window.units(scene, trajectory, inertia)
                within = np.maximum(within, estimate.error.worst * units)
        if worst is None or worst.worst < _NEAR:
            break
    return worst


def is_wrong(error: MotionError) -> bool:
    """Whether an error exceeds its threshold."""
    return not error.worst <= (CAUTION if error.settled else _CAUTION_IF_ROUGH)


@dataclass(frozen=True)
class _Estimate:
    """An estimate of the error in one window.

    Attributes:
        error: The error.
        known: The number of predictable steps.
        work: Number of steps taken for it.
    """

    error: MotionError
    known: int
    work: int


def _estimate(
    scene: Scene,
    integrator: Integrator,
    trajectory: Trajectory,
    window: Window,
    inertia: Floats,
    other: Finer,
    parts: Integers,
    most: int,
) -> _Estimate | None:
    """The error in one window, by at most ``most`` steps; None where it cannot be estimated.

    ``parts`` (N,) are those in which each step of the motion is repeated.
    """
    times = integrator.stage_times
    judged = int(window.judged.max())
    # Half of the steps, for the disturbed motion takes as many.
    affordable = int(np.searchsorted(np.cumsum(parts[window.step : window.step + judged]), most // 2, side="right"))
    count = min(judged, max(1, affordable))
    parts = parts[window.step : window.step + count]
    q, v = (values[window.step : window.step + count + 1] for values in (trajectory.q, trajectory.v))
    if noise_left_out(scene, integrator, trajectory):
        # Of both motions.
        plain = taken_again(scene, integrator, trajectory, times, window.step, count, parts // other.parts)
        if plain is None:
            return None
        q, v = plain
    again = Again(scene, other.method, trajectory, times, window.step, count, parts)
    far = _FAR * float(np.ptp(q, axis=0).max())
    # A motion that is far off is wrong or unpredictable: the repetition ends.
    while not again.ended and np.abs(again.q[again.done] - q[again.done]).max() <= far:
        again.go_on()
    known, work = again.done, again.work
    if not known:
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        off = [np.abs(a - b) / (1.0 - other.left) for a, b in ((q, again.q), (v, again.v))]
    # The error of a part of a period is extrapolated to the whole only if the repetition ran out of steps.
    cut = known < count
    error = window.error(scene, trajectory, inertia, (off[0][: known + 1], off[1][: known + 1]), cut=cut)
    if not error.worst < _SMALL:
        shift = disturbance(trajectory, window.step, known)
        beside = Again(scene, other.method, trajectory, times, window.step, known, parts[:known], shift)
        predictable = 0
        while not beside.ended and predictable == beside.done:
            beside.go_on()
            # Constraints may move the disturbed start by more than the disturbance.
            apart = max(shift[0], float(np.abs(beside.q[0] - again.q[0]).max()))
            predictable = grown(again.q[: beside.done + 1], beside.q[: beside.done + 1], apart)
        work += beside.work
        if predictable < known:
            known, cut = max(1, predictable), True
            error = window.error(scene, trajectory, inertia, (off[0][: known + 1], off[1][: known + 1]), cut=True)
    if max(float(np.ptp(x[: known + 1], axis=0).max()) for x in (q, again.q)) < _SHORTEST:
        return None
    return _Estimate(replace(error, settled=cut or count == judged), known, work)
