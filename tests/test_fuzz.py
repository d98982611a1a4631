"""Damaged files end in an error of varpin's, and those that once did not, each by itself."""

from __future__ import annotations

import io
import os
import struct
import threading
import zipfile
from concurrent.futures import ThreadPoolExecutor

import fuzz
import numpy as np
import pinocchio as pin
import pytest
from fuzz import npz, record, runner
from mechanisms import INERTIAL, joint, link, mass_matrix, random_tree, write_urdf

import varpin as vp
from varpin.io.archive import read_npz
from varpin.model import geometry
from varpin.model.tree import tree_mass_matrix
from varpin.study import extremes

# What takes some seconds each.
INPUTS = {
    "urdf": 400, "npz": 600, "solution": 150, "scene": 800,
    "reference": 800, "record": 1500, "command": 200,
}  # fmt: skip


def sound(kind, inputs):
    report = fuzz.run(kind, seed=7, begin=0, end=inputs)
    assert not report.findings, str(report)
    assert report.inputs == inputs
    assert report.largest < 7e8
    return report


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "inputs"), INPUTS.items())
def test_no_input_kills_hangs_or_surprises(kind, inputs):
    outcomes = sound(kind, inputs).outcomes
    # Most damage is told, and some of it does none.
    harmless = sum(count for outcome, count in outcomes.items() if outcome.startswith(("taken", "status 0")))
    assert harmless > inputs // 50
    assert inputs - harmless > inputs // 10


@pytest.mark.parametrize("kind", ["scene", "record"])
def test_a_sample(kind):
    sound(kind, 60)


@pytest.mark.parametrize("kind", fuzz.KINDS)
def test_an_input_follows_from_its_number(kind):
    if kind in ("solution", "npz", "reference"):
        pytest.skip("whose corpus has to be computed: the slow test looks at them")
    corpus = runner.module(kind).corpus()
    assert [runner.make(kind, n, 3, corpus) for n in range(5)] == [runner.make(kind, n, 3, corpus) for n in range(5)]


def test_the_fuzzer_sees_what_it_is_there_for(monkeypatch):
    lines = {
        "crash": ["5", "died: exit code -11"],
        "hang": ["5", None],
        "surprise": ["5", '[5, "FINDING", "KeyError: 3", 0.1, 1000]'],
    }
    for line in lines.values():
        calls = []

        def watched(kind, seed, begin, end, line=line, calls=calls):
            if begin == end:
                return iter(())
            calls.append(begin)
            return iter(line if begin == 5 else [f'[{n}, "taken", "", 0.1, 1000]' for n in range(begin, end)])

        monkeypatch.setattr(runner, "_watched", watched)
        report = fuzz.run("urdf", 0, 5, 8)
        assert [(kind, number) for kind, number, _ in report.findings] == [("urdf", 5)]
        assert (report.inputs, calls) == (3, [5, 6])


