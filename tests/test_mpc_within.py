"""A controller within hard constraints: its ticks against plans from scratch, obstacles that move, what is told."""

import numpy as np
from refusals import naming, refused, unnamed

import varpin as vp

ROBOT = vp.planar_chain(2)
ARM = {"joint1": ([0, 0, 0], [1, 0, 0], 0.05), "joint2": ([0, 0, 0], [1, 0, 0], 0.05)}


def target(t):
    return [0.8 * np.sin(1.5 * t), 0.4]


def bob(t):
    """Where a ball is that swings into the tool's way [m]."""
    return [1.9 - 0.3 * np.sin(2.0 * t), 0.0, -1.35]


def tracking(constraints, **options):
    cost = vp.TrackingCost(target, 100.0) + vp.ControlCost(1e-4) + vp.VelocityCost(1e-2)
    return vp.OptimalControlProblem(
        vp.Scene(ROBOT, damping=0.3),
        cost,
        [0.0, 0.4],
        [0.0, 0.0],
        dt=0.03,
        steps=16,
        constraints=constraints,
        **options,
    )


FAMILIES = {
    "speeds": [vp.WithinVelocityLimits(ROBOT, (-0.8, 0.8))],
    "a moving sphere": [vp.KeepOutOfSphere(ROBOT, "tip", bob, 0.3)],
    "a moving ball": [
        vp.KeepClear(ROBOT, [vp.Obstacle.sphere(bob(0), 0.2).moving(lambda t: bob(t) - np.array(bob(0)))], 0.02,
                     capsules=ARM),
    ],
    "rates": [vp.WithinControlRate(100.0)],
}  # fmt: skip


def test_obstacles_are_where_they_are_at_each_time():
    """Bounds of an obstacle and a sphere that move are those of ones that stand there, at every node."""
    problem = tracking([*FAMILIES["a moving sphere"], *FAMILIES["a moving ball"]], t0=0.4)
    rng = np.random.default_rng(0)
    q = rng.normal(size=(17, 2))
    sphere, ball = (bound.value(q, q, q[1:]) for bound in problem.bound_constraints)
    slopes = [bound.jacobian(q, q) for bound in problem.bound_constraints]
    for k, t in enumerate(0.4 + 0.03 * np.arange(1, 17)):
        still = [
            vp.KeepOutOfSphere(ROBOT, "tip", bob(t), 0.3),
            vp.KeepClear(ROBOT, [vp.Obstacle.sphere(bob(t), 0.2)], 0.02, capsules=ARM),
        ]
        for moving, there, slope in zip((sphere, ball), tracking(still).bound_constraints, slopes, strict=True):
            np.testing.assert_allclose(moving[k], there.value(q, q, q[1:])[k], rtol=0, atol=1e-12)
            np.testing.assert_allclose(slope[k], there.jacobian(q, q)[k], rtol=0, atol=1e-12)
    # Several motions at once, as a line search has them.
    both = problem.bound_constraints[1].value(np.array([q, -q]), np.array([q, q]), np.zeros((2, 16, 2)))
    np.testing.assert_array_equal(both[0], ball)


def test_ways_of_obstacles_are_checked():
    ball = vp.Obstacle.sphere([1.0, 0.0, 0.0], 0.1, name="ball")
    with refused(vp.InputError, "function"):
        ball.moving([0.0, 0.0, 1.0])
    moving = ball.moving(lambda t: [0.0, 0.0])
    with refused(vp.InputError, "moves already"):
        moving.moving(lambda t: [0.0, 0.0, 0.0])
    with refused(vp.InputError, "'ball'", "0.03"):
        tracking([vp.KeepClear(ROBOT, [moving], capsules=ARM)])
    with refused(vp.InputError, "center", "finite"):
        tracking([vp.KeepOutOfSphere(ROBOT, "tip", lambda t: [np.nan, 0.0, 0.0], 0.1)])


def test_ticks_that_find_no_plan_are_told_of():
    """A goal that no horizon reaches: multipliers stay bounded, and the goal is kept again once it can be."""
    far = vp.Mpc(tracking([vp.ReachFrame(ROBOT, "tip", position=[2.2, 0.0, 0.0])])).run(duration=0.3)
    assert far.infeasible > 3
    assert far.constraints[0].infeasible.sum() == far.infeasible
    assert naming(far.warnings, "no plan", "ReachFrame('tip')")
    assert any(plan.status is vp.Status.INFEASIBLE for plan in far.plans)
    assert not unnamed(str(far), "ReachFrame('tip')")
    assert np.isfinite(far.plans[-1].multipliers.values).all()


def test_what_the_plant_violates_is_told_of():
    """A plant that is pushed harder than the model knows."""
    noisy = vp.Plant(vp.Scene(ROBOT, damping=0.3, noise=vp.AdditiveNoise(0.1)))
    run = vp.Mpc(tracking(FAMILIES["speeds"])).run(noisy, duration=0.6, rng=1)
    assert 0.05 < run.constraints[0].worst < 0.4
    assert naming(run.warnings, "motion violates", "WithinVelocityLimits", "margin=", "narrower")


def test_no_bound_is_to_be_narrower_than_nothing():
    """Noise that moves the arm by more than its bound lets it, and a plan that goes on for want of time."""
    noisy = vp.Plant(vp.Scene(ROBOT, damping=0.3, noise=vp.AdditiveNoise(2.0)))
    run = vp.Mpc(tracking([vp.WithinVelocityLimits(ROBOT, (-0.8, 0.8))]), budget=1e-9).run(noisy, duration=0.15, rng=1)
    (report,) = run.constraints
    assert report.worst > 0.8
    assert naming(run.warnings, "motion violates", "margin=")
    assert not naming(run.warnings, "narrower")
    # The older plan kept to the bound on the way that it planned.
    assert report.older.tolist() == [False, *4 * [True]] == run.late.tolist()
    assert not unnamed(str(report), "4 ticks an older plan", "rad/s")
    first, bound = run.plans[0], run.plans[0].constraints[0].violation
    assert first.violation == bound == report.planned.max()
