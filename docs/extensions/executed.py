"""The Python of some pages runs when the site is built, and what it prints stands under it.

An exception, or a process that dies, is a warning of the page, so ``sphinx-build -W`` fails.
"""

import subprocess
from typing import Any

from page_code import with_outputs
from sphinx.application import Sphinx
from sphinx.util import logging


def _read(app: Sphinx, name: str, source: list[str]) -> None:
    if name in app.config.executed_pages:
        try:
            source[0] = with_outputs(source[0])
        except (RuntimeError, subprocess.TimeoutExpired) as error:
            logging.getLogger(__name__).warning("the code of the page failed: %s", error, location=name)


def setup(app: Sphinx) -> dict[str, Any]:
    """Of Sphinx: the names of pages to run are ``executed_pages`` in ``conf.py``."""
    app.add_config_value("executed_pages", [], "env", [list])
    app.connect("source-read", _read)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
