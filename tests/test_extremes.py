"""The battery of extreme scenes: its checks can fail, its kinds mean what they say, and it finds nothing silent."""

from __future__ import annotations

import csv
import dataclasses
import math

import battery
import numpy as np
import pytest
from battery import Setup, Trial
from battery.exact import exact_motion, period_error
from mechanisms import slider

import varpin as vp
from varpin.cli import main
from varpin.finding import Finding
from varpin.mechanics.wiener import wiener_increments
from varpin.model.chain import rod_chain
from varpin.study import checks
from varpin.study import extremes as robot_checks
from varpin.study.checks import LEVELS
from varpin.study.extremes import INTEGRATORS, Kind

BY_NAME = {trial.name: trial for trial in battery.TRIALS}


def falling(integrator=None, *, dt=1e-2, steps=100, **scene):
    """Three links that fall: their setup and their motion."""
    setup = Setup(vp.Scene(rod_chain([1.0] * 3, [1.0] * 3), **scene), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    return setup, vp.simulate(
        setup.scene, setup.q0, setup.v0, dt=dt, steps=steps, integrator=integrator or vp.Midpoint()
    )


def tampered(trajectory, **changes):
    """The record with other arrays, and nothing said of it."""
    return dataclasses.replace(trajectory, warnings=(), **changes)


def run_one(setup, dt=1e-2, steps=100, integrator=None, **options):
    trial = Trial("made up", "made up", lambda: setup, dt, steps, **options)
    return battery.run(trials=[trial], integrators=[integrator or vp.Midpoint()]).runs[0]


@pytest.fixture
def worried(monkeypatch):
    """A function after which every motion has a warning, also one that is clearly right."""

    def worry():
        found = (Finding("test", "all is not well"),)
        monkeypatch.setattr("varpin.simulation.simulate.checked", lambda *given, **_: given[2].changed(warnings=found))

    return worry


@pytest.fixture
def hasty(monkeypatch):
    """Little time for the exact motions over periods, which decide nothing here."""
    monkeypatch.setattr("battery.exact._PATIENCE_PERIODS", 0.1)
    monkeypatch.setattr("battery.exact._PATIENCE_PERIOD", 0.1)


# --- each check can fail -------------------------------------------------------------------------------------------


def test_a_sound_motion_passes_every_check():
    setup, motion = falling(gravity=False)
    found = checks.measures(setup.scene, vp.Midpoint(), motion, exact_motion(setup, 1e-2, 100, 0.3))
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
    [
        # Pinocchio knows better what energies and momenta are.
        (True, leaking, {"energy", "record"}),
        (True, overflowing, {"energy"}),
        (False, drifting, {"record"}),
    ],
)
def test_records_that_are_made_up_are_found(gravity, fault, broken):
    setup, motion = falling(gravity=gravity)
    own = {
        "energy": lambda m: checks.energy_error(setup.scene, m),
        "record": lambda m: checks.record_error(setup.scene, m),
    }

    def names(m):
        measured = {name: measure(m) for name, measure in own.items()}
        return {text.split()[0] for text in checks.findings(measured)}

    assert names(motion) == set()
    assert names(tampered(motion, **fault(motion))) == broken


def test_a_wrong_root_is_found_by_the_reference():
    # Another root of the step equation of a rod: it goes the long way round, and every record of it is consistent.
    setup, motion = falling()
    turn = np.zeros_like(motion.q)
    turn[40:, 2] = 2.0 * math.pi
    q = motion.q + turn
    exact = exact_motion(setup, 1e-2, 100, 0.5)
    assert len(exact.nodes) > 20
    assert exact.errors(motion)["error"] < 1e-2
    assert exact.errors(tampered(motion, q=q))["error"] > LEVELS["error"]


