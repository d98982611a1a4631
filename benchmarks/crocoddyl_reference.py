"""Optimal-control problems solved by crocoddyl: the reference that tests compare with, tests/data/crocoddyl.json.

    python -m venv croco
    croco/bin/pip install "crocoddyl==3.2.1" "pin==4.0.0" "libpinocchio==4.0.0" \
        example-robot-data numpy scipy threadpoolctl u-msgpack-python meshcat matplotlib rich
    PYTHONPATH=src croco/bin/python benchmarks/crocoddyl_reference.py tests/data/crocoddyl.json

An environment of its own, because crocoddyl 3.2.1 was built against Pinocchio 4.0.0: beside pin 4.1.0 it loads, and
silently drops gravity. The script compares crocoddyl's forward dynamics with pin.aba first and stops if they differ.
varpin only loads the robots.

Every problem: minimize J = integral of wq |q - q_r(t)|^2 + wv |v|^2 + wu |u|^2 dt
+ Wq |q(tf) - q_r(tf)|^2 + Wv |v(tf)|^2, from rest at q0, u joint torques, each held over a step dt = tf / N.
Nothing is halved (crocoddyl's activations are, so its weights are twice ours). The finger's hinges are parallel to
gravity (0, 0, -9.81), which therefore does no work on it; the panda's is felt.

Solved in two discretizations, both by FDDP, cold: all nodes at q0 at rest, torques that hold it there.

    Euler   IntegratedActionModelEuler: v' = v + a dt, q' = q + v' dt; cost dt l at the left end of a step, hence
            a J of first order in dt.
    RK4     IntegratedActionModelRK, four stages, the cost with the same weights. crocoddyl holds q_r over a step: here
            at its middle, which makes J of second order (the left end would make it of first).

Two defaults of FDDP do not suit the finger, whose inertias are 3e-7 to 9e-5 kg m^2. th_stop = 1e-9 is 2e-4 of its J:
here 1e-14. And reg_min = 1e-9, which crocoddyl adds to the second derivatives of the value function at every node, is
more than some of those are at small dt; convergence is then linear (RK4, N = 5000: 14 and 38 iterations where 3 and 4
do): here 1e-14. For the panda the latter makes no difference. No other setting is touched. ``iterations`` counts the
last one; ``stop`` is the improvement crocoddyl predicted before it.

What is stored of a run: cost J of the discretization; cost_check, the same summed in numpy on pin.aba with the
largest defect of the dynamics on the way; true_cost, of the same held torques applied open loop to the continuous
robot (SciPy's DOP853, step by step). Of a problem: ``richardson``, J for dt -> 0 from the three finest runs, and from
the three before them: their distance is its uncertainty. And ``optimum``: Pontryagin's boundary-value problem of the
continuous problem by SciPy's solve_bvp, started from the finest RK4 run, its torques applied open loop as above. That
cost exceeds the infimum by the square of the error of the torques only, so the optimum is the most accurate number
here, and independent of crocoddyl's discretizations; its uncertainty is the distance to the solution at a tolerance
ten times as large, or 1e-9 of it if that is more.
"""

import json
import platform
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import crocoddyl
import numpy as np
import pinocchio as pin
from scipy.integrate import solve_bvp, solve_ivp

import varpin as vp

THRESHOLD = 1e-14
REGULARIZATION = 1e-14
ITERATIONS = 500
SAMPLES = 50
SMALL = 5000  # steps up to which the true cost is computed
PATIENCE = 10.0  # seconds up to which a solve is repeated
ATTEMPTS = 5
Reference = Callable[[float], np.ndarray]


@dataclass(frozen=True)
class Problem:
    """A tracking problem; ``weights`` are wq, wv, wu, Wq, Wv."""

    robot: str
    lock: dict[str, float]
    q0: tuple[float, ...]
    tf: float
    weights: tuple[float, float, float, float, float]
    reference: Reference
    formula: str
    steps: tuple[int, ...]

    def model(self) -> pin.Model:
        return vp.load_robot(self.robot, lock=self.lock or None).model

    def running(self, t: float, q: np.ndarray, v: np.ndarray, u: np.ndarray) -> float:
        wq, wv, wu = self.weights[:3]
        error = q - self.reference(t)
        return wq * (error @ error) + wv * (v @ v) + wu * (u @ u)

    def terminal(self, q: np.ndarray, v: np.ndarray) -> float:
        error = q - self.reference(self.tf)
        return self.weights[3] * (error @ error) + self.weights[4] * (v @ v)


