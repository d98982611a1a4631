"""Whether the package that is imported as pinocchio is Pinocchio, which PyPI has as pin."""

from __future__ import annotations

import pinocchio

__all__ = ["pinocchio"]

if not hasattr(pinocchio, "buildModelFromUrdf"):
    raise ImportError(
        f"{pinocchio.__file__} is not Pinocchio, which PyPI has as pin: pip uninstall -y pinocchio, "
        "then pip install --force-reinstall pin"
    )
