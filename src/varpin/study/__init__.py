"""Studies: speed against accuracy, advice, extremes, the paper."""
