"""Figures: what is on them, and that making them leaves matplotlib's global state alone."""

import dataclasses
import io
import subprocess
import sys

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from refusals import refused

import varpin as vp
from varpin import plots

SINGLE = {
    "position [rad or m]": plots.plot_joints,
    "velocity [rad/s or m/s]": plots.plot_velocities,
    "control [N m or N]": plots.plot_controls,
    "E(t) - E(0) [J]": plots.plot_energy_error,
}


def swing(links=3, steps=40, controls=None):
    robot = vp.planar_chain(links)
    return robot, vp.simulate(
        vp.Scene(robot), np.full(links, 0.3), np.zeros(links), dt=0.01, steps=steps, controls=controls
    )


def drawn(axes):
    """The lines that stand for data, by label."""
    return {line.get_label(): line for line in axes.lines if not line.get_label().startswith("_")}


def legend_of(owner):
    legends = owner.legends if isinstance(owner, Figure) else [owner.get_legend()]
    return [text.get_text() for legend in legends if legend is not None for text in legend.get_texts()]


@pytest.mark.parametrize(("label", "draw"), SINGLE.items())
def test_single_figures_have_units_and_lines_under_the_joints_names(label, draw):
    robot, motion = swing()
    values = (motion.q, motion.v, np.vstack([motion.u, motion.u[-1:]]), motion.energy[:, None] - motion.energy[0])
    data = dict(zip(SINGLE, values, strict=True))[label]
    named = {"robot": robot} if len(data.T) > 1 else {}
    figure, axes = draw(motion, **named)
    assert axes.figure is figure
    assert (axes.get_xlabel(), axes.get_xlim()) == ("time [s]", (0.0, motion.t[-1]))
    assert axes.get_ylabel() == (label.split(" or ")[0] + "]" if named else label)
    names = list(motion.joint_names) if named else ["energy"]
    assert list(drawn(axes)) == names
    assert legend_of(axes) == (names if named else [])
    for line, column in zip(drawn(axes).values(), data.T, strict=True):
        np.testing.assert_array_equal(line.get_xydata(), np.column_stack([motion.t, column]))
    mine = Figure()
    given = mine.subplots()
    assert draw(motion, axes=given) == (mine, given)
    assert given.get_ylabel() == label
    assert given.lines


def test_prismatic_joints_are_in_metres_and_mixed_ones_say_which():
    fingers = {"lock": {f"panda_joint{k}": 0.0 for k in range(1, 8)}}
    for options, units in (({}, ("rad, m", "rad/s, m/s", "N m, N")), (fingers, ("m", "m/s", "N"))):
        robot = vp.load_robot("panda", **options)
        n = robot.dof
        motion = vp.simulate(vp.Scene(robot, gravity=False), np.zeros(n), np.full(n, 0.01), dt=1e-3, steps=5)
        for draw, kind, unit in zip([*SINGLE.values()][:3], ("position", "velocity", "control"), units, strict=True):
            _, axes = draw(motion, robot=robot)
            assert axes.get_ylabel() == f"{kind} [{unit}]"
            names = list(drawn(axes))
            mixed = unit.split(", ")
            if len(mixed) > 1:
                assert (names[0], names[-1]) == (f"panda_joint1 [{mixed[0]}]", f"panda_finger_joint1 [{mixed[1]}]")


def test_controls_are_steps_held_to_the_end_of_the_last_interval():
    controls = np.array([[1.0, 0.0], [1.0, 0.0], [-2.0, 0.0], [0.5, 0.0]])
    _, trajectory = swing(links=2, steps=4, controls=controls)
    _, axes = plots.plot_controls(trajectory)
    line = drawn(axes)["joint1"]
    assert line.get_drawstyle() == "steps-post"
    np.testing.assert_allclose(line.get_xdata(), [0.0, 0.01, 0.02, 0.03, 0.04])
    np.testing.assert_array_equal(line.get_ydata(), [1.0, 1.0, -2.0, 0.5, 0.5])


def test_linear_controls_are_lines_through_the_nodes():
    problem = vp.OptimalControlProblem(
        vp.Scene(vp.planar_chain(1)), vp.ControlCost(1.0), [0.3], [0.0], dt=0.01, steps=3, controls="linear"
    )
    nodes = np.array([[1.0], [-2.0], [3.0], [0.5]])
    motion = vp.solve(problem, nodes, max_iterations=0, check=False).trajectory
    (line,) = plots.plot_controls(motion)[1].get_lines()
    assert line.get_drawstyle() == "default"
    np.testing.assert_allclose(line.get_xydata(), np.column_stack([motion.t, nodes]), atol=1e-12)


