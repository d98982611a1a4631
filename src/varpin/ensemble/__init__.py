"""Many noisy paths of one scene, and their statistics."""

from varpin.ensemble.record import Ensemble, EnsembleInterrupted, EnsembleStatistics, PathFailure
from varpin.ensemble.run import simulate_ensemble

__all__ = ["Ensemble", "EnsembleInterrupted", "EnsembleStatistics", "PathFailure", "simulate_ensemble"]
