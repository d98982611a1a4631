"""Findings about a problem before any search: constraints that no motion meets, and values in wrong units."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from varpin.arrays import Floats
from varpin.control.constraints import (
    BoundConstraint,
    KeepClear,
    KeepInBox,
    KeepInHalfSpace,
    KeepInSphere,
    KeepOutOfSphere,
    PlanConstraint,
    ReachFrame,
    WithinJointLimits,
)
from varpin.control.costs import Cost, FramePositionCost, TrackingCost, weight_matrix
from varpin.control.problem import OptimalControlProblem
from varpin.finding import Finding
from varpin.mechanics.scene import closest_controls
from varpin.model import (
    ADVICE,
    AFAR,
    ASIDE,
    IN_MILLIMETRES,
    Robot,
    degrees_hint,
    joint_unit,
    looks_like_degrees,
    millimetres_hint,
)
from varpin.model.kinematics import FrameKinematics, frame_kinematics
from varpin.simulation.start import in_other_units

# Kinds of findings about values in wrong units.
UNITS = (
    "start in degrees",
    "goal in degrees",
    "goal in millimetres",
    "limits in degrees",
    "gravity in millimetres",
    "springs in millimetres",
    "places in millimetres",
)
_MILLIMETRES = f": {IN_MILLIMETRES}"
# Random postures in which the distance of a pair of bodies is tested.
_POSTURES = 64
# A joint limit of at least _ENDLESS [rad or m] is none: postures are then within a turn, or _RAIL [m], to either side.
_ENDLESS, _RAIL = 1e4, 100.0
# Share of the torque that holds a posture which limits may be short of without a word.
_SHARE_OF_WEIGHT = 0.01
# Tolerance on positions and joint limits [m or rad].
_SAME = 1e-6


def hints(problem: OptimalControlProblem) -> list[Finding]:
    """Findings about constraints that no motion satisfies, and about values that look like degrees or millimetres."""
    found = [*in_other_units(problem.scene, problem.q0)]
    found += [*_goals(problem), *_targets(problem), *_limits(problem), *_ends(problem), *_places(problem)]
    found += _weights(problem)
    for bound in problem.bound_constraints:
        found += _overlaps(problem, bound)
    return found


def reach(robot: Robot, frame: FrameKinematics) -> float:
    """Upper bound on a frame's distance from its first joint [m]; infinite on free rails.

    It is the shortest chain of hops from joint to joint, or over one revolute joint to the next but one.
    """
    links = frame.links
    hops = [*links.translation[1:], frame.translation]
    lower, upper = robot.position_limits
    ends = np.array([lower, upper])[:, links.coordinate]
    slides = np.where(links.prismatic, np.abs(links.ratio * ends + links.offset).max(axis=0), 0.0)
    most = [0.0]
    for k, hop in enumerate(hops):
        ways = [most[k] + slides[k] + np.linalg.norm(hop)]
        if k > 0 and not links.prismatic[k]:
            # Turned about joint k, the hop leads farthest away where it points away from its axis as the one before.
            before = links.rotation[k].T @ hops[k - 1]
            across = np.hypot(*before[:2]) + np.hypot(*hop[:2])
            ways.append(most[k - 1] + slides[k - 1] + np.hypot(across, before[2] + hop[2]))
        most.append(float(min(ways)))
    return most[-1]


def _goals(problem: OptimalControlProblem) -> Iterator[Finding]:
    """Goals out of reach, two different goals of one frame, and goals in a region that the frame must not enter."""
    goals = [bound for bound in problem.bound_constraints if isinstance(bound.source, ReachFrame)]
    for bound in goals:
        goal = bound.source
        assert isinstance(goal, ReachFrame)
        if goal.position is None:
            continue
        most = reach(goal.robot, goal.kinematics)
        away = float(np.linalg.norm(goal.position - goal.kinematics.links.translation[0]))
        if away > most * (1.0 + _SAME):
            far = away > AFAR * most
            yield Finding(
                "goal in millimetres" if far else "goal out of reach",
                f"{goal.label} has its goal {away:.4g} m from the first joint, and the frame gets {most:.4g} m from "
                f"there at most{_MILLIMETRES if far else ''}: no motion ends there",
            )
    for one, other in combinations(goals, 2):
        a, b = one.source, other.source
        assert isinstance(a, ReachFrame)
        assert isinstance(b, ReachFrame)
        if a.frame == b.frame and a.position is not None and b.position is not None:
            apart = float(np.linalg.norm(a.position - b.position))
            if apart > _SAME:
                yield Finding(
                    "two goals", f"{a.label} has two goals that are {apart:.4g} m apart: no motion ends at both"
                )
    places = [(goal.source.frame, goal.source.position, f"the goal of {goal.source.label}") for goal in goals]  # type: ignore[attr-defined]
    places += [
        (term.frame, term.target, f"the target of FramePositionCost({term.frame!r})")
        for term in _last(problem.cost)
        if isinstance(term, FramePositionCost) and not callable(term.target) and np.ndim(term.target) == 1
    ]
    for bound in problem.bound_constraints:
        outside = getattr(bound, "outside", None)
        if outside is None:
            continue
        for frame, place, name in places:
            if place is None or frame != bound.source.frame:  # type: ignore[attr-defined]
                continue
            c = outside(place)
            row = int(np.argmax(c))
            if c[row] > _SAME:
                yield Finding(
                    "goal outside constraints",
                    f"{name} is outside {bound.source.label}, {bound.rows[row]} by {c[row]:.4g} m at t = "
                    f"{bound.times[-1]:.4g} s: move the goal or the bound",
                )


def _targets(problem: OptimalControlProblem) -> Iterator[Finding]:
    """Targets of costs on a frame's position that are out of reach, or look like millimetres."""
    robot, named = problem.scene.robot, set()
    for term in problem.cost.terms:
        if not isinstance(term, FramePositionCost) or callable(term.target) or term.frame in named:
            continue
        frame = frame_kinematics(robot, term.frame)
        most = reach(robot, frame)
        away = _away(term, frame.links.translation[0])
        if away > most * (1.0 + _SAME):
            named.add(term.frame)
            far = away > AFAR * most
            yield Finding(
                "goal in millimetres" if far else "goal out of reach",
                f"FramePositionCost({term.frame!r}) has its target {away:.4g} m from the first joint, and the frame "
                f"gets {most:.4g} m from there at most{_MILLIMETRES if far else ''}: no motion gets there",
            )


