"""Hard constraints of a plan, one file for each family."""

from varpin.control.constraints.base import BoundConstraint as BoundConstraint
from varpin.control.constraints.base import BoundStates as BoundStates
from varpin.control.constraints.base import Horizon as Horizon
from varpin.control.constraints.base import OfStates as OfStates
from varpin.control.constraints.base import PlanConstraint as PlanConstraint
from varpin.control.constraints.clearance import KeepClear as KeepClear
from varpin.control.constraints.frames import KeepInBox as KeepInBox
from varpin.control.constraints.frames import KeepInHalfSpace as KeepInHalfSpace
from varpin.control.constraints.frames import KeepInSphere as KeepInSphere
from varpin.control.constraints.frames import KeepOutOfSphere as KeepOutOfSphere
from varpin.control.constraints.frames import ReachFrame as ReachFrame
from varpin.control.constraints.joints import BoundRate as BoundRate
from varpin.control.constraints.joints import WithinControlRate as WithinControlRate
from varpin.control.constraints.joints import WithinJointLimits as WithinJointLimits
from varpin.control.constraints.joints import WithinVelocityLimits as WithinVelocityLimits
