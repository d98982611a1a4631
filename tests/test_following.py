"""Trials that follow foreseen states: the inverse dynamics, where a motion goes, and what that saves."""

import numpy as np
import pinocchio as pin
import pytest

import varpin as vp
from varpin import core
from varpin.control import following
from varpin.control.commands import first_commands
from varpin.control.feedback import with_feedback
from varpin.control.following import Foresight, Path, inverse_dynamics, states_on
from varpin.control.line_search import LineSearch
from varpin.control.search import Search

RNG = np.random.default_rng(5)


def posture(*, goal=(2.0, -2.0, 2.0), scene=None, torque=1e-3, rate=0.0, **options):
    """Three links far from a posture."""
    scene = vp.Scene(vp.planar_chain(3)) if scene is None else scene
    end = vp.Terminal(vp.TrackingCost(goal, 1e3) + vp.VelocityCost(10.0))
    cost = vp.ControlCost(torque) + vp.VelocityCost(1e-2) + end
    if rate:
        cost += vp.ControlRateCost(rate)
    options = {"dt": 0.02, "steps": 50} | options
    return vp.OptimalControlProblem(scene, cost, np.zeros(3), np.zeros(3), **options)


def eager(**options):
    """The same with dear torques: full steps along the controls miss what the model says."""
    return posture(torque=0.1, steps=30, **options)


def planned(problem):
    """A search with its first plan."""
    search = Search(problem, False)
    search.begin(first_commands(problem, None))
    search._plan()
    return search


@pytest.mark.parametrize("name", ["ur5", "panda"])
def test_the_inverse_dynamics_is_that_of_pinocchio(name):
    robot = vp.load_robot(name)
    n, model = robot.dof, robot.model
    q, v, a = RNG.normal(size=(3, 8, n))
    scene = vp.Scene(robot, stiffness=3.0)
    found = core.inverse_dynamics(scene.core, q, v, a)
    for k in range(8):
        free = pin.rnea(model, model.createData(), robot.configuration(q[k]), v[k], a[k])
        np.testing.assert_allclose(found[k], free + 3.0 * q[k], rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.RungeKutta4(), vp.Gauss(2)])
@pytest.mark.parametrize("hold", [1, 2])
@pytest.mark.parametrize("rate", [0.0, 1e-4])
def test_a_motion_goes_along_the_foreseen_states(integrator, hold, rate):
    """They are those of the linearized motion under the plan, here from products of its matrices."""
    problem = posture(goal=(0.6, -0.5, 0.4), rate=rate, integrator=integrator, hold=hold)
    search = planned(problem)
    plan, along, n = search.plan, search.along, 3
    feedback = with_feedback(problem, search.trajectory, plan, closed=True)
    found = Foresight(problem).followed(along, plan, search.shares, np.inf)
    assert found.length == 1.0
    np.testing.assert_array_equal(found.commands[1].gains, feedback.gains)
    lin, x, foreseen = along.linearized(0, problem.steps)[0], np.zeros(2 * n), [np.zeros(2 * n)]
    du = np.zeros(n)
    for k in range(problem.steps):
        if k % hold == 0:
            before, r = du, k // hold
            du = plan.feedforward[r] + plan.feedback[r] @ x + (plan.previous[r] @ before if rate else 0.0)
        x = lin.A[k] @ x + lin.B[k] @ du
        foreseen.append(x)
    wanted = search.trajectory.q + np.array(foreseen)[:, :n]
    moved = np.abs(wanted - search.trajectory.q).max()
    # Held there by weak feedback, and by that of the plan.
    for commands in found.commands:
        motion = search.trials.attempt(commands).trajectory()
        assert np.abs(motion.q - wanted).max() <= 0.02 * moved
        assert problem.cost_of(motion) - search.cost == pytest.approx(found.cost, rel=0.05)
        # Its controls are those of the inverse dynamics.
        u, missing = inverse_dynamics(problem, Path(motion.q, motion.v), None)
        assert not missing.any()
        np.testing.assert_allclose(u, motion.u[::hold], atol=0.05 * np.abs(u).max())


