"""Times of runs that take turns in one process: on a shared machine their ratios are what counts."""

import time
from collections.abc import Callable, Mapping

import numpy as np


def in_turns(
    runs: Mapping[str, Callable[[], object]], rounds: int = 15, clock: Callable[[], float] = time.perf_counter
) -> dict[str, np.ndarray]:
    """Seconds of each run in each round (rounds,), after a round that does not count."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for k in range(rounds + 1):
        for name, run in runs.items():
            begin = clock()
            run()
            if k:
                times[name].append(clock() - begin)
    return {name: np.array(own) for name, own in times.items()}


def in_words(ratios: np.ndarray) -> str:
    """Median and range."""
    return f"{np.median(ratios):.2f} ({ratios.min():.2f} to {ratios.max():.2f})"
