"""One-step methods, all under the contract of :class:`varpin.integrators.base.Integrator`."""

from varpin.integrators.base import Integrator as Integrator
from varpin.integrators.base import Segment as Segment
from varpin.integrators.collocation import Gauss as Gauss
from varpin.integrators.collocation import Midpoint as Midpoint
from varpin.integrators.collocation import Radau as Radau
from varpin.integrators.explicit import ExplicitEuler as ExplicitEuler
from varpin.integrators.explicit import RungeKutta4 as RungeKutta4
from varpin.integrators.explicit import SemiImplicitEuler as SemiImplicitEuler
from varpin.integrators.reference import Reference as Reference
from varpin.integrators.registry import BY_NAME as BY_NAME
from varpin.integrators.registry import integrator_of as integrator_of
from varpin.integrators.variational import Guard as Guard
