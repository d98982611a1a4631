"""What a motion tells about itself: its error against SciPy on Pinocchio's aba, its warnings, and the log."""

import logging
import pickle
import re
import signal

import numpy as np
import pytest
from findings import about
from mechanisms import rod_chain, slider
from random_motions import draw, judge, truth
from refusals import unnamed

import varpin as vp

CHAIN, FREE = vp.planar_chain(3), vp.Scene(vp.planar_chain(3))
Q0, V0 = np.array([0.3, 0.2, -0.4]), np.array([0.5, 0.0, 1.0])
EULER, RK4, MIDPOINT = vp.SemiImplicitEuler(), vp.RungeKutta4(), vp.Midpoint()
D, K = np.array([2.0, 1.0, 0.5]), np.array([300.0, 100.0, 50.0])
TOLD = 0.01


def moved(scene, integrator=None, *, dt=0.02, steps=40, controls=None, start=(Q0, V0), **options):
    return vp.simulate(scene, *start, dt=dt, steps=steps, controls=controls, integrator=integrator, **options)


def finer(scene, motion, controls=None, parts=16, integrator=None, start=(Q0, V0)):
    options = {"dt": motion.dt / parts, "steps": motion.steps * parts, "controls": controls, "start": start}
    return moved(scene, integrator or vp.Gauss(4), check=False, **options).q[::parts]


def agree(motion, q, rel=0.05, least=1e-10):
    """The error of a motion is its distance from q; returns that as a share of the travel."""
    off = np.abs(motion.q - q)
    np.testing.assert_allclose(motion.error.max(), off.max(), rtol=rel, atol=least)
    assert np.abs(motion.error - off).max() < 2.0 * rel * off.max() + least
    assert motion.error_bound is None or motion.error_bound > off.max() - least
    return off.max() / np.ptp(q, axis=0).max()


def right():
    motion = moved(FREE, dt=0.005, steps=100)
    assert "error about" in repr(motion)
    assert 0.0 < motion.error_bound < 1e-4
    return motion


def test_lazy_error(tmp_path):
    motion, own = right(), right()
    known = motion.error
    assert f"error {known.max():.2g}" in repr(motion)
    assert 0.0 < known.max() < motion.error_bound
    assert motion.error is known
    assert own.changed(warnings=()).error.tobytes() == known.tobytes()
    part = own.part(20, 60)
    assert "error about" in repr(part)
    assert "error about" in repr(own)
    assert part.error.tobytes() == known[20:61].tobytes()
    assert right().part(10, 90).part(10, 50).error.tobytes() == known[20:61].tobytes()
    for again in (pickle.loads(pickle.dumps(right())), vp.Trajectory.load(right().save(tmp_path / "motion.npz"))):
        assert again.error.tobytes() == known.tobytes()
        assert again.error_bound == motion.error_bound
        assert repr(again) == repr(motion)


def test_no_check():
    coarse = moved(FREE, EULER, check=False)
    assert coarse.error is None
    assert coarse.error_bound is None
    assert coarse.warnings == ()
    assert "error" not in repr(coarse)
    assert about(moved(FREE, EULER).warnings, "error")
    searched = vp.simulate(FREE, Q0, V0, duration=0.2, tolerance=1e-4, check=False)
    assert searched.error.max() == pytest.approx(searched.accuracy.error)
    assert moved(FREE, steps=0).warnings == ()
    assert moved(FREE, start=([0.5 * np.pi, 0.0, 0.0], np.zeros(3))).error.max() < 1e-9


KICKED = [MIDPOINT, vp.Midpoint(kick="held"), vp.Gauss(2), vp.Radau(3), RK4, EULER, vp.ExplicitEuler()]