class TestUrdf:
    def chain(self, folder, links, kind="fixed"):
        parts = [
            link(f"l{k}") + joint(f"j{k}", f"l{k - 1}" if k > 1 else "base", f"l{k}", kind) for k in range(1, links)
        ]
        return write_urdf(folder, *parts)

    def refused(self, path, words):
        with pytest.raises(vp.RobotError, match=words):
            vp.load_robot(path)

    def test_deeper_than_the_parser_s_stack(self, tmp_path):
        # At 4000 links Pinocchio ends the process, on a stack of the usual size.
        path = self.chain(tmp_path, 5001)
        path.write_text(path.read_text().replace('name="j1" type="fixed"', 'name="j1" type="continuous"'))
        before = threading.stack_size()
        assert vp.load_robot(path).joint_names == ("j1",)
        # Also from a thread.
        with ThreadPoolExecutor(1) as thread:
            assert thread.submit(vp.load_robot, path).result().dof == 1
        assert threading.stack_size() == before

    def test_entities_that_expand_without_bound(self, tmp_path):
        laughs = "".join(f'<!ENTITY e{k} "{f"&e{k - 1};" * 10}">' for k in range(1, 12))
        path = tmp_path / "a.urdf"
        path.write_text(f'<!DOCTYPE robot [<!ENTITY e0 "ha">{laughs}]><robot name="a"><link name="&e11;"/></robot>')
        with pytest.raises(vp.RobotError):
            vp.load_robot(path)

    def test_nested_elements(self, tmp_path):
        self.refused(
            write_urdf(tmp_path, "<a>" * 20_000 + "</a>" * 20_000, link("l1", extra="<a>" * 5000 + "</a>" * 5000)),
            "Two root links|no joint that moves",
        )
        nested = joint("j1", "base", "l1", inside="<a>" * 5000 + "</a>" * 5000)
        self.refused(write_urdf(tmp_path, link("l1"), nested), "its elements are nested too deep")

    def test_numbers_that_only_one_of_the_parsers_reads(self, tmp_path):
        # Pinocchio drops the inertial with a line on stderr.
        for word in ("1_000", "٣", "0x1p3"):
            path = write_urdf(tmp_path, link("l1", INERTIAL.replace('"1.3"', f'"{word}"')), joint("j1", "base", "l1"))
            self.refused(path, "motion of 'j1' carries no inertia")
            assert any("no finite number: it is massless" in said for said in vp.inspect_robot(path).warnings)

    def test_numbers_in_odd_white_space(self, tmp_path):
        odd = INERTIAL.replace('value="1.3"', 'value=" 1.3&#9;"').replace("0.02 0.05 0.1", "&#10;0.02&#9;0.05  0.1 ")
        body = vp.load_robot(write_urdf(tmp_path, link("l1", odd), joint("j1", "base", "l1"))).model.inertias[1]
        assert body.mass == 1.3
        np.testing.assert_array_equal(body.lever, [0.02, 0.05, 0.1])

    def test_bytes_that_are_no_utf_8(self, tmp_path):
        path = write_urdf(tmp_path, link("l1"), joint("jXX", "base", "l1"))
        path.write_bytes(path.read_bytes().replace(b"jXX", b"j\xff\xfe"))
        robot = vp.load_robot(path)
        assert robot.joint_names == ("j\ufffd\ufffd",)
        assert vp.inspect_robot(path).joints
        assert geometry(robot).ngeoms == 0

    def test_masses_beyond_floating_point(self, tmp_path):
        heavy = INERTIAL.replace('ixx="0.02"', 'ixx="1e308"').replace('iyy="0.03"', 'iyy="1e308"')
        path = write_urdf(
            tmp_path, link("l1", heavy), link("l2", heavy), joint("j1", "base", "l1"), joint("j2", "l1", "l2")
        )
        self.refused(path, "the mass matrix of robot 'made_up' is not finite")
        with pytest.raises(vp.RobotError, match="not finite"):
            vp.inspect_robot(path)

    @pytest.mark.parametrize("axis", ["1e-200 0 0", "0 1e-320 0"])
    def test_axes_beyond_floating_point(self, tmp_path, axis):
        # What is not normalised moves other inertia in Pinocchio than in varpin, whose rotations were NaN.
        path = write_urdf(
            tmp_path, link("l1"), link("l2"), joint("j1", "base", "l1"), joint("j2", "l1", "l2", axis=axis)
        )
        self.refused(path, "joint 'j2' has an axis of length .*, which Pinocchio makes no unit vector of")

    def test_dampers_beyond_floating_point(self):
        scene = vp.Scene(vp.planar_chain(2, mass=1e-150, length=1e-5), damping=1e160)
        motion = vp.simulate(scene, np.zeros(2), np.ones(2), dt=1e-3, steps=2)
        assert np.isfinite(motion.q).all()
        assert "damping is faster than the step" in motion.warnings[0]

    def test_links_that_pinocchio_loses(self, tmp_path, monkeypatch):
        path = write_urdf(tmp_path, link("l1"), joint("j1", "base", "l1"))
        build = pin.buildModelFromXML

        def lossy(text):
            model = build(text)
            model.inertias[1] = pin.Inertia.Zero()
            return model

        monkeypatch.setattr(pin, "buildModelFromXML", lossy)
        self.refused(path, "describes links of 1.3 kg in all, of which Pinocchio reads 0 kg")


