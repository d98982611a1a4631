"""Figures of trajectories, and of speed against accuracy, in one style.

Figures are made without pyplot: nothing is shown, registered or configured globally. Save one with
``figure.savefig("motion.png")``; a notebook displays it as the value of a cell.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle, islice, product
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.model import Robot, joint_unit, require_robot
from varpin.show.given import motion_of, problem_of
from varpin.support.checks import count, tuple_of
from varpin.trajectory import Trajectory, kinematic_input_rows, require_trajectory, scene_indices

if TYPE_CHECKING:
    # Imported for types alone: plotting a joint needs no optimizer.
    from varpin.control import Solution
    from varpin.control.mpc import MpcRun
    from varpin.estimation import Identification
    from varpin.study.record import Study

Motion: TypeAlias = "Trajectory | Solution | MpcRun"

# Okabe and Ito's palette for colour-blind readers, without its yellow, which is faint on white.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
DASHES: tuple[Any, ...] = ("-", "--", ":", "-.", (0, (6, 1, 1, 1, 1, 1)), (0, (9, 3)))
# Entry of the legend for the limits, and the share of the motion's range within which limits are drawn.
_LIMITS, _NEAR = "limits", 0.3
# Rows of a column of the legend.
_LEGEND_ROWS = 20
# Look of a line that marks a value.
_MARK: dict[str, Any] = {"color": "0.6", "linewidth": 0.8, "linestyle": "--", "zorder": 1}


class Line(NamedTuple):
    """What a line shows: its name, the quantity and the unit."""

    name: str
    what: str
    unit: str


def plot_joints(
    trajectory: Motion, axes: Axes | None = None, *, robot: Robot | None = None
) -> tuple[Figure | SubFigure, Axes]:
    """Joint positions over time.

    Args:
        trajectory: The motion, or a plan or a controller's run that has one.
        axes: Where to draw; a new figure if left out.
        robot: The robot of the motion. With it, labels have the units of the joints, rad or m, and limits near the
            motion are dotted lines.

    Returns:
        The figure and its axes.

    Raises:
        InputError: ``trajectory`` is none, ``axes`` are none of matplotlib's, or ``robot`` is none or has other joints
            than the trajectory.
    """
    trajectory = _require_motion(trajectory, robot)
    limits = None if robot is None else robot.position_limits
    return _draw(trajectory, trajectory.q, _of_joints(trajectory, robot, "position", ("rad", "m")), axes, limits)


def plot_velocities(
    trajectory: Motion, axes: Axes | None = None, *, robot: Robot | None = None
) -> tuple[Figure | SubFigure, Axes]:
    """Joint velocities over time; arguments as for :func:`plot_joints`."""
    trajectory = _require_motion(trajectory, robot)
    limits = None if robot is None else (-robot.velocity_limit, robot.velocity_limit)
    return _draw(trajectory, trajectory.v, _of_joints(trajectory, robot, "velocity", ("rad/s", "m/s")), axes, limits)


def plot_error(
    trajectory: Motion, axes: Axes | None = None, *, robot: Robot | None = None
) -> tuple[Figure | SubFigure, Axes]:
    """The estimated error of q over time, of a checked motion; arguments as for :func:`plot_joints`."""
    trajectory = _require_motion(trajectory, robot)
    if trajectory.error is None:
        raise InputError("the motion has no error: it was simulated with check=False")
    lines = _of_joints(trajectory, robot, "estimated error", ("rad", "m"))
    figure, axes = _draw(trajectory, trajectory.error, lines, axes)
    if trajectory.error.any():
        # The error is zero at the start.
        axes.set_yscale("log")
    return figure, axes


def plot_controls(
    trajectory: Motion, axes: Axes | None = None, *, robot: Robot | None = None
) -> tuple[Figure | SubFigure, Axes]:
    """Controls over time: step functions, or lines where they are linear between nodes; as :func:`plot_joints`.

    Controls of position servos and kinematic inputs are commanded positions [rad or m]; the second control of a cubic
    input is a velocity [rad/s or m/s]. A control of several joints is named u1, u2, ... Others are in N m or N; limits
    are efforts, or positions for servos, or a plan's control limits.
    """
    problem, trajectory = problem_of(trajectory), _require_motion(trajectory, robot)
    limits, lines, joints = None, *_of_controls(trajectory, robot)
    if problem is not None:
        limits = tuple(problem.control_limits)
    elif robot is not None and lines and -1 not in joints and len({line.what for line in lines}) == 1:
        lower, upper = (
            robot.position_limits if lines[0].what != "control" else (-robot.effort_limit, robot.effort_limit)
        )
        limits = lower[joints], upper[joints]
    linear = trajectory.u_nodes.shape[1] > 0
    return _draw(trajectory, trajectory.u_nodes if linear else trajectory.u, lines, axes, limits, steps=not linear)


def plot_energy_error(trajectory: Motion, axes: Axes | None = None) -> tuple[Figure | SubFigure, Axes]:
    """Change of the energy [J], which is an error if no force drives or damps the robot; as :func:`plot_joints`."""
    trajectory = _require_motion(trajectory, None)
    figure, axes = _axes(axes)
    axes.axhline(0.0, color="0.75", linewidth=0.8, zorder=1)
    change = trajectory.energy - trajectory.energy[0]
    axes.plot(trajectory.t, change, label="energy", color=COLORS[0], linewidth=1.2)
    _finish(axes, trajectory, "E(t) - E(0) [J]")
    return figure, axes


def plot_trajectory(trajectory: Motion, *, robot: Robot | None = None) -> tuple[Figure, NDArray[Any]]:
    """Positions, velocities, controls unless all are 0, and energy; arguments as for :func:`plot_joints`."""
    given, trajectory = trajectory, _require_motion(trajectory, robot)
    draw = [plot_joints, plot_velocities, *([plot_controls] if np.any(trajectory.u) else [])]
    figure = Figure(figsize=(9.0, 2.5 * (len(draw) + 1)), layout="constrained")
    panels = figure.subplots(len(draw) + 1, 1, sharex=True)
    for plot, panel in zip(draw, panels, strict=False):
        plot(given, panel, robot=robot)
        panel.set_xlabel("")
    plot_energy_error(trajectory, panels[-1])
    off = f", {trajectory.error_text} rad or m" if trajectory.error_text else ""
    figure.suptitle(f"{trajectory.robot}: {trajectory.integrator}, dt = {trajectory.dt:g} s{off}", fontsize="large")
    _share_legend(figure, panels[: len(draw)])
    figure.align_ylabels()
    return figure, panels


def _share_legend(figure: Figure, panels: NDArray[Any]) -> None:
    """One legend for all panels; that of one panel would push the others apart."""
    shared: dict[str, Any] = {}
    for panel in panels:
        handles, names = panel.get_legend_handles_labels()
        shared |= {name: handle for name, handle in zip(names, handles, strict=True) if name not in shared}
        if panel.get_legend() is not None:
            panel.get_legend().remove()
    if len(shared) > 1:
        figure.legend(shared.values(), shared.keys(), loc="outside right upper", frameon=False, fontsize="small")


def plot_study(study: Study[Any], axes: Axes | None = None, *, quantity: str = "") -> tuple[Figure | SubFigure, Axes]:
    """What a study measured over time: a line for each method, circles on the Pareto front.

    A grey line marks the error of the reference.

    Args:
        study: From :func:`varpin.work_precision` or :func:`varpin.optimal_control_tradeoff`.
        axes: Where to draw; a new figure if left out.
        quantity: For work and precision ``"q"``, the largest error in q over the motion, or ``"energy"``, that of the
            energy of a conservative motion. Errors below that of the reference are drawn on its line.

    Returns:
        The figure and its axes.

    Raises:
        InputError: Another ``study`` or ``quantity``, or no run has such a value.
    """
    if not hasattr(study, "quantities"):
        raise InputError(f"this figure is of a study, as from varpin.work_precision, got {type(study).__name__}")
    labels, front = study.axes(quantity), study.pareto(quantity)
    if not front:
        raise InputError("no run has such a value, so there is nothing to plot")
    figure, axes = _axes(axes)
    names = list(dict.fromkeys(run.integrator for run in study.runs))
    for name, style in zip(names, _styles(len(names)), strict=True):
        runs = [run for run in study.runs if run.integrator == name]
        values = [study.value_of(run, quantity) for run in runs]
        axes.plot([run.seconds for run in runs], values, label=name, marker="o", markersize=4, **style)
    ring: dict[str, Any] = {"marker": "o", "markersize": 9, "markerfacecolor": "none", "color": "0.3", "zorder": 1}
    unbeaten = [run.seconds for run in front], [study.value_of(run, quantity) for run in front]
    axes.plot(*unbeaten, label="Pareto front", linestyle="none", **ring)
    axes.set(xscale="log", yscale="log" if study.logarithmic else "linear")
    floor: float = getattr(study, "reference_error", 0.0)
    if floor > 0.0 and quantity in ("", "q"):
        axes.axhline(floor, label="error of the reference", **_MARK)
    apply_style(axes)
    axes.legend(frameon=False, fontsize="small")
    axes.set(xlabel=labels[0], ylabel=labels[1])
    return figure, axes


def plot_identification(
    found: Identification, joints: str | Sequence[str] | None = None, *, log: int = 0
) -> tuple[Figure, NDArray[Any]]:
    """Measured positions of a log, and those of the motion before and after the identification; below, residuals.

    Args:
        found: From :func:`varpin.identify`.
        joints: Names of joints; all if left out.
        log: Index of the log in ``found.logs``.

    Returns:
        The figure and its panels: one for each joint, whose range is that of the samples, and one of residuals.

    Raises:
        InputError: ``found`` is no identification, or has no such log.
        UnknownJoint: There is no such joint.
    """
    if not hasattr(found, "predicted_before"):
        raise InputError(f"this figure is of an identification, from varpin.identify, got {type(found).__name__}")
    if count("log", log) >= len(found.logs):
        raise InputError(f"log must be the index of one of the {len(found.logs)} logs, got {log}")
    robot, given = found.scene.robot, (joints,) if isinstance(joints, str) else joints
    names = robot.joint_names if given is None else tuple_of("joints", given, str)
    chosen, t, samples = [robot.coordinate(name) for name in names], found.logs[log].t, found.logs[log].q
    figure = Figure(figsize=(9.0, 1.7 * len(chosen) + 2.5), layout="constrained")
    panels = figure.subplots(len(chosen) + 1, 1, sharex=True, height_ratios=[*[2] * len(chosen), 3])
    for c, panel, style in zip(chosen, panels, _styles(len(chosen)), strict=False):
        panel.plot(t, samples[:, c], ".", label="measured", color="0.7", markersize=6)
        panel.set_ylim(panel.get_ylim())  # the motion before may be far away
        panel.plot(t, found.predicted_before[log][:, c], label="before", color="0.4", linestyle="--", linewidth=1.0)
        panel.plot(t, found.predicted[log][:, c], label="after", color="black", linewidth=0.8)
        panel.set_title(robot.joint_names[c], loc="left", fontsize="small")
        panel.set_ylabel(f"q [{joint_unit(robot, c)}]")
        panels[-1].plot(t, found.residuals[log][:, c], label=robot.joint_names[c], **{**style, "linewidth": 0.8})
    panels[-1].set(xlabel="time [s]", ylabel=f"residual [{joint_unit(robot, chosen)}]", xlim=(t[0], t[-1]))
    for panel in panels:
        apply_style(panel)
    _share_legend(figure, panels)
    figure.align_ylabels()
    return figure, panels


def apply_style(axes: Axes) -> None:
    """Apply the style of varpin's figures: a faint grid below everything, no frame at the top and the right.

    Raises:
        InputError: ``axes`` are none of matplotlib's.
    """
    _require_axes(axes)
    axes.set_prop_cycle(color=COLORS)
    axes.grid(visible=True, color="0.92", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _draw(
    trajectory: Trajectory,
    values: Floats,
    lines: Sequence[Line],
    axes: Axes | None,
    limits: tuple[Floats, Floats] | None = None,
    *,
    steps: bool = False,
) -> tuple[Figure | SubFigure, Axes]:
    """Values at nodes (N + 1, k), or over ``steps`` (N, k); names of lines tell what these do not have in common."""
    figure, axes = _axes(axes)
    whats = list(dict.fromkeys(line.what for line in lines))
    units = list(dict.fromkeys(line.unit for line in lines))
    for row, line, style in zip(values.T, lines, _styles(len(lines)), strict=True):
        name = line.name + (f", {line.what}" if len(whats) > 1 else "") + (f" [{line.unit}]" if len(units) > 1 else "")
        if steps:
            axes.step(trajectory.t, np.append(row, row[-1:]), where="post", label=name, **style)
        else:
            axes.plot(trajectory.t, row, label=name, **style)
    if limits is not None:
        _draw_limits(axes, values, limits)
    _finish(axes, trajectory, f"{whats[0] if len(whats) == 1 else 'control'} [{', '.join(units) or '1'}]")
    return figure, axes


def _of_joints(trajectory: Trajectory, robot: Robot | None, what: str, units: tuple[str, str]) -> list[Line]:
    """A line for each joint; ``units`` are those of a revolute and of a prismatic joint."""
    slides = [None] * len(trajectory.joint_names) if robot is None else robot.slides.tolist()
    return [
        Line(name, what, " or ".join(units) if slide is None else units[int(slide)])
        for name, slide in zip(trajectory.joint_names, slides, strict=True)
    ]


def _of_controls(trajectory: Trajectory, robot: Robot | None) -> tuple[list[Line], list[int]]:
    """A line for each control (m,), and the joint that it acts on alone, or -1."""
    forces, positions, rates = (
        _of_joints(trajectory, robot, what, units)
        for what, units in (
            ("control", ("N m", "N")),
            ("commanded position", ("rad", "m")),
            ("velocity", ("rad/s", "m/s")),
        )
    )
    lines = [Line(f"u{k + 1}", "control", "N m or N") for k in range(trajectory.u.shape[1])]
    joints = [-1] * len(lines)
    actuation = trajectory.scene_values.get("actuation", np.zeros((0, 0)))
    # A file may have an actuation of another shape.
    if actuation.shape != (len(forces), len(lines)):
        return lines, joints
    inputs = kinematic_input_rows(trajectory).tolist()
    placed = {joint for joint, *_ in [*inputs, *scene_indices(trajectory, "PositionServo", 1).tolist()]}
    for control, column in enumerate(actuation.T):
        acts = np.flatnonzero(column)
        if len(acts) == 1:
            joints[control] = joint = int(acts[0])
            lines[control] = (positions if joint in placed else forces)[joint]
    for joint, _, control in inputs:
        # The velocity of a cubic input is a control of its own, whose column is 0.
        if 0 <= control < len(lines) and 0 <= joint < len(rates) and not actuation[:, control].any():
            joints[control], lines[control] = joint, rates[joint]
    return lines, joints


def _draw_limits(axes: Axes, values: Floats, limits: tuple[Floats, Floats]) -> None:
    """Draw limits as dotted lines in the colours of their joints, if values (N, k) come near them or pass them.

    Distant limits would compress the motion.
    """
    if not values.size:
        return
    low, high = float(values.min()), float(values.max())
    near = _NEAR * (high - low)
    across, dots = axes.get_yaxis_transform(), (0, (1, 2))
    look: dict[str, Any] = {"transform": across, "linewidth": 0.9, "linestyle": dots, "zorder": 1}
    drawn = False
    for k, style in enumerate(_styles(values.shape[1])):
        for limit in (limits[0][k], limits[1][k]):
            if low - near <= limit <= high + near:
                # hlines adds a collection: the axes' lines are the joints.
                axes.hlines(limit, 0.0, 1.0, color=style["color"], **look)
                drawn = True
    if drawn:
        # The entry of the legend, of no joint's colour.
        axes.hlines([], 0.0, 1.0, color="0.3", label=_LIMITS, **look)


def _axes(axes: Axes | None) -> tuple[Figure | SubFigure, Axes]:
    if axes is None:
        figure = Figure(figsize=(8.0, 4.5), layout="constrained")
        return figure, figure.subplots()
    _require_axes(axes)
    return axes.figure, axes


def _require_axes(axes: object) -> None:
    if not isinstance(axes, Axes):
        raise InputError(f"axes must be matplotlib's, such as matplotlib.figure.Figure().subplots(), got {axes!r}")


def _require_motion(given: object, robot: Robot | None) -> Trajectory:
    """The motion; refuses anything but a trajectory, a plan and a run, and a robot that is not the motion's."""
    motion = require_trajectory(motion_of(given))
    if robot is not None and require_robot(robot).joint_names != motion.joint_names:
        raise InputError(
            f"robot {robot.name!r} has joints {', '.join(robot.joint_names)}; "
            f"the trajectory has {', '.join(motion.joint_names)}"
        )
    return motion


def _styles(lines: int) -> list[dict[str, Any]]:
    """Distinct line styles: all colours, then all colours dashed, and so on."""
    kinds = cycle(product(DASHES, COLORS))
    return [{"color": color, "linestyle": dash, "linewidth": 1.4} for dash, color in islice(kinds, lines)]


def _finish(axes: Axes, trajectory: Trajectory, label: str) -> None:
    axes.set_xlabel("time [s]")
    axes.set_ylabel(label)
    apply_style(axes)
    if trajectory.duration > 0.0:
        axes.set_xlim(trajectory.t[0], trajectory.t[-1])
    else:
        # A line with one point is invisible without a marker.
        for line in axes.lines:
            line.set_marker("o")
    entries = axes.get_legend_handles_labels()[1]
    if len(entries) > 1:
        place: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0)}
        axes.legend(frameon=False, fontsize="small", ncols=-(-len(entries) // _LEGEND_ROWS), **place)
