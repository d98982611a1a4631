"""What the logs of an arm say: filter and smoother."""

from varpin.estimation.filter import Estimate as Estimate
from varpin.estimation.filter import kalman_filter as kalman_filter
from varpin.estimation.filter import smooth as smooth
from varpin.estimation.log import Log as Log
from varpin.estimation.log import as_log as as_log
