"""Where varpin ends: extreme scenes, each run with every integrator and judged by independent checks."""

from varpin.study.extremes.battery import Record as Record
from varpin.study.extremes.battery import run as run
from varpin.study.extremes.plans import PLANS as PLANS
from varpin.study.extremes.plans import Plan as Plan
from varpin.study.extremes.scenes import TRIALS as TRIALS
from varpin.study.extremes.scenes import trials_on as trials_on
from varpin.study.extremes.trial import Cell as Cell
from varpin.study.extremes.trial import Kind as Kind
from varpin.study.extremes.trial import Setup as Setup
from varpin.study.extremes.trial import Trial as Trial
