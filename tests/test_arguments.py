"""Whatever is given as an argument: an error that names it, or a finite result; never the core beyond its arrays."""

import contextlib
import dataclasses
import math
import warnings

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from refusals import named, refused

import varpin as vp
from varpin.control.costs import BoundCost, Cost, Expansion
from varpin.core.arrays import ConstraintRows, Diffusion, Element, Product
from varpin.errors import StepError
from varpin.mechanics.forces import Force
from varpin.mechanics.noise import BoundNoise, Noise

ROBOT = vp.planar_chain(2)
SCENE, NOISY = vp.Scene(ROBOT), vp.Scene(ROBOT, noise=vp.AdditiveNoise(1e-3))
CLEAR = {
    "robot": ROBOT,
    "obstacles": [vp.Obstacle.sphere([2, 0, 0], 0.1)],
    "capsules": {"tip": ([0, 0, 0], [0, 0, -1.0], 0.05)},
}
TIED, CALLED = {"a": "tip", "b": "universe"}, {"f": lambda q, v: np.zeros(2)}
DRAWN = {"field": lambda q, v, u: np.zeros((2, 1)), "processes": 1}
ABLE = {"robot": ROBOT, "frame": "tip", "least": 0.1, "directions": ["x", "z"]}
FINER = {"increments": [[0.1], [0.2]], "dt": 0.1, "rng": 0}

extremes = [0.0, -0.0, 1.0, -1.0, 1e-320, 1e-160, 1e160, -1e160, 1e308, np.inf, np.nan]
numbers = st.floats() | st.sampled_from(extremes)
shapes = st.sampled_from(
    [(), (0,), (1,), (2,), (3,), (1, 2), (2, 1), (2, 2), (5, 2), (5, 1), (2, 5), (0, 2), (5, 2, 4)]
)
anything = st.one_of(
    arrays.arrays(np.float64, shapes, elements=numbers),
    arrays.arrays(np.float64, (2,), elements=numbers),
    arrays.arrays(np.int64, shapes),
    arrays.arrays(np.float32, shapes, elements=st.floats(width=32)),
    arrays.arrays(np.complex128, shapes),
    arrays.arrays(np.bool_, shapes),
    arrays.arrays(np.dtype("U3"), shapes),
    arrays.arrays(object, shapes, elements=st.sampled_from([None, "a", 1, 10**400, object(), [1], 1.0])),
    numbers,
    st.integers(),
    st.none(),
    st.text(max_size=3),
    st.booleans(),
    st.lists(numbers | st.lists(numbers, max_size=3), max_size=3),
    st.sampled_from([[0.1, 0.2], np.array([0.1, 0.2])[::-1], np.asfortranarray(np.ones((5, 2))), {}, {"a": 1}, b"ab"]),
    st.dictionaries(st.sampled_from(["joint1", "joint2", "a", 1]), numbers | st.text(max_size=2), max_size=2),
    st.sampled_from([object(), ROBOT, SCENE, 10**15, lambda: None, lambda t: [0, 0], ["joint1", "joint1"]]),
)
SETTINGS = settings(max_examples=30, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))


def motion(scene=SCENE, q0=(0.1, 0.2), v0=(0.3, 0.4), **changes):
    return vp.simulate(scene, q0, v0, **({"dt": 1e-3, "steps": 5} | changes))


def ensemble(**changes):
    options = {"q0": [0.1, 0.2], "v0": [0.3, 0.4], "dt": 1e-3, "steps": 5, "paths": 3, "rng": 0, "workers": 1}
    return vp.simulate_ensemble(NOISY, **options | changes)


def of_scene(robot=ROBOT, **changes):
    scene = vp.Scene(robot, **changes)
    return vp.simulate(scene, [0.1, 0.2], [0.3, 0.4], dt=1e-3, steps=5, controls=np.ones(scene.controls), rng=0)


def fed(**changes):
    given = {"u": np.ones((5, 2)), "gains": np.ones((5, 2, 4)), "reference": np.ones((5, 4))} | changes
    return motion(controls=vp.LinearPolicy(**given))


def plan(t0=0.0, q0=(0.0, 0.0), v0=(0.0, 0.0), **options):
    solving = {name: options.pop(name) for name in ("check", "second_order", "time_limit") if name in options}
    problem = vp.OptimalControlProblem(SCENE, vp.ControlCost(1.0), q0, v0, dt=0.01, steps=2, t0=t0, **options)
    return vp.solve(problem, **solving).trajectory


def within(function, **usual):
    """The function, of which some arguments have usual values."""
    return lambda **given: function(**usual | given)


def integrated(kind):
    return lambda **given: motion(integrator=kind(**given))


