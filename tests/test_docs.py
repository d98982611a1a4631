"""The documentation and the README say what is so: their code runs, links lead somewhere, and the API is complete."""

import ast
import inspect
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import varpin as vp
from varpin.cli import command
from varpin.core.arrays import Carried, ConstraintRows, Diffusion, Product
from varpin.integrators import registry
from varpin.integrators.collocation import Collocation
from varpin.integrators.tableau import midpoint
from varpin.io.scenefile import scenes
from varpin.io.scenefile.kinds import CONSTRAINTS
from varpin.mechanics import constraints
from varpin.mechanics.forces import point_of
from varpin.mechanics.noise import BoundNoise
from varpin.simulation import limits

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "docs" / "extensions"))
import page_code

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))
README = "../README.md"
# What pages write for the browser, and the package beside varpin's own that they are about.
MADE = {
    "tutorial.md": ["panda_reach.html"],
    "replay.md": ["marks.html", "pair.html", "controller.html", "slider.html"],
    "control-loop.md": ["loop.html"],
    "scenes.md": ["plan.html"],
}
NEEDS = {"crocoddyl.md": "crocoddyl", "drake.md": "pydrake", "many-machines.md": "distributed", "mujoco.md": "mujoco"}
# Pages that run in less than 3 s of processor time; the site runs most others while it is built.
QUICK = ("drake.md", "mujoco.md", "notebooks.md", "robots.md")
WIDEST = 96


def text_of(page):
    return (DOCS / page).read_text(encoding="utf-8")


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```$", text_of(page), re.M | re.S)


def run(*words, cwd, **options):
    done = subprocess.run([sys.executable, *words], cwd=cwd, capture_output=True, text=True, check=False, **options)
    assert done.returncode == 0, done.stderr
    return done


@pytest.mark.parametrize(
    "page",
    [pytest.param(page, marks=[] if page in QUICK else pytest.mark.slow) for page in PAGES if blocks(page, "python")],
)
def test_a_page_runs_from_top_to_bottom(page, tmp_path):
    if page in NEEDS:
        pytest.importorskip(NEEDS[page])
    run("-c", "\n".join(blocks(page, "python")), cwd=tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir() if path.suffix == ".html") == sorted(MADE.get(page, []))


@pytest.mark.parametrize("page", PAGES)
def test_code_is_in_a_language_that_is_checked_and_fits_its_box(page):
    kinds = re.findall(r"^```(\S+)$", text_of(page), re.M)
    assert set(kinds) <= {"python", "cpp", "bash", "text", "toml", "{toctree}", "{eval-rst}", "{glossary}"}
    for kind in ("python", "cpp", "bash", "toml"):
        for block in blocks(page, kind):
            assert max(map(len, block.splitlines())) <= WIDEST, block


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "bash")])
def test_commands_are_ones_that_varpin_has(page):
    """Words and options, not what the files that they name hold."""
    for line in "".join(blocks(page, "bash")).splitlines():
        words = shlex.split(line, comments=True)
        if words and words[0] == "varpin":
            request = command._parser().parse_args(words[1:])
            assert callable(request.run), line


def test_the_site_runs_pages_that_there_are():
    names = re.search(r"executed_pages = \[(.*?)\]", (DOCS / "conf.py").read_text(), re.S).group(1)
    pages = [f"{name}.md" for name in re.findall(r'"([\w-]+)"', names)]
    assert len(pages) > 5
    for page in pages:
        assert blocks(page, "python"), page


def test_what_a_block_prints_and_draws_is_put_under_it():
    shown = page_code.with_outputs("# A page\n\n```python\nx = 2\n```\n\n```python\nprint(x)\n```\n")
    assert shown.count("```{code-block} text") == 1
    assert shown.endswith("```python\nprint(x)\n```\n\n```{code-block} text\n:class: output\n\n2\n```\n")
    drawn = page_code.with_outputs("```python\nfrom matplotlib.figure import Figure\n\nfigure = Figure()\n```\n")
    assert re.search(r"```\n\n```\{raw\} html\n<img [^\n]*base64,iVBORw0KGgo[^\n]*>\n```\n$", drawn)
    with pytest.raises(RuntimeError, match="ZeroDivisionError"):
        page_code.with_outputs("```python\n1 / 0\n```\n")


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
        assert picture.stat().st_size < 250_000


@pytest.mark.slow
@pytest.mark.parametrize("name", scenes())
def test_the_gallery_says_what_comes_out(name):
    plan = vp.load_scene(name).solve()
    joints, _, cost, iterations, _ = gallery_rows()[name]
    assert joints.startswith(f"{plan.problem.scene.robot.dof} of ")
    # Another machine rounds otherwise, and a search that swings up may then take another way.
    assert plan.cost == pytest.approx(float(cost), rel=1e-3)
    assert plan.iterations == pytest.approx(int(iterations), rel=0.3, abs=1)


