"""Model predictive control of a UR5 at 100 Hz: what planning takes, and how far the tool is from its moving target.

    python benchmarks/mpc.py

The task of examples/mpc_moving_target.py: 50 nodes of 10 ms ahead, one iteration a tick, on a plant that RungeKutta4
integrates at a tenth of the step. Once without surprises, once under noise, and once with noise and a payload of 0.3 kg
that the controller does not know; budget 10 ms, so that a plan that comes later does not act. Writes the table of
``docs/control-loop.md`` between its markers.

In the environment of crocoddyl_reference.py instead: ticks of crocoddyl's FDDP on Euler's map in turns with varpin's,
each on its own model, one iteration from the last plan, moved on by a node.
"""

import gc
import importlib
import importlib.util
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from pages import fill

import varpin as vp

DOCUMENT = Path(__file__).resolve().parents[1] / "docs" / "control-loop.md"
BEGIN = np.array([0.0, -1.5, 1.2, -1.2, -1.5, 0.0])
SEEDS = range(4)
NOISE = vp.AdditiveNoise(0.02)


def target(t: float) -> list[float]:
    """Where the flange is to be [m]."""
    return [0.45 + 0.1 * np.sin(2.0 * t), 0.15 + 0.15 * np.cos(1.3 * t), 0.4 + 0.1 * np.sin(1.7 * t)]


def controller(robot: vp.Robot, integrator: vp.Integrator) -> vp.Mpc:
    scene = vp.Scene(robot, damping=0.05)
    hold = -vp.lagrangian_jet(scene, BEGIN, np.zeros(robot.dof)).Lq
    cost = vp.FramePositionCost(robot, "tool0", target, 1e3) + vp.VelocityCost(0.05) + vp.ControlCost(1e-4, hold)
    cost += vp.Terminal(vp.FramePositionCost(robot, "tool0", target, 1e2) + vp.VelocityCost(0.5))
    rest = np.zeros(robot.dof)
    problem = vp.OptimalControlProblem(scene, cost, BEGIN, rest, dt=1e-2, steps=50, integrator=integrator)
    return vp.Mpc(problem, iterations=1, budget=1e-2)


def off_target(robot: vp.Robot, motion: vp.Trajectory) -> float:
    """Root mean square distance of the tool from the target after the first second [mm]."""
    late = motion.t > 1.0
    tip = robot.frame_positions(motion.q[late], "tool0")
    error = np.linalg.norm(tip - [target(t) for t in motion.t[late]], axis=1)
    return float(1e3 * np.sqrt((error**2).mean()))


def row(name: str, mpc: vp.Mpc, plants: dict[str, vp.Scene], robot: vp.Robot) -> str:
    mpc.run(duration=0.05)
    # A full pass of the garbage collector over all that has been imported takes 0.1 s.
    gc.freeze()
    seconds, misses, cells = [], 0, []
    for scene in plants.values():
        off = []
        for seed in SEEDS if scene.processes else range(1):
            run = mpc.run(vp.Plant(scene), duration=4.0, rng=seed)
            off.append(off_target(robot, run.motion))
            seconds.append(run.seconds[1:])
            misses += int(run.late.sum())
        spread = f" ± {np.std(off, ddof=1) / np.sqrt(len(off)):.2f}" if len(off) > 1 else ""
        cells.append(f"{np.mean(off):.2f}{spread}")
    took = 1e3 * np.concatenate(seconds)
    times = f"{took.mean():.2f} | {np.quantile(took, 0.95):.2f} | {took.max():.2f} | {misses} of {len(took)}"
    return f"| {name} | {times} | {' | '.join(cells)} |"


