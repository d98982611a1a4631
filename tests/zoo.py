"""Named scenes for tests: chains, arms, hands, forces, loops, inputs and noise, each with a start and a suited step.

    case = zoo.ZOO["four-bar"]
    motion = vp.simulate(case.scene, case.q0, case.v0, dt=case.dt, steps=20)

Scenes are built with their first use, once. Groups of names, such as ``LOOPS``, are for parametrization.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from mechanisms import crank_and_slider, random_tree, rod_chain, slider
from oracles import Mechanism, Path

import varpin as vp


@dataclass(frozen=True, eq=False)
class Case:
    """A scene, a state to start from, and controls that suit it: waves of ``amp`` about ``base``, one number or (m,).

    ``q`` is one number, (n,), or a guess that a loop is assembled from [rad or m]; of ``v`` the part along the
    constraints counts [rad/s or m/s]. ``dt`` resolves the motion [s]. The oracle is implicit if it is ``stiff``.
    ``path`` has position, rate and acceleration of prescribed joints at a time.
    """

    name: str
    build: Callable[[], vp.Scene]
    q: object = 0.3
    v: object = 0.5
    dt: float = 0.02
    amp: object = 1.0
    base: object = 0.0
    stiff: bool = False
    path: Path | None = None

    @functools.cached_property
    def scene(self) -> vp.Scene:
        return self.build()

    @functools.cached_property
    def q0(self) -> np.ndarray:
        q = np.broadcast_to(np.asarray(self.q, float), (self.scene.robot.dof,)).copy()
        return vp.assemble(self.scene, q) if self.scene.constraints else q

    @functools.cached_property
    def v0(self) -> np.ndarray:
        v = np.broadcast_to(np.asarray(self.v, float), self.q0.shape).copy()
        return Mechanism(self.scene, self.path).tangent(self.q0, v) if self.scene.constraints else v

    @property
    def span(self) -> float:
        """Duration over which it is compared with the continuous motion [s]."""
        return 20 * self.dt

    def swing(self, t: float) -> np.ndarray:
        """Smooth controls (m,) at a time, as fast as the motion."""
        k = np.arange(self.scene.controls)
        return self.base + np.asarray(self.amp) * np.sin(2.0 * t / self.span + 0.7 * k + 0.4)


ZOO: dict[str, Case] = {}


def add(name: str, build: Callable[[], vp.Scene], *args: object, **options: object) -> None:
    ZOO[name] = Case(name, build, *args, **options)


def chain(links: int, **scene: object) -> Callable[[], vp.Scene]:
    """A planar chain of rods of 1 m and 1 kg."""
    return lambda: vp.Scene(vp.planar_chain(links), **{"damping": 0.0, **scene})


@functools.cache
def robot(name: str, **options: object) -> vp.Robot:
    return vp.load_robot(name, **options)


def arm(name: str, lock: str | None = None, **scene: object) -> Callable[[], vp.Scene]:
    """A robot by name, at most one joint locked, and without the damping of its file."""
    options = {"lock": {lock: 0.02}} if lock else {}
    made = robot if not options else vp.load_robot
    return lambda: vp.Scene(made(name, **options), **{"damping": 0.0, "friction": 0.0, **scene})


def tree(seed: int, bodies: int, **scene: object) -> Callable[[], vp.Scene]:
    """A branching tree of revolute, prismatic, continuous and oblique joints with armature."""
    return lambda: vp.Scene(vp.load_robot(random_tree(seed, bodies)), damping=0.0, **scene)


def drag(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Coupled, and no gradient."""
    return 0.8 * np.sin(np.roll(q, 1)) - 0.1 * v * np.sqrt(1.0 + v**2) + 0.2 * np.roll(v, -1) * q


THREE = {"q": (0.3, -0.4, 0.5), "v": (1.0, -0.5, 0.8)}
TURNED = pin.utils.rotate("z", 0.4) @ pin.utils.rotate("x", -0.7)