def noisy(kind):
    return lambda **given: of_scene(noise=kind(**given))


LOGGED = {"t": [0.0, 0.1, 0.2], "q": np.ones((3, 2)), "u": np.zeros((3, 2))}


def filtered(**given):
    try:
        return vp.kalman_filter(**({"scene": NOISY, "log": vp.Log(**LOGGED), "q_noise": 1e-3} | given))
    except vp.LinearizationError:
        return None  # it names the step


START = {"scene": SCENE, "q": [0.0, 0.0], "v": [0.0, 0.0]}
DISCRETE = {"scene": SCENE, "q0": [0.0, 0.0], "q1": [0.0, 0.0], "dt": 0.1}

# Each argument of a function is given anything; the others keep their defaults.
FUNCTIONS = {
    "robot": (within(vp.planar_chain, links=2), "links length mass"),
    "load_robot": (within(vp.load_robot, source="ur5"), "package_dirs mimic lock payload"),
    "joint": (within(vp.load_robot, source="ur5"), "keep"),
    "combine": (lambda **given: vp.combine(ROBOT, ROBOT, **given), "prefixes placements"),
    "posture": (ROBOT.posture, "name"),
    "velocity": (ROBOT.velocity, "v"),
    "inspect_robot": (lambda **given: vp.inspect_robot(ROBOT, **given), "meshes"),
    "Scene": (of_scene, "robot gravity damping stiffness rest friction actuation noise forces"),
    "without": (SCENE.without, "joints"),
    "required": (within(SCENE.required, q0=[0.0, 0.0]), "task controls"),
    "frame": (lambda frame: of_scene(forces=vp.FrameWrench(frame, np.ones(6))), "frame"),
    "FrameOnFrame": (lambda **given: of_scene(constraints=vp.FrameOnFrame(**(TIED | given))), "a b"),
    "CustomForce": (lambda **given: of_scene(forces=vp.CustomForce(**(CALLED | given))), "f derivatives"),
    "CustomNoise": (lambda **given: of_scene(noise=vp.CustomNoise(**(DRAWN | given))), "processes check"),
    "cost": (lambda frame: vp.FrameVelocityCost(ROBOT, frame), "frame"),
    "ManipulabilityCost": (within(vp.ManipulabilityCost, **ABLE), "frame directions"),
    "limits": (within(vp.WithinJointLimits, robot=ROBOT), "limits"),
    "part": (lambda **given: motion().part(**({"begin": 1, "end": 2} | given)), "begin end"),
    "simulate": (motion, "scene q0 v0 dt steps controls increments rng integrator period check"),
    "simulate_ensemble": (ensemble, "q0 v0 dt steps paths rng controls quantiles store progress integrator"),
    "policy": (fed, "u gains reference hold on limits before period previous_gains integrator"),
    "OpenLoop": (lambda **given: motion(controls=vp.OpenLoop(**given)), "f"),
    "Midpoint": (integrated(vp.Midpoint), "alpha guard tolerance kick"),
    "Gauss": (integrated(vp.Gauss), "stages"),
    "Reference": (integrated(vp.Reference), "rtol atol"),
    "Guard": (
        lambda **given: motion(integrator=vp.Gauss(2, guard=vp.Guard(**given))),
        "branch_margin energy_balance energy_budget max_halvings",
    ),
    "solve": (plan, "t0 q0 v0 check second_order time_limit integrator"),
    "lagrangian_jet": (within(vp.lagrangian_jet, **START), "q v backend"),
    "v": (within(vp.discrete_lagrangian, **DISCRETE), "q0 q1 dt alpha"),
    "configuration": (ROBOT.configuration, "q"),
    "propagate_moments": (vp.propagate_moments, "linearization"),
    "Log": (within(vp.Log, **LOGGED), "t q u v joints controls"),
    "kalman_filter": (filtered, "log q_noise external dt q0 v0 covariance integrator"),
    "refine": (within(vp.wiener.refine, **FINER), "increments dt rng"),
    "wiener_increments": (lambda dt: vp.wiener.wiener_increments(1, dt, 3, rng=0), "dt"),
    "KeepClear": (within(vp.KeepClear, **CLEAR), "obstacles capsules itself"),
    "link": (within(vp.KeepClear, **CLEAR), "links"),
    "AdditiveNoise": (noisy(vp.AdditiveNoise), "intensity"),
    "ControlNoise": (noisy(vp.ControlNoise), "intensity"),
    "StateNoise": (noisy(vp.StateNoise), "intensity"),
    "center": (noisy(within(vp.StateNoise, intensity=1.0)), "center"),
}


