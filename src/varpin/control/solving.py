"""The verb: S-DDP, within the constraints that a problem may have."""

from varpin.control import search
from varpin.control.augmented import within_constraints

solve = within_constraints(search.solve)
