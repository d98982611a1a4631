"""The gradient of an expected cost the slow way, by differences of the total."""

import numpy as np
from varpin.control.backward import backward

import varpin as vp
from varpin.control.along import Along
from varpin.control.spread import Feedback


def expected_cost_slopes(problem: vp.OptimalControlProblem, made, u: np.ndarray):
    """The solver's gradient of the expected cost, that by differences of it, and that with S held, each like ``u``.

    ``made`` returns the motion of the controls ``u`` (R, m). The cost is that of the motion and the noise's share, by a
    backward pass of its own.
    """

    def cost(controls: np.ndarray) -> float:
        motion = made(controls)
        return problem.cost_of(motion) + backward(problem, motion, 0.0).noise

    motion = made(u)
    plan = backward(problem, motion, 0.0)
    along = Along(problem, motion)
    along.differentiate_noise(Feedback(plan.feedback, plan.previous), plan.spread, np.ones_like(problem.steered))
    whole, step, found = backward(problem, motion, 0.0, along=along).gradient, 1e-4, np.empty_like(u)
    for index in np.ndindex(u.shape):
        away = np.zeros_like(u)
        away[index] = step
        near, far = (cost(u + k * away) - cost(u - k * away) for k in (1, 2))
        found[index] = (8.0 * near - far) / (12.0 * step)
    return whole, found, plan.gradient
