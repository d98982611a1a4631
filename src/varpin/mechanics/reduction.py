"""A scene without joints that need not be computed: which ones these are, and the scene that is left."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Floats, Integers, Mask
from varpin.core.arrays import Coupling, Diffusion
from varpin.errors import InputError
from varpin.mechanics.forces import Force, of_kind
from varpin.mechanics.noise import BoundNoise
from varpin.mechanics.scene import Scene
from varpin.model import Robot, combine
from varpin.model.loading import hold_joints
from varpin.support.checks import JointValues, as_floats, joint_array, tuple_of
from varpin.support.frozen import Frozen
from varpin.support.markup import facts, listed

# Share of the largest torque of gravity that is rounding.
_ROUNDING = 1e-12


@dataclass(frozen=True)
class Required(Frozen):
    """Report on the parts of a scene that are computed and those that are left out.

    Attributes:
        joints: The computed joints.
        locked: Joints that are locked, and their positions [rad or m]: their links are part of others.
        idle: Joints that stay at rest and are left out, and their positions [rad or m].
        parts: The computed joints in independent groups.
        terms: Description of each possible effect, by its name.
    """

    joints: tuple[str, ...]
    locked: Mapping[str, float | tuple[float, ...]]
    idle: Mapping[str, float]
    parts: tuple[tuple[str, ...], ...]
    terms: Mapping[str, str]

    @property
    def described(self) -> int:
        """Number of moving joints in the robot's description."""
        return len(self.joints) + len(self.locked) + len(self.idle)

    @property
    def rows(self) -> list[tuple[str, str]]:
        """The report as names and texts."""
        rows = [("computed", f"{len(self.joints)} of {self.described}: {listed(self.joints)}")]
        for title, joints in (("locked", self.locked), ("nothing touches", self.idle)):
            if joints:
                rows.append((title, listed(f"{joint} at {at}" for joint, at in joints.items())))
        if len(self.parts) > 1:
            rows.append(("independent", "; ".join(listed(part) for part in self.parts)))
        return [*rows, *self.terms.items()]

    def _repr_html_(self) -> str:
        return facts("What is computed", self.rows)

    def __str__(self) -> str:
        return "\n".join(f"{name}: {words}" for name, words in self.rows)


def requirements(
    scene: Scene, q0: JointValues, v0: JointValues, controls: ArrayLike | None, task: Iterable[str]
) -> Required:
    """See :meth:`Scene.required`."""
    names = scene.robot.joint_names
    q, v = joint_array("q0", q0, names, uniform=True), joint_array("v0", v0, names, uniform=True)
    idle = idle_joints(scene, q, v, controls, task)
    return report(scene.without(idle), scene, idle)


def report(part: Scene, whole: Scene, idle: Mapping[str, float]) -> Required:
    """The report on ``part``, which is ``whole`` without its ``idle`` joints."""
    names = np.array(part.robot.joint_names)
    parts = tuple(tuple(names[part.group == label].tolist()) for label in np.unique(part.group))
    return Required(tuple(names.tolist()), whole.robot.locked, idle, parts, part.terms)


def idle_joints(
    scene: Scene, q: Floats, v: Floats, controls: ArrayLike | None, task: Iterable[str]
) -> dict[str, float]:
    """The joints that stay at rest, and their positions: nothing acts on their group, no force and no task.

    Control noise does not act on zero controls.
    """
    robot = scene.robot
    noise = scene.noise.diffusion
    if scene.constraints or scene.custom is not None or noise is None:
        return {}
    touched = (v != 0.0) | noise.constant.any(axis=1) | noise.quadratic.any(axis=1)
    # Springs, stops and forces on frames in the initial configuration.
    touched |= scene.changed(gravity=np.zeros(3)).static_pull(q) != 0.0
    touched |= _weighed(scene, q)
    rest = scene.command_at(q)
    given = rest[None] if controls is None else np.atleast_2d(as_floats("controls", controls))
    if given.shape[1] != scene.controls:
        raise InputError(f"controls must have shape ({scene.controls},) or (N, {scene.controls}), got {given.shape}")
    touched |= (scene.actuation != 0.0)[:, (given != rest).any(axis=0)].any(axis=1)
    for name in tuple_of("task", task, str):
        touched[robot.coordinate(name)] = True
    busy = np.isin(scene.group, scene.group[touched])
    for part in robot.parts:
        # Of several robots each keeps its joints, or those that are touched.
        own = np.isin(robot.joint_names, [part.prefix + name for name in part.robot.joint_names])
        busy |= own & ~busy[own].any()
    # If every joint is idle, none is left out.
    out = ~busy & busy.any()
    return {name: float(at) for name, at, left in zip(robot.joint_names, q, out, strict=True) if left}


