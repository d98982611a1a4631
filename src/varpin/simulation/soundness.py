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

from varpin.core import doubled_steps_agree, energy_turnover, fastest_damping, pulls_fast
from varpin.errors import SingularMassMatrix
from varpin.integrators import ExplicitEuler, Integrator, Radau, Reference
from varpin.integrators.base import open_loop
from varpin.integrators.explicit import accelerations
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.scene import Scene
from varpin.simulation.accuracy import (
    CLOSE,
    EVEN,
    FIRST,
    LIGHT,
    LITTLE,
    WINDOW,
    WRONG_ENERGY,
    WRONG_MOTION,
    WRONG_VELOCITY,
    MotionError,
    Place,
    between,
    blows,
    disturbance,
    grown,
    inertias,
    places,
)
from varpin.simulation.chatter import RUN, Alternation, alternation
from varpin.simulation.limits import left
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# What is spoken of, as part of what is wrong: estimates are made good to some percent.
CAUTION = 0.95
# Estimates up to this factor from what is wrong are made good; others are beyond doubt. Those that do not settle are
# spoken of from this part of what is wrong on. Those of a part of a period are in doubt from here on.
_DOUBT, _UNSETTLED, _DOUBT_OF_PART = 3.0, 0.7, 0.03
# Where estimates settle: from one halving to the next they change by less than this part; after so many at most.
_SETTLED, _HALVINGS = 0.1, 3
# Steps taken for that at most: so many of one joint, or so many times the motion's own.
_LEAST_WORK, _WORK = 200_000, 2
# Windows that are taken again in steps of twice the length, beside those where velocities change most; and how many
# times the error of a window counts, for over a period it grows.
_WINDOWS, _MARGIN = 16, 8.0
# What they are taken again with where dampers are faster than the step.
_STOPPING = Radau(3)
# Nodes at which mass matrices, and energies of single groups, are looked at; and rates of dampers.
_NODES, _INERTIAS = 16, 4
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
    if isinstance(integrator, Reference) or count * parts > max(4 * FIRST, int(trajectory.statistics.substeps.sum())):
        return False
    again = _taken_again(scene, integrator, trajectory, place, count, parts)
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
    """Says which limits of the robot's description the motion leaves; the motion itself may be right."""
    return tuple(Finding(kind, sentence) for kind, sentence in left(scene, trajectory))


def _in_parts(trajectory: Trajectory) -> str:
    """How many steps were taken in parts, in words; empty if none."""
    split = trajectory.statistics.split_steps
    if not split:
        return ""
    most = trajectory.statistics.substeps.max()
    return f"{split} of {trajectory.steps} steps were taken in up to {most} parts"


