"""Closed loops at their extremes; the oracle has their motions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from mechanisms import crank_and_slider
from oracles import exact

import varpin as vp
from varpin.mechanics.assembly import along_constraints
from varpin.model.chain import rod_chain


@dataclass(frozen=True, eq=False)
class Loop:
    """A closed loop, a guess that it is assembled from, and a velocity of which the part along the constraints counts.

    Controls are a function of time, or None; ``stiff`` is whether the oracle is to be implicit.
    """

    name: str
    scene: vp.Scene
    start: list[float]
    push: object = 1.0
    controls: Callable[[float], np.ndarray] | None = None
    duration: float = 0.3
    stiff: bool = False

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """A configuration and a velocity that keep the constraints."""
        q = vp.assemble(self.scene, self.start)
        push = np.broadcast_to(np.asarray(self.push, dtype=float), q.shape)
        return q, along_constraints(self.scene, q, push)

    def motion(self, times: int) -> tuple[np.ndarray, np.ndarray]:
        """(q, v) (times, n) from that state on, at evenly spaced times."""
        signal = None if self.controls is None else lambda k, q, v: self.controls
        found = exact(self.scene, *self.state(), np.linspace(0.0, self.duration, times), signal, stiff=self.stiff)
        return found.q, found.v


def scene(robot: vp.Robot, constraints: object, **options: object) -> vp.Scene:
    return vp.Scene(robot, constraints=constraints, damping=0.0, **options)


def held(place: tuple[float, float, float], axes: str = "xz") -> vp.PointOnPoint:
    return vp.PointOnPoint("tip", place, axes=axes)


def _facing() -> vp.Robot:
    """Two UR5 that look at each other."""
    facing = [[-1, 0, 0, 1.0], [0, -1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    beam = vp.Payload("tool0", mass=3.0, center=[0.0, 0.0, 0.25], inertia=[0.0625, 0.0625, 1e-3])
    left, right = vp.load_robot("ur5", payload=beam), vp.load_robot("ur5")
    return vp.combine(left, right, placements=[None, facing], prefixes=["left_", "right_"])


def two_arms(name: str = "two arms hold a beam", **options: object) -> Loop:
    """Two UR5 that hold a beam."""
    grip = [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.5], [0, 0, 0, 1]]
    controls = options.pop("controls", None)
    made = scene(_facing(), vp.FrameOnFrame("right_tool0", "left_tool0", grip), **options)
    return Loop(name, made, [-0.35, -1.3, 1.9, -0.6, 1.2, 0.0] * 2, 0.3, controls)


def delta() -> vp.Robot:
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


SEED, CRANK, AT = [-1.5, 1.5, 1.5], np.array([1.0, 0.0, 0.0]), (1.3, 0.0, 0.2)
REST = [-1.4, 1.4, 1.6]


def four_bar(name: str, push: object = CRANK, place: object = AT, start: object = SEED, **options: object) -> Loop:
    robot = options.pop("robot", None) or vp.planar_chain(3)
    own = {key: options.pop(key) for key in ("controls", "stiff") if key in options}
    return Loop(name, scene(robot, held(place), **options), start, push, **own)


def _sway(n: int) -> Callable[[float], np.ndarray]:
    return lambda t: 2.0 * np.sin(7.0 * t + np.arange(n))


def of_chain(name: str, constraints: object, start: list[float], push: object = 1.0) -> Loop:
    return Loop(name, scene(vp.planar_chain(len(start)), constraints), start, push)


def _on_a_plane() -> Loop:
    panda = vp.load_robot("panda", lock={"panda_finger_joint1": 0.0})
    plane = vp.PointOnPlane("panda_hand", (0.0, 0.0, 0.4), (0.0, 0.0, 1.0))
    return Loop("panda on a plane", scene(panda, plane), [0.0, -0.5, 0.0, -2.3, 0.0, 1.8, 0.8], 0.2)


def _delta() -> Loop:
    ends = [vp.PointOnPoint("end0", "end1"), vp.PointOnPoint("end0", "end2")]
    return Loop("delta", scene(delta(), ends), [0.3, 1.4, 0.0] * 3)


def _damped(k: float, d: float) -> Callable[[], Loop]:
    forces = [vp.JointSpring(k, REST), vp.JointDamper(d)]
    return lambda: four_bar(f"four-bar, springs {k:g}, dampers {d:g}", forces=forces, stiff=True)


def _weighted(heavy: float, light: float) -> Callable[[], Loop]:
    name = f"links of {heavy:g} and {light:g} kg"
    return lambda: four_bar(name, robot=rod_chain([1.0, 1.0, 1.0], [heavy, light, heavy]))


# They are built when asked for: robots from files take a while.
LOOPS: tuple[Callable[[], Loop], ...] = (
    lambda: four_bar("four-bar"),
    lambda: of_chain("five-bar", held((1.6, 0.0, 0.3)), [-1.0, 1.0, 1.0, 1.0]),
    lambda: four_bar("four-bar, swift", 10.0 * CRANK),
    lambda: four_bar("parallelogram", CRANK, (1.0, 0.0, 0.0), [-1.2, 1.2, 1.2]),
    lambda: four_bar("parallelogram next to flat", -CRANK, (1.0, 0.0, 0.0), [-0.05, 0.05, 0.05]),
    lambda: four_bar("nearly stretched", CRANK, (2.9, 0.0, 0.0), [-0.3, 0.3, 0.2]),
    lambda: four_bar("all but stretched", CRANK, (2.999, 0.0, 0.0), [-0.03, 0.03, 0.02]),
    lambda: Loop(
        "slider-crank", scene(crank_and_slider(), vp.PointOnPoint("tip", "pin", axes="xz")), [0.7, -0.9, 1.2], 5.0
    ),
    lambda: of_chain("planar loop with three rows", held(AT, "xyz"), SEED, CRANK),
    lambda: of_chain("closed twice", [held(AT), held(AT, "zx")], SEED, CRANK),
    lambda: of_chain("rod on a tip", vp.Distance("tip", (0.5, 0.0, 0.5), 1.2), [-1.0, 0.6, 0.5]),
    lambda: of_chain("cam", vp.JointTie("joint3", "joint1", (0.1, 0.5, -0.3, 0.2)), [-1.0, 0.6, 0.5]),
    _delta,
    two_arms,
    _on_a_plane,
    lambda: four_bar("driven four-bar", controls=_sway(3)),
    *(_damped(k, d) for k, d in ((1e2, 1.0), (1e4, 1e2), (0.0, 1e2), (0.0, 1e4))),
    *(
        _weighted(heavy, light)
        for heavy, light in ((1e4, 1e4), (1e-6, 1e-6), (1e4, 1e-6), (1e-6, 1e4), (1.0, 1e-6), (1.0, 1e4))
    ),
    lambda: four_bar("four-bar, friction", forces=vp.CoulombFriction(1.0, 0.1), stiff=True),
    lambda: four_bar(
        "four-bar, servo",
        forces=vp.PositionServo({"joint1": 2e3}, {"joint1": 50.0}),
        actuation=["joint1"],
        controls=lambda t: np.array([-1.4 + 0.3 * np.sin(5.0 * t)]),
    ),
    lambda: two_arms("two arms, damped and driven", forces=vp.JointDamper(2.0), controls=lambda t: 10.0 * _sway(12)(t)),
)
# Those whose reference is implicit, and takes seconds.
STIFF = frozenset({16, 17, 18, 19})
