"""A simulated motion: a frozen record, saved as npz without pickle."""

from __future__ import annotations

import os
import reprlib
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from varpin._version import __version__
from varpin.arrays import Floats, Integers
from varpin.errors import FileError, InputError
from varpin.finding import Finding
from varpin.io.archive import Axes, read_npz, record_of, save_npz
from varpin.model import Robot, require_robot
from varpin.support.checks import count, path_like
from varpin.support.frozen import Frozen
from varpin.support.markup import facts, joint_table, warning_count

Bytes = NDArray[np.uint8]

FORMAT = "varpin.trajectory/2"
# Of the files of plans, which have a motion, too.
PLAN_FORMAT = "varpin.solution/5"

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class StepStatistics(Frozen):
    """Work and accuracy of the solution of each of N steps. Zeros where an integrator does not have the quantity.

    Attributes:
        newton_iterations: Newton iterations (N,).
        jets: Evaluations of the whole jet (N,).
        sweeps: Evaluations of its first derivatives alone, or of forward dynamics (N,).
        substeps: Number of parts of the step (N,); more than 1 where a guard refused the whole step, so that the map is
            not that of a single step.
        halvings: Halvings of dt in each part of the split steps (K,), step after step: a part lasts dt / 2**halvings.
            Steps that are not split have no entries.
        residual: Residual of the step equation (N,), in units of the rounding error of its terms.
        energy_defect: Accumulated error of the energy balance (N,) [J], summed over the mechanically independent groups
            of joints: the change of energy that is not the work of a force.
        branch_margin: Distance from the fold of the step equation's solutions (N,): 1 as dt -> 0, refused at 0.
    """

    newton_iterations: Annotated[Integers, Axes("steps")]
    jets: Annotated[Integers, Axes("steps")]
    sweeps: Annotated[Integers, Axes("steps")]
    substeps: Annotated[Integers, Axes("steps")]
    halvings: Annotated[Bytes, Axes("parts")]
    residual: Annotated[Floats, Axes("steps")]
    branch_margin: Annotated[Floats, Axes("steps")]
    energy_defect: Annotated[Floats, Axes("steps")]

    def __repr__(self) -> str:
        if not len(self.substeps):
            return "StepStatistics(no steps)"
        return (
            f"StepStatistics({len(self.substeps)} steps: {self.newton_iterations.mean():.2f} Newton iterations a step, "
            f"{self.split_steps} split, worst residual {self.residual.max():.3g}, "
            f"smallest branch margin {self.branch_margin.min():.3g})"
        )

    @property
    def split_steps(self) -> int:
        """Number of steps that were split into parts."""
        return int(np.count_nonzero(self.substeps > 1))

    @property
    def whole(self) -> bool:
        """Whether the parts of each split step fill it; explicit integrators count no parts."""
        parts = self.substeps[self.substeps > 1]
        if (self.substeps < self.substeps.any()).any() or parts.sum() != len(self.halvings):
            return False
        lengths = np.bincount(np.repeat(np.arange(len(parts)), parts), 0.5**self.halvings)
        return bool((lengths == 1.0).all())

    def part(self, begin: int, end: int) -> StepStatistics:
        """Statistics of the steps begin .. end, as views."""
        parts = np.append(0, np.cumsum(np.where(self.substeps > 1, self.substeps, 0)))
        numbers = {name: getattr(self, name)[begin:end] for name in STEP_NUMBERS}
        return StepStatistics(**numbers, halvings=self.halvings[parts[begin] : parts[end]])


# Statistics with one number for each step.
STEP_NUMBERS = tuple(item.name for item in fields(StepStatistics) if item.name != "halvings")


def _sealed(record: T) -> T:
    """The record or array itself, its arrays read-only."""
    for value in (record, *getattr(record, "__dict__", {}).values()):
        if isinstance(value, np.ndarray):
            value.setflags(write=False)
    return record


