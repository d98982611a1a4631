"""What a warning or a reason is about: the one place in the tests that quotes sentences; a reword changes one line."""

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
    "noise not drawn": "none was drawn",
    "nothing random": "nothing is random",
    "noise left out": "least cost without noise",
    "noise within steps": "noise costs",
    "small margin": "is too small for this noise",
    "margins not counted": "violate bounds with a margin= is not known",
    "growth": "disturbances grow",
    "adding up": "errors of steps add up",
    "steps in parts": "parts",
    "ringing": "will ring",
    "moved start": "q0 was moved",
    "missed tolerance": "is not met",
    "unchecked": "was not checked",
    "look interrupted": "interrupted before the plan was replayed",
    "late plans": "planning took",
    "failed ticks": "no plan was found, and",
    "nodes alone": "hold at the nodes alone",
    "two goals": "two goals",
    "goal out of reach": "from there at most",
    "left limits": "leave their limits",
    "outside limits": "outside its limits",
    "open loops": "are open",
    "one motion": "one and the same motion",
    "not whole ticks": "no whole number of ticks",
    "no finite number": "no finite number",
    "computed again": "is computed again",
    "untrusted gains": "cannot be trusted",
    # Of reasons and reports.
    "rounding in Quu": "rounding may have changed Quu",
    "no lower cost": "no step lowers the cost",
    "unmet constraint": "cannot be met from here",
    "unmet first node": "whatever the controls within their limits",
    "no plan from here": "no plan can be made from here",
    "no plan within constraints": "no plan within the constraints",
    "no half step": "half the step cannot be taken",
    "interruption": "interrupted",
    "unfinished plan": "the plan is unfinished",
    "runaway": "away",
    "legend": "how to read it",
    "right derivatives": "the derivatives are those of the step",
    "wrong derivatives": "is not the derivative of the step",
    "another difference": "another step=",
    "left out of the description": "leaves out what the description gives",
    "out of reach": "not within reach",
}


def about(sentences: str | Iterable[str], *kinds: str) -> list[str]:
    """Those of the sentences, of a motion's warnings or a log, that are about one of ``kinds``."""
    given = [sentences] if isinstance(sentences, str) else sentences
    return [sentence for sentence in given if any(MARKS[kind] in sentence for kind in kinds)]
