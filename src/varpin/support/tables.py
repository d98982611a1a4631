"""Tables in plain text, for terminals and for print(), and as CSV."""

from __future__ import annotations

import csv
import io
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

# Width of a terminal on which tables are readable.
WIDTH = 80
# Blanks before each column.
_GAP = "  "


@dataclass(frozen=True)
class Table:
    """Rows of words under headings, or names and values without headings.

    Attributes:
        title: The line above.
        columns: The headings; none for names and values.
        rows: The entries of each row, as many as there are columns.
        strong: Indices of the rows that stand out.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[object]]
    strong: frozenset[int] = frozenset()

    def __str__(self) -> str:
        return "\n".join([*([self.title] if self.title else []), *(self._lines() if self.columns else self._facts())])

    def _facts(self) -> Iterator[str]:
        """Names and values, which continue below each other at blanks."""
        width = max((len(str(name)) for name, _ in self.rows), default=0)
        for name, value in self.rows:
            below = _GAP + " " * width + _GAP
            text = f"{_GAP}{name!s:{width}}{_GAP}{value}"
            yield from textwrap.wrap(
                text, WIDTH, subsequent_indent=below, break_long_words=False, break_on_hyphens=False
            ) or [text.rstrip()]

    def _lines(self) -> Iterator[str]:
        """Columns as wide as their entries; those that do not fit stand below, beside the first column again."""
        # Units stand below the names.
        heads = list(zip(*(column.replace(" [", "\n[").partition("\n")[::2] for column in self.columns), strict=True))
        cells = [*heads[: 1 + any(heads[1])], *([str(cell) for cell in row] for row in self.rows)]
        rule = len(cells) - len(self.rows)
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        cells.insert(rule, ["-" * width for width in widths])
        blocks: list[list[int]] = [[0]]
        for k in range(1, len(widths)):
            if len(blocks[-1]) > 1 and sum(len(_GAP) + widths[j] for j in [*blocks[-1], k]) > WIDTH:
                blocks.append([0])
            blocks[-1].append(k)
        for number, block in enumerate(blocks):
            if number:
                yield ""
            yield from ("".join(f"{_GAP}{row[k]:{widths[k]}}" for k in block).rstrip() for row in cells)


def csv_text(columns: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """Rows under their headings as CSV."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()