def joined(statistics: Sequence[StepStatistics]) -> StepStatistics:
    """Statistics of successive stretches of steps as one."""
    names = (item.name for item in fields(StepStatistics))
    return StepStatistics(**{name: np.concatenate([getattr(part, name) for part in statistics]) for name in names})


@dataclass(frozen=True)
class Accuracy:
    """Accuracy of a motion that was simulated with a tolerance, and the search for its integrator and step.

    Attributes:
        tolerance: The requested tolerance [rad or m].
        error: Estimated error in q, the largest over nodes and joints [rad or m].
        integrator: The selected integrator as text, for ``varpin.integrators.integrator_of``.
        dt: The selected time step [s].
        search_steps: Number of steps of all runs of the search.
        search_evaluations: Evaluations of forward dynamics or of the jet in these runs.
    """

    tolerance: float
    error: float
    integrator: str
    dt: float
    search_steps: int
    search_evaluations: int

    @property
    def met(self) -> bool:
        """Whether the estimate is within the tolerance."""
        return self.error <= self.tolerance

    def __str__(self) -> str:
        met = "within" if self.met else "not within"
        return (
            f"error {self.error:.1e}, {met} {self.tolerance:g}, by {self.integrator} at dt = {self.dt:.4g} s; "
            f"found in {self.search_steps} steps"
        )


@dataclass(frozen=True, eq=False)
class Nodes:
    """New nodes of a motion while it is computed, for a ``progress`` function of :func:`varpin.simulate`.

    Attributes:
        t: Times (k,) [s].
        q: Configurations (k, n) [rad or m].
        v: Velocities (k, n) [rad/s or m/s].
    """

    t: Floats
    q: Floats
    v: Floats