def test_a_map_that_is_not_symplectic_is_found():
    setup, motion = falling()
    A = checks.linearized(setup.scene, vp.Midpoint(), motion)
    assert A.shape == (4, 6, 6)
    assert checks.symplecticity_error(A) < 1e-13
    A[2, 0, 4] *= 1.0 + 1e-5
    assert checks.symplecticity_error(A) > LEVELS["symplecticity"]
    # Scale does not matter: lengths in millimetres change nothing.
    scale = np.array([1e3] * 3 + [1e-3] * 3)
    scaled = scale[:, None] * A / scale
    assert checks.symplecticity_error(scaled) == pytest.approx(checks.symplecticity_error(A), rel=1e-6)


def test_the_exact_motion_is_exact():
    # A linear oscillator, overdamped and not, in closed form against DOP853.
    for trial in battery.TRIALS:
        if trial.name in (
            "spring, h omega = 0.1",
            "spring and damper, h d / I = 0.1",
            "spring and damper, h d / I = 1",
        ):
            setup = trial.build()
            closed = exact_motion(setup, 1e-2, 100, 0.5)
            integrated = exact_motion(dataclasses.replace(setup, exact=None), 1e-2, 100, 0.5)
            np.testing.assert_allclose(closed.q, integrated.q, rtol=0, atol=1e-9)


def test_the_error_of_a_period_is_that_of_its_closed_form():
    """An oscillator: what the explicit Euler method's amplitude gains over a period, in units of what is wrong."""
    scene, z = vp.Scene(rod_chain([1.0], [1.0]), gravity=False, stiffness=1.0 / 3.0), 0.1
    for integrator in (vp.ExplicitEuler(), vp.Midpoint()):
        motion = vp.simulate(scene, [0.5], [0.0], dt=z, steps=round(math.tau / z), integrator=integrator)
        off = np.abs(motion.q[:, 0] - 0.5 * np.cos(motion.t)).max() / np.ptp(motion.q)
        assert period_error(scene, integrator, motion) == pytest.approx(off / LEVELS["error"], rel=0.3)


def test_what_goes_wrong_late_is_found():
    """A fifth of its travel is added to the rest of a motion from a node on, and every record is consistent."""
    setup, motion = falling(dt=1e-2, steps=400)
    later = vp.simulate(setup.scene, motion.q[250] + 0.3, motion.v[250], dt=1e-2, steps=150, integrator=vp.Midpoint())
    arrays = {name: np.append(getattr(motion, name)[:250], getattr(later, name), axis=0) for name in "qvp"}
    late = tampered(motion, **arrays, energy=np.append(motion.energy[:250], later.energy))
    assert period_error(setup.scene, vp.Midpoint(), motion) < 1.0 < period_error(setup.scene, vp.Midpoint(), late)


def test_kicks_of_noise_are_in_the_reference():
    trial, given = BY_NAME["noise of 1 N m s^0.5"], {"dt": 1e-2, "steps": 40}
    setup = trial.build()
    setup = dataclasses.replace(setup, increments=setup.increments[:40])
    quiet = vp.simulate(setup.scene, setup.q0, setup.v0, **given, integrator=vp.Midpoint())
    for integrator, left in ((vp.Midpoint(), 1.0), (vp.Midpoint(kick="held"), None)):
        exact = exact_motion(setup, **given, window=trial.window, left=left)
        options = {"increments": setup.increments, "integrator": integrator}
        motion = vp.simulate(setup.scene, setup.q0, setup.v0, **given, **options)
        assert exact.errors(motion)["error"] < 1e-2
        assert exact.errors(quiet)["error"] > LEVELS["error"]
        assert period_error(setup.scene, integrator, motion) < 1.0
        unkicked = tampered(quiet, dw=motion.dw)
        assert period_error(setup.scene, integrator, unkicked) > 1.0


def test_kicks_come_before_or_after_their_steps():
    # Explicit Euler makes of a mass that nothing but noise drives the very motion that is kicked after its steps.
    scene = vp.Scene(slider(), gravity=False, noise=vp.AdditiveNoise(1.0))
    setup = Setup(scene, np.zeros(1), np.zeros(1), increments=wiener_increments(1, 1e-2, 50, 0))
    assert run_one(setup, 1e-2, 50, vp.ExplicitEuler()).error < 1e-9
    assert run_one(setup, 1e-2, 50, vp.Midpoint()).error < 1e-9


