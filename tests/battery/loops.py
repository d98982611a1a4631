"""Closed loops at their extremes, and their motion by index-reduced equations written on Pinocchio's own calls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin
from mechanisms import crank_and_slider
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

import varpin as vp
from varpin.model.chain import rod_chain

Floats = NDArray[np.float64]
_WORLD = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


@dataclass(frozen=True)
class Closure:
    """What a loop keeps, as Pinocchio sees it: rows of dg/dt, and of d2g/dt2 without accelerations.

    Attributes:
        kind: "point", "weld", "distance", "plane" or "tie".
        a: A frame's name; of a tie the index of its joint.
        b: Another, or a place in the world; of a tie the index of its leader.
        rows: Of a point: the axes of the world, (k, 3); of a plane: its normal in the world, (1, 3).
        coefficients: Of a tie.
    """

    kind: str
    a: str | int
    b: str | int | tuple[float, ...]
    rows: Floats = field(default_factory=lambda: np.eye(3))
    coefficients: tuple[float, ...] = ()


class Dynamics:
    """The equations M a = tau(t, q, v) - bias + C' y, C a = -dC/dt v on Pinocchio's calls alone."""

    def __init__(
        self,
        model: pin.Model,
        closures: tuple[Closure, ...],
        gravity: Floats,
        torque: Callable[[float, Floats, Floats], Floats],
    ) -> None:
        self.model, self.closures, self.torque = model.copy(), closures, torque
        self.model.gravity.linear = gravity
        self.data = self.model.createData()

    def _of_frame(self, name: str) -> tuple[Floats, Floats, Floats]:
        """Place (3,), Jacobian (6, n) and acceleration without that of joints (6,), linear first, world's axes."""
        f = self.model.getFrameId(name)
        J = pin.getFrameJacobian(self.model, self.data, f, _WORLD)
        a = pin.getFrameClassicalAcceleration(self.model, self.data, f, _WORLD)
        return self.data.oMf[f].translation.copy(), J, a.vector.copy()

    def rows(self, q: Floats, v: Floats) -> tuple[Floats, Floats]:
        """C (m, n) and dC/dt v (m,)."""
        model, data, n = self.model, self.data, self.model.nv
        pin.computeJointJacobians(model, data, q)
        pin.forwardKinematics(model, data, q, v, np.zeros(n))
        pin.updateFramePlacements(model, data)
        C: list[Floats] = []
        bent: list[Floats] = []
        for own in self.closures:
            if own.kind == "tie":
                joint, leader = int(own.a), int(own.b)  # type: ignore[arg-type]
                p = np.polynomial.Polynomial(own.coefficients)
                row = np.zeros(n)
                row[joint] += 1.0
                row[leader] -= p.deriv()(q[leader])
                C.append(row[None])
                bent.append(np.array([-p.deriv(2)(q[leader]) * v[leader] ** 2]))
                continue
            x, J, a = self._of_frame(str(own.a))
            if isinstance(own.b, str):
                y, K, b = self._of_frame(own.b)
            else:
                y, K, b = np.array(own.b), np.zeros((6, n)), np.zeros(6)
            d, J, a = x - y, J - K, a - b
            if own.kind == "weld":
                # Both ends turn alike, and a's origin keeps its place on b: r = x_a - x_b turns with b.
                turn = pin.skew(d)
                w = K[3:] @ v
                C += [J[:3] + turn @ K[3:], J[3:]]
                bent += [a[:3] + turn @ b[3:] - np.cross(w, np.cross(w, d)), a[3:]]
            elif own.kind == "distance":
                rate = J[:3] @ v
                C.append((d @ J[:3])[None])
                bent.append(np.array([d @ a[:3] + rate @ rate]))
            else:
                C.append(own.rows @ J[:3])
                bent.append(own.rows @ a[:3])
        return np.concatenate(C), np.concatenate(bent)

    def acceleration(self, t: float, q: Floats, v: Floats) -> Floats:
        """The accelerations (n,)."""
        M = pin.crba(self.model, self.data, q).copy()
        M = np.triu(M) + np.triu(M, 1).T
        force = self.torque(t, q, v) - pin.nonLinearEffects(self.model, self.data, q, v).copy()
        C, bent = self.rows(q, v)
        root = np.linalg.inv(np.linalg.cholesky(M))
        B, free = C @ root.T, root @ force
        scale = np.linalg.norm(B, axis=1)
        B, bent = B[scale > 0.0] / scale[scale > 0.0, None], bent[scale > 0.0] / scale[scale > 0.0]
        pull = np.linalg.pinv(B, rcond=1e-9) @ (B @ free + bent)
        a: Floats = root.T @ (free - pull)
        return a

    def motion(self, q: Floats, v: Floats, times: Floats, *, stiff: bool = False) -> tuple[Floats, Floats]:
        """(q, v) at times, (N, n) each, by DOP853, or by Radau where forces are stiff."""
        n = q.size

        def rate(t: float, x: Floats) -> Floats:
            return np.append(x[n:], self.acceleration(t, x[:n], x[n:]))

        found = solve_ivp(
            rate,
            (0.0, float(times[-1])),
            np.append(q, v),
            method="Radau" if stiff else "DOP853",
            rtol=1e-9 if stiff else 1e-12,
            atol=1e-11 if stiff else 1e-12,
            t_eval=times,
        )
        if not found.success:
            raise ArithmeticError(found.message)
        return found.y[:n].T, found.y[n:].T


