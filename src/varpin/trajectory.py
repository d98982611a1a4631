"""A simulated motion: a frozen record, saved as npz without pickle."""

from __future__ import annotations

import contextlib
import os
import reprlib
import secrets
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from varpin._version import __version__
from varpin.errors import FileError, InputError
from varpin.io.archive import Check, Header, read_npz
from varpin.mechanics.scene import OF_FORCES, VALUES, Scene, differences, same
from varpin.model import Robot
from varpin.support.checks import path_like, writable
from varpin.support.frozen import Frozen
from varpin.support.markup import facts, said, table

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Bytes = NDArray[np.uint8]

FORMAT = "varpin.trajectory/2"

_ARRAYS = ("t", "q", "v", "p", "u", "dw", "energy", "masses")
_TEXTS = ("version", "integrator", "robot", "joint_names", "warnings")
_AT_A_TIME = 1_000_000  # parts of steps
# Before the names of the scene's values in a file.
_SCENE = "scene."
_MOST_WORDS = 1_000_000  # bytes of what does not grow with the steps
_KINDS = {f"statistics.{name}": "int64" for name in ("newton_iterations", "jets", "sweeps", "substeps")}
_KINDS["statistics.halvings"] = "uint8"


@dataclass(frozen=True, eq=False)
class StepStatistics(Frozen):
    """What each of N steps took, and how sound its solution is. Zeros where an integrator has no such thing.

    Attributes:
        newton_iterations: (N,).
        jets: Evaluations of the whole jet (N,).
        sweeps: Evaluations of its first derivatives alone, or of forward dynamics (N,).
        substeps: Parts the step was taken in (N,); more than 1 where a guard refused the whole step, and there the
            map is not the integrator's own.
        halvings: Of dt in each part of the steps taken in more than one (K,), step after step: a part is
            dt / 2**halvings long. Nothing is kept of the other steps.
        residual: Residual of the step equation (N,), in units of the rounding error of its terms.
        energy_defect: Errors of the energy balances so far (N,) [J], added up over the mechanically independent groups
            of joints: what the energy is off by, of what no force accounts for.
        branch_margin: Distance from the fold of the step equation's solutions (N,): 1 as dt -> 0, refused at 0.
    """

    newton_iterations: Integers
    jets: Integers
    sweeps: Integers
    substeps: Integers
    halvings: Bytes
    residual: Floats
    branch_margin: Floats
    energy_defect: Floats

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
        """How many steps were taken in more than one part."""
        return int((self.substeps > 1).sum())

    def part(self, begin: int, end: int) -> StepStatistics:
        """Of the steps begin .. end, as views."""
        first, last = (_parts_in(self.substeps[:place]) for place in (begin, end))
        own = {name: getattr(self, name)[begin:end] for name in STEP_NUMBERS}
        return StepStatistics(**own, halvings=self.halvings[first:last])

    def damage(self) -> str | None:
        """What is wrong with a record of parts that no motion has, in words."""
        counts, halvings = self.substeps[self.substeps > 1], self.halvings
        if counts.size and counts.max() > 1 << MOST_HALVINGS:
            return "statistics.substeps holds numbers of parts that no step has"
        fits = counts.sum() == halvings.size and (
            not halvings.size or (halvings.min() >= 1 and halvings.max() <= MOST_HALVINGS and _add_up(counts, halvings))
        )
        return None if fits else "statistics.halvings does not hold the parts that statistics.substeps counts"


# What statistics hold one number of for each step.
STEP_NUMBERS = tuple(item.name for item in fields(StepStatistics) if item.name != "halvings")
# A step is never halved more often.
MOST_HALVINGS = 30


def _parts_in(substeps: Integers) -> int:
    """How many parts the steps have together that were not taken whole."""
    return int(substeps[substeps > 1].sum())


def _add_up(counts: Integers, halvings: Bytes) -> bool:
    """Whether the parts of every step make a whole one; takes little memory, whatever a file holds."""
    units = 1 << (MOST_HALVINGS - np.arange(MOST_HALVINGS + 1))
    ends, done = np.cumsum(counts), 0
    for begin in range(0, halvings.size, _AT_A_TIME):
        sums = done + np.cumsum(units[halvings[begin : begin + _AT_A_TIME]])
        first, last = np.searchsorted(ends, [begin, begin + len(sums)], side="right")
        if not np.array_equal(sums[ends[first:last] - 1 - begin], np.arange(first + 1, last + 1) << MOST_HALVINGS):
            return False
        done = int(sums[-1])
    return True


