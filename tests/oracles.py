"""Plain answers to hold the library against: continuous motions, forces by their formulas, central differences.

Everything is written on Pinocchio's own calls and SciPy, in the coordinates of ``robot.joint_names``. Nothing here
takes a step of the library.
"""

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp
from scipy.optimize import Bounds, lsq_linear, minimize

import varpin as vp

WORLD = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
WEIGHTS = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}  # of eighth-order central differences
Force = Callable[[float], np.ndarray]
Path = Callable[[float], tuple[np.ndarray, np.ndarray, np.ndarray]]


def slope(f: Callable[[np.ndarray], np.ndarray], x: np.ndarray, along: np.ndarray, size: float) -> np.ndarray:
    """d f(x + s along) / ds at s = 0 by differences of eighth order with steps ``size``."""
    return sum(w * (f(x + k * size * along) - f(x - k * size * along)) for k, w in WEIGHTS.items()) / size


def jacobian(f: Callable[[np.ndarray], np.ndarray], x: np.ndarray, size: float) -> np.ndarray:
    """The derivative of f in each entry of x (n,) or of rows x (N, n), as a last axis, as :func:`slope` has it."""
    return np.stack([slope(f, x, e, size) for e in np.eye(x.shape[-1])], axis=-1)


def order_of(counts: Sequence[float], errors: Sequence[float]) -> float:
    """The order of convergence: minus the slope of log error over log count, by least squares."""
    return -float(np.polyfit(np.log(counts), np.log(errors), 1)[0])


class Motion(NamedTuple):
    """A continuous motion at times: q, v (N + 1, n), energy and work of forces without potential (N + 1,)."""

    q: np.ndarray
    v: np.ndarray
    energy: np.ndarray
    work: np.ndarray