@pytest.mark.parametrize("integrator", KICKED, ids=str)
def test_noise(integrator):
    scene = vp.Scene(CHAIN, damping=0.5, noise=vp.AdditiveNoise(0.5))
    dw, parts = np.sqrt(0.02) * np.random.default_rng(0).normal(size=(40, 3)), 32
    held = getattr(integrator, "kick", "left") == "held"
    fine = np.kron(dw, np.full((parts, 1), 1.0 / parts) if held else np.eye(parts, 1))
    fine = {"increments": fine, "dt": 0.02 / parts, "steps": 40 * parts, "check": False}
    truth = moved(scene, vp.Gauss(4, kick="held" if held else "left"), **fine).q[::parts]
    # Its repetition takes half steps, and has a half of the error to first order.
    rel = 0.3 if integrator == vp.ExplicitEuler() else 0.05
    agree(moved(scene, integrator, increments=dw), truth, rel=rel)


@pytest.mark.parametrize("integrator", [MIDPOINT, RK4], ids=str)
def test_a_law_that_its_record_tells_acts_on_the_repetition(integrator):
    gains = -np.hstack([np.diag([20.0, 10.0, 3.0]), np.diag([8.0, 4.0, 1.0])])
    law = {"controls": lambda t, q, v: gains @ np.append(q, v)}
    fine = moved(FREE, vp.Gauss(4), dt=0.02 / 16, steps=640, period=16, check=False, **law)
    agree(moved(FREE, integrator, **law), fine.q[::16])


def test_kinematic_inputs():
    scene = vp.Scene(CHAIN, constraints=vp.KinematicInput("joint1"), actuation=["joint1"])
    t, start = 0.02 * np.arange(41), (Q0, np.array([1.2, 0.0, 1.0]))
    motion = moved(scene, MIDPOINT, controls=vp.OpenLoop(lambda t: [0.3 + 0.3 * np.sin(4.0 * t)]), start=start)
    # They take the values at the ends of steps.
    np.testing.assert_allclose(motion.q[1:, 0], 0.3 + 0.3 * np.sin(4.0 * t[1:]), atol=1e-14)
    line = vp.OpenLoop(lambda s: [np.interp(s, t, 0.3 + 0.3 * np.sin(4.0 * t))])
    agree(motion, finer(scene, motion, line, start=start))


@pytest.mark.parametrize(
    ("force", "integrator", "dt"),
    [
        (vp.CoulombFriction(0.5), RK4, 0.005),
        (vp.JointStop(1e3, 5.0, -0.8, 0.8), None, 0.02),
    ],
)
def test_forces_sharper_than_the_step(force, integrator, dt):
    """More stages do not resolve kinks: the repetition must not be off alike."""
    scene = vp.Scene(vp.load_robot("ur5"), damping=0.2, friction=0, forces=force)
    for seed in range(4):
        start = np.full(6, 0.5), np.random.default_rng(seed).uniform(-2.0, 2.0, 6)
        motion = moved(scene, integrator, dt=dt, steps=50, start=start)
        true = finer(scene, motion, parts=64, integrator=vp.Radau(4), start=start)
        assert 0.8 < motion.error.max() / np.abs(motion.q - true).max() < 1.25


def fall(robot, height):
    return vp.Scene(robot, damping=0, friction=0), (np.full(robot.dof, height), np.zeros(robot.dof))


@pytest.mark.parametrize(
    ("robot", "height", "steps"), [(vp.planar_chain(2), 0.0, 1000), (vp.load_robot("z1"), 0.3, 500)]
)
def test_chaos(robot, height, steps):
    """Told with the time until which the motion is right: ended there it has no warning, and one if a step longer."""
    scene, start = fall(robot, height)
    motion = moved(scene, steps=steps, start=start)
    (told,) = about(motion.warnings, "error")
    assert motion.error.max() > 1.0
    right = round(told.time / motion.dt)
    assert not about(moved(scene, steps=right, start=start).warnings, "error")
    assert about(moved(scene, steps=right + 1, start=start).warnings, "error")
    part = motion.part(0, right)
    off = np.abs(part.q - finer(scene, part, start=start))
    assert off.max() < 1.25 * TOLD * np.ptp(part.q, axis=0).max()


