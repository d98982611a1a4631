"""The compiled core: C++ in ``src/core``, one header an idea, built when the package is."""

from varpin.core._core import Guards as Guards
from varpin.core._core import Mechanism as Mechanism
from varpin.core._core import Tableau as Tableau
from varpin.core._core import VariationalRollout as VariationalRollout
from varpin.core._core import variational_curvatures as variational_curvatures
from varpin.core._core import variational_derivatives as variational_derivatives
