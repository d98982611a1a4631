"""The compiled core: C++ in ``src/core``, one header an idea, built when the package is."""

from varpin.core._core import Links as Links
from varpin.core._core import Mechanism as Mechanism
from varpin.core._core import rotation_logarithms as rotation_logarithms
