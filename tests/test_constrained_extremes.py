"""What closed loops must hold to at their extremes, and no silent wrong motion in odd ones; the zoo has usual ones."""

import functools

import numpy as np
import pinocchio as pin
import pytest
import zoo
from mechanisms import rod_chain
from oracles import exact, off_constraints

import varpin as vp
from varpin.mechanics.assembly import along_constraints


def held(place, axes="xz"):
    return vp.PointOnPoint("tip", place, axes=axes)


def odd_loops(count):
    """Loops that are nearly flat, closed twice, welded, geared or started off their constraints."""
    rng = np.random.default_rng(5)
    for _ in range(count):
        links = int(rng.integers(2, 6))
        robot = vp.planar_chain(links)
        reach = rng.choice([links - 1e-6, links - 1e-3, links - 0.05, 0.5 * links, 0.1, links + 0.1])
        angle = rng.uniform(-np.pi, np.pi)
        place = reach * np.array([np.cos(angle), 0.0, np.sin(angle)])
        loops = [held(place, str(rng.choice(["xz", "xyz", "z"])))]
        more = int(rng.integers(0, 4))
        if more == 1:
            loops.append(held(place, "x"))
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
        kept = (np.array(off_constraints(scene, motion)) < [1e-10, 1e-8]).all()
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


# --- extremes --------------------------------------------------------------------------------------------------------

SPAN = 0.3  # [s]
LOOPS: dict[str, zoo.Case] = {}
# Controls as functions of time, of those that are driven.
DRIVES = {
    "four-bar, servo": lambda t: np.array([-1.4 + 0.3 * np.sin(5.0 * t)]),
    "two arms, damped and driven": lambda t: 20.0 * np.sin(7.0 * t + np.arange(12)),
}
CRANK = np.array([1.0, 0.0, 0.0])


def add(name, constraints, start=(-1.5, 1.5, 1.5), push=CRANK, *, robot=None, stiff=False, **scene):
    made = {"constraints": constraints, "damping": 0.0, **scene}
    LOOPS[name] = zoo.Case(name, lambda: vp.Scene((robot or vp.planar_chain(3)), **made), start, push, stiff=stiff)


def facing_arms():
    """Two UR5 that look at each other, and what fixes a beam of one in the other's hand."""
    place, grip = np.diag([-1.0, -1.0, 1.0, 1.0]), np.diag([1.0, -1.0, -1.0, 1.0])
    place[0, 3], grip[2, 3] = 1.0, 0.5
    beam = vp.Payload("tool0", mass=3.0, center=[0.0, 0.0, 0.25], inertia=[0.0625, 0.0625, 1e-3])
    left, right = vp.load_robot("ur5", payload=beam), vp.load_robot("ur5")
    both = vp.combine(left, right, placements=[None, place], prefixes=["left_", "right_"])
    return both, vp.FrameOnFrame("right_tool0", "left_tool0", grip)


def delta():
    """Three legs of a crank about an axis across the base and a rod on a universal joint, as of a delta robot."""
    model, none = pin.Model(), pin.SE3.Identity()
    for k in range(3):
        turn = pin.utils.rotate("z", 2.0 * np.pi * k / 3.0)
        joint = model.addJoint(0, pin.JointModelRY(), pin.SE3(turn, turn @ np.array([0.2, 0.0, 0.0])), f"crank{k}")
        model.appendBodyToJoint(joint, pin.Inertia(0.5, np.array([0.1, 0, 0]), 1e-3 * np.eye(3)), none)
        joint = model.addJoint(joint, pin.JointModelRY(), pin.SE3(np.eye(3), np.array([0.2, 0.0, 0.0])), f"lift{k}")
        model.appendBodyToJoint(joint, pin.Inertia(0.01, np.zeros(3), 1e-5 * np.eye(3)), none)
        joint = model.addJoint(joint, pin.JointModelRZ(), none, f"swing{k}")
        rod = pin.Inertia(0.2, np.array([0.25, 0.0, 0.0]), np.diag([1e-5, 4e-3, 4e-3]))
        model.appendBodyToJoint(joint, rod, none)
        end = pin.SE3(np.eye(3), np.array([0.5, 0.0, 0.0]))
        model.addFrame(pin.Frame(f"end{k}", joint, 0, end, pin.FrameType.OP_FRAME))
    return vp.load_robot(model)


BAR, SIDE = held((1.3, 0.0, 0.2)), held((1.0, 0.0, 0.0))
add("swift", BAR, push=10.0 * CRANK)
add("parallelogram", SIDE, (-1.2, 1.2, 1.2))
add("parallelogram next to flat", SIDE, (-0.05, 0.05, 0.05), -CRANK)
add("nearly stretched", held((2.9, 0.0, 0.0)), (-0.3, 0.3, 0.2))
add("all but stretched", held((2.999, 0.0, 0.0)), (-0.03, 0.03, 0.02))
add("three rows in a plane", held((1.3, 0.0, 0.2), "xyz"))
add("closed twice", [BAR, held((1.3, 0.0, 0.2), "zx")])
add("delta", [vp.PointOnPoint("end0", f"end{k}") for k in (1, 2)], [0.3, 1.4, 0.0] * 3, 1.0, robot=delta())
ARMS, GRIP = facing_arms()
for name, forces in (("two arms hold a beam", ()), ("two arms, damped and driven", vp.JointDamper(2.0))):
    add(name, GRIP, [-0.35, -1.3, 1.9, -0.6, 1.2, 0.0] * 2, 0.3, robot=ARMS, forces=forces)
