"""The battery of extreme scenes: its checks can fail, its kinds mean what they say, and it finds nothing silent."""

import csv
import dataclasses
import math

import battery
import numpy as np
import pytest
from battery import TRIALS, Bench, Trial, period_error
from mechanisms import rod_chain, slider

import varpin as vp
from varpin.cli import main
from varpin.finding import Finding
from varpin.mechanics.wiener import wiener_increments
from varpin.study import checks
from varpin.study import extremes as robot_checks
from varpin.study.checks import LEVELS
from varpin.study.extremes import INTEGRATORS, Kind

BY_NAME = {trial.name: trial for trial in TRIALS}
assert len(BY_NAME) == len(TRIALS)


def made_up(scene, v0, dt=1e-2, steps=100, window=1.0, **options):
    given = {"controls": None, "increments": None, "ahead": 0.0, "window": window} | options
    return Bench("made up", dt, steps, scene, np.zeros(len(v0)), np.array(v0), **given)


def falling(dt=1e-2, steps=100, window=0.5, **scene):
    own = made_up(vp.Scene(rod_chain([1.0] * 3, [1.0] * 3), **scene), [0.0, 1.0, 0.0], dt, steps, window)
    return own, vp.simulate(own.scene, own.q0, own.v0, dt=dt, steps=steps, integrator=vp.Midpoint())


def tampered(trajectory, **changes):
    return dataclasses.replace(trajectory, warnings=(), **changes)


def run_one(own, integrator=INTEGRATORS[1], **options):
    (found,) = battery.run([Trial(own.name, lambda: own)], integrators=[integrator], **options).runs
    return found


@pytest.fixture
def hasty(monkeypatch):
    """Little time for the exact motions over periods, which decide nothing here."""
    monkeypatch.setattr("battery._PATIENCE_PERIODS", 0.1)
    monkeypatch.setattr("battery._PATIENCE_PERIOD", 0.1)


# --- each check can fail -------------------------------------------------------------------------------------------


def test_a_sound_motion_passes_every_check():
    own, motion = falling(gravity=False, window=0.3)
    found = checks.measures(own.scene, vp.Midpoint(), motion, own.exact())
    assert found.keys() == LEVELS.keys()
    assert not any(math.isnan(value) for value in found.values())
    assert checks.findings(found) == ()
    assert found["error"] < 1e-2
    assert found["symplecticity"] < 1e-13


def leaking(motion):
    """Energy that is made up: a fifth of the largest kinetic one over the motion."""
    kinetic = (0.5 * motion.p * motion.v).sum(axis=1).max()
    return {"energy": motion.energy + np.linspace(0.0, 0.2 * kinetic, len(motion.energy))}


def overflowing(motion):
    return {"energy": np.where(np.arange(len(motion.energy)) == 50, np.inf, motion.energy)}


def drifting(motion):
    """Momenta that leak by a hundred-thousandth."""
    return {"p": motion.p * np.linspace(1.0, 1.0 + 1e-5, len(motion.p))[:, None]}


@pytest.mark.parametrize(
    ("gravity", "fault", "broken"),
    [(True, leaking, {"energy", "record"}), (True, overflowing, {"energy"}), (False, drifting, {"record"})],
)
def test_records_that_are_made_up_are_found(gravity, fault, broken):
    """Pinocchio knows better what energies and momenta are."""
    own, motion = falling(gravity=gravity)

    def names(m):
        found = {"energy": checks.energy_error(own.scene, m), "record": checks.record_error(own.scene, m)}
        return {text.split()[0] for text in checks.findings(found)}

    assert (names(motion), names(tampered(motion, **fault(motion)))) == (set(), broken)


def test_a_wrong_root_is_found_by_the_reference():
    # Another root of the step equation of a rod: it goes the long way round, and every record of it is consistent.
    own, motion = falling()
    turn = np.zeros_like(motion.q)
    turn[40:, 2] = 2.0 * math.pi
    exact = own.exact()
    assert len(exact.nodes) > 20
    assert exact.errors(motion)["error"] < 1e-2
    assert exact.errors(tampered(motion, q=motion.q + turn))["error"] > LEVELS["error"]


def test_a_map_that_is_not_symplectic_is_found():
    own, motion = falling()
    A = checks.linearized(own.scene, vp.Midpoint(), motion)
    assert A.shape == (4, 6, 6)
    assert checks.symplecticity_error(A) < 1e-13
    A[2, 0, 4] *= 1.0 + 1e-5
    assert checks.symplecticity_error(A) > LEVELS["symplecticity"]
    # Scale does not matter: lengths in millimetres change nothing.
    scale = np.array([1e3] * 3 + [1e-3] * 3)
    scaled = scale[:, None] * A / scale
    assert checks.symplecticity_error(scaled) == pytest.approx(checks.symplecticity_error(A), rel=1e-6)


