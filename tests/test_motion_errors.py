"""Wrong motions are told, right ones are left alone, and ``Trajectory.error`` is the true error: cheap random motions.

``python tests/random_motions.py`` judges hundreds of them.
"""

import functools
from types import SimpleNamespace

import numpy as np
import pytest
from random_motions import RIGHT, WRONG, draw, judge, truth

# Of methods that are given, so that no better choice makes them right.
WRONG_MOTIONS = (13, 20, 52, 54, 65, 94, 143, 154, 224, 226, 248, 264, 284)
# Chaotic ones, and blows within a step, by the default method.
HARD_MOTIONS = (55, 68, 107, 131, 133, 146, 237, 300, 328, 380)
# Blows that no stage of a step sees, and that move the robot elsewhere.
MISSED_BLOWS = (81, 185, 250, 341)
RIGHT_MOTIONS = (
    *(26, 208, 105, 196, 28, 145, 187, 252, 98, 293, 358, 8, 24, 115, 307),
    *(100, 165, 178, 263, 276, 82, 251, 303, 58, 266, 49, 75, 361, 103, 350),
)


@functools.cache
def judged(seed):
    """The motion of a seed, its true motion, and the verdict on it."""
    case = draw(seed)
    motion, real = case.simulate(), truth(case)
    return case, motion, real, judge(case, motion, real)


@pytest.mark.parametrize("seed", [*WRONG_MOTIONS, *HARD_MOTIONS, *MISSED_BLOWS])
def test_no_wrong_motion_is_untold(seed):
    case, _, _, verdict = judged(seed)
    assert "unknown" not in verdict.labels, case
    assert "off" in verdict.labels or seed not in WRONG_MOTIONS, f"{case}: {verdict}"
    assert "untold" not in verdict.labels, f"{case}: {verdict}"


@pytest.mark.parametrize("seed", RIGHT_MOTIONS)
def test_no_right_motion_is_told(seed):
    case, _, _, verdict = judged(seed)
    assert "right" in verdict.labels, f"{case}: {verdict}"
    assert not verdict.labels & {"told", "loop"}, f"{case}: {verdict}"


@pytest.mark.parametrize("seed", [*WRONG_MOTIONS, *HARD_MOTIONS, *MISSED_BLOWS, *RIGHT_MOTIONS])
def test_the_estimated_error_is_the_true_one(seed):
    case, motion, _, verdict = judged(seed)
    assert motion.error.shape == motion.q.shape
    assert np.isnan(verdict.factor) or 0.5 <= verdict.factor <= 2.0, f"{case}: {verdict}"


@pytest.mark.parametrize("seed", [26, 208, 58, 307])
def test_the_judge_knows_wrong_from_right(seed):
    """The true motion itself is right; shifted by a little more than what is wrong it is wrong, and untold."""
    case, _, (states, doubt), _ = judged(seed)
    exact = SimpleNamespace(q=states[0], v=states[1], warnings=())
    assert judge(case, exact, (states, doubt)).labels == {"right"}
    for part, limit in enumerate((WRONG, RIGHT)):
        other, size = states.copy(), np.ptp(states[0], axis=0).max()
        other[0, -1] += 1.01 * limit[0] * size
        labels = judge(case, exact, (other, doubt)).labels
        assert ("off" in labels, "untold" in labels, "right" in labels) == (part == 0, part == 0, False)
