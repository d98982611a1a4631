"""The experiments of the paper, run anew: what came out, claim by claim.

The cells are in :mod:`paper.experiments`, what they say of each sentence in :mod:`paper.claims`.
"""
