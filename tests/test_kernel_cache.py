"""numba's disk cache, seen from fresh processes on a copy of the package."""

from __future__ import annotations

import json
import logging
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import varpin
from varpin.kernels import _compile

# A pendulum at q = 0.3: its energy comes from a kernel of midpoint.py, which inlines one of jet.py.
SCRIPT = """
import json, sys
from numba.core.event import RecordingListener, install_listener
compiled = RecordingListener()
with install_listener("numba:compile", compiled):
    import varpin as vp
    scene = vp.Scene(vp.planar_chain(1))
    energy = vp.simulate(scene, [0.3], [0.0], dt=0.01, steps=0).energy[0]
    L = vp.lagrangian_jet(scene, [0.3], [0.0]).L
json.dump({"file": vp.__file__, "energy": energy, "L": L, "compilations": len(compiled.buffer)}, sys.stdout)
"""

GRAVITY = "potential -= g[i] * ("


class Copy:
    """A copy of the package with a cache of its own."""

    def __init__(self, folder: Path) -> None:
        self.source = folder / "src"
        self.kernels = self.source / "varpin" / "kernels"
        self.cache = folder / "cache"
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(Path(varpin.__file__).parent, self.source / "varpin", ignore=ignored)

    def run(self, **environment: str) -> tuple[dict, str]:
        """What the script reports, and its stderr."""
        settings = {"PYTHONPATH": str(self.source), "NUMBA_CACHE_DIR": str(self.cache)} | environment
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT], env=os.environ | settings, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        report = json.loads(done.stdout)
        assert Path(report["file"]).is_relative_to(self.source)
        return report, done.stderr

    def edit(self, name: str, old: str, new: str) -> None:
        path = self.kernels / name
        text = path.read_text()
        assert old in text
        # With the time stamp and the size as before: only the contents tell.
        times = path.stat()
        path.write_text(text.replace(old, new))
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))


@pytest.fixture(scope="module")
def used(tmp_path_factory) -> tuple[Copy, dict, str]:
    """A copy whose cache is filled, with what its first run said."""
    copy = Copy(tmp_path_factory.mktemp("copy"))
    return (copy, *copy.run())


def test_first_run_compiles_and_says_so(used):
    _, report, stderr = used
    assert report["compilations"] > 0
    assert stderr.count("compiling varpin's kernels for ") == 1
    assert report["energy"] == pytest.approx(-report["L"], rel=1e-14)


def test_second_run_takes_the_cache_in_silence(used):
    copy, first, _ = used
    report, stderr = copy.run()
    assert report == first | {"compilations": 0}
    assert "compiling" not in stderr


def test_an_edit_of_an_inlined_kernel_reaches_its_callers(used):
    copy, first, _ = used
    copy.edit("jet.py", GRAVITY, GRAVITY.replace("g[i]", "2.0 * g[i]"))
    try:
        report, stderr = copy.run()
    finally:
        copy.edit("jet.py", GRAVITY.replace("g[i]", "2.0 * g[i]"), GRAVITY)
    assert report["compilations"] > 0
    assert "compiling" in stderr
    assert report["energy"] == pytest.approx(2.0 * first["energy"], rel=1e-14)


@pytest.mark.slow
def test_works_where_nothing_can_be_cached(used, tmp_path):
    _, first, _ = used
    copy = Copy(tmp_path)
    # Files where numba's three places for a cache should be folders: of the environment, of the source, of the user.
    copy.cache.write_text("")
    (copy.kernels / "__pycache__").write_text("")
    report, stderr = copy.run(HOME="/proc", XDG_CACHE_HOME="/proc")
    assert report["compilations"] > 0
    assert report["energy"] == first["energy"]
    assert stderr.count("compiling varpin's kernels for ") == 1
    assert not list(tmp_path.rglob("*.nbi"))


def test_digest_covers_names_and_contents_of_all_sources(tmp_path):
    digests = set()
    for name, text in (("a.py", "1"), ("a.py", "2"), ("b.py", "2"), ("c.py", "")):
        (tmp_path / name).write_text(text)
        digests.add(_compile.sources_digest(tmp_path))
    assert len(digests) == 4
    (tmp_path / "notes.txt").write_text("no kernel")
    assert _compile.sources_digest(tmp_path) in digests
    assert _compile.sources_digest() == _compile._DIGEST


def test_announces_only_compilations_within(caplog):
    def work(x):
        return x + 1

    with caplog.at_level(logging.WARNING, logger="varpin"):
        _compile.inlined(work)(1)
        assert not caplog.records
        with _compile.announced_compilation("a feature"):
            fresh = _compile.inlined(work)
            fresh(1)
            # What a feature uses is its own.
            with _compile.announced_compilation("another"):
                fresh(1.0)
        with _compile.announced_compilation("a third"):
            fresh(1j)
    assert [record.name for record in caplog.records] == ["varpin.kernels._compile"] * 2
    assert [record.args for record in caplog.records] == [("a feature",), ("a third",)]
    assert "once on this machine" in caplog.text
