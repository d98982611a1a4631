"""varpin: variational integrators on Pinocchio.

Load an arm, integrate it variationally, replay it:

    import varpin as vp

    robot = vp.load_robot("finger")
    scene = vp.Scene(robot, gravity=False)
    trajectory = vp.simulate(scene, q0=[0.5, 0.3, 0.2], v0=[0, 0, 1], dt=1e-3, steps=1000)
    vp.replay(robot, trajectory, html="finger.html")
"""

from typing import TYPE_CHECKING

from varpin._version import __version__ as __version__
from varpin.errors import FileError as FileError
from varpin.errors import InputError as InputError
from varpin.errors import LinearizationError as LinearizationError
from varpin.errors import MissingDependency as MissingDependency
from varpin.errors import RobotError as RobotError
from varpin.errors import RobotNotFound as RobotNotFound
from varpin.errors import SingularMassMatrix as SingularMassMatrix
from varpin.errors import UnknownFrame as UnknownFrame
from varpin.errors import UnknownJoint as UnknownJoint
from varpin.errors import UnknownPosture as UnknownPosture
from varpin.errors import UnsupportedJoint as UnsupportedJoint
from varpin.errors import VarpinError as VarpinError
from varpin.forces import Armature as Armature
from varpin.forces import CoulombFriction as CoulombFriction
from varpin.forces import Force as Force
from varpin.forces import FrameDamper as FrameDamper
from varpin.forces import FrameSpring as FrameSpring
from varpin.forces import FrameWrench as FrameWrench
from varpin.forces import JointDamper as JointDamper
from varpin.forces import JointSpring as JointSpring
from varpin.forces import JointStop as JointStop
from varpin.forces import PositionServo as PositionServo
from varpin.integrators import ExplicitEuler as ExplicitEuler
from varpin.integrators import Gauss as Gauss
from varpin.integrators import Guard as Guard
from varpin.integrators import Integrator as Integrator
from varpin.integrators import Midpoint as Midpoint
from varpin.integrators import Radau as Radau
from varpin.integrators import Reference as Reference
from varpin.integrators import RungeKutta4 as RungeKutta4
from varpin.integrators import SemiImplicitEuler as SemiImplicitEuler
from varpin.lagrangian import DiscreteLagrangian as DiscreteLagrangian
from varpin.lagrangian import LagrangianJet as LagrangianJet
from varpin.lagrangian import discrete_lagrangian as discrete_lagrangian
from varpin.lagrangian import lagrangian_jet as lagrangian_jet
from varpin.noise import AdditiveNoise as AdditiveNoise
from varpin.noise import ControlNoise as ControlNoise
from varpin.noise import CustomNoise as CustomNoise
from varpin.noise import Noise as Noise
from varpin.noise import NoiseFieldError as NoiseFieldError
from varpin.noise import StateNoise as StateNoise
from varpin.policy import FirstOrderHold as FirstOrderHold
from varpin.policy import LinearPolicy as LinearPolicy
from varpin.policy import OpenLoop as OpenLoop
from varpin.replay import replay as replay
from varpin.robot import Payload as Payload
from varpin.robot import Robot as Robot
from varpin.robot import load_robot as load_robot
from varpin.robot import planar_chain as planar_chain
from varpin.robot import robot_names as robot_names
from varpin.scene import Scene as Scene
from varpin.simulation import ControlError as ControlError
from varpin.simulation import Interrupted as Interrupted
from varpin.simulation import NoiseError as NoiseError
from varpin.simulation import StepFailure as StepFailure
from varpin.simulation import ToleranceError as ToleranceError
from varpin.simulation import simulate as simulate
from varpin.trajectory import Accuracy as Accuracy
from varpin.trajectory import StepStatistics as StepStatistics
from varpin.trajectory import Trajectory as Trajectory

