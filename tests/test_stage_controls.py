"""Controls that change within a step: their order, derivatives, balance and records.

Against DOP853 on Pinocchio's forward dynamics, differences, and each other.
"""

import numpy as np
import pinocchio as pin
import pytest
from findings import about
from mechanisms import slider
from refusals import refused
from scipy.integrate import solve_ivp

import varpin as vp

DURATION = 0.4
# Torques that move each arm by some radians.
SWINGS = {
    "ur5": (40.0, 60.0, 30.0, 5.0, 4.0, 3.0),
    "ur10": (40.0, 60.0, 30.0, 1.0, 1.0, 0.3),
    "puma560": (90.0, 140.0, 40.0, 6.0, 5.0, 4.0),
}

MEMBERS = [vp.Gauss(2), vp.Gauss(3), vp.Gauss(4), vp.Radau(2), vp.Radau(3), vp.RungeKutta4()]
# Where errors of the order itself can be seen: between coarse steps and rounding.
COUNTS = {3: (160, 320), 4: (80, 160), 5: (80, 160), 6: (80, 160), 8: (40, 56, 80)}
# Rotors behind gears slow an arm down, and its errors.
COARSER = {"puma560": 4}
# Steps for an error of 1e-11; for order 3 they would be some ten thousands.
FINE = {4: 2400, 5: 600, 6: 240, 8: 80}
Q0 = np.array([0.3, -1.2, 0.8, 0.2, 0.5, -0.3])


def puma560():
    """An industrial arm with a spherical wrist and the rotors of its gears.

    Corke and Armstrong-Helouvry: A search for consensus among model parameters reported for the PUMA 560 robot, ICRA
    1994, as in the Robotics Toolbox.
    """
    turns = np.array([1, 0, -1, 1, -1, 0]) * np.pi / 2.0
    offsets, lengths = (0.0, 0.0, 0.15005, 0.4318, 0.0, 0.0), (0.0, 0.4318, 0.0203, 0.0, 0.0, 0.0)
    mass = (0.0, 17.4, 4.8, 0.82, 0.34, 0.09)
    centres = [(0, 0, 0), (-0.3638, 0.006, 0.2275), (-0.0203, -0.0141, 0.07), (0, 0.019, 0), (0, 0, 0), (0, 0, 0.032)]
    moments = [
        (0.0, 0.35, 0.0), (0.13, 0.524, 0.539), (0.066, 0.086, 0.0125),
        (1.8e-3, 1.3e-3, 1.8e-3), (3e-4, 4e-4, 3e-4), (1.5e-4, 1.5e-4, 4e-5),
    ]  # fmt: skip
    rotors, gears = (2e-4, 2e-4, 2e-4, 3.3e-5, 3.3e-5, 3.3e-5), (62.6111, 107.815, 53.7063, 76.0364, 71.923, 76.686)
    model, joint, end = pin.Model(), 0, pin.SE3.Identity()
    for k in range(6):
        joint = model.addJoint(joint, pin.JointModelRZ(), end, f"joint{k + 1}")
        # From the axis to the link's own frame, by Denavit and Hartenberg.
        end = pin.SE3(pin.utils.rotate("x", turns[k]), np.array([lengths[k], 0.0, offsets[k]]))
        model.appendBodyToJoint(joint, pin.Inertia(mass[k], np.array(centres[k], float), np.diag(moments[k])), end)
    model.armature = np.array(rotors) * np.square(gears)
    return vp.load_robot(model)


def swing(name, t):
    return np.array(SWINGS[name]) * np.sin(np.arange(3.0, 9.0) * t + np.arange(6))


@pytest.fixture(scope="module", params=SWINGS)
def driven(request):
    """A six-joint arm, its torques, and where they take it, by other code."""
    name = request.param
    robot = puma560() if name == "puma560" else vp.load_robot(name)
    model = robot.model
    assert robot.dof == 6
    data = model.createData()

    def rate(t, x):
        return np.concatenate([x[6:], pin.aba(model, data, x[:6], x[6:], swing(name, t))])

    start = np.concatenate([Q0, np.zeros(6)])
    end = solve_ivp(rate, (0.0, DURATION), start, method="DOP853", rtol=3e-14, atol=1e-14).y[:, -1]
    return vp.Scene(robot), lambda t: swing(name, t), end, COARSER.get(name, 1)


