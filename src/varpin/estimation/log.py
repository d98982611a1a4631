"""The log of an arm: what its encoders read under known controls."""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from varpin.arrays import Floats
from varpin.core import inverse_dynamics
from varpin.errors import FileError, InputError, UnknownJoint
from varpin.finding import Finding, announce
from varpin.io.archive import atomic_file, read_npz, save_npz
from varpin.mechanics.scene import Scene
from varpin.model import in_degrees, joint_unit
from varpin.support.checks import as_floats, is_file, path_like, require_finite, tuple_of
from varpin.support.frozen import Frozen
from varpin.trajectory import Trajectory

FORMAT = "varpin.log/1"

# A gap in the clock of so many median steps is told: some lost packets of a bus are fewer.
GAP = 10.0
# Longest median step [s] that is not told: arms are logged at 10 Hz and more, so longer ones look like milliseconds.
_SLOW = 0.5
# Distance beyond a joint's limits that is told [rad or m]: stops yield, and zeros of encoders are off, by less.
_BEYOND = 0.1
# Length [s] of the parabolas that tell the forces of a log, and the fewest samples of one, and parabolas, that do. The
# noise of encoders spoils shorter ones, and what arms do within longer ones is lost.
_PARABOLA, _FEW = 0.2, 4
# Share of the squared forces of a joint that a scene lacks with a log, below which those that it lacks with opposite
# controls or exchanged columns tell that these are right; from 0.1 to 0.5. Payloads and friction that no scene has
# leave 0.9 and more.
_FITS = 0.25
# Most joints whose columns may be turned or exchanged: of more, pairs take seconds.
_SUSPECTS = 8
# Fewest samples of a joint: fewer tell no velocity.
_LEAST = 2
# The arrays of a log in files, of which the first three must be there.
_ENTRIES = ("t", "q", "u", "v", "joints", "controls")

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Log(Frozen):
    """Measured positions of an arm, and the controls that acted.

    Attributes:
        t: Times of the samples (K,) [s], strictly increasing, as uneven as they are.
        q: Measured positions (K, n) [rad or m]; NaN where a sample is missing.
        u: Controls (K, m), without gaps; u[k] acts from t[k] to t[k + 1].
        v: Measured velocities (K, n) [rad/s or m/s], NaN where one is missing; None for encoders alone.
        joints: The joints of the columns of q and v; None for the robot's order.
        controls: The joints of the columns of u. If left out, ``joints`` where u is as wide as q, and else the scene's
            order.
        warnings: What is doubtful about the log, from :meth:`matched`.

    Raises:
        InputError: Shapes do not fit together, t does not increase, or a value is infinite, or NaN in t or u.
    """

    t: Floats
    q: Floats
    u: Floats
    v: Floats | None = None
    joints: tuple[str, ...] | None = None
    controls: tuple[str, ...] | None = None
    warnings: tuple[Finding, ...] = field(default=(), metadata={"entry": None})

    def __post_init__(self) -> None:
        t = require_finite("Log t", as_floats("Log t", self.t))
        if t.ndim != 1 or len(t) < _LEAST:
            raise InputError(f"Log t must have shape (K,) with at least {_LEAST} samples, got {t.shape}")
        k = int(np.argmin(np.diff(t)))
        if t[k + 1] <= t[k]:
            late = f"t[{k + 1}] = {t[k + 1]:.9g} s follows {t[k]:.9g} s"
            raise InputError(f"Log t must increase, and {late}: sort the rows by time and drop repeated ones")
        q, u = _rows("Log q", self.q, len(t)), require_finite("Log u", _rows("Log u", self.u, len(t)))
        v = None if self.v is None else _rows("Log v", self.v, len(t))
        if v is not None and v.shape != q.shape:
            raise InputError(f"Log v must have the shape of q, {q.shape}, got {v.shape}")
        joints = _names("joints", self.joints, q.shape[1])
        controls = joints if self.controls is None and q.shape == u.shape else self.controls
        for array in (t, q, u) if v is None else (t, q, u, v):
            array.setflags(write=False)
        # The frozen dataclass refuses assignments.
        vars(self).update(t=t, q=q, u=u, v=v, joints=joints, controls=_names("controls", controls, u.shape[1]))

    def __repr__(self) -> str:
        (samples, joints), controls = self.q.shape, self.u.shape[1]
        return f"Log({samples} samples in {self.t[-1] - self.t[0]:g} s, {joints} joints, {controls} controls)"

    @staticmethod
    def load(path: str | os.PathLike[str], joints: Sequence[str] | None = None) -> Log:
        """A log from a file.

        An ``.npz`` file has arrays t, q, u and, if there are any, v, joints and controls. Any other file is read as
        CSV: its first line names the columns t, q_<joint>, u_<joint> and, if there are any, v_<joint>, in any order;
        a cell of a missing sample is empty or nan, and other columns are ignored.

        Args:
            path: The file.
            joints: Names of the columns of q and v, in place of those in the file.

        Raises:
            FileError: The file cannot be read, or a cell is no number.
            InputError: The file's log is none, see :class:`Log`.
        """
        source = path_like("path", path)
        if source.suffix == ".npz":
            given = {name: np.asarray(entry) for name, entry in read_npz(source).items() if name in _ENTRIES}
            if lost := [name for name in _ENTRIES[:3] if name not in given]:
                raise FileError(f"{source}: {lost[0]} is missing; a log has arrays t, q and u")
        else:
            given = _from_csv(source)
        return Log(**given if joints is None else given | {"joints": joints})

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write ``.npz``, or else CSV, which needs the names ``joints`` and ``controls``; returns the path.

        Raises:
            FileError: The file cannot be written.
            InputError: The columns of a CSV file have no names.
        """
        target = path_like("path", path)
        if target.suffix == ".npz":
            return save_npz(target, FORMAT, self)
        if self.joints is None or self.controls is None:
            raise InputError("a CSV file names its columns: give the log's joints and controls, or save it as .npz")
        kinds = [("q", self.joints), ("u", self.controls), *([] if self.v is None else [("v", self.joints)])]
        head = ",".join(["t", *(f"{kind}_{name}" for kind, names in kinds for name in names)])
        rows = np.column_stack([self.t, *(getattr(self, kind) for kind, _ in kinds)])
        with atomic_file(target) as stream:
            np.savetxt(stream, rows, "%.17g", ",", header=head, comments="", encoding="utf-8")
        return target

    def matched(self, scene: Scene) -> Log:
        """The log with its columns in the order of a scene's robot and controls, and with ``warnings``, announced.

        Raises:
            UnknownJoint: A name is no joint of the robot, or of no control.
            InputError: Columns are missing or too many, or a joint has fewer than two samples.
        """
        names = scene.robot.joint_names
        to_q = _order("q", self.joints, names, self.q.shape[1], len(names))
        to_u = _order("u", self.controls, scene.control_joints, self.u.shape[1], scene.controls)
        q, u, v = self.q[:, to_q], self.u[:, to_u], None if self.v is None else self.v[:, to_q]
        few = np.flatnonzero(np.isfinite(q).sum(axis=0) < _LEAST)
        if few.size:
            raise InputError(f"the log has fewer than {_LEAST} samples of joint {names[few[0]]!r}")
        log = Log(self.t, q, u, v, names, scene.control_joints).changed(warnings=tuple(_doubts(scene, self.t, q, u)))
        announce(logger, scene.announced, float(np.median(np.diff(self.t))), log.warnings)
        return log


def as_log(given: Log | Trajectory) -> Log:
    """A log itself, or that of a simulated motion: its positions and the mean controls of its steps, the last again.

    Raises:
        InputError: It is neither.
    """
    if isinstance(given, Log):
        return given
    if not isinstance(given, Trajectory):
        raise InputError(f"a log must be a varpin.Log or a Trajectory, got {type(given).__name__}")
    return Log(given.t, given.q, np.vstack([given.u, given.u[-1:]]), None, given.joint_names)


def _rows(name: str, given: Any, rows: int) -> Floats:
    """An array (K, any) whose entries are finite or NaN."""
    array = as_floats(name, given)
    if array.ndim != 2 or len(array) != rows:
        raise InputError(f"{name} must have a row for each of the {rows} times, got shape {array.shape}")
    require_finite(name, np.where(np.isnan(array), 0.0, array))
    return array


def _names(what: str, given: Any, columns: int) -> tuple[str, ...] | None:
    if given is None:
        return None
    names = tuple(map(str, tuple_of(f"Log {what}", given, str)))
    if len(names) != columns or len(set(names)) != columns:
        raise InputError(f"Log {what} must be {columns} different names, one for each column, got {names}")
    return names


def _order(
    kind: str, given: tuple[str, ...] | None, names: tuple[str, ...] | None, columns: int, wanted: int
) -> list[int]:
    """Where the columns of ``names`` are among the ``given`` ones; as they are if either has no names."""
    known, own = names or (), given or ()
    if known and (strange := [name for name in own if name not in known]):
        raise UnknownJoint(strange[0], known, f"the log's {kind} names a joint that the scene does not have,")
    if columns != wanted:
        of = f", of {', '.join(known)}" if known else ""
        raise InputError(f"the log has {columns} columns of {kind}, the scene {wanted}{of}")
    return [own.index(name) for name in known] if known and own else list(range(columns))


def _doubts(scene: Scene, t: Floats, q: Floats, u: Floats) -> Iterator[Finding]:
    """What is doubtful about a log in the scene's order, the worst first."""
    names, steps = scene.robot.joint_names, np.diff(t)
    usual, at = float(np.median(steps)), int(np.argmax(steps))
    if usual > _SLOW:
        text = f"the log has a sample every {usual:.4g} s: t looks like milliseconds, and times are in seconds"
        yield Finding("clock of the log", text, value=usual, unit="s")
    least, most = np.nanmin(q, axis=0), np.nanmax(q, axis=0)
    lower, upper = scene.robot.position_limits
    beyond = np.maximum(lower - least, most - upper)
    far = int(np.argmax(beyond))
    if found := in_degrees(scene.robot, "q", q):
        yield from found
    elif beyond[far] > _BEYOND:
        unit = joint_unit(scene.robot, far)
        text = f"q of {names[far]!r} is {beyond[far]:.3g} {unit} beyond its limits: columns may be in another order"
        yield Finding("log beyond limits", text, names[far], value=float(beyond[far]), unit=unit)
    yield from _confused(scene, t, q, u)
    still, driven = most == least, (scene.actuation != 0.0) @ (np.ptp(u, axis=0) > 0.0)
    # An encoder that reads one number to the last bit while a control that changes acts on its joint.
    for joint in np.flatnonzero(still & driven & (not still.all())):
        text = f"q of {names[joint]!r} is one number throughout: its encoder may be dead, and missing samples are NaN"
        yield Finding("dead encoder", text, names[joint])
    if steps[at] > GAP * usual:
        text = f"the log has no samples for {steps[at]:.4g} s after t = {t[at]:.6g} s, its usual step is {usual:.3g} s"
        yield Finding("gap in the log", text, time=float(t[at]), value=float(steps[at]), unit="s")