class TestModels:
    @pytest.mark.parametrize(
        ("change", "words"),
        [
            (lambda model: model.parents.__setitem__(2, 77), "comes before its parent"),
            (lambda model: setattr(model, "armature", np.zeros(1)), "its armature has 1 entries, where 3 belong"),
            (lambda model: setattr(model, "lowerPositionLimit", np.zeros(9)), "its lowerPositionLimit has 9 entries"),
            (lambda model: model.names.append("more"), "its names has 5 entries, where 4 belong"),
            (lambda model: model.inertias.append(pin.Inertia.Zero()), "its inertias has 5 entries"),
            (lambda model: setattr(model.frames[1], "parentJoint", 99), "hangs on what is not there"),
        ],
    )
    def test_whose_parts_do_not_fit(self, change, words):
        model = random_tree(0, 3, branching=False)
        model.addFrame(pin.Frame("tool", 1, 0, pin.SE3.Identity(), pin.FrameType.OP_FRAME))
        while any(joint.nq != 1 for joint in list(model.joints)[1:]):
            model = random_tree(int(model.name[4:]) + 1, 3, branching=False)
            model.addFrame(pin.Frame("tool", 1, 0, pin.SE3.Identity(), pin.FrameType.OP_FRAME))
        change(model)
        with pytest.raises(vp.RobotError, match=words):
            vp.load_robot(model)

    @pytest.mark.parametrize("seed", range(5))
    def test_mass_matrix_in_numpy_is_pinocchio_s(self, seed):
        robot = vp.load_robot(random_tree(seed, 8))
        q = np.random.default_rng(seed).normal(size=8)
        expected = mass_matrix(robot, q, robot.free_model.createData())
        np.testing.assert_allclose(
            tree_mass_matrix(robot.tree, q), expected, rtol=0, atol=1e-13 * np.abs(expected).max()
        )

    @pytest.mark.parametrize("name", ["tiago", "allegro_left_hand", "panda"])
    def test_mass_matrix_in_numpy_knows_mimic_joints(self, load, name):
        robot = load(name)
        q = np.random.default_rng(0).normal(size=robot.dof)
        expected = mass_matrix(robot, q, robot.free_model.createData())
        np.testing.assert_allclose(
            tree_mass_matrix(robot.tree, q), expected, rtol=0, atol=1e-13 * np.abs(expected).max()
        )


class TestArchives:
    def written(self, path, **members):
        """An npz of raw contents."""
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in members.items():
                archive.writestr(f"{name}.npy", content)
        return path

    def npy(self, head, data=b""):
        return b"\x93NUMPY\1\0" + struct.pack("<H", len(head) + 1) + head.encode() + b"\n" + data

    @pytest.mark.parametrize(
        ("head", "words"),
        [
            # numpy made room for a header's word: 8 TB here.
            ("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }", "a has 8 bytes for shape"),
            ("{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }", "for shape"),
            ("{'descr': '<U0', 'fortran_order': False, 'shape': (1000000000000,), }", "is an array of"),
            ("{'descr': '<U1000000', 'fortran_order': False, 'shape': (), }", "is an array of"),
            ("{'descr': '|O', 'fortran_order': False, 'shape': (), }", "without unpickling"),
            ("{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (1,), }", "is an array of"),
            ("[" * 5000, "truncated or damaged"),
        ],
    )
    def test_headers_that_ask_for_more_than_there_is(self, tmp_path, head, words):
        with pytest.raises(vp.FileError, match=words):
            read_npz(self.written(tmp_path / "a.npz", a=self.npy(head, b"12345678")))

    def test_bombs(self, tmp_path):
        stream = io.BytesIO()
        np.lib.format.write_array_header_1_0(stream, {"descr": "|i1", "fortran_order": False, "shape": (6 * 10**8,)})
        path = tmp_path / "a.npz"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("a.npy", "w") as member:
            member.write(stream.getvalue())
            for _ in range(600):
                member.write(bytes(10**6))
        with pytest.raises(vp.FileError, match="unpacks to 600 MB, which is over 400 MB and over 100 times its size"):
            read_npz(path)

    @pytest.mark.parametrize("order", ["C", "F"])
    def test_arrays_come_back(self, tmp_path, order):
        arrays = {
            "a": np.asarray(np.random.default_rng(0).normal(size=(3, 4)), order=order),
            "b": np.array("text"),
            "c": np.zeros((0, 3)),
            "d": np.array(3),
        }
        np.savez(tmp_path / "a.npz", **arrays)
        back = read_npz(tmp_path / "a.npz")
        for name, array in arrays.items():
            assert (back[name].dtype, back[name].shape) == (array.dtype, array.shape)
            assert np.array_equal(back[name], array)
            assert back[name].flags.c_contiguous
            assert not back[name].flags.writeable

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"q": np.zeros((5, 2), dtype=">f8")}, "q holds >f8, where float64 belongs"),
            ({"statistics.jets": np.zeros(4)}, "statistics.jets holds float64, where int64 belongs"),
            ({"joint_names": np.zeros(2)}, "joint_names holds float64, where text belongs"),
        ],
    )
    def test_trajectories_of_other_types(self, tmp_path, change, words):
        path = tmp_path / "a.npz"
        vp.simulate(vp.Scene(vp.planar_chain(2)), [0.1, 0.2], [0, 0], dt=1e-3, steps=4).save(path)
        np.savez(path, **{**np.load(path), **change})
        with pytest.raises(vp.FileError, match=words):
            vp.Trajectory.load(path)

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"runs.dt": np.zeros(1)}, r"runs.dt is float64 \(1,\), where float \(2,\) belongs"),
            ({"runs.dt": np.array(["a", "b"])}, "runs.dt is <U1"),
            ({"runs.dt": np.array(3.0)}, "runs.dt is float64"),
            ({"robot": np.zeros(())}, "robot is float64"),
            ({"robot": np.array(["a", "b"])}, "robot is <U1"),
            ({"more": np.zeros(())}, "beyond what it should, more"),
        ],
    )
    def test_records_of_other_shapes(self, tmp_path, change, words):
        path = tmp_path / "a.npz"
        path.write_bytes(npz.corpus()["tradeoff"][0])
        np.savez(path, **{**np.load(path), **change})
        with pytest.raises(vp.FileError, match=words):
            vp.OptimalControlTradeoff.load(path)


