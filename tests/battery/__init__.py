"""Extreme scenes, each run with every integrator and judged by independent checks: what docs/limits.md reports."""

from battery.running import run as run
from battery.scenes import TRIALS as TRIALS
from battery.scenes import trials_on as trials_on
from battery.trial import Setup as Setup
from battery.trial import Trial as Trial
from varpin.study.extremes import Cell as Cell
from varpin.study.extremes import Kind as Kind
from varpin.study.extremes import Record as Record
