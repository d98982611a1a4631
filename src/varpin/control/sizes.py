"""What counts as nothing, as little and as much: the sizes that plans, their search and their checks share.

Each is a share of a whole, which is named where it is used. Within the ranges plans keep their status and their cost.
"""

# Rounding errors, relative to the largest of the numbers that are summed; from 1e-14 to 1e-10.
ROUNDING = 1e-12
# Rounding errors that results carry without harm, and weights that only make a result unique; from 1e-11 to 1e-8.
HARMLESS = 1e-9
# Shares that are none: interior points end inside their bounds, and iterations leave that much; from 1e-7 to 1e-5.
TRACE = 1e-6
# Greatest violation of a constraint at its places in a feasible plan, in its own unit; from 1e-7 to 1e-5.
FEASIBLE = 1e-6
# Changes that matter little: motions are looked at between nodes, margins follow; from 1e-4 to 1e-2.
SLIGHT = 1e-3
# Shares worth a warning, and what searches have to gain; from 3e-3 to 3e-2.
NOTABLE = 1e-2
# Shares of an allowance that errors may take or few iterations leave, and by which margins grow; from 0.05 to 0.3.
TENTH = 0.1