def equations(cell):
    """The numbers in a cell of the map, "(E1) to (E3)" written out."""
    for first, last in re.findall(r"\(([A-Z]\d+|1\.\d+)\)(?: to \(([A-Z]\d+|1\.\d+)\))?", cell):
        stem, begin = re.match(r"([A-Z]|1\.)(\d+)", first).groups()
        end = re.match(r"(?:[A-Z]|1\.)(\d+)", last or first).group(1)
        yield from (f"({stem}{k})" for k in range(int(begin), int(end) + 1))


DEFINITIONS = (ast.FunctionDef, ast.ClassDef)
PLACE = re.compile(r"`([\w/]+\.(?:hpp|py))`: `(\w+)`")


def described(file, name):
    """The docstrings of the functions or classes of this name in a Python file, or the comments above those in C++."""
    if file.endswith(".py"):
        folder = ROOT / ("benchmarks" if file.startswith("paper/") else "src/varpin")
        nodes = ast.walk(ast.parse((folder / file).read_text(encoding="utf-8")))
        named = [node for node in nodes if getattr(node, "name", None) == name and isinstance(node, DEFINITIONS)]
        found = [ast.get_docstring(node) or "" for node in named]
    else:
        source = (ROOT / "src/core/include/varpin" / file).read_text(encoding="utf-8")
        defined = rf"^ *(?!return)(?:[\w:<>*&\[\]]+ )+{name}\b(?!;).*[{{,]$"
        found = re.findall(rf"((?:^ *//.*\n)*)(?:^ *template .*\n)?{defined}", source, re.M)
    assert found, f"{file} defines no {name}"
    return "\n".join(found)


def equation_map():
    rows = re.findall(r"^\| (\([^|]*) \| [^|]* \| (.*) \|$", text_of("mathematics.md"), re.M)
    return [(list(equations(cell)), PLACE.findall(where)) for cell, where in rows]


def test_every_equation_is_on_the_map():
    pages = "".join(text_of(page) for page in ("mathematics.md", "constraints.md"))
    shown = re.findall(r"\\tag\{([A-Z]\d+)\}", pages)
    assert len(set(shown)) == len(shown) > 30
    mapped = [number for numbers, _ in equation_map() for number in numbers]
    assert len(set(mapped)) == len(mapped)
    assert {f"({tag})" for tag in shown} | {f"(1.{k})" for k in range(1, 11)} == set(mapped)


@pytest.mark.parametrize(("numbers", "functions"), equation_map())
def test_an_equation_is_computed_where_the_map_says(numbers, functions):
    """And what is said of the function names the equation in turn."""
    assert functions
    for file, name in functions:
        unnamed = set(numbers) - set(equations(described(file, name)))
        assert not unnamed, f"{name} in {file} does not name {sorted(unnamed)}"


HEADERS = sorted((ROOT / "src" / "core").rglob("*.hpp"))
NAMED_PAGE = re.compile(r"docs/([\w-]+\.md)((?:(?:,| and)? \"[^\"]+\")*)")


@pytest.mark.parametrize("header", HEADERS, ids=lambda path: path.name)
def test_a_header_names_a_page_at_its_head(header):
    """And sections of it that there are: headings, or words in bold at the beginning of a paragraph."""
    head = header.read_text(encoding="utf-8").partition("#pragma once")[0]
    named = NAMED_PAGE.findall(re.sub(r"\s*\n// *", " ", head))
    assert named, f"{header.name} names no page of docs/"
    for page, sections in named:
        assert page in PAGES
        for section in re.findall(r'"([^"]+)"', sections):
            assert re.search(rf"^(?:#+ |\*\*){section}\b", text_of(page), re.M), f"{page} has no section {section!r}"


def test_every_header_of_the_core_is_on_its_map():
    listed = re.search(r"## The map\n(.*?)\n## ", text_of("core.md"), re.S).group(1)
    core = {header.name for header in HEADERS if "bindings" not in header.parts}
    assert core == set(re.findall(r"`(\w+\.hpp)`", listed))


@pytest.mark.parametrize(
    ("page", "title"), [("extending.md", "Where decisions are made"), ("core.md", "Where a step stands")]
)
def test_functions_stand_where_the_page_says(page, title):
    rows = re.search(rf"## {title}\n(.*?)\n## ", text_of(page), re.S).group(1).splitlines()
    rows = [row for row in rows if row.startswith("| ")][1:]
    assert len(rows) > 7
    for row in rows:
        assert PLACE.findall(row), row
        for file, name in PLACE.findall(row):
            described(file, name)


