"""The compiled core. Its C++ is in ``src/core``, one header for each idea, and is built with the package."""

from varpin.core._core import *  # noqa: F403 - the names of the stub beside it