def joined(statistics: Sequence[StepStatistics]) -> StepStatistics:
    """Of steps that follow each other."""
    names = (item.name for item in fields(StepStatistics))
    return StepStatistics(**{name: np.concatenate([getattr(own, name) for own in statistics]) for name in names})


@dataclass(frozen=True)
class Accuracy:
    """How a motion came by its integrator and step where it was asked for with a tolerance, and what it is good for.

    It is a tolerance itself: ``simulate(..., tolerance=trajectory.accuracy)`` begins with this integrator and step.

    Attributes:
        tolerance: What was asked for [rad or m].
        error: The estimate of what was reached: in q, the largest over nodes and joints [rad or m].
        integrator: What was taken, as text; ``varpin.integrators.integrator_of`` makes it again.
        dt: The step that was taken [s].
        search_steps: Steps of all the runs that finding out took.
        search_evaluations: Evaluations of forward dynamics or of the jet in them.
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


# Numbers of an accuracy in a file, beside what the trajectory has itself.
_ACCURACY = ("tolerance", "error", "search_steps", "search_evaluations")


@dataclass(frozen=True, eq=False)
class Trajectory(Frozen):
    """A motion over N steps and N + 1 nodes.

    Attributes:
        t: Times (N + 1,) [s].
        q: Configurations (N + 1, n) [rad or m].
        v: Velocities (N + 1, n) [rad/s or m/s]; M(q)^-1 p for variational integrators.
        p: Momenta (N + 1, n) [N m s or N s].
        u: Controls (N, m), constant over each step.
        dw: Wiener increments (N, k) [s^0.5]; zeros where no noise was drawn.
        energy: Kinetic and potential energy together (N + 1,) [J]; springs included.
        masses: Of the robot's bodies (b,) [kg]; they tell robots apart whose joints have the same names.
        dt: Time step [s].
        integrator: What made it, as text with all options that are not the default;
            ``varpin.integrators.integrator_of`` makes it again.
        robot: The robot's name.
        joint_names: Names of the coordinates.
        statistics: What each step took.
        version: The varpin that made it.
        warnings: What varpin said of the motion, a sentence each: dt too coarse, energy off, steps taken in parts.
        scene_values: Numbers of the scene it was made in, :attr:`varpin.Scene.values`; empty in files that varpin wrote
            before it kept them.
        accuracy: The estimated error, and what finding integrator and step took, of a motion that was asked for with a
            tolerance; None of others.
    """

    t: Floats
    q: Floats
    v: Floats
    p: Floats
    u: Floats
    dw: Floats
    energy: Floats
    masses: Floats
    dt: float
    integrator: str
    robot: str
    joint_names: tuple[str, ...]
    statistics: StepStatistics
    version: str = __version__
    warnings: tuple[str, ...] = ()
    scene_values: Mapping[str, Floats] = field(default_factory=lambda: MappingProxyType({}), repr=False)
    accuracy: Accuracy | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        nodes, n = np.size(self.t), len(self.joint_names)
        # Whoever reads a record relies on its shapes.
        for name, lead in {"t": nodes, "energy": nodes, "q": nodes, "v": nodes, "p": nodes}.items():
            self._require(name, (lead, n) if name in "qvp" else (lead,))
        for name in ("u", "dw"):
            self._require(name, (nodes - 1, *np.shape(getattr(self, name))[1:2]))
        if nodes < 1 or self.u.ndim != 2 or self.dw.ndim != 2:
            raise InputError("a trajectory has one node or more, and controls and increments (N, ...)")
        for name in _ARRAYS:
            getattr(self, name).setflags(write=False)
        for array in vars(self.statistics).values():
            array.setflags(write=False)

    def _require(self, name: str, shape: tuple[int, ...]) -> None:
        array = getattr(self, name)
        if not isinstance(array, np.ndarray) or array.shape != shape or array.dtype != np.float64:
            raise InputError(f"a trajectory's {name} must be a float64 array {shape}, got {reprlib.repr(array)}")

    @property
    def steps(self) -> int:
        """N."""
        return len(self.t) - 1

    @property
    def duration(self) -> float:
        """Time from the first node to the last [s]."""
        return float(self.t[-1] - self.t[0])

    def part(self, begin: int, end: int) -> Trajectory:
        """Steps begin .. end with the nodes around them, as views."""
        if begin == 0 and end == self.steps:
            return self
        nodes, steps = slice(begin, end + 1), slice(begin, end)
        return replace(
            self,
            **{name: getattr(self, name)[nodes] for name in ("t", "q", "v", "p", "energy")},
            u=self.u[steps],
            dw=self.dw[steps],
            statistics=self.statistics.part(begin, end),
        )

    def __repr__(self) -> str:
        split = self.statistics.split_steps
        flag = f", {split} steps split by the guards" if split else ""
        reached = f", estimated error {self.accuracy.error:.1e}" if self.accuracy is not None else ""
        return (
            f"Trajectory({self.robot}: {len(self.joint_names)} joints, {self.steps} steps of {self.dt:g} s, "
            f"{self.integrator}{flag}{reached}{said(self.warnings)})"
        )

    def _repr_html_(self) -> str:
        own = self.statistics
        rows: list[tuple[str, object]] = [
            ("steps", f"{self.steps} of {self.dt:g} s, {self.duration:g} s in all"),
            ("integrator", self.integrator),
            ("energy [J]", f"{self.energy[0]:.6g} at first, {self.energy[-1]:.6g} in the end"),
            ("energy's largest change [J]", f"{np.abs(self.energy - self.energy[0]).max():.3g}"),
        ]
        if self.accuracy is not None:
            rows.append(("estimated error in q [rad or m]", f"{self.accuracy.error:.2g}"))
        if own.energy_defect.any():
            rows.append(("of it, what no force accounts for [J]", f"{np.abs(own.energy_defect).max():.3g}"))
        if own.newton_iterations.any():
            rows.append(("Newton iterations", f"{own.newton_iterations.mean():.2f} a step"))
        if own.split_steps:
            rows.append(("split by the guards", f"{own.split_steps} steps"))
        rows += [("warning", warning) for warning in self.warnings]
        ends = zip(self.joint_names, self.q[0], self.q[-1], self.q.min(axis=0), self.q.max(axis=0), strict=True)
        speeds = np.abs(self.v).max(axis=0)
        joints = [(name, *map(float, row), float(speed)) for (name, *row), speed in zip(ends, speeds, strict=True)]
        head = ("joint", "q at first [rad or m]", "in the end", "least", "most", "fastest [1/s]")
        return facts(f"Trajectory of {self.robot}", rows, table(head, joints))

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the trajectory as a compressed npz file without pickle; returns its path.

        A file that is there is replaced only once the new one is whole.

        Raises:
            FileError: The path cannot be written.
        """
        with atomic_file(path) as stream:
            np.savez_compressed(stream, **self.members(), format=FORMAT)
        return Path(path)

    def members(self) -> dict[str, Any]:
        """What an npz file holds of it, by name."""
        members: dict[str, Any] = {name: getattr(self, name) for name in _ARRAYS}
        members |= {f"statistics.{item.name}": getattr(self.statistics, item.name) for item in fields(StepStatistics)}
        members |= {"version": self.version, "integrator": self.integrator, "robot": self.robot}
        members |= {"warnings": np.array(self.warnings, dtype=str)}
        members |= {f"{_SCENE}{name}": values for name, values in self.scene_values.items()}
        if self.accuracy is not None:
            members["accuracy"] = np.array([getattr(self.accuracy, name) for name in _ACCURACY], dtype=np.float64)
        return members | {"dt": self.dt, "joint_names": np.array(self.joint_names, dtype=str)}

    @classmethod
    def load(cls, path: str | os.PathLike[str], robot: Robot | None = None) -> Trajectory:
        """Read a trajectory that :meth:`save` wrote.

        Args:
            path: The npz file.
            robot: If given, the trajectory must be of a robot with the same joints.

        Raises:
            FileError: The file is missing, truncated, no npz, written by something else, holds pickled objects,
                arrays that do not fit together, a state that is not finite, or is of another robot. Energies and
                statistics may be infinite or NaN, where the motion's own were.
        """
        source = path_like("path", path)
        if robot is not None and not isinstance(robot, Robot):
            raise InputError(f"robot must come from load_robot, got {type(robot).__name__}")
        members = read_members(
            source, FORMAT, MEMBERS, optional=OPTIONAL, check=lambda headers: require_layout(source, headers)
        )
        return cls.of_members(source, members, robot)

    @classmethod
    def of_members(cls, source: Path, members: Mapping[str, NDArray[Any]], robot: Robot | None) -> Trajectory:
        """The trajectory that members of the file ``source`` describe, by the names that :meth:`members` gives.

        Raises:
            FileError: As for :meth:`load`.
        """
        require_layout(source, members)
        steps = members["t"].size - 1
        # Energies, momenta with them, and what is said of steps overflow before q and v do, and are saved as they are.
        held = np.isfinite(members["energy"])
        given = {name: members[name] for name in ("t", "q", "v", "u", "dw", "masses", "dt")} | {"p": members["p"][held]}
        kept = {name: members[_SCENE + name] for name in VALUES if _SCENE + name in members}
        # A noise without a center of its own has NaN there, a stop of one end an infinite other one.
        endless = {"noise.center", *OF_FORCES}
        given |= {_SCENE + name: values for name, values in kept.items() if name not in endless}
        for name, values in given.items():
            if not np.isfinite(values).all():
                raise FileError(f"{source}: {name} holds values that are not finite numbers")
        if steps < 0 or not members["dt"] > 0.0:
            raise FileError(f"{source}: it has {steps + 1} nodes and dt = {members['dt']} s")
        expected = members["t"][0] + np.arange(steps + 1) * members["dt"]
        if not np.allclose(members["t"], expected, rtol=1e-9, atol=1e-9 * float(members["dt"])):
            raise FileError(f"{source}: its times t are not dt = {members['dt']} s apart")
        names = tuple(str(name) for name in members["joint_names"])
        if robot is not None and names != robot.joint_names:
            raise FileError(
                f"{source} is of robot {members['robot']!s} with joints {', '.join(names)}; "
                f"{robot.name!r} has joints {', '.join(robot.joint_names)}"
            )
        masses = members["masses"]
        if robot is not None and (
            masses.shape != robot.tree.mass.shape or not np.allclose(masses, robot.tree.mass, rtol=1e-6)
        ):
            raise FileError(
                f"{source} is of robot {members['robot']!s}, whose links weigh {masses.sum():.6g} kg in all; "
                f"{robot.name!r} has joints of the same names, but its links weigh {robot.tree.mass.sum():.6g} kg"
            )
        statistics = StepStatistics(**{x.name: members[f"statistics.{x.name}"] for x in fields(StepStatistics)})
        if damage := statistics.damage():
            raise FileError(f"{source}: {damage}")
        accuracy = None
        if "accuracy" in members:
            numbers = members["accuracy"]
            if not (np.isfinite(numbers).all() and (numbers >= 0.0).all()):
                raise FileError(f"{source}: accuracy holds numbers that no accuracy has")
            tolerance, error, *work = map(float, numbers)
            made = str(members["integrator"]), float(members["dt"])
            accuracy = Accuracy(tolerance, error, *made, *map(int, work))
        return cls(
            **{name: members[name] for name in _ARRAYS},
            dt=float(members["dt"]),
            integrator=str(members["integrator"]),
            robot=str(members["robot"]),
            joint_names=names,
            statistics=statistics,
            version=str(members["version"]),
            warnings=tuple(str(sentence) for sentence in members["warnings"]),
            scene_values=MappingProxyType(kept),
            accuracy=accuracy,
        )


