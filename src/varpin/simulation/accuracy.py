"""When a motion is wrong: the units of its errors, their thresholds, and the windows in which they are judged.

:mod:`varpin.simulation.soundness` estimates the errors by smaller steps, :mod:`varpin.study.extremes` by exact motions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats, Integers
from varpin.mechanics.scene import Scene
from varpin.model import longest_reach
from varpin.trajectory import Trajectory

# Thresholds of errors. Energy balance: share of the energy turned over. Position: share of the joint's travel over a
# period (the range that q covers), and of the largest joint travel of its kind. Velocity: share of the joint's
# largest, with a larger threshold, for a small shift in time changes a peak of the velocity by much.
WRONG_ENERGY = 0.1
WRONG_POSITION, WRONG_MOTION, WRONG_VELOCITY = 0.1, 0.05, 0.25
# Most steps of the window at the start, and of each other window.
FIRST, WINDOW = 384, 64
# Nodes on either side of a window's first node within which a joint's period is looked for.
HORIZON = 1024
# Number of other windows: where velocities change most, and spread over the motion.
VIOLENT, _SPREAD = 4, 3
# Number of windows at single steps with the largest change of the energy defect.
_JUMPS = 2
# Error from which on more windows are examined, in units of its threshold; and the number of these windows.
CLOSE, _BETWEEN = 0.4, 15
# Steps after which a start is judged by the travel so far. Before that a method of first order lags by half a step.
_SOON = (80, 160)
# Growth of a disturbance from which on a motion counts as unpredictable; and the disturbance, relative to q and v.
PREDICTABLE, DISTURBANCE = 10.0, 1e-7
# A joint's errors are measured in units of its own motion. For a joint that hardly moves, the unit is at least the
# smaller of two: LITTLE times the largest travel or speed among joints of its kind, and LIGHT times the speed at which
# the joint would have their energy.
LITTLE, LIGHT = 1e-2, 1e-2
# Least unit of a joint's errors in one window, as a share of its motion up to there.
_REST = 1e-3
# Accumulated rounding, relative to positions and velocities.
ROUNDING = 1e3 * float(np.finfo(np.float64).eps)
# Least change of a speed, as a share of it, for joints at constant speed.
EVEN = 1e-3


@dataclass(frozen=True)
class MotionError:
    """The largest error of a motion over all joints and windows.

    Attributes:
        step: First node of the window.
        joint: The coordinate.
        position: Error of q there over a period, as a share of the joint's travel over it.
        velocity: Error of v, in units of the joint's largest.
        motion: Error of q, as a share of the joint's scale, see :func:`scales`.
        settled: Whether the estimate is accurate to about a tenth; else only to a factor of two.
    """

    step: int
    joint: int
    position: float
    velocity: float
    motion: float
    settled: bool = True

    @property
    def worst(self) -> float:
        """The largest error, in units of its threshold; infinite where one is NaN."""
        shares = self.position / WRONG_POSITION, self.velocity / WRONG_VELOCITY, self.motion / WRONG_MOTION
        return math.inf if any(map(math.isnan, shares)) else max(shares)


@dataclass(frozen=True)
class Window:
    """A part of a motion in which its error is judged.

    Attributes:
        step: The first node.
        span: Number of steps in which each joint oscillates one and a half times, or makes a full turn (n,); under
            noise at least ``WINDOW``.
        whole: Whether it does so; else ``span`` is the number of all steps (n,).
        judged: Number of steps in which errors count (n,): a period.
        varied: Total variation of v after each step (K, n).
    """

    step: int
    span: Integers
    whole: NDArray[np.bool_]
    judged: Integers
    varied: Floats

    @classmethod
    def at(cls, scene: Scene, trajectory: Trajectory, step: int) -> Window:
        """The window that begins at a node."""
        ahead = slice(step, step + HORIZON + 1)
        q, v = trajectory.q[ahead], trajectory.v[ahead]
        span, whole = _periods(scene, q, v)
        # A period is two thirds of the span.
        judged = np.where(whole, (2 * span + 2) // 3, span)
        if trajectory.dw.any():
            # What the noise does from step to step is no oscillation.
            least = min(WINDOW, len(q) - 1)
            span, judged = np.maximum(span, least), np.maximum(judged, least)
        return cls(step, span, whole, judged, np.abs(np.diff(v, axis=0)).cumsum(axis=0))

    def units(self, scene: Scene, trajectory: Trajectory, inertia: Floats) -> Floats:
        """Units of the errors of q and v here (2, n)."""
        return np.array(_units(scene, trajectory, self.step, self.span, self.whole, inertia))

    def error(
        self, scene: Scene, trajectory: Trajectory, inertia: Floats, off: tuple[Floats, Floats], *, cut: bool
    ) -> MotionError:
        """The error in this window, from the distances of q and v from the right motion (K + 1, n), NaN if not known.

        ``cut`` if the right motion is unpredictable beyond K steps; else the error is extrapolated to a period in
        proportion to the variation of v. At the start of the motion the first steps are judged by themselves as well,
        for a motion that soon dies out.
        """
        count = len(off[0]) - 1
        soon = [until for until in _SOON if until < count] if self.step == 0 else []
        found = [self._until(scene, trajectory, inertia, off, until, cut=True) for until in soon]
        found.append(self._until(scene, trajectory, inertia, off, count, cut=cut))
        return max(found, key=lambda error: error.worst)

    def _until(
        self,
        scene: Scene,
        trajectory: Trajectory,
        inertia: Floats,
        off: tuple[Floats, Floats],
        until: int,
        *,
        cut: bool,
    ) -> MotionError:
        """:meth:`error` from the first ``until`` steps."""
        here = np.minimum(self.judged, until)
        # Unpredictable steps are no part of the travel.
        end = np.minimum(self.span, until) if cut else self.span
        travel, speed = _units(scene, trajectory, self.step, end, self.whole | (end < self.span), inertia)
        joints = np.arange(len(here))
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            far, fast = (np.maximum.accumulate(part, axis=0)[here, joints] for part in off)
            so_far = self.varied[here - 1, joints]
            growth = np.where(so_far > 0.0, self.varied[self.judged - 1, joints] / so_far, np.inf)
            growth = np.maximum(np.minimum(growth, self.judged / here), 1.0)
            rounding = ROUNDING * (1.0 + np.abs(trajectory.q[self.step]).max())
            position = np.where(far <= rounding, 0.0, far * (1.0 if cut else growth) / travel)
            # Rounding of the largest momentum goes into the velocities of joints at rest.
            root = np.sqrt(inertia)
            fastest = np.abs(trajectory.v[self.step : self.step + until + 1]).max(axis=0)
            rounding = np.maximum(rounding / (trajectory.dt * here), ROUNDING * (root * fastest).max() / root)
            velocity = np.where(fast <= np.maximum(rounding, 1e-9 * speed), 0.0, fast / speed)
            motion = position * travel / scales(scene, travel)
            shares = np.array([position / WRONG_POSITION, velocity / WRONG_VELOCITY, motion / WRONG_MOTION])
        joint = int(np.argmax(np.where(np.isnan(shares), np.inf, shares).max(axis=0)))
        return MotionError(self.step, joint, float(position[joint]), float(velocity[joint]), float(motion[joint]))


def grown(plain: Floats, disturbed: Floats, disturbance: float) -> int:
    """Steps, one at least, until the distance of two motions' q (K + 1, n) is ``PREDICTABLE`` times the disturbance."""
    with np.errstate(over="ignore", invalid="ignore"):
        apart = ~(np.abs(disturbed - plain).max(axis=1) <= PREDICTABLE * disturbance)
    return max(1, int(apart.argmax())) if apart.any() else len(plain) - 1