def _away(term: FramePositionCost, root: Floats) -> float:
    """Largest distance of a target from the root in the directions that have a weight [m]."""
    off = np.atleast_2d(np.asarray(term.target)) - root
    strengths, axes = np.linalg.eigh(weight_matrix("FramePositionCost", term.weight, 3))
    off = off @ axes[:, strengths > _SAME * strengths[-1]]
    return float(np.linalg.norm(off, axis=1).max())


def _limits(problem: OptimalControlProblem) -> Iterator[Finding]:
    """Limits of joints that look like degrees."""
    turning = _turning(problem.scene.robot)
    for limits in problem.constraints:
        if not isinstance(limits, WithinJointLimits):
            continue
        # Limits of the robot's description are in radians, however wide.
        given = np.isfinite(limits.limits) & (limits.limits != np.array(limits.robot.position_limits))
        wide = np.where(given, np.abs(limits.limits), 0.0).max(axis=0) * turning
        joint = int(np.argmax(wide))
        if looks_like_degrees(wide[joint]):
            yield Finding(
                "limits in degrees",
                f"{limits.label} lets {limits.robot.joint_names[joint]} turn to {wide[joint]:.4g} rad, "
                f"{wide[joint] / (2.0 * np.pi):.0f} turns, and looks like degrees: {ADVICE}",
            )


def _places(problem: OptimalControlProblem) -> Iterator[Finding]:
    """Obstacles and regions whose places or sizes look like millimetres."""
    robot = problem.scene.robot
    for constraint in problem.constraints:
        lengths = _lengths(constraint)
        sentence = millimetres_hint(robot, lengths) if lengths else ""
        if isinstance(constraint, KeepClear) and not sentence:
            sentence = millimetres_hint(robot, {"KeepClear: distance": abs(constraint.distance)}, ASIDE)
        if sentence:
            yield Finding("places in millimetres", sentence)


def _lengths(constraint: PlanConstraint) -> dict[str, float]:
    """Names of a constraint's lengths, and their sizes [m]; places count by their distance from the robot's root."""
    name = type(constraint).__name__
    if isinstance(constraint, KeepClear):
        found = {}
        root = constraint.robot.tree.translation[0]
        for body in constraint.obstacles:
            label = f"{name}: the obstacle {body.name!r}"
            found[f"{label}: its distance"] = float(min(np.linalg.norm(x - root) for x in (body.begin, body.end)))
            sides = body.sides if body.hull is None else body.hull.sides
            found[f"{label}: its radius or side"] = body.radius if sides is None else float(sides.max())
        return found
    if isinstance(constraint, KeepInSphere | KeepOutOfSphere):
        found = {f"{name}: radius": constraint.radius}
        if not callable(constraint.center):
            root = constraint.robot.tree.translation[0]
            found[f"{name}: the distance of its centre"] = float(np.linalg.norm(constraint.center - root))
        return found
    if isinstance(constraint, KeepInHalfSpace):
        return {f"{name}: offset": abs(constraint.offset)}
    if isinstance(constraint, KeepInBox):
        # One far side may stand for none.
        sides = np.abs(constraint.limits[np.isfinite(constraint.limits)])
        return {f"{name}: its nearest side": float(sides[sides > 0.0].min(initial=np.inf)) if sides.any() else 0.0}
    return {}


