"""Damaged input for everything that reads a file: a hundred thousand inputs if asked.

    cd tests && python -m fuzz --inputs 100000 --seed 0

``runner`` feeds inputs to worker processes and reports, ``damage`` is what all kinds of input have in common, and each
other module is one kind: ``corpus()`` is what its inputs are made from, ``whole(corpus)`` an input without damage,
``make(rng, corpus)`` a damaged one, and ``read(path, form)`` reads it, uses it, and says in a word what came of that.
"""

from fuzz.runner import KINDS as KINDS
from fuzz.runner import Report as Report
from fuzz.runner import run as run