def disturbance(trajectory: Trajectory, step: int, count: int) -> tuple[float, float]:
    """The disturbance of q and of v at a node with which the motion after it is tested for predictability."""
    nodes = trajectory.q[step : step + count + 1]
    shift = DISTURBANCE * max(1.0, float(np.abs(trajectory.q[step]).max()))
    # In v, relative to the velocities of the same steps.
    travel = max(float(np.ptp(nodes, axis=0).max()), shift)
    return shift, DISTURBANCE * float(np.abs(trajectory.v[step : step + count + 1]).max()) / max(1.0, travel)


def examined_nodes(scene: Scene, trajectory: Trajectory) -> Integers:
    """First nodes of the windows in which a motion is examined (K,).

    They are the start, the nodes where velocities change most, some spread over the motion, and the steps with the
    largest changes of the energy defect.
    """
    # The first window covers one period of the fastest joint.
    v, steps = trajectory.v, trajectory.steps
    seen = np.zeros(steps, dtype=bool)
    seen[: min(FIRST, int(Window.at(scene, trajectory, 0).judged.min()))] = True
    found = [0, *violent_windows(v, WINDOW, seen)]
    for node in np.linspace(0, max(0, steps - WINDOW), _SPREAD + 1)[1:].astype(np.int64):
        if not seen[node : node + WINDOW].all():
            found.append(int(node))
    # Single steps that are worse than others, such as an undivided one among divided ones.
    jumps = np.abs(np.diff(trajectory.statistics.energy_defect, prepend=0.0))
    found += np.argsort(-np.nan_to_num(jumps, nan=np.inf), kind="stable")[:_JUMPS].tolist()
    return np.unique(found)


