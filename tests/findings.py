"""What a warning is about: the one place in the tests that quotes the sentences, so that a reword changes one line."""

from __future__ import annotations

from collections.abc import Iterable

MARKS = {
    "stiff damping": "damping is faster than the step",
    "dry friction": "dry friction is faster than the step",
    "coarse steps": "coarse",
    "energy": "the energy is off by",
    "phase": "lose phase",
    "fast controls": "too fast for dt",
    "alternating steps": "alternates from step to step",
    "alternating ticks": "alternates from tick to tick",
    "restless plan": "goes up and down",
    "unstable loop": "control loop",
    "period too long": "too fast for its period",
    "replay": "cannot be replayed",
    "between nodes": "between nodes",
    "noise left out": "least cost without noise",
}


def about(sentences: str | Iterable[str], *kinds: str) -> list[str]:
    """Those of the sentences, of a motion's warnings or a log, that are about one of ``kinds``."""
    given = [sentences] if isinstance(sentences, str) else sentences
    return [sentence for sentence in given if any(MARKS[kind] in sentence for kind in kinds)]
