"""A robot where it is hard: motions with every integrator, judged by independent checks."""

from varpin.study.extremes.record import Cell as Cell
from varpin.study.extremes.record import Kind as Kind
from varpin.study.extremes.record import Record as Record
from varpin.study.extremes.robot import INTEGRATORS as INTEGRATORS
from varpin.study.extremes.robot import check_robot as check_robot
