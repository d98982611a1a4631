"""Studies: speed against accuracy, advice, extremes."""