def test_reference_states_are_those_of_the_integrator():
    q, v = RNG.normal(size=(2, 51, 3))
    by_velocity, by_momentum = (posture(integrator=each) for each in (vp.RungeKutta4(), vp.Midpoint()))
    np.testing.assert_array_equal(states_on(by_velocity, Path(q, v)), np.hstack([q, v])[:-1])
    p = [vp.lagrangian_jet(by_momentum.scene, *at).Lv for at in zip(q[:-1], v[:-1], strict=True)]
    np.testing.assert_allclose(states_on(by_momentum, Path(q, v)), np.hstack([q[:-1], p]), rtol=1e-12, atol=1e-12)


def of_panda():
    """A Panda moves each joint by up to 0.8 rad in a second, and a full step along its controls overshoots."""
    robot = vp.load_robot("panda", lock={"panda_finger_joint1": 0.02})
    begin = np.array([0.7, -0.4, 0.6, -1.2, 0.2, 1.6, -0.5])
    goal = begin + np.array([0.6, 0.7, -0.7, -0.5, 0.8, 0.6, -0.8])
    speed = vp.VelocityCost(1.0)
    cost = vp.ControlCost(1.0 / robot.effort_limit**2) + speed + vp.Terminal(vp.TrackingCost(goal, 1e4) + 1e3 * speed)
    return vp.OptimalControlProblem(vp.Scene(robot), cost, begin, np.zeros(7), dt=0.02, steps=50)


def of_two_links():
    cost = vp.ControlCost(0.1) + vp.VelocityCost(1e-2)
    cost += vp.Terminal(vp.TrackingCost([2.5, -2.5], 1e3) + vp.VelocityCost(10.0))
    return vp.OptimalControlProblem(vp.Scene(vp.planar_chain(2)), cost, np.zeros(2), np.zeros(2), dt=0.02, steps=30)


@pytest.mark.parametrize("task", [of_panda, of_two_links])
def test_steps_along_foreseen_states_save_iterations(monkeypatch, task):
    """The same optimum with fewer iterations and trials."""
    found = vp.solve(task(), check=False)
    monkeypatch.setattr(Foresight, "possible", False)
    plain = vp.solve(task(), check=False)
    assert found.status.converged
    assert found.cost == pytest.approx(plain.cost, rel=1e-6)
    assert found.iterations < plain.iterations
    rollouts = [sum(row.rollouts for row in plan.history) for plan in (found, plain)]
    assert rollouts[0] < rollouts[1]


@pytest.mark.parametrize(
    ("why", "options"),
    [
        ("a joint without a drive", {"scene": vp.Scene(vp.planar_chain(3), actuation=["joint1", "joint2"])}),
        ("more controls than joints", {"scene": vp.Scene(vp.planar_chain(3), actuation=np.eye(3, 4) + 0.1)}),
        ("drives with a limit", {"scene": vp.Scene(vp.planar_chain(3), forces=vp.PositionServo(100.0, 10.0, 15.0))}),
        ("linear controls", {"controls": "linear"}),
    ],
)
def test_only_arms_with_one_drive_for_each_joint_follow(why, options):
    assert Foresight(posture()).possible
    problem = posture(**options)
    assert not Foresight(problem).possible, why


def test_states_that_need_more_than_the_limits_are_not_followed():
    for limit, follows in ((1e3, True), (1.0, False)):
        problem = posture(goal=(0.9, -0.9, 0.9), control_limits=(-limit, limit))
        search = planned(problem)
        found = Foresight(problem).followed(search.along, search.plan, search.shares, np.inf)
        assert (found is not None) == follows


def test_states_far_away_are_not_followed(monkeypatch):
    problem = posture()
    search = planned(problem)
    arguments = search.along, search.plan, search.shares, np.inf
    assert Foresight(problem).followed(*arguments).length == 0.75
    monkeypatch.setattr(following, "_FAR", 0.9)
    assert Foresight(problem).followed(*arguments) is None


def strays():
    """Very coarse steps, in which feedback does not hold the motion on the path."""
    cost = vp.ControlCost(1e-2) + vp.VelocityCost(1e-2)
    cost += vp.Terminal(vp.TrackingCost([np.pi / 2, 0.0], 1e3) + vp.VelocityCost(1e2))
    options = {"dt": 0.1, "steps": 28, "integrator": vp.RungeKutta4()}
    begin = [-np.pi / 2, 0.0], np.zeros(2)
    return vp.OptimalControlProblem(vp.Scene(vp.planar_chain(2)), cost, *begin, **options)