@pytest.mark.parametrize("name", ["spring, h omega = 0.1", *(f"spring and damper, h d / I = {d:g}" for d in (0.1, 1))])
def test_the_exact_motion_is_exact(name):
    own = dataclasses.replace(BY_NAME[name].build(), steps=50)
    integrated = dataclasses.replace(own, closed=None, known={})
    np.testing.assert_allclose(own.exact().q, integrated.exact().q, rtol=0, atol=1e-9)


def test_what_goes_wrong_late_is_found():
    """A fifth of its travel is added to the rest of a motion from a node on, and every record is consistent."""
    own, motion = falling(steps=400)
    later = vp.simulate(own.scene, motion.q[250] + 0.3, motion.v[250], dt=1e-2, steps=150, integrator=vp.Midpoint())
    arrays = {name: np.append(getattr(motion, name)[:250], getattr(later, name), axis=0) for name in "qvp"}
    late = tampered(motion, **arrays, energy=np.append(motion.energy[:250], later.energy))
    assert period_error(own.scene, vp.Midpoint(), motion) < 1.0 < period_error(own.scene, vp.Midpoint(), late)


def test_kicks_of_noise_are_in_the_reference():
    own = dataclasses.replace(BY_NAME["noise of 1 N m s^0.5"].build(), steps=40)
    given = {"dt": own.dt, "steps": own.steps}
    quiet = vp.simulate(own.scene, own.q0, own.v0, **given, integrator=vp.Midpoint())
    for integrator, left in ((vp.Midpoint(), 1.0), (vp.Midpoint(kick="held"), None)):
        options = {"increments": own.increments[:40], "integrator": integrator}
        motion = vp.simulate(own.scene, own.q0, own.v0, **given, **options)
        assert own.exact(left).errors(motion)["error"] < 1e-2
        assert own.exact(left).errors(quiet)["error"] > LEVELS["error"]
        unkicked = tampered(quiet, dw=motion.dw)
        assert period_error(own.scene, integrator, motion) < 1.0 < period_error(own.scene, integrator, unkicked)


@pytest.mark.parametrize("integrator", [vp.ExplicitEuler(), vp.Midpoint()], ids=str)
def test_kicks_come_before_or_after_their_steps(integrator):
    """Explicit Euler makes of a mass that nothing but noise drives the very motion that is kicked after its steps."""
    scene = vp.Scene(slider(), gravity=False, noise=vp.AdditiveNoise(1.0))
    own = made_up(scene, [0.0], steps=50, increments=wiener_increments(1, 1e-2, 50, 0))
    assert run_one(own, integrator).error < 1e-9


def test_each_joint_is_checked_by_itself():
    """A wheel that turns far does not hide a joint that is off by half of its own way; nor do velocities go unseen."""
    own = made_up(vp.Scene(rod_chain([1.0] * 2, [1.0] * 2), gravity=False), [1.0, -0.5])
    motion, exact = vp.simulate(own.scene, own.q0, own.v0, dt=1e-2, steps=100), own.exact()
    far = dataclasses.replace(exact, travel=3000.0)
    off = tampered(motion, q=motion.q * [1.0, 1.5], v=motion.v * [1.0, -1.0])
    assert exact.errors(motion)["joint"] < 1e-2
    assert exact.errors(motion)["velocity"] < 1e-2
    assert far.errors(off)["error"] < LEVELS["error"]
    assert far.errors(off)["joint"] > LEVELS["joint"]
    assert far.errors(off)["velocity"] > LEVELS["velocity"]


# --- the kinds -----------------------------------------------------------------------------------------------------


def test_what_is_wrong_and_unsaid_is_silent_wrong(monkeypatch):
    """The bench believes in a motion of the pendulum that is none; then the same error is spoken of."""
    rod = vp.Scene(rod_chain([1.0], [1.0]))
    lie = made_up(rod, [0.0], window=0.5, closed=lambda t: (np.array([-7.0 * t * t]), np.array([-14.0 * t])))
    cell = run_one(lie)
    assert cell.kind is Kind.WRONG
    assert "error" in cell.found[0]
    found = (Finding("test", "all is not well"),)
    monkeypatch.setattr("varpin.simulation.simulate.checked", lambda case, _: case.trajectory.changed(warnings=found))
    assert run_one(lie).kind is Kind.DEGRADED


def test_errors_without_a_name_are_silent_wrong_and_those_with_one_are_not():
    def build():
        raise ZeroDivisionError("of the test")

    trials = [Trial("made up", build), BY_NAME["tip of 0 kg"]]
    unnamed, refused = battery.run(trials, integrators=[vp.Midpoint()]).runs
    assert unnamed.kind is Kind.WRONG
    assert unnamed.found == ("unnamed error: ZeroDivisionError: of the test",)
    assert (refused.kind, refused.done) == (Kind.REFUSED, 0)
    assert refused.said[0].startswith("SingularMassMatrix: ")


