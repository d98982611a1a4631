"""HTML: tables of objects in a notebook. Plain text is escaped here."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence

from varpin.arrays import Floats

# Largest number of rows of a table, and of names in a list.
_MOST = 50

_LEFT, _RIGHT = "text-align: left; vertical-align: top", "text-align: right; vertical-align: top"


def facts(title: str, rows: Iterable[tuple[str, object]], *parts: str) -> str:
    """A table of names and values, followed by ``parts``, which are HTML."""
    body = "".join(
        f'<tr><th style="{_LEFT}; white-space: nowrap">{_text(name)}</th><td style="{_LEFT}">{_text(value)}</td></tr>'
        for name, value in rows
    )
    return f'<div class="varpin"><b>{_text(title)}</b><table>{body}</table>{"".join(parts)}</div>'


class Printed:
    """A result whose text has a name and a value in each line below the first; notebooks show it as a table."""

    def _repr_html_(self) -> str:
        title, *lines = str(self).splitlines()
        pairs = (line.partition(": ") for line in lines)
        return facts(title, [(name, value) if value else ("", name) for name, _, value in pairs])


def table(columns: Sequence[str], rows: Iterable[Sequence[object]], strong: Iterable[int] = ()) -> str:
    """The first rows under headings, text to the left, numbers to the right; those in ``strong`` are bold."""
    every, bold = list(rows), set(strong)
    head = "".join(f'<th style="{_LEFT}">{_text(name)}</th>' for name in columns)
    body = ""
    for k, row in enumerate(every[:_MOST]):
        cells = ""
        for value in row:
            inner = f"<b>{_text(value)}</b>" if k in bold else _text(value)
            cells += f'<td style="{_LEFT if isinstance(value, str) else _RIGHT}">{inner}</td>'
        body += f"<tr>{cells}</tr>"
    if len(every) > _MOST:
        body += f'<tr><td colspan="{len(columns)}" style="{_LEFT}">and {len(every) - _MOST} more</td></tr>'
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def joint_table(joints: Sequence[str], columns: Mapping[str, Floats]) -> str:
    """A table with a row for each joint, of numbers (n,) under their headings."""
    numbers = (column.tolist() for column in columns.values())
    return table(("joint", *columns), zip(joints, *numbers, strict=True))


def folded(title: str, part: str) -> str:
    """A part (HTML) that is shown on a click."""
    return f"<details><summary>{_text(title)}</summary>{part}</details>"


def listed(names: Iterable[object]) -> str:
    """Names separated by commas, at most ``_MOST``."""
    every = [str(name) for name in names]
    more = f" and {len(every) - _MOST} more" if len(every) > _MOST else ""
    return ", ".join(every[:_MOST]) + more if every else "none"


def _text(value: object) -> str:
    """A value as HTML: a float with four digits, anything else as str."""
    return html.escape(f"{value:.4g}" if isinstance(value, float) else str(value))


def warning_count(warnings: Sequence[str]) -> str:
    """The number of warnings as a part of a line; empty if there are none."""
    return f", {len(warnings)} warning{'s' * (len(warnings) > 1)}" if warnings else ""


def warning_lines(warnings: Iterable[str]) -> list[str]:
    """Warnings as lines of a text."""
    return [f"warning: {warning}" for warning in warnings]