def require_finite(found) -> None:
    for name in ("t", "q", "v", "p", "u", "dw", "energy"):
        values = getattr(found, name, None)
        if isinstance(found, vp.Trajectory | vp.Estimate) or (isinstance(found, vp.Ensemble) and values is not None):
            assert values is None or np.isfinite(values).all() or getattr(found, "failures", ()), name


@pytest.mark.parametrize(
    ("function", "argument"), [(name, argument) for name, (_, own) in FUNCTIONS.items() for argument in own.split()]
)
@SETTINGS
@given(value=anything)
def test_an_argument_is_refused_by_name_or_gives_finite_numbers(function, argument, value):
    most = {"steps": 10**12, "paths": 10**12, "links": math.inf}.get(argument, 0)
    if isinstance(value, int) and 20 < value < most:
        return  # work, not a mistake
    refusal = ""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            require_finite(FUNCTIONS[function][0](**{argument: value}))
        except (vp.StepFailure, StepError, vp.UnknownFrame, vp.UnknownJoint):
            return  # they name the step, or what the robot lacks
        except vp.VarpinError as error:
            # Where all paths of an ensemble fail under numbers of any size, that is all there is to say.
            refusal = "" if type(error) is vp.VarpinError else str(error)
    assert not refusal or named(argument, refusal) or named(function, refusal), refusal


@SETTINGS
@given(
    state=arrays.arrays(np.float64, (2, 2), elements=numbers),
    dt=st.floats(min_value=0.0, exclude_min=True, allow_infinity=False),
    integrator=st.sampled_from([vp.Midpoint(), vp.Gauss(2), vp.RungeKutta4(), vp.ExplicitEuler()]),
)
def test_numbers_of_any_size(state, dt, integrator):
    with warnings.catch_warnings(), contextlib.suppress(vp.VarpinError):
        warnings.simplefilter("ignore")
        require_finite(vp.simulate(SCENE, *state, dt=dt, steps=3, integrator=integrator))


