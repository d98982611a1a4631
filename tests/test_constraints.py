"""Holonomic constraints: rows and second derivatives against differences and Pinocchio, assembly, and failures."""

import numpy as np
import pinocchio as pin
import pytest
import zoo
from oracles import Mechanism, jacobian, off_constraints, placements, slope
from refusals import refused, unnamed
from scipy.optimize import minimize

import varpin as vp
from varpin.mechanics.assembly import along_constraints, nearest


def loop(name, **options):
    case = zoo.ZOO[name]
    scene = vp.Scene(case.scene.robot, constraints=case.scene.constraints, **options)
    return scene, case.q0, along_constraints(scene, case.q0, np.array([1.0, 0.0, 0.0, 2.0][: case.q0.size]))


def circle(q):
    return [q[0] ** 2 + 2.0 * q[1] ** 2 - 1.0]


def circle_slope(q):
    return [[2.0 * q[0], 4.0 * q[1], *np.zeros(q.size - 2)]]


def circle_curvature(q, weights):
    return np.diag([2.0 * weights[0], 4.0 * weights[0], *np.zeros(q.size - 2)])


POSE = np.array([[0.0, -1.0, 0.0, 0.1], [1.0, 0.0, 0.0, 0.2], [0.0, 0.0, 1.0, -0.3], [0.0, 0.0, 0.0, 1.0]])
KINDS = {
    "point on point": vp.PointOnPoint("tool0", (0.1, 0.2, 0.3)),
    "one axis": vp.PointOnPoint(("tool0", (0.0, 0.1, 0.2)), ("forearm_link", (0.1, 0.0, 0.0)), axes="y"),
    "weld": vp.FrameOnFrame("tool0", "universe"),
    "weld of two": vp.FrameOnFrame("tool0", "upper_arm_link", POSE),
    "plane": vp.PointOnPlane("tool0", (0.0, 0.0, 0.4), (1.0, 2.0, 3.0)),
    "carried plane": vp.PointOnPlane("tool0", ("upper_arm_link", (0.1, 0.0, 0.2)), (1.0, 2.0, 3.0)),
    "line": vp.PointOnLine("tool0", (0.1, 0.2, 0.3), (0.0, 1.0, 1.0)),
    "carried line": vp.PointOnLine("tool0", ("upper_arm_link", (0.1, 0.0, 0.2)), (1.0, 0.0, 3.0)),
    "rod": vp.Distance("tool0", ("upper_arm_link", (0.0, 0.1, 0.0)), 0.5),
    "gear": vp.JointTie("elbow_joint", "shoulder_lift_joint", (0.1, -2.0)),
    "cam": vp.JointTie("elbow_joint", "shoulder_lift_joint", (0.1, 0.5, -0.3, 0.2, 0.1)),
    "custom": vp.CustomConstraint(1, circle, circle_slope, circle_curvature),
    "custom without curvature": vp.CustomConstraint(1, circle, circle_slope),
}
ARM = zoo.robot("ur5")


@pytest.mark.parametrize("kind", KINDS)
def test_rows_have_the_derivatives_of_their_values(kind):
    scene = vp.Scene(ARM, constraints=KINDS[kind])
    rng = np.random.default_rng(0)
    q, v = rng.normal(size=6), rng.normal(size=6)
    g, C = scene.constraint_values(q)
    assert len(g) == len(scene.constraint_labels)
    np.testing.assert_allclose(C, jacobian(lambda x: scene.constraint_values(x)[0], q, 1e-3), atol=1e-11)
    weights = rng.normal(size=len(g))
    H, bent = scene.core.constraint_curvature(q, weights, v)
    slopes = jacobian(lambda x: scene.core.constraints(x[None])[2][0], q, 1e-3)  # [row, c, k]
    np.testing.assert_allclose(H, np.einsum("r,rck->kc", weights, slopes), atol=1e-10)
    np.testing.assert_allclose(bent, np.einsum("rck,c->rk", slopes, v), atol=1e-10)