def test_searches_go_on_as_if_not_interrupted_once_a_trial_has_strayed(tmp_path):
    whole = vp.solve(strays(), tolerance=1e-4, check=False)
    assert not whole.search.follows
    for most in (1, len(whole.history) // 2, len(whole.history) - 2):
        part = vp.solve(strays(), tolerance=1e-4, max_iterations=most, check=False)
        part.save(tmp_path / "part.npz")
        read = vp.Solution.load(tmp_path / "part.npz", part.problem)
        assert read.search.follows == part.search.follows
        for known in (part, read):
            rest = vp.solve(part.problem, resume=known, tolerance=1e-4, check=False)
            assert [row.step for row in rest.history] == [row.step for row in whole.history]
            np.testing.assert_array_equal(rest.trajectory.q, whole.trajectory.q)
            assert rest.cost == whole.cost


def fence(angle):
    """A cost that fails beyond an angle."""

    def value(t, q, v, u):
        if np.abs(q).max() > angle:
            raise ValueError("beyond the fence")
        return np.zeros(len(q))

    return vp.CustomCost(value)


@pytest.mark.parametrize("angle", [0.5, 1.0, 1.5])
def test_a_cost_that_fails_at_foreseen_states_ends_no_search(angle):
    plain = eager()
    options = {"dt": plain.dt, "steps": plain.steps}
    problem = vp.OptimalControlProblem(plain.scene, plain.cost + fence(angle), plain.q0, plain.v0, **options)
    plan = vp.solve(problem, max_iterations=10, check=False)
    assert plan.history
    assert np.abs(plan.trajectory.q).max() <= angle


@pytest.mark.parametrize(
    ("scene", "options"),
    [
        (vp.Scene(vp.planar_chain(3)), {"forward": "open"}),
        (vp.Scene(vp.planar_chain(3), noise=vp.ControlNoise(0.05)), {"noise": "held"}),
    ],
    ids=["open loop", "noise of the controls"],
)
def test_searches_that_do_not_follow(monkeypatch, scene, options):
    def fails(*_):
        raise AssertionError("foreseen states were looked at")

    monkeypatch.setattr(Foresight, "followed", fails)
    with pytest.raises(AssertionError, match="foreseen"):
        vp.solve(eager(), check=False)
    assert vp.solve(eager(scene=scene), max_iterations=5, check=False, **options).history


def test_a_trial_that_strays_is_the_last_one(monkeypatch):
    """And a step along foreseen states is not extended along the controls."""
    steps, tried = [], []
    run, following = LineSearch.run, LineSearch._following

    def searched(self, start, shortest=0.0):
        steps.append(run(self, start, shortest))
        return steps[-1]

    def followed(self, *arguments):
        found = following(self, *arguments)
        if found is not None:
            tried.append((len(steps), found))
        return found

    monkeypatch.setattr(LineSearch, "run", searched)
    monkeypatch.setattr(LineSearch, "_following", followed)
    vp.solve(strays(), tolerance=1e-4, check=False)
    assert len(tried) > 1
    for at, (trial, length, trials) in tried[:-1]:
        assert steps[at].taken.motion is trial.motion
        assert (steps[at].length, steps[at].trials) == (length, 1 + trials)
    assert [steps[at].strayed for at, _ in tried] == [False] * (len(tried) - 1) + [True]


@pytest.mark.parametrize(("task", "trials"), [(of_panda, 1), (strays, 2)])
def test_weak_feedback_comes_first(monkeypatch, task, trials):
    """It holds an arm's slow reach on its path, and the plan's feedback is not tried; a fast swing leaves it."""
    found, following = [], LineSearch._following

    def followed(self, *arguments):
        found.append(following(self, *arguments))
        return found[-1]

    monkeypatch.setattr(LineSearch, "_following", followed)
    vp.solve(task(), tolerance=1e-4, check=False)
    assert {each[2] for each in found if each is not None} == {trials}
