"""Costs: integrals over time and terms at the end, which add up."""

from varpin.costs.barriers import JointLimitBarrier as JointLimitBarrier
from varpin.costs.barriers import VelocityLimitBarrier as VelocityLimitBarrier
from varpin.costs.barriers import barriers_of as barriers_of
from varpin.costs.base import BoundCost as BoundCost
from varpin.costs.base import BoundSum as BoundSum
from varpin.costs.base import Cost as Cost
from varpin.costs.base import CostError as CostError
from varpin.costs.base import CostSum as CostSum
from varpin.costs.base import Expansion as Expansion
from varpin.costs.base import Points as Points
from varpin.costs.base import Terminal as Terminal
from varpin.costs.custom import CustomCost as CustomCost
from varpin.costs.quadratic import ControlCost as ControlCost
from varpin.costs.quadratic import TrackingCost as TrackingCost
from varpin.costs.quadratic import VelocityCost as VelocityCost
from varpin.costs.rate import ControlRate as ControlRate
from varpin.costs.rate import ControlRateCost as ControlRateCost
from varpin.costs.rate import control_rate as control_rate
from varpin.costs.rate import is_control_rate as is_control_rate
from varpin.costs.rate import with_control_before as with_control_before
from varpin.costs.task import CenterOfMassCost as CenterOfMassCost
from varpin.costs.task import FrameOrientationCost as FrameOrientationCost
from varpin.costs.task import FramePositionCost as FramePositionCost
from varpin.costs.task import FrameVelocityCost as FrameVelocityCost
from varpin.costs.task import ManipulabilityCost as ManipulabilityCost
