"""Reaches of a UR5 and of a Panda against crocoddyl's FDDP: at equal dt, and to the same true cost.

    PYTHONPATH=src python benchmarks/reaches.py

In the environment of crocoddyl_reference.py; both single-threaded, in turns, in one process. An arm brings its tool to
a place and an orientation in one second and comes to rest there: running costs on torques (in units of the motors'
limits) and velocities, terminal ones on the tool and the velocities, no limits. Both begin cold: at q0, with the
torques that hold the arm there. True costs are open loop: of the controls alone, applied to the continuous arm.
varpin's look at a finished plan is left out, as crocoddyl takes none.
"""

from collections.abc import Callable
from dataclasses import dataclass

import crocoddyl
import numpy as np
import pinocchio as pin
from crocoddyl_reference import require_gravity
from timing import in_turns

import varpin as vp
from varpin.control.verification import played
from varpin.signals.commands import open_loop

DURATION = 1.0
TOLERANCE = 1e-6
LADDER = (10, 14, 20, 28, 40, 56, 80, 112, 160, 226, 320, 452, 640, 904, 1280, 1810, 2560)
WITHIN = 0.01


@dataclass(frozen=True)
class Reach:
    """The tool of a robot goes from where it is at ``begin`` to where it is at ``goal``."""

    robot: vp.Robot
    tool: str
    begin: tuple[float, ...]
    goal: tuple[float, ...]
    torque: float = 1.0
    speed: float = 1.0
    place: float = 1e5
    turn: float = 1e4
    stop: float = 10.0

    def target(self) -> pin.SE3:
        model = self.robot.model
        data = model.createData()
        pin.framesForwardKinematics(model, data, self.robot.configuration(np.array(self.goal)))
        return data.oMf[model.getFrameId(self.tool)].copy()

    def effort(self) -> np.ndarray:
        """Weights of the torques [1 / (N m)^2]."""
        return self.torque / self.robot.effort_limit**2

    def ours(self, N: int, integrator: vp.Integrator) -> vp.OptimalControlProblem:
        target, speed = self.target(), vp.VelocityCost(1.0)
        cost = vp.ControlCost(self.effort()) + self.speed * speed
        cost += vp.Terminal(
            vp.FramePositionCost(self.robot, self.tool, target.translation, self.place)
            + vp.FrameOrientationCost(self.robot, self.tool, target.rotation, self.turn)
            + self.stop * speed
        )
        rest = np.zeros(self.robot.dof)
        scene = vp.Scene(self.robot)
        return vp.OptimalControlProblem(scene, cost, self.begin, rest, dt=DURATION / N, steps=N, integrator=integrator)

    def theirs(self, N: int, integrator: str) -> crocoddyl.ShootingProblem:
        model, target, n = self.robot.model, self.target(), self.robot.dof
        state = crocoddyl.StateMultibody(model)
        actuation = crocoddyl.ActuationModelFull(state)
        frame = model.getFrameId(self.tool)
        # crocoddyl's activations are halved.
        at_rest = crocoddyl.CostModelResidual(
            state,
            crocoddyl.ActivationModelWeightedQuad(np.repeat([0.0, 2.0], n)),
            crocoddyl.ResidualModelState(state, n),
        )
        effort = crocoddyl.CostModelResidual(
            state,
            crocoddyl.ActivationModelWeightedQuad(2.0 * self.effort()),
            crocoddyl.ResidualModelControl(state, n),
        )
        place = crocoddyl.ResidualModelFrameTranslation(state, frame, target.translation, n)
        turn = crocoddyl.ResidualModelFrameRotation(state, frame, target.rotation, n)
        running, end = crocoddyl.CostModelSum(state), crocoddyl.CostModelSum(state)
        running.addCost("torque", effort, 1.0)
        running.addCost("speed", at_rest, self.speed)
        end.addCost("place", crocoddyl.CostModelResidual(state, place), 2.0 * self.place)
        end.addCost("turn", crocoddyl.CostModelResidual(state, turn), 2.0 * self.turn)
        end.addCost("speed", at_rest, self.stop)
        moving, last = (crocoddyl.DifferentialActionModelFreeFwdDynamics(state, actuation, c) for c in (running, end))
        dt = DURATION / N
        if integrator == "Euler":
            node = crocoddyl.IntegratedActionModelEuler(moving, dt)
        else:
            node = crocoddyl.IntegratedActionModelRK(moving, crocoddyl.RKType.four, dt)
        start = np.concatenate([self.begin, np.zeros(n)])
        made = crocoddyl.ShootingProblem(start, [node] * N, crocoddyl.IntegratedActionModelEuler(last, 0.0))
        made.nthreads = 1
        return made

    def fddp(self, N: int, integrator: str, threshold: float, most: int) -> Callable[[], np.ndarray]:
        made, model = self.theirs(N, integrator), self.robot.model
        rest = np.zeros(model.nv)
        hold = pin.rnea(model, model.createData(), np.array(self.begin), rest, rest)

        def run() -> np.ndarray:
            solver = crocoddyl.SolverFDDP(made)
            solver.th_stop = threshold
            solver.solve([made.x0] * (N + 1), [hold] * N, most, False)
            return np.array(solver.us)

        return run