def _confused(scene: Scene, t: Floats, q: Floats, u: Floats) -> Iterator[Finding]:
    """The signs or two columns that look wrong, whichever it is, by inverse dynamics of parabolas."""
    rows, k = np.flatnonzero(np.isfinite(q).all(axis=1)), round(_PARABOLA / float(np.median(np.diff(t))))
    if k < _FEW or len(rows) < _FEW * k:
        return
    at = rows[: len(rows) // k * k].reshape(-1, k)
    s = t[at] - t[at].mean(axis=1, keepdims=True)
    parabolas = np.linalg.pinv(np.stack([np.ones_like(s), s, 0.5 * s**2], axis=2)) @ q[at]
    motion, force = parabolas.swapaxes(0, 1), u[at].mean(axis=1) @ scene.actuation.T

    def lacking(motion: Floats, force: Floats) -> Floats:
        """Logarithms (n,) of the squared forces that the scene lacks."""
        q, v, a = motion
        off = (inverse_dynamics(scene.core, q, v, a) - force - scene.core.forces(q, v, force)[0]).T[:, :, None]
        # Friction and dampers that the scene does not have, of any size, tell nothing.
        passive = np.linalg.qr(np.array([np.sign(v), v]).T)[0]
        left = np.square(off - passive @ (passive.swapaxes(1, 2) @ off)).sum(axis=(1, 2))
        return np.asarray(np.log(np.maximum(left, np.finfo(float).tiny)))

    names, own, least = scene.robot.joint_names, lacking(motion, force), np.log(_FITS)
    gains = lacking(motion, -force) - own
    turned = np.flatnonzero(gains < least)
    best, kind = gains[turned].sum(), "sign of the columns"
    of = ", ".join(repr(names[joint]) for joint in turned)
    text = f"u of {of} fits q far better with the opposite sign: turn u, q or the scene's gravity, whichever is wrong"
    # The joints whose forces explain the least of what they need.
    suspects = sorted(np.argsort(lacking(motion, 0.0 * force) - own)[:_SUSPECTS])
    for joint in suspects:
        name, gains = names[joint], lacking(motion * np.where(np.arange(len(names)) == joint, -1.0, 1.0), force) - own
        if gains[joint] < least and gains.sum() < min(best, least):
            best, kind = gains.sum(), "sign of the columns"
            text = f"q of {name!r} fits u far better with the opposite sign: turn q or u, whichever is wrong"
    for pair in map(list, combinations(suspects, 2)):
        order = np.arange(len(names))
        order[pair] = pair[::-1]
        moved, other = motion[:, :, order], force[:, order]
        for what, *given in (("q", moved, force), ("u", motion, other), ("q and u", moved, other)):
            gains = lacking(*given) - own
            if gains[pair].max() < least and gains.sum() < best:
                best, kind = gains.sum(), "order of the columns"
                of = " and ".join(repr(names[joint]) for joint in pair)
                text = f"the columns of {of} in {what} look swapped: the log fits far better with them exchanged"
    if best < 0.0:
        yield Finding(kind, text)


def _from_csv(source: Path) -> dict[str, Any]:
    if not is_file(source):
        raise FileError(f"there is no file {source}")
    try:
        # NumPy warns of a file without rows.
        with warnings.catch_warnings(action="error"), source.open(encoding="utf-8-sig") as stream:
            # Names as they are: NumPy would take signs out of them. Text that is no number is refused.
            table = np.genfromtxt(
                stream, delimiter=",", names=True, autostrip=True, deletechars="", replace_space=" ", loose=False
            )
    except (OSError, ValueError, UserWarning) as error:
        raise FileError(f"cannot read {source}: {error}") from None
    names = table.dtype.names or ()
    of = {kind: tuple(name[2:] for name in names if name.startswith(f"{kind}_")) for kind in "quv"}
    if "t" not in names or not of["q"] or not of["u"] or sorted(of["v"]) not in ([], sorted(of["q"])):
        wanted = "t, q_<joint>..., u_<joint>... and, if there are any, v_<joint>... of the same joints as q"
        raise FileError(f"{source}: the first line must name the columns {wanted}, got {', '.join(names)[:200]}")
    of["v"] = of["q"] if of["v"] else ()
    given = {kind: np.column_stack([table[f"{kind}_{name}"] for name in own]) for kind, own in of.items() if own}
    return given | {"t": table["t"], "joints": of["q"], "controls": of["u"]}
