"""Plans with linear controls under noise: the expected cost, its gradient, and paths."""

import numpy as np
import pytest
from findings import about

import varpin as vp
from varpin.control.noise import covariances, left_within_steps, noise_cost
from varpin.control.riccati import backward
from varpin.control.stages import Feedback, Steps
from varpin.integrators.base import diffusion_and_drift

CONTROL, STATE = vp.ControlNoise(0.3), vp.StateNoise(3.0, center=np.zeros(2))
SLIDING = vp.CustomNoise(
    lambda q, v, u: np.array([[0.2 * v[0] + 0.1 * u[1]], [0.3 + 0.1 * v[1]]]),
    1,
    dv=lambda q, v, u: np.array([[[0.2, 0.0]], [[0.0, 0.1]]]),
    du=lambda q, v, u: np.array([[[0.0, 0.1]], [[0.0, 0.0]]]),
)


def reach(noise: object, *, steps: int = 5, dt: float = 0.08, rate: float = 0.0, joints: int = 2, **options: object):
    cost = vp.ControlCost(0.05) + vp.VelocityCost(0.1)
    cost += vp.Terminal(vp.TrackingCost([0.5, -0.5][:joints], 20.0) + vp.VelocityCost(5.0))
    if rate:
        cost += vp.ControlRateCost(rate)
    scene = vp.Scene(vp.planar_chain(joints), damping=0.2, noise=noise)
    at, still = np.full(joints, 0.2), np.zeros(joints)
    return vp.OptimalControlProblem(scene, cost, at, still, dt=dt, steps=steps, controls="linear", **options)


def line(problem: vp.OptimalControlProblem, u: np.ndarray) -> vp.LinearPolicy:
    N, (n, m) = problem.steps, (problem.scene.robot.dof, problem.scene.controls)
    return vp.LinearPolicy(u[1:], np.zeros((N, m, 2 * n)), np.zeros((N, 2 * n)), before=u[0], linear=True)


@pytest.mark.parametrize("noise", [vp.AdditiveNoise(0.3), CONTROL + STATE, SLIDING])
@pytest.mark.parametrize("kick", ["left", "split", "held"])
def test_the_noise_cost_is_that_of_the_covariance(noise: object, kick: str) -> None:
    """Forward by covariances in plain loops, backward by the value function: two ways to the same number."""
    weight = 1e-3
    problem = reach(noise, integrator=vp.Gauss(2, kick=kick), rate=weight)
    motion = problem.simulate(line(problem, np.random.default_rng(1).normal(size=(problem.decisions, 2))))
    steps = Steps(problem, motion)
    plan = backward(steps, 0.0)
    feedback = Feedback(plan.feedback, plan.previous)
    lin, C, changes, x = vp.linearize(problem.scene, motion), np.zeros((6, 6)), 0.0, 4
    nodes = covariances(steps, feedback)
    for k in range(problem.steps):
        np.testing.assert_allclose(nodes[k], C[:x, :x], atol=1e-12)
        K = np.hstack([plan.feedback[k + 1], plan.previous[k + 1]])
        change = K - np.eye(2, 6, 4)
        changes += 2.0 * weight / problem.dt * np.trace(change @ C @ change.T) / 2.0
        T = np.vstack([np.eye(6), K])
        J = np.hstack([lin.A[k], lin.B[k] - lin.ramp[k], lin.ramp[k]])
        Z, C = T @ C @ T.T, np.zeros((6, 6))
        C[:x, :x], C[:x, x:], C[x:, x:] = J @ Z @ J.T, J @ Z[:, 6:], Z[6:, 6:]
        C[x:, :x] = C[:x, x:].T
        for i in range(lin.G.shape[2]):
            D = np.hstack([lin.Gx[k, :, i], lin.Gu[k, :, i] - lin.Gramp[k, :, i], lin.Gramp[k, :, i]])
            C[:x, :x] += problem.dt * (np.outer(lin.G[k, :, i], lin.G[k, :, i]) + D @ Z @ D.T)
    assert plan.noise == pytest.approx(noise_cost(steps, feedback) + changes, rel=1e-10)


