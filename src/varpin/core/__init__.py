"""The compiled core: C++ in ``src/core``, one header an idea, built when the package is."""

from varpin.core._core import Mechanism as Mechanism