@pytest.mark.parametrize("name", ["z1", "xarm7", "so100"])
def test_of_falls_whose_deviations_grow_a_step_is_named_that_follows_them_or_a_shorter_duration(name):
    scene, start = fall(vp.load_robot(name), 0.3)
    (told,) = about(moved(scene, steps=100, start=start).warnings, "error")
    stages, dt = re.search(r"Gauss\((\d)\) and dt = (\S+) s", told).groups()
    step = {"dt": float(dt), "duration": 2.0, "integrator": vp.Gauss(int(stages))}
    motion = vp.simulate(scene, *start, **step)
    assert not about(motion.warnings, "error")
    apart = np.abs(vp.simulate(scene, start[0] + 1e-12, start[1], **step).q - motion.q).max(axis=1)
    right = round(told.time / motion.dt)
    assert apart.max() > 1e4 * apart[:right].max()
    (told,) = about(moved(scene, steps=500, start=start).warnings, "error")
    assert "and a shorter duration, as even rounding errors grow" in told


def test_of_swings_no_rounding_is_told():
    (told,) = about(moved(FREE, MIDPOINT, dt=0.05, steps=2000, start=([2.0, 0.0, 0.0], np.zeros(3))).warnings, "error")
    assert told.value > 0.1
    assert "grow" not in told


def test_unknown_error():
    done = []

    def force(q, v):
        if done:
            raise ValueError("no more")
        return -0.1 * v

    scene = vp.Scene(CHAIN, forces=vp.CustomForce(force))
    motion = moved(scene, progress=lambda k, steps: done.append(k) if k == steps else None)
    (told,) = motion.warnings
    assert told.kind == "error"
    assert not unnamed(told, "not known", "no more")
    assert np.isnan(motion.error).all()
    assert "error unknown" in repr(motion)


def test_interruption(request):
    # A process in the background of a script ignores Ctrl-C.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))
    options = {"dt": 0.3, "steps": 1_000_000, "progress": lambda done, steps: signal.raise_signal(signal.SIGINT)}
    with pytest.raises(vp.Interrupted) as caught:
        moved(vp.Scene(vp.planar_chain(1)), EULER, start=([0.0], [0.0]), **options)
    assert about(caught.value.trajectory.warnings, "error")


@pytest.mark.parametrize(
    ("options", "integrator", "dt"),
    [
        ({}, MIDPOINT, 0.05),
        ({}, EULER, 0.01),
        ({}, vp.ExplicitEuler(), 0.004),
        ({}, RK4, 0.1),
        ({"stiffness": 30.0 * K}, vp.Gauss(2), 0.02),
        ({"damping": 50.0 * D}, MIDPOINT, 0.02),
    ],
)
def test_advice(options, integrator, dt):
    """What a sentence advises makes a motion of which nothing is told; a small method may need its advice again."""
    scene, steps = vp.Scene(CHAIN, **options), round(0.8 / dt)
    unit = "rad/s" if "damping" in options else "rad"
    (told,) = about(moved(scene, integrator, dt=dt, steps=steps).warnings, "error")
    assert len(told) <= 240
    assert told.unit == unit
    assert not unnamed(told, f"{told.value:.2g} {unit}", f"'{told.joint}'", f"t = {told.time:.3g} s")
    family, stages = re.search(r"integrator=varpin\.(\w+)\((\d)\)", told).groups()
    assert (family == "Radau") == ("damping" in options)
    better = moved(scene, getattr(vp, family)(int(stages)), dt=dt, steps=steps)
    assert not about(better.warnings, "error")
    follow(scene, told, integrator, 0.8, (Q0, V0), again=3)


