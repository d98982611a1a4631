"""The core from C++: programs that link nothing but its headers."""

import importlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

import varpin as vp
from varpin import core

ROOT = Path(__file__).parents[1]
CORE = ROOT / "src" / "core"
COMPILER = os.environ.get("CXX", "c++")
FLAGS = ["-std=c++20", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", f"-I{CORE / 'include'}"]


@pytest.fixture(autouse=True)
def _compiler():
    if shutil.which(COMPILER) is None:
        pytest.skip("there is no C++ compiler")


@pytest.fixture
def arm(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "examples" / "cpp"))
    return importlib.import_module("arm")


@pytest.fixture(params=sorted((ROOT / "tests" / "cpp").glob("*.cpp")), ids=lambda path: path.stem)
def program(request, tmp_path, arm):
    (tmp_path / "arm.hpp").write_text(arm.header(vp.Scene(vp.planar_chain(3))))
    target = tmp_path / "program"
    # That of undefined behaviour doubles the time of the compiler; .ci/sanitize has it, on the same headers.
    checks = ["-fsanitize=address", "-D_GLIBCXX_ASSERTIONS"]
    subprocess.run([COMPILER, *FLAGS, *checks, f"-I{tmp_path}", request.param, "-o", target], check=True)
    return target


def test_it_finds_nothing_amiss(program):
    done = subprocess.run([program], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_headers_stand_beside_each_other(tmp_path):
    """In one program, in either order: each includes what it needs, and no name means two things."""
    headers = sorted(path.name for path in (CORE / "include" / "varpin").glob("*.hpp"))
    for number, order in enumerate((headers, headers[::-1])):
        source = tmp_path / f"{number}.cpp"
        source.write_text("".join(f'#include "varpin/{name}"\n' for name in order))
        subprocess.run([COMPILER, *FLAGS, "-fsyntax-only", source], check=True)


def test_arithmetic_that_is_not_exact_is_refused(tmp_path):
    source = tmp_path / "fast.cpp"
    source.write_text('#include "varpin/variational.hpp"\n')
    command = [COMPILER, *FLAGS, "-ffast-math", "-fsyntax-only", "-Wfatal-errors", source]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "IEEE" in done.stderr


@pytest.fixture
def configured(tmp_path):
    """Configures the example in a folder of that name, and returns the folder."""
    if shutil.which("cmake") is None:
        pytest.skip("there is no CMake")

    def configure(name, *options):
        build = tmp_path / name
        # The same bytes at every level of optimization.
        shared = [f"-DPython_EXECUTABLE={sys.executable}", "-DCMAKE_CXX_FLAGS_RELEASE=-O1"]
        subprocess.run(["cmake", "-S", ROOT / "examples" / "cpp", "-B", build, *shared, *options], check=True)
        return build

    return configure


def includes(build):
    flags = (build / "CMakeFiles" / "plan.dir" / "flags.make").read_text()
    (found,) = re.findall(r"-(?:I|isystem )(\S*/include)\b", flags)
    return Path(found)


def test_the_example_finds_the_core_in_the_tree_and_installed(configured, tmp_path):
    """The same headers; the next test compiles them."""
    subprocess.run(["cmake", "-S", CORE, "-B", tmp_path / "core"], check=True)
    subprocess.run(["cmake", "--install", tmp_path / "core", "--prefix", tmp_path / "prefix"], check=True)
    installed = includes(configured("installed", "-G", "Unix Makefiles", f"-DCMAKE_PREFIX_PATH={tmp_path / 'prefix'}"))
    tree = includes(configured("tree", "-G", "Unix Makefiles"))
    assert (installed, tree) == (tmp_path / "prefix" / "include", CORE / "include")
    names = {path.relative_to(tree) for path in tree.rglob("*.hpp")}
    assert {path.relative_to(installed) for path in installed.rglob("*.hpp")} == names
    assert not [name for name in names if (tree / name).read_bytes() != (installed / name).read_bytes()]


def test_plan_of_the_example_is_what_python_finds(configured, tmp_path):
    """Its motions and gains are to the last byte those of its controls, which are an optimum."""
    build = configured("build")
    subprocess.run(["cmake", "--build", build], check=True)
    done = subprocess.run([build / "plan", tmp_path / "found"], check=True, capture_output=True, text=True)
    assert "with feedback" in done.stdout
    N, n, h, effort, at_goal, at_rest = 100, 6, 0.01, 1e-4, 1e3, 10.0
    start, goal = np.array([0.0, -1.5, 1.5, 0.0, 0.5, 0.0]), np.array([0.6, -1.0, 1.2, -0.4, 0.8, 0.3])
    scene = vp.Scene(vp.load_robot("ur5"), damping=0.5)
    u, q, p, K, disturbed = np.split(np.fromfile(tmp_path / "found"), np.cumsum([N * n] * 3 + [2 * N * n * n]))
    u, K = u.reshape(N, n), K.reshape(N, n, 2 * n)

    def rollout(q0, controls):
        given = {"dt": h, "steps": N, "controls": controls, "integrator": vp.Midpoint()}
        return vp.simulate(scene, q0, np.zeros(n), check=False, **given)

    motion = rollout(start, u)
    np.testing.assert_array_equal(motion.q[1:].ravel(), q)
    np.testing.assert_array_equal(motion.p[1:].ravel(), p)
    pull, off, last = u - scene.holding_torque(start), motion.q[-1] - goal, motion.p[-1]
    cost = 0.5 * (h * effort * (pull**2).sum() + at_goal * (off**2).sum() + at_rest * (last**2).sum())
    gradient, end = np.hstack([np.zeros((N, 2 * n)), effort * pull]), np.concatenate([at_goal * off, at_rest * last])
    lin, nothing = vp.linearize(scene, motion), np.zeros((N, 2 * n, 0))
    found = {"feedforward": np.empty((N, n)), "feedback": np.empty((N, n, 2 * n)), "control_gradient": np.empty((N, n))}
    found |= {"factors": np.empty((N, n, n)), "spread": np.zeros((0, 2 * n, 2 * n))}
    given = {"A": lin.A, "B": lin.B, "G": nothing, "Gx": nothing[..., None] * end, "Gu": nothing[..., None] * goal}
    given |= {"gradient": gradient, "hessian": np.diag([0.0] * (2 * n) + [effort] * n)[None]}
    run = core.BackwardPass(n, end, np.diag([at_goal] * n + [at_rest] * n))
    assert run.run(h, 1, 0.0, **given, **found) < 0
    assert 0.0 <= -run.slope < 1e-4 * cost
    np.testing.assert_array_equal(found["feedback"], K)
    policy = vp.LinearPolicy(u, K, np.hstack([motion.q, motion.p])[:-1], on="momentum")
    np.testing.assert_array_equal(rollout(start + 0.05, policy).q[1:].ravel(), disturbed)


@pytest.mark.parametrize("surroundings", [{}, {"damping": 0.1, "forces": vp.JointStop(100.0)}], ids=["alone", "forces"])
def test_a_scene_with_any_number_of_forces_is_written(surroundings, arm, tmp_path):
    text = arm.header(vp.Scene(vp.load_robot("ur5"), **surroundings))
    source = tmp_path / "arm.cpp"
    source.write_text(f"{text.replace('#pragma once', '')}\nint main() {{ return arm().dof() == 6 ? 0 : 1; }}\n")
    subprocess.run([COMPILER, *FLAGS, source, "-o", tmp_path / "program"], check=True)
    subprocess.run([tmp_path / "program"], check=True)


def test_what_the_example_does_not_write_is_refused(arm):
    scene = vp.Scene(vp.load_robot("ur5"), forces=vp.FrameWrench("tool0", [0.0, 0.0, -1.0, 0.0, 0.0, 0.0]))
    with refused(SystemExit, "forces", "frames"):
        arm.header(scene)
