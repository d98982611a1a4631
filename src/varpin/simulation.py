"""From initial state and controls to a trajectory."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import fields
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from varpin.checks import as_floats, count, finite_array, is_one_of, positive, require_finite
from varpin.errors import InputError, VarpinError
from varpin.integrators import Integrator, Midpoint, Segment
from varpin.integrators.base import Failure, open_loop, rows, steps_of
from varpin.kernels._compile import announced_compilation
from varpin.kernels.tree import Commands
from varpin.policy import LinearPolicy
from varpin.scene import Scene, require_scene
from varpin.soundness import Finding, announce, evident, examined, with_warnings
from varpin.trajectory import StepStatistics, Trajectory
from varpin.wiener import wiener_increments

Floats = NDArray[np.float64]
ControlLaw = Callable[[float, Floats, Floats], ArrayLike]
Progress = Callable[[int, int], None]

logger = logging.getLogger(__name__)

# What a node has.
_NODES = ("q", "v", "p", "energy")
# Work between two looks at the progress callback and at Ctrl-C, in steps of one joint: some tens of milliseconds.
_CHUNK = 30_000


class Interrupted(KeyboardInterrupt):
    """Ctrl-C during a simulation.

    Attributes:
        trajectory: What was computed before it.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        self.trajectory = trajectory
        super().__init__(f"interrupted after {trajectory.steps} steps; they are in .trajectory")


class _StepError(VarpinError, ValueError):
    """A function of the user's failed in a step.

    Attributes:
        step: Index of the step.
        time: When it was called [s].
        trajectory: What was computed before.
    """

    def __init__(self, step: int, time: float, problem: str, trajectory: Trajectory) -> None:
        self.step = step
        self.time = time
        self.trajectory = trajectory
        super().__init__(f"step {step} (t = {time:.6g} s): {problem}; what came before is in error.trajectory")


class ControlError(_StepError):
    """A control function raised, or returned something that is no control.

    Attributes:
        step: Index of the step it was called for.
        time: The time it was called with [s].
        trajectory: What was computed before.
    """


class NoiseError(_StepError):
    """A function of a custom noise raised, or returned something that is no field.

    Attributes:
        step: Index of the step it was called in.
        time: The start of that step [s].
        trajectory: What was computed before.
    """


class StepFailure(VarpinError, RuntimeError):
    """The step equation could not be solved on its principal branch.

    Attributes:
        step: Index of the step that failed.
        time: Its start [s].
        residual: The last residual, in units of the rounding error of its terms.
        reason: What stopped the last attempt.
        q: Configuration at the start of the step (n,) [rad or m].
        v: Velocity there (n,).
        p: Momentum there (n,).
        trajectory: What was computed before.
    """

    def __init__(self, step: int, time: float, failure: Failure, trajectory: Trajectory) -> None:
        self.step = step
        self.time = float(time)
        self.residual = failure.residual
        self.reason = failure.reason
        self.q, self.v, self.p = trajectory.q[-1], trajectory.v[-1], trajectory.p[-1]
        self.trajectory = trajectory
        super().__init__(
            f"step {step} (t = {time:.6g} s) cannot be trusted: {failure.reason}; last residual {failure.residual:.3g} "
            f"rounding units, at q = {_row(self.q)}, v = {_row(self.v)}. What came before is in error.trajectory; "
            "a smaller dt may go further"
        )


def _row(values: Floats) -> str:
    """A vector on one line, whatever its length."""
    return "[" + ", ".join(f"{value:.6g}" for value in values) + "]"


class _Record:
    """Nodes, controls and statistics of the steps done so far; a trajectory can be made of it at any time."""

    def __init__(self, scene: Scene, integrator: Integrator, dt: float, steps: int, dw: Floats, first: Segment) -> None:
        self.scene, self.integrator, self.dt = scene, integrator, dt
        self.steps = 0
        self.dw = dw if len(dw) else np.zeros((steps, scene.processes))
        n = scene.robot.dof
        self.nodes = {name: np.empty((steps + 1, n)) for name in ("q", "v", "p")} | {"energy": np.empty(steps + 1)}
        self.u = np.empty((steps, scene.controls))
        self.statistics = {
            item.name: np.empty(steps, dtype=getattr(first.statistics, item.name).dtype)
            for item in fields(StepStatistics)
        }
        for name, array in self.nodes.items():
            array[0] = getattr(first, name)[0]

    def add(self, segment: Segment) -> None:
        now = slice(self.steps, self.steps + len(segment.q))
        for name, array in self.nodes.items():
            array[now.start + 1 : now.stop + 1] = getattr(segment, name)
        for name, array in self.statistics.items():
            array[now] = getattr(segment.statistics, name)
        self.u[now] = segment.u
        self.steps = now.stop

    def trajectory(self) -> Trajectory:
        return _trajectory(
            self.scene,
            self.integrator,
            self.dt,
            {name: array[: self.steps + 1] for name, array in self.nodes.items()},
            self.u[: self.steps],
            self.dw[: self.steps],
            StepStatistics(**{name: array[: self.steps] for name, array in self.statistics.items()}),
        )