@pytest.mark.parametrize("rows", [np.ones(3), np.ones((1, 1)), np.ones((2, 2, 2)), np.full((1, 3), np.nan)])
@pytest.mark.parametrize("kind", ["constraints.ties", "PositionServo"])
def test_controls_of_a_motion_whose_file_has_other_numbers(kind, rows):
    motion = vp.simulate(vp.Scene(vp.planar_chain(1)), [0.1], [0.0], dt=0.01, steps=2)
    odd = dataclasses.replace(motion, scene_values={**motion.scene_values, kind: rows})
    assert plots.plot_controls(odd)[1].get_ylabel() == "control [N m or N]"


BY_HAND, CUBIC = vp.KinematicInput("joint1"), vp.KinematicInput("joint1", "cubic")
SERVO = vp.PositionServo({"joint2": 50.0}, 1.0)
AT, TORQUE = "commanded position [rad]", "control [N m]"


@pytest.mark.parametrize(
    ("links", "options", "label", "names"),
    [
        (3, {"actuation": ["joint1", "joint3"]}, TORQUE, ["joint1", "joint3"]),
        (3, {"actuation": np.ones((3, 2))}, "control [N m or N]", ["u1", "u2"]),
        (2, {"constraints": BY_HAND, "actuation": ["joint1"]}, AT, ["joint1"]),
        (1, {"constraints": BY_HAND}, AT, ["joint1"]),
        (2, {"forces": vp.PositionServo(50.0, 1.0)}, AT, ["joint1", "joint2"]),
        (2, {"forces": SERVO, "actuation": ["joint2"]}, AT, ["joint2"]),
        (2, {"constraints": BY_HAND}, "control [rad, N m]", [f"joint1, {AT}", f"joint2, {TORQUE}"]),
        (2, {"forces": SERVO}, "control [N m, rad]", [f"joint1, {TORQUE}", f"joint2, {AT}"]),
        # As many controls as joints, and none of them a torque.
        (
            2,
            {"constraints": CUBIC, "actuation": ["joint1"]},
            "control [rad, rad/s]",
            [f"joint1, {AT}", "joint1, velocity [rad/s]"],
        ),
    ],
)
def test_controls_have_the_names_of_the_joints_that_they_move(links, options, label, names):
    scene = vp.Scene(vp.planar_chain(links), **options)
    motion = vp.simulate(scene, np.full(links, 0.3), np.zeros(links), dt=0.02, steps=3, check=False)
    _, axes = plots.plot_controls(motion, robot=scene.robot)
    assert (axes.get_ylabel(), list(drawn(axes))) == (label, names)


@pytest.mark.parametrize("links", [1, 3, 19])
def test_overview_has_everything_once(links):
    robot, trajectory = swing(links=links, controls=np.full((40, links), 0.1))
    figure, axes = plots.plot_trajectory(trajectory, robot=robot)
    assert isinstance(figure, Figure)
    labels = [panel.get_ylabel() for panel in axes]
    assert labels == ["position [rad]", "velocity [rad/s]", "control [N m]", "E(t) - E(0) [J]"]
    assert [panel.get_xlabel() for panel in axes] == ["", "", "", "time [s]"]
    assert [legend_of(panel) for panel in axes] == [[]] * 4
    assert legend_of(figure) == (list(trajectory.joint_names) if links > 1 else [])
    styles = {(line.get_color(), line.get_linestyle()) for line in drawn(axes[0]).values()}
    assert len(styles) == links
    figure.canvas.draw()
    heights = [panel.get_position().height for panel in axes]
    assert max(heights) < 1.02 * min(heights), "a long legend must not push panels apart"
    right = max(panel.get_window_extent().x1 for panel in axes)
    assert all(legend.get_window_extent().x0 >= right for legend in figure.legends)


def test_what_is_no_motion_record_robot_or_axes_is_refused():
    robot, trajectory = swing(links=2, steps=3, controls=[0.1, 0.2])
    for draw in (plots.plot_trajectory, *SINGLE.values()):
        for value in (None, "motion.npz", robot):
            with refused(vp.InputError, "Trajectory", type(value).__name__):
                draw(value)
    for draw in SINGLE.values():
        with refused(vp.InputError, "axes", "matplotlib.figure.Figure", "'x'"):
            draw(trajectory, "x")
    for draw in (plots.plot_trajectory, plots.plot_joints, plots.plot_velocities, plots.plot_controls):
        with refused(vp.InputError, "robot", "load_robot", "str"):
            draw(trajectory, robot="ur5")
    with refused(vp.InputError, "varpin.work_precision", "Robot"):
        plots.plot_study(robot)
    with refused(vp.InputError, "axes", "matplotlib.figure.Figure"):
        plots.apply_style(3)
    with refused(vp.InputError, "joint1, joint2, joint3"):
        plots.plot_joints(trajectory, robot=vp.planar_chain(3))


