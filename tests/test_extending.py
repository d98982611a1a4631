"""What docs/extending.md says, done: a class of one's own, and nothing else, is enough."""

import os
import re
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
from varpin.io.scenefile.kinds import CONSTRAINTS
from varpin.mechanics import constraints
from varpin.mechanics.forces import point_of
from varpin.mechanics.noise import BoundNoise

PAGE = Path(__file__).resolve().parents[1] / "docs" / "extending.md"


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

    def _tableau(self):
        return midpoint(0.25)

    def _coefficients(self):
        return np.full((1, 1), 0.25), np.ones(1), np.full(1, 0.5)


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


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.M | re.S)


@pytest.mark.slow
def test_a_force_of_the_core_is_a_struct_and_its_name(tmp_path):
    root = PAGE.parents[1]
    for name in ("src", "models"):
        shutil.copytree(root / name, tmp_path / name, ignore=shutil.ignore_patterns("*.so", "__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(root / name, tmp_path)
    header = tmp_path / "src" / "core" / "include" / "varpin" / "forces.hpp"
    before, listed, after = re.split(r"(^using Element =[^;]*;\n)", header.read_text(encoding="utf-8"), flags=re.M)
    struct, kinds = blocks("cpp")
    assert kinds.split() == listed.replace(">;", ", RubberBush>;").split(), "the page has another list of kinds"
    header.write_text(before + struct + kinds + after, encoding="utf-8")
    settings = {"build-type": "Plain", "define.CMAKE_UNITY_BUILD": "ON", "define.VARPIN_FEW_SIZES": "ON"}
    options = [f"--config-settings=cmake.{key}={value}" for key, value in settings.items()]
    pip = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check"]
    subprocess.run([*pip, "wheel", "--no-deps", *options, "-w", tmp_path / "wheel", tmp_path], check=True)
    (wheel,) = (tmp_path / "wheel").iterdir()
    shutil.unpack_archive(wheel, tmp_path / "built", "zip")
    script = tmp_path / "page.py"
    script.write_text("\n".join(blocks("python")) + (PAGE.parents[1] / "tests" / "added_force.py").read_text())
    done = subprocess.run(
        [sys.executable, script],
        env=os.environ | {"PYTHONPATH": str(tmp_path / "built")},
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr


def test_the_page_names_files_that_are_there():
    root = PAGE.parents[1]
    text = PAGE.read_text(encoding="utf-8")
    found = {path.name for path in (root / "src").rglob("*.*")} | {path.name for path in (root / "tests").iterdir()}
    named = {name.rpartition("/")[2] for name in re.findall(r"`([\w/]+\.(?:py|hpp|cpp))`", text)}
    assert named
    assert named <= found


def test_q0_takes_the_way_that_the_page_says():
    """Its Python functions are called in its order."""
    listed = re.search(r"\*\*`q0` from(.*?)\*\*A torque", PAGE.read_text(encoding="utf-8"), re.S).group(1)
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
