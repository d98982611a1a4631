"""The expected cost of a policy, by simulation."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from varpin.checks import count
from varpin.ensemble import simulate_ensemble
from varpin.errors import InputError, VarpinError
from varpin.policy import LinearPolicy
from varpin.sddp.problem import OptimalControlProblem
from varpin.sddp.verification import excess, percent
from varpin.simulation import NoiseError, StepFailure
from varpin.wiener import generator

Floats = NDArray[np.float64]

# Paths that are kept at a time to add up their costs; few, so that Ctrl-C loses little.
_PATHS, _PATHS_PER_WORKER = 256, 32


@dataclass(frozen=True)
class MonteCarlo:
    """The expected cost of a policy, by simulation.

    Attributes:
        cost: Mean over the paths.
        standard_error: Of the mean.
        predicted: By the solver's model.
        paths: How many were counted.
        failures: Paths that could not be finished; they are not counted.
    """

    cost: float
    standard_error: float
    predicted: float
    paths: int
    failures: int

    def __str__(self) -> str:
        gap = self.cost - self.predicted
        apart = f", {gap / self.standard_error:+.1f} standard errors" if self.standard_error > 0.0 else ""
        lost = f"; {self.failures} more ran away and are not counted" if self.failures else ""
        return "\n".join(
            [
                f"{'':16}{'expected cost':>14}",
                f"{'simulated':16}{self.cost:14.6e} +- {self.standard_error:.1e} ({self.paths} paths{lost})",
                f"{'predicted':16}{self.predicted:14.6e}",
                f"{'difference':16}{gap:+14.6e} ({percent(excess(self.cost, self.predicted))}{apart})",
                "read it so: within three standard errors (+-) the two agree; beyond, noise is too strong for the "
                "model",
            ]
        )


class MonteCarloInterrupted(KeyboardInterrupt):
    """Ctrl-C during :meth:`Solution.monte_carlo`.

    Attributes:
        result: Of the paths done so far; None if there are fewer than two.
    """

    def __init__(self, result: MonteCarlo | None) -> None:
        self.result = result
        done = 0 if result is None else result.paths + result.failures
        super().__init__(f"interrupted after {done} paths" + ("; they are in .result" if done else ""))


def monte_carlo(
    problem: OptimalControlProblem,
    policy: LinearPolicy,
    predicted: float,
    paths: int,
    rng: np.random.Generator | int,
    *,
    workers: int | None,
    progress: Callable[[int, int], None] | None,
) -> MonteCarlo:
    """As :meth:`Solution.monte_carlo` says, of any policy."""
    draws, paths = generator(rng), count("paths", paths, least=2)
    workers = count("workers", (os.cpu_count() or 1) if workers is None else workers, least=1)
    compiled = problem.scene.noise.diffusion is not None
    most = min(_PATHS, _PATHS_PER_WORKER * workers) if compiled else 1
    costs: list[Floats] = []
    try:
        for first in range(0, paths, most):
            batch = min(most, paths - first)
            costs.append(
                _together(problem, batch, draws, policy, workers) if compiled else _alone(problem, draws, policy)
            )
            if progress is not None:
                progress(first + batch, paths)
    except KeyboardInterrupt:
        raise MonteCarloInterrupted(_mean(costs, predicted)) from None
    result = _mean(costs, predicted)
    if result is None:
        raise VarpinError(f"fewer than two of {paths} paths got to the end; a smaller dt may help")
    return result


def _together(
    problem: OptimalControlProblem, paths: int, draws: np.random.Generator, policy: LinearPolicy, workers: int
) -> Floats:
    """Costs of some paths (P,), NaN where one failed."""
    try:
        ensemble = simulate_ensemble(
            problem.scene,
            problem.q0,
            problem.v0,
            dt=problem.dt,
            steps=problem.steps,
            paths=paths,
            rng=draws,
            controls=policy,
            integrator=problem.integrator,
            quantiles=(),
            workers=workers,
        )
    except InputError:
        raise
    except VarpinError:  # every path failed
        return np.full(paths, np.nan)
    if ensemble.q is None or ensemble.v is None or ensemble.u is None:
        return np.full(paths, np.nan)
    return problem.costs(ensemble.q, ensemble.v, ensemble.u)


def _alone(problem: OptimalControlProblem, draws: np.random.Generator, policy: LinearPolicy) -> Floats:
    """The cost of a path (1,), NaN where it failed."""
    (child,) = draws.spawn(1)
    try:
        motion = problem.simulate(policy, rng=child)
    except (StepFailure, NoiseError):
        return np.full(1, np.nan)
    return np.array([problem.cost_of(motion)])


def _mean(costs: Sequence[Floats], predicted: float) -> MonteCarlo | None:
    values = np.concatenate([np.zeros(0), *costs])
    good = values[np.isfinite(values)]
    if len(good) < 2:
        return None
    return MonteCarlo(
        cost=float(good.mean()),
        standard_error=float(good.std(ddof=1) / np.sqrt(len(good))),
        predicted=predicted,
        paths=len(good),
        failures=len(values) - len(good),
    )
