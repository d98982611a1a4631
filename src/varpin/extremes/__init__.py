"""Where varpin ends: extreme scenes, each run with every integrator and judged by independent checks."""

from varpin.extremes.battery import Record as Record
from varpin.extremes.battery import run as run
from varpin.extremes.plans import PLANS as PLANS
from varpin.extremes.plans import Plan as Plan
from varpin.extremes.scenes import TRIALS as TRIALS
from varpin.extremes.scenes import trials_on as trials_on
from varpin.extremes.trial import Cell as Cell
from varpin.extremes.trial import Kind as Kind
from varpin.extremes.trial import Setup as Setup
from varpin.extremes.trial import Trial as Trial
