"""Motions shown in meshcat: as one HTML file that plays by itself, or in a live window."""

from varpin.replay.motion import replay as replay