def require_layout(source: Path, members: Mapping[str, NDArray[Any] | Header]) -> None:
    """Refuse arrays, or headers of arrays, that are not those of one motion.

    Raises:
        FileError: It names the member, its shape or type, and what belongs there.
    """
    steps, n = members["t"].size - 1, members["joint_names"].size
    nodes: tuple[int, ...] = (steps + 1,)
    shapes = dict.fromkeys("qvp", (*nodes, n)) | dict.fromkeys(("t", "energy"), nodes) | {"masses": (-1,), "dt": ()}
    shapes |= {"u": (steps, -1), "dw": (steps, -1), "joint_names": (-1,), "warnings": (-1,)}
    shapes |= {f"statistics.{name}": (steps,) for name in STEP_NUMBERS} | {"statistics.halvings": (-1,)}
    shapes |= dict.fromkeys(_TEXTS[:3], ())
    shapes |= {"accuracy": (len(_ACCURACY),)} if "accuracy" in members else {}
    ends = {"gravity": (3,), "actuation": (n, -1)} | dict.fromkeys(("damping", "stiffness", "rest", "armature"), (n,))
    ends |= dict.fromkeys(("ratio", "offset"), (-1,)) | dict.fromkeys(("center", "translation"), (-1, 3))
    ends |= {"inertia": (-1, 6), "rotation": (-1, 3, 3)} | dict.fromkeys(OF_FORCES, (-1, -1))
    shapes |= {_SCENE + name: ends.get(name, (n, -1)) for name in VALUES if _SCENE + name in members}
    for name, shape in shapes.items():
        found, kind = members[name].shape, members[name].dtype
        if len(found) != len(shape) or any(b not in (-1, a) for a, b in zip(found, shape, strict=True)):
            raise FileError(f"{source}: {name} has shape {found}, where {shape} belongs")
        if name in _TEXTS:
            if kind.kind != "U":
                raise FileError(f"{source}: {name} holds {kind}, where text belongs")
        elif kind != _KINDS.get(name, "float64"):
            raise FileError(f"{source}: {name} holds {kind}, where {_KINDS.get(name, 'float64')} belongs")
        if name in (*_TEXTS, "masses") and members[name].size * kind.itemsize > _MOST_WORDS:
            raise FileError(f"{source}: {name} is longer than any: {found} of {kind}")


