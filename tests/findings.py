"""What a warning or a reason is about: its kind, or words of it where it is plain text, quoted here alone."""

from collections.abc import Iterable

# Words of findings in logs, reports and files, by their kinds.
MARKS = {
    "error": "off by up to",
    "noise not drawn": "no noise was applied",
    "open loops": "is open",
    "start off the constraints": "q0 was moved",
    "replay": "in quarters of dt",
    "noise within steps": "noise costs",
    "tolerance not met": "is not met",
    "outside limits": "outside its limits",
    "no finite number": "no finite number",
    "computed again": "is computed again",
    "untrusted gains": "cannot be trusted",
    # Of reasons and reports.
    "rounding in Quu": "rounding may have changed Quu",
    "no lower cost": "no step lowers the cost",
    "unmet constraint": "cannot be met from here",
    "unmet first node": "whatever the controls within their limits",
    "no plan within constraints": "no plan within the constraints",
    "no half step": "half the step cannot be taken",
    "interruption": "interrupted",
    "unfinished plan": "the plan is unfinished",
    "runaway": "away",
    "legend": "how to read it",
    "right derivatives": "the derivatives are those of the step",
    "another difference": "another step=",
    "left out of the description": "the scene leaves out",
    "out of reach": "not within reach",
}


def about(found: str | Iterable[str], *kinds: str) -> list[str]:
    """Those of a motion's warnings, or of the lines of a log or a report, that are about one of ``kinds``."""
    given = [found] if isinstance(found, str) else found
    return [one for one in given if _is_about(one, kinds)]


def _is_about(one: str, kinds: tuple[str, ...]) -> bool:
    own: str = getattr(one, "kind", "")
    return own in kinds if own else any(MARKS.get(kind, kind) in one for kind in kinds)