def test_rows_mean_what_pinocchio_says():
    q = np.random.default_rng(1).normal(size=6)
    ((tool,), (upper,)) = (placements(ARM, q[None], name) for name in ("tool0", "upper_arm_link"))
    place = upper.act(np.array([0.1, 0.0, 0.2]))

    def value(kind):
        return vp.Scene(ARM, constraints=KINDS[kind]).constraint_values(q)[0]

    np.testing.assert_allclose(value("point on point"), tool.translation - (0.1, 0.2, 0.3), atol=1e-14)
    normal = upper.rotation @ np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0)
    np.testing.assert_allclose(value("carried plane"), [normal @ (tool.translation - place)], atol=1e-14)
    along = upper.rotation @ np.array([1.0, 0.0, 3.0]) / np.sqrt(10.0)
    off = np.linalg.norm(np.cross(along, tool.translation - place))
    assert np.linalg.norm(value("carried line")) == pytest.approx(off, abs=1e-14)
    far = np.linalg.norm(tool.translation - upper.act(np.array([0.0, 0.1, 0.0])))
    np.testing.assert_allclose(value("rod"), [(far**2 - 0.25) / 1.0], atol=1e-14)
    # A weld in the pose that the frames have holds.
    pose = upper.actInv(tool).homogeneous
    weld = vp.Scene(ARM, constraints=vp.FrameOnFrame("tool0", "upper_arm_link", pose))
    np.testing.assert_allclose(weld.constraint_values(q)[0], 0.0, atol=1e-14)


def shake(t):
    return 0.3 * np.array([np.sin(7.0 * t), np.cos(5.0 * t), np.sin(3.0 * t + 1.0)])


def test_parts_of_a_step_are_under_their_own_torques():
    scene, q, v = loop("four-bar", damping=0.1)
    options = {"controls": vp.OpenLoop(shake), "check": False}
    tight = vp.Gauss(2, guard=vp.Guard(energy_balance=1e-9))
    motion = vp.simulate(scene, q, v, dt=0.05, steps=4, integrator=tight, **options)
    assert motion.statistics.split_steps > 0
    lin = vp.linearize(scene, motion)

    def moved(at):
        held = vp.OpenLoop(lambda t: shake(t) + at[:3] + at[3:] * t / 0.05)
        return vp.simulate(scene, q, v, dt=0.05, steps=1, integrator=tight, controls=held, check=False)

    slopes = jacobian(lambda at: np.append(moved(at).q[-1], moved(at).p[-1]), np.zeros(6), 1e-2)
    np.testing.assert_allclose(lin.B[0], slopes[:, :3], atol=1e-8)
    np.testing.assert_allclose(lin.ramp[0], slopes[:, 3:], atol=1e-8)


def test_forces_are_those_of_the_index_reduced_equations():
    """C' y is what the acceleration of M a = C' y - n(q, v), C a = c lacks."""
    scene, q, v = loop("five-bar")
    own = Mechanism(scene)
    motion = vp.simulate(scene, q, v, dt=1e-5, steps=1, integrator=vp.Gauss(2))
    bias = own.G.T @ pin.nonLinearEffects(own.model, own.data, own.positions(q), own.G @ v)
    missing = own.mass_matrix(q) @ own.acceleration(0.0, q, v, np.zeros(4)) + bias
    force = np.linalg.lstsq(scene.constraint_values(q)[1].T, missing, rcond=None)[0]
    np.testing.assert_allclose(motion.constraint_forces[0], force, atol=1e-4 * np.abs(force).max())


