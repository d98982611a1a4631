"""Compiled kernels: functions of plain arrays, which know numpy and numba and nothing else."""
