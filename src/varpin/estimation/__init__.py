"""What the logs of an arm say: sensitivities, identification, filter and smoother."""

from varpin.estimation.filter import Estimate as Estimate
from varpin.estimation.filter import kalman_filter as kalman_filter
from varpin.estimation.filter import smooth as smooth
from varpin.estimation.identification import Identification as Identification
from varpin.estimation.identification import identify as identify
from varpin.estimation.log import Log as Log
from varpin.estimation.log import as_log as as_log
from varpin.estimation.sensitivity import Gradient as Gradient
from varpin.estimation.sensitivity import Sensitivities as Sensitivities
from varpin.estimation.sensitivity import sensitivities as sensitivities