def fddp_ticks(robot: vp.Robot, mpc: vp.Mpc) -> Callable[[int], float]:
    """The ticks of crocoddyl's FDDP, one after another: what each took [s], new targets left out."""
    crocoddyl = importlib.import_module("crocoddyl")
    n, steps, dt = robot.dof, mpc.problem.steps, mpc.problem.dt
    hold = mpc.problem.scene.holding_torque(BEGIN)
    state = crocoddyl.StateMultibody(robot.model)
    actuation = crocoddyl.ActuationModelFull(state)
    # crocoddyl's activations are halved.
    at_rest = crocoddyl.CostModelResidual(
        state,
        crocoddyl.ActivationModelWeightedQuad(np.repeat([0.0, 2.0], n)),
        crocoddyl.ResidualModelState(state, n),
    )
    effort = crocoddyl.CostModelResidual(state, crocoddyl.ResidualModelControl(state, hold))
    places, nodes = [], []
    for k in range(steps + 1):
        places.append(crocoddyl.ResidualModelFrameTranslation(state, robot.model.getFrameId("tool0"), np.zeros(3), n))
        cost, last = crocoddyl.CostModelSum(state), k == steps
        cost.addCost("place", crocoddyl.CostModelResidual(state, places[-1]), 2e2 if last else 2e3)
        cost.addCost("speed", at_rest, 0.5 if last else 0.05)
        if not last:
            cost.addCost("effort", effort, 2e-4)
        moving = crocoddyl.DifferentialActionModelFreeFwdDynamics(state, actuation, cost)
        nodes.append(crocoddyl.IntegratedActionModelEuler(moving, 0.0 if last else dt))
    made = crocoddyl.ShootingProblem(np.concatenate([BEGIN, np.zeros(n)]), nodes[:-1], nodes[-1])
    made.nthreads = 1
    solver = crocoddyl.SolverFDDP(made)
    plan = [made.x0] * (steps + 1), [hold] * steps

    def tick(number: int) -> float:
        for k, place in enumerate(places):
            place.reference = np.array(target(dt * (number + k)))
        begin = time.perf_counter()
        if number > 0:
            made.x0 = plan[0][1]
            solver.solve([*plan[0][1:], plan[0][-1]], [*plan[1][1:], plan[1][-1]], 1, False)
        else:
            solver.solve(*plan, 100, False)
        took = time.perf_counter() - begin
        plan[0][:], plan[1][:] = solver.xs, solver.us
        return took

    tick(0)
    return tick


def against_crocoddyl(robot: vp.Robot, controllers: dict[str, vp.Mpc], ticks: int = 200) -> None:
    """Ticks in turns, in one process: on a noisy machine their ratios are what counts."""
    loops = {name: vp.Mpc(mpc.problem, iterations=1) for name, mpc in controllers.items()}
    plans = {name: mpc.plan(0.0, BEGIN, np.zeros(robot.dof)) for name, mpc in loops.items()}
    fddp = fddp_ticks(robot, loops["ExplicitEuler"])
    seconds: dict[str, list[float]] = {name: [] for name in (*loops, "FDDP")}
    gc.freeze()
    for k in range(1, ticks + 1):
        for name, mpc in loops.items():
            motion = plans[name].trajectory
            begin = time.perf_counter()
            plans[name] = mpc.plan(k * mpc.period, motion.q[1], motion.v[1], plans[name])
            seconds[name].append(time.perf_counter() - begin)
        seconds["FDDP"].append(fddp(k))
    theirs = np.array(seconds.pop("FDDP"))
    least, median = theirs.min(), np.median(theirs)
    print(f"ticks of FDDP: {1e3 * least:.2f} ms at least, {1e3 * median:.2f} in the median; others as multiples")
    for name, own in seconds.items():
        print(f"  {name:18} {min(own) / least:5.2f} {np.median(own) / median:5.2f}")


def main() -> None:
    robot, heavier = vp.load_robot("ur5"), vp.load_robot("ur5", payload=vp.Payload("tool0", mass=0.3))
    make: Callable[..., vp.Scene] = vp.Scene
    plants = {
        "as modelled": make(robot, damping=0.05),
        "noise": make(robot, damping=0.05, noise=NOISE),
        "noise and payload": make(heavier, damping=0.05, noise=NOISE),
    }
    integrators = {
        "Midpoint": vp.Midpoint(),
        "SemiImplicitEuler": vp.SemiImplicitEuler(),
        "ExplicitEuler": vp.ExplicitEuler(),
    }
    if importlib.util.find_spec("crocoddyl") is not None:
        against_crocoddyl(robot, {name: controller(robot, integrator) for name, integrator in integrators.items()})
        return
    table = [
        f"| plans with | mean [ms] | 95% [ms] | most [ms] | late | {' | '.join(f'{name} [mm]' for name in plants)} |",
        "|---" * (5 + len(plants)) + "|",
        *(row(name, controller(robot, integrator), plants, robot) for name, integrator in integrators.items()),
    ]
    print("\n".join(table))
    fill(DOCUMENT, {"mpc": "\n".join(table)})


if __name__ == "__main__":
    main()
