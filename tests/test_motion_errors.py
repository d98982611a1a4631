"""Wrong motions are told, right ones are left alone, and ``Trajectory.error`` is the true error: cheap random motions.

``python tests/random_motions.py`` judges hundreds of them.
"""

import numpy as np
import pytest
from random_motions import draw, judge, truth

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


def judged(seed):
    """The motion of a seed, and the verdict on it."""
    case = draw(seed)
    motion = case.simulate()
    return case, motion, judge(case, motion, truth(case))


def estimated(motion, verdict):
    """Asserts that the estimated error is the true one."""
    assert motion.error.shape == motion.q.shape
    assert np.isnan(verdict.factor) or 0.5 <= verdict.factor <= 2.0, verdict


@pytest.mark.parametrize("seed", [*WRONG_MOTIONS, *HARD_MOTIONS, *MISSED_BLOWS])
def test_no_wrong_motion_is_untold(seed):
    case, motion, verdict = judged(seed)
    assert "unknown" not in verdict.labels, case
    assert "off" in verdict.labels or seed not in WRONG_MOTIONS, f"{case}: {verdict}"
    assert "untold" not in verdict.labels, f"{case}: {verdict}"
    estimated(motion, verdict)


@pytest.mark.parametrize("seed", RIGHT_MOTIONS)
def test_no_right_motion_is_told(seed):
    case, motion, verdict = judged(seed)
    assert "right" in verdict.labels, f"{case}: {verdict}"
    assert not verdict.labels & {"told", "loop"}, f"{case}: {verdict}"
    estimated(motion, verdict)