def _fast_damping(scene: Scene, trajectory: Trajectory) -> float:
    """The fastest rate of the dampers [1/s] if a step cannot resolve it, else 0."""
    if not scene.dissipates or not trajectory.steps:
        return 0.0
    # Rates change along the motion as the inertia does.
    at = [i * trajectory.steps // (_INERTIAS - 1) for i in range(_INERTIAS)]
    return fastest_damping(scene.core, *_nodes_of(scene, trajectory, at), 2.0 / trajectory.dt)


def _nodes_of(scene: Scene, trajectory: Trajectory, at: list[int]) -> tuple[Floats, Floats, Floats]:
    """q, v and the constant forces of the controls (K, n) at some nodes."""
    controls = trajectory.u[np.minimum(at, trajectory.steps - 1)]
    return trajectory.q[at], trajectory.v[at], np.ascontiguousarray(controls @ scene.actuation.T)


def _applied(scene: Scene, trajectory: Trajectory) -> Floats:
    """Constant forces of the controls in each step (N, n)."""
    return np.ascontiguousarray(trajectory.u @ scene.actuation.T)


def _ringing(rate: float, dt: float) -> str:
    return (
        f"damping is faster than the step (dt * {rate:.3g}/s = {dt * rate:.3g} > 2): velocities that it should stop "
        "will ring; "
        f"dt below {2.0 / rate:.3g} s resolves it, varpin.Radau(3) stops them"
    )


def _looked_for(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Finding, ...]:
    """What the balance of the energy and steps taken again tell."""
    if not trajectory.steps:
        return ()
    found = [*_energy(scene, integrator, trajectory)]
    if resolved(scene, integrator, trajectory):
        return tuple(found)
    error = motion_error(scene, integrator, trajectory)
    if error is not None and spoken_of(error):
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
        own = scene.group == group
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
    return _turnover(scene, trajectory)[0]


def _turnover(scene: Scene, trajectory: Trajectory) -> tuple[float, Floats, Floats]:
    """:func:`energy_scale`; and of each joint (n,) [J] the energies that it is made of.

    The kinetic energy of the largest change of its velocity, for all it has to move; and the controls' work.
    """
    kinetic, work, turned, worked = energy_turnover(
        scene.core, trajectory.q, trajectory.v, trajectory.p, trajectory.u, trajectory.dt, even=EVEN, looks=_NODES
    )
    return min(kinetic, float(turned.sum())) + work, turned, worked


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

    What servos make of their controls counts among what is taken.

    Controls are constant over a step, and do the work of its way. A kick of v (N, n) begins each step. Dampers take
    least where the velocity is even, and q knows its mean: so does all other friction there.
    """
    h, before, after = trajectory.dt, trajectory.v[:-1] + kicked, trajectory.v[1:]
    with np.errstate(over="ignore", invalid="ignore"):
        way = np.diff(trajectory.q, axis=0)
        force = _applied(scene, trajectory)
        work = force * way
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


def resolved(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> bool:
    """Whether even steps of twice the length make the same motion, so that there is nothing more to look for.

    Windows all over the motion, or some of them, are taken again from their first nodes, all at once. That takes half
    as long as the motion, or less; a motion of whole steps without noise can pass.
    """
    steps, q, v, u = trajectory.steps, trajectory.q, trajectory.v, trajectory.u
    # Windows of like lengths, which are even.
    pieces = min(-(-steps // WINDOW), _WINDOWS)
    length = min(WINDOW, 2 * -(-steps // (2 * pieces)), steps - steps % 2) if pieces else 0
    if isinstance(integrator, Reference) or not length or trajectory.dw.any() or scene.noise.diffusion is None:
        return False
    if not np.abs(v).max() > _STILL:
        return True
    # Springs far faster than the step do as little in two.
    if trajectory.statistics.split_steps or pulls_fast(
        scene.core, *_nodes_of(scene, trajectory, [0, trajectory.steps]), trajectory.dt
    ):
        return False
    # So do dampers, but not where what they stop is at rest after a step, whatever its length. Other methods are held
    # against that in steps as long as theirs.
    damped = bool(_fast_damping(scene, trajectory))
    other, times = _STOPPING if damped else integrator, 1 if damped and not integrator.l_stable else 2
    apart = max(pieces, 1 + steps % 2) - 1
    begins = np.array(sorted({i * (steps - length) // max(apart, 1) for i in range(apart + 1)}))
    if pieces == _WINDOWS:
        begins = np.union1d(begins, blows(v, length))
    commands, drift = open_loop(u[:length:times]), np.zeros((0, 0, scene.robot.dof))
    if (u != u[0]).any():
        # Commands are the same for all paths; their forces need not be.
        held = u[begins[:, None] + np.arange(length)].reshape(len(begins), length // times, times, -1)
        commands, drift = open_loop(np.zeros_like(u[:length:times])), held.mean(axis=2) @ scene.actuation.T
    again = other.motions(scene, q[begins], v[begins], commands, drift, times * trajectory.dt)
    if times == 1 and again is not None:
        again = np.ascontiguousarray(again[0][:, 1::2]), np.ascontiguousarray(again[1][:, 1::2])
    # How much less the error is in steps of half the length; of another method nothing is known.
    gain = (1.0 if damped else 2.0**integrator.order - 1.0) / _MARGIN
    return again is not None and doubled_steps_agree(
        scene.core,
        q,
        v,
        begins,
        length,
        trajectory.dt,
        *again,
        way=gain * WRONG_MOTION,
        velocity=gain * WRONG_VELOCITY,
        little=LITTLE,
        light=LIGHT,
        even=EVEN,
    )


def motion_error(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> MotionError | None:
    """The error of a motion, by taking parts of it again from their first nodes, in steps of half the length.

    The start, the places where velocities change most and some spread over the motion are looked at, over a period of
    each joint or what can be had of it; more places where errors come close to what is wrong. Each joint is judged in
    units of its own motion. Where that leaves doubt whether it is wrong, steps are halved again until the estimate
    settles. It says nothing of how errors grow over many
    periods. None where nothing moves, and for an integrator that chooses its own steps.
    """
    moved = np.abs(trajectory.v).max(initial=0.0)
    if isinstance(integrator, Reference) or not trajectory.steps or not moved > _STILL:
        return None
    steps = places(scene, trajectory)
    inertia = inertias(scene, trajectory.q[steps])
    # Half a step is as little as a whole one to dampers that are far faster.
    fast = trajectory.dt * _fast_damping(scene, trajectory)
    finer = int(2 ** np.clip(np.ceil(np.log2(max(1.0, fast))), 0, 3))
    left = max(_LEAST_WORK // scene.robot.dof, _WORK * int(trajectory.statistics.substeps.sum()))
    worst = None
    for chosen in (steps, between(trajectory.steps, steps)):
        looks = []
        for step in chosen:
            place = Place.at(scene, trajectory, int(step))
            look = _look(scene, integrator, trajectory, place, inertia, finer)
            if look is not None and look.doubtful and not look.whole:
                whole = _look(scene, integrator, trajectory, place, inertia, finer, left)
                look = whole or look
                left -= 0 if whole is None else whole.work
            if look is not None:
                looks.append((place, look))
        looks.sort(key=lambda pair: -pair[1].error.worst)
        for place, look in looks:
            error = look.error
            if look.doubtful:
                error, work = _settled(scene, integrator, trajectory, place, inertia, finer, look, left)
                left -= work
            if worst is None or error.worst > worst.worst:
                worst = error
            if spoken_of(error):
                return error
        if worst is None or worst.worst < CLOSE:
            break
    return worst


def spoken_of(error: MotionError) -> bool:
    """Whether an error is worth a word."""
    return not error.worst <= (CAUTION if error.settled else _UNSETTLED)


@dataclass(frozen=True)
class _Look:
    """An estimate of the error at one place.

    Attributes:
        error: The error.
        whole: Whether it is of a period, or of all that can be told of it, and not of a part that stands for it.
        known: How many steps can be told.
        work: Steps taken for it.
    """

    error: MotionError
    whole: bool
    known: int
    work: int

    @property
    def doubtful(self) -> bool:
        """Whether the error itself may be on the other side of what is wrong."""
        low, high = (1.0 / _DOUBT, _DOUBT) if self.whole else (_DOUBT_OF_PART, np.inf)
        return low < self.error.worst < high


def _settled(
    scene: Scene,
    integrator: Integrator,
    trajectory: Trajectory,
    place: Place,
    inertia: Floats,
    finer: int,
    look: _Look,
    most: int,
) -> tuple[MotionError, int]:
    """The error at a place by ever smaller steps, over a period, and how many steps that took."""
    spent = 0
    for halving in range(1, _HALVINGS + 1):
        known = look.known if look.whole else None
        again = _look(scene, integrator, trajectory, place, inertia, finer * 2**halving, most - spent, known)
        if again is None:
            break
        spent += again.work
        change = abs(again.error.worst - look.error.worst)
        if not again.doubtful or (look.whole and again.whole and change <= _SETTLED * again.error.worst):
            return again.error, spent
        look = again
    return replace(look.error, settled=False), spent


def _look(
    scene: Scene,
    integrator: Integrator,
    trajectory: Trajectory,
    place: Place,
    inertia: Floats,
    finer: int,
    most: int | None = None,
    known: int | None = None,
) -> _Look | None:
    """The error at one place, with at most so many steps; None where steps cannot be taken again.

    How many steps of the motion can be told need not be found out twice.
    """
    count, parts = _affordable(trajectory, place, finer, most)
    if not parts:
        return None
    again = _taken_again(scene, integrator, trajectory, place.step, count, parts)
    if again is None:
        return None
    steps = slice(place.step, place.step + count + 1)
    recorded = trajectory.q[steps], trajectory.v[steps]
    if scene.noise.diffusion is None and trajectory.dw.any():
        # Kicks that only Python knows are left out of both.
        plain = _taken_again(scene, integrator, trajectory, place.step, count, parts // (2 * finer))
        if plain is None:
            return None
        recorded = plain
    # The part of the error that is left with the smaller steps.
    taken = np.maximum(trajectory.statistics.substeps[steps][:count], 1)
    left = float(parts) ** -integrator.order / np.mean(1.0 / taken.astype(float) ** integrator.order)
    work = count * parts
    if known is None:
        moved = disturbance(trajectory, place.step, count)
        # In small steps as well: guards may take the large ones of the two in different parts.
        other = _taken_again(scene, integrator, trajectory, place.step, count, parts, moved)
        known = 1 if other is None else grown(again[0], other[0], moved[0])
        work *= 2
    known = min(known, count)
    with np.errstate(over="ignore", invalid="ignore"):
        q, v = (np.abs(a - b)[: known + 1] / (1.0 - left) for a, b in zip(recorded, again, strict=True))
    error = place.error(scene, trajectory, inertia, (q, v), cut=known < count)
    return _Look(error, known < count or count >= int(place.judged.max()), known, work)


def _affordable(trajectory: Trajectory, place: Place, finer: int, most: int | None) -> tuple[int, int]:
    """How many steps are taken again, each in how many parts; (0, 0) for none.

    These are half of what they were taken in, or that part of it again where dampers are faster.

    The work is at most ``most``; if that is left out, that of some hundreds of steps or an eighth of the motion's own,
    and then a part has to do for a period.
    """
    substeps = np.maximum(trajectory.statistics.substeps, 1)
    count = int(place.judged.max())
    if most is None:
        length = FIRST if place.step == 0 else WINDOW
        count, most = min(length, count), max(4 * length, int(substeps.sum()) // 8)
    parts = 2 * finer * np.maximum.accumulate(substeps[place.step : place.step + count])
    affordable = parts * np.arange(1, len(parts) + 1) <= most
    if not affordable[0]:
        return 0, 0
    count = len(parts) if affordable.all() else int(affordable.argmin())
    return count, int(parts[count - 1])


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
    try:
        state, _ = integrator.start(scene, q, v)
    except SingularMassMatrix:
        return None
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