def chained(parts: Sequence[Trajectory]) -> Trajectory:
    """Motions at one dt, each of which begins where the one before ended, as one that begins when the first does.

    Their warnings, each in the times of its own part, are left out.
    """
    first = parts[0]
    steps = sum(part.steps for part in parts)
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(first, name)[:1], *(getattr(part, name)[1:] for part in parts)])
        for name in ("q", "v", "p", "energy")
    }
    arrays |= {name: np.concatenate([getattr(part, name) for part in parts]) for name in ("u", "dw")}
    return replace(
        first,
        t=first.t[0] + np.arange(steps + 1) * first.dt,
        **arrays,
        statistics=joined([part.statistics for part in parts]),
        warnings=(),
        accuracy=None,
    )


def require_motion(scene: Scene, trajectory: Trajectory) -> None:
    """Refuse what is no trajectory of a scene's robot with its number of controls.

    Raises:
        InputError: It says what it is instead.
    """
    if not isinstance(trajectory, Trajectory):
        raise InputError(f"the motion must be a varpin.Trajectory, got {type(trajectory).__name__}")
    if trajectory.joint_names != scene.robot.joint_names:
        raise InputError(
            f"the trajectory is of joints {', '.join(trajectory.joint_names)}; "
            f"the scene's robot has {', '.join(scene.robot.joint_names)}"
        )
    if trajectory.u.shape[1] != scene.controls:
        raise InputError(f"the trajectory has {trajectory.u.shape[1]} controls, the scene {scene.controls}")


