"""The experiments of the paper, run anew: what came out, claim by claim.

``varpin paper`` is :func:`reproduce`. The cells are in :mod:`varpin.study.paper.experiments`, what they say of each
sentence in :mod:`varpin.study.paper.claims`.
"""

from varpin.study.paper.reproduction import Reproduction as Reproduction
from varpin.study.paper.reproduction import reproduce as reproduce