class TestScenes:
    BASE = '[robot]\nsource = "finger"\n[horizon]\ndt = 0.01\nsteps = 4\n'

    def refused(self, folder, text, words):
        path = folder / "scene.toml"
        path.write_text(text)
        with pytest.raises(vp.SceneFileError, match=words) as caught:
            vp.load_scene(path)
        assert len(str(caught.value)) < 1000
        assert "\n" not in str(caught.value)

    @pytest.mark.parametrize("key", ["a" + ".a" * 20_000, '"a b"' + '."a, b"' * 20_000, "1.5" + "-1.5" * 20_000])
    def test_keys_of_thousands_of_parts(self, tmp_path, key):
        # tomllib takes minutes.
        self.refused(tmp_path, self.BASE + key + " = 1", "dots that are not those of numbers")

    def test_many_numbers_have_many_dots(self, tmp_path):
        values = ", ".join(f"[{k}.5, 1.0, -2.5e-3]" for k in range(2000))
        times = ", ".join(f"{k}.25" for k in range(2000))
        path = tmp_path / "scene.toml"
        path.write_text(
            self.BASE + f'[[cost]]\ntype = "tracking"\nreference = {{ times = [{times}], values = [{values}] }}\n'
        )
        assert vp.load_scene(path).problem.steps == 4

    def test_too_large(self, tmp_path):
        self.refused(tmp_path, self.BASE + "\n" * 10**6, "larger than 1 MB")

    @pytest.mark.parametrize("number", ["9" * 5000, "0x" + "f" * 5000, "-9223372036854775809"])
    def test_long_integers(self, tmp_path, number):
        self.refused(tmp_path, self.BASE + f"[simulate]\nseed = {number}\n", "more than 64 bits|not TOML")

    @pytest.mark.parametrize(
        ("text", "words"),
        [
            ('"a\\nb" = 1', "a key of no use"),
            ('title = "a\\nb"', "must be a text of one line"),
            (f'title = "{"x" * 5000}"', "1000 characters at most"),
            ("a = " + "{a = " * 30 + "1" + "}" * 30, "nested more than 20 deep"),
            ("a = [" + ", ".join(f'"j{k}"' for k in range(1000)) + "]", "has 1000 entries; 300 are the most"),
            ('[[cost]]\ntype = "control"\n' * 301, "has 301 entries; 300 are the most"),
            (f'[[robot.payload]]\nframe = "{"x" * 500}"\nmass = 1.0\n', "there is no frame"),
        ],
    )
    def test_what_no_scene_has(self, tmp_path, text, words):
        head, own = (text, self.BASE) if "title" in text or text.startswith(("a =", '"')) else (self.BASE, text)
        self.refused(tmp_path, f"{head}\n{own}", words)

    def test_horizons_beyond_memory(self, tmp_path):
        long = self.BASE.replace("steps = 4", "steps = 2_000_000")
        self.refused(tmp_path, long + '[[cost]]\ntype = "control"\n', "steps times 1 costs are too many")
        self.refused(tmp_path, self.BASE.replace("steps = 4", "steps = 100_000_000"), "<= 10000000")

    @pytest.mark.parametrize("name", ["/dev/zero", "fifo.urdf", "x" * 300 + ".urdf", "folder/a.urdf"])
    def test_paths_that_are_no_files(self, tmp_path, name):
        os.mkfifo(tmp_path / "fifo.urdf")
        self.refused(tmp_path, self.BASE.replace("finger", name), "there is no file")

    @pytest.mark.parametrize(
        ("text", "words"),
        [
            ("," * 200_000, "a line of more than 100000 characters"),
            ("t,mcp,pip,dip,mcp\n0,1,1,1,1\n1,1,1,1,1\n", "'mcp' is there twice"),
            (",".join(f'"c{k:x}\n"' for k in range(200_000)) + ",c0\n", "'c0' is there twice"),
        ],
    )
    def test_tables_of_references(self, tmp_path, text, words):
        (tmp_path / "path.csv").write_text(text)
        cost = '[[cost]]\ntype = "tracking"\nreference = { file = "path.csv" }\n'
        self.refused(tmp_path, self.BASE + cost, words)

    def test_arrays_of_references(self, tmp_path):
        # numpy made room for a header's word.
        archives = TestArchives()
        head = "{'descr': '<M8[s]', 'fortran_order': False, 'shape': (10000000000,), }"
        archives.written(tmp_path / "path.npz", t=archives.npy(head, b"12345678"))
        cost = '[[cost]]\ntype = "tracking"\nreference = { file = "path.npz" }\n'
        self.refused(tmp_path, self.BASE + cost, "t has 8 bytes for shape")