def follow(scene, told, integrator, duration, start, controls=None, again=1):
    """What a sentence names of the step is taken as it is written, and ends in a motion without an error to tell."""
    for _ in range(again):
        if not (named := re.search(r"(dt|steps) = (\S+)", told)):
            return
        options = {named[1]: (float if named[1] == "dt" else int)(named[2])}
        motion = vp.simulate(scene, *start, duration=duration, **options, controls=controls, integrator=integrator)
        if not (found := about(motion.warnings, "error")):
            return
        (told,) = found
    pytest.fail(told)


def test_a_named_step_keeps_the_period_of_a_law_and_of_a_policy():
    scene, wish = vp.Scene(vp.planar_chain(2)), np.array([0.6, -0.4])
    options = {"q0": [0.0, 0.0], "v0": [8.0, 0.0], "duration": 1.2, "integrator": vp.Midpoint()}

    def law(t, q, v):
        return 20.0 * (wish - q) - 2.0 * v

    motion = vp.simulate(scene, **options, dt=0.03, controls=law, period=2)
    (told,) = about(motion.warnings, "error")
    dt, period = re.search(r"dt = (\S+) s with period=(\d+)", told).groups()
    assert float(dt) * int(period) == pytest.approx(0.06, rel=1e-12)
    better = vp.simulate(scene, **options, dt=float(dt), controls=law, period=int(period))
    assert better.error.max() < 0.5 * motion.error.max()
    u, gains = np.tile(40.0 * wish, (20, 1)), np.zeros((20, 2, 4))
    motion = vp.simulate(scene, **options, dt=0.03, controls=vp.LinearPolicy(u, gains, np.zeros((20, 4)), hold=2))
    (told,) = about(motion.warnings, "error")
    dt, hold = re.search(r"dt = (\S+) s with hold=(\d+)", told).groups()
    policy = vp.LinearPolicy(u, gains, np.zeros((20, 4)), hold=int(hold))
    assert vp.simulate(scene, **options, dt=float(dt), controls=policy).error.max() < 0.5 * motion.error.max()


@pytest.mark.parametrize(("rate", "size", "phase"), [(60, 150.0, 0.3), (300, 400.0, 0.3), (100, 200.0, np.pi / 2)])
def test_of_waves_within_a_step_a_step_that_follows_them_is_named(rate, size, phase):
    """More stages change nothing there, or the error for the worse; two see nothing of the last one."""
    scene, start, push = vp.Scene(vp.planar_chain(2), damping=0.0), ([0.4, 0.4], [0.0, 0.0]), size * np.array([-1, 1])
    controls = vp.OpenLoop(lambda t: push * np.sin(2.0 * np.pi * rate * t + phase))
    motion = vp.simulate(scene, *start, duration=0.5, dt=0.01, controls=controls)
    (told,) = about(motion.warnings, "error")
    assert "faster than the step" in told
    assert "integrator" not in told
    follow(scene, told, None, 0.5, start, controls)


@pytest.mark.parametrize(("links", "damping", "width"), [(3, 0.0, 0.01), (2, 100.0, 0.01), (2, 1000.0, 0.001)])
@pytest.mark.parametrize("integrator", [None, vp.Radau(3), vp.Gauss(2)], ids=str)
@pytest.mark.parametrize("dt", [5e-3, 2e-2])
def test_of_stops_within_a_step_a_step_that_resolves_them_is_named(links, damping, width, integrator, dt):
    stop = vp.JointStop(1e6, damping, -0.5, 0.9, width)
    scene, start = vp.Scene(vp.planar_chain(links), damping=0.0, forces=[stop]), (np.full(links, 0.4), np.zeros(links))
    motion = vp.simulate(scene, *start, duration=1.0, dt=dt, integrator=integrator)
    for told in about(motion.warnings, "error"):
        assert "Stops are stiffer" in told
        assert "integrator" not in told
        follow(scene, told, integrator, 1.0, start, again=2)