if TYPE_CHECKING:
    from varpin.costs import BoundCost as BoundCost
    from varpin.costs import CenterOfMassCost as CenterOfMassCost
    from varpin.costs import ControlCost as ControlCost
    from varpin.costs import ControlRateCost as ControlRateCost
    from varpin.costs import Cost as Cost
    from varpin.costs import CostError as CostError
    from varpin.costs import CustomCost as CustomCost
    from varpin.costs import Expansion as Expansion
    from varpin.costs import FrameOrientationCost as FrameOrientationCost
    from varpin.costs import FramePositionCost as FramePositionCost
    from varpin.costs import FrameVelocityCost as FrameVelocityCost
    from varpin.costs import JointLimitBarrier as JointLimitBarrier
    from varpin.costs import ManipulabilityCost as ManipulabilityCost
    from varpin.costs import Points as Points
    from varpin.costs import Terminal as Terminal
    from varpin.costs import TrackingCost as TrackingCost
    from varpin.costs import VelocityCost as VelocityCost
    from varpin.costs import VelocityLimitBarrier as VelocityLimitBarrier
    from varpin.ensemble import Ensemble as Ensemble
    from varpin.ensemble import EnsembleInterrupted as EnsembleInterrupted
    from varpin.ensemble import EnsembleStatistics as EnsembleStatistics
    from varpin.ensemble import PathFailure as PathFailure
    from varpin.ensemble import simulate_ensemble as simulate_ensemble
    from varpin.inspection import FrameReport as FrameReport
    from varpin.inspection import JointReport as JointReport
    from varpin.inspection import LinkReport as LinkReport
    from varpin.inspection import RobotReport as RobotReport
    from varpin.inspection import inspect_robot as inspect_robot
    from varpin.linearization import Curvature as Curvature
    from varpin.linearization import Linearization as Linearization
    from varpin.linearization import Moments as Moments
    from varpin.linearization import linearize as linearize
    from varpin.linearization import propagate_moments as propagate_moments
    from varpin.linearization import second_order as second_order
    from varpin.linearization_check import LinearizationCheck as LinearizationCheck
    from varpin.linearization_check import check_linearization as check_linearization
    from varpin.mpc import Mpc as Mpc
    from varpin.mpc import MpcRun as MpcRun
    from varpin.mpc import Plant as Plant
    from varpin.scenefile import Required as Required
    from varpin.scenefile import SceneFile as SceneFile
    from varpin.scenefile import SceneFileError as SceneFileError
    from varpin.scenefile import load_scene as load_scene
    from varpin.sddp import Iteration as Iteration
    from varpin.sddp import MonteCarlo as MonteCarlo
    from varpin.sddp import MonteCarloInterrupted as MonteCarloInterrupted
    from varpin.sddp import OptimalControlProblem as OptimalControlProblem
    from varpin.sddp import SearchState as SearchState
    from varpin.sddp import Solution as Solution
    from varpin.sddp import Status as Status
    from varpin.sddp import Verification as Verification
    from varpin.sddp import Violations as Violations
    from varpin.sddp import solve as solve
    from varpin.tradeoff import Advice as Advice
    from varpin.tradeoff import Choice as Choice
    from varpin.tradeoff import OptimalControlRun as OptimalControlRun
    from varpin.tradeoff import OptimalControlTradeoff as OptimalControlTradeoff
    from varpin.tradeoff import WorkPrecision as WorkPrecision
    from varpin.tradeoff import WorkPrecisionRun as WorkPrecisionRun
    from varpin.tradeoff import advise as advise
    from varpin.tradeoff import optimal_control_tradeoff as optimal_control_tradeoff
    from varpin.tradeoff import work_precision as work_precision

# What a simulation has no need of is imported with its first use: all of it at once takes as long as Pinocchio.
_LATE: dict[str, tuple[str, ...]] = {
    "varpin.costs": (
        "BoundCost",
        "CenterOfMassCost",
        "ControlCost",
        "ControlRateCost",
        "Cost",
        "CostError",
        "CustomCost",
        "Expansion",
        "FrameOrientationCost",
        "FramePositionCost",
        "FrameVelocityCost",
        "JointLimitBarrier",
        "ManipulabilityCost",
        "Points",
        "Terminal",
        "TrackingCost",
        "VelocityCost",
        "VelocityLimitBarrier",
    ),
    "varpin.ensemble": ("Ensemble", "EnsembleInterrupted", "EnsembleStatistics", "PathFailure", "simulate_ensemble"),
    "varpin.inspection": ("FrameReport", "JointReport", "LinkReport", "RobotReport", "inspect_robot"),
    "varpin.linearization": ("Curvature", "Linearization", "Moments", "linearize", "propagate_moments", "second_order"),
    "varpin.linearization_check": ("LinearizationCheck", "check_linearization"),
    "varpin.mpc": ("Mpc", "MpcRun", "Plant"),
    "varpin.scenefile": ("Required", "SceneFile", "SceneFileError", "load_scene"),
    "varpin.sddp": (
        "Iteration",
        "MonteCarlo",
        "MonteCarloInterrupted",
        "OptimalControlProblem",
        "SearchState",
        "Solution",
        "Status",
        "Verification",
        "Violations",
        "solve",
    ),
    "varpin.tradeoff": (
        "Advice",
        "Choice",
        "OptimalControlRun",
        "OptimalControlTradeoff",
        "WorkPrecision",
        "WorkPrecisionRun",
        "advise",
        "optimal_control_tradeoff",
        "work_precision",
    ),
}


if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        from importlib import import_module  # noqa: PLC0415 - no public name

        for module, names in _LATE.items():
            if name in names:
                globals()[name] = value = getattr(import_module(module), name)
                return value
        raise AttributeError(f"module 'varpin' has no attribute {name!r}")

    def __dir__() -> list[str]:
        return sorted({*globals(), *(name for names in _LATE.values() for name in names)} - {"TYPE_CHECKING"})
