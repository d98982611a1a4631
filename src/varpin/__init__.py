"""varpin: variational integrators on Pinocchio.

Load an arm, integrate it variationally, replay it:

    import varpin as vp

    robot = vp.load_robot("finger")
    scene = vp.Scene(robot, gravity=False)
    trajectory = vp.simulate(scene, q0=[0.5, 0.3, 0.2], v0=[0, 0, 1], dt=1e-3, steps=1000)
    vp.replay(robot, trajectory, html="finger.html")
"""

from typing import TYPE_CHECKING

from varpin._pinocchio import pinocchio as _pinocchio  # noqa: F401
from varpin._version import __version__ as __version__
from varpin.errors import AssemblyError as AssemblyError
from varpin.errors import ControlError as ControlError
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
from varpin.errors import WorkersLost as WorkersLost
from varpin.finding import Finding as Finding
from varpin.integrators import ExplicitEuler as ExplicitEuler
from varpin.integrators import Gauss as Gauss
from varpin.integrators import Guard as Guard
from varpin.integrators import Integrator as Integrator
from varpin.integrators import Midpoint as Midpoint
from varpin.integrators import Radau as Radau
from varpin.integrators import Reference as Reference
from varpin.integrators import RungeKutta4 as RungeKutta4
from varpin.integrators import SemiImplicitEuler as SemiImplicitEuler
from varpin.marks import Marks as Marks
from varpin.mechanics.assembly import assemble as assemble
from varpin.mechanics.constraints import Constraint as Constraint
from varpin.mechanics.constraints import CustomConstraint as CustomConstraint
from varpin.mechanics.constraints import CustomConstraintError as CustomConstraintError
from varpin.mechanics.constraints import Distance as Distance
from varpin.mechanics.constraints import FrameOnFrame as FrameOnFrame
from varpin.mechanics.constraints import JointTie as JointTie
from varpin.mechanics.constraints import KinematicInput as KinematicInput
from varpin.mechanics.constraints import PointOnLine as PointOnLine
from varpin.mechanics.constraints import PointOnPlane as PointOnPlane
from varpin.mechanics.constraints import PointOnPoint as PointOnPoint
from varpin.mechanics.custom import CustomForce as CustomForce
from varpin.mechanics.custom import CustomForceError as CustomForceError
from varpin.mechanics.forces import Armature as Armature
from varpin.mechanics.forces import CoulombFriction as CoulombFriction
from varpin.mechanics.forces import Force as Force
from varpin.mechanics.forces import FrameDamper as FrameDamper
from varpin.mechanics.forces import FrameSpring as FrameSpring
from varpin.mechanics.forces import FrameWrench as FrameWrench
from varpin.mechanics.forces import JointDamper as JointDamper
from varpin.mechanics.forces import JointSpring as JointSpring
from varpin.mechanics.forces import JointStop as JointStop
from varpin.mechanics.forces import PositionServo as PositionServo
from varpin.mechanics.lagrangian import discrete_lagrangian as discrete_lagrangian
from varpin.mechanics.lagrangian import lagrangian_jet as lagrangian_jet
from varpin.mechanics.noise import AdditiveNoise as AdditiveNoise
from varpin.mechanics.noise import ControlNoise as ControlNoise
from varpin.mechanics.noise import CustomNoise as CustomNoise
from varpin.mechanics.noise import Noise as Noise
from varpin.mechanics.noise import NoiseFieldError as NoiseFieldError
from varpin.mechanics.noise import StateNoise as StateNoise
from varpin.mechanics.reduction import Required as Required
from varpin.mechanics.scene import Scene as Scene
from varpin.model import Payload as Payload
from varpin.model import Robot as Robot
from varpin.model import combine as combine
from varpin.model import load_robot as load_robot
from varpin.model import planar_chain as planar_chain
from varpin.model import robot_names as robot_names
from varpin.signals.policy import FirstOrderHold as FirstOrderHold
from varpin.signals.policy import LinearPolicy as LinearPolicy
from varpin.signals.policy import OpenLoop as OpenLoop
from varpin.simulation.failures import ConstraintError as ConstraintError
from varpin.simulation.failures import ForceError as ForceError
from varpin.simulation.failures import Interrupted as Interrupted
from varpin.simulation.failures import NoiseError as NoiseError
from varpin.simulation.failures import StepFailure as StepFailure
from varpin.simulation.failures import ToleranceError as ToleranceError
from varpin.simulation.simulate import simulate as simulate
from varpin.textbook import DiscreteLagrangian as DiscreteLagrangian
from varpin.textbook import LagrangianJet as LagrangianJet
from varpin.trajectory import Accuracy as Accuracy
from varpin.trajectory import Nodes as Nodes
from varpin.trajectory import StepStatistics as StepStatistics
from varpin.trajectory import Trajectory as Trajectory