@pytest.mark.parametrize("stiffness", [3e4, 1e5])
def test_the_step_named_for_a_stop_is_as_long_as_its_spring_allows(stiffness):
    """Two radians of a mass of 1 kg on it."""
    scene = vp.Scene(slider(1.0), gravity=False, forces=vp.JointStop(stiffness, 0.0, -1.0, 1.0, 1e-4))
    motion = vp.simulate(scene, [0.0], [1.0], dt=0.05, steps=40, integrator=MIDPOINT)
    (told,) = about(motion.warnings, "error")
    named = float(re.search(r"dt = (\S+)", told)[1])
    assert 1.0 < named * np.sqrt(stiffness) <= 2.0


def test_limits():
    scene = vp.Scene(vp.load_robot("ur5"), gravity=False)
    robot, push = scene.robot, np.array([400.0, 0.0, 0.0, 40.0, 50.0, 60.0])
    motion = moved(scene, dt=1e-3, start=(np.full(6, 7.0), np.arange(1.0, 7.0)), controls=push)
    for kind, values, limit, unit in (
        ("position limits", motion.q, robot.position_limits[1], "rad"),
        ("velocity limits", np.abs(motion.v), robot.velocity_limit, "rad/s"),
        ("effort limits", np.abs(motion.u), robot.effort_limit, "N m"),
    ):
        (told,), excess = about(motion.warnings, kind), values - limit
        worst = int(excess.max(axis=0).argmax())
        assert (told.joint, told.unit) == (robot.joint_names[worst], unit)
        assert told.value == pytest.approx(excess.max())
        assert told.time == pytest.approx(motion.t[int(excess[:, worst].argmax())])
        count = int((excess.max(axis=0) > 1e-6).sum()) - 1
        assert not unnamed(told, f"'{told.joint}'", f"{limit[worst]:.4g} {unit}", f"by up to {told.value:.3g}")
        assert told.endswith((f"{count} more joint does", f"{count} more joints do") if count else "")
        assert len(told) <= 240


def test_log(caplog):
    scene, start = vp.Scene(vp.load_robot("ur5"), gravity=False), (np.full(6, 7.0), np.arange(1.0, 7.0))

    def lines(scene=scene, **options):
        caplog.clear()
        motion = moved(scene, EULER, start=start, **options)
        return motion, caplog.messages

    with caplog.at_level(logging.WARNING, "varpin"):
        motion, said = lines()
        assert said == [f"{motion.warnings[0]} ({len(motion.warnings) - 1} more in .warnings)"]
        assert len({told.kind for told in motion.warnings}) == len(motion.warnings) > 2
        again, said = lines()
        assert said == []
        assert again.warnings == motion.warnings
        assert len(lines(dt=0.01)[1]) == 1
        assert len(lines(scene=vp.Scene(scene.robot, gravity=False))[1]) == 1
    with caplog.at_level(logging.ERROR, "varpin"):
        assert lines(scene=vp.Scene(scene.robot, gravity=False))[1] == []


@pytest.mark.parametrize("given", [True, False], ids=["breaks", "no breaks"])
@pytest.mark.parametrize("integrator", [None, MIDPOINT, vp.Gauss(3), vp.Radau(3), RK4])
def test_blows(given, integrator):
    scene, rng = vp.Scene(slider(1.0), gravity=False), np.random.default_rng(0)
    for width in np.repeat([5e-4, 1e-3, 4e-3, 2e-2] if given else [1e-3, 4e-3, 2e-2], 6):
        end = (begin := rng.uniform(0.05, 0.9)) + width
        f = lambda t, a=begin, b=end: ((a <= t) & (t < b))[:, None] / (b - a)  # noqa: E731
        push = vp.OpenLoop(f, vectorized=True, breaks=(begin, end) if given else ())
        motion = moved(scene, integrator, dt=0.01, steps=100, controls=push, start=([0.0], [0.0]))
        after = motion.t > end
        assert motion.v[after, 0] == pytest.approx(1.0, abs=1e-10 if given else 1e-3)
        off = np.abs(motion.q[after, 0] - motion.t[after] + 0.5 * (begin + end))
        # A control that is constant over the step acts in its middle, which is its error.
        assert off.max() < (0.006 if integrator == MIDPOINT else 1e-10 if given else 1e-3)
        assert integrator != MIDPOINT or motion.error[after].max() == pytest.approx(off.max(), rel=0.1, abs=1e-3)