@pytest.mark.parametrize("integrator", MEMBERS, ids=str)
def test_torques_of_time_keep_the_order(driven, integrator):
    """Where errors show it, and down to 1e-11."""
    scene, force, end, coarser = driven

    def error(steps):
        options = {"duration": DURATION, "steps": steps, "integrator": integrator, "check": False}
        motion = vp.simulate(scene, Q0, np.zeros(6), controls=vp.OpenLoop(force), **options)
        assert motion.statistics.split_steps == 0
        return np.abs(motion.q[-1] - end[:6]).max()

    counts = [count // coarser for count in COUNTS[integrator.order]]
    errors = [error(count) for count in counts]
    slopes = np.log(np.divide(errors[:-1], errors[1:])) / np.log(np.divide(counts[1:], counts[:-1]))
    # Runge-Kutta's leading term is small here, and the next one adds to it.
    assert slopes.min() > integrator.order - 0.3, (slopes, errors)
    if integrator.order in FINE:
        assert error(FINE[integrator.order]) < 1e-11


@pytest.mark.parametrize("integrator", [vp.Gauss(2), vp.Gauss(3), vp.RungeKutta4()], ids=str)
def test_goals_of_servos_keep_the_order(integrator):
    robot, stiffness, damping = vp.planar_chain(3), 60.0, 4.0
    scene = vp.Scene(robot, forces=vp.PositionServo(stiffness, damping))
    model = robot.model
    data = model.createData()

    def goal(t):
        return np.array([0.5, -0.3, 0.4]) * np.sin(np.array([6.0, 5.0, 8.0]) * t)

    def rate(t, x):
        drive = stiffness * (goal(t) - x[:3]) - damping * x[3:]
        return np.concatenate([x[3:], pin.aba(model, data, x[:3], x[3:], drive)])

    end = solve_ivp(rate, (0.0, 0.5), np.concatenate([CHAIN_Q, CHAIN_V]), "DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    errors = []
    for steps in (100, 200):
        motion = vp.simulate(
            scene,
            CHAIN_Q,
            CHAIN_V,
            duration=0.5,
            steps=steps,
            controls=vp.OpenLoop(goal),
            integrator=integrator,
            check=False,
        )
        errors.append(np.abs(motion.q[-1] - end[:3]).max())
    assert np.log2(errors[0] / errors[1]) > integrator.order - 0.3, errors


def test_reference_meets_its_tolerance(driven):
    scene, force, end, _ = driven
    motion = vp.simulate(
        scene, Q0, np.zeros(6), duration=DURATION, steps=20, controls=vp.OpenLoop(force), integrator=vp.Reference(1e-11)
    )
    assert np.abs(motion.q[-1] - end[:6]).max() < 1e-9


def test_one_stage_holds_the_middle(driven):
    scene, force, *_ = driven
    for integrator in (vp.Midpoint(), vp.Gauss(1), vp.Radau(1), vp.ExplicitEuler()):
        options = {"dt": 0.01, "steps": 5, "integrator": integrator}
        motion = vp.simulate(scene, Q0, np.zeros(6), controls=vp.OpenLoop(force), **options)
        np.testing.assert_array_equal(motion.u, [force((k + 0.5) * 0.01) for k in range(5)])
        assert motion.u_stages.shape == (5, 0, 6)


def test_values_and_means(driven):
    """u_stages are the function's own values, u their mean over the step as the method weighs them."""
    scene, force, *_ = driven
    for integrator in (vp.Gauss(3), vp.Radau(2), vp.RungeKutta4()):
        motion = vp.simulate(
            scene, Q0, np.zeros(6), dt=0.01, steps=6, controls=vp.OpenLoop(force), integrator=integrator
        )
        for k in range(6):
            own = [force((k + c) * 0.01) for c in integrator.stage_times]
            np.testing.assert_allclose(motion.u_stages[k], own, rtol=1e-15, atol=1e-15)
            mean = [np.mean([force((k + c) * 0.01) for c in (np.arange(2000) + 0.5) / 2000], axis=0)]
            np.testing.assert_allclose(motion.u[k], mean[0], rtol=0, atol=1e-5 * np.abs(mean[0]).max())
        assert motion.part(2, 5).u_stages.shape == (3, len(integrator.stage_times), 6)


def stiff_scene():
    """Friction and a servo, whose forces depend on the controls', on a chain."""
    robot = vp.planar_chain(3)
    names = robot.joint_names
    return vp.Scene(
        robot,
        damping=0.3,
        forces=[
            vp.PositionServo({names[1]: 40.0}, damping=1.0, effort=25.0),
            vp.CoulombFriction({names[0]: 0.4}, width=3.0),
        ],
    )


SMALL = {"dt": 0.03, "steps": 3}
CHAIN_Q, CHAIN_V = np.array([0.3, -0.4, 0.5]), np.array([1.0, -0.5, 0.8])


def push(t):
    return np.array([3.0 * np.sin(9.0 * t + 1.0), 0.2 + 0.02 * np.sin(7.0 * t), np.sin(5.0 * t + 1.0)])


def eighth(f, size):
    weights = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}
    return sum(w * (f(k * size) - f(-k * size)) for k, w in weights.items()) / size


@pytest.mark.parametrize(
    ("integrator", "split"),
    [
        (vp.Gauss(2, guard=None), False),
        (vp.Gauss(4), False),
        (vp.Radau(3), False),
        (vp.RungeKutta4(), False),
        (vp.Gauss(2, guard=vp.Guard(energy_balance=1e-3)), True),
        (vp.Gauss(3, guard=vp.Guard(energy_balance=1e-7)), True),
    ],
    ids=str,
)
def test_derivatives_against_differences(integrator, split):
    """In the state, in a shift of the control and in a ramp of it, in whole steps and in parts."""
    scene = stiff_scene()
    n, dt = 3, SMALL["dt"]
    motion = vp.simulate(scene, CHAIN_Q, CHAIN_V, controls=vp.OpenLoop(push), integrator=integrator, **SMALL)
    assert (motion.statistics.split_steps > 0) == split
    lin = vp.linearize(scene, motion)
    assert lin.ramp is not None
    both = integrator.linearize_with_ramps(scene, motion)
    for found, alone in zip(both[:3], integrator.linearize(scene, motion), strict=True):
        np.testing.assert_array_equal(found, alone)
    for k in range(motion.steps):
        start = motion.q[k], motion.p[k] if integrator.variational else motion.v[k]

        def end(dx, du, dr, k=k, start=start):
            q, second = start[0] + dx[:n], start[1] + dx[n:]
            if integrator.variational:
                second = np.linalg.solve(vp.lagrangian_jet(scene, q, np.zeros(n)).Lvv, second)
            force = vp.OpenLoop(lambda t: push(k * dt + t) + du + dr * t / dt)
            own = vp.simulate(scene, q, second, dt=dt, steps=1, controls=force, integrator=integrator, check=False)
            assert own.statistics.substeps[0] == motion.statistics.substeps[k], "the difference crosses a guard"
            return np.concatenate([own.q[1], own.p[1] if integrator.variational else own.v[1]])

        for derivative, place in ((lin.A[k], 0), (lin.B[k], 1), (lin.ramp[k], 2)):
            for c in range(derivative.shape[1]):

                def moved(size, place=place, c=c, end=end):
                    given = [np.zeros(2 * n), np.zeros(n), np.zeros(n)]
                    given[place][c] += size
                    return end(*given)

                size = 4e-5 if place == 0 else 4e-4
                np.testing.assert_allclose(derivative[:, c], eighth(moved, size), rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    "integrator", [vp.Gauss(2), vp.Radau(3), vp.Gauss(2, guard=vp.Guard(energy_balance=1e-4))], ids=str
)
def test_second_derivatives_against_differences_of_the_first(integrator):
    scene = stiff_scene()
    n, dt = 3, SMALL["dt"]
    z = np.random.default_rng(1).normal(size=2 * n)
    motion = vp.simulate(
        scene, CHAIN_Q, CHAIN_V, dt=dt, steps=1, controls=vp.OpenLoop(push), integrator=integrator, check=False
    )
    curved = vp.second_order(scene, motion, z)
    found = np.block([[curved.xx[0], curved.ux[0].T], [curved.ux[0], curved.uu[0]]])

    def gradient(y):
        v = np.linalg.solve(vp.lagrangian_jet(scene, y[:n], np.zeros(n)).Lvv, y[n : 2 * n])
        force = vp.OpenLoop(lambda t: push(t) + y[2 * n :])
        end = vp.simulate(scene, y[:n], v, dt=dt, steps=1, controls=force, integrator=integrator, check=False)
        assert end.statistics.substeps[0] == motion.statistics.substeps[0], "the difference crosses a guard"
        lin = vp.linearize(scene, end)
        return z @ np.hstack([lin.A[0], lin.B[0]])

    point = np.concatenate([motion.q[0], motion.p[0], np.zeros(n)])
    for c in range(3 * n):
        e = np.zeros(3 * n)
        e[c] = 1.0
        np.testing.assert_allclose(
            found[:, c], eighth(lambda size, e=e: gradient(point + size * e), 2e-4), rtol=0, atol=1e-7
        )


def test_reference_linearizes():
    scene = vp.Scene(vp.planar_chain(3), damping=0.3)
    options = {"dt": 0.03, "steps": 1, "controls": vp.OpenLoop(push), "check": False}
    own = vp.simulate(scene, CHAIN_Q, CHAIN_V, integrator=vp.Reference(1e-11), **options)
    other = vp.simulate(scene, CHAIN_Q, CHAIN_V, integrator=vp.RungeKutta4(), **(options | {"dt": 3e-4, "steps": 100}))
    lin, fine = vp.linearize(scene, own), vp.linearize(scene, other)
    A, B, ramp = np.eye(6), np.zeros((6, 3)), np.zeros((6, 3))
    for k in range(100):
        # The part of the long ramp in a short step: a shift and a ramp of its own.
        A, B = fine.A[k] @ A, fine.A[k] @ B + fine.B[k]
        ramp = fine.A[k] @ ramp + fine.B[k] * k / 100 + fine.ramp[k] / 100
    for found, expected in ((lin.A[0], A), (lin.B[0], B), (lin.ramp[0], ramp)):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize(("stages", "balance"), [(2, 1e-10), (3, 1e-13)])
def test_steps_in_parts_keep_the_order(stages, balance):
    """Parts take the polynomial through the whole step's stages, which alone leaves an error of the method's order."""
    scene = vp.Scene(vp.planar_chain(3))
    options = {"duration": 0.48, "controls": vp.OpenLoop(push), "check": False}
    end = vp.simulate(scene, CHAIN_Q, CHAIN_V, steps=96, integrator=vp.Gauss(5), **options).q[-1]
    cut, errors = vp.Gauss(stages, guard=vp.Guard(energy_balance=balance)), []
    for steps in (6, 12):
        motion = vp.simulate(scene, CHAIN_Q, CHAIN_V, steps=steps, integrator=cut, **options)
        assert motion.statistics.split_steps == steps
        errors.append(np.abs(motion.q[-1] - end).max())
        whole = vp.simulate(scene, CHAIN_Q, CHAIN_V, steps=steps, integrator=vp.Gauss(stages), **options)
        assert errors[-1] < 0.5 * np.abs(whole.q[-1] - end).max()
    assert np.log2(errors[0] / errors[1]) > 2 * stages - 0.5, errors


@pytest.mark.parametrize("integrator", [vp.Gauss(2), vp.Radau(3), vp.RungeKutta4()], ids=str)
def test_the_ledger_closes(integrator):
    """The energy defect is the method's own error, and goes with its order; the look finds nothing to say."""
    scene, off = vp.Scene(vp.planar_chain(3)), []
    for steps in (100, 200):
        motion = vp.simulate(
            scene, CHAIN_Q, CHAIN_V, duration=0.5, steps=steps, controls=vp.OpenLoop(push), integrator=integrator
        )
        off.append(np.abs(motion.statistics.energy_defect).max())
        assert motion.warnings == ()
    assert off[0] < 1e-5
    assert np.log2(off[0] / off[1]) > integrator.order - 0.5, off


def test_the_look_sees_coarse_steps():
    options = {"duration": 2.0, "controls": vp.OpenLoop(push), "integrator": vp.RungeKutta4()}
    scene = vp.Scene(vp.planar_chain(3))
    coarse = vp.simulate(scene, CHAIN_Q, CHAIN_V, steps=30, **options)
    assert any("coarse" in told or "too long" in told for told in coarse.warnings)
    assert vp.simulate(scene, CHAIN_Q, CHAIN_V, steps=800, **options).warnings == ()


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(2), vp.RungeKutta4()], ids=str)
def test_controls_that_change_too_fast_for_the_step_are_told_of(integrator):
    scene = vp.Scene(vp.planar_chain(3), gravity=(0.0, 0.0, 0.0), damping=5.0)
    fast = vp.OpenLoop(lambda t: np.array([1.0, 0.5, 0.2]) * np.sin(100.0 * t + 1.0))
    options = {"duration": 0.4, "controls": fast, "integrator": integrator}
    coarse = vp.simulate(scene, CHAIN_Q, np.zeros(3), steps=7, **options)
    assert about(coarse.warnings, "fast controls")
    assert vp.simulate(scene, CHAIN_Q, np.zeros(3), steps=400, **options).warnings == ()