def _trajectory(
    scene: Scene,
    integrator: Integrator,
    dt: float,
    nodes: dict[str, Floats],
    u: Floats,
    dw: Floats,
    statistics: StepStatistics,
) -> Trajectory:
    return Trajectory(
        t=np.arange(len(u) + 1, dtype=np.float64) * dt,
        q=nodes["q"],
        v=nodes["v"],
        p=nodes["p"],
        energy=nodes["energy"],
        u=u,
        dw=dw,
        masses=scene.robot.tree.mass.copy(),
        dt=dt,
        integrator=str(integrator),
        robot=scene.robot.name,
        joint_names=scene.robot.joint_names,
        statistics=statistics,
    )


class Motions:
    """Motions without noise from one state under commands of any kind; they share their work arrays."""

    def __init__(self, scene: Scene, integrator: Integrator, q0: Floats, v0: Floats, dt: float) -> None:
        self.scene, self.integrator, self.dt = scene, integrator, dt
        self._state, (self._first,) = integrator.start(scene, q0[None], v0[None])

    def under(self, commands: Commands) -> tuple[Trajectory, Failure | None]:
        """The motion, and why it stopped early, if it did; nothing is checked."""
        first, nothing = self._first, np.zeros((0, 0, self.scene.processes))
        state = self.integrator.fork(self._state)
        (steps,) = self.integrator.rollout(self.scene, state, commands, nothing, self.dt)
        nodes = {name: np.concatenate([getattr(first, name), getattr(steps, name)]) for name in _NODES}
        dw = np.zeros((len(steps.u), self.scene.processes))
        made = _trajectory(self.scene, self.integrator, self.dt, nodes, steps.u, dw, steps.statistics)
        return made, steps.failure


def rollout(
    scene: Scene, integrator: Integrator, q0: Floats, v0: Floats, commands: Commands, dt: float
) -> tuple[Trajectory, Failure | None]:
    """One of the :class:`Motions` from (q0, v0)."""
    return Motions(scene, integrator, q0, v0, dt).under(commands)


