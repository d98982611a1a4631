"""The documentation says what is so: its code runs, its links lead somewhere, and the API page is complete."""

import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import varpin as vp
from varpin.io.scenefile import scenes

DOCS = Path(__file__).resolve().parents[1] / "docs"


def python_blocks(page):
    return re.findall(r"^```python\n(.*?)^```$", (DOCS / page).read_text(encoding="utf-8"), re.M | re.S)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("page", "least", "made"),
    [
        ("tutorial.md", 6, ["panda_reach.html"]),
        ("replay.md", 2, ["marks.html", "pair.html", "controller.html"]),
        ("notebooks.md", 2, []),
        ("control-loop.md", 1, ["loop.html"]),
        ("textbook.md", 2, []),
        ("many-machines.md", 4, []),
    ],
)
def test_a_page_runs_from_top_to_bottom(page, least, made, tmp_path):
    blocks = python_blocks(page)
    assert len(blocks) >= least
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(blocks)], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in tmp_path.iterdir() if path.suffix == ".html") == sorted(made)


def gallery_rows():
    """The table's rows by scene: joints, steps, cost, iterations, true cost."""
    lines = [line for line in (DOCS / "gallery.md").read_text().splitlines() if line.startswith("| [")]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {re.match(r"\[(\w+)\]", first).group(1): cells for first, *cells in rows}


def test_the_gallery_shows_every_scene():
    text = (DOCS / "gallery.md").read_text()
    assert sorted(gallery_rows()) == sorted(scenes())
    for name in scenes():
        picture = DOCS / "images" / f"gallery_{name}.png"
        assert f"(images/{picture.name})" in text
        assert f"varpin solve {name} --html" in text
        assert picture.stat().st_size < 100_000


@pytest.mark.slow
@pytest.mark.parametrize("name", scenes())
def test_the_gallery_says_what_comes_out(name):
    plan = vp.load_scene(name).solve()
    joints, _, cost, iterations, _ = gallery_rows()[name]
    assert joints.startswith(f"{plan.problem.scene.robot.dof} of ")
    # Another machine rounds otherwise, and a search that swings up may then take another way.
    assert plan.cost == pytest.approx(float(cost), rel=1e-3)
    assert plan.iterations == pytest.approx(int(iterations), rel=0.3, abs=1)


def test_every_public_name_is_on_the_api_page():
    public = {name for name in dir(vp) if not name.startswith("_") and not inspect.ismodule(getattr(vp, name))}
    listed = re.findall(r"^\.\. auto(?:class|function|exception|data):: (\w+)$", (DOCS / "api.md").read_text(), re.M)
    assert sorted(listed) == sorted(public)


@pytest.mark.parametrize("page", sorted(path.name for path in DOCS.glob("*.md")))
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#:]+)\)", (DOCS / page).read_text(encoding="utf-8")):
        assert (DOCS / target).exists(), target