@pytest.mark.parametrize("noise", [CONTROL + STATE, SLIDING], ids=["core", "python"])
@pytest.mark.parametrize("kick", ["left", "split", "held"])
def test_the_effect_of_noise_along_a_line(noise: object, kick: str) -> None:
    """Its derivatives in the controls at both ends, by differences of the fields before and after a quiet step."""
    integrator = vp.Gauss(2, kick=kick)
    problem = reach(noise, steps=1, integrator=integrator).at(q0=[0.3, -0.2], v0=[0.4, 0.7])
    scene, n, left = problem.scene, 2, integrator.left
    at, size = np.array([1.0, -2.0, 3.0, 0.5]), 1e-4
    motion = problem.simulate(line(problem, at.reshape(2, 2)))
    lin = vp.linearize(scene, motion)

    def effect(ends: np.ndarray) -> np.ndarray:
        moved = problem.simulate(line(problem, ends.reshape(2, 2)))

        def fields(k: int, u: np.ndarray) -> np.ndarray:
            return scene.noise.fields(moved.q[k, None], moved.v[k, None], u[None], problem.q0).F[0]

        def columns(k: int) -> np.ndarray:
            slope = (fields(k, ends[2:]) - fields(k, ends[:2])) / np.sqrt(12.0)
            # Noise of the state's alone sees no slope.
            return np.hstack([fields(k, 0.5 * (ends[:2] + ends[2:])), slope[:, np.abs(slope).any(axis=0)]])

        before, after = columns(0), columns(1)
        found = left * lin.J[0] @ before
        found[n:] += (1.0 - left) * after
        return found

    np.testing.assert_allclose(lin.G[0], effect(at), atol=1e-12)
    derivatives = np.concatenate([lin.Gu - lin.Gramp, lin.Gramp], axis=3)[0]
    for c, away in enumerate(size * np.eye(4)):
        found = (effect(at + away) - effect(at - away)) / (2.0 * size)
        np.testing.assert_allclose(derivatives[:, :, c], found, atol=1e-8)


@pytest.mark.parametrize(
    ("noise", "integrator"), [(CONTROL, vp.Gauss(2, kick="held")), (SLIDING, vp.RungeKutta4())], ids=["core", "python"]
)
def test_paths_cost_what_the_plan_expects(noise: object, integrator: vp.Integrator) -> None:
    problem = reach(noise, integrator=integrator)
    plan = vp.solve(problem, check=False)
    assert plan.noise_cost > 0.0
    paths = 1500 if noise is CONTROL else 100
    told = plan.monte_carlo(paths, rng=0)
    assert abs(told.cost - told.predicted) < 3.0 * told.standard_error
    # Path by path, from the recorded controls at the nodes.
    children = np.random.default_rng(0).spawn(2)
    again = [problem.cost_of(problem.simulate(plan.policy, rng=child)) for child in children]
    first = plan.monte_carlo(2, rng=0)
    within = left_within_steps(Steps(problem, plan.trajectory), Feedback(plan.gains, plan.previous_gains))
    assert (within > 0.0) == integrator.holds_noise
    assert first.cost == pytest.approx(np.mean(again) + within, rel=1e-12)


@pytest.mark.parametrize("rate", [0.0, 1e-2])
def test_the_noise_cost_in_halves_is_that_of_each_impulse(rate: float) -> None:
    """Of a linear system the cost is quadratic in the increments: their second differences are its mean under noise."""
    noise = vp.AdditiveNoise(0.3)
    scene = vp.Scene(vp.planar_chain(1), gravity=False, damping=1.0, stiffness=3.0, noise=noise)
    cost = vp.ControlCost(1e-2) + vp.TrackingCost([0.5], 1.0)
    cost += vp.Terminal(vp.TrackingCost([0.5], 10.0))
    task = {"q0": [0.0], "v0": [0.0], "dt": 0.1, "steps": 8, "controls": "linear"}
    problem = vp.OptimalControlProblem(scene, cost + vp.ControlRateCost(rate) if rate else cost, **task)
    plan = vp.solve(problem)
    assert not about(plan.warnings, "noise within steps")
    halves = vp.OptimalControlProblem(scene, cost, **task).at(dt=0.05)

    def motion(w: np.ndarray) -> vp.Trajectory:
        policy, own = plan.policy_on("momentum"), problem.integrator
        return vp.simulate(
            scene, [0.0], [0.0], dt=0.05, steps=16, controls=policy, increments=w, integrator=own, check=False
        )

    still = motion(np.zeros((16, 1)))
    least, expected = halves.cost_of(still), 0.0
    for w in np.eye(16)[:, :, None]:
        expected += 0.05 * 0.5 * (halves.cost_of(motion(w)) + halves.cost_of(motion(-w)) - 2.0 * least)
    found = noise_cost(Steps(halves, still), Feedback(plan.gains, plan.previous_gains), halves=True)
    assert found == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("strength", [0.1, 1.0])