# --- the kinds -----------------------------------------------------------------------------------------------------


def test_what_is_wrong_and_unsaid_is_silent_wrong(worried):
    # The bench believes in a motion of the pendulum that is none.
    rod = vp.Scene(rod_chain([1.0], [1.0]))
    lie = Setup(rod, np.zeros(1), np.zeros(1), exact=lambda t: (np.array([-7.0 * t * t]), np.array([-14.0 * t])))
    cell = run_one(lie, window=0.5)
    assert cell.kind is Kind.WRONG
    assert "error" in cell.found[0]
    # The same error, but spoken of.
    worried()
    assert run_one(lie, window=0.5).kind is Kind.DEGRADED


def test_errors_without_a_name_are_silent_wrong():
    def build():
        raise ZeroDivisionError("of the test")

    trial = Trial("made up", "made up", build, 1e-2, 10)
    (cell,) = battery.run(trials=[trial], integrators=[vp.Midpoint()]).runs
    assert cell.kind is Kind.WRONG
    assert cell.found == ("unnamed error: ZeroDivisionError: of the test",)


def test_refused_before_anything_ran():
    (cell,) = battery.run(trials=[BY_NAME["tip of 0 kg"]], integrators=[vp.Midpoint()]).runs
    assert (cell.kind, cell.done) == (Kind.REFUSED, 0)
    assert cell.said[0].startswith("SingularMassMatrix: ")


def test_stopped_with_the_motion_so_far(hasty):
    setup = Setup(vp.Scene(rod_chain([1.0] * 2, [1.0] * 2)), np.zeros(2), np.array([1e3, -500.0]))
    cell = run_one(setup, 1e-3, 1000, vp.ExplicitEuler(), window=1e-2)
    assert cell.kind is Kind.STOPPED
    assert 0 < cell.done < cell.steps
    assert cell.said[0].startswith("StepFailure: step ")


def test_a_motion_that_takes_too_long_is_judged_by_what_there_is(hasty):
    setup, _ = falling(gravity=False)
    trial = Trial("long", "made up", lambda: setup, 1e-3, 100_000, window=0.1)
    (cell,) = battery.run(trials=[trial], integrators=[vp.Gauss(4)], patience=0.01).runs
    assert 0 < cell.done < cell.steps
    assert cell.kind is Kind.ACCURATE


# --- the record ----------------------------------------------------------------------------------------------------


def test_every_trial_has_a_name_of_its_own(load):
    for trials in (battery.TRIALS, battery.trials_on(load("finger"))):
        names = [trial.name for trial in trials]
        assert len(set(names)) == len(names)
    assert len({repr(member) for member in INTEGRATORS}) == len(INTEGRATORS) == 11


def few(names, *lies):
    """``motions_of``, of which these are taken, and lies added."""
    own = robot_checks.motions_of
    return lambda robot: [*(motion for motion in own(robot) if motion.name in names), *lies]