def _weighed(scene: Scene, q: Floats) -> Mask:
    """Joints (n,) on which gravity acts in some configuration."""
    n = scene.robot.dof
    if not scene.gravity.any():
        return np.zeros(n, dtype=np.bool_)
    bare = Scene(scene.robot, gravity=scene.gravity, damping=0.0, constraints=())
    samples = [q, *np.random.default_rng(0).uniform(-2.0, 2.0, (3, n))]
    torque = np.abs([bare.static_pull(at) for at in samples]).max(axis=0)
    return np.asarray(torque > _ROUNDING * torque.max(initial=0.0))


def without(scene: Scene, joints: Mapping[str, float] | Collection[str]) -> Scene:
    """See :meth:`Scene.without`."""
    names = scene.robot.joint_names
    held = dict(joints if isinstance(joints, Mapping) else dict.fromkeys(tuple_of("joints", joints, str), 0.0))
    for name in held:
        scene.robot.coordinate(name)
    if not held:
        return scene
    noise = scene.noise.diffusion
    odd = "constraints" if scene.constraints else "a CustomForce" if scene.custom else ""
    if odd or noise is None:
        raise InputError(f"a scene with {odd or 'CustomNoise'} keeps all its joints, of which its functions are")
    keep = np.flatnonzero([name not in held for name in names])
    columns = driving(scene, held)
    actuation = scene.actuation[:, columns]
    for servo in of_kind(scene.elements, "PositionServo"):
        # The scene has the stiffness of the servo here.
        actuation[servo.coordinate] = actuation[servo.coordinate] != 0.0
    return Scene(
        _held(scene.robot, held),
        gravity=scene.gravity,
        damping=0.0,
        forces=[part for part in (_part(force, scene, keep, held) for force in scene.forces) if part is not None],
        actuation=actuation[keep],
        constraints=(),
    ).changed(noise=_noise_of(noise, keep, columns))


def driving(scene: Scene, held: Collection[str]) -> Integers:
    """The controls that stay without the joints ``held``: all but those of these joints alone."""
    out = np.isin(scene.robot.joint_names, list(held))
    acts = scene.actuation != 0.0
    return np.flatnonzero(acts[~out].any(axis=0) | ~acts[out].any(axis=0))


def _held(robot: Robot, held: Mapping[str, float]) -> Robot:
    if not robot.parts:
        return hold_joints(robot, held)
    robots = []
    for part in robot.parts:
        own = {name: held[part.prefix + name] for name in part.robot.joint_names if part.prefix + name in held}
        robots.append(_held(part.robot, own) if own else part.robot)
    prefixes, placements = [part.prefix for part in robot.parts], [part.place for part in robot.parts]
    return combine(*robots, prefixes=prefixes, placements=placements)


def _part(force: Force, scene: Scene, keep: Integers, held: Mapping[str, float]) -> Force | None:
    """What is left of a force on the coordinates ``keep``; None for nothing.

    Of a force on frames all is left if one of them still moves.
    """
    bound = force.bind(scene.robot)
    if not np.isin(scene._moved_by(bound), keep).any():
        return None
    if any(isinstance(each, Coupling) for each in bound):
        return force
    return replace(force, **{item.name: _values(getattr(force, item.name), keep, held) for item in fields(force)})


def _values(value: Any, keep: Integers, held: Mapping[str, float]) -> Any:
    if isinstance(value, Mapping):
        return {name: number for name, number in value.items() if name not in held}
    return value[keep] if np.ndim(value) == 1 else value


def _noise_of(fields: Diffusion, keep: Integers, columns: Integers) -> BoundNoise:
    """The processes that act on the coordinates ``keep`` in proportion to nothing but the controls ``columns``."""
    acts = (
        fields.constant[keep].any(axis=0) | fields.quadratic[keep].any(axis=0) | fields.control[keep].any(axis=(0, 2))
    )
    rows = np.ix_(keep, acts)
    parts = (fields.constant[rows], fields.control[np.ix_(keep, acts, columns)], fields.quadratic[rows])
    return BoundNoise(Diffusion(*map(np.ascontiguousarray, (*parts, fields.center[rows]))))