@pytest.mark.parametrize("turned", [0.8, 0.2])
def test_what_steps_see_of_a_swinging_force_is_told_where_it_moves_a_joint(turned):
    """A mass under a sine: values in the middles of steps push it by (h w / 2) / sin(h w / 2) too far."""
    rate = 20.0
    dt = turned / rate
    swing = vp.OpenLoop(lambda t: np.array([np.cos(rate * t)]))
    motion = vp.simulate(
        vp.Scene(slider(1.0), gravity=False), [0.0], [0.0], dt=dt, steps=60, controls=swing, integrator=vp.Midpoint()
    )
    true = (1.0 - np.cos(rate * motion.t)) / rate**2
    off = np.abs(motion.q[:, 0] - true).max() / np.ptp(true)
    told = about(motion.warnings, "fast controls")
    assert bool(told) == (off > 0.01) == (turned > 0.5)
    if told:
        percent = float(told[0].split("% of the largest joint travel")[0].split()[-1])
        assert percent == pytest.approx(100.0 * np.abs(motion.q[:, 0] - true).max() / np.ptp(motion.q), rel=0.02)


def test_lines_between_nodes():
    """A first-order hold is the function of time that NumPy interpolates."""
    scene, steps, dt = stiff_scene(), 12, 0.02
    u = np.random.default_rng(0).normal(size=(steps + 1, 3))
    nodes = np.arange(steps + 1) * dt

    def line(t):
        return [np.interp(t, nodes, column) for column in u.T]

    options = {"dt": dt, "steps": steps}
    for integrator in (vp.Midpoint(), vp.Gauss(2), vp.Radau(3), vp.RungeKutta4()):
        own = vp.simulate(scene, CHAIN_Q, CHAIN_V, controls=vp.FirstOrderHold(u), integrator=integrator, **options)
        same = vp.simulate(scene, CHAIN_Q, CHAIN_V, controls=vp.OpenLoop(line), integrator=integrator, **options)
        np.testing.assert_allclose(own.q, same.q, rtol=0, atol=1e-13)
        np.testing.assert_allclose(own.u, 0.5 * (u[1:] + u[:-1]), rtol=0, atol=1e-15)


