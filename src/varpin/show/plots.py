"""Figures of trajectories, and of speed against accuracy, in one style.

Figures are made without pyplot: nothing is shown, registered or configured globally. Save one with
``figure.savefig("motion.png")``; a notebook displays it as the value of a cell.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle, islice
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.model import Robot, require_robot
from varpin.show.given import motion_of, problem_of
from varpin.support.checks import flag
from varpin.trajectory import Trajectory, kinematic_input_rows, require_trajectory

if TYPE_CHECKING:
    # Imported for types alone: plotting a joint needs no optimizer.
    from varpin.control import Solution
    from varpin.control.mpc import MpcRun
    from varpin.study.record import Study

Motion: TypeAlias = "Trajectory | Solution | MpcRun"

# Okabe and Ito's palette for colour-blind readers, without its yellow, which is faint on white.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
DASHES: tuple[Any, ...] = ("-", "--", ":", "-.", (0, (6, 1, 1, 1, 1, 1)), (0, (9, 3)))
# Line widths: the second is for lines beyond all combinations of colours and dashes.
_WIDTHS = (1.4, 0.7)
# Entry of the legend for the limits.
_LIMITS = "limits"
# Rows of a column of the legend.
_LEGEND_ROWS = 20
# Look of a line that marks a value.
_MARK: dict[str, Any] = {"color": "0.6", "linewidth": 0.8, "linestyle": "--", "zorder": 1}
# Largest number of points of a line; thinning keeps the extremes.
_POINTS = 8000


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
    return _plot_nodes(trajectory, trajectory.q, "position", ("rad", "m"), axes, robot, limits)


def plot_velocities(
    trajectory: Motion, axes: Axes | None = None, *, robot: Robot | None = None
) -> tuple[Figure | SubFigure, Axes]:
    """Joint velocities over time; arguments as for :func:`plot_joints`."""
    trajectory = _require_motion(trajectory, robot)
    limits = None if robot is None else (-robot.velocity_limit, robot.velocity_limit)
    return _plot_nodes(trajectory, trajectory.v, "velocity", ("rad/s", "m/s"), axes, robot, limits)


def plot_error(
    trajectory: Motion, axes: Axes | None = None, *, robot: Robot | None = None
) -> tuple[Figure | SubFigure, Axes]:
    """The estimated error of the joint positions over time, on a logarithmic axis.

    The arguments are those of :func:`plot_joints`.

    Raises:
        InputError: As for :func:`plot_joints`, or the motion was not checked.
    """
    trajectory = _require_motion(trajectory, robot)
    if trajectory.error is None:
        raise InputError("the motion has no error: it was simulated with check=False")
    figure, axes = _plot_nodes(trajectory, trajectory.error, "estimated error", ("rad", "m"), axes, robot, None)
    if trajectory.error.any():
        # The error is zero at the start.
        axes.set_yscale("log")
    return figure, axes


def plot_controls(
    trajectory: Motion,
    axes: Axes | None = None,
    *,
    robot: Robot | None = None,
    labels: Sequence[str] | None = None,
) -> tuple[Figure | SubFigure, Axes]:
    """Controls over time: step functions, or lines where they are linear between nodes.

    Controls of position servos and kinematic inputs are commanded positions [rad or m]; the second control of a cubic
    input is a velocity [rad/s or m/s].

    Args:
        trajectory: The motion, or a plan or a controller's run that has one.
        axes: Where to draw; a new figure if left out.
        robot: The robot of the motion. With it, labels have the units of the controls, N m or N, and limits near the
            controls are dotted lines: efforts, or positions for servos. Those of a plan are its control limits.
        labels: Names of the m controls. If left out, the joints' names where there are as many, which is right if every
            joint is actuated, else u1, u2, ...

    Returns:
        The figure and its axes.

    Raises:
        InputError: ``labels`` are not m names, or as for :func:`plot_joints`.
    """
    problem, trajectory = problem_of(trajectory), _require_motion(trajectory, robot)
    controls = trajectory.u.shape[1]
    _require_labels(labels, controls)
    slides = _slides(robot)
    figure, axes = _axes(axes)
    joints = _served(trajectory)
    served = [joint is not None for joint in joints]
    rates = _rates(trajectory)
    what = "control"
    if labels is None and controls == len(trajectory.joint_names) and not any(served):
        names, unit = _labels(trajectory.joint_names, ("N m", "N"), slides)
    elif controls and all(served):
        what, commanded = "commanded position", np.array([joint for joint in joints if joint is not None])
        plain = [trajectory.joint_names[joint] for joint in commanded] if labels is None else labels
        names, unit = _labels(plain, ("rad", "m"), None if slides is None else slides[commanded])
    else:
        every = labels is None and controls == len(trajectory.joint_names) and not rates
        plain = trajectory.joint_names if every else (labels or [f"u{i + 1}" for i in range(controls)])
        names = [
            name if joint is None else f"{name}, commanded position [{_position_unit(joint, slides)}]"
            for name, joint in zip(plain, joints, strict=True)
        ]
        for control, joint in rates.items():
            unit = "rad/s or m/s" if slides is None else ("rad/s", "m/s")[int(slides[joint])]
            names[control] = f"{plain[control]}, velocity [{unit}]"
        unit = "units of each"
    linear = trajectory.u_nodes.shape[1] > 0
    drawn = trajectory.u_nodes if linear else trajectory.u
    for row, name, style in zip(drawn.T, names, _styles(controls), strict=True):
        if linear:
            axes.plot(*_thin(trajectory.t, row), label=name, **style)
        else:
            axes.step(*_thin_steps(trajectory.t, row), where="post", label=name, **style)
    limits = _control_limits(robot, joints) if problem is None else tuple(problem.control_limits)
    if limits is not None:
        _draw_limits(axes, drawn, limits)
    _finish(axes, trajectory, f"{what} [{unit}]", controls)
    return figure, axes


def plot_energy_error(
    trajectory: Motion, axes: Axes | None = None, *, relative: bool = False
) -> tuple[Figure | SubFigure, Axes]:
    """Change of the energy over time, which is an error if no force drives or damps the robot.

    Args:
        trajectory: The motion, or a plan or a controller's run that has one.
        axes: Where to draw; a new figure if left out.
        relative: Divide by the initial energy, instead of plotting joules. The potential energy is zero at the world's
            origin, so the result depends on the placement of the robot.

    Returns:
        The figure and its axes.

    Raises:
        InputError: ``relative`` is set and the initial energy is 0, or as for :func:`plot_joints`.
    """
    trajectory = _require_motion(trajectory, None)
    start = trajectory.energy[0]
    if flag("relative", relative) and start == 0.0:
        raise InputError("the initial energy is 0 J, so nothing is relative to it: plot with relative=False")
    figure, axes = _axes(axes)
    change = (trajectory.energy - start) / (abs(start) if relative else 1.0)
    label = "(E(t) - E(0)) / |E(0)| [1]" if relative else "E(t) - E(0) [J]"
    axes.axhline(0.0, color="0.75", linewidth=0.8, zorder=1)
    axes.plot(*_thin(trajectory.t, change), label="energy", color=COLORS[0], linewidth=1.2)
    _finish(axes, trajectory, label, 1)
    return figure, axes


def plot_trajectory(
    trajectory: Motion,
    axes: Sequence[Axes] | NDArray[Any] | None = None,
    *,
    robot: Robot | None = None,
    labels: Sequence[str] | None = None,
) -> tuple[Figure | SubFigure, NDArray[Any]]:
    """An overview: positions, velocities, controls and energy, one above the other.

    Args:
        trajectory: The motion, or a plan or a controller's run that has one.
        axes: Four axes to draw on; a new figure if left out, without the panel of controls if there are none or all
            are 0.
        robot: As for :func:`plot_joints`.
        labels: Names of the controls, as for :func:`plot_controls`.

    Returns:
        The figure and its axes: four, or three without controls.

    Raises:
        InputError: ``axes`` are not four, or as for the single figures.
    """
    given, trajectory = trajectory, _require_motion(trajectory, robot)
    _require_labels(labels, trajectory.u.shape[1])
    driven = axes is not None or bool(np.any(trajectory.u))
    if axes is None:
        count = 4 if driven else 3
        new = Figure(figsize=(9.0, 2.5 * count), layout="constrained")
        panels = new.subplots(count, 1, sharex=True)
        off = f", {trajectory.error_text} rad or m" if trajectory.error_text else ""
        title = f"{trajectory.robot}: {trajectory.integrator}, dt = {trajectory.dt:g} s{off}"
        new.suptitle(title, fontsize="large")
    else:
        panels = np.asarray(axes, dtype=object).ravel()
        if panels.size != 4:
            raise InputError(f"axes must be 4 (positions, velocities, controls, energy), got {panels.size}")
    plot_joints(trajectory, panels[0], robot=robot)
    plot_velocities(trajectory, panels[1], robot=robot)
    if driven:
        plot_controls(given, panels[2], robot=robot, labels=labels)
    plot_energy_error(trajectory, panels[-1])
    # Joints have the same colours in all panels and share one legend, which also has the key of limits in any panel.
    entries = [dict(zip(*reversed(panel.get_legend_handles_labels()), strict=True)) for panel in panels[:-1]]
    limits = next((entry[_LIMITS] for entry in entries if _LIMITS in entry), None)
    shared = {name: handle for name, handle in entries[0].items() if name != _LIMITS}
    joints = len(shared)
    if limits is not None:
        shared[_LIMITS] = limits
    mixed = len({joint is None for joint in _served(trajectory)}) > 1
    for panel, own in zip(panels[1:-1], entries[1:], strict=True):
        same = len(own.keys() - {_LIMITS}) == joints and not (panel is panels[2] and mixed)
        alone = axes is not None and _LIMITS in own and _LIMITS not in entries[0]
        if panel.get_legend() is not None and not alone and (panel is panels[1] or (same and labels is None)):
            panel.get_legend().remove()
    if axes is None and (panels[0].get_legend() is not None or limits is not None):
        # A legend of the figure, as that of one panel would push the others apart.
        if panels[0].get_legend() is not None:
            panels[0].get_legend().remove()
        new.legend(shared.values(), shared.keys(), loc="outside right upper", frameon=False, fontsize="small")
    for panel in panels[:-1]:
        panel.set_xlabel("")
    if axes is None:
        new.align_ylabels()
    return panels[0].figure, panels


def plot_study(study: Study[Any], axes: Axes | None = None, **options: str) -> tuple[Figure | SubFigure, Axes]:
    """What a study measured over time: a line for each method, circles and a line on the Pareto front.

    A grey line marks the error of the reference, or the tolerance or budget that was asked for.

    Args:
        study: From :func:`varpin.work_precision`, :func:`varpin.advise` or :func:`varpin.optimal_control_tradeoff`.
        axes: Where to draw; a new figure if left out.
        options: For work and precision ``quantity``: ``"q"``, the largest error in q over the motion; ``"end"``, that
            at its end; ``"energy"``, the energy error of a conservative motion; ``"tip"``, the error of the end
            effector. Errors below that of the reference are drawn on its line.

    Returns:
        The figure and its axes.

    Raises:
        InputError: Another ``study`` or ``quantity``, or no run has such a value.
    """
    if not hasattr(study, "chart"):
        what = "varpin.work_precision, advise or optimal_control_tradeoff"
        raise InputError(f"this figure is of a study, from {what}, got {type(study).__name__}")
    chart = study.chart(**options)
    if not chart.front:
        raise InputError("no run has such a value, so there is nothing to plot")
    figure, axes = _axes(axes)
    names = list(dict.fromkeys(name for name, _, _ in chart.points))
    for name, style in zip(names, _styles(len(names)), strict=True):
        curve = [(seconds, value) for label, seconds, value in chart.points if label == name]
        axes.plot(*zip(*curve, strict=True), label=name, marker="o", markersize=4, **style)
    ring: dict[str, Any] = {"marker": "o", "markersize": 9, "markerfacecolor": "none", "color": "0.3", "zorder": 1}
    axes.plot(*zip(*chart.front, strict=True), linestyle="none", **ring)
    # The line connects only the points whose error is below that of all faster ones.
    front = [point for k, point in enumerate(chart.front) if all(point[1] < v for _, v in chart.front[:k])]
    axes.plot(*zip(*front, strict=True), label=chart.standing, linewidth=0.8, **ring)
    axes.set(xscale="log", yscale="log" if chart.logarithmic else "linear")
    for name, (axis, value) in chart.marks.items():
        (axes.axvline if axis == "x" else axes.axhline)(value, label=name, **_MARK)
    apply_style(axes)
    axes.legend(frameon=False, fontsize="small")
    axes.set(xlabel=chart.labels[0], ylabel=chart.labels[1])
    return figure, axes


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


def _plot_nodes(
    trajectory: Trajectory,
    values: Floats,
    what: str,
    units: tuple[str, str],
    axes: Axes | None,
    robot: Robot | None,
    limits: tuple[Floats, Floats] | None,
) -> tuple[Figure | SubFigure, Axes]:
    """One line for each joint over the nodes; ``units`` are those of a revolute and of a prismatic joint."""
    slides = _slides(robot)
    figure, axes = _axes(axes)
    names, unit = _labels(trajectory.joint_names, units, slides)
    for row, name, style in zip(values.T, names, _styles(len(names)), strict=True):
        axes.plot(*_thin(trajectory.t, row), label=name, **style)
    if limits is not None:
        _draw_limits(axes, values, limits)
    _finish(axes, trajectory, f"{what} [{unit}]", len(names))
    return figure, axes


def _control_limits(robot: Robot | None, joints: Sequence[int | None]) -> tuple[Floats, Floats] | None:
    """Limits of the controls (m,), (m,): positions if all are servos, efforts if each joint has one; else None."""
    if robot is None or not joints:
        return None
    served = [joint for joint in joints if joint is not None]
    if len(served) == len(joints):
        lower, upper = robot.position_limits
        return lower[served], upper[served]
    if not served and len(joints) == robot.dof:
        return -robot.effort_limit, robot.effort_limit
    return None


def _draw_limits(axes: Axes, values: Floats, limits: tuple[Floats, Floats]) -> None:
    """Draw limits as dotted lines in the colours of their joints, if values (N, k) come near them or pass them.

    Distant limits would compress the motion.
    """
    if not values.size:
        return
    low, high = float(values.min()), float(values.max())
    near = 0.3 * (high - low)
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


def _require_labels(labels: object, controls: int) -> None:
    """Refuse anything but None or as many names as there are controls."""
    if labels is None:
        return
    if isinstance(labels, str) or not isinstance(labels, Sequence) or not all(isinstance(own, str) for own in labels):
        raise InputError(f"labels must be a list of {controls} names, one a control, got {labels!r}")
    if len(labels) != controls:
        raise InputError(f"labels must be {controls}, one a control, got {len(labels)}")


def _slides(robot: Robot | None) -> NDArray[np.bool_] | None:
    """Whether each coordinate (n,) is prismatic; None without a robot."""
    return None if robot is None else robot.slides


def _labels(names: Sequence[str], units: tuple[str, str], slides: NDArray[np.bool_] | None) -> tuple[list[str], str]:
    """Legend entries and the unit of the axis; entries have units of their own where joints differ."""
    if slides is None:
        return list(names), " or ".join(units)
    if slides.all() or not slides.any():
        return list(names), units[int(slides[0])]
    return [f"{name} [{units[1]}]" if s else name for name, s in zip(names, slides, strict=True)], ", ".join(units)


def _served(trajectory: Trajectory) -> list[int | None]:
    """For each control (m,), the joint whose position it commands, by a servo or as a kinematic input; else None."""
    found: list[int | None] = [None] * trajectory.u.shape[1]
    values = trajectory.scene_values
    if "actuation" not in values:
        return found
    actuation = values["actuation"]
    joints = range(min(len(trajectory.joint_names), len(actuation)))
    servos = values.get("PositionServo", np.zeros((0, 1)))
    for joint in [*(servos[:, 0].tolist() if servos.size else ()), *kinematic_input_rows(trajectory)[:, 0].tolist()]:
        # A file may have invalid joints.
        drives = np.flatnonzero(actuation[int(joint)]) if joint in joints else np.zeros(0, dtype=np.int64)
        if len(drives) and drives[0] < len(found):
            found[int(drives[0])] = int(joint)
    return found


def _rates(trajectory: Trajectory) -> dict[int, int]:
    """Controls that are velocities of cubic inputs, whose columns of the actuation are 0, and their joints."""
    actuation = trajectory.scene_values.get("actuation", np.zeros((0, 0)))
    if actuation.ndim != 2 or actuation.shape[1] != trajectory.u.shape[1]:
        return {}
    idle, joints = np.flatnonzero(~actuation.any(axis=0)), range(len(trajectory.joint_names))
    rows = kinematic_input_rows(trajectory)
    return {int(row[-1]): int(row[0]) for row in rows if row[-1] in idle and row[0] in joints}


def _position_unit(joint: int, slides: NDArray[np.bool_] | None) -> str:
    return "rad or m" if slides is None else ("rad", "m")[int(slides[joint])]


def _styles(lines: int) -> list[dict[str, Any]]:
    """Distinct line styles: all colours, then all colours dashed, and so on, then all of these thinner."""
    kinds = (
        {"color": color, "linestyle": dash, "linewidth": width}
        for width in cycle(_WIDTHS)
        for dash in DASHES
        for color in COLORS
    )
    return list(islice(kinds, lines))


def _finish(axes: Axes, trajectory: Trajectory, label: str, lines: int) -> None:
    axes.set_xlabel("time [s]")
    axes.set_ylabel(label)
    apply_style(axes)
    if trajectory.duration > 0.0:
        axes.set_xlim(trajectory.t[0], trajectory.t[-1])
    else:
        # A line with one point is invisible without a marker.
        for line in axes.lines:
            if np.size(line.get_xdata()) == 1:
                line.set_marker("o")
    entries = axes.get_legend_handles_labels()[1]
    if lines > 1 or _LIMITS in entries:
        axes.legend(
            loc="upper left",
            bbox_to_anchor=(1.0, 1.0),
            frameon=False,
            fontsize="small",
            ncols=-(-len(entries) // _LEGEND_ROWS),
        )


def _thin(t: Floats, values: Floats) -> tuple[Floats, Floats]:
    """A line thinned to about ``_POINTS`` points, with the extremes of each stretch."""
    if len(t) <= _POINTS:
        return t, values
    stretch = -(-2 * len(t) // _POINTS)
    whole = len(t) // stretch * stretch
    blocks = values[:whole].reshape(-1, stretch)
    first = np.arange(len(blocks)) * stretch
    extremes = np.concatenate([first + blocks.argmin(axis=1), first + blocks.argmax(axis=1)])
    kept = np.unique(np.concatenate([extremes, [0, len(t) - 1], np.arange(whole, len(t))]))
    return t[kept], values[kept]


def _thin_steps(t: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Changes of a step function over the intervals of ``t`` (N + 1,): times and values, the last value repeated."""
    if not len(values):
        return t, np.zeros(len(t))
    changes = np.flatnonzero(np.concatenate([[True], np.diff(values) != 0.0]))
    edges, steps = _thin(t[changes], values[changes])
    return np.append(edges, t[-1]), np.append(steps, values[-1])
