"""The compiled core: C++ in ``src/core``, one header an idea, built when the package is."""

from varpin.core._core import ExplicitMethod as ExplicitMethod
from varpin.core._core import ExplicitRollout as ExplicitRollout
from varpin.core._core import ForwardDynamics as ForwardDynamics
from varpin.core._core import Links as Links
from varpin.core._core import Mechanism as Mechanism
from varpin.core._core import Outcome as Outcome
from varpin.core._core import accelerations as accelerations
from varpin.core._core import linearize_explicit as linearize_explicit
from varpin.core._core import rotation_logarithms as rotation_logarithms
