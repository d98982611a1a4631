"""Runs the Python of a page, and puts what it prints and logs under the code.

The blocks of a page (fenced, ``python``) run one after another in one process of their own, in an empty folder.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile

BLOCK = re.compile(r"^```python\n(.*?)^```$", re.M | re.S)
SECONDS = 120.0  # for a page

# What the process runs: the blocks by standard input, what each printed by the last line of standard output.
_DRIVER = """
import contextlib, io, json, sys, traceback

blocks, printed = json.load(sys.stdin), []
namespace = {"__name__": "__page__"}
for block in blocks:
    text = io.StringIO()
    try:
        with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
            exec(compile(block, "<page>", "exec"), namespace)
    except Exception:
        print(json.dumps([printed, traceback.format_exc()]))
        break
    printed.append(text.getvalue())
else:
    print(json.dumps([printed, ""]))
"""


def run(blocks: list[str]) -> list[str]:
    """What each of the blocks prints.

    Raises:
        RuntimeError: one of them failed; the message is its traceback.
    """
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "-c", _DRIVER],
            input=json.dumps(blocks),
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
            timeout=SECONDS,
        )
    if done.returncode:
        raise RuntimeError(done.stderr)
    printed, error = json.loads(done.stdout.splitlines()[-1])
    if error:
        raise RuntimeError(error)
    return [text.replace(folder, ".") for text in printed]


def with_outputs(page: str) -> str:
    """The page's source with what its blocks print under them."""
    printed = iter(run(BLOCK.findall(page)))

    def shown(block: re.Match[str]) -> str:
        text = next(printed).rstrip()
        return block.group() + (f"\n\n```{{code-block}} text\n:class: output\n\n{text}\n```" if text else "")

    return BLOCK.sub(shown, page)