# What has to be refused, and what the message names.
REFUSED = [
    *((name, value, facts) for name in ("q0", "v0") for value, facts in (
        ([0.0, np.nan], ("[1]", "nan")), ([np.inf, 0.0], ("[0]", "inf")), ([0.0], ("(2,)", "(1,)")),
        (0.0, ("(2,)", "()")), ("text", "real numbers"))),
    *(("dt", value, str(value)) for value in (0, -0.01, np.nan, np.inf, True)),
    *((name, None, ("dt", "steps", "duration", "tolerance")) for name in ("dt", "steps")),
    *(("steps", value, repr(value)) for value in (-1, 2.5, "5")),
    ("steps", 10**15, ("1000000000000000", "memory")),
    *(("controls", np.zeros(shape), ("(5, 2)", "(2,)", str(shape))) for shape in ((4, 2), (5, 3), (3,), ())),
    ("controls", np.array([[0, 0]] * 4 + [[0, np.nan]]), ("controls[4, 1]", "nan")),
    ("controls", lambda t: [0.0, 0.0], ("(t, q, v)", "varpin.OpenLoop(f)")),
    ("integrator", vp.Midpoint, "varpin.Midpoint()"),
    ("period", 0, "0"),
    ("period", 2, "period = 2"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value", "facts"), REFUSED)
def test_arguments_of_a_motion(name, value, facts):
    with refused(vp.InputError, name, facts):
        motion(**{name: value})


@pytest.mark.parametrize("integrator", [None, vp.Midpoint(), vp.RungeKutta4()], ids=str)
@pytest.mark.parametrize("kind", ["law", "open loop"])
@pytest.mark.parametrize(
    ("value", "facts"),
    [
        (lambda: [1.0], ("(2,)", "(1,)")),
        (lambda: [0.0, np.nan], ("[1]", "nan")),
        (lambda: None, "None"),
        (lambda: 0.0, ("(2,)", "()")),
        (lambda: 1 / 0, "ZeroDivisionError('division by zero')"),
    ],
)
def test_control_functions(integrator, kind, value, facts):
    # Laws are called where a step begins, functions of time within it.
    def swing(t):
        return [0.1, 0.2] if t < (3e-3 if kind == "law" else 3.3e-3) else value()

    controls, source = (lambda t, q, v: swing(t)), "controls(t, q, v)"
    if kind == "open loop":
        controls, source = vp.OpenLoop(swing), "OpenLoop: f(t)"
    with refused(vp.ControlError, "step 3", "t = ", source, facts, "error.trajectory") as info:
        motion(controls=controls, integrator=integrator)
    error, whole = info.value, motion(steps=3, controls=[0.1, 0.2], integrator=integrator)
    assert (error.step, error.trajectory.steps) == (3, 3)
    assert 3e-3 - 1e-12 <= error.time < 4e-3
    np.testing.assert_allclose(error.trajectory.q, whole.q, rtol=0, atol=1e-14)
    np.testing.assert_allclose(error.trajectory.u, whole.u, rtol=1e-14)
    assert isinstance(error.__cause__, ZeroDivisionError) == ("ZeroDivisionError" in facts)


def test_a_law_is_refused_for_an_ensemble_and_a_broken_open_loop_ends_it():
    with refused(vp.InputError, "simulate"):
        ensemble(controls=lambda t, q, v: [0.0, 0.0])
    with refused(vp.ControlError, "step 1", "OpenLoop", "(2,)") as info:
        ensemble(controls=vp.OpenLoop(lambda t: [0.0, 0.0] if t < 1e-3 else [0.0]))
    assert info.value.trajectory is None


@pytest.mark.parametrize("state", [{"q0": [1e308, 0.0]}, {"v0": [1e200, 0.0]}, {"v0": [1e160, -1e160]}])
def test_numbers_beyond_reason_fail_and_say_where(state):
    with refused(vp.StepFailure, "step 0", "t = 0 s", "dt") as info:
        motion(**state)
    assert info.value.trajectory.steps == 0


@pytest.mark.parametrize("field", Diffusion._fields)
@pytest.mark.parametrize("value", [np.zeros((1, 1)), np.zeros((9, 9)), None, np.full((2, 2), np.inf, dtype="f4")])
def test_noise_of_one_s_own(field, value):
    class Own(Noise):
        def bind(self, actuation, joints):
            fields = Diffusion(np.zeros((2, 2)), np.zeros((2, 2, 2)), np.zeros((2, 2)), np.zeros((2, 2)))
            return BoundNoise(fields._replace(**{field: value}))

    # Without the first array not even the number of processes is there.
    unknown = field == "constant" and value is None
    with pytest.raises((vp.InputError, AttributeError) if unknown else vp.InputError):
        vp.Scene(ROBOT, noise=Own())


@pytest.mark.parametrize("part", [1.0, "JointDamper", Element("JointDamper", 0, (np.nan,))])
def test_forces_of_one_s_own(part):
    class Own(Force):
        def bind(self, robot):
            return (part,)

    with refused(vp.InputError, "Own.bind", repr(part)):
        vp.Scene(ROBOT, forces=Own())


@pytest.mark.parametrize(
    ("changes", "fact"),
    [
        ({"aligned": ((0, 1),)}, "aligned"),
        ({"aligned": ((1, 99),)}, "aligned"),
        ({"aligned": ((1, -1),)}, "aligned"),
        ({"labels": ()}, "label"),
        ({"labels": ("a", "b")}, "label"),
        ({"rows": ConstraintRows((), (Product(0, 99, 1.0, 0.0),))}, "vectors"),
        (None, "NoneType"),
    ],
)
def test_constraints_of_one_s_own(changes, fact):
    class Own(vp.PointOnPoint):
        def bind(self, robot):
            return None if changes is None else super().bind(robot)._replace(**changes)

    with refused(vp.InputError, "Own.bind", fact):
        vp.Scene(ROBOT, constraints=Own("tip", (1.0, 0.0, 0.0), axes="x"))


@pytest.mark.parametrize(
    ("gradient", "hessian"), [((5, 6), (2, 6, 6)), ((5, 6), (6, 6)), ((5, 1), (1, 6, 6)), ((1, 6), (5, 6, 6))]
)
def test_costs_of_one_s_own(gradient, hessian):
    class Bound(BoundCost):
        def value(self, q, v, u):
            return np.zeros(q.shape[:-1])

        def expand(self, q, v, u):
            return Expansion(np.zeros(gradient), np.zeros(hessian))

    class Own(Cost):
        def bind(self, points):
            return Bound()

    problem = vp.OptimalControlProblem(SCENE, Own() + vp.ControlCost(1.0), [0, 0], [0, 0], dt=1e-3, steps=5)
    with refused(vp.CostError, "shapes"):
        vp.solve(problem)


CHANGED = {"q": [(5, 2), (6, 3)], "u": [(3, 2)], "t": [(0,)], "constraint_forces": [(5, 1)]}
CHANGED |= {"u_stages": [(5, 2, 1)], "u_nodes": [(6, 3)], "error": [(5, 2)]}


@pytest.mark.parametrize(("name", "shape"), [(name, shape) for name, own in CHANGED.items() for shape in own])
def test_trajectories_changed_by_hand(name, shape):
    with pytest.raises(ValueError, match="must be a float64 array"):
        vp.linearize(SCENE, dataclasses.replace(motion(), **{name: np.zeros(shape)}))