def test_both_parts_of_a_line_against_differences():
    """dx1 = A dx + (B - ramp) du_k + ramp du_(k+1)."""
    scene, integrator = stiff_scene(), vp.Gauss(2)
    u = np.array([[1.0, 0.2, -1.0], [2.0, 0.4, 0.5]])

    def end(nodes):
        own = vp.simulate(
            scene, CHAIN_Q, CHAIN_V, dt=0.03, steps=1, controls=vp.FirstOrderHold(nodes), integrator=integrator
        )
        return own, np.concatenate([own.q[1], own.p[1]])

    lin = vp.linearize(scene, end(u)[0])
    for row, derivative in enumerate((lin.B[0] - lin.ramp[0], lin.ramp[0])):
        for c in range(3):

            def moved(size, row=row, c=c):
                nodes = u.copy()
                nodes[row, c] += size
                return end(nodes)[1]

            np.testing.assert_allclose(derivative[:, c], eighth(moved, 4e-4), rtol=0, atol=1e-8)


def test_held_controls_have_no_ramp():
    scene = stiff_scene()
    motion = vp.simulate(scene, CHAIN_Q, CHAIN_V, controls=np.zeros(3), integrator=vp.Gauss(2), **SMALL)
    assert vp.linearize(scene, motion).ramp is None


