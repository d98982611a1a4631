"""Logs as they come from arms, with what is wrong with them: one clear error, a warning that fits, or right values."""

import numpy as np
import pinocchio as pin
import pytest
from refusals import naming, refused
from ur5_logs import NAMES, NOISE, TRUTH, motion, start

import varpin as vp

ORDER = [2, 1, 0, 3, 4, 5]  # as joint states come by name, the elbow first


def measured(late=0):
    """Times, positions with noise and torques that act ``late`` ms later than they are told."""
    q, u = motion(late, duration=1.5)
    return 1e-2 * np.arange(len(q)), q + NOISE * np.random.default_rng(0).standard_normal(q.shape), u


def found(t, q, u, joints=None, **options):
    log = vp.Log(t, q, u, joints=joints, controls=start().robot.joint_names)
    return vp.identify(start(), log, NAMES, q_noise=NOISE, **options)


def spoiled(values, at, by):
    changed = values.copy()
    changed[at] = by
    return changed


REFUSED = {
    "milliseconds": (lambda t, q, u: (1e3 * t, q, u), ("10 s", "milliseconds")),
    "a dead encoder": (lambda t, q, u: (t, spoiled(q, np.s_[:, 3], 0.0), u), ("'wrist_1_joint'", "encoder")),
    "a dead encoder's gaps": (lambda t, q, u: (t, spoiled(q, np.s_[:, 3], np.nan), u), ("'wrist_1_joint'", "samples")),
    "gaps in the controls": (lambda t, q, u: (t, q, spoiled(u, (50, 2), np.nan)), ("u[50, 2]", "nan")),
    "degrees": (lambda t, q, u: (t, np.degrees(q) + 360.0, u), ("q of", "degrees")),
    "rows out of order": (lambda t, q, u: (spoiled(t, 50, 0.2), q, u), ("t[50]", "sort")),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_no_value_could_be_right_from_is_refused(what):
    change, facts = REFUSED[what]
    with refused(vp.InputError, *facts):
        found(*change(*measured()))


WARNED = {
    "a clock that is fast by 1 %": (lambda t, q, u: (1.01 * t, q, u), ("clock", "q_noise")),
    "an encoder of the other sign": (
        lambda t, q, u: (t, q * [1, 1, -1, 1, 1, 1], u),
        ("'elbow_joint'", "opposite sign"),
    ),
    "columns in another order": (lambda t, q, u: (t, q[:, ORDER], u[:, ORDER]), ("column", "q_noise")),
    "an encoder that dies": (lambda t, q, u: (t, spoiled(q, np.s_[70:, 3], q[70, 3]), u), ("q_noise",)),
}


@pytest.mark.parametrize("what", WARNED)
@pytest.mark.filterwarnings("error")
def test_what_does_not_fit_is_told_first(what):
    each = found(*WARNED[what][0](*measured()), evaluations=5)
    assert naming(each.warnings[:1], *WARNED[what][1]), each.warnings
    assert np.abs(each.values / TRUTH - 1.0).max() > 0.02


def wrong(log, scene):
    """What is told of the order and the signs of columns."""
    kinds = "sign of the columns", "order of the columns"
    return [each for each in log.matched(scene).warnings if each.kind in kinds]


TURNED = {
    # What it carries would hide that of the first wrist joint.
    "torques of all joints": ([0, 1, 2, 4, 5], lambda t, q, u: vp.Log(t, q, -u)),
    "torques of a joint": ([0], lambda t, q, u: vp.Log(t, q, u * [-1, 1, 1, 1, 1, 1])),
    "torques of another": ([5], lambda t, q, u: vp.Log(t, q, u * [1, 1, 1, 1, 1, -1])),
    "an encoder": ([2], lambda t, q, u: vp.Log(t, q * [1, 1, -1, 1, 1, 1], u)),
    "another encoder": ([1], lambda t, q, u: vp.Log(t, q * [1, -1, 1, 1, 1, 1], u)),
    "none": ([], vp.Log),
    "none, but friction": ([], lambda t, q, u: vp.Log(t, q, u + 9.0 * np.sign(np.gradient(q, axis=0)))),
    "none, and strong drives": ([], lambda t, q, u: vp.Log(t, q, 0.5 * u)),
}


@pytest.mark.parametrize("what", TURNED)
def test_turned_signs_are_told(what):
    joints, change = TURNED[what]
    told = wrong(change(*measured()), start())
    assert all(each.kind == "sign of the columns" for each in told)
    named = [k for k, name in enumerate(start().robot.joint_names) if any(name in warning for warning in told)]
    assert named == joints


@pytest.mark.parametrize("what", ["q", "u", "q and u"])
def test_swapped_columns_are_told(what):
    order, (t, q, u) = [4, 1, 2, 3, 0, 5], measured()
    log = vp.Log(t, q[:, order] if "q" in what else q, u[:, order] if "u" in what else u)
    (told,) = wrong(log, start())
    assert f"'shoulder_pan_joint' and 'wrist_2_joint' in {what} look swapped" in told


@pytest.mark.parametrize("name", ["ur5", "kinova", "xarm7", "panda"])
def test_no_right_log_is_told_to_be_wrong(name):
    """Torques are those of Pinocchio for what the arm carries, on its way along waves, with friction and dampers."""
    lock = {"lock": {"panda_finger_joint1": 0.0}} if name == "panda" else {}
    robot = vp.load_robot(name, **lock)
    scene = vp.Scene(robot, damping=0.0, friction=0.0)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        carrying = vp.load_robot(name, payload=vp.Payload(robot.end_effector, rng.uniform(0.0, 3.0)), **lock).model
        middle, phase = rng.uniform([[-2.0], [0.0]], [[2.0], [6.0]], (2, robot.dof))
        rate, size = 2.0 * np.pi * rng.uniform(0.3, 1.2, robot.dof), rng.uniform(0.1, 0.4, robot.dof)
        level, damping = rng.uniform(0.0, [[5.0], [3.0]], (2, robot.dof))
        t = 1e-2 * np.arange(300)[:, None]
        # A control acts until the next sample.
        angle = rate * (t + 5e-3) + phase
        v = size * rate * np.cos(angle)
        at = map(robot.configuration, middle + size * np.sin(angle))
        states = zip(at, v, -size * rate**2 * np.sin(angle), strict=True)
        u = np.array([pin.rnea(carrying, carrying.createData(), *each) for each in states])
        q = middle + size * np.sin(rate * t + phase) + NOISE * rng.standard_normal(u.shape)
        assert not wrong(vp.Log(t[:, 0], q, u + level * np.sign(v) + damping * v), scene)


@pytest.mark.parametrize("what", ["as it is", "named columns", "gaps", "an epoch's clock", "late torques"])
def test_values_are_right_all_the_same(what):
    late = 8 * (what == "late torques")
    t, q, u = measured(late)
    names = tuple(start().robot.joint_names[k] for k in ORDER)
    given = {
        "named columns": (t, q[:, ORDER], u, names),
        "gaps": (t, np.where(np.random.default_rng(1).random(q.shape) < 0.1, np.nan, q), u),
        "an epoch's clock": (t + 1.7e9, q, u),
    }
    each = found(*given.get(what, (t, q, u)))
    assert (np.abs(each.values - TRUTH) < 5.0 * each.deviations).all()
    assert each.delay == pytest.approx(1e-3 * late, abs=1e-4)
    assert bool(naming(each.warnings, "controls", "later")) == bool(late)
