"""Runs the Python of a page, and puts what it prints and logs under the code, and the figure that it draws.

The blocks of a page (fenced, ``python``) run one after another in one process of their own, in an empty folder. A block
draws a figure by assigning it to the name ``figure``.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile

BLOCK = re.compile(r"^```python\n(.*?)^```$", re.M | re.S)
SECONDS = 120.0  # for a page

# What the process runs: blocks by standard input; text and figure (a PNG) of each by the last line of standard output.
_DRIVER = """
import base64, contextlib, io, json, sys, traceback

blocks, outputs = json.load(sys.stdin), []
namespace = {"__name__": "__page__"}
for block in blocks:
    text, picture = io.StringIO(), io.BytesIO()
    try:
        with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
            exec(compile(block, "<page>", "exec"), namespace)
        if (figure := namespace.pop("figure", None)) is not None:
            figure.savefig(picture, format="png", dpi=110)
    except Exception:
        print(json.dumps([outputs, traceback.format_exc()]))
        break
    outputs.append([text.getvalue(), base64.b64encode(picture.getvalue()).decode()])
else:
    print(json.dumps([outputs, ""]))
"""


def run(blocks: list[str]) -> list[tuple[str, str]]:
    """What each of the blocks prints, and its figure as a PNG in base 64, empty if it draws none.

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
    outputs, error = json.loads(done.stdout.splitlines()[-1])
    if error:
        raise RuntimeError(error)
    return [(text.replace(folder, "."), picture) for text, picture in outputs]


def with_outputs(page: str) -> str:
    """The page's source with what its blocks print and draw under them."""
    outputs = iter(run(BLOCK.findall(page)))

    def shown(block: re.Match[str]) -> str:
        text, picture = next(outputs)
        parts = [block.group()]
        if text.strip():
            parts.append(f"```{{code-block}} text\n:class: output\n\n{text.rstrip()}\n```")
        if picture:
            image = f'<img class="output" alt="The figure of this block" src="data:image/png;base64,{picture}">'
            parts.append(f"```{{raw}} html\n{image}\n```")
        return "\n\n".join(parts)

    return BLOCK.sub(shown, page)