def finger_reference(t: float) -> np.ndarray:
    return np.array([1.0 + 0.25 * np.sin(4.0 * np.pi * t), 0.1 * np.sin(2.0 * np.pi * t), 0.0])


PANDA_Q0 = (0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8)
PANDA_SWING = np.array([1.0, 0.5, -1.0, 0.5, 1.0, -0.5, 1.0])


def panda_reference(t: float) -> np.ndarray:
    return np.array(PANDA_Q0) + 0.3 * np.sin(2.0 * np.pi * t) * PANDA_SWING


def finger(q0: tuple[float, ...]) -> Problem:
    return Problem(
        robot="finger",
        lock={},
        q0=q0,
        tf=1.5,
        weights=(10.0, 0.0, 0.1, 1.0, 0.0),
        reference=finger_reference,
        formula="[1 + 0.25 sin(4 pi t), 0.1 sin(2 pi t), 0]",
        steps=(250, 500, 1000, 2000, 5000, 10000, 15000),
    )


PROBLEMS = {
    "finger": finger((1.0, 0.0, 0.0)),
    "finger_off_reference": finger((0.7, 0.2, -0.1)),
    "panda": Problem(
        robot="panda",
        lock={"panda_finger_joint1": 0.02},
        q0=PANDA_Q0,
        tf=1.0,
        weights=(10.0, 0.1, 1e-3, 100.0, 1.0),
        reference=panda_reference,
        formula="q0 + 0.3 sin(2 pi t) [1, 0.5, -1, 0.5, 1, -0.5, 1]",
        steps=(100, 200, 500, 1000, 2000, 5000),
    ),
}


@dataclass(frozen=True)
class Plan:
    """A solved run: states and torques by node, gradients of the value function, and what the solver says."""

    integrator: str
    N: int
    dt: float
    x: np.ndarray
    u: np.ndarray
    costates: np.ndarray
    cost: float
    iterations: int
    stop: float
    converged: bool
    seconds: float


def require_gravity(model: pin.Model) -> None:
    """Stop if crocoddyl and Pinocchio disagree on forward dynamics, at rest and in motion."""
    state = crocoddyl.StateMultibody(model)
    costs = crocoddyl.CostModelSum(state)
    free = crocoddyl.DifferentialActionModelFreeFwdDynamics(state, crocoddyl.ActuationModelFull(state), costs)
    data, own = free.createData(), model.createData()
    generator = np.random.default_rng(0)
    for scale in (0.0, 1.0):
        q, v = generator.normal(size=model.nv), scale * generator.normal(size=model.nv)
        free.calc(data, np.concatenate([q, v]), np.zeros(model.nv))
        expected = pin.aba(model, own, q, v, np.zeros(model.nv))
        if not np.allclose(data.xout, expected, rtol=1e-10, atol=1e-10):
            raise SystemExit("crocoddyl's forward dynamics is not Pinocchio's; is this pin 4.0.0?")


