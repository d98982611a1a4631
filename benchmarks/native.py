"""varpin's problems as crocoddyl's own: its compiled models of dynamics, integrators and costs, with the same weights.

In the environment of crocoddyl_reference.py with ``cmeel-eigen==3.4.1``. crocoddyl's actuations have neither dampers
nor joints without a motor; crocoddyl_joints.cpp adds both in C++, which takes a compiler and some seconds, once a
process.
"""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sysconfig
import tempfile
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import crocoddyl
import numpy as np
import pinocchio as pin

import varpin as vp

SCHEMES = ("Euler", "RK2", "RK4")


@cache
def joints() -> ModuleType:
    """crocoddyl_joints.cpp, compiled against crocoddyl's wheel and the headers of ``cmeel-eigen``."""
    prefix = Path(pin.__file__).parents[4]
    compiler = shutil.which("c++")
    if compiler is None:
        raise SystemExit("crocoddyl_joints.cpp needs a C++ compiler")
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "crocoddyl_joints.so"
        includes = (
            f"-I{prefix / 'include'}",
            f"-I{sysconfig.get_paths()['include']}",
            f"-I{prefix / 'include' / 'eigen3'}",
        )
        defines = ("-DBOOST_MPL_LIMIT_LIST_SIZE=30", "-DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS")
        options = ("-w", "-std=c++17", "-O3", "-DNDEBUG", *defines, *includes, "-shared", "-fPIC")
        boost = next((prefix / "lib").glob("libboost_python3*.so"))
        linked = (f"-L{prefix / 'lib'}", "-lcrocoddyl", str(boost), f"-Wl,-rpath,{prefix / 'lib'}")
        source = Path(__file__).with_name("crocoddyl_joints.cpp")
        subprocess.run([compiler, *options, str(source), "-o", str(library), *linked], check=True)
        found = importlib.util.spec_from_file_location("crocoddyl_joints", library)
        module = importlib.util.module_from_spec(found)
        found.loader.exec_module(module)
    return module


def costs(problem: vp.OptimalControlProblem, state: crocoddyl.StateMultibody, t: float, *, end: bool) -> Any:
    """The running costs at a time, or the terminal ones. crocoddyl's activations are halved."""
    n, m = problem.scene.robot.dof, problem.scene.controls
    found = crocoddyl.CostModelSum(state, m)
    target, weights = np.zeros(2 * n), np.zeros(2 * n)
    for cost in problem.cost.terms:
        if cost.at_end != end:
            continue
        weight = 2.0 * cost.factor * np.asarray(cost.weight)
        if isinstance(cost, vp.TrackingCost):
            target[:n] = cost.reference(t) if callable(cost.reference) else cost.reference
            weights[:n] += weight
        elif isinstance(cost, vp.VelocityCost):
            weights[n:] += weight
        else:
            if isinstance(cost, vp.ControlCost):
                residual, size = crocoddyl.ResidualModelControl(state, m), m
            else:
                kind = {
                    vp.FramePositionCost: crocoddyl.ResidualModelFrameTranslation,
                    vp.FrameOrientationCost: crocoddyl.ResidualModelFrameRotation,
                }[type(cost)]
                frame, size = state.pinocchio.getFrameId(cost.frame), 3
                residual = kind(state, frame, np.asarray(cost.target), m)
            activation = crocoddyl.ActivationModelWeightedQuad(np.broadcast_to(weight, size).copy())
            name = f"{type(cost).__name__} {len(found.costs.todict())}"
            found.addCost(name, crocoddyl.CostModelResidual(state, activation, residual), 1.0)
    if weights.any():
        activation = crocoddyl.ActivationModelWeightedQuad(weights)
        residual = crocoddyl.ResidualModelState(state, target, m)
        found.addCost("state", crocoddyl.CostModelResidual(state, activation, residual), 1.0)
    return found


class Dynamics:
    """Differential models of a problem, by time."""

    def __init__(self, problem: vp.OptimalControlProblem) -> None:
        scene = problem.scene
        self.problem, self.state = problem, crocoddyl.StateMultibody(scene.robot.model)
        if scene.damping.any() or scene.controls != scene.robot.dof:
            self.actuation = joints().Joints(self.state, scene.actuation.copy(), scene.damping.copy())
        else:
            self.actuation = crocoddyl.ActuationModelFull(self.state)
        self.timed = any(callable(getattr(cost, "reference", None)) for cost in problem.cost.terms)

    def at(self, t: float, *, end: bool = False) -> Any:
        sum_ = costs(self.problem, self.state, t, end=end)
        return crocoddyl.DifferentialActionModelFreeFwdDynamics(self.state, self.actuation, sum_)

    def shooting(self, N: int, scheme: str) -> crocoddyl.ShootingProblem:
        """N steps of a scheme. Moving references are held over a step: for Euler as at its begin, else its middle."""
        problem = self.problem
        dt = problem.duration / N

        def node(k: int) -> Any:
            moving = self.at((k + (0.0 if scheme == "Euler" else 0.5)) * dt)
            if scheme == "Euler":
                made = crocoddyl.IntegratedActionModelEuler(moving, dt)
            else:
                stages = {"RK2": crocoddyl.RKType.two, "RK4": crocoddyl.RKType.four}[scheme]
                made = crocoddyl.IntegratedActionModelRK(moving, stages, dt)
            if problem.limited:
                made.u_lb, made.u_ub = problem.control_limits
            return made

        nodes = [node(k) for k in range(N)] if self.timed else [node(0)] * N
        last = crocoddyl.IntegratedActionModelEuler(self.at(problem.duration, end=True), 0.0)
        made = crocoddyl.ShootingProblem(np.concatenate([problem.q0, problem.v0]), nodes, last)
        made.nthreads = 1
        return made

    def require_same(self, tolerance: float = 1e-11) -> None:
        """Stop unless costs and accelerations are varpin's at some states."""
        problem, rng = self.problem, np.random.default_rng(0)
        scene, times = problem.scene, problem.running.points.t
        q, v, u = (rng.normal(size=(len(times), size)) for size in (scene.robot.dof, scene.robot.dof, scene.controls))
        wanted = problem.running.value(q, v, u)
        for row in (0, len(times) // 3, len(times) - 1):
            moving, last = self.at(times[row]), self.at(problem.duration, end=True)
            data, end = moving.createData(), last.createData()
            x = np.concatenate([q[row], v[row]])
            moving.calc(data, x, u[row])
            last.calc(end, x)
            at_end = float(problem.terminal.value(q[row, None], v[row, None], u[row, None])[0])
            for found, own in ((data.cost, wanted[row]), (end.cost, at_end)):
                if not abs(found - own) <= tolerance * max(1.0, abs(own)):
                    raise SystemExit(f"crocoddyl's cost is not varpin's: {found:.15g} and {own:.15g}")
            jet = vp.lagrangian_jet(scene, q[row], v[row])
            force = scene.actuation @ u[row] - scene.damping * v[row]
            own = np.linalg.solve(jet.Lvv, jet.Lq + force - jet.Lvq @ v[row])
            if not np.abs(data.xout - own).max() <= 1e-9 * np.abs(own).max():
                raise SystemExit("crocoddyl's forward dynamics is not varpin's; is this pin 4.0.0?")