def simulate(
    scene: Scene,
    q0: ArrayLike,
    v0: ArrayLike,
    *,
    dt: float,
    steps: int,
    controls: ArrayLike | ControlLaw | LinearPolicy | None = None,
    integrator: Integrator | None = None,
    rng: np.random.Generator | int | None = None,
    increments: ArrayLike | None = None,
    sampling: Literal["midpoint", "start"] = "midpoint",
    check: bool = True,
    progress: Progress | None = None,
) -> Trajectory:
    """Integrate a scene in time.

    Main args:
        scene: The scene.
        q0: Initial configuration (n,) [rad or m].
        v0: Initial velocity (n,) [rad/s or m/s].
        dt: Time step [s].
        steps: N, their number.
        controls: None for none; an array (N, m), one row a step; one row (m,) for all steps; a
            :class:`varpin.LinearPolicy`; or a function of (t [s], q (n,), v (n,)) that returns (m,).
            Controls are constant over each step.
        integrator: :class:`Midpoint` with alpha = 1/2 if left out.

    Other Args:
        rng: Generator or seed of the Wiener increments. Without it, and without ``increments``, they are zero.
        increments: The increments themselves, (N, k) [s^0.5], to replay or refine a path; see :mod:`varpin.wiener`.
        sampling: Where a control function is evaluated, once a step. ``"midpoint"``: at the step's midpoint, at the
            state expected there, which keeps second order. ``"start"``: at the node where the step begins, as a
            digital controller with a zero-order hold would, at the price of first order.
        check: Look at the finished motion, whether the balance of its energy closes and its steps resolve it, for
            ``Trajectory.warnings`` and the log. It takes as long as some hundreds of steps.
        progress: Called now and then with (steps done, steps in all).

    Returns:
        The trajectory, frozen.

    Raises:
        InputError: Wrong shapes, values that are not finite, dt <= 0, steps < 0.
        ControlError: The control function returned something unusable; holds the trajectory so far.
        NoiseError: A function of a CustomNoise did; holds the trajectory so far.
        StepFailure: A step has no trustworthy solution; holds the trajectory so far.
        SingularMassMatrix: M(q0) is not positive definite.
        Interrupted: Ctrl-C; holds the trajectory so far. It is a KeyboardInterrupt.
    """
    n = require_scene(scene).robot.dof
    q0, v0 = finite_array("q0", q0, (n,)), finite_array("v0", v0, (n,))
    dt, steps = positive("dt", dt, "s"), count("steps", steps)
    if not is_one_of(sampling, ("midpoint", "start")):
        raise InputError(f"sampling must be 'midpoint' or 'start', got {sampling!r}")
    integrator = Midpoint() if integrator is None else integrator
    if not isinstance(integrator, Integrator):
        raise InputError(f"integrator must be one of varpin's, for example varpin.Midpoint(), got {integrator!r}")
    law = controls if callable(controls) else None
    _require_memory(scene, steps)
    given = (None, 0) if callable(controls) else (controls, steps)
    commands = commands_of(scene, integrator, *given)
    dw = wiener_increments(scene.processes, dt, steps, rng, increments)
    with announced_compilation(f"simulate with {type(integrator).__name__}"):
        state, (start,) = integrator.start(scene, q0[None], v0[None])
        record = _Record(scene, integrator, dt, steps, dw, start)
        # A sweep takes as long as the robot has joints, an elimination as their cube.
        chunk = max(1, _CHUNK // (n + n**3 // 100))
        # One step at a time where Python functions are called, so that what came before one that fails is recorded.
        stepwise = law is not None or scene.noise.diffusion is None
        try:
            while record.steps < steps:
                if law is not None:
                    block = open_loop(_sample(law, sampling, integrator, state, record))
                elif stepwise:
                    block = _next(commands, record)
                else:
                    first = record.steps // commands.hold
                    before = record.u[None, record.steps - 1] if record.steps else None
                    block = rows(commands, first, first + max(1, chunk // commands.hold), before)
                drawn = dw[None, record.steps : record.steps + steps_of(block)] if len(dw) else dw[None, :0][:0]
                try:
                    (segment,) = integrator.rollout(scene, state, block, drawn, dt)
                except InputError as error:
                    now = record.trajectory()
                    raise NoiseError(now.steps, float(now.t[-1]), str(error), now) from error.__cause__
                record.add(segment)
                if segment.failure is not None:
                    node = record.trajectory()
                    raise StepFailure(node.steps, node.t[-1], segment.failure, node)
                if progress is not None and (not stepwise or record.steps % chunk == 0 or record.steps == steps):
                    progress(record.steps, steps)
        except KeyboardInterrupt:
            raise Interrupted(_told(scene, integrator, record.trajectory(), check=check)[0]) from None
        trajectory, found = _told(scene, integrator, record.trajectory(), check=check)
    announce(logger, scene, dt, found)
    return trajectory


def _told(
    scene: Scene, integrator: Integrator, trajectory: Trajectory, *, check: bool
) -> tuple[Trajectory, tuple[Finding, ...]]:
    """A whole motion with what is to be said of it."""
    if check:
        return examined(scene, integrator, trajectory)
    found = evident(scene, trajectory)
    return with_warnings(trajectory, found), found


def _require_memory(scene: Scene, steps: int) -> None:
    """Refuse a number of steps whose record cannot be held, before anything runs."""
    columns = 3 * scene.robot.dof + 2 * scene.controls + len(fields(StepStatistics)) + 2
    try:
        np.empty((steps + 1, columns))
    except (MemoryError, ValueError, OverflowError):
        raise InputError(f"steps = {steps} needs more memory than there is: {columns * 8} bytes a step") from None


def commands_of(
    scene: Scene, integrator: Integrator, controls: ArrayLike | LinearPolicy | None, steps: int
) -> Commands:
    """Controls of ``steps`` steps as kernels take them: None, (steps, m), (m,) or a policy."""
    if isinstance(controls, LinearPolicy):
        return controls.commands(steps, scene.controls, scene.robot.dof, integrator.variational)
    return open_loop(control_rows(scene, controls, steps))


def control_rows(scene: Scene, controls: ArrayLike | None, steps: int) -> Floats:
    """Controls as one row a step, (steps, m).

    Raises:
        InputError: The array is neither (steps, m) nor (m,), or not finite.
    """
    shape = (steps, scene.controls)
    if controls is None:
        return np.zeros(shape)
    array = as_floats("controls", controls)
    if array.shape != shape and array.shape != shape[1:]:
        raise InputError(f"controls must have shape {shape}, one row a step, or {shape[1:]}, got {array.shape}")
    # A copy: to numba a view that must not be written to is another type, and every kernel would be compiled anew.
    return np.broadcast_to(require_finite("controls", array), shape).copy()


def _next(commands: Commands, record: _Record) -> Commands:
    """The command of the next step alone: a decision, or the control of the last one while it is held."""
    decision, held = divmod(record.steps, commands.hold)
    if held:
        return open_loop(record.u[record.steps - 1 : record.steps])
    before = record.u[None, record.steps - 1] if record.steps else None
    return rows(commands, decision, decision + 1, before)._replace(hold=1)


def _sample(law: ControlLaw, sampling: str, integrator: Integrator, state: Any, record: _Record) -> Floats:
    """The control of the next step, (1, m), from a control function."""
    k, dt = record.steps, record.dt
    if sampling == "start":
        time, q, v = k * dt, record.nodes["q"][k].copy(), record.nodes["v"][k].copy()
    else:
        time, (q, v) = (k + 0.5) * dt, integrator.predict(state, dt)
    try:
        value = law(time, q, v)
    except Exception as error:
        raise ControlError(k, time, f"controls(t, q, v) raised {error!r}", record.trajectory()) from error
    try:
        return finite_array("controls(t, q, v)", value, (record.scene.controls,))[None]
    except InputError as error:
        raise ControlError(k, time, str(error), record.trajectory()) from None
