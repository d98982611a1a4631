"""Files of every kind of record: those of varpin 0.1 are read, and damaged or foreign ones are refused by name."""

from __future__ import annotations

import functools
import operator
import os
import pickle
import socket
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refused

import varpin as vp
from varpin.io.archive import read_npz

DATA = Path(__file__).parent / "data" / "files"


@functools.cache
def problem() -> vp.OptimalControlProblem:
    """Of the stored solution."""
    scene = vp.Scene(vp.planar_chain(2), damping=0.2, noise=vp.AdditiveNoise(0.1))
    cost = vp.TrackingCost([0.8, 0.1], 10.0) + vp.ControlCost(0.1) + vp.ControlRateCost(0.01)
    return vp.OptimalControlProblem(scene, cost, [0.4, -0.3], [0.0, 0.0], dt=0.02, steps=8, integrator=vp.Gauss(4))


LOADERS: dict[str, Callable[[Path], Any]] = {
    "trajectory.npz": vp.Trajectory.load,
    "solution.npz": lambda path: vp.Solution.load(path, problem()),
}


def members_of(name: str) -> dict[str, np.ndarray]:
    with np.load(DATA / name) as archive:
        return dict(archive)


def changed(folder: Path, name: str, **members: Any) -> Path:
    """A stored file with other entries, or without those that are None."""
    path = folder / name
    np.savez(path, **{key: value for key, value in {**members_of(name), **members}.items() if value is not None})
    return path


def unread(name: str, path: Path, *facts: str) -> None:
    with refused(vp.FileError, path.name, *facts):
        LOADERS[name](path)


@pytest.mark.parametrize("name", LOADERS)
def test_what_varpin_wrote_is_read(name):
    record, compared = LOADERS[name](DATA / name), 0
    motion = record.trajectory if name == "solution.npz" else record
    for entry, expected in members_of(name).items():
        first, *rest = entry.split(".")
        if first == "history":
            found: Any = [getattr(item, rest[0]) for item in record.history]
        elif first == "scene":
            found = motion.scene_values.get(".".join(rest), expected if not expected.size else None)
        else:
            owner = motion if first in ("statistics", *vars(motion)) else record
            try:
                found = operator.attrgetter(entry)(owner)
            except AttributeError:
                continue
            if entry in ("accuracy", "status", "problem.integrator", "controls"):
                continue
        np.testing.assert_array_equal(found, expected)
        compared += 1
    assert compared >= {"solution.npz": 35}.get(name, 40)


def test_a_stored_solution_is_gone_on_from():
    stored = vp.Solution.load(DATA / "solution.npz", problem())
    again = vp.solve(problem(), max_iterations=3)
    assert stored.history[0].cost == pytest.approx(again.history[0].cost, rel=1e-9)
    assert vp.solve(problem(), resume=stored).cost == pytest.approx(again.cost, rel=1e-6)


@pytest.mark.parametrize("name", LOADERS)
def test_read_and_written_again_it_is_the_same(name, tmp_path):
    path = LOADERS[name](DATA / name).save(tmp_path / name)
    LOADERS[name](path)
    before, after = members_of(name), read_npz(path)
    lost = {key for key in before.keys() - after.keys() if not key.startswith("scene.") or before[key].size}
    assert lost <= {"accuracy", "motion"}
    for key in before.keys() & after.keys():
        assert before[key].dtype == after[key].dtype
        np.testing.assert_array_equal(before[key], after[key])


@pytest.mark.parametrize("name", LOADERS)
def test_what_is_no_such_record(name, tmp_path):
    whole, path = (DATA / name).read_bytes(), tmp_path / name
    for share in (0.0, 0.3, 0.9, 0.99):
        path.write_bytes(whole[: int(share * len(whole))])
        unread(name, path, "truncated")
    others = [(DATA / other).read_bytes() for other in LOADERS if other != name]
    for content in (b"hello", b"\x93NUMPY", bytes(1000), pickle.dumps({"q": 1}), *others):
        path.write_bytes(content)
        unread(name, path)
    form = str(members_of(name)["format"])
    unread(name, changed(tmp_path, name, format=form[:-1] + "9"), "/9")
    os.mkfifo(tmp_path / "pipe.npz")
    for missing in (tmp_path / "none.npz", tmp_path, tmp_path / "pipe.npz"):
        unread(name, missing)


@pytest.mark.parametrize("name", ["trajectory.npz"])
def test_any_damaged_byte_is_an_error_or_harmless(name, tmp_path):
    whole, sound = (DATA / name).read_bytes(), members_of(name)
    rng, refusals, path = np.random.default_rng(0), 0, tmp_path / name
    for place in rng.choice(len(whole), 40, replace=False):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            loaded = LOADERS[name](path)
        except vp.FileError:
            refusals += 1
        else:
            loaded.save(path)
            np.testing.assert_equal(
                members_of(name), {**sound, **{k: v for k, v in read_npz(path).items() if k in sound}}
            )
    assert refusals > 15