def test_a_tolerance_is_met_at_high_order():
    scene, (q, v) = vp.Scene(vp.planar_chain(3)), (CHAIN_Q, CHAIN_V)
    exact = vp.simulate(scene, q, v, dt=0.0025, steps=200, controls=vp.OpenLoop(push), integrator=vp.Gauss(5)).q[-1]
    motion = vp.simulate(scene, q, v, duration=0.5, tolerance=1e-9, controls=vp.OpenLoop(push))
    assert np.abs(motion.q[-1] - exact).max() < 1e-9
    assert motion.steps < 1000  # thousands of times as many at second order
    u = np.array([push(t) for t in np.linspace(0.0, 0.5, 6)])
    lines = vp.simulate(scene, q, v, duration=0.5, tolerance=1e-9, controls=vp.FirstOrderHold(u))
    times = np.linspace(0.0, 0.5, lines.steps + 1)
    along = np.column_stack([np.interp(times, np.linspace(0.0, 0.5, 6), column) for column in u.T])
    fine = vp.FirstOrderHold(along).refined(4)
    exact = vp.simulate(scene, q, v, duration=0.5, steps=4 * lines.steps, controls=fine, integrator=vp.Gauss(4)).q[-1]
    assert np.abs(lines.q[-1] - exact).max() < 1e-9


