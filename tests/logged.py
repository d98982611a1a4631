"""What encoders and drives of a UR5 tell under made-up torques, of which parameters are to be found again."""

import functools

import numpy as np

import varpin as vp

DAMPING = np.array([2.0, 1.5, 1.0, 0.3, 0.2, 0.1])
TRUTH = np.append(DAMPING, 2.0)
NAMES = ["damping", "payload"]
NOISE = 2e-4
MIDDLE = np.array([0.0, -1.2, 1.2, -0.5, 0.5, 0.0])


def start(**options):
    """The scene without what is to be found."""
    return vp.Scene(vp.load_robot("ur5"), damping=0.0, **options)


@functools.cache
def motion(late=0, damping=tuple(DAMPING), friction=0.0, duration=2.0):
    """A UR5 with 2 kg under torques that are held for 10 ms, and act ``late`` ms later: by 1 ms steps of Gauss(3)."""
    robot = vp.load_robot("ur5", payload=vp.Payload("tool0", 2.0))
    scene = vp.Scene(robot, damping=damping, friction=friction)
    rng, N = np.random.default_rng(4), round(duration / 1e-2)
    phase, rate, size = rng.uniform(0, 6, (3, 6)), rng.uniform(0.3, 1.2, (3, 6)), rng.uniform(0.1, 0.4, (3, 6))

    def law(t, q, v):
        goal = MIDDLE + np.sum(size * np.sin(2.0 * np.pi * rate * t + phase), axis=0)
        M = scene.core.jets(q[None], v[None])[0][0]
        return scene.holding_torque(q) + M @ (100.0 * (goal - q) - 16.0 * v) + scene.damping * v

    options = {"dt": 1e-3, "steps": 10 * N, "integrator": vp.Gauss(3), "check": False}
    made = vp.simulate(scene, MIDDLE, np.zeros(6), controls=law, period=10, **options)
    if late:
        u = np.concatenate([np.repeat(made.u[:1], late, axis=0), made.u])[: 10 * N]
        return vp.simulate(scene, MIDDLE, np.zeros(6), controls=u, **options).q[::10], made.u[
            np.r_[0 : 10 * N : 10, -1]
        ]
    return made.q[::10], made.u[np.r_[0 : 10 * N : 10, -1]]