# The last part of the names of entries that may be missing.
OPTIONAL = {"version", "warnings", "missing", "fingerprint", "accuracy", "motion", "constraint_labels"}


@pytest.mark.parametrize("name", LOADERS)
def test_every_entry_is_checked(name, tmp_path):
    """An entry that is missing, of another shape or of another type is named: one of the three for each."""
    same = ("scene.", "statistics.", "best.") if name == "solution.npz" else ("scene.",)
    entries = {key: array for key, array in members_of(name).items() if not key.startswith(same)}
    for index, (entry, array) in enumerate(entries.items()):
        other = (None, array[None], array.astype("S9"))[index % 3]
        if entry.split(".")[-1] in OPTIONAL and (other is None or not array.size or entry.endswith("motion")):
            continue
        with pytest.raises(vp.FileError) as caught:
            LOADERS[name](changed(tmp_path, name, **{entry: other}))
        assert entry.split(".")[-1] in str(caught.value), entry


@pytest.mark.parametrize(
    ("entry", "other"),
    [
        ("statistics.substeps", lambda kept: np.append(0, kept[1:])),
        ("statistics.substeps", lambda kept: kept * 2**62),
        ("statistics.substeps", lambda kept: kept * 3),
        ("statistics.halvings", lambda kept: np.append(kept, np.uint8(1))),
    ],
)
def test_parts_that_do_not_fill_the_steps(entry, other, tmp_path):
    kept = members_of("trajectory.npz")[entry]
    unread("trajectory.npz", changed(tmp_path, "trajectory.npz", **{entry: other(kept)}), entry)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize(
    ("name", "entry"),
    [*(("trajectory.npz", entry) for entry in ("t", "q", "v", "p", "u", "dw", "dt")), ("solution.npz", "gains")],
)
def test_numbers_that_are_not_finite(name, entry, value, tmp_path):
    array = members_of(name)[entry].copy()
    array[(-1,) * array.ndim] = value
    unread(name, changed(tmp_path, name, **{entry: array}), entry)


@pytest.mark.parametrize("name", LOADERS)
def test_pickles_are_not_opened(name, tmp_path):
    witness = tmp_path / "witness"

    class Trap:
        def __reduce__(self):
            return (Path.touch, (witness,))

    path = changed(tmp_path, name, format=np.array([Trap()], dtype=object))
    unread(name, path, "format")
    assert not witness.exists()
    # The trap is live.
    with np.load(path, allow_pickle=True) as archive:
        archive["format"]
    assert witness.exists()


def test_a_wrong_shape_costs_no_memory(tmp_path):
    """A file of some kilobytes whose q would take 80 MB is refused by its header."""
    path = tmp_path / "a.npz"
    np.savez_compressed(path, **{**members_of("trajectory.npz"), "q": np.zeros((10_000_000, 1, 1))})
    assert path.stat().st_size > 1_000
    tracemalloc.start()
    with refused(vp.FileError, "a.npz", "q", "(10000000, 1, 1)"):
        vp.Trajectory.load(path)
    assert tracemalloc.get_traced_memory()[1] < 10_000_000
    tracemalloc.stop()


def test_names_that_are_too_long_are_refused_by_name(tmp_path):
    motion = vp.Trajectory.load(DATA / "trajectory.npz")
    longest = tmp_path / f"{'a' * 251}.npz"
    assert vp.Trajectory.load(motion.save(longest)).steps == motion.steps
    for call in (motion.save, vp.Trajectory.load, vp.load_scene, vp.load_robot):
        with pytest.raises(vp.VarpinError, match="aaaa"):
            call(tmp_path / f"{'a' * 300}.npz")


def test_what_a_killed_save_left_is_gone_after_the_next(tmp_path):
    """And what another process that runs is writing stays."""
    motion = vp.Trajectory.load(DATA / "trajectory.npz")
    words = "import os, pathlib, signal, sys\nfrom varpin.io.archive import atomic_file\n"
    words += "with atomic_file(pathlib.Path(sys.argv[1])): os.kill(os.getpid(), signal.SIGKILL)"
    subprocess.run([sys.executable, "-c", words, tmp_path / "a.npz"], check=False)
    assert len(list(tmp_path.iterdir())) == 1
    running = tmp_path / f".varpin-{socket.gethostname()}-{os.getppid()}-0123456789abcdef"
    running.touch()
    motion.save(tmp_path / "a.npz")
    assert sorted(path.name for path in tmp_path.iterdir()) == [running.name, "a.npz"]
