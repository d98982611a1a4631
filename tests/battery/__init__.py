"""Extreme scenes, each run with every integrator and judged by independent checks: what docs/limits.md reports."""

from battery.running import Bench as Bench
from battery.running import Trial as Trial
from battery.running import period_error as period_error
from battery.running import run as run
from battery.scenes import TRIALS as TRIALS
from battery.scenes import trials_on as trials_on
