"""The check of a finished motion: its error, from one repetition, and what is doubtful about it.

A motion that is clearly right is let pass by :mod:`varpin.simulation.gate`. Any other motion is repeated as a whole
from its start by the method of :func:`closer`, under the same controls and the same noise. The distance between both is
the error of the motion, up to the far smaller one of the repetition: :attr:`varpin.Trajectory.error`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numpy as np

from varpin.arrays import Floats, Integers
from varpin.core.arrays import Commands
from varpin.errors import AssemblyError, ControlError, SingularMassMatrix
from varpin.finding import Finding
from varpin.integrators import Gauss, Integrator, Radau, Reference, RungeKutta4
from varpin.integrators.base import drifts, noise_impulses
from varpin.integrators.collocation import MOST_STAGES
from varpin.integrators.reference import TIGHTEST
from varpin.mechanics.constraints import CustomConstraintError
from varpin.mechanics.custom import CustomForceError
from varpin.mechanics.scene import Scene
from varpin.model import joint_unit
from varpin.signals.commands import changing, cubics, in_parts, in_parts_of_steps, open_loop, prescribing, rows, shares
from varpin.signals.controls import Controls, commands_of
from varpin.signals.functions import ControlLaw, Copies, Sampled, decision, left_by_stages
from varpin.signals.policy import FirstOrderHold, LinearPolicy, OpenLoop
from varpin.simulation.gate import proven_error
from varpin.simulation.limits import beyond_limits
from varpin.simulation.spectrum import contact_rate, fastest_rate, speed_scales, travel_scales
from varpin.simulation.start import finer
from varpin.simulation.velocity_noise import wrong_spread
from varpin.trajectory import Trajectory

# Errors from which on a motion is told of: of q as a share of the largest travel of its kind, of v as a share of the
# joint's largest speed. Motions off by 5 % are wrong and those off by 0.3 % are right for any use: between 0.5 and 4 %
# the same of 400 random motions are told of.
TOLD, TOLD_VELOCITY = 0.01, 0.25
# Shares of the travel up to which errors grow as small ones do, and tell what reduces them; from 0.05 to 0.3.
_LINEAR = 0.1
# Growth of deviations from which on a motion is told to be sensitive; from 3e3 to 2e4: swings of chains reach 2e3 in a
# hundred seconds, falls of arms 1e5 in two.
_SENSITIVE = 1e4
# The share that a better step should leave.
_AIM = 0.2
# Most parts of a step that are named; the order of motions with kinks in forces.
_MOST_PARTS, _KINKED = 10, 2
# What polynomials may leave of a function of time, as a share of its largest value, for the motion's own residual to
# show its error: a third order of it is lost.
_RESOLVED = 0.02
# The rate of dampers and stops that a step resolves, in units of 1 / dt: with 1 to 3 the same advice is right.
_RINGS = 2.0
# Points of a step at which a custom force is looked at: none are more than 8 % of the step's travel apart.
_POINTS = 20
# Steps of one joint between two checks for Ctrl-C: a tenth of a second.
_CHUNK = 100_000


@np.errstate(over="ignore", invalid="ignore")
def check(
    scene: Scene,
    integrator: Integrator,
    trajectory: Trajectory,
    controls: Controls | Commands = None,
    *,
    restart: int = 0,
    known: Floats | None = None,
    hold: int = 0,
    law: Copies | None = None,
) -> Trajectory:
    """The motion with its error and its warnings, the worst first.

    Args:
        scene: The scene of the motion.
        integrator: The integrator of the motion.
        trajectory: The motion, without warnings.
        controls: Those that the record does not have whole: functions of time, lines, feedback.
        restart: Steps after which a controller corrects errors: the repetition begins anew there; 0 for none.
        known: The error, if it is known (N + 1, n): nothing is repeated.
        hold: The period of a control law in steps, 0 for none.
        law: What makes copies of the law as it was before the motion; None if it cannot be copied.
    """
    function = controls if isinstance(controls, Sampled) else None
    extremes = None if function is None else function.whole.extremes
    limits = beyond_limits(scene, trajectory, extremes)
    if trajectory.noisy:
        limits = [*wrong_spread(scene, integrator, trajectory), *limits]
    if not trajectory.steps:
        known = np.zeros_like(trajectory.q)
    if known is not None:
        return trajectory.with_error(known).changed(warnings=tuple(limits))
    held_mean = isinstance(controls, FirstOrderHold) and not integrator.stage_times
    if noise_unknown(scene, integrator, trajectory):
        text = "the error is not known: a repetition cannot have this noise. Use kick='held'"
        return trajectory.changed(warnings=(Finding("error", text), *limits))
    # A function of time would be called again for parts of a step, at whatever time the error is asked for.
    calls = isinstance(controls, OpenLoop) and closer(scene, integrator, trajectory, sampled=True)[1] > 1
    resolved = function is None or left_by_stages(function, len(integrator.stage_times)) <= _RESOLVED
    # What a law makes of an error, only its calls show.
    alone = resolved and not (held_mean or calls or hold)
    proven = proven_error(scene, integrator, trajectory) if alone else None

    def repeat(shift: float = 0.0) -> tuple[Floats, Floats, float]:
        return repeated(scene, integrator, trajectory, controls, restart, law and law(), hold, shift)

    found: tuple[Finding, ...] = ()
    if proven is not None:
        motion = trajectory.with_error(lambda: distance(repeat(), trajectory)[0], proven)
    else:
        try:
            again = repeat()
            off, speed_off = distance(again, trajectory)

            def rounded() -> Floats:
                last_digit = float(np.spacing(max(1.0, np.abs(trajectory.q[0]).max())))
                return np.abs(repeat(math.sqrt(trajectory.steps) * last_digit)[0] - again[0])

            found = error_findings(scene, integrator, trajectory, off, speed_off, rounded, controls, hold)
            found = found or short_forces(scene, integrator, trajectory)
        except (CustomForceError, CustomConstraintError) as error:
            off = np.full_like(trajectory.q, np.nan)
            text = f"the error is not known: a function of the scene fails in the repetition, {error.__cause__!r:.80}"
            found = (Finding("error", text),)
        motion = trajectory.with_error(off)
    return motion.changed(warnings=(*found, *limits))


def more_stages(integrator: Integrator) -> int:
    """Two stages more than a collocation of the order of a method has."""
    return (integrator.order + 1) // 2 + 2


def distance(again: tuple[Floats, Floats, float], trajectory: Trajectory) -> tuple[Floats, Floats]:
    """Errors of q and v at all nodes (N + 1, n), from a repetition that has a share ``again[2]`` of them."""
    q, v, left = again
    share = abs(1.0 - left)
    return np.abs(q - trajectory.q) / share, np.abs(v - trajectory.v) / share


def closer(
    scene: Scene, integrator: Integrator, trajectory: Trajectory, *, fed: bool = False, sampled: bool = False
) -> tuple[Integrator, int, float]:
    """The method of a repetition, its steps in one of the motion's, and the share of the motion's error that it has.

    Two stages more than the motion's order needs, of Radau, which does not ring. More stages resolve neither kinks nor
    fast dampers: those take half steps, too. Runge-Kutta's method halves its step, and is for controls ``fed`` back on
    (q, v), but not for functions of time that are ``sampled``.
    """
    # Steps that guards divided are as many shorter ones.
    taken = np.maximum(trajectory.statistics.substeps, 1).sum() / max(trajectory.steps, 1)
    sharp = integrator.l_stable or scene.elements or scene.couplings or scene.custom is not None
    parts = (2 if sharp else 1) << math.ceil(math.log2(max(1.0, taken)))
    if isinstance(integrator, Reference):
        factor = 0.1 if 0.1 * integrator.rtol >= TIGHTEST else 10.0
        other = Reference(factor * integrator.rtol, None if integrator.atol is None else factor * integrator.atol)
        return other, 1, factor
    if trajectory.noisy and integrator.kicks_after:
        return integrator, 2, 0.5
    own = isinstance(integrator, RungeKutta4)
    if (own and not sampled) or (fed and not integrator.variational):
        return RungeKutta4(), 2 * parts, (2.0 * parts) ** -integrator.order if own else 0.0
    stages = more_stages(integrator)
    if stages > MOST_STAGES:
        stages, parts = MOST_STAGES, 2 * parts
    kick = integrator.kick
    return (Gauss(stages, kick=kick) if scene.constraints else Radau(stages, kick=kick)), parts, 0.0


def repeated(
    scene: Scene,
    integrator: Integrator,
    trajectory: Trajectory,
    controls: Controls | Commands = None,
    restart: int = 0,
    law: ControlLaw | None = None,
    hold: int = 0,
    shift: float = 0.0,
) -> tuple[Floats, Floats, float]:
    """A motion repeated by the method of :func:`closer`: q and v (N + 1, n), NaN where it failed; and its share.

    The arguments are those of :func:`check`. A ``law`` replaces the controls, every ``hold`` steps. The start is off by
    ``shift`` [rad or m].
    """
    fed = isinstance(controls, LinearPolicy) or (isinstance(controls, Commands) and len(controls.gains) > 0)
    method, parts, left = closer(scene, integrator, trajectory, fed=fed, sampled=isinstance(controls, OpenLoop))
    q, v = np.full((2, *trajectory.q.shape), np.nan)
    q[0], v[0] = trajectory.q[0] + shift, trajectory.v[0]
    commands = _commands(scene, integrator, method, trajectory, controls, parts)
    drawn, kicks = _noise(scene, integrator, method, trajectory, parts)
    drift = None
    if scene.noise.velocity_dependent:
        drift = method.drift_share * np.repeat(drifts(scene, trajectory), parts, axis=0)[None]
    try:
        state, (last,) = method.start(scene, q[:1], v[:1])
    except (SingularMassMatrix, AssemblyError):
        return q, v, left
    longest = max(1, _CHUNK // (len(q[0]) * parts * commands.hold)) * commands.hold
    chunk, steps, done = (restart or (longest if law is None else hold)) * parts, trajectory.steps * parts, 0
    for first in range(0, steps, chunk):
        taken = slice(first, min(first + chunk, steps))
        if restart and first:
            state, _ = method.start(scene, trajectory.q[done : done + 1], trajectory.v[done : done + 1])
        if law is not None:
            try:
                u = decision(law, scene, done, done * trajectory.dt, q[done], v[done])
            except ControlError:
                break
            period = hold * trajectory.dt
            u = in_parts_of_steps(scene, u, q[None, done], v[None, done], period, chunk)
            block = open_loop(u[: taken.stop - first])
        else:
            before = last.u[None, -1] if first else None
            block = rows(commands, first // commands.hold, -(-taken.stop // commands.hold), before)
        (last,) = method.rollout(
            scene,
            state,
            block,
            drawn[:, taken],
            trajectory.dt / parts,
            drift=None if drift is None else drift[:, taken],
            impulses=None if kicks is None else kicks[:, taken],
        )
        new = len(last.q) // parts
        for nodes, values in ((q, last.q), (v, last.v)):
            nodes[done + 1 : done + new + 1] = values[parts - 1 :: parts][:new]
        done += new
        if last.failure is not None:
            break
    return q, v, left


def _commands(
    scene: Scene,
    integrator: Integrator,
    method: Integrator,
    trajectory: Trajectory,
    controls: Controls | Commands,
    parts: int,
) -> Commands:
    """The controls of a motion for a repetition by another method, in so many parts of each step."""
    dt, times = trajectory.dt / parts, method.stage_times
    if trajectory.u_nodes.shape[1]:
        controls = FirstOrderHold(trajectory.u_nodes)
    if isinstance(controls, FirstOrderHold):
        controls = None if scene.inputs else controls.refined(parts)
    if isinstance(controls, FirstOrderHold | OpenLoop):
        return commands_of(scene, method, controls, trajectory.steps * parts, dt)
    alike = method.variational == integrator.variational
    if isinstance(controls, LinearPolicy) and alike:
        controls = commands_of(scene, method, controls, trajectory.steps, trajectory.dt)
    if isinstance(controls, Commands) and alike:
        return controls._replace(hold=controls.hold * parts)
    held = open_loop(in_parts_of_steps(scene, trajectory.u, trajectory.q[:-1], trajectory.v[:-1], trajectory.dt, parts))
    if not trajectory.u_stages.shape[1]:
        return held
    within = in_parts(trajectory.u_stages, integrator.stage_times, parts, times)
    return prescribing(scene, changing(within, times), held.u)


def noise_unknown(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> bool:
    """Whether a repetition cannot have the noise of a motion, so that its error stays unknown."""
    if not trajectory.noisy or integrator.holds_noise:
        return False
    if scene.noise.velocity_dependent and integrator.kick == "split":
        return True
    return bool(scene.constraints and trajectory.dw.shape[1] > scene.processes)


def _noise(
    scene: Scene, integrator: Integrator, method: Integrator, trajectory: Trajectory, parts: int
) -> tuple[Floats, Floats | None]:
    """The noise of a motion for a repetition: increments (1, N parts, k), or impulses (1, N parts, 2, n)."""
    if not trajectory.noisy:
        return scene.silence, None
    N, n = trajectory.steps, trajectory.q.shape[1]
    if scene.constraints and not method.holds_noise:
        drawn = np.zeros((1, N * parts, trajectory.dw.shape[1]))
        drawn[0, ::parts] = trajectory.dw
        return drawn, None
    before = 0.0 if integrator.kicks_after else integrator.left

    def impulses(share: float, node: Integers) -> Floats:
        at = trajectory.q[node], trajectory.v[node]
        return share * noise_impulses(scene, trajectory, *at) if share else np.zeros((N, n))

    found = np.zeros((N, parts, 2, n))
    if method.holds_noise:
        found[:, :, 0] = impulses(before, np.arange(N))[:, None] / parts
    else:
        found[:, 0, 0] = impulses(before, np.arange(N))
        found[:, -1, 1] = impulses(1.0 - before, np.arange(1, N + 1))
    return scene.silence, found.reshape(1, N * parts, 2, n)


def error_findings(
    scene: Scene,
    integrator: Integrator,
    trajectory: Trajectory,
    off: Floats,
    speed_off: Floats,
    rounded: Callable[[], Floats],
    controls: Controls | Commands = None,
    hold: int = 0,
) -> tuple[Finding, ...]:
    """The warning of a motion's error, if it is large, from errors of q and v at its nodes (N + 1, n).

    Its time is the last one until which the motion, ended there, would have no warning of q. ``rounded`` finds how far
    the rounding of all steps takes q at the nodes apart (N + 1, n).
    """
    cure = functools.partial(_cure, scene, integrator, trajectory, controls, hold)
    last = int(np.append(np.isfinite(off).all(axis=1), False).argmin())
    names, t = trajectory.joint_names, trajectory.t
    q, v = trajectory.q[:last], trajectory.v[:last]
    travel, speed = travel_scales(scene, q), speed_scales(scene, v)
    shares = np.maximum.accumulate(off[:last]) / travel
    joint = int(shares[-1].argmax())
    share = float(shares[-1, joint])
    if share > TOLD:
        right = int(np.flatnonzero((shares <= TOLD).all(axis=1))[-1])
        unit = joint_unit(scene.robot, joint)
        value = float(off[:last, joint].max())
        part = f", {100.0 * share:.2g} % of the largest travel" if share < 0.99 else ""
        text = (
            f"q is off by up to {value:.2g} {unit}{part} (joint {names[joint]!r}, wrong after t = {t[right]:.3g} s). "
        )
        if share <= _LINEAR:
            advice = cure(share / TOLD)
        else:
            apart = np.maximum.accumulate(rounded()[:last])
            growth, drift = float(apart[-1].max() / apart[right].max()), (apart / travel).max(axis=1)
            advice = cure(max(share / TOLD, growth))
            if drift[-1] > TOLD:
                shorter = f"a shorter duration, as even rounding errors grow to {apart[-1, joint]:.2g} {unit}"
                advice = f"Use {shorter}" if drift[right + 1] > TOLD else f"{advice} and {shorter}"
            elif growth > _SENSITIVE:
                advice += f", as deviations grow more than {_SENSITIVE:g}-fold"
        return (Finding("error", text + advice, names[joint], time=float(t[right]), value=value, unit=unit),)
    # A jump that comes a part of a step too late is no error of the motion.
    lasting = np.minimum(speed_off[: last - 1], speed_off[1:last]) / speed
    if len(lasting) and lasting.max() > TOLD_VELOCITY:
        first, joint = divmod(int(lasting.argmax()), lasting.shape[1])
        unit = joint_unit(scene.robot, joint, speed=True)
        value, most = float(speed_off[first, joint]), float(np.abs(v[:, joint]).max())
        text = (
            f"the velocity of joint {names[joint]!r} is off by up to {value:.2g} {unit}, beside {most:.2g} at most "
            f"(t = {t[first]:.3g} s). {cure(float(lasting[first, joint]) / TOLD_VELOCITY)}"
        )
        return (Finding("error", text, names[joint], time=float(t[first]), value=value, unit=unit),)
    if last < len(off):
        text = (
            f"the error is not known from t = {t[last]:.3g} s on: a method of more stages fails there. Use a smaller dt"
        )
        return (Finding("error", text, time=float(t[last])),)
    return ()


def _cure(
    scene: Scene,
    integrator: Integrator,
    trajectory: Trajectory,
    controls: Controls | Commands,
    hold: int,
    excess: float,
) -> str:
    """What reduces an error that exceeds its threshold by a factor ``excess``; laws and policies keep their periods."""
    q, v, most = trajectory.q, trajectory.v, _RINGS / trajectory.dt
    contact = contact_rate(scene, q, v, trajectory.dt)
    # Radau damps what noise excites, too.
    damped_by_others = not (integrator.l_stable or scene.constraints or contact > most or trajectory.noisy)
    if damped_by_others and fastest_rate(scene, q, v, trajectory.u, most) > 0.0:
        return "Damping or friction is faster than the step: use integrator=varpin.Radau(4)"
    if isinstance(integrator, Reference):
        return "Use a smaller rtol"
    stages = more_stages(integrator)
    if isinstance(controls, Sampled) and left_by_stages(controls, stages) > _RESOLVED:
        return "The controls change faster than the step. Use a smaller dt"
    # Kinks of forces cost any method its order.
    order = integrator.order if scene.smooth else min(integrator.order, _KINKED)
    need = max(excess, 1.0) / _AIM
    times = need ** (1.0 / order)
    kept = isinstance(controls, LinearPolicy) and not integrator.variational
    kept |= trajectory.noisy and integrator.l_stable
    kept |= stages > MOST_STAGES or not (scene.smooth or not scene.elements)
    either = kept or times < _MOST_PARTS
    if not either:
        # Of a low order smaller steps take too many. The fewest stages to which half of the step is enough:
        stages = min(max(stages, math.ceil(0.5 * math.log2(need))), MOST_STAGES)
        times = need ** (0.5 / stages)
    parts = max(2.0, min(times, _MOST_PARTS), contact / most)
    parts, smaller = finer(trajectory, math.ceil(parts))
    if hold:
        smaller += f" with period={hold * parts}"
    elif isinstance(controls, LinearPolicy) and controls.period is None:
        smaller += f" with hold={controls.hold * parts} in the policy"
    if contact > most:
        return f"Stops are stiffer than the step resolves. Use {smaller}"
    if kept:
        return f"Use {smaller}"
    other = f"integrator=varpin.{'Radau' if integrator.l_stable else 'Gauss'}({stages})"
    if either:
        return f"Use {other} or {smaller}"
    return f"Use {other} and {smaller}" if times > 2.0 else f"Use {other}"


def short_forces(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Finding, ...]:
    """A warning if stages miss the impulse of a custom force along the cubics through the nodes."""
    force = scene.custom
    if force is None or not trajectory.steps:
        return ()
    times = integrator.stage_times or (0.5,)
    x, weights = np.polynomial.legendre.leggauss(_POINTS)
    q, v, dt = trajectory.q, trajectory.v, trajectory.dt
    along = cubics(np.concatenate([np.array(times), 0.5 * (1.0 + x)]), dt)
    missed = np.zeros((trajectory.steps, q.shape[1]))
    for k in range(trajectory.steps):
        ends = np.stack([v[k], q[k + 1] - q[k], v[k + 1]])
        at, rate = q[k] + along[:, 1:4] @ ends, along[:, 5:] @ ends
        found = np.array([force(*state, False)[0] for state in zip(at, rate, strict=True)])
        missed[k] = dt * (0.5 * weights @ found[len(times) :] - shares(times) @ found[: len(times)])
    speeds = np.abs(np.linalg.solve(scene.core.jets(q[:-1], v[:-1])[0], missed[:, :, None])[:, :, 0])
    off = speeds * (trajectory.t[-1] - trajectory.t[:-1, None]) / travel_scales(scene, q)[-1]
    step, joint = divmod(int(off.argmax()), off.shape[1])
    if not off[step, joint] > TOLD:
        return ()
    name, time = trajectory.joint_names[joint], float(trajectory.t[step])
    value, unit = float(np.abs(missed[step]).max()), "N s" if scene.robot.slides[joint] else "N m s"
    text = (
        f"CustomForce {force.names} acts for less than a step on joint {name!r} (t = {time:.3g} s): the stages miss "
        f"{value:.2g} {unit} of its impulse. Use a smaller dt"
    )
    return (Finding("short force", text, name, time=time, value=value, unit=unit),)
