"""The check of a finished motion: its error, from one repetition, and what is doubtful about it.

A motion that is clearly right is let pass by :mod:`varpin.simulation.gate`. Any other motion is repeated as a whole
from its start by the method of :attr:`Case.closer`, under the same controls and the same noise. The distance between
both is the error of the motion, up to the far smaller one of the repetition: :attr:`varpin.Trajectory.error`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

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
from varpin.signals.functions import Copies, Sampled, decision, left_by_stages
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


@dataclass(frozen=True, eq=False)
class Case:
    """A motion of a scene by an integrator, with what its record does not have.

    Attributes:
        controls: Functions of time, lines, feedback.
        restart: Steps after which a controller corrects errors: the repetition begins anew there; 0 for none.
        hold: The period of a control law in steps, 0 for none.
        law: What makes copies of the law as it was before the motion; None if it cannot be copied.
    """

    scene: Scene
    integrator: Integrator
    trajectory: Trajectory
    controls: Controls | Commands = None
    restart: int = 0
    hold: int = 0
    law: Copies | None = None

    @functools.cached_property
    def closer(self) -> tuple[Integrator, int, float]:
        """The method of a repetition, its steps in one of the motion's, and its share of the motion's error.

        Two stages more than the motion's order needs, of Radau, which does not ring. More stages resolve neither kinks
        nor fast dampers: those take half steps, too. Runge-Kutta's method halves its step, and is for controls fed back
        on (q, v), but not for functions of time.
        """
        scene, integrator, trajectory, controls = self.scene, self.integrator, self.trajectory, self.controls
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
        fed = isinstance(controls, LinearPolicy) or (isinstance(controls, Commands) and len(controls.gains) > 0)
        own = isinstance(integrator, RungeKutta4)
        if (own and not isinstance(controls, OpenLoop)) or (fed and not integrator.variational):
            return RungeKutta4(), 2 * parts, (2.0 * parts) ** -integrator.order if own else 0.0
        stages = more_stages(integrator)
        if stages > MOST_STAGES:
            stages, parts = MOST_STAGES, 2 * parts
        kick = integrator.kick
        return (Gauss(stages, kick=kick) if scene.constraints else Radau(stages, kick=kick)), parts, 0.0

    def errors(self, again: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
        """Errors of q and v at all nodes (N + 1, n), from those of the repetition."""
        (q, v), share = again, abs(1.0 - self.closer[2])
        return np.abs(q - self.trajectory.q) / share, np.abs(v - self.trajectory.v) / share

    def repetition(self, shift: float = 0.0) -> tuple[Floats, Floats]:
        """Q and v (N + 1, n) of the repetition, NaN where it failed, from a start that is off by ``shift``."""
        scene, trajectory, hold, law = self.scene, self.trajectory, self.hold, self.law and self.law()
        method, parts, _ = self.closer
        q, v = np.full((2, *trajectory.q.shape), np.nan)
        q[0], v[0] = trajectory.q[0] + shift, trajectory.v[0]
        commands, (drawn, kicks) = self._commands(), self._noise()
        drift = None
        if scene.noise.velocity_dependent:
            drift = method.drift_share * np.repeat(drifts(scene, trajectory), parts, axis=0)[None]
        try:
            state, (last,) = method.start(scene, q[:1], v[:1])
        except (SingularMassMatrix, AssemblyError):
            return q, v
        longest = max(1, _CHUNK // (len(q[0]) * parts * commands.hold)) * commands.hold
        chunk, steps, done = (self.restart or (longest if law is None else hold)) * parts, trajectory.steps * parts, 0
        for first in range(0, steps, chunk):
            taken = slice(first, min(first + chunk, steps))
            if self.restart and first:
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
        return q, v

    def _commands(self) -> Commands:
        """The controls of the motion for its repetition."""
        scene, integrator, trajectory, controls = self.scene, self.integrator, self.trajectory, self.controls
        method, parts, _ = self.closer
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
        states = trajectory.q[:-1], trajectory.v[:-1]
        held = open_loop(in_parts_of_steps(scene, trajectory.u, *states, trajectory.dt, parts))
        if not trajectory.u_stages.shape[1]:
            return held
        within = in_parts(trajectory.u_stages, integrator.stage_times, parts, times)
        return prescribing(scene, changing(within, times), held.u)

    @property
    def noise_unknown(self) -> bool:
        """Whether a repetition cannot have the noise of the motion, so that its error stays unknown."""
        if not self.trajectory.noisy or self.integrator.holds_noise:
            return False
        if self.scene.noise.velocity_dependent and self.integrator.kick == "split":
            return True
        return bool(self.scene.constraints and self.trajectory.dw.shape[1] > self.scene.processes)

    def _noise(self) -> tuple[Floats, Floats | None]:
        """The noise of the repetition: increments (1, N parts, k), or impulses (1, N parts, 2, n)."""
        scene, integrator, trajectory = self.scene, self.integrator, self.trajectory
        method, parts, _ = self.closer
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

    def findings(self, off: Floats, speed_off: Floats, rounded: Callable[[], Floats]) -> tuple[Finding, ...]:
        """The warning of a large error, from errors of q and v at the nodes (N + 1, n).

        Its time is the last one until which the motion, ended there, would have no warning of q. ``rounded`` finds how
        far the rounding of all steps takes q at the nodes apart (N + 1, n).
        """
        scene, trajectory = self.scene, self.trajectory
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
                f"q is off by up to {value:.2g} {unit}{part} (joint {names[joint]!r}, wrong after t = {t[right]:.3g} "
                "s). "
            )
            if share <= _LINEAR:
                advice = self._cure(share / TOLD)
            else:
                apart = np.maximum.accumulate(rounded()[:last])
                growth, drift = float(apart[-1].max() / apart[right].max()), (apart / travel).max(axis=1)
                advice = self._cure(max(share / TOLD, growth))
                if drift[-1] > TOLD:
                    shorter = f"a shorter duration, as even rounding errors grow to {apart[-1, joint]:.2g} {unit}"
                    advice = f"Use {shorter}" if drift[right + 1] > TOLD else f"{advice} and {shorter}"
            return (Finding("error", text + advice, names[joint], time=float(t[right]), value=value, unit=unit),)
        # A jump that comes a part of a step too late is no error of the motion.
        lasting = np.minimum(speed_off[: last - 1], speed_off[1:last]) / speed
        if len(lasting) and lasting.max() > TOLD_VELOCITY:
            first, joint = divmod(int(lasting.argmax()), lasting.shape[1])
            unit = joint_unit(scene.robot, joint, speed=True)
            value, most = float(speed_off[first, joint]), float(np.abs(v[:, joint]).max())
            text = (
                f"the velocity of joint {names[joint]!r} is off by up to {value:.2g} {unit}, beside {most:.2g} at most "
                f"(t = {t[first]:.3g} s). {self._cure(float(lasting[first, joint]) / TOLD_VELOCITY)}"
            )
            return (Finding("error", text, names[joint], time=float(t[first]), value=value, unit=unit),)
        if last < len(off):
            text = (
                f"the error is not known from t = {t[last]:.3g} s on: a method of more stages fails there. "
                f"Use {self.smaller}"
            )
            return (Finding("error", text, time=float(t[last])),)
        return ()

    @property
    def smaller(self) -> str:
        """What the caller gives for shorter steps, in words."""
        return "more Plant(substeps=)" if self.restart else "a smaller dt"

    @functools.cached_property
    def rings(self) -> str:
        """The advice where the integrator rings, or runs away, as damping is faster than the step; else empty."""
        scene, motion, most = self.scene, self.trajectory, _RINGS / self.trajectory.dt
        # Radau does not go with constraints, and damps what noise excites, too.
        if self.integrator.l_stable or scene.constraints or motion.noisy:
            return ""
        if contact_rate(scene, motion.q, motion.v, motion.dt) > most:
            return ""
        fast = fastest_rate(scene, motion.q, motion.v, motion.u, most) > 0.0
        return "Damping or friction is faster than the step: use integrator=varpin.Radau(4)" if fast else ""

    def _cure(self, excess: float) -> str:
        """What reduces an error that exceeds its threshold by a factor ``excess``, under a law of the same period."""
        scene, integrator, trajectory, controls = self.scene, self.integrator, self.trajectory, self.controls
        if self.rings:
            return self.rings
        if isinstance(integrator, Reference):
            return "Use a smaller rtol"
        stages = more_stages(integrator)
        if isinstance(controls, Sampled) and left_by_stages(controls, stages) > _RESOLVED:
            return f"The controls change faster than the step. Use {self.smaller}"
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
        stiff = contact_rate(scene, trajectory.q, trajectory.v, trajectory.dt) * trajectory.dt / _RINGS
        parts, smaller = finer(trajectory, math.ceil(max(2.0, min(times, _MOST_PARTS), stiff)), self.restart)
        if self.hold:
            smaller += f" with period={self.hold * parts}"
        elif isinstance(controls, LinearPolicy) and controls.period is None:
            smaller += f" with hold={controls.hold * parts} in the policy"
        if stiff > 1.0:
            return f"Stops are stiffer than the step resolves. Use {smaller}"
        if kept:
            return f"Use {smaller}"
        other = f"integrator=varpin.{'Radau' if integrator.l_stable else 'Gauss'}({stages})"
        if either:
            return f"Use {other} or {smaller}"
        return f"Use {other} and {smaller}" if times > 2.0 else f"Use {other}"

    def short_forces(self) -> tuple[Finding, ...]:
        """A warning if stages miss the impulse of a custom force along the cubics through the nodes."""
        scene, integrator, trajectory = self.scene, self.integrator, self.trajectory
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
            f"CustomForce {force.names} acts for less than a step on joint {name!r} (t = {time:.3g} s): the stages "
            f"miss {value:.2g} {unit} of its impulse. Use {self.smaller}"
        )
        return (Finding("short force", text, name, time=time, value=value, unit=unit),)


def more_stages(integrator: Integrator) -> int:
    """Two stages more than a collocation of the order of a method has."""
    return (integrator.order + 1) // 2 + 2


@np.errstate(over="ignore", invalid="ignore")
def check(case: Case, known: Floats | None = None) -> Trajectory:
    """The motion of a case, which has no warnings, with its error and its warnings, the worst first.

    Of a motion whose error is ``known`` (N + 1, n) nothing is repeated.
    """
    scene, integrator, trajectory, controls = case.scene, case.integrator, case.trajectory, case.controls
    function = controls if isinstance(controls, Sampled) else None
    extremes = None if function is None else function.whole.extremes
    limits = beyond_limits(scene, trajectory, extremes)
    if trajectory.noisy:
        limits = [*wrong_spread(scene, integrator, trajectory, case.smaller), *limits]
    if not trajectory.steps:
        known = np.zeros_like(trajectory.q)
    if known is not None:
        return trajectory.with_error(known).changed(warnings=tuple(limits))
    held_mean = isinstance(controls, FirstOrderHold) and not integrator.stage_times
    if case.noise_unknown:
        text = "the error is not known: a repetition cannot have this noise. Use kick='held'"
        return trajectory.changed(warnings=(Finding("error", text), *limits))
    # A function of time would be called again for parts of a step, at whatever time the error is asked for.
    calls = isinstance(controls, OpenLoop) and case.closer[1] > 1
    resolved = function is None or left_by_stages(function, len(integrator.stage_times)) <= _RESOLVED
    # What a law makes of an error, only its calls show.
    alone = resolved and not (held_mean or calls or case.hold)
    proven = proven_error(scene, integrator, trajectory) if alone else None
    if proven is not None:
        motion = trajectory.with_error(lambda: case.errors(case.repetition())[0], proven)
        return motion.changed(warnings=tuple(limits))

    try:
        again = case.repetition()
        off, speed_off = case.errors(again)

        def rounded() -> Floats:
            last_digit = float(np.spacing(max(1.0, np.abs(trajectory.q[0]).max())))
            return np.abs(case.repetition(math.sqrt(trajectory.steps) * last_digit)[0] - again[0])

        found = case.findings(off, speed_off, rounded) or case.short_forces()
    except (CustomForceError, CustomConstraintError) as error:
        off = np.full_like(trajectory.q, np.nan)
        text = f"the error is not known: a function of the scene fails in the repetition, {error.__cause__!r:.80}"
        found = (Finding("error", text),)
    return trajectory.with_error(off).changed(warnings=(*found, *limits))
