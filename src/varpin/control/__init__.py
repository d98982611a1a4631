"""S-DDP: optimal control under noise, within limits and constraints, on any integrator's linearization."""

from varpin.control.history import Iteration as Iteration
from varpin.control.history import Refined as Refined
from varpin.control.history import Refinement as Refinement
from varpin.control.history import SearchState as SearchState
from varpin.control.history import Status as Status
from varpin.control.monte_carlo import MonteCarlo as MonteCarlo
from varpin.control.multipliers import ConstraintReport as ConstraintReport
from varpin.control.multipliers import Multipliers as Multipliers
from varpin.control.problem import OptimalControlProblem as OptimalControlProblem
from varpin.control.solution import Solution as Solution
from varpin.control.solving import solve as solve
from varpin.control.verification import Verification as Verification