if TYPE_CHECKING:
    from varpin.control import ConstraintReport as ConstraintReport
    from varpin.control import Iteration as Iteration
    from varpin.control import MonteCarlo as MonteCarlo
    from varpin.control import Multipliers as Multipliers
    from varpin.control import OptimalControlProblem as OptimalControlProblem
    from varpin.control import Refined as Refined
    from varpin.control import Refinement as Refinement
    from varpin.control import SearchState as SearchState
    from varpin.control import Solution as Solution
    from varpin.control import Status as Status
    from varpin.control import Verification as Verification
    from varpin.control import solve as solve
    from varpin.control.constraints import KeepClear as KeepClear
    from varpin.control.constraints import KeepInBox as KeepInBox
    from varpin.control.constraints import KeepInHalfSpace as KeepInHalfSpace
    from varpin.control.constraints import KeepInSphere as KeepInSphere
    from varpin.control.constraints import KeepOutOfSphere as KeepOutOfSphere
    from varpin.control.constraints import PlanConstraint as PlanConstraint
    from varpin.control.constraints import ReachFrame as ReachFrame
    from varpin.control.constraints import WithinControlRate as WithinControlRate
    from varpin.control.constraints import WithinJointLimits as WithinJointLimits
    from varpin.control.constraints import WithinVelocityLimits as WithinVelocityLimits
    from varpin.control.costs import BoundCost as BoundCost
    from varpin.control.costs import CenterOfMassCost as CenterOfMassCost
    from varpin.control.costs import ControlCost as ControlCost
    from varpin.control.costs import ControlRateCost as ControlRateCost
    from varpin.control.costs import Cost as Cost
    from varpin.control.costs import CostError as CostError
    from varpin.control.costs import CustomCost as CustomCost
    from varpin.control.costs import Expansion as Expansion
    from varpin.control.costs import FrameOrientationCost as FrameOrientationCost
    from varpin.control.costs import FramePositionCost as FramePositionCost
    from varpin.control.costs import FrameVelocityCost as FrameVelocityCost
    from varpin.control.costs import JointLimitBarrier as JointLimitBarrier
    from varpin.control.costs import ManipulabilityCost as ManipulabilityCost
    from varpin.control.costs import Points as Points
    from varpin.control.costs import Terminal as Terminal
    from varpin.control.costs import TrackingCost as TrackingCost
    from varpin.control.costs import VelocityCost as VelocityCost
    from varpin.control.costs import VelocityLimitBarrier as VelocityLimitBarrier
    from varpin.control.mpc import Mpc as Mpc
    from varpin.control.mpc import MpcRun as MpcRun
    from varpin.control.mpc import Plant as Plant
    from varpin.ensemble import Ensemble as Ensemble
    from varpin.ensemble import EnsembleStatistics as EnsembleStatistics
    from varpin.ensemble import PathFailure as PathFailure
    from varpin.ensemble import PathsInterrupted as PathsInterrupted
    from varpin.ensemble import simulate_ensemble as simulate_ensemble
    from varpin.estimation import Estimate as Estimate
    from varpin.estimation import Gradient as Gradient
    from varpin.estimation import Identification as Identification
    from varpin.estimation import Log as Log
    from varpin.estimation import Sensitivities as Sensitivities
    from varpin.estimation import identify as identify
    from varpin.estimation import kalman_filter as kalman_filter
    from varpin.estimation import sensitivities as sensitivities
    from varpin.estimation import smooth as smooth
    from varpin.io.scenefile import SceneFile as SceneFile
    from varpin.io.scenefile import SceneFileError as SceneFileError
    from varpin.io.scenefile import load_scene as load_scene
    from varpin.linearization import Curvature as Curvature
    from varpin.linearization import Linearization as Linearization
    from varpin.linearization import Moments as Moments
    from varpin.linearization import linearize as linearize
    from varpin.linearization import propagate_moments as propagate_moments
    from varpin.linearization import second_order as second_order
    from varpin.model.clearance import Obstacle as Obstacle
    from varpin.show.inspection import FrameReport as FrameReport
    from varpin.show.inspection import JointReport as JointReport
    from varpin.show.inspection import LinkReport as LinkReport
    from varpin.show.inspection import RobotReport as RobotReport
    from varpin.show.inspection import inspect_robot as inspect_robot
    from varpin.show.replay.live import LiveView as LiveView
    from varpin.show.replay.motion import replay as replay
    from varpin.study.advice import Advice as Advice
    from varpin.study.advice import Choice as Choice
    from varpin.study.advice import advise as advise
    from varpin.study.extremes import check_robot as check_robot
    from varpin.study.linearization_check import LinearizationCheck as LinearizationCheck
    from varpin.study.linearization_check import check_linearization as check_linearization
    from varpin.study.plans import OptimalControlRun as OptimalControlRun
    from varpin.study.plans import OptimalControlTradeoff as OptimalControlTradeoff
    from varpin.study.plans import optimal_control_tradeoff as optimal_control_tradeoff
    from varpin.study.precision import WorkPrecision as WorkPrecision
    from varpin.study.precision import WorkPrecisionRun as WorkPrecisionRun
    from varpin.study.precision import work_precision as work_precision
    from varpin.study.record import StudyInterrupted as StudyInterrupted

