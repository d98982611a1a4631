from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

import varpin as vp

NODES = ("t", "q", "v", "p", "energy")


@pytest.fixture(scope="module")
def trajectory() -> vp.Trajectory:
    scene = vp.Scene(vp.planar_chain(2), damping=0.1, actuation=["joint2"])
    return vp.simulate(scene, [0.1, 0.2], [1.0, -1.0], dt=0.01, steps=20, controls=lambda t, q, v: [np.sin(t)])


@pytest.fixture
def saved(trajectory, tmp_path) -> Path:
    return trajectory.save(tmp_path / "run.npz")


def arrays_of(record: object) -> dict[str, np.ndarray]:
    values = {item.name: getattr(record, item.name) for item in dataclasses.fields(record)}
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


class TestRoundTrip:
    def test_holds_for_no_steps_and_no_controls(self, tmp_path):
        scene = vp.Scene(vp.planar_chain(1), actuation=[])
        still = vp.simulate(scene, [0.3], [0.0], dt=0.01, steps=0)
        loaded = vp.Trajectory.load(still.save(tmp_path / "still"))
        assert (loaded.steps, loaded.u.shape, loaded.q.shape) == (0, (0, 0), (1, 1))

    def test_holds_for_names_beyond_ascii(self, trajectory, tmp_path):
        named = dataclasses.replace(trajectory, robot="Häßlich 臂", joint_names=("épaule", "肘"))
        loaded = vp.Trajectory.load(named.save(tmp_path / "ünï.npz"))
        assert (loaded.robot, loaded.joint_names) == (named.robot, named.joint_names)

    @pytest.mark.parametrize("speed", [1.0, 1e155, 1e300])
    @pytest.mark.parametrize("integrator", [vp.ExplicitEuler(), vp.Midpoint()], ids=str)
    def test_holds_for_motions_that_run_away(self, tmp_path, speed, integrator):
        """Energies overflow long before velocities do."""
        scene = vp.Scene(vp.planar_chain(2))
        try:
            motion = vp.simulate(scene, [0.1, 0.2], [speed, -speed], dt=1e-3, steps=3, integrator=integrator)
        except vp.StepFailure as error:
            motion = error.trajectory
        assert np.isfinite(motion.energy).all() == (speed == 1.0)
        loaded = vp.Trajectory.load(motion.save(tmp_path / "away.npz"))
        for name in NODES:
            assert getattr(loaded, name).tobytes() == getattr(motion, name).tobytes(), name

    @pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan])
    @pytest.mark.parametrize("name", ["energy_defect", "residual", "branch_margin"])
    def test_holds_for_infinite_statistics(self, trajectory, tmp_path, name, value):
        statistics = dataclasses.replace(trajectory.statistics, **{name: np.full(trajectory.steps, value)})
        away = dataclasses.replace(trajectory, statistics=statistics)
        loaded = vp.Trajectory.load(away.save(tmp_path / "away.npz"))
        assert getattr(loaded.statistics, name).tobytes() == getattr(statistics, name).tobytes()

    def test_of_a_path_below_home(self, trajectory, tmp_path, monkeypatch):
        monkeypatch.setenv("HOME", str(tmp_path))
        trajectory.save("~/run.npz")
        assert (tmp_path / "run.npz").is_file()
        assert vp.Trajectory.load("~/run.npz").steps == trajectory.steps

    def test_checks_the_robot(self, saved):
        assert vp.Trajectory.load(saved, vp.planar_chain(2)).steps == 20
        with refused(vp.FileError, "chain2", "joint1, joint2", "'chain3'"):
            vp.Trajectory.load(saved, vp.planar_chain(3))


def test_arrays_are_read_only(trajectory, saved):
    for record in (trajectory, vp.Trajectory.load(saved)):
        for owner in (record, record.statistics):
            for name, array in arrays_of(owner).items():
                with pytest.raises(ValueError, match="read-only"):
                    array[...] = 0
                assert not array.flags.writeable, name
        with pytest.raises(dataclasses.FrozenInstanceError):
            record.dt = 1.0


class TestSaving:
    def test_that_fails_leaves_the_old_file(self, trajectory, saved, monkeypatch):
        before = saved.read_bytes()

        def fail(stream, **members):
            stream.write(b"half a file")
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(np, "savez_compressed", fail)
        with refused(vp.FileError, "No space left on device"):
            trajectory.save(saved)
        assert saved.read_bytes() == before
        assert [path.name for path in saved.parent.iterdir()] == [saved.name]

    def test_to_a_pipe(self, trajectory, tmp_path):
        # Replacing what is there would turn /dev/null into a file.
        pipe = tmp_path / "pipe"
        os.mkfifo(pipe)
        with refused(vp.FileError, "device"):
            trajectory.save(pipe)
        assert pipe.is_fifo()

    def test_replaces_and_keeps_the_umask(self, trajectory, saved):
        old = os.umask(0o027)
        try:
            trajectory.save(saved)
        finally:
            os.umask(old)
        assert saved.stat().st_mode & 0o777 == 0o640

    def test_to_where_no_file_can_be(self, trajectory, tmp_path):
        for path, fact in (
            (tmp_path, "folder"),
            (tmp_path / "nowhere" / "run.npz", "nowhere"),
            ("/proc/run.npz", "/proc"),
        ):
            with refused(vp.FileError, fact):
                trajectory.save(path)

    def test_through_a_link_writes_what_it_points_to(self, trajectory, tmp_path):
        real, link = tmp_path / "real.npz", tmp_path / "link.npz"
        real.write_bytes(b"old")
        link.symlink_to(real)
        trajectory.save(link)
        assert link.is_symlink()
        assert vp.Trajectory.load(real).steps == 20


def test_robots_with_joints_of_the_same_names_are_told_apart(tmp_path):
    """The UR arms share their joint names; their links weigh differently."""
    small = vp.load_robot("ur5")
    path = vp.simulate(vp.Scene(small), np.zeros(6), np.zeros(6), dt=1e-3, steps=3).save(tmp_path / "a.npz")
    assert vp.Trajectory.load(path, small).steps == 3
    with refused(vp.FileError, "ur5", "'ur10'", "kg"):
        vp.Trajectory.load(path, vp.load_robot("ur10"))


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("t", lambda t: t[::-1]),
        ("dt", lambda dt: -dt),
        ("dt", lambda dt: 0.0 * dt),
    ],
)
def test_numbers_that_no_motion_has(saved, name, change):
    members = dict(np.load(saved))
    np.savez(saved, **members | {name: change(members[name])})
    with refused(vp.FileError, name):
        vp.Trajectory.load(saved)


@pytest.mark.parametrize("path", [3, None, "a\0b", b"a"])
def test_what_is_no_path(path):
    motion = vp.simulate(vp.Scene(vp.planar_chain(1)), [0.0], [0.0], dt=1e-3, steps=1)
    for call in (motion.save, vp.Trajectory.load):
        with refused(vp.InputError, "path"):
            call(path)
    with refused(vp.InputError, "robot", "load_robot", "str"):
        vp.Trajectory.load("a.npz", "finger")
