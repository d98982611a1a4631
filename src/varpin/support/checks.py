"""Validators of user input. Each returns the checked value, or raises an InputError that names the argument."""

from __future__ import annotations

import inspect
import math
import os
import reprlib
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from numbers import Real
from pathlib import Path
from types import UnionType
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.errors import FileError, InputError, UnknownJoint

# One number for each joint, in order or by the joint's name.
JointValues: TypeAlias = ArrayLike | Mapping[str, float]


def require_memory(rows: int, columns: int, what: str, row: str) -> None:
    """Refuse arrays (rows, columns) that do not fit into memory; ``what`` asks for them, and each row is a ``row``."""
    try:
        np.empty((rows, columns))
    except (MemoryError, ValueError, OverflowError):
        raise InputError(f"{what} needs more memory than there is: {8 * columns} bytes a {row}") from None


def finite_array(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Floats:
    """``value`` as a new C-contiguous float array of exactly ``shape``."""
    array = as_floats(name, value)
    if array.shape != shape:
        raise InputError(f"{name} must have shape {shape}, got {array.shape}")
    return require_finite(name, array)


def rotation_matrix(name: str, value: ArrayLike) -> Floats:
    """``value`` as a new rotation matrix (3, 3)."""
    R = finite_array(name, value, (3, 3))
    if np.abs(R.T @ R - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0.0:
        raise InputError(f"{name} must be a rotation matrix: R'R = 1 and det R = 1")
    return R


def tuple_of(name: str, given: Any, kind: type | UnionType, note: str = "") -> tuple[Any, ...]:
    """``given``, an object of type ``kind`` or a sequence of them, as a tuple.

    The ``name`` is the plural of the type; a ``note`` ends messages, where other objects have the same name.
    """
    found = (given,) if isinstance(given, kind) and kind is not str else given
    wanted = f"{name} must be a list" if kind is str else f"{name} must be a list of varpin's {name}"
    if isinstance(found, str | Mapping) or not np.iterable(found):
        raise InputError(f"{wanted}, got {reprlib.repr(given)}{note}")
    items = tuple(found)
    for item in items:
        if not isinstance(item, kind):
            raise InputError(f"{wanted}, got {reprlib.repr(item)} in it{note}")
    return items


def broadcast_array(name: str, value: object, size: int, *, limit: bool = False) -> Floats:
    """``value``, one number or (size,), as a new float array (size,); a ``limit`` need not be finite."""
    array = as_floats(name, value)
    if array.shape not in ((), (size,)):
        raise InputError(f"{name} must be one number or have shape ({size},), got {array.shape}")
    return np.array(np.broadcast_to(array if limit else require_finite(name, array), (size,)))


# Arguments that are positions of joints, for which the name of a posture may be given by mistake.
_POSITIONS = frozenset({"q", "q0", "q1", "rest"})


def joint_array(
    name: str,
    value: JointValues,
    joints: Sequence[str],
    *,
    uniform: bool = False,
    absent: float = 0.0,
    lack: str = "the robot has no joint",
) -> Floats:
    """``value`` as a new float array (n,) with a number for each of the ``joints``; 0 for those not named."""
    if isinstance(value, str) and name in _POSITIONS:
        raise InputError(
            f"{name} must be real numbers, ({len(joints)},) or by joint name, got {value!r}; the positions of a "
            f"posture are robot.posture({value!r})"
        )
    limit = not math.isfinite(absent)
    if not isinstance(value, Mapping):
        if uniform:
            return broadcast_array(name, value, len(joints), limit=limit)
        return finite_array(name, value, (len(joints),))
    array = np.full(len(joints), absent)
    for joint, number in value.items():
        if joint not in joints:
            raise UnknownJoint(str(joint), joints, f"{name}: {lack}")
        array[joints.index(joint)] = (real if limit else finite)(f"{name}[{joint!r}]", number)
    return array


def control_values(
    name: str, value: JointValues, joints: Sequence[str] | None, m: int, *, uniform: bool = False, absent: float = 0.0
) -> Floats:
    """``value``, (m,) or by the names of the driven joints, as a new float array (m,); ``absent`` for those not named.

    With ``uniform`` it may be one number for all controls, and need not be finite where ``absent`` is not.
    """
    if isinstance(value, Mapping):
        if joints is None:
            raise InputError(
                f"{name} is given by joint name, but the joint that each control drives is not known: give numbers in "
                "the order of the controls"
            )
        return joint_array(name, value, joints, absent=absent, lack="no control is the force of a joint")
    if uniform:
        return broadcast_array(name, value, m, limit=not math.isfinite(absent))
    return finite_array(name, value, (m,))


def named_limits(
    name: str, limits: tuple[JointValues, JointValues] | None, joints: Sequence[str] | None, size: int
) -> Floats:
    """(lower, upper), each one number, (size,) or by the names of ``joints``, as (2, size); infinite for no limit."""
    pair: Any = (-np.inf, np.inf) if limits is None else limits
    if not (isinstance(pair, tuple | list | np.ndarray) and np.iterable(pair)) or len(pair) != 2:
        one = reprlib.repr(limits)
        both_sides = f"; for +-{one} write (-{one}, {one})" if isinstance(limits, int | float) else ""
        raise InputError(f"{name} must be a pair (lower, upper), got {one}{both_sides}")
    both = np.empty((2, size))
    for row, side, value, none in zip(both, ("lower", "upper"), pair, (-np.inf, np.inf), strict=True):
        what = f"{name}: {side}"
        row[:] = control_values(what, value, joints, size, uniform=True, absent=none)
        if np.isnan(row).any():
            raise InputError(f"{what}[{int(np.argmax(np.isnan(row)))}] is NaN; inf stands for no limit")
    wrong = ~(both[0] <= both[1]) | (both[0] == np.inf) | (both[1] == -np.inf)
    if wrong.any():
        c = int(np.argmax(wrong))
        raise InputError(f"{name}: nothing is within {both[0, c]:g} and {both[1, c]:g}, the limits of entry {c}")
    both.setflags(write=False)
    return both


def some_limits(
    name: str,
    limits: tuple[JointValues, JointValues] | None,
    own: tuple[Floats, Floats],
    robot: str,
    joints: Sequence[str],
) -> Floats:
    """:func:`named_limits` of joints, by default a robot's ``own``, of which one has to be finite."""
    found = named_limits(f"{name} limits", own if limits is None else limits, joints, len(joints))
    if not np.isfinite(found).any():
        why = f"robot {robot!r} has no such limits" if limits is None else "all limits given are infinite"
        raise InputError(f"{name}: {why}; give limits=(lower, upper) of which one is finite")
    return found


def over_time(name: str, function: Callable[[float], ArrayLike], times: Floats, size: int) -> Floats:
    """Values (N, size) of a function of time at times (N,) [s]."""
    rows = [
        returned(name, partial(function, t), (size,), partial(" at t = {:.6g} s".format, t)) for t in times.tolist()
    ]
    return np.array(rows).reshape(len(times), size)


def returned(
    name: str,
    call: Callable[[], object],
    shape: tuple[int, ...],
    at: Callable[[], str] = str,
    error: type[InputError] = InputError,
) -> Floats:
    """What a user's function returns, an array of ``shape``; messages end with ``at()``, made for them alone."""
    try:
        value = call()
    except Exception as cause:
        raise error(f"{name} raised {cause!r}{at()}") from cause
    try:
        return finite_array(name, value, shape)  # type: ignore[arg-type]
    except InputError as wrong:
        raise error(f"{wrong}{at()}") from None


def as_floats(name: str, value: object) -> Floats:
    """``value`` as a new float array."""
    try:
        array = np.asarray(value)
        # True is no number: of damping=True nobody means 1.
        kind = array.dtype.kind
        numbers = kind in "iuf" or (kind != "b" and all(isinstance(entry, Real) for entry in array.flat))
        if numbers:
            return np.array(array, dtype=np.float64, order="C")
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name} must be an array of real numbers: {error}") from None
    raise InputError(f"{name} must be an array of real numbers, got {reprlib.repr(value)}")


def require_finite(name: str, array: Floats) -> Floats:
    """``array`` itself if all of it is finite."""
    # A sum of squares is the faster look, and may overflow.
    if not math.isfinite(np.vdot(array, array)) and not np.isfinite(array).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        entry = f"{name}[{', '.join(map(str, where))}]" if where else name
        raise InputError(f"{entry} is {array[where]}; it must be finite")
    return array


def positive(name: str, value: Any, unit: str) -> float:
    """``value`` as a float > 0 and finite."""
    number = real(name, value)
    if not (math.isfinite(number) and number > 0.0):
        raise InputError(f"{name} must be positive and finite [{unit}], got {value}")
    return number


def real(name: str, value: Any) -> float:
    """``value`` as a float; raises an InputError that names it otherwise."""
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    if isinstance(value, bool) or not isinstance(value, Real):
        raise InputError(f"{name} must be a number, got {reprlib.repr(value)}")
    try:
        return float(value)
    except OverflowError:
        raise InputError(f"{name} is beyond the range of floating-point numbers") from None


def finite(name: str, value: Any) -> float:
    """``value`` as a finite float; raises an InputError that names it otherwise."""
    number = real(name, value)
    if not math.isfinite(number):
        raise InputError(f"{name} is {number}; it must be finite")
    return number


def fraction(name: str, value: float) -> float:
    """``value`` as a float in [0, 1]; raises an InputError that names it otherwise."""
    number = real(name, value)
    if not 0.0 <= number <= 1.0:
        raise InputError(f"{name} must be in [0, 1], got {value}")
    return number


def is_one_of(value: object, words: tuple[str, ...]) -> bool:
    """Whether ``value`` is one of ``words``; False for arrays, which compare entry by entry."""
    return isinstance(value, str) and value in words


def word(name: str, value: object, words: tuple[str, ...]) -> None:
    """Raise an InputError unless ``value`` is one of ``words``."""
    if not is_one_of(value, words):
        given = ", ".join(map(repr, words[:-1]))
        raise InputError(f"{name} must be {given} or {words[-1]!r}, got {reprlib.repr(value)}")


def count(name: str, value: Any, least: int = 0) -> int:
    """``value`` as an int >= ``least``."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise InputError(f"{name} must be an integer, got {reprlib.repr(value)}")
    if not least <= value <= sys.maxsize:
        raise InputError(f"{name} must be at least {least}, and at most {sys.maxsize}, got {reprlib.repr(int(value))}")
    return int(value)


def flag(name: str, value: Any) -> bool:
    """``value`` as a bool; a text such as "no" would count as True."""
    if not isinstance(value, bool | np.bool_):
        raise InputError(f"{name} must be True or False, got {reprlib.repr(value)}")
    return bool(value)


def require_function(name: str, value: object, arguments: str, *, optional: bool = False) -> None:
    """Refuse anything but a function of ``arguments``, or None where it is ``optional``."""
    if not (callable(value) or (optional and value is None)):
        raise InputError(f"{name} must be a function of {arguments}, got {reprlib.repr(value)}")


def path_like(name: str, path: Any) -> Path:
    """``path`` as a Path, with ~ expanded."""
    if not isinstance(path, str | os.PathLike) or "\0" in os.fspath(path):
        raise InputError(f"{name} must be a path, got {path!r}")
    return Path(path).expanduser()


def writable(path: str | os.PathLike[str]) -> Path:
    """``path`` with links resolved, checked before any work is done for the file."""
    target = path_like("path", path).resolve()
    exists = True
    # Not target.exists(), which from Python 3.14 on has no error for a name that is too long.
    try:
        target.lstat()
    except (FileNotFoundError, NotADirectoryError):
        exists = False
    except OSError as error:
        raise FileError(f"cannot write a file of that name, {target.name[:40]!r}: {error.strerror}") from None
    if exists and not target.is_file():
        raise FileError(f"cannot write {target}: it is a folder, a device or a pipe")
    if not target.parent.is_dir():
        raise FileError(f"cannot write {target}: there is no folder {target.parent}")
    if not os.access(target if exists else target.parent, os.W_OK):
        raise FileError(f"cannot write {target}: permission denied")
    return target


def is_file(path: Path) -> bool:
    """Whether ``path`` is a regular file; False for an invalid path."""
    try:
        return path.is_file()
    except OSError:
        return False


def takes(function: Callable[..., object], arguments: int) -> bool:
    """Whether a function can be called with ``arguments`` arguments; True if its signature is unknown."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return True
    try:
        signature.bind(*range(arguments))
    except TypeError:
        return False
    return True


def told_motion(name: str, function: object, arguments: str, motion: str = "") -> bool:
    """Whether a progress function of ``arguments`` takes the ``motion``, too, as one argument more."""
    # A function of any number of arguments, such as print, gets the fewer ones.
    least = arguments.count(",") + 1
    if function is None or (callable(function) and takes(function, least)):
        return False
    if motion and callable(function) and takes(function, least + 1):
        return True
    more = f", or of ({arguments}, {motion})" if motion else ""
    raise InputError(f"{name} must be a function of ({arguments}){more}; got {reprlib.repr(function)}")
