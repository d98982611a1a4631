"""Speed against accuracy: what each integrator gives on a scene of one's own, and which to take.

:func:`work_precision` measures errors and times over many steps, :func:`optimal_control_tradeoff` does the same for
S-DDP, and :func:`advise` picks an integrator and a step from a few short runs.
"""

from varpin.simulation.ladder import INTEGRATORS as INTEGRATORS
from varpin.study.tradeoff.advice import Advice as Advice
from varpin.study.tradeoff.advice import Choice as Choice
from varpin.study.tradeoff.advice import advise as advise
from varpin.study.tradeoff.optimal_control import OptimalControlRun as OptimalControlRun
from varpin.study.tradeoff.optimal_control import OptimalControlTradeoff as OptimalControlTradeoff
from varpin.study.tradeoff.optimal_control import optimal_control_tradeoff as optimal_control_tradeoff
from varpin.study.tradeoff.precision import WorkPrecision as WorkPrecision
from varpin.study.tradeoff.precision import WorkPrecisionRun as WorkPrecisionRun
from varpin.study.tradeoff.precision import work_precision as work_precision
