"""Motions in meshcat: as one self-contained HTML file, as a film, or in a live window."""
