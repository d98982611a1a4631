"""The ``varpin`` command: simulate a robot, plan its motion, look into it, choose an integrator, or identify it.

Exit status: 0 done, 1 a silent wrong result among extreme scenes, 2 a mistake in the request, 3 a step that could not
be solved, a search that has not converged or an accuracy out of reach, 130 interrupted.
"""

from varpin.cli.command import main as main