def nodes_between(steps: int, seen: Integers) -> Integers:
    """More first nodes of windows, evenly spread, for errors close to their thresholds.

    The middle node comes first, then the middle nodes of both halves, and so on.
    """
    nodes = np.linspace(0, steps, _BETWEEN + 2)[1:-1].astype(np.int64)
    order = [k for part in (8, 4, 2, 1) for k in range(part, _BETWEEN + 1, 2 * part)]
    found = nodes[np.array(order) - 1]
    return np.array([node for node in dict.fromkeys(found.tolist()) if node not in seen], dtype=np.int64)


def violent_windows(v: Floats, length: int, seen: NDArray[np.bool_] | None = None) -> list[int]:
    """The first steps of windows about the largest changes of v (N + 1, n); the windows are marked as seen."""
    steps = len(v) - 1
    seen = np.zeros(steps, dtype=bool) if seen is None else seen
    change = np.abs(np.diff(v, axis=0))
    most = change.max(axis=0)
    # Changes of each joint, in units of its largest one.
    change = ((change / np.where(most > 0.0, most, np.inf)) ** 2).sum(axis=1)
    found: list[int] = []
    for _ in range(VIOLENT):
        if seen.all():
            break
        peak = int(np.argmax(np.where(seen, -1.0, change)))
        found.append(min(max(0, peak - length // 4), max(0, steps - length)))
        seen[found[-1] : found[-1] + length] = True
    return found


def inertias(scene: Scene, q: Floats) -> Floats:
    """The largest diagonal entry of M for each joint (n,), over configurations (K, n)."""
    largest: Floats = np.diagonal(masses(scene, q), axis1=1, axis2=2).max(axis=0)
    return largest


def masses(scene: Scene, q: Floats) -> Floats:
    """M (K, n, n) at configurations (K, n)."""
    q = np.ascontiguousarray(q)
    return scene.core.jets(q, np.zeros_like(q))[0]


def velocity_change(v: Floats) -> Floats:
    """The change of velocities over the nodes (K, ...): the range they cover, at most the largest speed."""
    fastest = np.abs(v).max(axis=0)
    change: Floats = np.clip(np.ptp(v, axis=0), EVEN * fastest, fastest)
    return change


def error_units(scene: Scene, travel: Floats, speed: Floats, light: Floats, duration: Floats) -> tuple[Floats, Floats]:
    """Units of errors (..., n): travels and largest velocities, bounded from below by those of the other joints.

    ``light`` are the velocities of :func:`light_joint_speed` (..., n), ``duration`` is the time of the judgement [s].
    """
    least = np.minimum(LITTLE * largest_of_its_kind(scene, speed), light)
    least_travel = np.minimum(LITTLE * largest_of_its_kind(scene, travel), light * duration)
    return np.maximum(travel, least_travel), np.maximum(speed, least)


def light_joint_speed(inertia: Floats, change: Floats) -> Floats:
    """``LIGHT`` times the velocity at which each joint has the energy of the largest change (..., n)."""
    root = np.sqrt(inertia)
    light: Floats = LIGHT * (root * change).max(axis=-1, keepdims=True) / root
    return light


def largest_of_its_kind(scene: Scene, values: Floats) -> Floats:
    """For each coordinate (..., n), the largest value of all revolute joints, or of all prismatic ones."""
    sliding = scene.robot.slides
    largest = [values[..., kind].max(axis=-1, initial=0.0, keepdims=True) for kind in (sliding, ~sliding)]
    each: Floats = np.where(sliding, *largest)
    return each


def travel_scales(scene: Scene, q: Floats) -> Floats:
    """:func:`scales` of the travels over nodes (K, n)."""
    return scales(scene, np.ptp(q, axis=0))


def scales(scene: Scene, travel: Floats) -> Floats:
    """For each coordinate (n,), the travel of which errors are shares: the largest of its kind among travels (n,).

    Joints of one kind that hardly move are compared with the others: their scale is at least ``LITTLE`` times what
    those move at the robot's reach.
    """
    travel = largest_of_its_kind(scene, travel)
    sliding = scene.robot.slides
    if sliding.all() or not sliding.any():
        return travel
    reach = longest_reach(scene.robot)
    # On rails without ends: a metre.
    lever = reach if 0.0 < reach < np.inf else 1.0
    turns, slides = float(travel[~sliding].max()), float(travel[sliding].max())
    least = LITTLE * np.where(sliding, turns * lever, slides / lever)
    return np.maximum(travel, least)


def _periods(scene: Scene, q: Floats, v: Floats) -> tuple[Integers, NDArray[np.bool_]]:
    """Number of steps in which each joint oscillates one and a half times, or makes a full turn (n,).

    The number of all steps where it does neither; the second value is True where it does. One and a half oscillations
    are three times the range of q and four times the largest speed in total variation, so that a single turning point,
    where the velocity is small, does not count as one.

    Args:
        scene: The scene.
        q: Configurations (K + 1, n).
        v: Velocities (K + 1, n).
    """
    gone = np.abs(np.diff(q, axis=0)).cumsum(axis=0)
    wide = (np.maximum.accumulate(q, axis=0) - np.minimum.accumulate(q, axis=0))[1:]
    varied = np.abs(np.diff(v, axis=0)).cumsum(axis=0)
    fastest = np.maximum.accumulate(np.abs(v), axis=0)[1:]
    round_once = ~scene.robot.slides & (wide >= 2.0 * np.pi)
    over = ((gone >= 3.0 * wide) | round_once) & (varied >= 4.0 * fastest) & (wide > 0.0)
    whole = np.asarray(over.any(axis=0))
    span: Integers = np.where(whole, over.argmax(axis=0) + 1, len(q) - 1)
    return span, whole


def _units(
    scene: Scene, trajectory: Trajectory, step: int, span: Integers, whole: NDArray[np.bool_], inertia: Floats
) -> tuple[Floats, Floats]:
    """Units of each joint's errors of q and v (n,): its travel over a period, and its largest velocity."""
    n = len(span)
    before = np.zeros(n, dtype=np.int64)
    if step:
        behind = slice(max(0, step - HORIZON), step + 1)
        before = _periods(scene, trajectory.q[behind][::-1], trajectory.v[behind][::-1])[0]
    # Where the motion ends within a period, the steps before complete it.
    begin = step - np.where(whole, 0, before)
    travel, speed, change = np.empty(n), np.empty(n), np.empty(n)
    end = step + span + 1
    # Joints with the same nodes together: all of them in short motions.
    for first, last in set(zip(begin.tolist(), end.tolist(), strict=True)):
        alike = (begin == first) & (end == last)
        q, v = trajectory.q[:last, alike], trajectory.v[:last, alike]
        travel[alike] = np.maximum(np.ptp(q[first:], axis=0), _REST * np.ptp(q, axis=0))
        speed[alike] = np.maximum(np.abs(v[first:]).max(axis=0), _REST * np.abs(v).max(axis=0))
        change[alike] = velocity_change(v[first:])
    travel, speed = error_units(
        scene, travel, speed, light_joint_speed(inertia, change), trajectory.dt * span.astype(np.float64)
    )
    tiny = np.finfo(np.float64).tiny
    return np.maximum(travel, tiny), np.maximum(speed, tiny)