# --- free mechanisms -------------------------------------------------------------------------------------------------
add("pendulum", chain(1), 1.0, -0.4)
add("double pendulum", chain(2), (0.4, -0.7), (1.0, 0.5))
add("chain", chain(3), **THREE)
add("drifting chain", chain(3, gravity=False), **THREE)
add("tilted chain", chain(3, gravity=(1.5, 3.0, -8.0)), **THREE)
# A carriage on a rail along x that carries two rods.
add("cart", lambda: vp.Scene(rod_chain([0.6, 0.6], [0.5, 0.5], rail=2.0), damping=0.0, actuation=["rail"]),
    (0.2, 0.5, -0.3), (0.5, 1.0, -0.8))  # fmt: skip
add("mass on a spring", lambda: vp.Scene(slider(2.0), gravity=False, stiffness=30.0), 0.5, 1.0)
add("tree", tree(3, 7, actuation=np.cos(np.arange(35.0).reshape(7, 5))), 0.2, 0.8, 0.01)
add("finger", arm("finger"), (0.5, 0.3, 0.2), (4.0, -3.0, 2.0), 5e-3, 2e-5)
add("ur5", arm("ur5"), (0.3, -1.0, 0.8, 0.2, 0.4, 0.1), (1.0, 0.5, -0.4, 0.8, -0.5, 0.3), amp=(20, 20, 10, 1, 1, 0.1))
add("kinova", arm("kinova"), (0.4, 2.2, 2.0, 0.3, 0.8, -0.2), (0.5, -0.3, 0.4, -0.5, 0.6, 1.0), 4e-3, 0.3)
add("panda", arm("panda"), (0, -0.5, 0, -1.9, 0.2, 1.6, 0.7, 0.02), (0.5, 0.3, -0.4, 0.3, 0.5, -0.3, 0.4, 0.1), 0.01)
add("locked panda", arm("panda", "panda_finger_joint1"), (0, -0.5, 0, -1.9, 0.2, 1.6, 0.7), 0.4, 0.01)
add("z1", arm("z1"), (0.2, 1.2, -1.4, 0.3, 0.2, -0.3, -0.2), 0.4, 0.01, 0.05)
add("talos arm", arm("talos_arm"), (1.2, 0.2, -1.0, 0.3, 0.2, -0.3, -0.2), 0.4, 0.01, 0.1)
add("baxter", arm("baxter"), 0.3, 0.3 * np.cos(np.arange(17.0)), 5e-3, 0.1)
add("hand", arm("allegro_right_hand"), 0.4, 0.5 * np.cos(np.arange(16.0)), 5e-3, 5e-3)
# --- forces ----------------------------------------------------------------------------------------------------------
add("springs", chain(3, stiffness=(9.0, 5.0, 0.5), rest=0.2, forces=vp.JointSpring({"joint2": 4.0}, 0.7)), **THREE)
add("dampers", chain(3, damping=(0.8, 0.5, 0.3), forces=vp.JointDamper({"joint3": 0.4})), **THREE)
add("rotors", arm("ur5", forces=vp.Armature((0.5, 0.4, 0.3, 0.1, 0.1, 0.05)), damping=0.6), 0.3, 0.6, amp=3.0)
add("friction", chain(3, forces=vp.CoulombFriction(0.6, width=0.8)), **THREE)
add("breakaway", chain(2, forces=vp.CoulombFriction(0.4, 0.9, 0.9, 1.2)), (0.3, -0.5), (1.2, -0.9))
# Within their transitions all the way, where forces are smooth.
STOPS = [vp.JointStop({"joint1": 90.0}, 0.0, -9.0, -1.0, 4.0), vp.JointStop({"joint2": 60.0}, 6.0, 0.8, 9.0, 4.0)]
add("stops", chain(2, forces=STOPS), (0.5, -0.7), (0.8, -0.5), 0.01)
SERVOS = [vp.PositionServo({"joint1": 60.0, "joint3": 30.0}, {"joint1": 4.0, "joint3": 2.0})]
add("servos", chain(3, forces=SERVOS), **THREE, amp=(0.4, 1.0, 0.4))
# In the bend below its limit all the way.
LIMITED = [vp.PositionServo({"joint1": 2.0}, {"joint1": 0.1}, {"joint1": 20.0})]
add("servo at its limit", chain(2, forces=LIMITED), (0.3, -0.5), (1.0, 0.5), 0.01, (0.1, 1.0), (10.8, 0.0))
HELD = [
    vp.FrameSpring(("tip", (0.0, 0.1, 0.2)), (1.0, 0.3, -0.5), (12.0, 0.0, 8.0), (0.1, 0.0, -0.2)),
    vp.FrameSpring("joint3", "joint1", 15.0, 0.9, (1.0, 3.0, 0.5), TURNED),
]
add("frame springs", chain(3, forces=HELD), **THREE)
add("frame dampers", chain(3, forces=vp.FrameDamper(("tip", (0.1, 0.0, 0.0)), "joint1", (1.0, 0.5, 1.5), 0.4)), **THREE)
LOADS = [
    vp.FrameWrench(("tool0", (0.0, 0.1, 0.05)), (3.0, -2.0, 5.0, 0.2, -0.3, 0.4)),
    vp.FrameWrench(("forearm_link", (0.1, 0.0, 0.2)), (4.0, 1.0, -6.0, 0.5, 0.3, -0.2), "frame"),
]
add("wrenches", arm("ur5", forces=LOADS), 0.3, 0.4, amp=2.0)
add("custom force", chain(3, forces=vp.CustomForce(drag, "complex")), **THREE)
BUMPERS = [vp.JointStop({"joint1": 90.0, "joint2": 50.0}, 0.0, -9.0, -1.0, 4.0), vp.Armature(0.3)]
add("bumpers", chain(2, forces=BUMPERS), (0.5, -0.7), (0.8, -0.5), 0.01)