# Their references are implicit, and take seconds.
STIFF = {f"springs {k:g}, dampers {d:g}": (k, d) for k, d in ((1e2, 1.0), (1e4, 1e2), (0.0, 1e2), (0.0, 1e4))}
for name, (k, d) in STIFF.items():
    add(name, BAR, stiff=True, forces=[vp.JointSpring(k, [-1.4, 1.4, 1.6]), vp.JointDamper(d)])
for heavy, light in ((1e4, 1e4), (1e-6, 1e-6), (1e4, 1e-6), (1e-6, 1e4), (1.0, 1e-6), (1.0, 1e4)):
    add(f"links of {heavy:g} and {light:g} kg", BAR, robot=rod_chain([1.0, 1.0, 1.0], [heavy, light, heavy]))
add("four-bar, friction", BAR, forces=vp.CoulombFriction(1.0, 0.1), stiff=True)
add("four-bar, servo", BAR, forces=vp.PositionServo({"joint1": 2e3}, {"joint1": 50.0}), actuation=["joint1"])
LOOP_METHODS = [vp.Midpoint(), vp.Gauss(2), vp.Gauss(3)]


@functools.cache
def truth(case):
    """q and v (31, n) at evenly spaced times."""
    signal = (lambda k, q, v: DRIVES[case.name]) if case.name in DRIVES else None
    return exact(case.scene, case.q0, case.v0, np.linspace(0.0, SPAN, 31), signal, stiff=case.stiff)


def moved(case, integrator, steps):
    own, controls = truth(case), vp.OpenLoop(DRIVES[case.name]) if case.name in DRIVES else None
    given = {"dt": SPAN / steps, "steps": steps, "controls": controls, "integrator": integrator}
    motion = vp.simulate(case.scene, case.q0, case.v0, **given)
    mine, its = max(1, steps // 30), max(1, 30 // steps)
    off = np.abs(motion.q[::mine] - own.q[::its]).max() / np.ptp(own.q, axis=0).max()
    return motion, off, np.abs(motion.v[::mine] - own.v[::its]).max() / np.abs(own.v).max()


def judged(case, integrator, steps):
    try:
        motion, off, rate_off = moved(case, integrator, steps)
    except vp.StepFailure:
        return False
    miss, rate = off_constraints(case.scene, motion)
    assert miss < 1e-11
    assert rate < 1e-12 * max(1.0, 10.0 * np.abs(motion.v).max())
    told = any("limits" not in sentence for sentence in motion.warnings)
    assert (off < 0.05 and rate_off < 0.1) or told
    return True


@pytest.mark.parametrize("name", [pytest.param(k, marks=[pytest.mark.slow] if k in STIFF else []) for k in LOOPS])
def test_loops_at_their_extremes_move_as_index_reduced_equations_do(name):
    for integrator in LOOP_METHODS:
        assert judged(LOOPS[name], integrator, 30)
    if name not in STIFF:
        _, off, rate_off = moved(LOOPS[name], vp.Gauss(3), 300)
        assert max(off, rate_off) < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize("name", LOOPS)
def test_loops_at_their_extremes_over_decades_of_steps(name):
    for integrator in (vp.Midpoint(), *(vp.Gauss(stages) for stages in (1, 2, 3, 4))):
        assert all(judged(LOOPS[name], integrator, steps) for steps in (3, 30, 300))


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(2)])
def test_light_links_that_carry_a_heavy_one_take_long_steps(integrator):
    motion, off, rate_off = moved(LOOPS["links of 1e-06 and 10000 kg"], integrator, 3)
    assert motion.statistics.split_steps == 0
    assert max(off, rate_off) < (2e-2 if integrator.order == 2 else 1e-4)


BEAM = LOOPS["two arms hold a beam"]


@pytest.mark.parametrize("case", [zoo.ZOO["four-bar"], BEAM, zoo.ZOO["plane"]], ids=lambda case: case.name)
@pytest.mark.parametrize("tolerance", [1e-3, 1e-8])
def test_tolerances_are_met(case, tolerance):
    motion = vp.simulate(case.scene, case.q0, case.v0, duration=SPAN, tolerance=tolerance)
    assert {finding.kind for finding in motion.warnings} <= {"position limits", "velocity limits"}
    assert motion.accuracy.met
    off = np.abs(motion.q[-1] - truth(case).q[-1]).max()
    assert off < max(tolerance, 1e-10)
    assert off < 1.5 * motion.accuracy.error + 1e-10


def test_advice_is_right():
    advice = vp.advise(BEAM.scene, BEAM.q0, BEAM.v0, duration=SPAN, tolerance=1e-6)
    assert advice.reached
    best = advice.best
    motion = vp.simulate(BEAM.scene, BEAM.q0, BEAM.v0, dt=best.dt, steps=best.steps, integrator=best.integrator)
    assert np.abs(motion.q[-1] - truth(BEAM).q[-1]).max() < 2e-6
