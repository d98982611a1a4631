"""Tables in plain text: for terminals, for print(), and as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence

from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

# Width of tables in a pipe or a file.
WIDTH = 140


def table_of(title: str, columns: Sequence[str]) -> Table:
    """A table with a title and columns."""
    table = Table(title=Text(title), title_justify="left")
    for column in columns:
        table.add_column(Text(column), overflow="fold")
    return table


def facts(title: str) -> Table:
    """A table of two columns, names and values."""
    table = Table(title=Text(title), title_justify="left", show_header=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    return table


def add_row(table: Table, *cells: str, style: str = "") -> None:
    """Add a row of plain text to a table."""
    # As Text: rich takes brackets, in which units are written, for markup.
    table.add_row(*(Text(cell) for cell in cells), style=style)


def csv_text(columns: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """Rows under their headings as CSV."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()


def plain(parts: Iterable[RenderableType]) -> str:
    """Tables and texts below one another, as text without colours."""
    stream = io.StringIO()
    console = Console(file=stream, width=WIDTH, color_system=None, force_terminal=False, force_jupyter=False)
    for part in parts:
        console.print(part, soft_wrap=isinstance(part, Text))
    return "\n".join(line.rstrip() for line in stream.getvalue().splitlines())
