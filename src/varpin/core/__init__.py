"""The compiled core: C++ in ``src/core``, one header an idea, built when the package is."""

from varpin.core._core import BackwardPass as BackwardPass
from varpin.core._core import Elimination as Elimination
from varpin.core._core import ExpandedSteps as ExpandedSteps
from varpin.core._core import ExplicitMethod as ExplicitMethod
from varpin.core._core import ExplicitRollout as ExplicitRollout
from varpin.core._core import ForwardDynamics as ForwardDynamics
from varpin.core._core import Gains as Gains
from varpin.core._core import Guards as Guards
from varpin.core._core import Links as Links
from varpin.core._core import Mechanism as Mechanism
from varpin.core._core import Outcome as Outcome
from varpin.core._core import RootPass as RootPass
from varpin.core._core import Solver as Solver
from varpin.core._core import Squares as Squares
from varpin.core._core import Tableau as Tableau
from varpin.core._core import VariationalRollout as VariationalRollout
from varpin.core._core import accelerations as accelerations
from varpin.core._core import box_minimum as box_minimum
from varpin.core._core import linearize_explicit as linearize_explicit
from varpin.core._core import rotation_logarithms as rotation_logarithms
from varpin.core._core import variational_curvatures as variational_curvatures
from varpin.core._core import variational_derivatives as variational_derivatives