def reaches() -> dict[str, Reach]:
    panda = vp.load_robot("panda", lock={"panda_finger_joint1": 0.02})
    return {
        "ur5": Reach(vp.load_robot("ur5"), "tool0", (0.0, -1.5, 0.8, -0.5, 0.0, 0.0), (0.9, -1.0, 1.2, -0.9, 0.5, 0.3)),
        "panda": Reach(
            panda,
            "panda_hand",
            (0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8),
            (0.7, 0.2, 0.3, -1.4, 0.2, 1.9, 0.4),
        ),
    }


def whole_solves(name: str, reach: Reach) -> None:
    model = reach.robot.model
    rest = np.zeros(model.nv)
    hold = pin.rnea(model, model.createData(), np.array(reach.begin), rest, rest)
    for N in (50, 100, 200, 1000):
        problem, made = reach.ours(N, vp.Midpoint()), reach.theirs(N, "Euler")
        first = problem.holding_policy()
        plan = vp.solve(problem, first, tolerance=TOLERANCE, check=False)
        solver = crocoddyl.SolverFDDP(made)
        solver.th_stop = TOLERANCE * plan.cost
        start = [made.x0] * (N + 1), [hold] * N
        runs = {
            "ours": lambda problem=problem, first=first: vp.solve(problem, first, tolerance=TOLERANCE, check=False),
            "theirs": lambda solver=solver, start=start: solver.solve(*start, 100, False),
        }
        ours, theirs = (own.min() for own in in_turns(runs, 7).values())
        a, b = len(plan.history), solver.iter + 1
        print(
            f"  {name:6} N = {N:5d}  varpin Midpoint {1e3 * ours:7.2f} ms, {a:2d} iterations  "
            f"crocoddyl FDDP, Euler {1e3 * theirs:7.2f} ms, {b:2d}  "
            f"ratio {ours / theirs:5.2f}, of an iteration {ours / a / (theirs / b):5.2f}"
        )


def same_true_cost(name: str, reach: Reach) -> None:
    reference = vp.solve(reach.ours(1000, vp.RungeKutta4()), tolerance=1e-10, check=False)
    optimum = reference.verify(tolerance=1e-9).open_loop_cost
    methods = {
        "varpin Midpoint": vp.Midpoint(),
        "varpin Gauss(2)": vp.Gauss(2),
        "varpin RungeKutta4": vp.RungeKutta4(),
        "crocoddyl FDDP Euler": None,
        "crocoddyl FDDP RK4": None,
    }
    best: dict[str, float] = {}
    for label, integrator in methods.items():
        for N in LADDER:
            problem = reach.ours(N, integrator or vp.Midpoint())
            if integrator is not None:
                if isinstance(integrator, vp.Gauss):
                    problem = problem.at(sampling="gauss")
                run = lambda problem=problem: vp.solve(problem, tolerance=1e-4, check=False).controls  # noqa: E731
            else:
                run = reach.fddp(N, label.split()[-1], 1e-4 * optimum, 100)
            commands = open_loop(run())._replace(hold=64)
            cost = played(problem, problem.in_parts(64), commands, vp.RungeKutta4()).cost
            excess = cost / optimum - 1.0
            if abs(excess) <= WITHIN:
                seconds = in_turns({"": run}, 7)[""].min()
                best[label] = seconds
                print(f"  {name:6} {label:22} N = {N:5d} {1e3 * seconds:9.2f} ms  {excess:+.2%}")
                break
        else:
            print(f"  {name:6} {label:22} not within {WITHIN:.0%} at N = {LADDER[-1]}: {excess:+.2%}")
    ours = min(seconds for label, seconds in best.items() if label.startswith("varpin"))
    theirs = {label: seconds for label, seconds in best.items() if label.startswith("crocoddyl")}
    for label, seconds in theirs.items():
        print(f"  {name:6} varpin's best / {label}: {ours / seconds:.2f}")


def main() -> None:
    everything = reaches()
    require_gravity(everything["ur5"].robot.model)
    print("cold solves at equal dt; ratios are varpin / crocoddyl")
    for name, reach in everything.items():
        whole_solves(name, reach)
    print(f"cold solve to a true cost within {WITHIN:.0%} of the optimum")
    for name, reach in everything.items():
        same_true_cost(name, reach)


if __name__ == "__main__":
    main()
