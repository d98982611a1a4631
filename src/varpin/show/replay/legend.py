"""The legend of a replay's colours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from varpin.show.replay.script import Script

# Colours that robots and the background do not have.
GHOST_COLOR, TARGET_COLOR = 0x1450D2, 0xC0187A
TIE_COLOR = 0x007C8A
REGION_COLORS = {"obstacle": 0x9A5B13, "out": 0x9A5B13, "in": 0x6B3FA8}
TRACE_COLORS = {"motion": 0xD1480F, "ghost": GHOST_COLOR, "reference": 0x157A3C}

# Colours of no torque, half of the limit and the whole limit; linear in between.
EFFORT_COLORS = np.array([[0.72, 0.76, 0.8], [0.98, 0.75, 0.1], [0.8, 0.05, 0.05]])


@dataclass(frozen=True)
class Entry:
    """A line of the legend.

    Attributes:
        text: Text of the line.
        colors: One CSS colour, or those of a gradient from left to right.
    """

    text: str
    colors: tuple[str, ...]


def legend(script: Script) -> list[Entry]:
    """The lines of the legend, one for each kind of mark in a script."""
    entries = []
    if any(actor.effort is not None for actor in script.actors):
        scale = tuple(_css(color) for color in np.rint(255.0 * EFFORT_COLORS).astype(int))
        entries.append(Entry("torque: none, half, all of the limit", scale))
    if any("ghost" in actor.positions for actor in script.actors):
        planned = any(actor.outlooks for actor in script.actors)
        entries.append(Entry("plan" if planned else "ghost", (f"#{GHOST_COLOR:06x}",)))
    traces = [*script.traces, *(trace for actor in script.actors for trace in actor.traces)]
    for kind, text in (("motion", "path of {}"), ("ghost", "path of {}, ghost"), ("reference", "reference: {}")):
        names = dict.fromkeys(trace.name for trace in traces if trace.kind == kind)
        if names:
            words = "reference" if [*names] == ["reference"] else text.format(", ".join(names))
            entries.append(Entry(words, (f"#{TRACE_COLORS[kind]:06x}",)))
    kinds = dict.fromkeys(tie.name for actor in script.actors for tie in actor.ties)
    if kinds:
        entries.append(Entry(f"constraint: {', '.join(kinds)}", (f"#{TIE_COLOR:06x}",)))
    found = [region for actor in script.actors for region in actor.regions]
    for kind, text in (("obstacle", "obstacle: {}"), ("out", "{} keeps out"), ("in", "{} keeps in")):
        names = dict.fromkeys(region.name for region in found if region.kind == kind)
        if names:
            entries.append(Entry(text.format(", ".join(names)), (f"#{REGION_COLORS[kind]:06x}",)))
    if targets := script.target_names:
        words = "target" if targets == ("target",) else f"target: {', '.join(targets)}"
        entries.append(Entry(words, (f"#{TARGET_COLOR:06x}",)))
    return entries


def _css(color: NDArray[np.int64]) -> str:
    return "#" + "".join(f"{part:02x}" for part in color)