@dataclass(frozen=True, eq=False)
class Loop:
    """A closed loop, a state near it, and what acts on it.

    Attributes:
        name: Unique.
        scene: With its constraints and forces.
        start: Where the assembly begins (n,) [rad or m].
        push: A velocity (n,), of which the part along the constraints counts [rad/s or m/s].
        closures: The constraints again, for the reference.
        torque: What acts on joints at (t, q, v) besides gravity (n,), for the reference [N m or N].
        controls: What the scene is given.
        duration: [s].
        stiff: Whether the reference is to be implicit.
    """

    name: str
    scene: vp.Scene
    start: Floats
    push: Floats
    closures: tuple[Closure, ...]
    torque: Callable[[float, Floats, Floats], Floats]
    controls: Callable[[float], Floats] | None = None
    duration: float = 0.3
    stiff: bool = False

    def dynamics(self) -> Dynamics:
        """The reference."""
        return Dynamics(self.scene.robot.model, self.closures, self.scene.gravity, self.torque)


def still(n: int) -> Callable[[float, Floats, Floats], Floats]:
    """No torque on n joints."""
    return lambda t, q, v: np.zeros(n)


PLANE = np.eye(3)[[0, 2]]


def _arm(links: int, length: float = 1.0, mass: float = 1.0) -> vp.Robot:
    return vp.planar_chain(links, length=length, mass=mass)


def _loop(
    name: str,
    robot: vp.Robot,
    constraints: object,
    closures: tuple[Closure, ...],
    start: object,
    push: object = 1.0,
    forces: tuple[vp.Force, ...] = (),
    torque: Callable[[float, Floats, Floats], Floats] | None = None,
    controls: Callable[[float], Floats] | None = None,
    actuation: object = None,
    **options: object,
) -> Loop:
    n = robot.dof
    scene = vp.Scene(robot, constraints=constraints, forces=list(forces), actuation=actuation, damping=0.0)  # type: ignore[arg-type]
    first = np.broadcast_to(np.asarray(push, dtype=float), (n,)).copy()
    acts = still(n) if torque is None else torque
    return Loop(name, scene, np.asarray(start, dtype=float), first, closures, acts, controls, **options)  # type: ignore[arg-type]


def _closed(links: int, place: tuple[float, float, float], **options: object) -> Loop:
    """A planar chain whose tip is held."""
    name = str(options.pop("name"))
    robot = options.pop("robot", None) or _arm(links)
    closure = (Closure("point", "tip", place, PLANE),)
    return _loop(name, robot, vp.PointOnPoint("tip", place, axes="xz"), closure, **options)  # type: ignore[arg-type]


FOUR = {"links": 3, "place": (1.3, 0.0, 0.2), "start": [-1.5, 1.5, 1.5]}
FIVE = {"links": 4, "place": (1.6, 0.0, 0.3), "start": [-1.0, 1.0, 1.0, 1.0]}