class Mechanism:
    """The equations M a = F(t, q, v) - bias + C' y, C a = -dC/dt v of a scene, by Pinocchio.

    The motion of a joint with a :class:`varpin.KinematicInput` is ``path``: its position, rate and acceleration, one
    entry for each input.
    """

    def __init__(self, scene: vp.Scene, path: Path | None = None) -> None:
        robot = scene.robot
        self.scene, self.path, self.names = scene, path, list(robot.joint_names)
        self.model = robot.model.copy()
        self.model.gravity.linear = scene.gravity
        self.data, self.n = self.model.createData(), robot.dof
        # Coordinates to joints: leaders, and followers of mimic joints; a continuous joint is cos and sin.
        self.G, self.offset = np.zeros((self.model.nv, self.n)), np.zeros(self.model.nv)
        ties = {tie.follower: tie for tie in robot.ties}
        self.rotor = np.zeros(self.n)
        for joint in range(1, self.model.njoints):
            tie, row = ties.get(joint), self.model.joints[joint].idx_v
            c = self.names.index(self.model.names[tie.leader if tie else joint])
            self.G[row, c], self.offset[row] = (tie.ratio, tie.offset) if tie else (1.0, 0.0)
            self.rotor[c] += 0.0 if tie else self.model.armature[row]
        self.model.armature = np.zeros(self.model.nv)
        for own in scene.forces:
            if isinstance(own, vp.Armature):
                self.rotor = self.rotor + self.per_joint(own.inertia, 0.0)
        self.round = [joint for joint in self.model.joints if joint.nq == 2]

    def per_joint(self, value: object, missing: float) -> np.ndarray:
        """A parameter as (n,): one number, an array, or numbers by joint name."""
        if hasattr(value, "keys"):
            return np.array([float(value[name]) if name in value else missing for name in self.names])
        return np.broadcast_to(np.asarray(value, float), (self.n,)).copy()

    def positions(self, q: np.ndarray) -> np.ndarray:
        """Pinocchio's configuration."""
        angles = self.G @ q + self.offset
        if not self.round:
            return angles
        found = np.zeros(self.model.nq)
        for joint in list(self.model.joints)[1:]:
            angle = angles[joint.idx_v]
            found[joint.idx_q : joint.idx_q + joint.nq] = angle if joint.nq == 1 else (np.cos(angle), np.sin(angle))
        return found

    def place(self, q: np.ndarray, v: np.ndarray | None = None) -> None:
        """Update every frame and its Jacobian; with ``v`` its acceleration at zero joint accelerations, too."""
        at = self.positions(q)
        pin.computeJointJacobians(self.model, self.data, at)
        if v is not None:
            pin.forwardKinematics(self.model, self.data, at, self.G @ v, np.zeros(self.model.nv))
        pin.updateFramePlacements(self.model, self.data)

    def point(self, end: object) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Place (3,), rotation (3, 3), Jacobian (6, n) and bias acceleration (6,) of a point, world axes."""
        name, shift = end if isinstance(end, tuple) else (end, np.zeros(3))
        if not isinstance(name, str):
            return np.asarray(end, float), np.eye(3), np.zeros((6, self.n)), np.zeros(6)
        f = self.model.getFrameId(name)
        R, x = self.data.oMf[f].rotation.copy(), self.data.oMf[f].translation.copy()
        # Of one joint the bindings drop an axis.
        J = pin.getFrameJacobian(self.model, self.data, f, WORLD).reshape(6, -1) @ self.G
        a = pin.getFrameClassicalAcceleration(self.model, self.data, f, WORLD).vector.copy()
        w = pin.getFrameVelocity(self.model, self.data, f, WORLD).angular
        r = R @ np.asarray(shift, float)
        a[:3] += np.cross(a[3:], r) + np.cross(w, np.cross(w, r))
        J[:3] -= pin.skew(r) @ J[3:]
        return x + r, R, J, a

    def mass_matrix(self, q: np.ndarray) -> np.ndarray:
        """M (n, n), rotors included."""
        full = pin.crba(self.model, self.data, self.positions(q))
        full = np.triu(full) + np.triu(full, 1).T
        return self.G.T @ full @ self.G + np.diag(self.rotor)

    def forces(self, q: np.ndarray, v: np.ndarray, drive: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Energy of springs and loads, its force -dV/dq (n,), and all other forces (n,), under ``drive`` (n,)."""
        V, pull, rest, drive = 0.0, np.zeros(self.n), np.zeros(self.n), drive.copy()
        placed = False
        for own in self.scene.forces:
            if isinstance(own, vp.FrameSpring | vp.FrameDamper | vp.FrameWrench):
                if not placed:
                    self.place(q)
                    placed = True
                energy, of_energy, other = self._frame_force(own, v)
                V, pull, rest = V + energy, pull + of_energy, rest + other
            elif isinstance(own, vp.JointSpring):
                k, at = self.per_joint(own.stiffness, 0.0), self.per_joint(own.rest, 0.0)
                V, pull = V + 0.5 * float(k @ (q - at) ** 2), pull - k * (q - at)
            elif isinstance(own, vp.JointDamper):
                rest -= self.per_joint(own.damping, 0.0) * v
            elif isinstance(own, vp.CoulombFriction):
                level, width = self.per_joint(own.level, 0.0), self.per_joint(own.width, 1.0)
                if own.breakaway is not None:
                    fading = self.per_joint(own.stribeck_velocity, 1.0)
                    level = level + (self.per_joint(own.breakaway, 0.0) - level) * np.exp(-((v / fading) ** 2))
                rest -= level * np.tanh(v / width)
            elif isinstance(own, vp.JointStop):
                energy, of_energy, other = self._stop(own, q, v)
                V, pull, rest = V + energy, pull + of_energy, rest + other
            elif isinstance(own, vp.PositionServo):
                k, d = self.per_joint(own.stiffness, 0.0), self.per_joint(own.damping, 0.0)
                most, driven = self.per_joint(own.effort, np.inf), k > 0.0
                drive[driven] = saturated(drive - k * q - d * v, most)[driven]
            elif isinstance(own, vp.CustomForce):
                rest += own.f(q, v)
            elif not isinstance(own, vp.Armature):
                raise NotImplementedError(own)
        return V, pull, rest + drive

    def _stop(self, own: vp.JointStop, q: np.ndarray, v: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        k, d = self.per_joint(own.stiffness, 0.0), self.per_joint(own.damping, 0.0)
        w, limits = self.per_joint(own.width, 1.0), self.scene.robot.position_limits
        lower = limits[0] if own.lower is None else self.per_joint(own.lower, -np.inf)
        upper = limits[1] if own.upper is None else self.per_joint(own.upper, np.inf)
        V, pull, drag = 0.0, np.zeros(self.n), np.zeros(self.n)
        for depth, side in ((q - upper, -1.0), (lower - q, 1.0)):
            x = np.maximum(depth, 0.0)
            y = np.minimum(x / w, 1.0)
            # Integrals of the share 3 y^2 - 2 y^3 over the depth, once and twice.
            first = w * (y**3 - y**4 / 2.0) + np.maximum(x - w, 0.0)
            second = w**2 * (y**4 / 4.0 - y**5 / 10.0) + np.maximum(x - w, 0.0) * x / 2.0
            V, pull, drag = V + float(k @ second), pull + side * k * first, drag - d * (3.0 * y**2 - 2.0 * y**3) * v
        return V, pull, drag

    def _frame_force(self, own: vp.Force, v: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        none = np.zeros(self.n)
        if isinstance(own, vp.FrameWrench):
            x, R, J, _ = self.point(own.frame)
            f, m = np.split(np.asarray(own.wrench, float), 2)
            if own.axes == "frame":
                return 0.0, none, J[:3].T @ (R @ f) + J[3:].T @ (R @ m)
            return -float(f @ x), J[:3].T @ f, J[3:].T @ m
        (x, R, J, _), (y, S, K, _) = self.point(own.a), self.point(own.b)
        d, J = x - y, J - K
        if isinstance(own, vp.FrameDamper):
            turning = 0.0 if own.rotational_damping is None else own.rotational_damping
            return 0.0, none, -J[:3].T @ (own.damping * (J[:3] @ v)) - J[3:].T @ (turning * (J[3:] @ v))
        k, rest = np.asarray(own.stiffness, float), np.asarray(own.rest, float)
        if rest.ndim == 0 and rest > 0.0:
            length = np.linalg.norm(d)
            V, pull = 0.5 * k * (length - rest) ** 2, -J[:3].T @ (k * (length - rest) * d / length)
        else:
            V, pull = 0.5 * np.sum(k * (d - rest) ** 2), -J[:3].T @ (k * (d - rest))
        if own.rotational_stiffness is not None:
            about = np.broadcast_to(own.rotational_stiffness, (3,))
            T = S if own.rest_rotation is None else S @ own.rest_rotation
            g = 0.5 * about.sum() - about
            V += float(g @ (1.0 - np.sum(R * T, axis=0)))
            pull += J[3:].T @ (np.cross(R.T, T.T).T @ g)
        return float(V), pull, none

    def rows(self, t: float, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of the constraints: C (m, n), the right sides of C v = b and C a = c."""
        C, b, c = [np.zeros((0, self.n))], [np.zeros(0)], [np.zeros(0)]

        def add(row: np.ndarray, rate: np.ndarray, second: np.ndarray) -> None:
            for parts, part in zip((C, b, c), (np.atleast_2d(row), np.atleast_1d(rate), second), strict=True):
                parts.append(np.atleast_1d(part) if part.ndim < 2 else part)

        self.place(q, v)
        moved = 0
        for own in self.scene.constraints:
            if isinstance(own, vp.KinematicInput):
                _, rate, second = self.path(t)
                add(np.eye(self.n)[self.names.index(own.joint)], rate[moved], second[moved])
                moved += 1
                continue
            if isinstance(own, vp.JointTie):
                p = np.polynomial.Polynomial(own.coefficients)
                i, j = self.names.index(own.joint), self.names.index(own.leader)
                row = np.eye(self.n)[i] - p.deriv()(q[j]) * np.eye(self.n)[j]
                add(row, np.zeros(1), np.atleast_1d(p.deriv(2)(q[j]) * v[j] ** 2))
                continue
            (x, _, J, a), (y, _, K, e) = self.point(own.a), self.point(own.b)
            d, J, a = x - y, J - K, a - e
            if isinstance(own, vp.FrameOnFrame):
                # Both ends turn alike, and a keeps its place on b: d turns with b.
                w = K[3:] @ v
                J[:3] += pin.skew(d) @ K[3:]
                a[:3] += np.cross(d, e[3:]) - np.cross(w, np.cross(w, d))
                add(J, np.zeros(6), -a)
            elif isinstance(own, vp.Distance):
                add(d @ J[:3], np.zeros(1), -np.atleast_1d(d @ a[:3] + (J[:3] @ v) @ (J[:3] @ v)))
            else:
                N = normals(own)
                add(N @ J[:3], np.zeros(len(N)), -N @ a[:3])
        return np.concatenate(C), np.concatenate(b), np.concatenate(c)

    def tangent(self, q: np.ndarray, v: np.ndarray, t: float = 0.0) -> np.ndarray:
        """The velocity nearest to ``v`` in kinetic energy that the constraints allow."""
        C, b, _ = self.rows(t, q, v)
        root = np.linalg.inv(np.linalg.cholesky(self.mass_matrix(q)))
        return v - root.T @ np.linalg.pinv(C @ root.T, rcond=1e-9) @ (C @ v - b)

    def acceleration(self, t: float, q: np.ndarray, v: np.ndarray, F: np.ndarray) -> np.ndarray:
        """(n,) under generalized forces F beside gravity."""
        at, rate = self.positions(q), self.G @ v
        if len(self.G) == self.n and not self.rotor.any() and not self.scene.constraints:
            return self.G.T @ pin.aba(self.model, self.data, at, rate, self.G @ F)
        free = F - self.G.T @ pin.nonLinearEffects(self.model, self.data, at, rate)
        M = self.mass_matrix(q)
        if not self.scene.constraints:
            return np.linalg.solve(M, free)
        C, _, c = self.rows(t, q, v)
        root = np.linalg.inv(np.linalg.cholesky(M))
        B, a = C @ root.T, root @ free
        return root.T @ (a - np.linalg.pinv(B, rcond=1e-9) @ (B @ a - c))

    def energy(self, q: np.ndarray, v: np.ndarray) -> float:
        """Kinetic and potential energy, springs and loads included [J]."""
        weight = pin.computePotentialEnergy(self.model, self.data, self.positions(q))
        return 0.5 * float(v @ self.mass_matrix(q) @ v) + weight + self.forces(q, v, np.zeros(self.n))[0]


def assert_jet(scene: vp.Scene, q: np.ndarray, v: np.ndarray, backend: str) -> None:
    """The Lagrangian and its derivatives against Pinocchio's energies, along a direction by differences."""
    own, dq = Mechanism(scene), np.random.default_rng(4).uniform(-1.0, 1.0, q.size)
    jet, M = vp.lagrangian_jet(scene, q, v, backend=backend), own.mass_matrix(q)

    def L(q: np.ndarray) -> float:
        return v @ own.mass_matrix(q) @ v - own.energy(q, v)

    size = np.abs(jet.Lq).max() + np.abs(jet.Lqq).max() + abs(jet.L)
    assert abs(jet.L - L(q)) < 1e-12 * size
    np.testing.assert_allclose(jet.Lvv, M, rtol=0, atol=1e-12 * np.abs(M).max())
    np.testing.assert_allclose(jet.Lv, M @ v, rtol=0, atol=1e-12 * np.abs(jet.Lv).max())
    assert abs(jet.Lq @ dq - slope(L, q, dq, 0.02)) < 1e-10 * size
    in_q = slope(lambda x: vp.lagrangian_jet(scene, x, v, backend=backend).Lq, q, dq, 0.02)
    np.testing.assert_allclose(jet.Lqq @ dq, in_q, rtol=0, atol=1e-9 * size)
    in_q = slope(lambda x: own.mass_matrix(x) @ v, q, dq, 0.02)
    np.testing.assert_allclose(jet.Lvq @ dq, in_q, rtol=0, atol=1e-9 * size)


def assert_same_jet(
    one: vp.LagrangianJet, other: vp.LagrangianJet, keep: object = slice(None), rtol: float = 1e-12
) -> None:
    """Jet ``one`` is ``other`` on the coordinates ``keep`` of that, relative to its largest entries."""
    for name in ("Lq", "Lv", "Lqq", "Lvq", "Lvv"):
        whole = getattr(other, name)
        part = whole[keep] if whole.ndim == 1 else whole[keep][:, keep]
        np.testing.assert_allclose(getattr(one, name), part, rtol=0, atol=rtol * np.abs(whole).max(), err_msg=name)


def off_constraints(scene: vp.Scene, motion: vp.Trajectory) -> tuple[float, float]:
    """By how much a motion misses its constraints: the largest residual, and its largest rate."""
    g, _, C = scene.core.constraints(motion.q)
    return float(np.abs(g).max()), float(np.abs(np.einsum("kmn,kn->km", C, motion.v)).max())


def same(one: object, other: object) -> bool:
    """Whether two records are the same to the last bit."""
    if dataclasses.is_dataclass(one):
        names = [own.name for own in dataclasses.fields(one)]
        return one is other or all(same(getattr(one, name), getattr(other, name)) for name in names)
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
    if hasattr(one, "keys"):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, tuple | list):
        return len(one) == len(other) and all(map(same, one, other))
    return one == other or (one != one and other != other)  # noqa: PLR0124 - NaN


def normals(own: vp.Constraint) -> np.ndarray:
    """Directions (k, 3) along which two points of a constraint coincide."""
    if isinstance(own, vp.PointOnPoint):
        return np.eye(3)[["xyz".index(axis) for axis in own.axes]]
    if isinstance(own, vp.PointOnPlane):
        return np.atleast_2d(np.asarray(own.normal, float) / np.linalg.norm(own.normal))
    along = np.asarray(own.direction, float) / np.linalg.norm(own.direction)
    return np.linalg.svd(along[None])[2][1:]


def saturated(wanted: np.ndarray, most: np.ndarray) -> np.ndarray:
    """A drive's force: as wanted up to 0.9 of the limit, bent smoothly to the limit at 1.1."""
    y = np.abs(wanted) / most
    bent = np.where(y < 1.1, y - 2.5 * np.maximum(y - 0.9, 0.0) ** 2, 1.0)
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(most), np.sign(wanted) * most * bent, wanted)


def exact(
    scene: vp.Scene,
    q0: np.ndarray,
    v0: np.ndarray,
    times: Sequence[float],
    signal: Callable[[int, np.ndarray, np.ndarray], Force] | None = None,
    *,
    path: Path | None = None,
    stiff: bool = False,
    rtol: float | None = None,
) -> Motion:
    """The continuous motion at ``times``, by DOP853 to 1e-12 or, stiff, by SciPy's Radau to 1e-11.

    Between times k and k + 1 the controls are the function of time that ``signal(k, q, v)`` returns at the state of
    time k: rows, laws and policies are constant over an interval, open loops are not. None holds servos at ``q0``.
    """
    own, n = Mechanism(scene, path), scene.robot.dof
    x = np.concatenate([q0, v0, [0.0]])
    rows = [x]
    for k, (begin, end) in enumerate(itertools.pairwise(times)):
        force = None if signal is None else signal(k, x[:n], x[n : 2 * n])
        resting = np.zeros(n)
        if force is None:
            for each in scene.forces:
                if isinstance(each, vp.PositionServo):
                    resting += own.per_joint(each.stiffness, 0.0) * q0

        def rate(t: float, y: np.ndarray, force=force, resting=resting) -> np.ndarray:
            q, v = y[:n], y[n : 2 * n]
            _, pull, rest = own.forces(q, v, resting if force is None else scene.actuation @ force(t))
            return np.concatenate([v, own.acceleration(t, q, v, pull + rest), [v @ rest]])

        method, usual = ("Radau", 1e-11) if stiff else ("DOP853", 1e-12)
        share = rtol or usual
        x = solve_ivp(rate, (begin, end), x, method, rtol=share, atol=1e-3 * share).y[:, -1]
        rows.append(x)
    y = np.array(rows)
    q, v = y[:, :n], y[:, n : 2 * n]
    return Motion(q, v, np.array([own.energy(*state) for state in zip(q, v, strict=True)]), y[:, -1])


# --- plans: rows of constraints by NumPy and Pinocchio, and what holds at an optimum ----------------------------------


def rollout(problem: vp.OptimalControlProblem, controls: np.ndarray) -> vp.Trajectory:
    """The motion of a plan's decisions (R, m), without noise."""
    held = np.repeat(controls, problem.hold, axis=0)
    given = lines(problem, controls) if problem.controls == "linear" else held
    grid = {"dt": problem.dt, "steps": problem.steps, "integrator": problem.integrator}
    still = {"increments": 0} if problem.scene.processes else {}
    return vp.simulate(problem.scene, problem.q0, problem.v0, controls=given, check=False, **grid, **still)


def lines(problem: vp.OptimalControlProblem, controls: np.ndarray) -> vp.LinearPolicy:
    """Controls (N + 1, m) at nodes, linear between them."""
    (N, m), x = (len(controls) - 1, controls.shape[1]), 2 * problem.scene.robot.dof
    on = "momentum" if problem.integrator.variational else "velocity"
    return vp.LinearPolicy(
        controls[1:], np.zeros((N, m, x)), np.zeros((N, x)), on=on, before=controls[0], linear=True,
        previous_gains=np.zeros((N, m, m)), previous=np.zeros((N, m)), period=problem.dt,
    )  # fmt: skip


def plan_rows(
    problem: vp.OptimalControlProblem, motion: vp.Trajectory, controls: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rows c <= 0 and rows c = 0 of a problem's constraints at a motion's nodes, all but the first."""
    robot, q, v = problem.scene.robot, motion.q[1:], motion.v[1:]
    t = problem.t0 + motion.t[1:] - motion.t[0]
    below, zero = [np.zeros(0)], [np.zeros(0)]
    for own in problem.constraints:
        match own:
            case vp.WithinJointLimits() | vp.WithinVelocityLimits():
                low, high = own.limits
                y = q if isinstance(own, vp.WithinJointLimits) else v
                below += [y - high, low - y]
            case vp.WithinControlRate():
                first = controls[:1] if own.before is None else np.broadcast_to(own.before, controls[:1].shape)
                below.append(np.abs(np.diff(controls, axis=0, prepend=first)) / (problem.dt * problem.hold) - own.limit)
            case vp.ReachFrame():
                (place,) = placements(robot, q[-1:], own.frame)
                zero += [] if own.position is None else [place.translation - own.position]
                zero += [] if own.rotation is None else [pin.log3(own.rotation.T @ place.rotation)]
            case vp.KeepInHalfSpace():
                below.append(own.offset - robot.frame_positions(q, own.frame) @ own.normal)
            case vp.KeepInBox():
                x = robot.frame_positions(q, own.frame)
                below += [x - own.limits[1], own.limits[0] - x]
            case vp.KeepInSphere() | vp.KeepOutOfSphere():
                center = np.array([own.center(s) for s in t]) if callable(own.center) else own.center
                far = np.linalg.norm(robot.frame_positions(q, own.frame) - center, axis=1) - own.radius
                below.append(far if isinstance(own, vp.KeepInSphere) else -far)
            case vp.KeepClear():
                below.append(np.array([own.distance - gap for gap in clearances(own, q, t)]))
            case _:
                raise TypeError(f"no rows for {own!r}")
    flat = [np.concatenate([np.ravel(part) for part in parts]) for parts in (below, zero)]
    return flat[0][np.isfinite(flat[0])], flat[1]


def placements(robot: vp.Robot, q: np.ndarray, frame: str) -> list[pin.SE3]:
    """The placement of a frame at configurations (K, n)."""
    data, found = robot.model.createData(), []
    for one in q:
        pin.framesForwardKinematics(robot.model, data, robot.configuration(one))
        found.append(data.oMf[robot.model.getFrameId(frame)].copy())
    return found


def clearances(own: vp.KeepClear, q: np.ndarray, t: np.ndarray) -> np.ndarray:
    """The least distance between capsules of links and balls at configurations (K, n) at times (K,)."""
    gaps = []
    for link, (begin, end, radius) in own.capsules.items():
        for k, place in enumerate(placements(own.robot, q, link)):
            a, b = (place.act(np.asarray(point, float)) for point in (begin, end))
            for ball in own.obstacles:
                assert len(ball.points) == 1
                at = ball.position + (0.0 if ball.shift is None else np.array(ball.shift(t[k])))
                share = np.clip((at - a) @ (b - a) / max((b - a) @ (b - a), 1e-300), 0.0, 1.0)
                gaps.append((k, np.linalg.norm(a + share * (b - a) - at) - radius - ball.radius))
    return np.array([min(gap for at, gap in gaps if at == k) for k in range(len(q))])


def violation(problem: vp.OptimalControlProblem, motion: vp.Trajectory, controls: np.ndarray) -> float:
    """The largest violation of constraints and control limits by a motion's nodes."""
    below, zero = plan_rows(problem, motion, controls)
    beyond = np.maximum(controls - problem.control_limits[1], problem.control_limits[0] - controls)
    return max(0.0, *(float(part.max(initial=0.0)) for part in (below, np.abs(zero), beyond)))


def given(problem: vp.OptimalControlProblem) -> list[int]:
    """Which of the first controls the start gives: on lines the positions of inputs, and the rates of cubic ones."""
    inputs = [own for own in problem.scene.constraints if isinstance(own, vp.KinematicInput)]
    joints = list(problem.scene.robot.joint_names)
    first = [*(joints.index(own.joint) for own in inputs), *range(len(joints), problem.scene.controls)]
    return first if problem.controls == "linear" else []


def kkt(plan: vp.Solution, near: float = 1e-5) -> float:
    """What is left of the Lagrangian's gradient in the controls; 1 is the cost's gradient at controls a tenth smaller.

    By central differences of motions. Multipliers are those of the least squares, of any sign for rows c = 0, not
    negative for rows c <= 0 and control limits within ``near`` of being met, and 0 for all others.
    """
    problem, u = plan.problem, plan.controls

    def values(w: np.ndarray) -> np.ndarray:
        motion = rollout(problem, w)
        below, zero = plan_rows(problem, motion, w)
        return np.concatenate([[problem.cost_of(motion)], below, zero])

    def slopes(at: np.ndarray) -> np.ndarray:
        sizes = 1e-5 * np.maximum(np.abs(at).max(axis=0), 1e-2 * np.abs(at).max())
        ways = [np.where(np.arange(at.size) == i, 1.0, 0.0).reshape(at.shape) * sizes for i in range(at.size)]
        return np.array([(values(at + way) - values(at - way)) / (2.0 * way.max()) for way in ways]).T

    below, _ = plan_rows(problem, plan.trajectory, u)
    found, (low, high) = slopes(u), problem.control_limits
    found[:, given(problem)] = 0.0
    met = np.concatenate([below > -near, np.ones(len(found) - 1 - len(below), dtype=bool)])
    free = np.concatenate([np.zeros(len(below), dtype=bool), np.ones(len(found) - 1 - len(below), dtype=bool)])[met]
    ends = np.concatenate([np.eye(u.size)[(u >= high - near).ravel()], -np.eye(u.size)[(u <= low + near).ravel()]])
    rows = np.concatenate([found[1:][met], ends])
    least = np.where(np.concatenate([free, np.zeros(len(ends), dtype=bool)]), -np.inf, 0.0)
    scale = np.abs(slopes(0.9 * u)[0]).max()
    if not len(rows):
        return float(np.abs(found[0]).max() / scale)
    # Rows that no control moves, as that of a goal off the plane of a chain, are left out.
    size = np.maximum(np.linalg.norm(rows, axis=1), 1e-12)
    y = lsq_linear((rows / size[:, None]).T, -found[0], (least, np.full(len(rows), np.inf)), tol=1e-14).x
    return float(np.abs(found[0] + y @ (rows / size[:, None])).max() / scale)


def least_cost(problem: vp.OptimalControlProblem, start: np.ndarray) -> float:
    """The least cost that SciPy's SLSQP finds within a problem's limits and constraints from controls (R, m)."""
    known: dict[bytes, tuple[float, np.ndarray, np.ndarray]] = {}

    def parts(x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        if x.tobytes() not in known:
            w = x.reshape(start.shape)
            motion = rollout(problem, w)
            known[x.tobytes()] = (problem.cost_of(motion), *plan_rows(problem, motion, w))
        return known[x.tobytes()]

    first = start.ravel()
    # Rows that no control moves, as that of a goal off the plane of a chain, make equations singular.
    moved = np.abs(parts(first)[2] - parts(1.01 * first + 0.01)[2]) > 1e-12
    rules = [
        {"type": "ineq", "fun": lambda x: -parts(x)[1]},
        {"type": "eq", "fun": lambda x: parts(x)[2][moved]},
    ]
    sides = [np.broadcast_to(side, start.shape).ravel() for side in problem.control_limits]
    found = minimize(
        lambda x: parts(x)[0], first, method="SLSQP", bounds=Bounds(*sides),
        constraints=rules if problem.constraints else (), options={"maxiter": 200, "ftol": 1e-8 * parts(first)[0]},
    )  # fmt: skip
    assert found.success, found.message
    return float(found.fun)
