"""Speed against accuracy: what each integrator gives on a scene of one's own, and which to take.

:func:`work_precision` measures errors and times over many steps, :func:`optimal_control_tradeoff` does the same for
S-DDP, and :func:`advise` picks an integrator and a step from a few short runs.
"""

from varpin.refinement import INTEGRATORS as INTEGRATORS
from varpin.tradeoff.advice import Advice as Advice
from varpin.tradeoff.advice import Choice as Choice
from varpin.tradeoff.advice import advise as advise
from varpin.tradeoff.optimal_control import OptimalControlRun as OptimalControlRun
from varpin.tradeoff.optimal_control import OptimalControlTradeoff as OptimalControlTradeoff
from varpin.tradeoff.optimal_control import optimal_control_tradeoff as optimal_control_tradeoff
from varpin.tradeoff.precision import WorkPrecision as WorkPrecision
from varpin.tradeoff.precision import WorkPrecisionRun as WorkPrecisionRun
from varpin.tradeoff.precision import work_precision as work_precision
