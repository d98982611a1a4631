"""The core from C++: programs that link nothing but its headers."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
COMPILER = os.environ.get("CXX", "c++")


@pytest.fixture(params=sorted((ROOT / "tests" / "cpp").glob("*.cpp")), ids=lambda path: path.stem)
def program(request, tmp_path):
    if shutil.which(COMPILER) is None:
        pytest.skip("there is no C++ compiler")
    target = tmp_path / "program"
    flags = ["-std=c++20", "-O1", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", "-D_GLIBCXX_ASSERTIONS"]
    sanitizers = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    include = ROOT / "src" / "core" / "include"
    subprocess.run([COMPILER, *flags, *sanitizers, f"-I{include}", request.param, "-o", target], check=True)
    return target


def test_it_finds_nothing_amiss(program):
    done = subprocess.run([program], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
