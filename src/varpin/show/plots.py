"""Figures of trajectories, and of speed against accuracy, in one style.

Figures are made without pyplot: nothing is shown, registered or configured globally. Save one with
``figure.savefig("motion.png")``; a notebook displays it as the value of a cell.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.model import Robot, joint_unit, require_robot
from varpin.show.given import motion_of, problem_of, require_joints
from varpin.support.checks import count, tuple_of
from varpin.trajectory import Trajectory, kinematic_input_rows, require_trajectory, scene_indices

if TYPE_CHECKING:
    # Imported for types alone: plotting a joint needs no optimizer.
    from varpin.control import Solution
    from varpin.control.mpc import MpcRun
    from varpin.estimation import Identification
    from varpin.study.record import Study

Motion: TypeAlias = "Trajectory | Solution | MpcRun"
Drawn: TypeAlias = tuple[Figure | SubFigure, Axes]

# Okabe and Ito's palette for colour-blind readers, without its yellow, which is faint on white.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
DASHES: tuple[Any, ...] = ("-", "--", ":", "-.", (0, (6, 1, 1, 1, 1, 1)), (0, (9, 3)))
# Entry of the legend for the limits, and the share of the motion's range within which limits are drawn.
_LIMITS, _NEAR = "limits", 0.3
# Rows of a column of the legend.
_LEGEND_ROWS = 20
# Units of quantities, of a revolute and of a prismatic joint.
_UNITS = {
    "position": ("rad", "m"),
    "commanded position": ("rad", "m"),
    "estimated error": ("rad", "m"),
    "velocity": ("rad/s", "m/s"),
    "control": ("N m", "N"),
}
# Width of a line of a motion, in points.
_WIDTH = 1.4
# Look of a line that marks a value.
_MARK: dict[str, Any] = {"color": "0.6", "linewidth": 0.8, "linestyle": "--", "zorder": 1}


class Line(NamedTuple):
    """What a line shows: its name, the quantity and the unit."""

    name: str
    what: str
    unit: str


def plot_joints(trajectory: Motion, axes: Axes | None = None, *, robot: Robot | None = None) -> Drawn:
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
    return _draw(trajectory, trajectory.q, _of_joints(trajectory, robot, "position"), axes, limits)


def plot_velocities(trajectory: Motion, axes: Axes | None = None, *, robot: Robot | None = None) -> Drawn:
    """Joint velocities over time; arguments as for :func:`plot_joints`."""
    trajectory = _require_motion(trajectory, robot)
    limits = None if robot is None else (-robot.velocity_limit, robot.velocity_limit)
    return _draw(trajectory, trajectory.v, _of_joints(trajectory, robot, "velocity"), axes, limits)


def plot_controls(trajectory: Motion, axes: Axes | None = None, *, robot: Robot | None = None) -> Drawn:
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


def plot_energy_error(trajectory: Motion, axes: Axes | None = None) -> Drawn:
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


def plot_study(study: Study[Any], axes: Axes | None = None, *, quantity: str = "") -> Drawn:
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
    for name in dict.fromkeys(run.integrator for run in study.runs):
        runs = [run for run in study.runs if run.integrator == name]
        values = [study.value_of(run, quantity) for run in runs]
        seconds = [run.seconds for run in runs]
        axes.plot(seconds, values, label=name, marker="o", markersize=4, linewidth=_WIDTH)
    ring: dict[str, Any] = {"marker": "o", "markersize": 9, "markerfacecolor": "none", "color": "0.3", "zorder": 1}
    unbeaten = [run.seconds for run in front], [study.value_of(run, quantity) for run in front]
    axes.plot(*unbeaten, label="Pareto front", linestyle="none", **ring)
    axes.set(xscale="log", yscale="log" if study.logarithmic else "linear")
    floor: float = getattr(study, "reference_error", 0.0)
    if floor > 0.0 and quantity in ("", "q"):
        axes.axhline(floor, label="error of the reference", **_MARK)
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
    for panel in panels:
        apply_style(panel)
    for c, panel in zip(chosen, panels, strict=False):
        panel.plot(t, samples[:, c], ".", label="measured", color="0.7", markersize=6)
        panel.set_ylim(panel.get_ylim())  # the motion before may be far away
        panel.plot(t, found.predicted_before[log][:, c], label="before", color="0.4", linestyle="--", linewidth=1.0)
        panel.plot(t, found.predicted[log][:, c], label="after", color="black", linewidth=0.8)
        panel.set_title(robot.joint_names[c], loc="left", fontsize="small")
        panel.set_ylabel(f"q [{joint_unit(robot, c)}]")
        panels[-1].plot(t, found.residuals[log][:, c], label=robot.joint_names[c], linewidth=0.8)
    panels[-1].set(xlabel="time [s]", ylabel=f"residual [{joint_unit(robot, chosen)}]", xlim=(t[0], t[-1]))
    _share_legend(figure, panels)
    figure.align_ylabels()
    return figure, panels


def apply_style(axes: Axes) -> None:
    """Apply the style of varpin's figures: a faint grid below everything, no frame at the top and the right.

    Raises:
        InputError: ``axes`` are none of matplotlib's.
    """
    if not isinstance(axes, Axes):
        raise InputError(f"axes must be matplotlib's, such as matplotlib.figure.Figure().subplots(), got {axes!r}")
    # All colours, then all colours dashed, and so on.
    axes.set_prop_cycle(color=COLORS * len(DASHES), linestyle=[dash for dash in DASHES for _ in COLORS])
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
) -> Drawn:
    """Values at nodes (N + 1, k), or over ``steps`` (N, k); names of lines tell what these do not have in common."""
    figure, axes = _axes(axes)
    whats = list(dict.fromkeys(line.what for line in lines))
    units = list(dict.fromkeys(line.unit for line in lines))
    if steps:
        values = np.concatenate([values, values[-1:]])
    t, curves = trajectory.t[: len(values)], list[Line2D]()
    for row, line in zip(values.T, lines, strict=True):
        name = line.name + (f", {line.what}" if len(whats) > 1 else "") + (f" [{line.unit}]" if len(units) > 1 else "")
        curves += axes.plot(t, row, label=name, linewidth=_WIDTH, drawstyle="steps-post" if steps else "default")
    if limits is not None and values.size:
        _draw_limits(axes, values, curves, limits)
    _finish(axes, trajectory, f"{whats[0] if len(whats) == 1 else 'control'} [{', '.join(units) or '1'}]")
    return figure, axes


def _of_joints(trajectory: Trajectory, robot: Robot | None, what: str) -> list[Line]:
    """A line of a quantity for each joint."""
    units = _UNITS[what]
    slides = [None] * len(trajectory.joint_names) if robot is None else robot.slides.tolist()
    return [
        Line(name, what, " or ".join(units) if slide is None else units[int(slide)])
        for name, slide in zip(trajectory.joint_names, slides, strict=True)
    ]


def _of_controls(trajectory: Trajectory, robot: Robot | None) -> tuple[list[Line], list[int]]:
    """A line for each control (m,), and the joint that it acts on alone, or -1."""
    kinds = "control", "commanded position", "velocity"
    forces, positions, rates = (_of_joints(trajectory, robot, kind) for kind in kinds)
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


def _draw_limits(axes: Axes, values: Floats, curves: Sequence[Line2D], limits: tuple[Floats, Floats]) -> None:
    """Draw limits as dotted lines in the colours of their joints, if values (N, k) come near them or pass them.

    Distant limits would compress the motion.
    """
    low, high = float(values.min()), float(values.max())
    near = _NEAR * (high - low)
    look: dict[str, Any] = {"linewidth": 0.9, "linestyle": (0, (1, 2)), "zorder": 1}
    look["transform"] = axes.get_yaxis_transform()
    found = [(at, curve) for curve, *both in zip(curves, *limits, strict=True) for at in both]
    drawn = [(at, curve) for at, curve in found if low - near <= at <= high + near]
    for at, curve in drawn:
        # hlines adds a collection: the axes' lines are the joints.
        axes.hlines(at, 0.0, 1.0, color=curve.get_color(), **look)
    if drawn:
        # The entry of the legend, of no joint's colour.
        axes.hlines([], 0.0, 1.0, color="0.3", label=_LIMITS, **look)


def _axes(axes: Axes | None) -> Drawn:
    """The axes, or those of a new figure, in the style of all figures."""
    axes = Figure(figsize=(8.0, 4.5), layout="constrained").subplots() if axes is None else axes
    apply_style(axes)
    return axes.figure, axes


def _require_motion(given: object, robot: Robot | None) -> Trajectory:
    """The motion; refuses anything but a trajectory, a plan and a run, and a robot that is not the motion's."""
    motion = require_trajectory(motion_of(given))
    if robot is not None:
        require_joints("motion", motion, require_robot(robot))
    return motion


def _finish(axes: Axes, trajectory: Trajectory, label: str) -> None:
    axes.set_xlabel("time [s]")
    axes.set_ylabel(label)
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