def test_every_public_name_is_on_one_page_of_the_api():
    public = {name for name in dir(vp) if not name.startswith("_") and not inspect.ismodule(getattr(vp, name))}
    pages = "".join(text_of(page) for page in PAGES if page.startswith("api"))
    listed = re.findall(r"^\.\. auto(?:class|function|exception|data):: (\w+)$", pages, re.M)
    assert sorted(listed) == sorted(public)


def test_type_checkers_see_the_names_that_are_imported_late():
    tree = ast.parse(Path(vp.__file__).read_text(encoding="utf-8"))
    (block,) = (item for item in tree.body if isinstance(item, ast.If) and isinstance(item.test, ast.Name))
    seen = {(item.module, name.name) for item in block.body for name in item.names}
    assert seen == {(module, name) for module, names in vp._LATE.items() for name in names.split()}


@pytest.mark.parametrize("page", [README, *PAGES])
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#:]+)[)#]", text_of(page)):
        assert ((DOCS / page).parent / target).exists(), target


def test_the_list_of_slow_tests_names_tests(request):
    if request.config.args_source is not pytest.Config.ArgsSource.TESTPATHS:
        pytest.skip("some tests are not collected")
    assert not request.config.unknown_slow


@pytest.mark.parametrize("number", range(len(blocks(README, "python"))))
def test_a_block_of_the_readme_runs(number, tmp_path):
    code = blocks(README, "python")[number]
    done = run("-c", code, cwd=tmp_path)
    # What is shown first asks nothing of a robot that its description forbids.
    assert not [kind for kind in limits.KINDS if kind in done.stderr], done.stderr
    if "replay" in code:
        assert list(tmp_path.glob("*.html"))
    if "verify" in code:
        own = done.stdout[done.stdout.index("                          cost") :]
        (table,), cost = blocks(README, "text"), r" (\d\.\d{6}e-07)"
        for found, shown in zip(own.split(), table.split(), strict=False):
            # What is down at rounding is another number on another machine.
            assert found == shown or float(found) == pytest.approx(float(shown), rel=0.5, abs=1e-12)
        found, shown = ([float(text) for text in re.findall(cost, part)[:3]] for part in (own, table))
        assert found == pytest.approx(shown, rel=1e-3)


def test_the_readme_s_main_command(tmp_path):
    """The first command's own work, with this interpreter for the one it installs; .ci/run runs it whole."""
    assert set(re.findall(r"^```(\w+)$", text_of(README), re.M)) == {"python", "bash", "text"}
    first, _ = blocks(README, "bash")
    words = first.replace("\\\n", " ").split("&& .venv/bin/varpin ")[1]
    run("-m", "varpin", *words.split(), cwd=tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"finger.html", "finger.npz", "finger.png"}


# --- what docs/extending.md says, done: a class of one's own, and nothing else, is enough ----------------------------


@dataclass(frozen=True, eq=False, repr=False)
class Height(constraints.Constraint):
    """A frame's origin at a height: g = z . x - height."""

    a: str
    height: float

    def bind(self, robot):
        body, _, at = point_of("a", self.a, robot)
        vectors = ((Carried(body, False, tuple(at)),), (Carried(-1, True, (0.0, 0.0, 1.0)),))
        rows = ConstraintRows(vectors, (Product(0, 1, 1.0, self.height),))
        return constraints.Bound(rows, (repr(self),))


def test_a_constraint_is_the_plane_that_it_is():
    robot, plane = vp.planar_chain(3), vp.PointOnPlane("tip", (0.0, 0.0, 0.4), (0.0, 0.0, 1.0))
    mine, known = (vp.Scene(robot, constraints=own) for own in (Height("tip", 0.4), plane))
    q = vp.assemble(mine, [0.3, -0.5, 0.4])
    for one, other in zip(mine.constraint_values(q + 0.1), known.constraint_values(q + 0.1), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-14)
    given = {"dt": 1e-2, "steps": 50, "integrator": vp.Gauss(2)}
    motion, other = (vp.simulate(scene, q, np.zeros(3), **given) for scene in (mine, known))
    np.testing.assert_allclose(robot.frame_positions(motion.q, "tip")[:, 2], 0.4, atol=1e-12)
    np.testing.assert_allclose(motion.q, other.q, atol=1e-10)
    assert np.ptp(motion.q, axis=0).max() > 0.1


def test_scene_files_name_every_constraint_without_a_function():
    kinds = {kind for kind in constraints.Constraint.__subclasses__() if kind.__module__ == constraints.__name__}
    assert kinds - set(CONSTRAINTS.values()) == {vp.CustomConstraint}
    assert CONSTRAINTS["point_on_line"] is vp.PointOnLine


@dataclass(frozen=True)
class Quarter(Collocation):
    """The generalized midpoint rule at a quarter of the step."""

    stages: int = 1

    @property
    def order(self):
        return 1

    @property
    def scheme(self):
        return midpoint(0.25)