def test_the_command_writes_its_files(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(robot_checks, "motions_of", few({"falls, dt = 0.5 s", "no gravity"}))
    monkeypatch.setattr(robot_checks, "INTEGRATORS", (vp.Midpoint(), vp.RungeKutta4()))
    assert main(["extremes", "finger", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "finger at the extremes" in out
    rows = list(csv.DictReader((tmp_path / "extremes.csv").open()))
    assert [row["motion"] for row in rows] == ["falls, dt = 0.5 s"] * 2 + ["no gravity"] * 2
    assert {row["result"] for row in rows} <= {kind.value for kind in Kind}
    page = (tmp_path / "extremes.html").read_text()
    assert page.count("<td") >= 5 * len(rows)
    assert "<script" not in page
    assert "http" not in page.split("</style>")[1]


def test_the_command_fails_where_anything_is_silent_wrong(capsys, monkeypatch):
    monkeypatch.setattr(robot_checks, "motions_of", few({"no gravity"}))
    monkeypatch.setattr(robot_checks, "INTEGRATORS", (vp.Midpoint(), vp.RungeKutta4()))
    honest = robot_checks.attempt

    def lying(*given, **options):
        """The recorded momenta leak."""
        motion, error = honest(*given, **options)
        return tampered(motion, **drifting(motion)), error

    monkeypatch.setattr(robot_checks, "attempt", lying)
    assert main(["extremes", "finger", "--quiet"]) == 1
    assert capsys.readouterr().out.count("silent wrong: no gravity, ") == 2


def test_check_robot_agrees_with_the_battery(load, hasty):
    robot, names = load("double_pendulum"), {"falls, dt = 0.1 s", "after 1e6 turns", "noise of 1 times its weight"}
    members = [vp.Midpoint(), vp.ExplicitEuler()]
    trials = [trial for trial in battery.trials_on(robot) if trial.name in names]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(robot_checks, "motions_of", few(names))
        own = vp.check_robot("double_pendulum", integrators=members)
    whole = battery.run(robot, trials=trials, integrators=members)
    assert own.missing == 0
    for mine, other in zip(own.runs, whole.runs, strict=True):
        assert (mine.trial, mine.integrator, mine.kind) == (other.trial, other.integrator, other.kind)
        assert mine.error == pytest.approx(other.error, rel=1e-9, abs=1e-12, nan_ok=True)


def test_rest_and_torques_that_change_their_sign_are_not_wrong(load, monkeypatch):
    """Momenta below the smallest normal number have no digits; explicit steps move by the velocity before the force."""
    monkeypatch.setattr(robot_checks, "motions_of", few({"dampers, h d / I = 10", "+-10 times its weight"}))
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


@pytest.mark.parametrize(
    "name", ["3 links, dt = 0.5 s", "tip of 1e-09 kg", "spring, h omega = 10", "1e6 N m on 3 links"]
)
def test_nothing_in_some_scenes_is_silent_wrong(name, hasty):
    record = battery.run(trials=[BY_NAME[name]], integrators=[vp.Midpoint(), vp.Gauss(2), vp.RungeKutta4()])
    assert [(cell.integrator, cell.found) for cell in record.wrong()] == []


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, trial in BY_NAME.items() if not trial.deep])
def test_nothing_in_the_battery_is_silent_wrong(name):
    record = battery.run(trials=[BY_NAME[name]])
    assert record.missing == 0
    assert [(cell.integrator, cell.found) for cell in record.wrong()] == []


@pytest.mark.slow
def test_nothing_on_the_finger_is_silent_wrong(load):
    record = battery.run(load("finger"))
    assert record.missing == 0
    assert [(cell.trial, cell.integrator, cell.found) for cell in record.wrong()] == []
    counts = record.counts()
    assert counts[Kind.ACCURATE] > 60
    assert counts[Kind.DEGRADED] > 30


def test_each_joint_is_checked_by_itself():
    """A wheel that turns far does not hide a joint that is off by half of its own way; nor do velocities go unseen."""
    scene = vp.Scene(rod_chain([1.0] * 2, [1.0] * 2), gravity=False)
    setup = Setup(scene, np.zeros(2), np.array([1.0, -0.5]))
    motion = vp.simulate(scene, setup.q0, setup.v0, dt=1e-2, steps=100)
    exact = exact_motion(setup, 1e-2, 100, 1.0)
    far = dataclasses.replace(exact, travel=3000.0)
    off = tampered(motion, q=motion.q * [1.0, 1.5], v=motion.v * [1.0, -1.0])
    assert exact.errors(motion)["joint"] < 1e-2
    assert exact.errors(motion)["velocity"] < 1e-2
    assert far.errors(off)["error"] < LEVELS["error"]
    assert far.errors(off)["joint"] > LEVELS["joint"]
    assert far.errors(off)["velocity"] > LEVELS["velocity"]