def test_motions_that_end_early_are_judged_by_what_there_is(hasty):
    fast = made_up(vp.Scene(rod_chain([1.0] * 2, [1.0] * 2)), [1e3, -500.0], 1e-3, 1000, window=1e-2)
    stopped = run_one(fast, vp.ExplicitEuler())
    long = dataclasses.replace(falling(gravity=False, dt=1e-3, window=0.1)[0], steps=100_000)
    late = run_one(long, vp.Gauss(4), patience=0.01)
    for cell, kind in ((stopped, Kind.STOPPED), (late, Kind.ACCURATE)):
        assert cell.kind is kind
        assert 0 < cell.done < cell.steps
    assert stopped.said[0].startswith("StepFailure: step ")


# --- the record ----------------------------------------------------------------------------------------------------


@pytest.fixture
def few(monkeypatch):
    """A function that leaves of a robot's motions those of some names, and of the integrators these."""
    whole = robot_checks.motions_of

    def leave(*names, integrators=(INTEGRATORS[1], INTEGRATORS[-1])):
        monkeypatch.setattr(robot_checks, "motions_of", lambda robot: [m for m in whole(robot) if m.name in names])
        monkeypatch.setattr(robot_checks, "INTEGRATORS", integrators)

    return leave


def test_the_command_writes_its_table(tmp_path, capsys, few):
    few("falls, dt = 0.5 s", "no gravity")
    assert main(["extremes", "finger", "--save", str(tmp_path / "extremes.csv")]) == 0
    assert "finger at the extremes" in capsys.readouterr().out
    rows = list(csv.DictReader((tmp_path / "extremes.csv").open()))
    assert [row["motion"] for row in rows] == ["falls, dt = 0.5 s"] * 2 + ["no gravity"] * 2
    assert {row["result"] for row in rows} <= {kind.value for kind in Kind}


def test_the_command_fails_where_anything_is_silent_wrong(capsys, monkeypatch, few):
    few("no gravity")
    honest = robot_checks.attempt

    def lying(*given, **options):
        motion, error = honest(*given, **options)
        return tampered(motion, **drifting(motion)), error

    monkeypatch.setattr(robot_checks, "attempt", lying)
    assert main(["extremes", "finger", "--quiet"]) == 1
    assert capsys.readouterr().out.count("silent wrong: no gravity, ") == 2


def test_check_robot_agrees_with_the_battery(load, hasty, few):
    robot, names = load("double_pendulum"), ("falls, dt = 0.1 s", "after 1e6 turns", "noise of 1 times its weight")
    trials = [trial for trial in battery.trials_on(robot) if trial.name in names]
    few(*names, integrators=(vp.Midpoint(), vp.ExplicitEuler()))
    own = vp.check_robot("double_pendulum")
    whole = battery.run(trials, integrators=robot_checks.INTEGRATORS)
    assert own.missing == 0
    for mine, other in zip(own.runs, whole.runs, strict=True):
        assert (mine.trial, mine.integrator, mine.kind) == (other.trial, other.integrator, other.kind)
        assert mine.error == pytest.approx(other.error, rel=1e-9, abs=1e-12, nan_ok=True)


def test_rest_and_torques_that_change_their_sign_are_not_wrong(load, few):
    """Momenta below the smallest normal number have no digits; explicit steps move by the velocity before the force."""
    few("dampers, h d / I = 10", "+-10 times its weight")
    damped, _, _, flipped = vp.check_robot(load("finger"), integrators=[vp.Radau(4), vp.ExplicitEuler()]).runs
    assert damped.kind is flipped.kind is Kind.ACCURATE
    assert damped.record < 1e-9
    assert flipped.energy < 1e-3


def test_check_robot_keeps_what_was_done(load):
    def interrupt(done, cells):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(vp.StudyInterrupted) as stop:
        vp.check_robot(load("finger"), progress=interrupt)
    record = stop.value.record
    assert (len(record.runs), record.missing) == (2, 229)


SOME = ("3 links, dt = 0.5 s", "tip of 1e-09 kg", "spring, h omega = 10", "1e6 N m on 3 links")


@pytest.mark.parametrize("name", SOME)
def test_nothing_in_some_scenes_is_silent_wrong(name, hasty):
    record = battery.run([BY_NAME[name]], integrators=[vp.Midpoint(), vp.Gauss(2), vp.RungeKutta4()])
    assert [(cell.integrator, cell.found) for cell in record.wrong()] == []


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, trial in BY_NAME.items() if not trial.deep])
def test_nothing_in_the_battery_is_silent_wrong(name):
    record = battery.run([BY_NAME[name]])
    assert record.missing == 0
    assert [(cell.integrator, cell.found) for cell in record.wrong()] == []


@pytest.mark.slow
def test_nothing_on_the_finger_is_silent_wrong(load):
    record = battery.run(battery.trials_on(load("finger")))
    assert record.missing == 0
    assert [(cell.trial, cell.integrator, cell.found) for cell in record.wrong()] == []
    counts = record.counts()
    assert counts[Kind.ACCURATE] > 60
    assert counts[Kind.DEGRADED] > 30