def test_saved_and_read_again(tmp_path):
    scene = stiff_scene()
    motion = vp.simulate(scene, CHAIN_Q, CHAIN_V, controls=vp.OpenLoop(push), integrator=vp.Gauss(3), **SMALL)
    again = vp.Trajectory.load(motion.save(tmp_path / "motion.npz"))
    np.testing.assert_array_equal(again.u_stages, motion.u_stages)
    np.testing.assert_array_equal(vp.linearize(scene, again).B, vp.linearize(scene, motion).B)


def test_noise_is_kicked_under_the_same_torques():
    """With fields that the core evaluates, and with the same in Python, step by step."""
    robot = vp.planar_chain(3)
    swung = {"controls": vp.OpenLoop(push), "integrator": vp.Gauss(2), "rng": 3, **SMALL}
    own = vp.simulate(vp.Scene(robot, noise=vp.AdditiveNoise(0.2)), CHAIN_Q, CHAIN_V, **swung)
    custom = vp.CustomNoise(lambda q, v, u: 0.2 * np.eye(3), processes=3)
    other = vp.simulate(vp.Scene(robot, noise=custom), CHAIN_Q, CHAIN_V, **swung)
    np.testing.assert_allclose(own.q, other.q, rtol=0, atol=1e-12)
    paths = vp.simulate_ensemble(vp.Scene(robot, noise=vp.AdditiveNoise(0.2)), CHAIN_Q, CHAIN_V, paths=2, **swung)
    np.testing.assert_allclose(paths.u[0], own.u, rtol=0, atol=1e-15)