@pytest.mark.parametrize("steps", [20_000, pytest.param(200_000, marks=pytest.mark.slow)])
def test_a_long_motion_stays_on_the_constraints_and_keeps_its_energy(steps):
    scene, q, v = loop("four-bar")
    motion = vp.simulate(scene, q, v, dt=2e-3, steps=steps, check=False, integrator=vp.Midpoint())
    assert max(off_constraints(scene, motion)) < 1e-12
    off = motion.energy - motion.energy[0]
    first, second = off[: steps // 2], off[steps // 2 :]
    assert abs(second.mean() - first.mean()) < 0.05 * np.abs(off).max()
    assert np.abs(off).max() < 2e-3 * np.ptp(np.einsum("ki,ki->k", motion.p, motion.v))


def test_a_crank_that_goes_round_keeps_its_digits():
    # A connecting rod twice as long as the crank.
    end = ("tip", (1.0, 0.0, 0.0))
    scene = vp.Scene(vp.planar_chain(2), gravity=False, constraints=vp.PointOnPoint(end, (0.0, 0.0, 0.0), axes="z"))
    q = vp.assemble(scene, [0.4, -0.6])
    v = along_constraints(scene, q, np.array([20.0, -20.0]))
    motion = vp.simulate(scene, q, v, dt=1e-3, steps=20_000, check=False)
    assert np.ptp(motion.q[:, 0]) > 100.0
    # What is shown has as many digits as the turns leave.
    g, rate = off_constraints(scene, motion)
    assert g < 1e-12
    assert rate < 1e-10


def tangent(scene, q, v):
    n = q.size
    jet = vp.lagrangian_jet(scene, q, v)
    C = scene.constraint_values(q)[1]
    bent = scene.core.constraint_curvature(q, np.zeros(len(C)), v)[1][scene.constraint_order]
    inverse = np.linalg.inv(jet.Lvv)
    rows = np.block([[C, np.zeros_like(C)], [bent - C @ inverse @ jet.Lvq, C @ inverse]])
    _, sizes, basis = np.linalg.svd(rows)
    return basis[int((sizes > 1e-9).sum()) :].T, n


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(2), vp.Gauss(3)])
def test_steps_are_symplectic_along_the_constraints_and_go_back(integrator):
    scene, q, v = loop("five-bar")
    motion = vp.simulate(scene, q, v, dt=0.02, steps=6, integrator=integrator)
    lin = vp.linearize(scene, motion)
    A = lin.A[5]
    # What is normal to the constraints does nothing.
    assert np.abs(lin.K[5] @ scene.constraint_values(motion.q[5])[1].T).max() < 1e-12
    assert np.abs(scene.constraint_values(motion.q[6])[1] @ A[:4]).max() < 1e-12
    T, n = tangent(scene, motion.q[5], motion.v[5])
    J = np.block([[np.zeros((n, n)), np.eye(n)], [-np.eye(n), np.zeros((n, n))]])
    assert np.abs(T.T @ (A.T @ J @ A - J) @ T).max() < 1e-12
    assert np.abs(A.T @ J @ A - J).max() > 0.1
    assert np.linalg.matrix_rank(A, tol=1e-9) == 2 * (n - 2)
    back = vp.simulate(scene, motion.q[-1], -motion.v[-1], dt=0.02, steps=6, integrator=integrator)
    np.testing.assert_allclose(back.q[::-1], motion.q, atol=1e-12)


def test_a_start_next_to_the_constraints_is_moved_onto_them(caplog):
    scene, q, v = loop("five-bar")
    off = q + 1e-3 * np.array([1.0, -1.0, 0.5, 1.0])
    motion = vp.simulate(scene, off, [1.0, 1.0, 1.0, 1.0], dt=1e-2, steps=2)
    assert max(off_constraints(scene, motion)) < 1e-12
    (said,) = motion.warnings
    assert not unnamed(said, "q0", "v0")
    assert said in caplog.text
    assert vp.simulate(scene, q, v, dt=1e-2, steps=2).warnings == ()
    with refused(vp.InputError, "q0", "PointOnPoint", "assemble"):
        vp.simulate(scene, q + 0.1, 0.0 * q, dt=1e-2, steps=2)


@pytest.mark.parametrize("off", [1e-3, 0.1, 1.0])
def test_assembly_is_the_nearest(off):
    scene, q, _ = loop("five-bar")
    start = q + off * np.array([0.5, -0.3, 0.4, 0.6])
    M = vp.lagrangian_jet(scene, start, 0 * q).Lvv
    found = vp.assemble(scene, start)
    assert np.abs(scene.constraint_values(found)[0]).max() < 1e-14

    def distance(x):
        return 0.5 * (x - start) @ M @ (x - start)

    closed = {"type": "eq", "fun": lambda x: scene.constraint_values(x)[0]}
    best = minimize(distance, found + 1e-3 * off, constraints=closed, method="SLSQP", options={"ftol": 1e-14})
    assert distance(found) <= best.fun * (1.0 + 1e-5) + 1e-15


