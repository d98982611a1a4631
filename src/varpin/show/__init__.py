"""Replays in meshcat, figures, and reports on robots."""
