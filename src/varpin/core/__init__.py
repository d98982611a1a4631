"""The compiled core: C++ in ``src/core``, one header an idea, built when the package is."""

from varpin.core._core import Guards as Guards
from varpin.core._core import Mechanism as Mechanism
from varpin.core._core import Tableau as Tableau
from varpin.core._core import VariationalRollout as VariationalRollout
from varpin.core._core import variational_curvatures as variational_curvatures
from varpin.core._core import variational_derivatives as variational_derivatives
from varpin.core._core import BackwardPass as BackwardPass
from varpin.core._core import ExpandedSteps as ExpandedSteps
from varpin.core._core import Gains as Gains
from varpin.core._core import Mechanism as Mechanism
from varpin.core._core import RootPass as RootPass
from varpin.core._core import Squares as Squares
from varpin.core._core import box_minimum as box_minimum