@pytest.mark.parametrize(
    ("begin", "width", "dt", "given"),
    [
        # Between the last point of a step's quadrature and its end, and on both sides of it.
        *((0.2 - early, 1e-3, 0.01, False) for early in (30e-6, 1e-6, 0.0, -20e-6)),
        (0.066, 1e-3, 0.019, False),
        *((begin, 5e-5, 0.01, True) for begin in (0.0037, 0.2037)),
    ],
)
@pytest.mark.parametrize("force", [(), vp.CustomForce(lambda q, v: 0.0 * v)], ids=["compiled", "python"])
def test_short_blows_have_their_impulse(begin, width, dt, given, force):
    """A force in Python takes one step at a time: breaks are counted from the start of the motion."""
    breaks = (begin, begin + width) if given else ()
    push = vp.OpenLoop(lambda t: [float(begin <= t < begin + width) / width], breaks=breaks)
    scene = vp.Scene(slider(1.0), gravity=False, forces=force)
    motion = vp.simulate(scene, [0.0], [0.0], dt=dt, steps=40, controls=push)
    assert motion.v[-1, 0] == pytest.approx(1.0, abs=1e-9 if given else 1e-6)


def test_unsettled_functions():
    (told,) = moved(FREE, controls=vp.OpenLoop(lambda t: np.sin(1e9 * t * t) * np.ones(3)), steps=2).warnings
    assert (told.kind, told.value, told.unit) == ("fast controls", 2.0, "steps")
    assert not unnamed(told, "2 steps", "breaks=")


def test_findings(tmp_path):
    own = vp.Finding("error", "too far", "joint2", time=0.5, value=0.1, unit="rad")
    numbers = {"kind": "error", "joint": "joint2", "time": 0.5, "value": 0.1, "unit": "rad"}
    assert own == "too far"
    assert vars(own) == vars(pickle.loads(pickle.dumps(own))) == numbers
    assert (own.about("path 3: "), vars(own.about("path 3: "))) == ("path 3: too far", numbers)
    motion = moved(FREE, EULER, start=(Q0, 5.0 * V0))
    assert motion.warnings
    loaded = vp.Trajectory.load(motion.save(tmp_path / "motion.npz")).warnings
    for again in (loaded, pickle.loads(pickle.dumps(motion)).warnings):
        assert again == motion.warnings
        assert [vars(told) for told in again] == [vars(told) for told in motion.warnings]


def test_the_second_part_of_a_split_kick_has_the_field_at_the_end_of_its_step():
    scene = vp.Scene(vp.planar_chain(2), noise=vp.StateNoise(3.0, center=np.zeros(2)))
    kicked = vp.Gauss(5, kick="split")
    motion = vp.simulate(scene, [0.3, 0.2], [1.0, 2.0], dt=0.01, steps=20, integrator=kicked, rng=1)
    assert motion.error.max() < 1e-9


def test_friction_that_turns_in_a_step_is_repeated_on_either_side():
    scene = vp.Scene(slider(1.0), gravity=False, forces=vp.CoulombFriction(0.01, 0.1))
    for speed in (1.0, -1.0):
        motion = vp.simulate(scene, [0.0], [speed], dt=0.05, steps=20, controls=[-2.0 * speed])
        assert motion.error_bound is None


def test_a_joint_that_hardly_turns_is_measured_by_the_others():
    scene = vp.Scene(vp.planar_chain(2), gravity=False, stiffness=[0.0, 1e3])
    assert not vp.simulate(scene, [0.0, 4e-5], [1.0, 0.0], dt=0.02, steps=50, integrator=MIDPOINT).warnings