@dataclass(frozen=True, eq=False)
class Trajectory(Frozen):
    """A motion over N steps and N + 1 nodes.

    Attributes:
        t: Times (N + 1,) [s].
        q: Configurations (N + 1, n) [rad or m].
        v: Velocities (N + 1, n) [rad/s or m/s]; M(q)^-1 p for variational integrators.
        p: Momenta (N + 1, n) [N m s or N s].
        u: Controls (N, m): constant over each step, or their mean if they change within it.
        dw: Wiener increments (N, k) [s^0.5]; zeros where no noise was drawn. Where controls are linear between nodes
            and the strength of s of the processes depends on them, it is (N, k + s) with s increments dw' of the
            slopes: sqrt(12) / dt times the integral of (t - t_middle) dw over the step, independent of dw, N(0, dt).
        energy: Sum of kinetic and potential energy (N + 1,) [J]; springs included.
        masses: Masses of the robot's bodies (b,) [kg], to distinguish robots with the same joint names.
        dt: Time step [s].
        integrator: The integrator as text, with its options that are not the default, for
            ``varpin.integrators.integrator_of``.
        robot: The robot's name.
        joint_names: Names of the coordinates.
        statistics: Work and accuracy of each step.
        version: The version of varpin that computed it.
        warnings: What is doubtful about the motion, the worst first: strings of one sentence, with their numbers as
            attributes (:class:`varpin.Finding`).
        error: The estimated error of q at each node (N + 1, n) [rad or m]: the distance from a repetition of the motion
            by a method of more stages. NaN from where the repetition fails; None for a motion that was not checked. It
            is computed on first use where the record alone shows the motion right, see :attr:`error_bound`.
        error_bound: Four times the largest error that the record alone shows, to first order [rad or m]. Errors of 3 in
            100 such motions are larger, in fast chaotic ones up to 16 times. None for motions that were repeated.
        scene_values: Numbers of its scene, :attr:`varpin.Scene.values`.
        u_stages: Controls (N, s, m) at the stages of each step, if they change within it (:class:`varpin.OpenLoop` or
            :class:`varpin.FirstOrderHold` with a method of several stages); else (N, 0, m). The motion is that under
            the polynomial through them.
        u_nodes: Controls at the nodes (N + 1, m) of a policy or a plan with controls linear between them; (N + 1, 0)
            for other motions.
        accuracy: Estimated error and search for integrator and step, for a motion with a tolerance; None for others.
        constraint_forces: Mean force of each constraint row over each step (N, c) [N or N m]; the generalized force is
            dg/dq' times them. Redundant rows that were left out have zero force.
        constraint_labels: Name of the constraint of each row (c,), in words.
    """

    t: Annotated[Floats, Axes("nodes", finite=True)]
    q: Annotated[Floats, Axes("nodes", "joints", finite=True)]
    v: Annotated[Floats, Axes("nodes", "joints", finite=True)]
    p: Annotated[Floats, Axes("nodes", "joints")]
    u: Annotated[Floats, Axes("steps", "controls", finite=True)]
    dw: Annotated[Floats, Axes("steps", "processes", finite=True)]
    energy: Annotated[Floats, Axes("nodes")]
    masses: Annotated[Floats, Axes("bodies", finite=True)]
    dt: float
    integrator: str
    robot: str
    joint_names: tuple[str, ...]
    statistics: StepStatistics
    version: str = __version__
    warnings: tuple[Finding, ...] = ()
    scene_values: Mapping[str, Floats] = field(
        default_factory=lambda: MappingProxyType({}), repr=False, metadata={"entry": "scene"}
    )
    accuracy: Accuracy | None = field(default=None, repr=False)
    constraint_forces: Annotated[Floats, Axes("steps", "constraints", finite=True)] = field(
        default_factory=lambda: np.zeros((0, 0)), repr=False
    )
    constraint_labels: tuple[str, ...] = ()
    u_stages: Annotated[Floats, Axes("steps", "stages", "controls", finite=True)] = field(
        default_factory=lambda: np.zeros((0, 0, 0)), repr=False
    )
    u_nodes: Annotated[Floats, Axes("nodes", "lines", finite=True)] = field(
        default_factory=lambda: np.zeros((0, 0)), repr=False
    )
    # A factory leaves the class without the attribute, so that __getattr__ is asked for it.
    error: Annotated[Floats, Axes("nodes", "joints")] | None = field(default_factory=lambda: None, repr=False)
    error_bound: float | None = None

    def __getattr__(self, name: str) -> Any:
        """The error of a motion that is repeated only now: see :meth:`with_error`."""
        if name != "error":
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        repeat = vars(self).get("_repeat")
        # Another thread may have the error by now.
        found = vars(self).get("error") if repeat is None else _sealed(repeat())
        found = vars(self).setdefault("error", found)
        vars(self).pop("_repeat", None)
        return found

    def __getstate__(self) -> dict[str, Any]:
        _ = self.error
        return super().__getstate__()

    def with_error(self, error: Floats | Callable[[], Floats], bound: float | None = None) -> Trajectory:
        """The motion with its error (N + 1, n), or with a function that computes it on first use, and its bound."""
        if not callable(error):
            return self.changed(error=_sealed(error), error_bound=bound)
        made = self.changed(_repeat=error, error_bound=bound)
        vars(made).pop("error", None)
        return made

    def __post_init__(self) -> None:
        """Check shapes, on which readers rely; arrays that are left out have no columns."""
        N, n, c = max(np.size(self.t) - 1, 0), len(self.joint_names), len(self.constraint_labels)
        m, k, s = (np.shape(array)[1] if np.ndim(array) > 1 else 0 for array in (self.u, self.dw, self.u_stages))
        left_out = {"constraint_forces": (N, c), "u_stages": (N, s, m), "u_nodes": (N + 1, 0)}
        shapes: dict[str, Any] = {"t": (N + 1,), "energy": (N + 1,), "u": (N, m), "dw": (N, k)} | left_out
        shapes |= dict.fromkeys("qvp" if self.error is None else ("q", "v", "p", "error"), (N + 1, n))
        if np.size(self.u_nodes):
            shapes["u_nodes"] = (N + 1, m)
        for name, shape in shapes.items():
            if name in left_out and not np.size(getattr(self, name)):
                object.__setattr__(self, name, np.zeros(shape))
            array = getattr(self, name)
            if not isinstance(array, np.ndarray) or array.shape != shape or array.dtype != np.float64:
                raise InputError(f"a trajectory's {name} must be a float64 array {shape}, got {reprlib.repr(array)}")
        _sealed(self.statistics)
        _sealed(self)

    @property
    def steps(self) -> int:
        """N."""
        return len(self.t) - 1

    @property
    def noisy(self) -> bool:
        """Whether noise was drawn in some step."""
        return bool(self.dw.size) and bool(self.dw.any())

    @property
    def duration(self) -> float:
        """Time from the first node to the last [s]."""
        return float(self.t[-1] - self.t[0])

    def part(self, begin: int, end: int) -> Trajectory:
        """Steps begin .. end with the nodes around them, as views."""
        if not 0 <= count("begin", begin) <= count("end", end) <= self.steps:
            raise InputError(f"a part is from begin to end within {self.steps} steps, got {begin} and {end}")
        if begin == 0 and end == self.steps:
            return self
        nodes, steps = slice(begin, end + 1), slice(begin, end)
        part = replace(
            self,
            error=known[nodes] if isinstance(known := vars(self).get("error"), np.ndarray) else None,
            **{name: getattr(self, name)[nodes] for name in ("t", "q", "v", "p", "energy", "u_nodes")},
            u=self.u[steps],
            u_stages=self.u_stages[steps],
            dw=self.dw[steps],
            constraint_forces=self.constraint_forces[steps],
            statistics=self.statistics.part(begin, end),
        )
        pending = "_repeat" in vars(self)
        return part.with_error(lambda: np.array(self.error)[nodes], self.error_bound) if pending else part

    @property
    def error_text(self) -> str:
        """The largest error in words, ``"error 2e-06"`` or ``"error about 1e-03"`` [rad or m]; empty if not checked."""
        known = vars(self).get("error")
        if known is None:
            return "" if self.error_bound is None else f"error about {self.error_bound:.1g}"
        return f"error {known.max():.2g}" if np.isfinite(known).all() else "error unknown"

    def __repr__(self) -> str:
        split = self.statistics.split_steps
        flag = f", {split} {'step' if split == 1 else 'steps'} split by the guards" if split else ""
        reached = f", {self.error_text}" if self.error_text else ""
        return (
            f"Trajectory({self.robot}: {len(self.joint_names)} joints, {self.steps} steps of {self.dt:g} s, "
            f"{self.integrator}{flag}{reached}{warning_count(self.warnings)})"
        )

    @property
    def overview(self) -> list[tuple[str, object]]:
        """The motion as names and texts: its steps, its error and its energies."""
        change = self.energy - self.energy[0]
        kinetic = 0.5 * (self.p * self.v).sum(axis=1).max()
        rows: list[tuple[str, object]] = [("steps", f"{self.steps} of {self.dt:g} s, {self.duration:g} s in all")]
        if self.accuracy is not None:
            rows.append(("tolerance", str(self.accuracy)))
        elif self.error_text:
            rows.append(("estimated error in q", f"{self.error_text.removeprefix('error ')} rad or m"))
        if split := self.statistics.split_steps:
            most = self.statistics.substeps.max()
            text = f"{split} of {self.steps}, into up to {most} parts: a smaller dt keeps the structure"
            rows.append(("split steps", text))
        text = f"{change[-1]:+.3g} J from start to end, {np.abs(change).max():.3g} J at most in between"
        return [*rows, ("energy change", text), ("kinetic energy", f"up to {kinetic:.3g} J")]

    def _repr_html_(self) -> str:
        warnings = [("warning", warning) for warning in self.warnings]
        rows = [("integrator", self.integrator), *self.overview, *warnings]
        columns = {"q at first [rad or m]": self.q[0], "in the end": self.q[-1]}
        columns |= {"least": self.q.min(axis=0), "most": self.q.max(axis=0)}
        columns |= {"fastest [1/s]": np.abs(self.v).max(axis=0)}
        return facts(f"Trajectory of {self.robot}", rows, joint_table(self.joint_names, columns))

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the trajectory as a compressed npz file without pickle; returns its path.

        An existing file is replaced only when the new one is complete.

        Raises:
            FileError: The path cannot be written.
        """
        return save_npz(path, FORMAT, self)

    @classmethod
    def load(cls, path: str | os.PathLike[str], robot: Robot | None = None) -> Trajectory:
        """Read a trajectory that :meth:`save` wrote, or that of a plan that :meth:`Solution.save` wrote.

        Args:
            path: The npz file.
            robot: If given, the trajectory must be of a robot with the same joints.

        Raises:
            FileError: The file is missing, truncated, not npz or not a trajectory; it has pickled objects, inconsistent
                arrays or a state that is not finite; or it is of another robot. Energies and statistics may be infinite
                or NaN, as in the saved motion.
        """
        source = path_like("path", path)
        if robot is not None:
            require_robot(robot)
        return cls.of_members(source, read_npz(source, FORMAT, PLAN_FORMAT), robot)

    @classmethod
    def of_members(cls, source: Path, members: Mapping[str, Any], robot: Robot | None) -> Trajectory:
        """The trajectory from the entries of the file ``source``; errors as :meth:`load`."""
        found = record_of(cls, members, source)
        # Energies and momenta overflow before q and v do; they may then be infinite.
        if not np.isfinite(found.p[np.isfinite(found.energy)]).all():
            raise FileError(f"{source}: p holds values that are not finite numbers")
        expected = found.t[0] + np.arange(found.steps + 1) * found.dt
        if not found.dt > 0.0 or not np.allclose(found.t, expected, rtol=1e-9, atol=1e-9 * found.dt):
            raise FileError(f"{source}: its times t are not dt = {found.dt} s apart")
        if not found.statistics.whole:
            raise FileError(f"{source}: statistics.substeps and statistics.halvings are not those of whole steps")
        if robot is None:
            return found
        if found.joint_names != robot.joint_names:
            raise FileError(
                f"{source} is of robot {found.robot} with joints {', '.join(found.joint_names)}; "
                f"{robot.name!r} has joints {', '.join(robot.joint_names)}: give its own robot, for varpin replay as "
                "--robot"
            )
        masses = robot.tree.mass
        if found.masses.shape != masses.shape or not np.allclose(found.masses, masses, rtol=1e-6):
            raise FileError(
                f"{source} is of robot {found.robot}, whose links weigh {found.masses.sum():.6g} kg, and those of "
                f"{robot.name!r} {masses.sum():.6g} kg: load the robot with its payloads, for varpin replay by a scene "
                "file as --robot"
            )
        return found


def require_trajectory(motion: object) -> Trajectory:
    """``motion`` itself; an InputError if it is no Trajectory, which names that of a plan or a controller's run."""
    if isinstance(motion, Trajectory):
        return motion
    own = next((name for name in ("trajectory", "motion") if isinstance(getattr(motion, name, None), Trajectory)), None)
    hint = f"; give its .{own}" if own else ""
    raise InputError(f"the motion must be a varpin.Trajectory, got {type(motion).__name__}{hint}")


def kinematic_input_rows(trajectory: Trajectory) -> Integers:
    """Rows (joint, joint, rate) of a record's ties that are kinematic inputs: joints tied to themselves."""
    ties = scene_indices(trajectory, "constraints.ties", 3)
    return np.asarray(ties[ties[:, 0] == ties[:, 1]], dtype=np.int64)


def scene_indices(trajectory: Trajectory, kind: str, columns: int) -> Integers:
    """The indices (K, columns) with which a record's rows of a kind begin; a file may have other numbers there."""
    rows = trajectory.scene_values.get(kind, np.zeros(0))
    found = rows[:, :columns] if rows.ndim == 2 and rows.shape[1] >= columns else np.zeros((0, columns))
    indices: Integers = found[(np.abs(found) < sys.maxsize).all(axis=1)].astype(np.int64)
    return indices
