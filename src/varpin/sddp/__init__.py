"""S-DDP: optimal control under noise by differential dynamic programming, on any integrator's linearization."""

from varpin.sddp.examination import looked_at as looked_at
from varpin.sddp.history import Iteration as Iteration
from varpin.sddp.history import SearchState as SearchState
from varpin.sddp.history import Status as Status
from varpin.sddp.monte_carlo import MonteCarlo as MonteCarlo
from varpin.sddp.monte_carlo import MonteCarloInterrupted as MonteCarloInterrupted
from varpin.sddp.problem import OptimalControlProblem as OptimalControlProblem
from varpin.sddp.search import replan as replan
from varpin.sddp.search import solve as solve
from varpin.sddp.solution import Solution as Solution
from varpin.sddp.solution import Violations as Violations
from varpin.sddp.solution_file import solution_trajectory as solution_trajectory
from varpin.sddp.verification import Verification as Verification