class TestSolutions:
    @pytest.mark.parametrize(
        ("change", "words"),
        [
            # numpy compares no texts with numbers where NaN may be equal.
            ({"scene.damping": np.array(["a", "b"])}, "another scene damping"),
            ({"history": np.full((1, 11), np.nan)}, "history holds counts that are no whole numbers"),
            ({"history": np.full((1, 11), np.inf)}, "history holds counts that are no whole numbers"),
            ({"search.history": np.array(-1)}, "search.history is -1, where a whole number from 0 to"),
            ({"history": np.zeros((500_000, 11))}, "unpacks to 44.* MB, which no varpin solution does that fits here"),
        ],
    )
    def test_with_other_members(self, tmp_path, change, words):
        problem = vp.OptimalControlProblem(
            vp.Scene(vp.planar_chain(2)), vp.ControlCost(1.0), [0.1, 0.2], [0.0, 0.0], dt=1e-2, steps=4
        )
        path = tmp_path / "a.npz"
        vp.solve(problem, max_iterations=1).save(path)
        np.savez(path, **{**np.load(path), **change})
        with pytest.raises(vp.FileError, match=words):
            vp.Solution.load(path, problem)


class TestRecords:
    @pytest.mark.parametrize(
        ("change", "words"),
        [
            (lambda text: "[" * 100_000, "recursion"),
            (lambda text: text.replace('"deep": false', '"deep": 0'), "deep of the record is 0"),
            (lambda text: text.replace('"missing": 0', f'"missing": {10**30}'), "missing of the record is 1000"),
            (lambda text: text.replace('"error": 0.0', f'"error": {10**400}'), "error of a cell is 1000"),
            (lambda text: text.replace('"seconds": 0.25', '"seconds": 1e999'), "seconds of a cell is inf"),
            (lambda text: text.replace('"said": []', '"said": [[]]'), r"said of a cell is \[\[\]\]"),
            (lambda text: text.replace('"trial"', '"trail"'), "a cell does not have"),
            (lambda text: text.replace('"kind": "accurate"', '"kind": "good"'), "'good' is not a valid Kind"),
            (lambda text: text + " " * 6_000_000, "larger than 5 MB"),
            (lambda text: f"[{text}]", "the record does not have"),
        ],
    )
    def test_of_the_battery(self, tmp_path, change, words):
        path, whole = tmp_path / "record.json", record.corpus().decode()
        assert change(whole) != whole
        path.write_text(change(whole))
        with pytest.raises(vp.FileError, match=words):
            extremes.Record.load(path)

    def test_that_are_no_files(self, tmp_path):
        os.mkfifo(tmp_path / "fifo")
        for path in (tmp_path, tmp_path / "fifo", tmp_path / ("x" * 300)):
            with pytest.raises(vp.FileError, match="there is no file"):
                extremes.Record.load(path)