def couple() -> vp.Scene:
    """Two arms that share nothing but a spring and a damper between their tips."""
    away = pin.SE3(pin.utils.rotate("z", 0.4), np.array([1.2, 0.3, 0.2])).homogeneous
    both = vp.combine(vp.planar_chain(2), vp.planar_chain(2), placements=[None, away], prefixes=["a_", "b_"])
    return vp.Scene(
        both, damping=0.1, forces=[vp.FrameSpring("a_tip", "b_tip", 9.0), vp.FrameDamper("a_tip", "b_tip", 0.8)]
    )


add("two arms", couple, (0.3, -0.4, 0.5, 0.2), (1.0, -0.5, 0.8, 0.3))
add("treacle", chain(3, forces=vp.JointDamper(30.0)), **THREE, amp=30.0, stiff=True)


def busy(made: Callable[[], vp.Robot], tip: str, other: str) -> Callable[[], vp.Scene]:
    """A robot under every kind of force, each in units of its inertia."""

    def build() -> vp.Scene:
        own = made()
        n, q = own.dof, 0.3
        unit = 1.0 / np.diag(
            np.linalg.inv(vp.lagrangian_jet(vp.Scene(own, damping=0.0), np.full(n, q), np.zeros(n)).Lvv)
        )
        s, served = float(unit.min()), np.where(np.arange(n) == n - 1, unit, 0.0)
        forces = [
            vp.Armature(0.5 * unit),
            vp.JointSpring(5.0 * unit, 0.2),
            vp.JointDamper(0.8 * unit),
            vp.CoulombFriction(1.5 * unit, 1.5, 2.5 * unit, 2.0),
            vp.JointStop(9.0 * unit, 2.0 * unit, -9.0, q - 1.0, 4.0),
            vp.PositionServo(20.0 * served, 2.0 * served, np.where(served > 0.0, 30.0 * served, np.inf)),
            vp.FrameWrench((tip, (0.0, 0.1, 0.0)), s * np.array([3.0, -2.0, 5.0, 0.1, 0.2, -0.1])),
            vp.FrameWrench(tip, s * np.array([1.0, -2.0, 0.5, 0.2, 0.4, -0.3]), "frame"),
            vp.FrameSpring(tip, (other, (0.05, 0.1, 0.0)), s * np.array([8.0, 0.0, 3.0]), (0.1, 0.0, -0.2)),
            vp.FrameSpring(
                (tip, (0.0, 0.0, 0.1)), (1.2, -0.9, 1.1), 6.0 * s, 0.7, s * np.array([1.0, 5.0, 0.5]), TURNED
            ),
            vp.FrameDamper((tip, (0.1, 0.0, 0.0)), other, 0.6 * s, 0.4 * s),
        ]
        return vp.Scene(own, damping=0.0, friction=0.0, forces=forces)

    return build


