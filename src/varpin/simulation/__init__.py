"""Motions: stepping a scene, and the look at what came out."""