def test_a_weld_that_is_turned_round_is_none():
    """Its rows vanish half a turn away, too: a search that ends there goes on from other places."""
    robot = vp.planar_chain(1)
    scene = vp.Scene(robot, constraints=vp.FrameOnFrame("joint1", "universe"))
    assert abs(np.sin(vp.assemble(scene, [0.3])[0] - vp.assemble(scene, [-0.2])[0])) < 1e-12
    closed = vp.assemble(scene, [0.1])[0]
    assert np.cos(vp.assemble(scene, [closed + 3.0])[0] - closed) == pytest.approx(1.0, abs=1e-14)
    with refused(vp.AssemblyError, "FrameOnFrame"):
        vp.assemble(vp.Scene(robot, constraints=vp.FrameOnFrame("joint1", "universe", POSE)), [0.3])
    # They vanish at a third of a turn about a diagonal, too.
    arm, start = vp.load_robot("ur5"), np.array([0.2, -1.2, 1.5, -0.3, 1.4, 0.1])
    place = placements(arm, start[None], "tool0")[0].homogeneous
    third = place.copy()
    third[:3] = place[[2, 0, 1]]
    third[:3, 3] = place[:3, 3]
    scene = vp.Scene(arm, constraints=vp.FrameOnFrame("tool0", "universe", third))
    assert np.abs(scene.constraint_values(start)[0]).max() < 1e-12
    with refused(vp.AssemblyError, "FrameOnFrame", "1.571"):
        vp.simulate(scene, start, np.zeros(6), dt=1e-2, steps=1)
    q = vp.assemble(scene, start)
    np.testing.assert_allclose(placements(arm, q[None], "tool0")[0].homogeneous, third, atol=1e-12)


@pytest.mark.parametrize("ground", [1.01, 1.1])
def test_near_a_toggle_point_steps_are_cut_and_the_assembly_is_kept(ground):
    robot = vp.planar_chain(3)
    scene = vp.Scene(robot, gravity=False, constraints=vp.PointOnPoint("tip", (ground, 0.0, 0.0), axes="xz"))
    q = vp.assemble(scene, [-np.pi / 2, np.pi / 2, np.pi / 2])
    v = along_constraints(scene, q, np.array([3.0, 0.0, 0.0]))
    fine = vp.simulate(scene, q, v, dt=5e-4, steps=6000, integrator=vp.Gauss(3))
    coarse = vp.simulate(scene, q, v, dt=2e-2, steps=150, integrator=vp.Gauss(2))
    assert coarse.statistics.split_steps > 0
    assert np.abs(coarse.energy / coarse.energy[0] - 1.0).max() < 0.01
    np.testing.assert_allclose(coarse.q, fine.q[::40], atol=0.02)


@pytest.mark.parametrize("integrator", [vp.Midpoint(), vp.Gauss(2)])
def test_a_motion_through_a_toggle_point_stops_and_names_the_constraint(integrator):
    scene = vp.Scene(vp.planar_chain(3), gravity=False, constraints=vp.PointOnPoint("tip", (1.0, 0.0, 0.0), axes="xz"))
    # A parallelogram, which may become a crossed one where it is flat.
    q = np.array([-np.pi / 2, np.pi / 2, np.pi / 2])
    with refused(vp.StepFailure, "PointOnPoint") as found:
        vp.simulate(
            scene, q, along_constraints(scene, q, np.array([3.0, 0.0, 0.0])), dt=0.01, steps=100, integrator=integrator
        )
    motion = found.value.trajectory
    assert motion.t[-1] > 0.4
    assert np.abs(motion.energy / motion.energy[0] - 1.0).max() < 1e-3


