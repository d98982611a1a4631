"""What the defaults promise holds on the continuous robot, or the plan says so."""

import logging
import re

import numpy as np
import pytest
from findings import about
from refusals import naming, unnamed

import varpin as vp
from varpin.io.scenefile import scenes

ARMS = ("ur5", "ur10", "xarm7", "panda", "z1")


def reach(robot, seed, *, damping=0.1, dt=0.01, steps=100, running="velocity", **options):
    rng = np.random.default_rng(seed)
    lower, upper = (
        np.clip(np.nan_to_num(limit, posinf=np.pi, neginf=-np.pi), -np.pi, np.pi) for limit in robot.position_limits
    )
    begin = 0.5 * (lower + upper) + 0.25 * (upper - lower) * rng.uniform(-1.0, 1.0, robot.dof)
    goal = np.clip(begin + rng.uniform(-0.8, 0.8, robot.dof), lower, upper)
    scene = vp.Scene(robot, damping=damping)
    rest = np.zeros(robot.dof)
    cost = vp.ControlCost(1e-3, -vp.lagrangian_jet(scene, begin, rest).Lq)
    cost += vp.Terminal(vp.TrackingCost(goal, 1e3) + vp.VelocityCost(10.0))
    cost += vp.VelocityCost(1.0) if running == "velocity" else vp.TrackingCost(goal, 10.0)
    return vp.OptimalControlProblem(scene, cost, begin, rest, dt=dt, steps=steps, **options)


def test_defaults():
    problem = reach(vp.planar_chain(2), 0, steps=2)
    assert problem.integrator == vp.Gauss(stages=3)
    # Where gravity swings the arm, or dampers stop it, in a few steps.
    hanging = vp.OptimalControlProblem(
        vp.Scene(vp.planar_chain(2)), vp.ControlCost(), [1.5, 0.0], [0, 0], dt=0.2, steps=5
    )
    assert hanging.integrator == vp.Gauss(stages=4)
    assert hanging.at(dt=0.02).integrator == vp.Gauss(stages=3)
    assert problem.sampling == "gauss"
    # The rule stays where only the integrator is named.
    assert reach(vp.planar_chain(2), 0, steps=2, integrator=vp.Midpoint()).sampling == "gauss"


def test_samples_at_midpoints_alone_are_told_of(load, caplog):
    """Optimal velocities alternate between them; the log tells it once for a scene and a step."""
    problem = reach(load("ur10"), 1001, integrator=vp.Midpoint(), sampling="midpoint")
    with caplog.at_level(logging.WARNING):
        plans = [vp.solve(problem) for _ in range(2)]
    (told,) = about(plans[0].warnings, "replay")
    assert not unnamed(told, "sampling='gauss'")
    assert plans[0].warnings == plans[1].warnings
    assert len(about(caplog.messages, "replay")) == 1
    for text in (str(plans[0]), plans[0].table(), plans[0]._repr_html_()):
        assert about(text, "replay")
    assert vp.solve(problem, check=False).warnings == ()


def test_dampers_faster_than_the_step(load):
    """A wrist that stops at 735/s, in steps of 10 ms: two stages lose a tenth, four do not."""
    problem = reach(load("xarm7"), 1002)
    plan = vp.solve(problem.at(integrator=vp.Gauss(2)))
    truth = plan.verify(tolerance=1e-6)
    assert truth.closed_loop_loss > 1e-2
    assert "problem.at(dt=0.0025, hold=4)" in about(plan.warnings, "replay")[0]
    finer = vp.solve(problem.at(integrator=vp.Gauss(2), dt=0.0025, hold=4))
    assert finer.warnings == ()
    assert abs(finer.verify(tolerance=1e-6).closed_loop_loss) < 1e-3
    usual = vp.solve(problem)
    assert usual.warnings == ()
    assert abs(usual.verify(tolerance=1e-6).closed_loop_loss) < 1e-3


