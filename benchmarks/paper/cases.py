"""The paper's finger, its cost and its three noises; and what the paper leaves open, in several ways.

Taken from the text: the cost, the horizon, the reference, the noise fields and the search's parameters. Not in the
text are the finger's parameters, its initial state, gravity, friction, the first controls and the powers of ten of the
noise: those here are chosen for their meaning and not for what comes out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from varpin.control import OptimalControlProblem
from varpin.control.costs import ControlCost, Cost, Terminal, TrackingCost
from varpin.integrators import ExplicitEuler, Gauss, Integrator, Midpoint
from varpin.mechanics.noise import AdditiveNoise, ControlNoise, Noise, StateNoise
from varpin.mechanics.scene import Scene
from varpin.model import Robot, load_robot

DURATION = 1.5
STEPS = (1e-4, 5e-4, 1e-3, 2e-3, 4e-3, 6e-3, 1e-2, 2e-2)
QUICK_STEPS = (1e-3, 2e-3, 6e-3, 2e-2)
FINE, COARSE, COARSEST = 1e-4, 6e-3, 2e-2
ON_REFERENCE = (1.0, 0.0, 0.0)
OFF_REFERENCE = (0.7, 0.2, -0.1)
# q0 [rad] and v0 [rad/s] of figure 1.
FREE_START = ((np.pi / 2.0, 0.0, 0.0), (0.0, 0.0, 1.0))
# In the vertical plane, the finger hanging down at theta = 0.
HANGING = (9.81, 0.0, 0.0)

METHODS: dict[str, Integrator] = {"variational": Midpoint(), "Euler": ExplicitEuler()}
# Beyond the paper: variational and of fourth order, its running cost too.
FOURTH_ORDER = "fourth-order"


def reference(t: float) -> tuple[float, float, float]:
    """theta_r(t) [rad]."""
    return 1.0 + 0.25 * np.sin(4.0 * np.pi * t), 0.1 * np.sin(2.0 * np.pi * t), 0.0


def cost() -> Cost:
    """Integral of 10 |theta - theta_r|^2 + 0.1 |u|^2, and |theta - theta_r|^2 at the end."""
    return TrackingCost(reference, 10.0) + ControlCost(0.1) + Terminal(TrackingCost(reference, 1.0))


@dataclass(frozen=True)
class Case:
    """One of the paper's noises.

    Attributes:
        key: For file names.
        title: For people.
        noise: The model.
    """

    key: str
    title: str
    noise: Noise


CASES = (
    Case("1", "white noise, C = 5e-7", AdditiveNoise(5e-7)),
    Case("2", "control-dependent noise, C = 5e-4", ControlNoise(5e-4)),
    Case("3", "state-dependent noise, C = 5e-4", StateNoise(5e-4)),
)


@dataclass(frozen=True)
class Setting:
    """What the paper leaves open, decided one way.

    Attributes:
        key: For file names.
        title: For people.
        heavier: Factor on masses and inertias of the anatomical finger.
        q0: Where it starts from rest [rad].
        gravity: [m/s^2]; the finger moves in the horizontal plane, where the usual one does no work.
    """

    key: str
    title: str
    heavier: float = 1.0
    q0: tuple[float, float, float] = ON_REFERENCE
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)


MAIN = Setting("main", "anatomical finger in the horizontal plane, at rest on the reference")
VARIATIONS = (
    Setting("off", "at rest off the reference", q0=OFF_REFERENCE),
    Setting("gravity", "moving in the vertical plane", gravity=HANGING),
    Setting("heavier-10", "ten times heavier", heavier=10.0),
    Setting("heavier-1000", "a thousand times heavier", heavier=1000.0),
    Setting(
        "heavier-1000-off", "a thousand times heavier, off the reference, in the vertical plane", 1000.0,
        OFF_REFERENCE, HANGING,
    ),
)  # fmt: skip
# Where the noise matters: control-dependent, up to ten times case 2, in the vertical plane.
NOISY = Setting("noisy", "moving in the vertical plane under stronger control-dependent noise", gravity=HANGING)
NOISY_STEP = 2e-3
NOISY_STRENGTHS = (5e-4, 1e-3, 2e-3, 3e-3, 5e-3)
QUICK_STRENGTHS = (1e-3, 2e-3)


def noisy_case(strength: float) -> Case:
    """Control-dependent noise of a given strength C [s^0.5]."""
    return Case(f"2-{strength:g}", f"control-dependent noise, C = {strength:g}", ControlNoise(strength))


def strength_of(key: str) -> float:
    """The strength C in the key of a :func:`noisy_case`."""
    return float(key.split("-", 1)[1])


def finger(heavier: float = 1.0) -> Robot:
    """The bundled finger, its masses and inertias multiplied."""
    robot = load_robot("finger")
    if heavier == 1.0:
        return robot
    model = robot.model.copy()
    for inertia in model.inertias:
        inertia.mass *= heavier
        inertia.inertia = inertia.inertia * heavier
    return load_robot(model)


def problem(setting: Setting, case: Case | None, method: str, dt: float) -> OptimalControlProblem:
    """The paper's problem; without a case, without noise."""
    scene = Scene(finger(setting.heavier), gravity=setting.gravity, noise=None if case is None else case.noise)
    steps = round(DURATION / dt)
    fourth = method == FOURTH_ORDER
    return OptimalControlProblem(
        scene,
        cost(),
        setting.q0,
        np.zeros(3),
        dt=DURATION / steps,
        steps=steps,
        integrator=Gauss(stages=2) if fourth else METHODS[method],
        sampling="gauss" if fourth else "midpoint",
    )