def test_a_custom_constraint_that_raises_is_told_of():
    def broken(q):
        raise RuntimeError("no value")

    scene = vp.Scene(vp.planar_chain(3), constraints=vp.CustomConstraint(1, broken, circle_slope))
    with refused(vp.CustomConstraintError, "RuntimeError('no value')"):
        vp.simulate(scene, [1.0, 0.0, 0.0], np.zeros(3), dt=1e-2, steps=5)

    def late(q):
        return circle(q) if q[2] < 0.05 else [np.nan]

    failing = vp.Scene(vp.planar_chain(3), constraints=vp.CustomConstraint(1, late, circle_slope, circle_curvature))
    with refused(vp.ConstraintError, "CustomConstraint") as info:
        vp.simulate(failing, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0], dt=1e-2, steps=50)
    assert info.value.trajectory.steps == info.value.step > 0
    with refused(vp.ConstraintError, "CustomConstraint") as info:
        vp.simulate(failing, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0], duration=0.5, tolerance=1e-4)
    assert info.value.trajectory.steps > 0
    wrong = vp.Scene(vp.planar_chain(3), constraints=vp.CustomConstraint(2, circle, circle_slope))
    with refused(vp.CustomConstraintError, "(2,)", "(1,)"):
        wrong.constraint_values(np.zeros(3))


WRONG = {
    "frame": (lambda: vp.PointOnPoint("tyip", (0, 0, 0)), (vp.UnknownFrame, "'tyip'", "'tip'")),
    "axes": (lambda: vp.PointOnPoint("tip", (0, 0, 0), axes="xx"), (vp.InputError, "axes", "'xx'")),
    "shape": (lambda: vp.PointOnPoint("tip", (0, 0)), (vp.InputError, "b", "(2,)")),
    "not finite": (lambda: vp.PointOnPoint("tip", (0, 0, np.nan)), (vp.InputError, "b[2]", "nan")),
    "both in the world": (lambda: vp.Distance((0, 0, 0), (1, 0, 0), 1.0), (vp.InputError, "both ends")),
    "one body": (lambda: vp.Distance("tip", ("tip", (0, 0, 1)), 1.0), (vp.InputError, "one body")),
    "length": (lambda: vp.Distance("tip", (0, 0, 0), 0.0), (vp.InputError, "length", "0.0")),
    "normal": (lambda: vp.PointOnPlane("tip", (0, 0, 0), (0, 0, 0)), (vp.InputError, "normal")),
    "joint": (lambda: vp.JointTie("joint9", "joint1"), (vp.UnknownJoint, "'joint9'", "'joint1'")),
    "itself": (lambda: vp.JointTie("joint1", "joint1"), (vp.InputError, "itself")),
    "placement": (lambda: vp.FrameOnFrame("tip", "universe", 2.0 * np.eye(4)), (vp.InputError, "placement")),
    "function": (lambda: vp.CustomConstraint(1, 3.0, circle_slope), (vp.InputError, "value", "3.0")),
    "word": (lambda: "weld", (vp.InputError, "constraints", "'weld'")),
    "in a list": (lambda: ["weld"], (vp.InputError, "constraints", "'weld'")),
    "of a plan": (
        lambda: [vp.WithinJointLimits(vp.planar_chain(3), (-1, 1))],
        (vp.InputError, "OptimalControlProblem"),
    ),
}


@pytest.mark.parametrize("what", WRONG)
def test_wrong_constraints_are_refused(what):
    make, (kind, *facts) = WRONG[what]
    with refused(kind, *facts):
        vp.Scene(vp.planar_chain(3), constraints=make())


@pytest.mark.parametrize("kind", [vp.Midpoint, vp.Gauss])
def test_a_check_of_the_linearization(kind):
    """It confirms A along the constraints, B and G; a wrong normal part is none, a wrong tangent part is told."""
    scene, q, v = loop("five-bar", noise=vp.AdditiveNoise(0.1), damping=0.2)
    u, C = np.linspace(-1.0, 1.0, scene.controls), scene.constraint_values(q)[1]

    def check(at, integrator):
        return vp.check_linearization(scene, at, v, u, dt=1e-2, integrator=integrator)

    assert check(q, kind()).worst < 1e-8
    # Moved onto the constraints, as by simulate.
    assert check(q + 0.003, kind()).worst < 1e-8
    with refused(vp.InputError, "misses", "PointOnPoint"):
        check(q + 0.5, kind())
    for row, right in ((C[0], True), (np.linalg.svd(C)[2][-1], False)):

        class Wrong(kind):
            def linearize(self, scene, trajectory, row=row, **options):
                A, *others = super().linearize(scene, trajectory, **options)
                A[:, 0, : q.size] += 1e-4 * row
                return A, *others

        assert check(q, Wrong()).holds == right


