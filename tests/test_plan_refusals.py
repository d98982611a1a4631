"""What problems, costs, searches, plans, controllers and policies refuse, by the names of their arguments."""

import numpy as np
import pytest
from plan_problems import CAPSULES, REST, SMALL, TWO, linear, reach, small, wave
from refusals import refused

import varpin as vp

BEFORE = np.array([0.7, -0.3])
BALL = vp.Obstacle.sphere([1.0, 0.0, 0.0], 0.1, name="ball")
MOVING = BALL.moving(lambda t: [0.0, 0.0])


class Wrapped(vp.Cost):
    def bind(self, points):
        return vp.ControlRateCost(1.0).bind(points)


def policy(**options):
    return vp.LinearPolicy(np.zeros((3, 2)), np.zeros((3, 2, 4)), np.zeros((3, 4)), **options)


def rated(weight=1.0, before=None):
    return linear(vp.ControlRateCost(weight, before))


def clear(**given):
    return vp.KeepClear(TWO, **{"obstacles": [BALL], "capsules": CAPSULES, **given})


def mpc():
    return vp.Mpc(wave())


def plan():
    return vp.solve(reach(), max_iterations=1, check=False)


OF_PROBLEMS = [
    (lambda: small(dt=0.0), "dt"),
    (lambda: small(steps=0), ("steps", "1")),
    (lambda: small(hold=3), ("steps = 20", "hold = 3")),
    (lambda: small(hold=0), ("hold", "1")),
    (lambda: small(sampling="end"), "sampling"),
    (lambda: small(integrator="rk4"), "integrator"),
    (lambda: small(actuation=[]), "controls"),
    (lambda: small("cheap"), "cost"),
    (lambda: small().at(q0=[0.0]), "q0"),
    (lambda: small().at(v0=[0.0, np.inf]), "v0"),
    (lambda: small().cost_of(vp.simulate(small().scene, REST, REST, dt=0.05, steps=3)), "3 steps"),
    (lambda: small().cost_of(np.zeros((21, 2))), ("motion", "varpin.Trajectory")),
    (lambda: small().cost_of(vp.solve(wave(), max_iterations=0).trajectory), "joints"),
    (lambda: small(actuation=[[1.0], [0.0]]).cost_of(small().simulate([0, 0])), ("1", "2", "controls")),
    (lambda: small(controls="cubic"), ("controls", "'held'", "'linear'")),
    (lambda: small(controls="linear", hold=2), "hold"),
    # The optimum of a midpoint sum alternates freely: its controls cost nothing in the middle of a step.
    (lambda: small(controls="linear", sampling="midpoint"), ("'midpoint'", "linear")),
    (lambda: small(controls="linear", sampling="start"), ("'start'", "linear")),
    (lambda: reach(control_limits=(1.0, -1.0)), ("control_limits", "1", "-1", "0")),
    (lambda: reach(control_limits=(-1.0, np.nan)), ("control_limits", "upper[0]", "NaN")),
    (lambda: reach(control_limits=([-1.0] * 3, 1.0)), ("control_limits", "lower", "(2,)", "(3,)")),
    (lambda: reach(control_limits=3.0), ("control_limits", "pair")),
    (lambda: reach(control_limits=(np.inf, np.inf)), ("control_limits", "inf")),
    (lambda: vp.ControlRateCost(-1.0), ("ControlRateCost", "weight", "positive semidefinite")),
    (lambda: vp.Terminal(vp.ControlRateCost()), ("ControlRateCost", "terminal")),
    (lambda: linear(Wrapped()), "cost"),
    (lambda: rated([1.0, 1.0, 1.0]), ("2", "(3,)")),
    (lambda: rated(before=np.nan), ("ControlRateCost", "before", "nan")),
    (lambda: rated(before=np.zeros((2, 2))), ("before", "(2, 2)")),
    (lambda: rated(before=np.zeros(3)), ("before", "(2,)", "(3,)")),
    (lambda: rated().at(before=np.zeros(3)), ("before", "(2,)", "(3,)")),
    (lambda: linear(vp.ControlRateCost() + vp.ControlRateCost(1.0, BEFORE)), ("ControlRateCost", "before")),
    (lambda: linear().at(before=BEFORE), ("before", "ControlRateCost", "WithinControlRate")),
]
OF_COSTS = [
    (lambda: vp.TrackingCost(0.0, np.nan), ("TrackingCost", "weight", "nan")),
    (lambda: vp.TrackingCost(0.0, [1.0, np.inf]), ("weight[1]", "inf")),
    (lambda: vp.TrackingCost(0.0, [[1.0, 2.0], [2.0, 1.0]]), ("positive semidefinite", "-1")),
    (lambda: vp.ControlCost(np.ones((2, 3))), ("weight", "(2, 3)")),
    (lambda: vp.ControlCost("heavy"), ("ControlCost", "weight", "'heavy'")),
    (lambda: vp.TrackingCost("home"), ("TrackingCost", "reference", "'home'")),
    (lambda: vp.Terminal(vp.TrackingCost(0.0) + 2.0 * vp.ControlCost()), ("ControlCost", "terminal")),
    (lambda: vp.Terminal(vp.Terminal(vp.TrackingCost(0.0))), "Terminal"),
    (lambda: vp.Terminal(1.0), ("Terminal", "float")),
    (lambda: -1.0 * vp.TrackingCost(0.0), "-1"),
    (lambda: vp.CustomCost(3), ("CustomCost", "function", "3")),
    (lambda: vp.CustomCost(print, 3.0, name="mine"), ("mine", "derivatives")),
    (lambda: small(vp.ControlCost(1.0, np.zeros((19, 2)))), ("(20, 2)", "(19, 2)")),
    (lambda: small(vp.ControlCost([1.0, 1.0, 1.0])), ("weight", "2", "(3,)")),
    (lambda: small(vp.TrackingCost(np.zeros((20, 2)))), ("(21, 2)", "(20, 2)")),
    (lambda: small(vp.TrackingCost([0.0, 0.0, 0.0])), ("(2,)", "(21, 2)", "(3,)")),
    (lambda: small(vp.Terminal(vp.TrackingCost([0.0, np.nan]))), ("TrackingCost", "reference[1]", "nan")),
]
OF_CONSTRAINTS = [
    (lambda: reach(vp.JointTie("joint1", "joint2")), "varpin.Scene"),
    (lambda: reach(vp.WithinJointLimits(vp.planar_chain(3), (-1, 1))), "robot"),
    (lambda: vp.WithinVelocityLimits(TWO), "limits"),
    (lambda: vp.ReachFrame(TWO, "tip"), ("position", "rotation")),
    (lambda: vp.ReachFrame(TWO, "tip", rotation=2.0 * np.eye(3)), "rotation matrix"),
    (lambda: vp.WithinControlRate(0.0), ("limit", "0")),
    (lambda: vp.WithinJointLimits(TWO, (-1, 1), margin=-1.0), ("margin", "0")),
    (lambda: reach(vp.WithinControlRate(1.0, before=np.nan)), ("before", "nan")),
    (lambda: reach(between_nodes="yes"), "between_nodes"),
    (lambda: clear(obstacles=None), "obstacles"),
    (lambda: clear(itself="no"), "itself"),
    (lambda: clear(links=["joint1", "joint1"]), "twice"),
    (lambda: clear(capsules={"joint1": 0.05}), "begin"),
    (lambda: clear(capsules=[0.05]), "capsules"),
    (lambda: BALL.moving([0.0, 0.0, 1.0]), "function"),
    (lambda: MOVING.moving(lambda t: [0.0, 0.0, 0.0]), "moves already"),
    (lambda: reach(clear(obstacles=[MOVING])), ("'ball'", "0.06")),
    (lambda: reach(vp.KeepOutOfSphere(TWO, "tip", lambda t: [np.nan, 0.0, 0.0], 0.1)), ("center", "finite")),
]
OF_SEARCHES = [
    (lambda: vp.solve("finger"), ("OptimalControlProblem", "str")),
    (lambda: vp.solve(small(), tolerance=0.0), "tolerance"),
    (lambda: vp.solve(small(), tolerance=np.nan), "tolerance"),
    (lambda: vp.solve(small(), regularization=-1.0), "regularization"),
    (lambda: vp.solve(small(), max_iterations=1.5), "max_iterations"),
    (lambda: vp.solve(small(), max_iterations=-1), ("max_iterations", "0")),
    (lambda: vp.solve(small(), time_limit=0.0), "time_limit"),
    (lambda: vp.solve(small(), true_cost=0.0), "true_cost"),
    (lambda: vp.solve(reach(), true_cost=0.1, resume=SMALL["held"].plan), ("resume", "true_cost")),
    (lambda: vp.solve(small(integrator=vp.ExplicitEuler()), second_order=True), "ExplicitEuler"),
    (lambda: vp.solve(small(hold=2), np.zeros((20, 2))), ("controls", "(10, 2)", "(20, 2)")),
    (lambda: vp.solve(small(), [np.nan, 0.0]), "controls"),
    (lambda: vp.solve(small(hold=2), vp.solve(small())), ("controls", "1", "2")),
    (lambda: vp.solve(small(steps=40), vp.solve(small())), ("20", "40")),
    (lambda: vp.solve(reach(), SMALL["linear"].plan), "linear"),
    *((lambda x=x: SMALL["held"].plan.shifted(x), "decisions") for x in (-1, 12, 1.5)),
    *((lambda x=x: plan().verify(tolerance=x), "tolerance") for x in (0.0, -1.0, np.nan, "tight")),
    *((lambda x=x: plan().monte_carlo(x, 0), "paths") for x in (1, 0, 2.5)),
]
OF_CONTROLLERS = [
    (lambda: policy(previous_gains=np.eye(2)), ("previous_gains", "(3, 2, 2)", "(2, 2)")),
    (lambda: policy(previous=np.zeros((3, 2))), ("previous", "previous_gains")),
    (lambda: policy(before=[0.0]), ("before", "(2,)", "(1,)")),
    (lambda: policy(linear=True), "before"),
    (lambda: policy().control(3, np.zeros(4)), ("interval", "0", "2", "3")),
    (lambda: vp.FirstOrderHold(np.zeros(3)), ("node", "(3,)")),
    (lambda: vp.FirstOrderHold([[0.0], [np.nan]]), "finite"),
    (lambda: small().simulate(vp.FirstOrderHold(np.zeros((3, 2)))), ("FirstOrderHold", "u", "(21, 2)", "(3, 2)")),
    (lambda: vp.Mpc("x"), ("problem", "OptimalControlProblem", "str")),
    (lambda: vp.Mpc(wave(), iterations=0), "iterations"),
    (lambda: vp.Mpc(wave(), budget=-1.0), "budget"),
    (lambda: mpc().run(vp.Plant(vp.Scene(TWO)), duration=1.0), "joints"),
    (lambda: mpc().run(duration=0.16).planned(-0.1), ("ahead", "0")),
    (lambda: mpc().run(duration=0.16).planned(np.nan), ("ahead", "0")),
    (lambda: mpc().run(duration=0.0), "duration"),
    (lambda: mpc().run(wave().scene, duration=0.1), ("plant", "varpin.Plant")),
    (lambda: mpc().run(duration=0.1, rng="a"), "rng"),
    (lambda: mpc().plan(0.0, [0.0], np.zeros(3)), "q0"),
    (lambda: mpc().plan(0.05, np.zeros(3), np.zeros(3), 3), ("previous", "int")),
    (lambda: mpc().plan(0.05, np.zeros(3), np.zeros(3), None, -1), ("decisions", "-1")),
    (lambda: vp.Plant(wave().scene, "rk"), "integrator"),
]


@pytest.mark.parametrize(("make", "facts"), [*OF_PROBLEMS, *OF_COSTS, *OF_CONSTRAINTS, *OF_SEARCHES, *OF_CONTROLLERS])
def test_it_is_refused(make, facts):
    with refused(vp.InputError, facts):
        make()
