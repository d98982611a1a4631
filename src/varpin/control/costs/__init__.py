"""Costs: integrals over time and terms at the end, which add up."""

from varpin.control.costs.base import BoundCost as BoundCost
from varpin.control.costs.base import BoundSum as BoundSum
from varpin.control.costs.base import Cost as Cost
from varpin.control.costs.base import CostError as CostError
from varpin.control.costs.base import CostSum as CostSum
from varpin.control.costs.base import Expansion as Expansion
from varpin.control.costs.base import Points as Points
from varpin.control.costs.base import Terminal as Terminal
from varpin.control.costs.custom import CustomCost as CustomCost
from varpin.control.costs.joints import ControlCost as ControlCost
from varpin.control.costs.joints import ControlRate as ControlRate
from varpin.control.costs.joints import ControlRateCost as ControlRateCost
from varpin.control.costs.joints import JointLimitBarrier as JointLimitBarrier
from varpin.control.costs.joints import TrackingCost as TrackingCost
from varpin.control.costs.joints import VelocityCost as VelocityCost
from varpin.control.costs.joints import VelocityLimitBarrier as VelocityLimitBarrier
from varpin.control.costs.joints import control_rate as control_rate
from varpin.control.costs.joints import with_control_before as with_control_before
from varpin.control.costs.task import CenterOfMassCost as CenterOfMassCost
from varpin.control.costs.task import FrameOrientationCost as FrameOrientationCost
from varpin.control.costs.task import FramePositionCost as FramePositionCost
from varpin.control.costs.task import FrameVelocityCost as FrameVelocityCost
from varpin.control.costs.task import ManipulabilityCost as ManipulabilityCost