def require_scene_of(scene: Scene, trajectory: Trajectory) -> None:
    """Refuse a motion that was made in a scene of other numbers, as far as it keeps them.

    Noise counts where there was some: without, the motion is that of any noise.

    Raises:
        InputError: It says what differs.
    """
    found = differences(scene, trajectory.scene_values, noise=bool(trajectory.dw.any()))
    if not same(trajectory.masses, scene.robot.tree.mass):
        found.insert(0, "the robot's masses are others in the scene")
    if found:
        raise InputError(
            f"the trajectory was made in another scene than the one given: {'; '.join(found)}. Give the scene that "
            "made it, or simulate again in this one"
        )


# What a file of a trajectory holds beside its format, and what it may hold.
MEMBERS = frozenset(_ARRAYS) | {"dt", "version", "integrator", "robot", "joint_names", "warnings"}
MEMBERS |= {f"statistics.{item.name}" for item in fields(StepStatistics)}
OPTIONAL = frozenset(_SCENE + name for name in VALUES) | {"accuracy"}


def read_members(
    source: Path,
    kind: str,
    expected: Iterable[str],
    *,
    optional: Collection[str] = (),
    others: bool = False,
    most: int | None = None,
    check: Check | None = None,
) -> dict[str, NDArray[Any]]:
    """The ``expected`` arrays of an npz file of format ``kind``, the ``optional`` that it has, with ``others`` all.

    ``most`` and ``check`` as for :func:`varpin.io.archive.read_npz`.

    Raises:
        FileError: It says what is wrong with the file.
    """
    what = f"varpin {kind.removeprefix('varpin.').partition('/')[0]}"
    names = {*expected, "format"}
    found = read_npz(source, names, what, wanted={"format"}, most=_MOST_WORDS)["format"]
    if found.shape != () or str(found) != kind:
        raise FileError(f"{source} is not a {what}: its format is {reprlib.repr(str(found))[1:-1]}, not {kind!r}")
    wanted = None if others else {*names, *optional}
    return read_npz(source, names, what, wanted=wanted, most=most, check=check)


@contextlib.contextmanager
def atomic_file(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """A binary stream whose contents take the place of ``path`` when the block ends well, and vanish if not.

    Raises:
        FileError: The path cannot be written.
    """
    target = writable(path)
    # Not by tempfile, which gives files to their owner alone.
    own = target.with_name(f".{target.name}.{secrets.token_hex(8)}")
    try:
        with own.open("xb") as stream:
            yield stream
        own.replace(target)
    except BaseException as error:
        own.unlink(missing_ok=True)
        if isinstance(error, OSError) and not isinstance(error, FileError):
            raise FileError(f"cannot write {target}: {error.strerror or error}") from None
        raise
