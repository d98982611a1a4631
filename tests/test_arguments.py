"""Whatever is given as an argument: an error of varpin's, or a motion without NaN; never the core beyond its arrays."""

from __future__ import annotations

import dataclasses
import warnings

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from refusals import refused

import varpin as vp
from varpin.control.costs import BoundCost, Cost, Expansion

ROBOT = vp.planar_chain(2)
SCENE = vp.Scene(ROBOT)

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
    st.just(object()),
)
SETTINGS = settings(max_examples=80, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))


def require_sound(motion: vp.Trajectory) -> None:
    for name in ("t", "q", "v", "p", "u", "dw", "energy"):
        assert np.isfinite(getattr(motion, name)).all(), name


def attempt(call) -> None:
    """An error of varpin's, or a sound motion; overflow on the way to an error is no news."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            motion = call()
        except vp.VarpinError:
            return
    require_sound(motion)


@SETTINGS
@given(name=st.sampled_from(["gravity", "damping", "stiffness", "rest", "actuation", "noise", "robot"]), value=anything)
def test_scene(name, value):
    def run():
        given_robot = {"robot": ROBOT} | {name: value}
        scene = vp.Scene(given_robot.pop("robot"), **given_robot)
        u = np.ones(scene.controls)
        return vp.simulate(scene, [0.1, 0.2], [0.3, 0.4], dt=1e-3, steps=5, controls=u, rng=0)

    attempt(run)


@SETTINGS
@given(
    kind=st.sampled_from([vp.AdditiveNoise, vp.ControlNoise, vp.StateNoise, lambda x: vp.StateNoise(1.0, x)]),
    value=anything,
)
def test_noise(kind, value):
    def run():
        scene = vp.Scene(ROBOT, noise=kind(value))
        return vp.simulate(scene, [0.1, 0.2], [0.3, 0.4], dt=1e-3, steps=5, controls=[1.0, 1.0], rng=0)

    attempt(run)


@SETTINGS
@given(
    name=st.sampled_from(["q0", "v0", "dt", "controls", "increments", "rng", "integrator", "period"]),
    value=anything,
    integrator=st.sampled_from([vp.Midpoint(), vp.Gauss(2), vp.RungeKutta4(), vp.SemiImplicitEuler()]),
)
def test_simulate(name, value, integrator):
    options = {"q0": [0.1, 0.2], "v0": [0.3, 0.4], "dt": 1e-3, "integrator": integrator} | {name: value}
    attempt(lambda: vp.simulate(SCENE, options.pop("q0"), options.pop("v0"), steps=5, **options))


@SETTINGS
@given(
    state=arrays.arrays(np.float64, (2, 2), elements=numbers),
    dt=st.floats(min_value=0.0, exclude_min=True, allow_infinity=False),
    integrator=st.sampled_from([vp.Midpoint(), vp.Gauss(2), vp.RungeKutta4(), vp.ExplicitEuler()]),
)
def test_numbers_of_any_size(state, dt, integrator):
    attempt(lambda: vp.simulate(SCENE, *state, dt=dt, steps=3, integrator=integrator))


@SETTINGS
@given(
    steps=st.integers(0, 6),
    u=anything,
    gains=st.just(np.ones((5, 2, 4))) | anything,
    reference=st.just(np.ones((5, 4))) | anything,
    hold=st.integers(-1, 5) | anything,
)
def test_policy(steps, u, gains, reference, hold):
    attempt(
        lambda: vp.simulate(
            SCENE, [0.1, 0.2], [0.3, 0.4], dt=1e-3, steps=steps, controls=vp.LinearPolicy(u, gains, reference, hold)
        )
    )


@SETTINGS
@given(name=st.sampled_from(["q0", "v0", "dt", "steps", "paths", "rng", "controls", "quantiles"]), value=anything)
def test_ensemble(name, value):
    scene = vp.Scene(ROBOT, noise=vp.AdditiveNoise(1e-3))
    options = {"q0": [0.1, 0.2], "v0": [0.3, 0.4], "dt": 1e-3, "steps": 5, "paths": 3, "rng": 0} | {name: value}
    if name in ("steps", "paths") and isinstance(value, int) and 1000 < value < 10**12:
        return  # work, not a mistake
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            ensemble = vp.simulate_ensemble(scene, options.pop("q0"), options.pop("v0"), workers=1, **options)
        except vp.VarpinError:
            return
    assert np.isfinite(ensemble.statistics.mean).all()
    if not ensemble.failures:
        assert np.isfinite(ensemble.q).all()


class TestTheCoreGetsWhatFits:
    @pytest.mark.parametrize(
        ("gradient", "hessian"), [((5, 6), (2, 6, 6)), ((5, 6), (6, 6)), ((5, 1), (1, 6, 6)), ((1, 6), (5, 6, 6))]
    )
    def test_costs_of_one_s_own(self, gradient, hessian):
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

    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("q", np.zeros((5, 2))),
            ("q", np.zeros((6, 3))),
            ("v", np.zeros((6, 2), dtype=np.float32)),
            ("u", np.zeros((3, 2))),
            ("dw", np.zeros(5)),
            ("t", np.zeros(0)),
            ("energy", [0.0] * 6),
        ],
    )
    def test_trajectories_changed_by_hand(self, name, value):
        motion = vp.simulate(SCENE, [0.1, 0.2], [0.0, 0.0], dt=1e-3, steps=5)
        with refused(vp.InputError, "trajectory"):
            dataclasses.replace(motion, **{name: value})
