"""The documentation says what is so: its code runs, its links lead somewhere, and the API page is complete."""

import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import varpin as vp

DOCS = Path(__file__).resolve().parents[1] / "docs"


def python_blocks(page):
    return re.findall(r"^```python\n(.*?)^```$", (DOCS / page).read_text(encoding="utf-8"), re.M | re.S)


@pytest.mark.slow
def test_the_tutorial_runs_from_top_to_bottom(tmp_path):
    blocks = python_blocks("tutorial.md")
    assert len(blocks) >= 6
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(blocks)], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "panda_reach.html").exists()


def test_every_public_name_is_on_the_api_page():
    public = {name for name in vars(vp) if not name.startswith("_") and not inspect.ismodule(getattr(vp, name))}
    listed = re.findall(r"^\.\. auto(?:class|function|exception|data):: (\w+)$", (DOCS / "api.md").read_text(), re.M)
    assert sorted(listed) == sorted(public)


@pytest.mark.parametrize("page", sorted(path.name for path in DOCS.glob("*.md")))
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#:]+)\)", (DOCS / page).read_text(encoding="utf-8")):
        assert (DOCS / target).exists(), target
