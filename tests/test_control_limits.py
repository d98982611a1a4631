"""Limits of controls: what they leave alone, saturation everywhere, what is refused."""

import numpy as np
import pytest
from refusals import refused
from test_sddp import sliders

import varpin as vp


def pushed(limits=None, **options):
    """Two sliders that are to be farther away than their motors bring them in time."""
    scene = options.pop("scene", None) or vp.Scene(sliders(2), gravity=False)
    cost = vp.TrackingCost([1.0, -0.2]) + vp.ControlCost([[1e-2, 2e-3], [2e-3, 2e-2]]) + vp.VelocityCost(1e-3)
    cost += vp.Terminal(vp.TrackingCost([1.0, -0.2], 10.0))
    options = {"dt": 0.05, "steps": 30, **options}
    return vp.OptimalControlProblem(scene, cost, [0, 0], [0, 0], control_limits=limits, **options)


def test_limits_that_the_optimum_does_not_touch():
    """From a cold start, with a stiff end."""
    robot = vp.load_robot("z1", lock={"jointGripper": 0.0})
    begin = np.array([0.2, 1.2, -1.4, 0.1, -0.3, 0.2])
    goal = begin + np.array([0.7, -0.5, 0.6, -0.4, 0.5, -0.6])
    cost = vp.ControlCost(1.0 / robot.effort_limit**2) + vp.VelocityCost(1.0)
    cost += vp.Terminal(vp.TrackingCost(goal, 1e4) + vp.VelocityCost(1e3))
    scene = vp.Scene(robot, damping="robot")
    free, limited = (
        vp.solve(
            vp.OptimalControlProblem(scene, cost, begin, np.zeros(6), dt=0.02, steps=50, control_limits=limits),
            check=False,
        )
        for limits in ((-np.inf, np.inf), (-robot.effort_limit, robot.effort_limit))
    )
    assert (np.abs(free.controls) < robot.effort_limit).all()
    assert limited.status.converged
    assert limited.iterations <= free.iterations + 1
    np.testing.assert_allclose(limited.cost, free.cost, rtol=1e-6)
    np.testing.assert_allclose(limited.controls, free.controls, atol=1e-3)


def test_first_controls_are_brought_within_limits():
    problem = pushed((-1.0, 0.5))
    for begin in (
        np.full((30, 2), 3.0),
        vp.LinearPolicy(np.full((30, 2), 3.0), np.zeros((30, 2, 4)), np.zeros((30, 4))),
    ):
        np.testing.assert_array_equal(vp.solve(problem, begin, max_iterations=0).controls, 0.5)
    other = vp.solve(pushed())
    assert np.abs(other.controls).max() > 1.0
    again = vp.solve(problem, other)
    assert again.status.converged
    assert (again.controls <= 0.5).all()
    assert (again.controls >= -1.0).all()
    hanging = vp.OptimalControlProblem(
        vp.Scene(vp.planar_chain(2)),
        vp.ControlCost(),
        [0, 0],
        [0, 0],
        dt=0.01,
        steps=5,
        control_limits=(-3.0, [4.0, 3.0]),
    )
    np.testing.assert_array_equal(hanging.holding_controls(), [-3.0, -3.0])


@pytest.mark.parametrize(
    "integrator",
    [vp.Midpoint(), vp.Gauss(stages=2), vp.RungeKutta4(), vp.SemiImplicitEuler(), vp.Reference()],
    ids=str,
)
def test_feedback_saturates(integrator):
    """A policy's controls are clipped, whatever integrates: each as the policy by hand gives it at the node."""
    rng = np.random.default_rng(0)
    limits = np.array([-0.4, -0.2]), np.array([0.3, 0.1])
    policy = vp.LinearPolicy(
        rng.normal(size=(6, 2)), rng.normal(size=(6, 2, 4)), rng.normal(size=(6, 4)), hold=2, limits=limits
    )
    motion = vp.simulate(
        vp.Scene(sliders(2)), [0.1, 0.2], [0, 0], dt=0.05, steps=12, controls=policy, integrator=integrator
    )
    second = motion.p if integrator.variational else motion.v
    x = np.hstack([motion.q, second])[:-1:2]
    wanted = policy.u + np.einsum("Rmx,Rx->Rm", policy.gains, x - policy.reference)
    np.testing.assert_allclose(motion.u[::2], np.clip(wanted, *limits), rtol=1e-12)
    np.testing.assert_array_equal(motion.u[1::2], motion.u[::2])
    assert np.count_nonzero(motion.u[::2] == limits[0]) + np.count_nonzero(motion.u[::2] == limits[1]) > 0