# The names of the block above by their modules, which are imported with the first use of a name.
_LATE = {
    "varpin.control": (
        "ConstraintReport Iteration MonteCarlo Multipliers "
        "OptimalControlProblem Refined Refinement SearchState Solution Status "
        "Verification solve"
    ),
    "varpin.control.constraints": (
        "KeepClear KeepInBox KeepInHalfSpace KeepInSphere KeepOutOfSphere "
        "PlanConstraint ReachFrame WithinControlRate WithinJointLimits "
        "WithinVelocityLimits"
    ),
    "varpin.control.costs": (
        "BoundCost CenterOfMassCost ControlCost ControlRateCost Cost CostError "
        "CustomCost Expansion FrameOrientationCost FramePositionCost "
        "FrameVelocityCost JointLimitBarrier ManipulabilityCost Points Terminal "
        "TrackingCost VelocityCost VelocityLimitBarrier"
    ),
    "varpin.control.mpc": "Mpc MpcRun Plant",
    "varpin.ensemble": ("Ensemble EnsembleStatistics PathFailure PathsInterrupted simulate_ensemble"),
    "varpin.estimation": (
        "Estimate Gradient Identification Log Sensitivities identify kalman_filter sensitivities smooth"
    ),
    "varpin.io.scenefile": "SceneFile SceneFileError load_scene",
    "varpin.linearization": "Curvature Linearization Moments linearize propagate_moments second_order",
    "varpin.model.clearance": "Obstacle",
    "varpin.show.inspection": "FrameReport JointReport LinkReport RobotReport inspect_robot",
    "varpin.show.replay.live": "LiveView",
    "varpin.show.replay.motion": "replay",
    "varpin.study.advice": "Advice Choice advise",
    "varpin.study.extremes": "check_robot",
    "varpin.study.linearization_check": "LinearizationCheck check_linearization",
    "varpin.study.plans": "OptimalControlRun OptimalControlTradeoff optimal_control_tradeoff",
    "varpin.study.precision": "WorkPrecision WorkPrecisionRun work_precision",
    "varpin.study.record": "StudyInterrupted",
}

# Submodules that a user takes from the top level.
_MODULES = {"plots": "varpin.show.plots", "wiener": "varpin.mechanics.wiener"}


if not TYPE_CHECKING:
    # What a simulation has no need of is imported with its first use: all of it at once takes as long as Pinocchio.
    _MODULE_OF = {name: module for module, names in _LATE.items() for name in names.split()}

    def __getattr__(name: str) -> object:
        from importlib import import_module  # noqa: PLC0415 - no public name

        if name in _MODULES:
            found = import_module(_MODULES[name])
        elif name in _MODULE_OF:
            found = getattr(import_module(_MODULE_OF[name]), name)
        else:
            raise AttributeError(f"module 'varpin' has no attribute {name!r}")
        globals()[name] = found
        return found

    def __dir__() -> list[str]:
        return sorted({*globals(), *_MODULE_OF, *_MODULES} - {"TYPE_CHECKING"})