def test_strong_noise_costs_what_the_plan_expects_in_fine_steps(strength: float) -> None:
    """The noise of a line is that of its controls within the step, so alternating ones do not escape it."""
    problem = reach(vp.ControlNoise(strength), steps=10, dt=0.08 if strength == 1.0 else 0.05)
    plan = vp.solve(problem)
    assert plan.status is vp.Status.CONVERGED
    assert not about(plan.warnings, "noise within steps")
    fine = problem.at(dt=problem.dt / 4)
    given = {"dt": fine.dt, "steps": fine.steps, "controls": plan.policy, "integrator": problem.integrator}
    paths = [
        vp.simulate(problem.scene, problem.q0, problem.v0, rng=child, check=False, **given)
        for child in np.random.default_rng(3).spawn(200)
    ]
    costs = np.array([fine.cost_of(path) for path in paths])
    assert abs(costs.mean() - plan.expected_cost) < 3.0 * costs.std(ddof=1) / np.sqrt(len(costs))


FREE = vp.Scene(vp.planar_chain(1), gravity=False, noise=vp.ControlNoise(0.4))
LINE = vp.FirstOrderHold(np.array([[1.0], [-1.0], [2.0], [0.5], [0.5], [-3.0]]))


@pytest.mark.parametrize(
    "integrator",
    [vp.Midpoint(), vp.Midpoint(kick="held"), vp.Gauss(2, kick="split"), vp.Gauss(2, kick="held"), vp.RungeKutta4()],
    ids=str,
)
def test_the_covariance_along_a_line_is_that_of_continuous_noise(integrator: vp.Integrator) -> None:
    """That of a free joint, by quadrature: the momentum exactly, the position as far as one force a step goes."""
    h, t = 0.1, np.linspace(0.0, 0.5, 50_001)
    given = {"dt": h, "steps": 5, "controls": LINE, "integrator": integrator}
    quiet = vp.simulate(FREE, [0.0], [0.0], increments=0.0, **given)
    inertia = quiet.p[-1, 0] / quiet.v[-1, 0]
    to_v = np.diag([1.0, 1.0 / inertia if integrator.variational else 1.0])
    found = to_v @ vp.propagate_moments(vp.linearize(FREE, quiet)).covariance[-1] @ to_v
    power = (0.4 * np.interp(t, h * np.arange(6), LINE.u[:, 0]) / inertia) ** 2
    left = 0.5 - t
    exact = [np.trapezoid(power * left**i, t) for i in (2, 1, 0)]
    assert found[1, 1] == pytest.approx(exact[2], rel=1e-8)
    if integrator.holds_noise:
        assert found[0, 0] == pytest.approx(exact[0], rel=0.02)
        assert found[0, 1] == pytest.approx(exact[1], rel=0.08)
    paths = vp.simulate_ensemble(FREE, [0.0], [0.0], paths=2000, rng=1, store=True, **given)
    drawn = np.cov(paths.q[:, -1, 0], paths.v[:, -1, 0])
    # The standard error of a variance is sqrt(2 / paths) of it.
    np.testing.assert_allclose(drawn, found, rtol=3.0 * np.sqrt(2.0 / 2000))


