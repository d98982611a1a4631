"""What closed loops must hold to: energy over long times, time reversal, and no silent wrong motion in odd loops."""

import functools

import numpy as np
import pytest
from battery.loops import LOOPS, STIFF

import varpin as vp
from varpin.mechanics.assembly import along_constraints


def odd_loops(count):
    """Loops that are nearly flat, closed twice, welded, geared or started off their constraints."""
    rng = np.random.default_rng(5)
    for _ in range(count):
        links = int(rng.integers(2, 6))
        robot = vp.planar_chain(links)
        reach = rng.choice([links - 1e-6, links - 1e-3, links - 0.05, 0.5 * links, 0.1, links + 0.1])
        angle = rng.uniform(-np.pi, np.pi)
        place = reach * np.array([np.cos(angle), 0.0, np.sin(angle)])
        loops = [vp.PointOnPoint("tip", place, axes=str(rng.choice(["xz", "xyz", "z"])))]
        more = int(rng.integers(0, 4))
        if more == 1:
            loops.append(vp.PointOnPoint("tip", place, axes="x"))
        elif more == 2:
            loops.append(vp.JointTie("joint2", "joint1", [0.0, float(rng.normal())]))
        elif more == 3:
            loops.append(vp.Distance("tip", (0.0, 0.0, 0.0), max(reach, 0.1)))
        yield vp.Scene(robot, constraints=loops), rng.normal(size=links), rng


@pytest.mark.parametrize("count", [20, pytest.param(200, marks=pytest.mark.slow)])
def test_odd_loops_move_rightly_or_say_that_they_do_not(count):
    told, right, wrong = 0, 0, []
    for number, (scene, start, rng) in enumerate(odd_loops(count)):
        n = scene.robot.dof
        try:
            q = vp.assemble(scene, start)
            off = rng.choice([0.0, 1e-3, 0.1, 1.0]) * rng.normal(size=n)
            v = along_constraints(scene, q, rng.normal(size=n))
            motion = vp.simulate(scene, q + off, v, dt=5e-3, steps=40, integrator=vp.Gauss(2))
        except (vp.AssemblyError, vp.InputError, vp.StepFailure):
            told += 1
            continue
        g, _, C = scene.core.constraints(motion.q)
        kept = np.abs(g).max() < 1e-10 and np.abs(np.einsum("kmn,kn->km", C, motion.v)).max() < 1e-8
        try:
            fine = vp.simulate(scene, motion.q[0], motion.v[0], dt=5e-4, steps=400, integrator=vp.Gauss(3), check=False)
        except vp.StepFailure:
            # Nearer to where it has no unique continuation the finer motion sees more.
            fine = None
        away = 0.0 if fine is None else np.abs(fine.q[::10] - motion.q).max()
        if kept and (away < 1e-2 or motion.warnings):
            right += 1
        else:
            wrong.append((number, kept, away, scene))
    assert not wrong
    assert right > count / 5
    assert told > count / 10


LOOP_METHODS = [vp.Midpoint(), vp.Gauss(2), vp.Gauss(3)]


@functools.cache
def exact_motion(number):
    loop = LOOPS[number]()
    return loop, *loop.state(), loop.motion(31)


def moved(number, integrator, steps):
    loop, q, v, (exact_q, exact_v) = exact_motion(number)
    controls = None if loop.controls is None else vp.OpenLoop(loop.controls)
    dt = loop.duration / steps
    motion = vp.simulate(loop.scene, q, v, dt=dt, steps=steps, controls=controls, integrator=integrator)
    mine, its = max(1, steps // 30), max(1, 30 // steps)
    off = np.abs(motion.q[::mine] - exact_q[::its]).max() / np.ptp(exact_q, axis=0).max()
    rate_off = np.abs(motion.v[::mine] - exact_v[::its]).max() / np.abs(exact_v).max()
    return motion, off, rate_off


def told(motion):
    return any("limits" not in sentence for sentence in motion.warnings)


def judged(number, integrator, steps):
    try:
        motion, off, rate_off = moved(number, integrator, steps)
    except vp.StepFailure:
        return False
    g, _, C = exact_motion(number)[0].scene.core.constraints(motion.q)
    assert np.abs(g).max() < 1e-11
    assert np.abs(np.einsum("kmn,kn->km", C, motion.v)).max() < 1e-12 * max(1.0, 10.0 * np.abs(motion.v).max())
    assert (off < 0.05 and rate_off < 0.1) or told(motion)
    return True


# The stiff references take seconds each.
@pytest.mark.parametrize(
    "number", [pytest.param(k, marks=[pytest.mark.slow] if k in STIFF else []) for k in range(len(LOOPS))]
)
def test_loops_at_their_extremes_move_as_index_reduced_equations_do(number):
    for integrator in LOOP_METHODS:
        assert judged(number, integrator, 30)
    if number in STIFF:
        return
    _, off, rate_off = moved(number, vp.Gauss(3), 300)
    assert off < 1e-8
    assert rate_off < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize("number", range(len(LOOPS)))
def test_loops_at_their_extremes_over_decades_of_steps(number):
    for integrator in (vp.Midpoint(), *(vp.Gauss(stages) for stages in (1, 2, 3, 4))):
        assert all(judged(number, integrator, steps) for steps in (3, 30, 300))


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(2)])
def test_light_links_that_carry_a_heavy_one_take_long_steps(integrator):
    (number,) = (k for k, made in enumerate(LOOPS) if made().name == "links of 1e-06 and 10000 kg")
    motion, off, rate_off = moved(number, integrator, 3)
    assert motion.statistics.split_steps == 0
    assert max(off, rate_off) < (2e-2 if integrator.order == 2 else 1e-4)


@pytest.mark.parametrize("number", [0, 13, 14])
@pytest.mark.parametrize("tolerance", [1e-3, 1e-8])
def test_tolerances_are_met(number, tolerance):
    loop, q, v, (truth, _) = exact_motion(number)
    motion = vp.simulate(loop.scene, q, v, duration=loop.duration, tolerance=tolerance)
    assert {finding.kind for finding in motion.warnings} <= {"position limits", "velocity limits"}
    assert motion.accuracy.met
    off = np.abs(motion.q[-1] - truth[-1]).max()
    assert off < max(tolerance, 1e-10)
    assert off < 1.5 * motion.accuracy.error + 1e-10


def test_advice_is_right():
    loop, q, v, (truth, _) = exact_motion(13)
    advice = vp.advise(loop.scene, q, v, duration=loop.duration, tolerance=1e-6)
    assert advice.reached
    best = advice.best
    motion = vp.simulate(loop.scene, q, v, dt=best.dt, steps=best.steps, integrator=best.integrator)
    assert np.abs(motion.q[-1] - truth[-1]).max() < 2e-6