def shaken(scene_noise, limits):
    scene = vp.Scene(sliders(2), gravity=False, noise=scene_noise)
    return pushed(limits, scene=scene)


@pytest.mark.parametrize("noise", [vp.AdditiveNoise(0.3), vp.ControlNoise(0.05)], ids=["additive", "control"])
def test_noise_never_drives_a_control_out_of_its_limits(noise):
    """Not in Monte Carlo either; there saturation costs what the model of linear feedback does not see."""
    lower, upper = np.array([-1.0, -0.8]), np.array([1.5, 0.5])
    sol = vp.solve(shaken(noise, (lower, upper)))
    assert sol.status.converged
    ensemble = vp.simulate_ensemble(
        sol.problem.scene,
        sol.problem.q0,
        sol.problem.v0,
        dt=sol.problem.dt,
        steps=sol.problem.steps,
        paths=50,
        rng=0,
        controls=sol.policy,
    )
    assert (ensemble.u >= lower).all()
    assert (ensemble.u <= upper).all()
    saturated = (ensemble.u == lower) | (ensemble.u == upper)
    planned = (sol.controls == lower) | (sol.controls == upper)
    assert 0 < planned.sum() < planned.size
    assert (saturated != planned).any()
    # Limits so far away that noise does not reach them: the model's expectation is right.
    far = vp.solve(shaken(noise, (lower * 20, upper * 20))).monte_carlo(400, rng=1)
    assert abs(far.cost - far.predicted) < 4.0 * far.standard_error


@pytest.mark.parametrize(
    ("limits", "facts"),
    [
        ((1.0, -1.0), ("control_limits", "1", "-1", "0")),
        ((-1.0, np.nan), ("control_limits", "upper[0]", "NaN")),
        (([-1.0, -1.0, -1.0], 1.0), ("lower", "control_limits", "(2,)", "(3,)")),
        (3.0, ("control_limits", "pair")),
        ((1.0, 2.0, 3.0), ("control_limits", "pair")),
        (("a", 1.0), ("control_limits", "lower")),
        ("robot", ("control_limits", "pair")),
        ((np.inf, np.inf), ("control_limits", "inf")),
    ],
)
def test_limits_that_are_refused(limits, facts):
    with refused(vp.InputError, facts):
        pushed(limits)


def test_limits_below_the_weight_are_told():
    """Of an arm that lies horizontal: it takes half of its weight times its length."""
    robot = vp.planar_chain(1)
    weight = abs(vp.Scene(robot).holding_torque([0.0])[0])
    cost = vp.ControlCost(0.1) + vp.Terminal(vp.TrackingCost([0.0]))

    def kinds(share, begin=0.0, speed=0.0):
        limits = (-share * weight, share * weight)
        problem = vp.OptimalControlProblem(
            vp.Scene(robot), cost, [begin], [speed], dt=0.05, steps=10, control_limits=limits
        )
        return [finding.kind for finding in vp.solve(problem, max_iterations=0).warnings]

    assert kinds(0.8).count("limits below the weight") == 2
    assert kinds(0.8, begin=-np.pi / 2).count("limits below the weight") == 1
    assert kinds(0.8, speed=1.0).count("limits below the weight") == 1
    assert "limits below the weight" not in kinds(1.05)
