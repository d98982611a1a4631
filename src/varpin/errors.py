"""The errors that varpin raises. Each has its data as attributes, and a message that tells what is allowed."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any, Self

# Names that fit a message of two lines.
_MOST_NAMES = 8


class VarpinError(Exception):
    """Base of all errors that varpin raises."""

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (type(self), str(self), vars(self).copy())


def _restored(kind: type[VarpinError], message: str, values: dict[str, Any]) -> VarpinError:
    """An unpickled error."""
    error = kind.__new__(kind, message)
    vars(error).update(values)
    return error


class RobotError(VarpinError, ValueError):
    """A robot description cannot be used."""


class RobotNotFound(RobotError):
    """No robot of that name, or no file at that path.

    Attributes:
        name: The given name or path.
        matches: Similar names.
    """

    def __init__(self, name: str, known: Iterable[str], note: str = "", more: str = "") -> None:
        self.name = name
        known = sorted(known)
        self.matches = difflib.get_close_matches(name.lower(), known, n=5, cutoff=0.5)
        hints = [f"close matches: {', '.join(self.matches)}"] if self.matches else []
        if not (note or self.matches):
            hints = ["varpin.robot_names() lists the names, such as " + ", ".join(known[:5])]
        if more and name.lower() not in known:
            hints.append(more)
        super().__init__("; ".join([f"no fixed-base robot or URDF file {name[:100]!r}{note}", *hints]))


class UnsupportedJoint(RobotError):
    """A joint type outside generalized coordinates in R^n.

    Attributes:
        joint: Name of the joint.
        kind: Pinocchio type of the joint.
    """

    def __init__(self, joint: str, kind: str, numbers: int) -> None:
        self.joint, self.kind = joint, kind
        value = "position" if numbers == 1 else f"[{numbers} numbers]"
        super().__init__(
            f"joint {joint!r} is a {kind}, which has no single coordinate in R: hold it with "
            f"lock={{{joint!r}: {value}}}, or describe it as a chain of revolute and prismatic joints"
        )


class SingularMassMatrix(RobotError):
    """The mass matrix is not positive definite: a moving part has no inertia, or a negative one.

    Attributes:
        joints: The joints whose motion carries no inertia, or a negative one.
        negative: Whether the inertia is negative.
    """

    def __init__(
        self, joints: Iterable[str], q: object = None, *, negative: bool = False, cause: str = "", hint: str = ""
    ) -> None:
        self.joints, self.negative = tuple(joints), negative
        more = f" and {len(self.joints) - 3} more" if len(self.joints) > 3 else ""
        names = ", ".join(map(repr, self.joints[:3])) + more
        kind, lack = ("not positive definite", "negative") if negative else ("singular", "no")
        why = cause or (
            f"motion of {names} carries {lack} inertia; "
            + (hint or "give the links it moves mass and inertia, give the joint an armature, or lock it")
        )
        at = "" if q is None else f" at q = {q}"
        super().__init__(f"the mass matrix is {kind}{at}: {why}")


class InputError(VarpinError, ValueError):
    """An argument has a wrong shape, type or value."""


class AssemblyError(InputError):
    """The search finds no configuration that satisfies all constraints.

    Attributes:
        constraint: The most violated constraint.
        miss: Its violation [m or rad].
        q: Final configuration of the search (n,) [rad or m].
    """

    def __init__(self, constraint: str, miss: float, q: object) -> None:
        self.constraint, self.miss, self.q = constraint, miss, q
        super().__init__(
            f"the constraints cannot be assembled from this q: the closest that was found misses {constraint} by "
            f"{miss:.4g} m or rad, at q = {q}; give another q, or correct lengths and places"
        )


def similar(name: str, known: Iterable[str]) -> list[str]:
    """The known names that are like a name."""
    names = tuple(known)
    return difflib.get_close_matches(name, names, n=3, cutoff=0.5) or [own for own in names if name and name in own][:3]


def suggestion(name: str, known: Iterable[str], kind: str, most: int = _MOST_NAMES) -> str:
    """A hint at similar names, and the first of the known ones, which are of a ``kind``, in the plural."""
    names = tuple(known)
    matches = similar(name, names)
    hint = f"did you mean {' or '.join(map(repr, matches))}? " if matches else ""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{hint}{kind}: {', '.join(names[:most]) or 'none'}{more}"


class UnknownName(InputError):
    """A name that is not among the known ones.

    Attributes:
        name: The given name.
        known: The known names.
        matches: Similar names.
    """

    kind = "names"

    def __init__(self, name: str, known: Iterable[str], lack: str) -> None:
        self.name, self.known = name, tuple(known)
        self.matches = similar(name, self.known)
        super().__init__(f"{lack} {name!r}; {suggestion(name, self.known, self.kind)}")


class UnknownJoint(UnknownName):
    """A joint ``name`` that is not ``known`` to the robot or its controls, and the similar names, ``matches``."""

    kind = "joints"


class UnknownFrame(UnknownName):
    """A frame ``name`` that is not ``known`` to the robots, and the similar names, ``matches``."""

    kind = "frames"


class UnknownPosture(UnknownName):
    """A posture whose ``name`` is not ``known`` to the robot, and the similar names, ``matches``."""

    kind = "postures, from load_robot(..., srdf=path)"


class FileError(VarpinError, OSError):
    """A file cannot be read or written."""


class MissingDependency(VarpinError, ImportError):
    """A feature needs a package or a program that is not installed.

    Attributes:
        purpose: The feature.
        missing: The missing packages or programs.
        command: The command that installs them.
    """

    def __init__(self, purpose: str, missing: Iterable[str], command: str) -> None:
        self.purpose, self.missing, self.command = purpose, tuple(missing), command
        super().__init__(f"{purpose} needs {' and '.join(self.missing)}: {command}")


class WorkersLost(VarpinError, RuntimeError):
    """An executor has lost its workers, as when a process of a pool is killed.

    Attributes:
        result: What the finished paths give, as :attr:`varpin.PathsInterrupted.result`.
    """

    def __init__(self, cause: object, result: Any = None) -> None:
        self.result = result
        kept = "" if result is None else "; the finished paths are in .result"
        super().__init__(f"the executor has lost its workers{kept}: {cause}")


class LinearizationError(VarpinError, RuntimeError):
    """A step of a trajectory has no solution at zero noise, so it has no derivative.

    Attributes:
        step: Index of the step.
        time: Time at its start [s].
        reason: Why the solver stopped.
    """

    def __init__(self, step: int, time: float, reason: str) -> None:
        self.step, self.time, self.reason = step, time, reason
        super().__init__(f"step {step} (t = {time:.6g} s) cannot be linearized: {reason}; a smaller dt may help")


class StepError(VarpinError, ValueError):
    """A user's function failed in a step.

    Attributes:
        step: Index of the step that it was called for.
        time: The time it was called with, or the start of that step [s].
        problem: What failed, in words.
        trajectory: The motion before; None where the function is called before the motion begins, as in an ensemble.
    """

    def __init__(self, step: int, time: float, problem: str, trajectory: Any = None) -> None:
        self.step, self.time, self.problem, self.trajectory = step, time, problem, trajectory
        before = "" if trajectory is None else "; what came before is in error.trajectory"
        super().__init__(f"step {step} (t = {time:.6g} s): {problem}{before}")

    def after(self, trajectory: Any) -> Self:
        """The same error with the motion before it."""
        return type(self)(self.step, self.time, self.problem, trajectory)


class ControlError(StepError):
    """A control law or the function of an OpenLoop raised, or returned something that is no control."""