def shooting(problem: Problem, model: pin.Model, integrator: str, N: int) -> crocoddyl.ShootingProblem:
    n, dt = model.nv, problem.tf / N
    wq, wv, wu, Wq, Wv = problem.weights
    state = crocoddyl.StateMultibody(model)
    actuation = crocoddyl.ActuationModelFull(state)
    effort = crocoddyl.CostModelResidual(state, crocoddyl.ResidualModelControl(state, n))

    def dynamics(t: float, position: float, speed: float, torque: float) -> Any:
        costs = crocoddyl.CostModelSum(state)
        activation = crocoddyl.ActivationModelWeightedQuad(np.repeat([2.0 * position, 2.0 * speed], n))
        target = np.concatenate([problem.reference(t), np.zeros(n)])
        residual = crocoddyl.ResidualModelState(state, target, n)
        costs.addCost("state", crocoddyl.CostModelResidual(state, activation, residual), 1.0)
        if torque:
            costs.addCost("torque", effort, 2.0 * torque)
        return crocoddyl.DifferentialActionModelFreeFwdDynamics(state, actuation, costs)

    if integrator == "Euler":
        nodes = [crocoddyl.IntegratedActionModelEuler(dynamics(k * dt, wq, wv, wu), dt) for k in range(N)]
    else:
        four = crocoddyl.RKType.four
        nodes = [crocoddyl.IntegratedActionModelRK(dynamics((k + 0.5) * dt, wq, wv, wu), four, dt) for k in range(N)]
    end = crocoddyl.IntegratedActionModelEuler(dynamics(problem.tf, Wq, Wv, 0.0), 0.0)
    made = crocoddyl.ShootingProblem(np.concatenate([problem.q0, np.zeros(n)]), nodes, end)
    made.nthreads = 1
    return made


def solve(problem: Problem, model: pin.Model, integrator: str, N: int) -> Plan:
    """The run, its time the best of several where that takes little."""
    made = shooting(problem, model, integrator, N)
    rest = np.zeros(model.nv)
    hold = pin.rnea(model, model.createData(), np.array(problem.q0), rest, rest)
    best, spent = np.inf, 0.0
    for _ in range(ATTEMPTS):
        solver = crocoddyl.SolverFDDP(made)
        solver.th_stop = THRESHOLD
        solver.reg_min = REGULARIZATION
        start = time.perf_counter()
        done = solver.solve([made.x0] * (N + 1), [hold] * N, ITERATIONS, False)
        elapsed = time.perf_counter() - start
        best, spent = min(best, elapsed), spent + elapsed
        if spent > PATIENCE:
            break
    return Plan(
        integrator,
        N,
        problem.tf / N,
        np.array(solver.xs),
        np.array(solver.us),
        np.array(solver.Vx),
        solver.cost,
        solver.iter + 1,  # solver.iter counts from zero
        solver.stop,
        bool(done and solver.isFeasible),
        best,
    )


def check(problem: Problem, model: pin.Model, plan: Plan) -> tuple[float, float]:
    """The plan's cost summed in numpy, and the largest defect of its dynamics, by the definitions of the docstring."""
    data, n, dt = model.createData(), model.nv, plan.dt
    cost, defect = problem.terminal(plan.x[-1, :n], plan.x[-1, n:]), 0.0

    def rate(t: float, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, float]:
        return np.concatenate([x[n:], pin.aba(model, data, x[:n], x[n:], u)]), problem.running(t, x[:n], x[n:], u)

    for k in range(plan.N):
        x, u = plan.x[k], plan.u[k]
        if plan.integrator == "Euler":
            slope, density = rate(k * dt, x, u)
            velocity = x[n:] + dt * slope[n:]
            after = np.concatenate([x[:n] + dt * velocity, velocity])
        else:
            middle = (k + 0.5) * dt
            s1, l1 = rate(middle, x, u)
            s2, l2 = rate(middle, x + 0.5 * dt * s1, u)
            s3, l3 = rate(middle, x + 0.5 * dt * s2, u)
            s4, l4 = rate(middle, x + dt * s3, u)
            density = (l1 + 2.0 * l2 + 2.0 * l3 + l4) / 6.0
            after = x + dt / 6.0 * (s1 + 2.0 * s2 + 2.0 * s3 + s4)
        cost += dt * density
        defect = max(defect, np.abs(after - plan.x[k + 1]).max())
    return cost, defect


def open_loop(
    problem: Problem,
    model: pin.Model,
    torque: Callable[[int, float], np.ndarray],
    knots: np.ndarray,
    unit: float,
    rtol: float = 1e-10,
) -> float:
    """Cost of ``torque(k, t)``, smooth between knots k and k + 1, on the continuous robot; ``unit`` is its size."""
    data, n = model.createData(), model.nv
    y = np.concatenate([problem.q0, np.zeros(n + 1)])
    for k in range(len(knots) - 1):

        def rate(t: float, y: np.ndarray, k: int = k) -> np.ndarray:
            q, v, u = y[:n], y[n:-1], torque(k, t)
            return np.concatenate([v, pin.aba(model, data, q, v, u), [problem.running(t, q, v, u) / unit]])

        y = solve_ivp(rate, knots[k : k + 2], y, method="DOP853", rtol=rtol, atol=1e-2 * rtol).y[:, -1]
    return unit * y[-1] + problem.terminal(y[:n], y[n:-1])