@pytest.mark.parametrize("integrator", [vp.Gauss(2), vp.Gauss(4), vp.RungeKutta4(), vp.SemiImplicitEuler()], ids=str)
def test_a_loss_is_told_as_large_as_verification_finds_it(integrator):
    plan = vp.solve(reach(vp.planar_chain(2), 3, steps=50, dt=0.02, integrator=integrator))
    lost, told = plan.verify(tolerance=1e-8).closed_loop_loss, about(plan.warnings, "replay")
    assert bool(told) == (not -1e-2 <= lost <= 1e-3)
    if told:
        share = float(re.search(r"with feedback (\S+) %", told[0])[1]) / 100.0
        assert 0.5 <= share / lost <= 1.1


def test_a_cost_that_fails_off_the_plan_is_told():
    def picky(t, q, v, u):
        if len(t) > 40:
            raise ValueError("too many")
        return (q**2).sum(axis=1)

    plan = vp.solve(small(cost=vp.CustomCost(picky) + vp.ControlCost(0.1)), max_iterations=2)
    assert naming(about(plan.warnings, "replay"), "too many")


def test_ctrl_c_ends_the_look_and_not_the_plan(monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("varpin.control.checks.replays", stop)
    plan = vp.solve(small())
    assert plan.status.converged
    assert about(plan.warnings[0], "interrupted")


def small(cost=None, **options):
    cost = vp.ControlCost(0.1) + vp.Terminal(vp.TrackingCost([0.0])) if cost is None else cost
    given = {"q0": [0.0], "v0": [0.0], "dt": 0.05, "steps": 10, **options}
    return vp.OptimalControlProblem(vp.Scene(vp.planar_chain(1)), cost, **given)


WEIGHT = abs(vp.Scene(vp.planar_chain(1)).holding_torque([0.0])[0])


def limited(share):
    return {"control_limits": (-share * WEIGHT, share * WEIGHT)}


def tip(target, weight=1.0):
    return {"cost": vp.ControlCost() + vp.FramePositionCost(LINK, "tip", target, weight)}


def end(target):
    return {"cost": vp.ControlCost() + vp.Terminal(vp.TrackingCost([target]))}


def goal(x):
    return {"constraints": vp.ReachFrame(LINK, "tip", position=[x, 0.0, 0.0])}


def joints(lower, upper):
    return {"constraints": vp.WithinJointLimits(LINK, (lower, upper)), "q0": [-0.5]}


LINK = vp.planar_chain(1)
TABLE = vp.Obstacle.sphere([0.0, 0.0, -0.1], 0.06, name="table")
CLEAR = vp.KeepClear(LINK, [TABLE], capsules={"joint1": ([0, 0, 0], [1, 0, 0], 0.05)})
FIXED, ACROSS = vp.Terminal(vp.FramePositionCost(LINK, "tip", (1.0, 0.0, 0.0))), [1.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("options", "kind", "times", "facts"),
    [
        (limited(0.8), "limits below the weight", 2, "'joint1'"),
        ({**limited(0.8), "q0": [-np.pi / 2]}, "limits below the weight", 1, ()),
        ({**limited(0.8), "v0": [1.0]}, "limits below the weight", 1, ()),
        (limited(1.005), "limits below the weight", 0, ()),
        (limited(0.995), "limits below the weight", 0, ()),
        ({"q0": [90.0]}, "degrees", 1, ("q0", "90 rad")),
        (end(90.0), "degrees", 1, ("reference", "90 rad")),
        (end(3.0), "degrees", 0, ()),
        (joints(-10.0, 90.0), "degrees", 1, ("limit", "90 rad")),
        (joints(-10.0, 3.0), "degrees", 0, ()),
        (joints(-1.0, -0.2), "goal outside constraints", 1, ("joint1", "0.2 rad", "WithinJointLimits")),
        (joints(-1.0, 0.1), "goal outside constraints", 0, ()),
        (joints(-0.2, 3.0), "start outside constraints", 1, ("lower limit of joint1", "0.3 rad", "WithinJointLimits")),
        (joints(-1.0, 3.0), "start outside constraints", 0, ()),
        ({"constraints": CLEAR}, "start outside constraints", 1, ("joint1", "table", "0.01")),
        (goal(1.1), "goal out of reach", 1, ("1.1 m", "1 m")),
        (goal(0.9), "goal out of reach", 0, ()),
        (goal(700.0), "goal out of reach", 1, ("700 m", "1 m")),
        # The last one can be reached.
        ({"cost": tip((5.0, 0.0, 0.0))["cost"] + FIXED}, "goal out of reach", 1, ()),
        (tip((0.7, 0.0, 0.0)), "goal out of reach", 0, ()),
        (tip((700.0, 0.0, 0.0)), "goal out of reach", 1, ()),
        # Rows count, too, but only directions with a weight.
        (tip((1.1, 5.0, 0.0), ACROSS), "goal out of reach", 1, ()),
        (tip((0.9, 5.0, 0.0), ACROSS), "goal out of reach", 0, ()),
        (tip(np.linspace([0.5, 0.0, 0.0], [1.1, 0.0, 0.0], 11)), "goal out of reach", 1, ()),
        (tip(np.linspace([0.5, 0.0, 0.0], [0.9, 0.0, 0.0], 11)), "goal out of reach", 0, ()),
    ],
)
def test_what_cannot_be_is_said_first(options, kind, times, facts, caplog):
    told = vp.solve(small(**options), max_iterations=0).warnings
    assert [finding.kind for finding in told].count(kind) == times
    assert not times or (told[0].kind == kind and told[0] in caplog.messages[0])
    assert not times or not unnamed(told[0], facts)


def test_limits_of_the_description_are_in_radians_and_rails_go_anywhere():
    model = LINK.model.copy()
    model.lowerPositionLimit[:], model.upperPositionLimit[:] = -1e5, 1e5
    wide, mobile = vp.load_robot(model), vp.load_robot(LINK.model, base="planar")
    far = vp.ControlCost() + vp.FramePositionCost(mobile, "tip", [30.0, 5.0, 0.0])
    for robot, cost, constraints in ((wide, vp.ControlCost(), vp.WithinJointLimits(wide)), (mobile, far, ())):
        at, scene = np.zeros(robot.dof), vp.Scene(robot, gravity=False)
        problem = vp.OptimalControlProblem(scene, cost, at, at, dt=0.02, steps=10, constraints=constraints)
        assert vp.solve(problem, max_iterations=0).warnings == ()


@pytest.mark.parametrize(
    ("bound", "damping", "kind"),
    [
        (vp.WithinVelocityLimits, 200.0, "margins of velocities"),
        (vp.WithinVelocityLimits, 0.2, None),
        (vp.WithinJointLimits, 200.0, None),
        (vp.WithinVelocityLimits, None, "margin without noise"),
    ],
)
def test_margins_that_may_be_wrong_are_told_of(bound, damping, kind):
    noise = None if damping is None else vp.AdditiveNoise(0.1)
    scene = vp.Scene(LINK, damping=damping or 0.0, noise=noise)
    within = bound(LINK, (-20.0, 20.0), margin=2.0)
    given = {"dt": 0.05, "steps": 8, "integrator": vp.Radau(2, kick="held"), "constraints": within}
    plan = vp.solve(vp.OptimalControlProblem(scene, vp.ControlCost(), [0.0], [0.0], **given))
    assert [told.kind for told in plan.warnings if "margin" in told.kind] == ([kind] if kind else [])
    assert not kind or naming(plan.warnings, "margin")


def held(plan):
    truth = plan.verify(tolerance=1e-6, max_substeps=256)
    return truth.open_loop_loss < 1e-3 or truth.closed_loop_loss < 1e-3


@pytest.mark.slow
def test_random_reaches_of_five_arms_hold_or_say_so():
    warned = 0
    for seed in range(20):
        name = ARMS[seed % len(ARMS)]
        robot = vp.load_robot(name, lock={"panda_finger_joint1": 0.02} if name == "panda" else None)
        running = "velocity" if seed % 2 else "tracking"
        plan = vp.solve(reach(robot, seed, running=running))
        assert plan.status.converged
        said = [told for told in plan.warnings if not told.kind.endswith(" limits")]
        warned += bool(said)
        assert said or held(plan), (seed, name)
    assert warned <= 4


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(scenes()))
def test_bundled_scenes_hold(name):
    file = vp.load_scene(name)
    plan = file.solve()
    assert plan.status.converged
    assert plan.warnings == ()
    assert held(plan)