def manipulator() -> vp.Robot:
    return vp.load_robot("tiago_no_hand", base="planar")


add("busy finger", busy(lambda: robot("finger"), "dip", "mcp"), 0.3, 0.6, 0.01, 1e-5)
add("busy panda", busy(lambda: robot("panda"), "panda_leftfinger", "panda_rightfinger"), 0.3, 0.4, 0.01, 0.02)
add("busy hand", busy(lambda: robot("allegro_right_hand"), "link_3.0", "link_14.0"), 0.3, 0.5, 4e-3, 1e-4)
add("busy manipulator", busy(manipulator, "arm_7_link", "torso_lift_link"), 0.3, 0.4, 0.01, 1e-3)
# --- constraints -----------------------------------------------------------------------------------------------------
TIP = (1.3, 0.0, 0.2)
FOUR, FIVE = {"q": (-1.5, 1.5, 1.5), "v": (1.0, 0.0, 0.0)}, {"q": (-1.0, 1.0, 1.0, 1.0), "v": 1.0}
add("four-bar", chain(3, constraints=vp.PointOnPoint("tip", TIP, "xz")), **FOUR)
add("five-bar", chain(4, damping=0.3, constraints=vp.PointOnPoint("tip", (1.6, 0.0, 0.3), "xz")), **FIVE)
# With a row that nothing moves, and one that depends on others.
TWICE = [vp.PointOnPoint("tip", "pin"), vp.PointOnPlane("tip", "pin", (1.0, 0.5, 1.0))]
add("crank and block", lambda: vp.Scene(crank_and_slider(), constraints=TWICE), (0.7, -0.9, 1.2), (3.0, 0.0, 0.0), 0.01)
add("rod", chain(3, constraints=vp.Distance("tip", (0.5, 0.0, 0.5), 1.2)), (-1.0, 0.6, 0.5), 1.0)
add("cam", chain(3, constraints=vp.JointTie("joint3", "joint1", (0.1, 0.5, -0.3, 0.2))), (-1.0, 0.6, 0.5), 1.0)
add("line", chain(3, constraints=vp.PointOnLine("tip", (1.0, 0.0, -0.4), (1.0, 0.0, 0.5))), (0.9, -1.1, 0.8), 1.0, 0.01)
POSTURE = (0.0, -0.5, 0.0, -2.3, 0.0, 1.8, 0.8)
PLANE = vp.PointOnPlane("panda_hand", (0.0, 0.0, 0.4), (0.1, 0.0, 1.0))
add("plane", arm("panda", "panda_finger_joint1", constraints=PLANE), POSTURE, 0.3, 0.01, 0.5)