def test_rows_keep_the_order_they_are_given_in():
    robot = vp.planar_chain(4)
    given = [
        vp.JointTie("joint2", "joint1", (0.0, 0.5)),
        vp.PointOnPoint("tip", (1.6, 0.0, 0.3), axes="z"),
        vp.CustomConstraint(1, circle, circle_slope),
        vp.PointOnPoint("tip", (1.6, 0.0, 0.3), axes="x"),
    ]
    scene = vp.Scene(robot, constraints=given)
    q = np.array([0.3, 0.1, 0.5, -0.2])
    each = [vp.Scene(robot, constraints=own).constraint_values(q) for own in given]
    g, C = scene.constraint_values(q)
    np.testing.assert_array_equal(g, np.concatenate([own for own, _ in each]))
    np.testing.assert_array_equal(C, np.concatenate([own for _, own in each]))
    assert [label.partition("(")[0] for label in scene.constraint_labels] == [type(own).__name__ for own in given]


def test_scene_files_have_constraints(tmp_path):
    path = tmp_path / "loop.toml"
    text = (
        '[robot]\nsource = "ur5"\n[[constraint]]\ntype = "point_on_point"\n'
        'a = { frame = "tool0", place = [0.0, 0.0, 0.1] }\nb = [0.3, 0.2, 0.4]\naxes = "xz"\n'
        "[horizon]\ndt = 2e-3\nsteps = 10\n"
    )
    path.write_text(text)
    file, own = vp.load_scene(path), vp.PointOnPoint(("tool0", [0.0, 0.0, 0.1]), [0.3, 0.2, 0.4], axes="xz")
    assert file.scene.bound_constraints == vp.Scene(vp.load_robot("ur5"), constraints=own).bound_constraints
    assert file.required.terms["constraints"] == "PointOnPoint"
    with refused(vp.SceneFileError, "loop.toml", "initial.q", "q0", "assemble"):
        file.simulate()
    path.write_text(text.replace("tool0", "tol0"))
    with refused(vp.SceneFileError, "constraint[0]", "'tol0'"):
        vp.load_scene(path)


def test_a_function_gets_angles_with_their_whole_turns():
    robot = vp.planar_chain(2)
    on_a_line = [vp.PointOnPlane("tip", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))]
    q = vp.assemble(vp.Scene(robot, constraints=on_a_line), [2.0 * np.pi + 0.5, 2.0])
    forces = vp.CustomForce(lambda q, v: -5.0 * q), vp.JointSpring(5.0)
    scenes = [vp.Scene(robot, constraints=on_a_line, forces=[force]) for force in forces]
    motions = [vp.simulate(scene, q, [0, 0], dt=1e-2, steps=20, integrator=vp.Gauss(2)) for scene in scenes]
    np.testing.assert_allclose(motions[0].q, motions[1].q, atol=1e-9)


def test_rows_whose_terms_vanish_hold_from_rest():
    robot = vp.planar_chain(3)
    scene = vp.Scene(robot, constraints=[vp.JointTie("joint1", "joint2", (0.0, 0.0))])
    motion = vp.simulate(scene, [0.0, 0.2, 0.3], [0, 0, 0], dt=2e-3, steps=50, integrator=vp.Gauss(2))
    assert np.abs(motion.q[:, 0]).max() < 1e-15
    base = vp.load_robot("ur5", base="planar")
    held = vp.Scene(base, constraints=[vp.FrameOnFrame("base_link", "universe")])
    motion = vp.simulate(held, np.zeros(base.dof), np.zeros(base.dof), dt=2e-3, steps=20, integrator=vp.Gauss(2))
    fixed = vp.load_robot("ur5")
    alone = vp.simulate(vp.Scene(fixed), np.zeros(6), np.zeros(6), dt=2e-3, steps=20, integrator=vp.Gauss(2))
    np.testing.assert_allclose(motion.q[:, 3:], alone.q, atol=1e-9)


# --- second derivatives of steps -------------------------------------------------------------------------------------


# Central differences of eighth order, of the second derivative.
SECOND = {0: -205 / 72, 1: 8 / 5, 2: -1 / 5, 3: 8 / 315, 4: -1 / 560}
SIZE = 1e-3


