"""The function ``solve``: S-DDP for problems with or without constraints."""

from varpin.control import unconstrained
from varpin.control.augmented import within_constraints

solve = within_constraints(unconstrained.solve)