def _facing() -> vp.Robot:
    """Two UR5 that look at each other."""
    facing = [[-1, 0, 0, 1.0], [0, -1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    beam = vp.Payload("tool0", mass=3.0, center=[0.0, 0.0, 0.25], inertia=[0.0625, 0.0625, 1e-3])
    left, right = vp.load_robot("ur5", payload=beam), vp.load_robot("ur5")
    return vp.combine(left, right, placements=[None, facing], prefixes=["left_", "right_"])


def two_arms(**options: object) -> Loop:
    """Two UR5 that hold a beam."""
    grip = [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.5], [0, 0, 0, 1]]
    return _loop(
        str(options.pop("name", "two arms hold a beam")),
        _facing(),
        vp.FrameOnFrame("right_tool0", "left_tool0", grip),
        (Closure("weld", "right_tool0", "left_tool0"),),
        [-0.35, -1.3, 1.9, -0.6, 1.2, 0.0] * 2,
        0.3,
        **options,  # type: ignore[arg-type]
    )


def delta(place: float = 0.25) -> vp.Robot:
    """Three legs of a crank about an axis across the base and a rod on a universal joint, as of a delta robot."""
    model = pin.Model()
    model.name = "delta"
    for k in range(3):
        turn = pin.utils.rotate("z", 2.0 * np.pi * k / 3.0)
        joint = model.addJoint(0, pin.JointModelRY(), pin.SE3(turn, turn @ np.array([0.2, 0.0, 0.0])), f"crank{k}")
        model.appendBodyToJoint(joint, pin.Inertia(0.5, np.array([0.1, 0, 0]), 1e-3 * np.eye(3)), pin.SE3.Identity())
        at = pin.SE3(np.eye(3), np.array([0.2, 0.0, 0.0]))
        joint = model.addJoint(joint, pin.JointModelRY(), at, f"lift{k}")
        model.appendBodyToJoint(joint, pin.Inertia(0.01, np.zeros(3), 1e-5 * np.eye(3)), pin.SE3.Identity())
        joint = model.addJoint(joint, pin.JointModelRZ(), pin.SE3.Identity(), f"swing{k}")
        rod = pin.Inertia(0.2, np.array([0.25, 0.0, 0.0]), np.diag([1e-5, 4e-3, 4e-3]))
        model.appendBodyToJoint(joint, rod, pin.SE3.Identity())
        end = pin.SE3(np.eye(3), np.array([0.5, 0.0, 0.0]))
        model.addFrame(pin.Frame(f"end{k}", joint, 0, end, pin.FrameType.OP_FRAME))
    return vp.load_robot(model)


def _weighted(heavy: float, light: float) -> vp.Robot:
    return rod_chain([1.0, 1.0, 1.0], [heavy, light, heavy])


def _sway(n: int) -> Callable[[float], Floats]:
    return lambda t: 2.0 * np.sin(7.0 * t + np.arange(n))


def _springs(n: int, k: float, d: float, rest: object) -> Callable[[float, Floats, Floats], Floats]:
    at = np.asarray(rest, dtype=float)
    return lambda t, q, v: -k * (q - at) - d * v


def _rubs(level: float, width: float) -> Callable[[float, Floats, Floats], Floats]:
    return lambda t, q, v: -level * np.tanh(v / width)


def _cases() -> list[Callable[[], Loop]]:
    three = np.array([1.0, 0.0, 0.0])
    rest = [-1.4, 1.4, 1.6]
    square = (1.0, 0.0, 0.0)
    made: list[Callable[[], Loop]] = [  # built when asked for: robots from files take a while
        lambda: _closed(**FOUR, name="four-bar", push=three),
        lambda: _closed(**FIVE, name="five-bar"),
        lambda: _closed(**FOUR, name="four-bar, swift", push=10.0 * three),
        lambda: _closed(3, (1.0, 0.0, 0.0), name="parallelogram", start=[-1.2, 1.2, 1.2], push=three),
        lambda: _closed(3, square, name="parallelogram next to flat", start=[-0.05, 0.05, 0.05], push=-three),
        lambda: _closed(3, (2.9, 0.0, 0.0), name="nearly stretched", start=[-0.3, 0.3, 0.2], push=three),
        lambda: _closed(3, (2.999, 0.0, 0.0), name="all but stretched", start=[-0.03, 0.03, 0.02], push=three),
        lambda: _loop(
            "slider-crank",
            crank_and_slider(),
            vp.PointOnPoint("tip", "pin", axes="xz"),
            (Closure("point", "tip", "pin", PLANE),),
            [0.7, -0.9, 1.2],
            5.0,
        ),
        lambda: _loop(
            "planar loop with three rows",
            _arm(3),
            vp.PointOnPoint("tip", (1.3, 0.0, 0.2)),
            (Closure("point", "tip", (1.3, 0.0, 0.2)),),
            [-1.5, 1.5, 1.5],
            three,
        ),
        lambda: _loop(
            "closed twice",
            _arm(3),
            [vp.PointOnPoint("tip", (1.3, 0.0, 0.2), axes="xz"), vp.PointOnPoint("tip", (1.3, 0.0, 0.2), axes="zx")],
            (Closure("point", "tip", (1.3, 0.0, 0.2), PLANE),),
            [-1.5, 1.5, 1.5],
            three,
        ),
        lambda: _loop(
            "rod on a tip",
            _arm(3),
            vp.Distance("tip", (0.5, 0.0, 0.5), 1.2),
            (Closure("distance", "tip", (0.5, 0.0, 0.5)),),
            [-1.0, 0.6, 0.5],
        ),
        lambda: _loop(
            "cam",
            _arm(3),
            vp.JointTie("joint3", "joint1", (0.1, 0.5, -0.3, 0.2)),
            (Closure("tie", 2, 0, coefficients=(0.1, 0.5, -0.3, 0.2)),),
            [-1.0, 0.6, 0.5],
        ),
        lambda: _loop(
            "delta",
            delta(),
            [vp.PointOnPoint("end0", "end1"), vp.PointOnPoint("end0", "end2")],
            (Closure("point", "end0", "end1"), Closure("point", "end0", "end2")),
            [0.3, 1.4, 0.0] * 3,
        ),
        two_arms,
        lambda: _loop(
            "panda on a plane",
            vp.load_robot("panda", lock={"panda_finger_joint1": 0.0}),
            vp.PointOnPlane("panda_hand", (0.0, 0.0, 0.4), (0.0, 0.0, 1.0)),
            (Closure("plane", "panda_hand", (0.0, 0.0, 0.4), np.eye(3)[[2]]),),
            [0.0, -0.5, 0.0, -2.3, 0.0, 1.8, 0.8],
            0.2,
        ),
        lambda: _closed(
            **FOUR, name="driven four-bar", push=three, controls=_sway(3), torque=lambda t, q, v: _sway(3)(t)
        ),
    ]
    for k, d in ((1e2, 1.0), (1e4, 1e2), (0.0, 1e2), (0.0, 1e4)):
        made.append(
            lambda k=k, d=d: _closed(  # type: ignore[misc]
                **FOUR,
                name=f"four-bar, springs {k:g}, dampers {d:g}",
                push=three,
                forces=(vp.JointSpring(k, rest), vp.JointDamper(d)),
                torque=_springs(3, k, d, rest),
                stiff=True,
            )
        )
    for heavy, light in ((1e4, 1e4), (1e-6, 1e-6), (1e4, 1e-6), (1e-6, 1e4), (1.0, 1e-6), (1.0, 1e4)):
        made.append(
            lambda heavy=heavy, light=light: _closed(  # type: ignore[misc]
                **FOUR, name=f"links of {heavy:g} and {light:g} kg", push=three, robot=_weighted(heavy, light)
            )
        )
    made += [
        lambda: _closed(
            **FOUR,
            name="four-bar, friction",
            push=three,
            forces=(vp.CoulombFriction(1.0, 0.1),),
            torque=_rubs(1.0, 0.1),
            stiff=True,
        ),
        lambda: _closed(
            **FOUR,
            name="four-bar, servo",
            push=three,
            forces=(vp.PositionServo({"joint1": 2e3}, {"joint1": 50.0}),),
            actuation=["joint1"],
            controls=lambda t: np.array([-1.4 + 0.3 * np.sin(5.0 * t)]),
            torque=lambda t, q, v: np.array([2e3 * (-1.4 + 0.3 * np.sin(5.0 * t) - q[0]) - 50.0 * v[0], 0.0, 0.0]),
        ),
        lambda: two_arms(
            name="two arms, damped and driven",
            forces=(vp.JointDamper(2.0),),
            torque=lambda t, q, v: 10.0 * _sway(12)(t) - 2.0 * v,
            controls=lambda t: 10.0 * _sway(12)(t),
        ),
    ]
    return made


LOOPS: tuple[Callable[[], Loop], ...] = tuple(_cases())
# Those whose reference is implicit.
STIFF = frozenset({16, 17, 18, 19})
