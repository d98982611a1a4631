"""The record of an ensemble: its statistics, its paths and those that failed."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.finding import Finding
from varpin.io.archive import Axes, read_npz, record_of, save_npz
from varpin.support.checks import path_like
from varpin.support.frozen import Frozen
from varpin.support.markup import Printed, joint_table, warning_count, warning_lines

FORMAT = "varpin.ensemble/1"


@dataclass(frozen=True, eq=False)
class EnsembleStatistics(Frozen):
    """Moments and quantiles over the paths at each of N + 1 nodes.

    x is (q, p) for variational integrators and (q, v) for the others.

    Attributes:
        mean: Mean of x (N + 1, 2n).
        covariance: Covariance of x (N + 1, 2n, 2n), with P - 1 in the denominator.
        levels: Levels of the quantiles (L,).
        quantiles: Quantiles of x (L, N + 1, 2n).
        quantile_paths: How many of the first paths the quantiles are of: all, unless these were too many to keep.
        energy_mean: Mean energy (N + 1,) [J].
        energy_deviation: Standard deviation of the energy (N + 1,) [J].
        count: Number of paths at each node (N + 1,): those that have not failed before.
    """

    mean: Annotated[Floats, Axes("nodes", "states")]
    covariance: Annotated[Floats, Axes("nodes", "states", "states")]
    levels: Annotated[Floats, Axes("levels")]
    quantiles: Annotated[Floats, Axes("levels", "nodes", "states")]
    quantile_paths: int
    energy_mean: Annotated[Floats, Axes("nodes")]
    energy_deviation: Annotated[Floats, Axes("nodes")]
    count: Annotated[NDArray[np.int64], Axes("nodes")]

    def __repr__(self) -> str:
        nodes, states = self.mean.shape
        return f"EnsembleStatistics({nodes} nodes, {states // 2} joints, {len(self.levels)} quantiles)"


@dataclass(frozen=True)
class PathFailure:
    """A path that stopped early.

    Attributes:
        path: Index of the path.
        step: Index of the step that failed.
        reason: Why it failed, in words.
    """

    path: int
    step: int
    reason: str


@dataclass(frozen=True, eq=False)
class Ensemble(Printed, Frozen):
    """P paths over N steps.

    Attributes:
        t: Times (N + 1,) [s].
        statistics: Moments and quantiles over the paths.
        q: Configurations (P, N + 1, n) [rad or m], NaN after a failure; None, like the next four, if not stored.
        v: Velocities (P, N + 1, n).
        p: Momenta (P, N + 1, n).
        u: Controls applied (P, N, m).
        energy: Energy (P, N + 1) [J].
        failures: Paths that stopped early. The statistics leave a path out after its failure.
        warnings: One of each kind: errors, limits, paths that stopped early. The first path, the one with the most
            split steps, the one with the most energy and the fastest are checked as :func:`varpin.simulate` does.
        integrator: The integrator of all paths.
        joint_names: Names of the coordinates.
    """

    t: Annotated[Floats, Axes("nodes", finite=True)]
    statistics: EnsembleStatistics
    q: Annotated[Floats, Axes("paths", "nodes", "joints")] | None = None
    v: Annotated[Floats, Axes("paths", "nodes", "joints")] | None = None
    p: Annotated[Floats, Axes("paths", "nodes", "joints")] | None = None
    u: Annotated[Floats, Axes("paths", "steps", "controls")] | None = None
    energy: Annotated[Floats, Axes("paths", "nodes")] | None = None
    failures: tuple[PathFailure, ...] = ()
    warnings: tuple[Finding, ...] = ()
    integrator: str = ""
    joint_names: tuple[str, ...] = ()

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the ensemble as a compressed npz file without pickle; returns its path.

        Raises:
            FileError: The path cannot be written.
        """
        return save_npz(path, FORMAT, self)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Ensemble:
        """Read an ensemble that :meth:`save` wrote.

        Raises:
            FileError: The file is missing, truncated, not npz or not an ensemble, or has inconsistent arrays.
        """
        source = path_like("path", path)
        return record_of(cls, read_npz(source, FORMAT), source)

    def __repr__(self) -> str:
        counted = int(self.statistics.count[0])
        kept = "" if self.q is not None else ", not stored"
        lost = f", {len(self.failures)} stopped early" if self.failures else ""
        return (
            f"Ensemble({counted} paths{kept} over {len(self.t) - 1} steps, {self.t[-1] - self.t[0]:g} s, "
            f"{self.integrator}{lost}{warning_count(self.warnings)})"
        )

    def __str__(self) -> str:
        own = self.statistics
        energy = f"energy [J]: {own.energy_mean[-1]:.4g} +- {own.energy_deviation[-1]:.2g} in the end"
        return "\n".join([repr(self), energy, *warning_lines(self.warnings)])

    def _repr_html_(self) -> str:
        mean, deviation = self.statistics.mean[-1], np.sqrt(np.diagonal(self.statistics.covariance[-1]))
        n = len(self.joint_names)
        columns = {"mean of q in the end [rad or m]": mean[:n], "standard deviation": deviation[:n]}
        return super()._repr_html_() + joint_table(self.joint_names, columns)


class PathsInterrupted(KeyboardInterrupt):
    """Ctrl-C while paths are simulated.

    Attributes:
        result: The :class:`Ensemble` of the paths that were finished, in order from the first, or their
            :class:`MonteCarlo`; None if they are too few.
    """

    def __init__(self, result: Any, done: int) -> None:
        self.result = result
        super().__init__(f"interrupted after {done} paths" + ("; they are in .result" if result is not None else ""))