@pytest.mark.parametrize(
    ("kick", "constrained"), [("left", False), ("split", False), ("held", False), ("left", True), ("held", True)]
)
def test_paths_on_lines_are_repeated_and_examined_with_their_noise(kick: str, constrained: bool) -> None:
    noise = vp.ControlNoise(0.05) + vp.AdditiveNoise(0.01)
    limits = [vp.JointTie("joint2", "joint1")] if constrained else []
    scene = vp.Scene(vp.planar_chain(2), damping=0.2, noise=noise, constraints=limits)
    integrator = vp.Gauss(2, kick=kick)
    controls = vp.FirstOrderHold(20.0 * np.sin(np.linspace(0.0, 60.0, 201))[:, None] * [1.0, -0.5])
    given = {"dt": 2e-3, "steps": 200, "controls": controls, "integrator": integrator}
    motion = vp.simulate(scene, [0.2, 0.2], [0.0, 0.0], rng=1, **given)
    assert motion.dw.shape == (200, 6)
    unknown = ["error"] if constrained and kick == "left" else []  # the repetition cannot have its noise
    assert [finding.kind for finding in motion.warnings] == unknown
    again = vp.simulate(scene, [0.2, 0.2], [0.0, 0.0], increments=motion.dw, **given)
    np.testing.assert_array_equal(again.q, motion.q)
    # Without those of slopes these are zero.
    means = vp.simulate(scene, [0.2, 0.2], [0.0, 0.0], increments=motion.dw[:, :4], **given)
    zeros = np.hstack([motion.dw[:, :4], np.zeros((200, 2))])
    np.testing.assert_array_equal(means.q, vp.simulate(scene, [0.2, 0.2], [0.0, 0.0], increments=zeros, **given).q)
    assert np.abs(means.q - motion.q).max() > 1e-6


@pytest.mark.parametrize("integrator", [vp.Gauss(2), vp.Gauss(2, kick="held"), vp.RungeKutta4()], ids=str)
def test_the_drift_along_a_line_is_its_mean_over_the_step(integrator: vp.Integrator) -> None:
    """By Simpson's rule, exact for noise linear in the control; its derivatives by differences of quiet steps."""
    sliding = vp.CustomNoise(
        lambda q, v, u: np.array([[0.2 * v[0] + 0.1 * u[1]], [0.3 + 0.1 * u[0] * v[1]]]),
        1,
        dv=lambda q, v, u: np.array([[[0.2, 0.0]], [[0.0, 0.1 * u[0]]]]),
        du=lambda q, v, u: np.array([[[0.0, 0.1]], [[0.1 * v[1], 0.0]]]),
        check=True,
    )
    problem = reach(sliding, steps=1, integrator=integrator).at(q0=[0.3, -0.2], v0=[0.4, 0.7])
    scene, u = problem.scene, np.array([1.0, -2.0, -3.0, 4.0])

    def ends(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        at = problem.at(q0=x[:2], v0=x[2:])
        motion = at.simulate(line(at, u.reshape(2, 2)))
        return np.concatenate([motion.q[1], motion.p[1] if integrator.variational else motion.v[1]])

    def local(control: np.ndarray) -> np.ndarray:
        return diffusion_and_drift(scene, problem.q0, problem.v0, control, problem.q0)[1]

    mean = 0.5 * (u[:2] + u[2:])
    found = diffusion_and_drift(scene, problem.q0, problem.v0, mean, problem.q0, (u[None, :2], u[None, 2:]))[1]
    np.testing.assert_allclose(found, (local(u[:2]) + 4.0 * local(mean) + local(u[2:])) / 6.0, atol=1e-14)
    assert np.abs(found - local(mean)).max() > 1e-2
    lin = vp.linearize(scene, problem.simulate(line(problem, u.reshape(2, 2))))
    x, step = np.concatenate([problem.q0, problem.v0]), 1e-5
    by_control = np.concatenate([lin.B - lin.ramp, lin.ramp], axis=2)[0]
    for c, away in enumerate(step * np.eye(4)):
        np.testing.assert_allclose(by_control[:, c], (ends(x, u + away) - ends(x, u - away)) / (2 * step), atol=1e-8)
