"""Motions in meshcat: as one self-contained HTML file, as a film, or in a live window."""

from varpin.show.replay.annotations import frame_names as frame_names
from varpin.show.replay.motion import replay as replay
from varpin.show.replay.video import check_film as check_film