def grasp() -> vp.Scene:
    """An arm of seven joints whose hand is welded to the world."""
    panda = vp.load_robot("panda", lock={"panda_finger_joint1": 0.02})
    model = panda.model
    data = model.createData()
    pin.framesForwardKinematics(model, data, np.array(POSTURE))
    place = data.oMf[model.getFrameId("panda_hand")].homogeneous
    return vp.Scene(panda, damping=0.0, constraints=vp.FrameOnFrame("panda_hand", "universe", place))


add("weld", grasp, POSTURE, (1.0, 0.3, 1.0, 0.0, -1.0, 0.0, 1.0), 0.01)


def evenly(t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.array([0.3 + 0.8 * t]), np.array([0.8]), np.zeros(1)


def cubically(t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    p = np.polynomial.Polynomial([0.3, 0.8, 2.0, -3.0])
    return tuple(np.array([p.deriv(k)(t) if k else p(t)]) for k in range(3))


add("pushed joint", chain(3, damping=0.2, constraints=vp.KinematicInput("joint1")), (0.3, -0.4, 0.5), (0.8, -0.5, 0.8),
    path=evenly)  # fmt: skip
add("steered joint", chain(3, damping=0.2, constraints=vp.KinematicInput("joint2", "cubic")), (0.5, 0.3, 0.5),
    (0.5, 0.8, -0.5), path=cubically)  # fmt: skip


def cranked(t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return ZOO["cranked five-bar"].q0[:1] + 0.8 * t, np.array([0.8]), np.zeros(1)


CRANK = [vp.PointOnPoint("tip", (1.6, 0.0, 0.3), "xz"), vp.KinematicInput("joint1")]
add("cranked five-bar", chain(4, damping=0.3, constraints=CRANK), **FIVE, path=cranked)
# --- noise -----------------------------------------------------------------------------------------------------------
add("trembling", chain(2, damping=0.3, noise=vp.AdditiveNoise((0.3, 0.2))), (0.3, -0.5), (1.0, 0.5), 0.01)
add("trembling torques", chain(2, noise=vp.ControlNoise(0.2) + vp.AdditiveNoise(0.05)), (0.3, -0.5), 0.5, 0.01, 3.0)
add("trembling far out", arm("ur5", noise=vp.StateNoise(0.6, center=0.1)), 0.4, 0.5, 0.01, 3.0)
FIELD = vp.CustomNoise(
    lambda q, v, u: np.array([[0.2 + 0.1 * q[1]], [0.3 * np.cos(q[0]) + 0.1 * u[1]]]), 1,
    dq=lambda q, v, u: np.array([[[0.0, 0.1]], [[-0.3 * np.sin(q[0]), 0.0]]]),
    du=lambda q, v, u: np.array([[[0.0, 0.0]], [[0.0, 0.1]]]),
)  # fmt: skip


def rough(n: int, m: int, strength: float) -> vp.CustomNoise:
    """F = strength (q q' + diag(1 + v^2 / 2 + q v) + u_0) of n joints under m controls, with all its derivatives."""
    eye, first = np.eye(n), np.eye(m)[0]

    def diagonal(values: np.ndarray) -> np.ndarray:
        return np.einsum("ik,ic,i->ikc", eye, eye, values)

    return vp.CustomNoise(
        field=lambda q, v, u: strength * (np.outer(q, q) + np.diag(1.0 + 0.5 * v**2 + q * v) + u[0]),
        processes=n,
        dq=lambda q, v, u: strength * (eye[:, None] * q[:, None] + eye * q[:, None, None] + diagonal(v)),
        dv=lambda q, v, u: strength * diagonal(q + v),
        du=lambda q, v, u: strength * np.einsum("ik,m->ikm", np.ones((n, n)), first),
        check=True,
    )


add("custom noise", chain(2, damping=0.2, noise=FIELD), (0.3, -0.5), (1.0, 0.5), 0.01)
add("trembling loop", chain(3, noise=vp.AdditiveNoise(0.2), constraints=vp.PointOnPoint("tip", TIP, "xz")), **FOUR)
