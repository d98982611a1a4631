"""What scripts measure, put into the pages that show it."""

from collections.abc import Mapping
from pathlib import Path


def fill(page: Path, parts: Mapping[str, str]) -> None:
    """Replace what stands between the page's markers ``<!-- name:begin -->`` and ``<!-- name:end -->``."""
    text = page.read_text(encoding="utf-8")
    for name, own in parts.items():
        begin, end = f"<!-- {name}:begin -->\n", f"<!-- {name}:end -->"
        before, rest = text.split(begin)
        text = f"{before}{begin}{own}\n{end}{rest.split(end, 1)[1]}"
    page.write_text(text, encoding="utf-8")