def second(values):
    return (SECOND[0] * values[0] + sum(SECOND[k] * (values[k] + values[-k]) for k in range(1, 5))) / SIZE**2


CUBIC = [zoo.CRANK[0], vp.KinematicInput("joint1", "cubic")]
CASES = {
    "forces": zoo.ZOO["five-bar"],
    "linear": zoo.ZOO["cranked five-bar"],
    "cubic": zoo.Case("", zoo.chain(4, damping=0.3, constraints=CUBIC), **zoo.FIVE, path=zoo.cranked),
}


@pytest.mark.parametrize("integrator", [vp.Midpoint(guard=None), vp.Gauss(2, guard=None)])
@pytest.mark.parametrize("kind", CASES)
def test_against_differences_of_steps_along_the_constraints(kind, integrator):
    """Of z . x1 on curves through states that keep the constraints: f'' = x' H x' + z J x''."""
    scene, q, v = CASES[kind].scene, CASES[kind].q0, CASES[kind].v0
    rng, n = np.random.default_rng(3), 4
    u = scene.command_at(q) + 0.01 * rng.normal(size=scene.controls)
    given = {"dt": 1e-2, "steps": 1, "integrator": integrator, "check": False}
    motion = vp.simulate(scene, q, v, controls=u[None], **given)
    lin = vp.linearize(scene, motion)
    # States that keep what is not moved by hand.
    fixed = vp.Scene(scene.robot, constraints=scene.constraints[:1])
    z = rng.normal(size=2 * n)
    own = vp.second_order(scene, motion, z)
    H = np.block([[own.xx[0], own.ux[0].T], [own.ux[0], own.uu[0]]])
    np.testing.assert_allclose(H, H.T, rtol=1e-12, atol=1e-12 * np.abs(H).max())
    for _ in range(3):
        dq, dv, du = rng.normal(size=n), rng.normal(size=n), rng.normal(size=scene.controls)

        def curve(s, dq=dq, dv=dv, du=du):
            """The state and the controls at s, and z . x1 of there."""
            at, command = nearest(fixed, q + s * dq), u + s * du
            rate = along_constraints(fixed, at, v + s * dv)
            moved = vp.simulate(scene, at, rate, controls=command[None], **given)
            return np.concatenate([at, moved.p[0], command, [z @ np.append(moved.q[1], moved.p[1])]])

        *along, rise = slope(curve, 0.0, 1.0, SIZE)
        *bend, curvature = second({k: curve(k * SIZE) for k in range(-4, 5)})
        J = np.concatenate([lin.A[0], lin.B[0]], axis=1)
        assert abs(rise - z @ J @ along) < 1e-8 * np.abs(z @ J * along).max()
        terms, bends = np.outer(along, along) * H, z @ J * bend
        size = max(np.abs(terms).max(), np.abs(bends).max())
        assert abs(curvature - terms.sum() - bends.sum()) < 1e-7 * size


@pytest.mark.parametrize(
    "constraint", [vp.PointOnPoint("joint3", (5.0, 0.0, 0.0)), vp.Distance("joint3", (0.0, 0.0, 4.0), 0.5)], ids=repr
)
def test_an_assembly_that_cannot_be_names_a_place_nearby(constraint):
    """A target out of reach: polishing to rounding must not lead away from where the search ended."""
    with pytest.raises(vp.AssemblyError) as info:
        vp.assemble(vp.Scene(vp.planar_chain(3), constraints=constraint), [0.3, 0.4, 0.2])
    assert np.abs(info.value.q).max() < 10.0
    assert info.value.miss < 3.8


def test_a_wrong_jacobian_is_named_where_steps_fail():
    wrong = vp.CustomConstraint(1, lambda q: [np.sin(q[0]) + q[1] - 0.3], lambda q: [[-np.cos(q[0]), -1.0]])
    with refused(vp.StepFailure, "CustomConstraint", "derivatives are wrong"):
        vp.simulate(vp.Scene(vp.planar_chain(2), constraints=[wrong]), [0.0, 0.3], [0.0, 0.0], dt=1e-2, steps=20)