def extrapolated(plans: list[Plan], order: int) -> dict[str, float]:
    """J for dt -> 0 from J0 + a dt^order + b dt^(order + 1)."""

    def limit(three: list[Plan]) -> float:
        steps = np.array([plan.dt for plan in three])
        basis = np.stack([np.ones(3), steps**order, steps ** (order + 1)], axis=1)
        return float(np.linalg.solve(basis, [plan.cost for plan in three])[0])

    finest = limit(plans[-3:])
    return {"cost": finest, "uncertainty": abs(finest - limit(plans[-4:-1]))}


def pontryagin(problem: Problem, model: pin.Model, plan: Plan) -> dict[str, Any]:
    """The optimum of the continuous problem, from its boundary-value problem in q, v and scaled costates."""
    data, n = model.createData(), model.nv
    wq, wv, wu, Wq, Wv = problem.weights
    x0 = np.concatenate([problem.q0, np.zeros(n)])
    scale = np.concatenate([np.ones(2 * n), np.repeat(np.abs(plan.costates).reshape(-1, 2, n).max(axis=(0, 2)), n)])

    def torque(y: np.ndarray) -> np.ndarray:
        pin.computeMinverse(model, data, y[:n])
        inverse = np.triu(data.Minv) + np.triu(data.Minv, 1).T
        return -inverse @ (scale[3 * n :] * y[3 * n :]) / (2.0 * wu)

    def slope(t: float, y: np.ndarray) -> np.ndarray:
        q, v, (lq, lv), u = y[:n], y[n : 2 * n], (scale * y)[2 * n :].reshape(2, n), torque(y)
        aq, av, _ = pin.computeABADerivatives(model, data, q, v, u)
        dlq = -2.0 * wq * (q - problem.reference(t)) - aq.T @ lv
        dlv = -2.0 * wv * v - lq - av.T @ lv
        return np.concatenate([v, data.ddq, dlq, dlv]) / scale

    def rate(t: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.stack([slope(*pair) for pair in zip(t, y.T, strict=True)], axis=1)

    def ends(start: np.ndarray, end: np.ndarray) -> np.ndarray:
        error = end[:n] - problem.reference(problem.tf)
        gradient = np.concatenate([2.0 * Wq * error, 2.0 * Wv * end[n : 2 * n]])
        return np.concatenate([start[: 2 * n] - x0, end[2 * n :] - gradient / scale[2 * n :]])

    # every node of the boundary layers, every tenth or so between them
    times = plan.dt * np.arange(plan.N + 1)
    layer = np.minimum(times, problem.tf - times) < 0.01 * problem.tf
    chosen = layer | (np.arange(plan.N + 1) % max(1, plan.N // 500) == 0)
    t, y = times[chosen], (np.hstack([plan.x, plan.costates]) / scale)[chosen].T
    costs = []
    for tolerance in (1e-5, 1e-6):
        found = solve_bvp(rate, ends, t, y, tol=tolerance, max_nodes=50_000)
        if not found.success:
            raise SystemExit(f"solve_bvp: {found.message}")
        t, y, curve = found.x, found.y, found.sol
        whole = np.array([0.0, problem.tf])
        costs.append(open_loop(problem, model, lambda _, s, curve=curve: torque(curve(s)), whole, plan.cost, 1e-12))
    grid = np.linspace(0.0, problem.tf, SAMPLES + 1)
    values = curve(grid).T
    return {
        "cost": costs[-1],
        "uncertainty": max(abs(costs[-1] - costs[0]), 1e-9 * costs[-1]),
        "mesh": len(t),
        "samples": {
            "t": rounded(grid),
            "q": rounded(values[:, :n]),
            "u": rounded(np.array([torque(row) for row in values])),
        },
    }


def rounded(values: np.ndarray) -> Any:
    """Six significant digits, as lists; what rounding left of zero becomes zero."""
    small = 1e-12 * np.abs(values).max()
    if values.ndim > 1:
        return [rounded(np.where(np.abs(row) < small, 0.0, row)) for row in values]
    return [float(f"{value:.6g}") for value in values]


def measured(problem: Problem) -> dict[str, Any]:
    """What is stored of a problem."""
    model = problem.model()
    require_gravity(model)
    runs, richardson = [], {}
    for integrator, order in (("Euler", 1), ("RK4", 2)):
        plans = []
        for N in problem.steps:
            plan = solve(problem, model, integrator, N)
            summed, defect = check(problem, model, plan)
            run = {
                "integrator": integrator,
                "N": N,
                "dt": plan.dt,
                "cost": plan.cost,
                "iterations": plan.iterations,
                "stop": float(f"{plan.stop:.2g}"),
                "converged": plan.converged,
                "cost_check": float(f"{summed - plan.cost:.2g}"),
                "defect": float(f"{defect:.2g}"),
            }
            if N <= SMALL:
                knots = np.linspace(0.0, problem.tf, N + 1)
                run["true_cost"] = open_loop(problem, model, lambda k, _, u=plan.u: u[k], knots, plan.cost)
            runs.append(run)
            per_node = 1e6 * plan.seconds / plan.iterations / N
            print(
                f"{integrator:5} {N:6d} {plan.cost:.10e} {plan.iterations:4d} {plan.stop:8.1e} {plan.converged!s:5} "
                f"{run['cost_check']:8.1e} {defect:8.1e} {run.get('true_cost', np.nan):.8e} "
                f"{plan.seconds:8.3f} s {per_node:6.1f} us",
                flush=True,
            )
            plans.append(plan)
        richardson[integrator] = {"order": order, **extrapolated([p for p in plans if p.converged], order)}
    finest = [plan for plan in plans if plan.converged][-1]
    optimum = pontryagin(problem, model, finest)
    for name, value in (*richardson.items(), ("optimum", optimum)):
        print(f"{name:8} {value['cost']:.10e} +- {value['uncertainty']:.1e}", flush=True)
    return {
        "robot": problem.robot,
        "lock": problem.lock,
        "gravity": model.gravity.linear.tolist(),
        "q0": problem.q0,
        "tf": problem.tf,
        "weights": dict(zip(("wq", "wv", "wu", "Wq", "Wv"), problem.weights, strict=True)),
        "reference": problem.formula,
        "optimum": optimum,
        "richardson": richardson,
        "runs": runs,
    }


def text(value: Any, indent: str = "") -> str:
    """JSON with numbers of a list, and of a run, on one line."""
    inner = indent + "  "
    if isinstance(value, dict) and not all(isinstance(entry, (int, float, str)) for entry in value.values()):
        rows = ",\n".join(f"{inner}{json.dumps(key)}: {text(entry, inner)}" for key, entry in value.items())
        return f"{{\n{rows}\n{indent}}}"
    if isinstance(value, list) and value and isinstance(value[0], (dict, list)):
        rows = ",\n".join(inner + text(entry, inner) for entry in value)
        return f"[\n{rows}\n{indent}]"
    return json.dumps(value)


def main() -> None:
    if len(sys.argv) != 2:
        raise SystemExit("usage: crocoddyl_reference.py OUTPUT.json")
    packages = ("crocoddyl", "pin", "libpinocchio", "numpy", "scipy")
    problems = {}
    for name, problem in PROBLEMS.items():
        print(name, flush=True)
        problems[name] = measured(problem)
    document = {
        "made_by": "benchmarks/crocoddyl_reference.py, whose docstring explains every entry; SI units",
        "versions": {"python": platform.python_version(), **{package: version(package) for package in packages}},
        "settings": {"th_stop": THRESHOLD, "reg_min": REGULARIZATION},
        "problems": problems,
    }
    output = Path(sys.argv[1])
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(text(document) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
