"""Controls over time."""