def test_an_integrator_is_a_tableau_and_a_name(monkeypatch):
    scene = vp.Scene(vp.planar_chain(2))
    given = {"dt": 1e-2, "steps": 20}
    mine, known = (
        vp.simulate(scene, [0.3, 0.2], [0.0, 1.0], integrator=i, **given) for i in (Quarter(), vp.Midpoint(0.25))
    )
    np.testing.assert_array_equal(mine.q, known.q)
    assert vp.check_linearization(scene, [0.3, 0.2], [0.0, 1.0], dt=1e-2, integrator=Quarter()).worst < 1e-9
    monkeypatch.setattr(registry, "BY_NAME", {**registry.BY_NAME, "Quarter": Quarter})
    assert registry.integrator_of("Quarter(kick=split)") == Quarter(kick="split")


@dataclass(frozen=True)
class First(vp.Noise):
    """White noise on the first joint alone."""

    strength: float

    def bind(self, actuation, joints):
        n, m = actuation.shape
        field, nothing = self.strength * np.eye(n)[:, :1], np.zeros((n, 1))
        return BoundNoise(Diffusion(field, np.zeros((n, 1, m)), nothing, nothing))


def test_a_noise_kicks_what_it_says():
    scene = vp.Scene(vp.planar_chain(2), noise=First(0.3))
    known = vp.Scene(vp.planar_chain(2), noise=vp.AdditiveNoise([0.3, 0.0]))
    given = {"dt": 1e-2, "steps": 20}
    dw = np.random.default_rng(0).normal(scale=0.1, size=(20, 2))
    mine = vp.simulate(scene, [0.3, 0.2], [0.0, 0.0], increments=dw[:, : scene.processes], **given)
    theirs = vp.simulate(known, [0.3, 0.2], [0.0, 0.0], increments=dw[:, : known.processes], **given)
    np.testing.assert_allclose(mine.q, theirs.q, atol=1e-14)


@pytest.mark.slow
def test_a_force_of_the_core_is_a_struct_and_its_name(tmp_path):
    for name in ("src", "models"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("*.so", "__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, tmp_path)
    header = tmp_path / "src" / "core" / "include" / "varpin" / "forces.hpp"
    before, listed, after = re.split(r"(^using Element =[^;]*;\n)", header.read_text(encoding="utf-8"), flags=re.M)
    struct, kinds = blocks("extending.md", "cpp")
    assert kinds.split() == listed.replace(">;", ", RubberBush>;").split(), "the page has another list of kinds"
    header.write_text(before + struct + kinds + after, encoding="utf-8")
    settings = {"build-type": "Plain", "define.CMAKE_UNITY_BUILD": "ON", "define.VARPIN_FEW_SIZES": "ON"}
    options = [f"--config-settings=cmake.{key}={value}" for key, value in settings.items()]
    pip = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check"]
    subprocess.run([*pip, "wheel", "--no-deps", *options, "-w", tmp_path / "wheel", tmp_path], check=True)
    (wheel,) = (tmp_path / "wheel").iterdir()
    shutil.unpack_archive(wheel, tmp_path / "built", "zip")
    script = tmp_path / "page.py"
    checks = (ROOT / "tests" / "added_force.py").read_text()
    script.write_text("\n".join(blocks("extending.md", "python")) + checks)
    run(script, cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(tmp_path / "built")})


def test_the_page_names_files_that_are_there():
    found = {path.name for path in (ROOT / "src").rglob("*.*")} | {path.name for path in (ROOT / "tests").iterdir()}
    named = {name.rpartition("/")[2] for name in re.findall(r"`([\w/]+\.(?:py|hpp|cpp))`", text_of("extending.md"))}
    assert named
    assert named <= found


def test_q0_takes_the_way_that_the_page_says():
    """Its Python functions are called in its order."""
    listed = re.search(r"\*\*`q0` from(.*?)\*\*A torque", text_of("extending.md"), re.S).group(1)
    way = re.findall(r"^\d+\. `([\w/]+\.\w+)`: (?:`(\w+)`)?", listed, re.M)
    assert len({file for file, _ in way}) == 12
    assert way[8] == ("jet.hpp", "lagrangian_jet")
    root, called = Path(vp.__file__).parent, []

    def note(frame, event, _):
        if event == "call" and root in (path := Path(frame.f_code.co_filename)).parents:
            called.append((path.relative_to(root).as_posix(), frame.f_code.co_name))

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        assert command.main(["simulate", "ur5", "--q0", "0.3", "--steps", "2", "--quiet"]) == 0
    finally:
        sys.setprofile(before)
    rest = iter(called)
    for place in way:
        if place[0].endswith(".py"):
            assert place in rest, place