def test_plans_and_runs_are_drawn_as_their_motions():
    """And the limits of the controls are those of the plan, not the robot's."""
    cost, limits = vp.TrackingCost([0.4, 0.2], 1.0) + vp.ControlCost(1e-3), ([-1, -2], [1, 2])
    scene = vp.Scene(vp.planar_chain(2), gravity=False)
    problem = vp.OptimalControlProblem(scene, cost, [0, 0], [0, 0], dt=0.02, steps=8, control_limits=limits)
    plan, run = vp.solve(problem), vp.Mpc(problem).run(duration=0.04)
    for given, motion in ((plan, plan.trajectory), (run, run.motion)):
        for draw in (*SINGLE.values(), plots.plot_trajectory):
            panels = [np.ravel(draw(one)[1]) for one in (given, motion)]
            for mine, other in zip(*panels, strict=True):
                for line, same in zip(drawn(mine).values(), drawn(other).values(), strict=True):
                    np.testing.assert_array_equal(line.get_xydata(), same.get_xydata())
        _, axes = plots.plot_controls(given, robot=scene.robot)
        places = {path.vertices[0, 1] for lines in axes.collections for path in lines.get_paths()}
        assert {-1.0, 1.0, -2.0, 2.0} >= places > set()
    with refused(vp.InputError, "Trajectory", "OptimalControlProblem"):
        plots.plot_joints(problem)


def test_global_state_is_left_alone():
    before = dict(mpl.rcParams)
    had_pyplot = "matplotlib.pyplot" in sys.modules
    _, trajectory = swing()
    for draw in (*SINGLE.values(), plots.plot_trajectory):
        figure, _ = draw(trajectory)
        figure.savefig(io.BytesIO(), format="png", dpi=40)
    assert dict(mpl.rcParams) == before
    assert ("matplotlib.pyplot" in sys.modules) == had_pyplot
    from matplotlib import pyplot  # noqa: PLC0415 - the figures above are made without it

    assert pyplot.get_fignums() == []


def test_limits_are_drawn_where_the_motion_comes_near_them():
    robot = vp.load_robot("ur5")
    lower, upper = robot.position_limits
    q0 = np.array([0.0, -1.0, 1.0, 0.0, 0.0, 0.0])
    motion = vp.simulate(vp.Scene(robot, gravity=False), q0, np.zeros(6), dt=0.01, steps=2)
    assert limit_lines(motion, robot) == []
    # The elbow goes to its limit; the others' are far away.
    turned = dataclasses.replace(motion, q=np.linspace(q0, np.where(np.arange(6) == 2, upper, q0), 3))
    *lines, key = limit_lines(turned, robot)
    levels = {round(float(line.get_segments()[0][0, 1]), 6) for line in lines}
    assert (key.get_segments(), key.get_label()) == ([], "limits")
    assert round(float(upper[2]), 6) in levels
    assert all(np.abs(np.array([*lower, *upper]) - level).min() < 1e-6 for level in levels)
    assert limit_lines(turned, None) == []


def test_limits_have_an_entry_in_every_legend():
    """In one panel, also of one joint, and once in an overview whose velocities alone come near their limits."""
    robot, motion = swing(links=1)
    model = robot.model.copy()
    model.velocityLimit = np.array([1.05 * np.abs(motion.v).max()])
    limited = vp.load_robot(model)
    assert legend_of(plots.plot_velocities(motion, robot=limited)[1]) == ["joint1", "limits"]
    assert legend_of(plots.plot_joints(motion, robot=limited)[1]) == []
    figure, axes = plots.plot_trajectory(motion, robot=limited)
    assert legend_of(figure) == ["joint1", "limits"]
    assert [legend_of(panel) for panel in axes] == [[]] * 3


def limit_lines(trajectory, robot):
    _, axes = plots.plot_joints(trajectory, robot=robot)
    assert len(axes.lines) == len(trajectory.joint_names)
    return list(axes.collections)


def test_plotting_a_motion_imports_no_optimizer():
    found = "any(name.startswith(('varpin.control', 'varpin.study')) for name in sys.modules)"
    program = f"import sys, varpin.show.plots; sys.exit({found})"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


def test_free_motions_have_no_panel_of_controls_and_single_nodes_are_points():
    for steps, marker in ((0, "o"), (1, "None")):
        figure, axes = plots.plot_trajectory(swing(steps=steps)[1])
        figure.canvas.draw()
        assert [panel.get_ylabel().split()[0] for panel in axes] == ["position", "velocity", "E(t)"]
        assert [line.get_marker() for line in axes[0].lines] == [marker] * 3
        # Of a motion without steps, nothing.
        assert len(plots.plot_controls(swing(steps=steps)[1])[1].lines) == 3
