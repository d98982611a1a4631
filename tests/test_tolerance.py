"""Motions that are asked for with a tolerance: errors at all nodes, what is said of them, what goes together."""

from dataclasses import replace

import numpy as np
import pytest
from findings import about
from oracles import Mechanism, exact
from refusals import refused, unnamed

import varpin as vp
from varpin.cli import main
from varpin.integrators import integrator_of
from varpin.simulation import tolerance as search

REST = np.zeros(3)


def chain(**options):
    return vp.Scene(vp.planar_chain(3), **options)


def shake(t):
    return np.array([np.sin(5.0 * t), 0.2, np.cos(3.0 * t)])


def off(scene, motion, torque=None):
    """The largest error of q at nodes, under a torque of time or the controls that the motion holds."""

    def signal(k, q, v):
        return torque or (lambda t: motion.u[k])

    true = exact(scene, motion.q[0], motion.v[0], motion.t, signal)
    return np.abs(motion.q - true.q).max()


BOUND = {"damping": 0.3, "stiffness": 2.0}
ROWS = np.random.default_rng(0).normal(size=(3, 3))


@pytest.mark.parametrize(
    ("scene", "wish", "options"),
    [
        *((BOUND, wish, {}) for wish in (1e-3, 1e-6, 1e-10)),
        ({}, 1e-5, {"controls": vp.OpenLoop(shake)}),
        ({}, 1e-7, {"controls": ROWS}),
        ({}, 1e-7, {"controls": {"joint1": 2.0}}),
        # Where friction turns round no method shows its order.
        ({"forces": vp.CoulombFriction(0.5)}, 1e-4, {}),
        ({"forces": vp.PositionServo(200.0, 20.0)}, 1e-6, {"controls": [0.3, 0.0, -0.2]}),
        ({}, 1e-2, {"integrator": vp.Midpoint(alpha=0.4)}),
        ({"damping": 30.0}, 1e-5, {"integrator": vp.Radau(3)}),
    ],
)
def test_error_at_all_nodes_is_within_the_tolerance_and_told(scene, wish, options):
    scene = chain(**scene)
    motion = vp.simulate(scene, [0.5, 0.0, -0.3], REST, duration=0.6, tolerance=wish, **options)
    of_time = isinstance(options.get("controls"), vp.OpenLoop)
    error, own = off(scene, motion, shake if of_time else None), motion.accuracy
    assert error <= wish
    assert error / 2 <= own.error <= 2 * error
    assert own.met
    assert own.tolerance == wish
    assert (own.integrator, own.dt) == (motion.integrator, motion.dt)
    assert motion.integrator == str(options.get("integrator", motion.integrator))
    assert own.search_steps > 2 * motion.steps
    assert own.search_evaluations > own.search_steps
    assert motion.t[-1] == pytest.approx(0.6, rel=1e-12)


def test_no_more_steps_are_taken_than_the_order_asks_for():
    options = {"duration": 0.5, "tolerance": 1e-4, "integrator": vp.Midpoint()}
    motion = vp.simulate(chain(), [0.5, 0.0, -0.3], REST, **options)
    assert 0.3e-4 < motion.accuracy.error <= 1e-4


