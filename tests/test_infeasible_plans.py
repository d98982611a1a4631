"""Plans that no motion within the constraints makes: each says so, with the constraint, within bounded iterations."""

import numpy as np

import varpin as vp

ROBOT = vp.planar_chain(2)


def test_a_search_that_jumps_does_not_call_a_plan_infeasible():
    """Gauss(2) divides steps of fast dampers, and a motion of other parts is another one; Radau has a plan."""
    goal = np.array([0.019, 0.721])
    cost = vp.ControlCost(1e-4) + vp.Terminal(vp.TrackingCost(goal, 1e3) + vp.VelocityCost(10.0))

    def plan(integrator):
        return vp.solve(
            vp.OptimalControlProblem(
                vp.Scene(ROBOT, damping=[100.0, 10.0]),
                cost,
                np.zeros(2),
                np.zeros(2),
                dt=0.1,
                steps=6,
                integrator=integrator,
                constraints=[vp.WithinVelocityLimits(ROBOT, (-1.2, 1.2))],
            ),
            check=False,
        )

    jumping = plan(vp.Gauss(2))
    assert jumping.status is not vp.Status.INFEASIBLE
    assert plan(vp.Radau(2)).status.converged
