"""The joints of a scene that have to be computed, and those that can be left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from varpin.arrays import Floats, Mask
from varpin.io.scenefile.layout import CostTerm, Layout, holding_controls, joints_of_frame, times_of
from varpin.io.scenefile.plan_constraints import PLAN_CONSTRAINTS
from varpin.io.scenefile.references import Timeline
from varpin.io.scenefile.spec import FORCES, FRAME_FORCES
from varpin.mechanics.forces import CoulombFriction, Force, JointStop
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.scene import Scene
from varpin.support.markup import facts, listed

# Forces that act only if the scene has them, by their names in the report.
_ABSENT: Mapping[str, type[Force]] = {"stops at joint limits": JointStop, "dry friction": CoulombFriction}


@dataclass(frozen=True)
class Required:
    """Report on the parts of a scene that are computed and those that are left out.

    Attributes:
        joints: The computed joints.
        locked: Joints that the scene locks, and their positions [rad or m]: their links are part of others.
        idle: Joints that stay at rest and are left out, and their positions.
        parts: The computed joints in independent groups; ``solve`` plans each group separately.
        coupled: Why groups are planned together although they share no inertia; empty if they are not.
        terms: Description of each possible effect, by its name.
    """

    joints: tuple[str, ...]
    locked: Mapping[str, float | tuple[float, ...]]
    idle: Mapping[str, float]
    parts: tuple[tuple[str, ...], ...]
    coupled: str
    terms: Mapping[str, str]

    @property
    def described(self) -> int:
        """Number of moving joints in the robot's description."""
        return len(self.joints) + len(self.locked) + len(self.idle)

    @property
    def saved(self) -> float:
        """Saved share of the linear algebra of a plan, whose work grows with the cube of the number of joints."""
        return 1.0 - sum(len(part) ** 3 for part in self.parts) / self.described**3

    def _repr_html_(self) -> str:
        rows: list[tuple[str, object]] = [
            ("computed", f"{len(self.joints)} of {self.described}: {listed(self.joints)}")
        ]
        for title, joints in (("locked", self.locked), ("nothing touches", self.idle)):
            if joints:
                rows.append((title, listed(f"{joint} at {at}" for joint, at in joints.items())))
        if len(self.parts) > 1:
            rows.append(("planned apart", "; ".join(listed(part) for part in self.parts)))
        if self.coupled:
            rows.append(("planned together", self.coupled))
        rows += [*self.terms.items(), ("saved", f"{100 * self.saved:.0f}% of a plan's linear algebra, by counting")]
        return facts("What is computed", rows)

    def __str__(self) -> str:
        lines = [f"joints: {len(self.joints)} of {self.described} computed: {', '.join(self.joints)}"]
        for title, joints in (("locked", self.locked), ("nothing touches", self.idle)):
            if joints:
                lines.append(f"{title}: {', '.join(joints)}")
        if len(self.parts) > 1:
            lines.append(f"planned apart: {'; '.join(', '.join(part) for part in self.parts)}")
        if self.coupled:
            lines.append(f"planned together: {self.coupled}")
        lines += [f"{name}: {words}" for name, words in self.terms.items()]
        return "\n".join([*lines, f"saved: {100 * self.saved:.0f}% of the linear algebra of a plan, by counting"])


def idle_joints(layout: Layout, scene: Scene) -> Mask:
    """Whether each joint (n,) stays at rest, as no force and no cost acts on its group.

    A joint is idle if it starts at rest, no force acts on it in any configuration, and no cost does at its position.
    A group is idle if all its joints are. Control noise does not act on zero controls.
    """
    if scene.constraints or layout.spec.plan_constraints:
        return np.zeros(scene.robot.dof, dtype=np.bool_)
    touched = layout.v0 != 0.0
    touched |= _pushed(layout, scene)
    touched |= _weighed(layout)
    t = times_of(layout.spec)
    for model in layout.noise:
        if model.kind != "control":
            touched |= model.intensity != 0.0
    if isinstance(layout.controls, Timeline):
        commands = layout.controls.at(t)
    else:
        commands = (holding_controls(scene, layout.q0) if layout.controls == "hold" else np.zeros(scene.controls))[None]
    touched[layout.actuated] |= (commands != _resting(layout)).any(axis=0)
    for term in layout.costs:
        touched |= _costs(term, layout, scene, t)
    group = scene.group
    busy = np.isin(group, group[touched])
    for part in layout.robot.parts:
        # Of several robots each keeps its joints, or those that are touched.
        own = np.isin(layout.robot.joint_names, [part.prefix + name for name in part.robot.joint_names])
        busy |= own & ~busy[own].any()
    # If every joint is idle, none is left out.
    return ~busy if busy.any() else np.zeros_like(busy)


def _resting(layout: Layout) -> Floats:
    """Controls (m,) that leave the joints at rest: zero force, or the initial position for a servo."""
    return np.where(layout.served, layout.q0, 0.0)[layout.actuated]


def _pushed(layout: Layout, scene: Scene) -> Mask:
    """Joints (n,) on which springs, stops and forces on frames act in the initial configuration."""
    floating = Scene(
        layout.robot, gravity=False, damping=0.0, forces=scene.forces, actuation=layout.actuation, constraints=()
    )
    return np.asarray(floating.holding_torque(layout.q0) != 0.0)


