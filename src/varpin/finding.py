"""What varpin tells about a result that it returns: one sentence each, with the numbers as attributes."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Sequence
from typing import Any, Self

# Kind, time step and joint of the findings that the log has for a scene.
Told = set[tuple[str, float, str | None]]


class Finding(str):
    """A warning about a motion, a plan or a robot: a string of one sentence, with its numbers as attributes.

    Attributes:
        kind: Its subject, for example ``"error"``, ``"velocity limits"`` or ``"unstable loop"``.
        joint: Name of the joint it is about; None for none.
        time: When [s]; None where no time belongs to it.
        value: Its number, in ``unit``; None where it has none.
        unit: The unit of ``value``.
    """

    kind: str
    joint: str | None
    time: float | None
    value: float | None
    unit: str

    def __new__(
        cls,
        kind: str,
        text: str,
        joint: str | None = None,
        *,
        time: float | None = None,
        value: float | None = None,
        unit: str = "",
    ) -> Self:
        """Make a finding of a kind with its text."""
        made = super().__new__(cls, text)
        made.kind, made.joint, made.time, made.value, made.unit = kind, joint, time, value, unit
        return made

    def __getnewargs_ex__(self) -> tuple[tuple[Any, ...], dict[str, Any]]:
        numbers = {"time": self.time, "value": self.value, "unit": self.unit}
        return (self.kind, str(self), self.joint), numbers

    def about(self, text: str) -> Finding:
        """The same finding with ``text`` before its own."""
        (kind, own, joint), numbers = self.__getnewargs_ex__()
        return Finding(kind, f"{text}{own}", joint, **numbers)

    def entry(self) -> str:
        """The finding as JSON, for files."""
        return json.dumps({"text": str(self), **vars(self)})

    @classmethod
    def of_entry(cls, entry: str) -> Finding:
        """The finding of a file's entry."""
        return cls(**json.loads(entry))


def and_more(number: int, what: str) -> str:
    """``"; 3 more joints do"``, the end of a sentence about the worst of several; empty for none."""
    return f"; {number} more {what}{'s' if number > 1 else ''} {'do' if number > 1 else 'does'}" if number else ""


def ranked(found: Iterable[Finding]) -> tuple[Finding, ...]:
    """One finding of each kind, the first of it."""
    kinds: dict[str, Finding] = {}
    for finding in found:
        kinds.setdefault(finding.kind, finding)
    return tuple(kinds.values())


def announce(logger: logging.Logger, told: Told, dt: float, found: Sequence[Finding]) -> None:
    """Log one line: the worst finding, the first, and how many there are; each is told once for a scene and a step.

    ``told`` is :attr:`varpin.Scene.announced`, ``dt`` the time step [s].
    """
    new = [finding for finding in found if (finding.kind, dt, finding.joint) not in told]
    told.update((finding.kind, dt, finding.joint) for finding in new)
    if new:
        more = f" ({len(found) - 1} more in .warnings)" if len(found) > 1 else ""
        logger.warning("%s%s", new[0], more)