def test_rows_of_controls_are_each_held_over_their_part():
    motion = vp.simulate(chain(), REST, REST, duration=0.6, tolerance=1e-4, controls=ROWS)
    np.testing.assert_array_equal(motion.u, np.repeat(ROWS, motion.steps // 3, axis=0))


@pytest.mark.parametrize("jump", [0.1234, *(pytest.param(jump, marks=pytest.mark.slow) for jump in (0.37, 0.777))])
def test_a_torque_that_jumps_inside_steps_is_not_taken_for_met(jump):
    """Steps and half steps may have it on the same side of the times where they look."""
    scene, torque = chain(damping=1.0), np.array([20.0, 0.0, 0.0])
    motion = vp.simulate(
        scene, REST, REST, duration=1.0, tolerance=1e-6, controls=vp.OpenLoop(lambda t: torque * (t < jump))
    )
    end = exact(scene, REST, REST, [0.0, jump, 1.0], lambda k, q, v: lambda t: torque * (t < jump)).q[-1]
    assert np.abs(motion.q[-1] - end).max() < 1e-6 or about(motion.warnings, "tolerance not met")


def policy(on, period=0.05):
    gains = np.tile(-np.hstack([10.0 * np.eye(3), np.eye(3)]), (10, 1, 1))
    return vp.LinearPolicy(np.ones((10, 3)), gains, np.zeros((10, 6)), on=on, period=period)


@pytest.mark.parametrize("on", ["momentum", "velocity", None])
def test_policies_with_a_period(on):
    motion = vp.simulate(chain(), REST, REST, duration=0.5, tolerance=1e-7, controls=policy(on))
    taken = integrator_of(motion.integrator)
    assert motion.steps % 10 == 0
    assert taken.variational == (on != "velocity")

    def signal(k, q, v):
        x = np.append(q, v if on == "velocity" else Mechanism(chain()).mass_matrix(q) @ v)
        u = 1.0 + policy(on).gains[k] @ x
        return lambda t: u

    true = exact(chain(), REST, REST, 0.05 * np.arange(11), signal)
    assert np.abs(motion.q[:: motion.steps // 10] - true.q).max() <= 1e-7


def test_it_is_the_motion_of_its_integrator_and_step_the_same_each_time():
    motion, again = (vp.simulate(chain(), REST, REST, duration=0.5, tolerance=1e-6) for _ in range(2))
    fixed = vp.simulate(
        chain(), REST, REST, dt=motion.dt, steps=motion.steps, integrator=integrator_of(motion.integrator)
    )
    assert motion.q.tobytes() == again.q.tobytes() == fixed.q.tobytes()
    assert motion.accuracy == again.accuracy
    assert motion.warnings == fixed.warnings
    assert fixed.accuracy is None


def test_beyond_rounding_it_says_what_is_reached(caplog):
    motion = vp.simulate(chain(), REST, REST, duration=0.3, tolerance=1e-17)
    assert not motion.accuracy.met
    (warning,) = motion.warnings
    assert about(warning, "tolerance not met")
    assert not unnamed(warning, "1e-17", "rounding", f"{motion.accuracy.error:.2g}")
    assert warning in caplog.text
    assert off(chain(), motion) <= 2 * motion.accuracy.error


def test_a_chaotic_motion_has_no_end(monkeypatch):
    monkeypatch.setattr(search, "_MOST_WORK", 100_000)
    with refused(vp.ToleranceError, "1e-06", "200 s"):
        vp.simulate(chain(), REST, REST, duration=200.0, tolerance=1e-6)


@pytest.mark.parametrize("bend", [0.0, 1.0])
def test_no_more_steps_are_tried_than_there_is_time_for(bend):
    """From rest at an equilibrium the first try is of few steps; from a bend it is too long already."""
    with refused(vp.ToleranceError, "unknown"):
        vp.simulate(chain(), np.zeros(len(REST)) + bend, REST, duration=1e12, tolerance=1e-6)


@pytest.mark.parametrize(
    ("options", "facts"),
    [
        ({"dt": 1e-3, "duration": 1.0, "tolerance": 1e-6}, ("dt", "tolerance")),
        ({"steps": 10, "tolerance": 1e-6}, ("steps", "tolerance")),
        ({"tolerance": 1e-6}, "duration"),
        ({"duration": 1.0, "tolerance": 0.0}, "tolerance"),
        ({"duration": -1.0, "tolerance": 1e-6}, "duration"),
        ({"duration": 1.0, "tolerance": 1e-6, "controls": lambda t, q, v: REST}, "tolerance"),
        ({"duration": 1.0, "tolerance": 1e-6, "controls": np.ones((4, 2))}, ("controls", "(R, 3)")),
        ({"duration": 1.0, "tolerance": 1e-6, "controls": policy(None, None)}, "period"),
        ({"duration": 1.0, "tolerance": 1e-6, "controls": policy(None)}, ("0.05 s", "0.1 s")),
        ({"duration": 1.0, "tolerance": 1e-6, "integrator": vp.Reference()}, "rtol"),
        ({"duration": 1.0, "tolerance": 1e-6, "integrator": "Midpoint"}, "integrator"),
        ({"duration": 1.0}, ("dt", "duration")),
        ({}, "dt"),
        ({"dt": 0.1, "steps": 10, "duration": 1.0}, "dt"),
        ({"dt": 0.3, "duration": 1.0}, ("1 s", "0.3 s")),
    ],
)
def test_what_does_not_go_together(options, facts):
    with refused(vp.InputError, facts):
        vp.simulate(chain(), REST, REST, **options)


def test_duration_in_place_of_steps_or_dt():
    by_steps = vp.simulate(chain(), REST, REST, dt=0.01, steps=30)
    for options in ({"dt": 0.01, "duration": 0.3}, {"steps": 30, "duration": 0.3}):
        motion = vp.simulate(chain(), REST, REST, **options)
        assert motion.steps == 30
        assert motion.q == pytest.approx(by_steps.q, abs=1e-12)
        assert motion.accuracy is None


def test_the_estimate_is_saved(tmp_path):
    motion = vp.simulate(chain(), REST, REST, duration=0.2, tolerance=1e-6)
    path = motion.save(tmp_path / "a.npz")
    assert vp.Trajectory.load(path).accuracy == motion.accuracy
    error = motion.accuracy.error
    assert not unnamed(repr(motion), f"{error:.1e}")
    assert f"{error:.2g}" in motion._repr_html_()
    assert not unnamed(str(motion.accuracy), f"{error:.1e}", "1e-06", motion.integrator)
    plain = replace(motion, accuracy=None).save(tmp_path / "b.npz")
    assert vp.Trajectory.load(plain).accuracy is None
    for entry, value in (("tolerance", np.array([1e-6, 1e-7])), ("integrator", 1.0)):
        np.savez(tmp_path / "b.npz", **{**np.load(path), f"accuracy.{entry}": value})
        with refused(vp.FileError, "accuracy"):
            vp.Trajectory.load(tmp_path / "b.npz")


def test_command(tmp_path, capsys):
    path = tmp_path / "a.npz"
    words = ["simulate", "finger", "--duration", "0.5", "--q0", "0.5"]
    assert main([*words, "--tolerance", "1e-7", "--save", str(path)]) == 0
    motion = vp.Trajectory.load(path)
    assert not unnamed(capsys.readouterr().out, f"error {motion.accuracy.error:.1e}", "1e-07")
    scene = vp.Scene(vp.load_robot("finger"))
    assert motion.accuracy.tolerance == 1e-7
    assert off(scene, motion) <= 1e-7
    assert main([*words, "--tolerance", "1e-4", "--integrator", "Midpoint", "--quiet", "--save", str(path)]) == 0
    assert vp.Trajectory.load(path).integrator == "Midpoint(alpha=0.5)"


def test_a_force_that_is_met_within_a_step_is_in_the_motion():
    high, width, begin = 10.0, 0.06, 0.4

    def ridge(q, v):
        y = np.clip((q - begin) / width, 0.0, 1.0)
        return -high * 30.0 * y**2 * (1.0 - y) ** 2

    def slopes(q, v):
        y = np.clip((q - begin) / width, 0.0, 1.0)
        return np.diag(-high * 60.0 * y * (1.0 - y) * (1.0 - 2.0 * y) / width), np.zeros((1, 1))

    scene = vp.Scene(vp.planar_chain(1), gravity=False, forces=vp.CustomForce(ridge, slopes))
    M = vp.lagrangian_jet(scene, [0.0], [0.0]).Lvv[0, 0]
    motion = vp.simulate(scene, [0.0], [3.0], duration=0.4, tolerance=1e-4)
    assert motion.accuracy.met
    assert motion.v[-1, 0] == pytest.approx(np.sqrt(9.0 - 2.0 * high * width / M), abs=1e-3)
