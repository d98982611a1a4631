"""Many noisy paths of one scene, and their statistics."""

from varpin.ensemble.record import Ensemble, EnsembleStatistics, PathFailure, PathsInterrupted
from varpin.ensemble.run import simulate_ensemble

__all__ = ["Ensemble", "EnsembleStatistics", "PathFailure", "PathsInterrupted", "simulate_ensemble"]
