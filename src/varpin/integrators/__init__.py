"""One-step methods, all under the contract of :class:`varpin.integrators.base.Integrator`."""

from varpin.integrators.base import Integrator as Integrator
from varpin.integrators.base import Segment as Segment
from varpin.integrators.midpoint import Midpoint as Midpoint