def test_a_slide_that_hardly_moves_is_measured_by_the_arm_that_turns():
    """On a heavy carriage: what the arm of 20 m turns is metres at its end."""
    model = rod_chain([20.0], [1.0], rail=1e3).model.copy()
    model.lowerPositionLimit[0], model.upperPositionLimit[0] = -1.0, 1.0
    scene = vp.Scene(vp.load_robot(model), gravity=(0.0, 0.0, -9.81))
    motion = vp.simulate(scene, [0.0, 0.3], [0.0, 6.0], dt=0.15, steps=40, integrator=MIDPOINT)
    own = motion.error.max(axis=0) / np.ptp(motion.q, axis=0)
    assert own[1] < TOLD < own[0]
    assert not about(motion.warnings, "error")


def test_a_ramp_is_the_polynomial_of_two_stages():
    ramp = vp.OpenLoop(lambda t: [t - 0.5])
    scene = vp.Scene(slider(1.0), gravity=False)
    motion = vp.simulate(scene, [0.3], [0.0], dt=0.1, steps=10, controls=ramp, integrator=vp.Gauss(2))
    assert motion.error_bound is not None


def test_a_blow_within_a_step_is_held_against_the_limit_of_efforts():
    """Its mean over the step is a fifth of it, within the limit."""
    scene = vp.Scene(vp.load_robot("ur5"))
    push = vp.OpenLoop(lambda t: [0.0, 400.0 * (0.1 <= t < 0.102), 0.0, 0.0, 0.0, 0.0], breaks=[0.1, 0.102])
    motion = moved(scene, dt=0.01, steps=20, controls=push, start=np.zeros((2, 6)))
    (told,) = about(motion.warnings, "effort limits")
    assert told.value == pytest.approx(400.0 - scene.robot.effort_limit[1])
    assert told.time == pytest.approx(0.1)


# --- random motions, of which benchmarks/judged_motions.py judges hundreds --------------------------------------------

# Of methods that are given, so that no better choice makes them right.
WRONG_MOTIONS = (13, 20, 52, 54, 65, 94, 143, 154, 224, 226, 248, 264, 284)
# Chaotic ones, and blows within a step, by the default method.
HARD_MOTIONS = (55, 68, 107, 131, 133, 146, 237, 300, 328, 380)
# Blows that no stage of a step sees, and that move the robot elsewhere.
MISSED_BLOWS = (81, 185, 250, 341)
RIGHT_MOTIONS = (
    *(26, 208, 105, 196, 28, 145, 187, 252, 98, 293, 358, 8, 24, 115, 307),
    *(100, 165, 178, 263, 276, 82, 251, 303, 58, 266, 49, 75, 361, 103, 350),
)


def judged(seed):
    case = draw(seed)
    motion = case.simulate()
    return case, motion, judge(case, motion, truth(case))


def estimated(motion, verdict):
    assert motion.error.shape == motion.q.shape
    assert np.isnan(verdict.factor) or 0.5 <= verdict.factor <= 2.0, verdict


@pytest.mark.parametrize("seed", [*WRONG_MOTIONS, *HARD_MOTIONS, *MISSED_BLOWS])
def test_no_wrong_motion_is_untold(seed):
    case, motion, verdict = judged(seed)
    assert "unknown" not in verdict.labels, case
    assert "off" in verdict.labels or seed not in WRONG_MOTIONS, f"{case}: {verdict}"
    assert "untold" not in verdict.labels, f"{case}: {verdict}"
    estimated(motion, verdict)


@pytest.mark.parametrize("seed", RIGHT_MOTIONS)
def test_no_right_motion_is_told(seed):
    case, motion, verdict = judged(seed)
    assert "right" in verdict.labels, f"{case}: {verdict}"
    assert not verdict.labels & {"told", "loop"}, f"{case}: {verdict}"
    estimated(motion, verdict)