def test_what_is_refused():
    scene = stiff_scene()
    with refused(vp.InputError, "node", "(3,)"):
        vp.FirstOrderHold(np.zeros(3))
    with refused(vp.InputError, "finite"):
        vp.FirstOrderHold([[0.0], [np.nan]])
    with refused(vp.InputError, "FirstOrderHold", "u", "(4, 3)", "(3, 3)"):
        vp.simulate(scene, CHAIN_Q, CHAIN_V, controls=vp.FirstOrderHold(np.zeros((3, 3))), **SMALL)
    calls = []

    def breaks(t):
        calls.append(t)
        if t > 0.05:
            raise RuntimeError("no more")
        return push(t)

    with refused(vp.ControlError, "1") as info:
        vp.simulate(scene, CHAIN_Q, CHAIN_V, controls=vp.OpenLoop(breaks), integrator=vp.Gauss(2), **SMALL)
    assert info.value.trajectory.steps == 1


RISE = np.array([0.5, -0.2, 0.1])


def rising(t):
    """Torques (m,) of a time, or (K, m) of times."""
    t = np.asarray(t)[..., None]
    return RISE * (1.0 + 2.0 * t * t)


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(3), vp.Radau(2), vp.RungeKutta4()])
def test_a_function_of_many_times_makes_the_motion_of_one_of_each(integrator):
    scene, called = vp.Scene(vp.planar_chain(3)), []

    def plain(t):
        assert isinstance(t, float)
        called.append(t)
        return rising(t)

    def lists(t):
        return rising(t).tolist()

    def vectorized(t):
        assert t.ndim == 1
        called.append(t)
        return rising(t)

    options = {"dt": 0.01, "steps": 7, "integrator": integrator}
    motion = vp.simulate(scene, CHAIN_Q, CHAIN_V, controls=vp.OpenLoop(plain), check=False, **options)
    assert called == sorted(set(called)), "a time is asked for twice, or before an earlier one"
    called.clear()
    for controls in (vp.OpenLoop(lists), vp.OpenLoop(vectorized, vectorized=True)):
        again = vp.simulate(scene, CHAIN_Q, CHAIN_V, controls=controls, **options)
        np.testing.assert_array_equal(again.u, motion.u)
        np.testing.assert_array_equal(again.q, motion.q)
    # For the motion, for its means, and for its repetition: the first time of each is alone.
    assert len(called) <= 6


def test_where_a_function_of_many_times_fails():
    scene = vp.Scene(vp.planar_chain(3))
    options = {"dt": 0.01, "steps": 7, "integrator": vp.Gauss(2)}
    at = float(3 + vp.Gauss(2).stage_times[1]) * 0.01

    def failed(f, *facts):
        with refused(vp.ControlError, facts) as info:
            vp.simulate(scene, CHAIN_Q, CHAIN_V, controls=vp.OpenLoop(f, vectorized=True), **options)
        return info.value

    def raises(t):
        if (t >= at).any():
            raise RuntimeError("no more")
        return rising(t)

    for f, words in (
        (raises, "RuntimeError"),
        (lambda t: np.where((t >= at)[:, None], np.nan, rising(t)), "[0, 0]"),
    ):
        error = failed(f, words)
        assert (error.step, error.trajectory.steps) == (3, 3)
        assert error.time == pytest.approx(at, abs=1e-15)
    assert failed(lambda t: rising(t).T, "(1, 3)", "(3, 1)").step == 0
    assert failed(lambda t: rising(t[0]), "(1, 3)", "(3,)").step == 0
    failed(lambda t: rising(t)[:3], "times")
    with refused(vp.InputError, "vectorized"):
        vp.OpenLoop(rising, vectorized="no")
    # As many times as controls: rows and columns look alike.
    options["steps"] = 2
    failed(lambda t: rising(t).T, "(1, 3)", "(3, 1)")