def _weighed(layout: Layout) -> Mask:
    """Joints (n,) on which gravity acts in some configuration."""
    robot = layout.robot
    if layout.spec.gravity is False:
        return np.zeros(robot.dof, dtype=np.bool_)
    bare = Scene(robot, gravity=layout.spec.gravity, damping=0.0, constraints=())
    rng = np.random.default_rng(0)
    samples = [layout.q0, *rng.uniform(-2.0, 2.0, (3, robot.dof))]
    torque = np.abs([lagrangian_jet(bare, q, np.zeros(robot.dof), backend="pinocchio").Lq for q in samples]).max(axis=0)
    return np.asarray(torque > 1e-12 * torque.max(initial=0.0))


def _costs(term: CostTerm, layout: Layout, scene: Scene, t: Floats) -> Mask:
    """Joints (n,) that a term of the cost would move, or that it charges in the initial configuration."""
    touched = np.zeros(layout.robot.dof, dtype=np.bool_)
    space = term.spec.term.space
    if space == "frame":
        return joints_of_frame(layout.robot, term.spec.frame)
    if space == "robot":
        return ~touched
    rest = {"q": layout.q0, "v": np.zeros(layout.robot.dof), "u": _resting(layout)}[space]
    if term.spec.term.limits is not None:
        lower, upper = term.spec.term.limits(layout.robot)
        margin = term.spec.numbers["margin"]
        return np.asarray((term.weight != 0.0) & ((rest > upper - margin) | (rest < lower + margin)))
    if term.holding_q is not None:
        wanted = holding_controls(scene, term.holding_q)[None]
    else:
        wanted = rest[None] if term.target is None else term.target.at(t)
    moves = ((wanted != rest) & (term.weight != 0.0)).any(axis=0)
    touched[layout.actuated if space == "u" else slice(None)] |= moves
    return touched


def requirements(layout: Layout, whole: Layout, idle: Sequence[str], scene: Scene) -> Required:
    """The report on ``layout``, whose scene is ``scene``, as a part of ``whole``."""
    names, group = layout.robot.joint_names, scene.group
    parts = [tuple(name for name, g in zip(names, group, strict=True) if g == label) for label in np.unique(group)]
    together = ", ".join(sorted({term.spec.kind for term in layout.costs if term.spec.term.space == "robot"}))
    why = f"the cost has a term on the whole robot ({together})" if together else ""
    if scene.constraints and not why:
        why = "the scene has constraints"
    if why or len(parts) == 1:
        coupled = why if len(parts) > 1 else ""
        parts = [names]
    else:
        coupled = ""
    position = whole.robot.joint_names
    return Required(
        joints=names,
        locked=whole.robot.locked,
        idle={name: float(whole.q0[position.index(name)]) for name in idle},
        parts=tuple(parts),
        coupled=coupled,
        terms=_terms(layout),
    )


def _terms(layout: Layout) -> dict[str, str]:
    spec = layout.spec
    gravity = spec.gravity if isinstance(spec.gravity, tuple) else layout.robot.model.gravity.linear * spec.gravity
    joints = layout.robot.joint_names

    def of(values: Floats, names: Sequence[str]) -> str:
        acting = [name for name, value in zip(names, values, strict=True) if value]
        if len(acting) == len(names):
            return "on every joint"
        return f"on {', '.join(acting)}" if acting else "none"

    noise = [f"{model.kind} ({np.count_nonzero(model.intensity)} processes)" for model in layout.noise]
    limited = np.isfinite(layout.torque_limit)
    costs = [term.spec.kind + (" at the end" if term.spec.terminal else "") for term in layout.costs]
    kinds: set[type[Force]] = {force.kind for force in layout.forces} | {type(part) for part in layout.frame_forces}
    absent = [words for words, kind in _ABSENT.items() if kind not in kinds] + ["contact"]
    kinds_kept = [constraint.kind for constraint in spec.plan_constraints]
    kept = [name.replace("_", " ") for name, kind in PLAN_CONSTRAINTS.items() if kind in kinds_kept]
    shapes = "replays and clearance" if "clearance" in kept else "a replay"
    payloads = [
        f"{payload.mass:g} kg at {word}{payload.frame}"
        for word, robot in zip(spec.prefixes or ("",), spec.robots, strict=True)
        for payload in robot.payload
    ]
    terms = {
        "gravity": f"{', '.join(f'{g:g}' for g in gravity)} m/s^2" if any(gravity) else "none",
        "damping": of(layout.damping, joints),
        "springs": of(layout.stiffness, joints),
        "payload": ", ".join(payloads) or "none",
        "noise": ", ".join(noise) or "none",
        "driven": ", ".join(layout.driven) or "none",
        "torque limits": of(limited.astype(float), layout.driven),
        "cost": ", ".join(costs) or "none",
        "other forces": ", ".join(word for word, kind in {**FORCES, **FRAME_FORCES}.items() if kind in kinds) or "none",
        "not modelled": f"{', '.join(absent)}; shapes are read only for {shapes}",
    }
    if layout.constraints:
        terms["constraints"] = ", ".join(dict.fromkeys(type(part).__name__ for part in layout.constraints))
    if kept:
        terms["the plan keeps"] = ", ".join(kept)
    return terms