def _ends(problem: OptimalControlProblem) -> Iterator[Finding]:
    """Goal configurations outside the joint limits, or that look like degrees."""
    robot = problem.scene.robot
    for term in _last(problem.cost):
        if not isinstance(term, TrackingCost) or not isinstance(term.reference, np.ndarray):
            continue
        end = term.reference
        if end.shape != (robot.dof,):
            continue
        if sentence := degrees_hint(robot, "the goal of the terminal TrackingCost", end):
            yield Finding("goal in degrees", sentence)
            continue
        for limits in problem.constraints:
            if not isinstance(limits, WithinJointLimits):
                continue
            beyond = np.maximum(end - limits.limits[1], limits.limits[0] - end)
            joint = int(np.argmax(beyond))
            if beyond[joint] > _SAME:
                yield Finding(
                    "goal outside constraints",
                    f"the terminal TrackingCost has its goal for {robot.joint_names[joint]} {beyond[joint]:.4g} "
                    f"{joint_unit(robot, joint)} outside {limits.label}, where the plan will not end",
                )


def _weights(problem: OptimalControlProblem) -> Iterator[Finding]:
    """Limits of joint torques that cannot hold the arm at rest where it starts, or where it is to end."""
    scene, names = problem.scene, problem.scene.robot.joint_names
    if not problem.limited or scene.constraints or not (scene.direct and scene.direct_efforts):
        return
    postures: list[tuple[str, Floats]] = [] if problem.v0.any() else [("the start", problem.q0)]
    for term in _last(problem.cost):
        end = term.reference if isinstance(term, TrackingCost) else None
        if isinstance(end, np.ndarray) and end.shape == problem.q0.shape:
            postures.append(("the goal of the terminal TrackingCost", end))
    for where, q in postures:
        needed, (lower, upper) = closest_controls(scene, q), problem.control_limits
        beyond = np.maximum(needed - upper, lower - needed)
        joint = int(np.argmax(beyond))
        if beyond[joint] > _SHARE_OF_WEIGHT * abs(needed[joint]):
            yield Finding(
                "limits below the weight",
                f"control limits cannot hold the arm at rest at {where}: joint {names[joint]!r} needs "
                f"{needed[joint]:.3g}, and its limits are {lower[joint]:.3g} and {upper[joint]:.3g}",
                joint=names[joint],
                value=float(needed[joint]),
            )


def _overlaps(problem: OptimalControlProblem, bound: BoundConstraint) -> Iterator[Finding]:
    """Pairs of bodies that are too close in all random postures."""
    constraint = bound.source
    if not isinstance(constraint, KeepClear):
        return
    robot = problem.scene.robot
    shares = np.random.default_rng(0).random((_POSTURES, robot.dof))
    low, high = _range(robot)
    q = low + shares * (high - low)
    q[0] = problem.q0
    missing = constraint.missing(q, bound.times[0])
    least = missing.min(axis=0)
    for pair in np.flatnonzero(least > 0.0):
        yield Finding(
            "pair always too close",
            f"KeepClear: {constraint.pairs[pair]} are too close by {least[pair]:.2g} m or more in each of {_POSTURES} "
            "postures. Use links= to leave one out, capsules= for a smaller capsule, or move the obstacle",
            value=float(least[pair]),
            unit="m",
        )


def _range(robot: Robot) -> tuple[Floats, Floats]:
    """Lower and upper bounds, (n,) each, of the random postures [rad or m]."""
    width = np.where(_turning(robot) > 0.0, 2.0 * np.pi, _RAIL)
    lower, upper = robot.position_limits
    below, above = np.abs(lower) < _ENDLESS, np.abs(upper) < _ENDLESS
    low = np.where(below, lower, np.where(above, upper, 0.0) - width)
    high = np.where(above, upper, np.where(below, lower, 0.0) + width)
    return low, high


def _turning(robot: Robot) -> Floats:
    """1 for coordinates of revolute joints (n,), 0 for those of prismatic joints."""
    turning = np.ones(robot.dof)
    turning[robot.tree.coordinate[np.flatnonzero(robot.tree.prismatic)]] = 0.0
    return turning


def _last(cost: Cost) -> Iterator[Cost]:
    """The terminal costs."""
    return (term for term in cost.terms if term.at_end)
