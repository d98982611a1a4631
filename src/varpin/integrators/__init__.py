"""One-step methods, all under the contract of :class:`varpin.integrators.base.Integrator`."""

from varpin.integrators.base import Integrator as Integrator
from varpin.integrators.base import Segment as Segment
from varpin.integrators.explicit import ExplicitEuler as ExplicitEuler
from varpin.integrators.explicit import RungeKutta4 as RungeKutta4
from varpin.integrators.explicit import SemiImplicitEuler as SemiImplicitEuler
from varpin.integrators.gauss import Gauss as Gauss
from varpin.integrators.midpoint import Midpoint as Midpoint
from varpin.integrators.midpoint import largest_step as largest_step
from varpin.integrators.reference import Reference as Reference
