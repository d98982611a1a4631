"""What is made of an identification: a URDF, a figure, and what ``varpin identify`` prints."""

import contextlib
import re

import numpy as np
import pinocchio as pin
import pytest
from mechanisms import joint, link, mimic, write_urdf
from refusals import refused, unnamed

import varpin as vp
from varpin.cli import main
from varpin.model import readable_geometry
from varpin.model.inertia import with_inertial_numbers
from varpin.model.urdf_output import save_urdf
from varpin.show.plots import plot_identification

TOOL = joint("flange", "b", "tool", kind="fixed") + link("tool")
FOLLOWER = joint("follow", "a", "c", inside=mimic("lift", -0.5) + '<dynamics damping="9" friction="9"/>')
PARTS = [link("a"), link("b"), joint("lift", "base", "a"), joint("slide", "a", "b", kind="prismatic")]
NOTES = "<!-- weighed -- twice --->\n<gazebo:plugin name='x'>a &lt; b<![CDATA[<raw>]]></gazebo:plugin>\n"


@pytest.fixture
def arm(tmp_path):
    return write_urdf(tmp_path, *PARTS, TOOL, FOLLOWER, link("c"), NOTES)


@pytest.mark.parametrize("options", [{}, {"lock": {"slide": 0.3}}, {"mimic": "free"}, {"base": "planar"}])
def test_a_written_urdf_is_the_robot_as_it_is_now(arm, tmp_path, options):
    rng, file = np.random.default_rng(0), vp.load_robot(arm, **options)
    robot = vp.load_robot(arm, payload=vp.Payload("tool", 0.7, (0.1, 0.2, 0.3), (0.02, 0.03, 0.04)), **options)
    robot = with_inertial_numbers(robot, {1: rng.uniform(0.0, 0.1, 10)} if "base" not in options else {})
    given = {name: rng.uniform(0.1, 0.3) for name in ("lift", "slide") if name in robot.joint_names}
    path = save_urdf(robot, tmp_path / "now.urdf", damping=given, friction=given)
    again = vp.load_robot(path, **options)
    assert again.joint_names == robot.joint_names
    for q in rng.uniform(-1.0, 1.0, (5, robot.dof)):
        at = robot.configuration(q)
        for of in (pin.crba, pin.computeGeneralizedGravity):
            old, now, then = (of(each.model, each.model.createData(), at) for each in (file, robot, again))
            np.testing.assert_allclose(np.triu(then), np.triu(now), atol=1e-12)
            assert np.abs(old - now).max() > 1e-2
    scene = vp.Scene(again, damping="robot", friction="robot")
    free = 9.0 * ("follow" in robot.joint_names)
    expected = [given.get(name, free * (name == "follow")) for name in robot.joint_names]
    np.testing.assert_array_equal(scene.damping, expected)
    np.testing.assert_array_equal(again.friction, expected)


def test_what_is_not_said_anew_stays(arm, tmp_path):
    robot = vp.load_robot(arm)
    text = save_urdf(robot, tmp_path / "same.urdf").read_text()
    assert not unnamed(text, "<!-- weighed - - twice - -->", "a &lt; b&lt;raw&gt;", 'mass value="1.3"', 'damping="9"')
    assert text.count("<inertial>") == 4
    slide = robot.model.getJointId("slide")
    heavier = with_inertial_numbers(robot, {slide: [0.4, *[0.0] * 9]})
    text = save_urdf(heavier, tmp_path / "heavier.urdf").read_text()
    # The tool keeps what it has.
    assert text.count('<mass value="1.3"') == 3
    masses = {each.link: each.mass for each in vp.load_robot(tmp_path / "heavier.urdf").inertials}
    assert masses == pytest.approx({"a": 1.3, "b": 1.7, "tool": 1.3, "c": 1.3})
    lost = -0.7 * np.array(robot.model.inertias[slide].toDynamicParameters())
    light = with_inertial_numbers(robot, {slide: lost})
    again = vp.load_robot(save_urdf(light, tmp_path / "light.urdf"))
    # The body is lighter than the tool, which has nothing then.
    assert {each.link: each.mass for each in again.inertials} == pytest.approx({"a": 1.3, "b": 0.78, "c": 1.3})
    assert again.model.inertias[slide].isApprox(light.model.inertias[slide], 1e-12)


def test_meshes_are_found_from_another_folder(tmp_path):
    (tmp_path / "arm" / "meshes").mkdir(parents=True)
    (tmp_path / "made").mkdir()
    mesh = tmp_path / "arm" / "meshes" / "rod.obj"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    shape = '<visual><geometry><mesh filename="{}meshes/rod.obj"/></geometry></visual>'
    parts = (link("a", extra=shape.format("")), link("b", extra=shape.format("package://arm/")))
    robot = vp.load_robot(write_urdf(tmp_path / "arm", *parts, *PARTS[2:]))
    for folder, names in (("arm", {"meshes/rod.obj", "package://arm/meshes/rod.obj"}), ("made", {f"file://{mesh}"})):
        again = vp.load_robot(save_urdf(robot, tmp_path / folder / "now.urdf"))
        shapes, faults = readable_geometry(again)
        assert (len(shapes.geometryObjects), faults) == (2, {})
        assert {name for name in names if f'filename="{name}"' in again.urdf.read_text()} == names


def test_urdfs_that_would_be_wrong_are_refused(arm, tmp_path):
    robot, path = vp.load_robot(arm), tmp_path / "now.urdf"
    for other in (vp.planar_chain(2), vp.combine(robot, robot, prefixes=["l_", "r_"])):
        with refused(vp.InputError, repr(other.name), "URDF"):
            save_urdf(other, path)
    with refused(vp.InputError, ".urdf", "now.xml"):
        save_urdf(robot, tmp_path / "now.xml")
    with refused(vp.InputError, "friction", "'lift'", "-1", ">= 0"):
        save_urdf(robot, path, friction={"lift": -1.0})
    with refused(vp.InputError, "damping", "'base_x'", "no such joint"):
        save_urdf(vp.load_robot(arm, base="planar"), path, damping=1.0)
    for mass in (np.nan, -robot.model.inertias[1].mass):
        with refused(vp.InputError, "'lift'", "mass"):
            save_urdf(with_inertial_numbers(robot, {1: [mass, *[0.0] * 9]}), path)
    with refused(vp.UnknownJoint, "'neck'"):
        save_urdf(robot, path, damping={"neck": 1.0})
    assert not path.exists()


@pytest.fixture(scope="module")
def swings(tmp_path_factory):
    """An arm, and the paths of two logs of it with dampers and a payload that its file does not have."""
    folder = tmp_path_factory.mktemp("swings")
    path = write_urdf(folder, *PARTS, TOOL)
    robot, logs, rng = vp.load_robot(path, payload=vp.Payload("tool", 0.8)), [], np.random.default_rng(0)
    scene = vp.Scene(robot, damping=[1.5, 20.0])
    for name in ("one.csv", "two.csv"):
        u = np.sin(np.outer(np.arange(151), rng.uniform(0.05, 0.1, 2))) * [6.0, 10.0] + scene.holding_torque([0.2, 0.0])
        motion = vp.simulate(scene, [0.2, 0.0], np.zeros(2), dt=0.01, steps=150, controls=u[:-1])
        q = motion.q + 1e-4 * rng.normal(size=motion.q.shape)
        logs.append(vp.Log(motion.t, q, u, joints=robot.joint_names).save(folder / name))
    return path, logs


@pytest.fixture(scope="module")
def found(swings):
    path, (one, two) = swings
    logs = vp.Log.load(one), vp.Log.load(two)
    return vp.identify(vp.Scene(vp.load_robot(path)), logs, ["damping", "payload:tool"], q_noise=1e-4, delay=0.0)


def test_the_figure_has_samples_and_both_motions(found):
    _, panels = plot_identification(found, log=1)
    for c, panel in enumerate(panels[:-1]):
        lines = {line.get_label(): line.get_xydata() for line in panel.lines}
        rows = found.logs[1].q, found.predicted_before[1], found.predicted[1]
        for name, values in zip(("measured", "before", "after"), rows, strict=True):
            np.testing.assert_array_equal(lines[name], np.column_stack([found.logs[1].t, values[:, c]]))
        low, high = panel.get_ylim()
        assert high - low < 1.2 * np.ptp(found.logs[1].q[:, c])
    assert [panel.get_ylabel() for panel in panels] == ["q [rad]", "q [m]", "residual [rad or m]"]
    one = plot_identification(found, "slide")[1]
    np.testing.assert_array_equal(one[1].lines[0].get_ydata(), found.residuals[0][:, 1])
    assert (one[0].get_title("left"), one[1].get_ylabel()) == ("slide", "residual [m]")
    for mistake, facts in (({"log": 2}, "2 logs"), ({"joints": 3}, "joints")):
        with refused(vp.InputError, facts):
            plot_identification(found, **mistake)
    with refused(vp.InputError, "identify", "Scene"):
        plot_identification(found.scene)
    with refused(vp.UnknownJoint, "'neck'"):
        plot_identification(found, ["neck"])


def test_an_identification_writes_its_urdf(found, tmp_path, caplog):
    again = vp.load_robot(found.save_urdf(tmp_path / "found.urdf"))
    np.testing.assert_array_equal(again.damping, found.values[:2])
    assert again.model.inertias[2].mass == pytest.approx(2.6 + found.values[2], rel=1e-12)
    assert found.values[2] == pytest.approx(0.8, abs=4.0 * found.deviations[2])
    assert not caplog.messages
    assert not unnamed(repr(found.changed(warnings=("a",))), "3 parameters", "payload:tool", "2 logs", "1 warning")
    found.changed(names=("armature:lift", *found.names[1:])).save_urdf(tmp_path / "part.urdf")
    assert not unnamed(caplog.messages[0], "part.urdf", "armature:lift")


def test_the_command_prints_what_identify_finds(found, swings, tmp_path, capsys):
    path, (one, two) = swings
    urdf, png = tmp_path / "found.urdf", tmp_path / "found.png"
    words = ["identify", path, one, two, "--parameters", "damping", "payload:tool", "--q-noise", "1e-4", "--delay", "0"]
    assert main([*map(str, words), "--held-out", str(one), "--save", str(urdf), "--plot", str(png)]) == 0
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= 80 + len(str(tmp_path))
    numbers = [(f"{value:.5g}", f"{spread:.2g}") for value, spread in zip(found.values, found.deviations, strict=True)]
    assert not unnamed(out, *found.names, *numbers, *found.units, "held out", "status", "converged", "0, as given ms")
    before = np.concatenate([log.q - own for log, own in zip(found.logs, found.predicted_before, strict=True)])
    for rows in (before, np.concatenate(found.residuals)):
        assert not unnamed(out, *(f"{np.sqrt(np.square(column).mean()):.3g}" for column in rows.T))
    np.testing.assert_array_equal(vp.load_robot(urdf).damping, found.values[:2])
    assert png.read_bytes().startswith(b"\x89PNG")


def test_the_command_tells_what_it_could_not_find(swings, capsys):
    path, (one, _) = map(str, swings[:1]), swings[1]
    words = ["identify", *path, str(one), "--q-noise", "1e-4", "--delay", "0", "--parameters", "payload:tool"]
    # A mass at the origin of a joint's frame, at which it is as a payload.
    assert main([*words, "payload:b", "inertia:b:m"]) == 0
    assert not unnamed(" ".join(capsys.readouterr().out.split()), "not told", "payload:b", "inertia:b:m")
    assert main([*words, "--evaluations", "1"]) == 3
    shown = capsys.readouterr()
    assert not unnamed(shown.err, "not converged", "evaluations")
    # All warnings, also that which the log has.
    assert not unnamed(" ".join(shown.out.split()), "times q_noise", "the search ended at its most evaluations")
    for more, facts in (
        (["damper"], ("'damper'", "damping")),
        (["--save", "a.npz"], ("--save", ".urdf", "'a.npz'")),
        (["--held-out", "none.csv"], "none.csv"),
        (["--q-noise", "-1"], "q_noise"),
        (["--damping", "1", "2", "3"], "damping"),
    ):
        assert main([*words, *more]) == 2
        assert not unnamed(capsys.readouterr().err, facts)


def test_ctrl_c_keeps_the_best_values(swings, tmp_path, capsys, monkeypatch):
    path, (one, _) = swings

    @contextlib.contextmanager
    def pressed(*_, **__):
        def tell(done, _):
            if done == 4:
                raise KeyboardInterrupt

        yield tell

    monkeypatch.setattr("varpin.cli.fits.progress_bar", pressed)
    words = ["identify", path, one, "--q-noise", "1e-4", "--parameters", "damping", "--save", tmp_path / "a.urdf"]
    assert main([*map(str, words)]) == 130
    assert not unnamed(capsys.readouterr().err, "interrupted")
    assert vp.load_robot(tmp_path / "a.urdf").damping.any()


def test_the_command_takes_a_scene_file(tmp_path, capsys):
    """Its damping is what the search begins with, its step that of the motions."""
    path, head = tmp_path / "scene.toml", '[robot]\nsource = "finger"\n[initial]\nv = 5.0\n'
    for damping in (2e-4, 1e-4):
        path.write_text(f"damping = {damping}\n{head}[horizon]\ndt = 2e-3\nsteps = 100\n")
        if damping == 2e-4:
            motion = vp.load_scene(path).simulate()
    log = vp.Log(motion.t, motion.q, np.vstack([motion.u, motion.u[-1:]]), joints=motion.joint_names)
    saved = str(log.save(tmp_path / "log.npz"))
    words = ["identify", str(path), saved, "--parameters", "damping", "--q-noise", "1e-4", "--delay", "0"]
    assert main(words) == 0
    assert re.search(r"damping:mcp +0.0001 +0.0002 ", capsys.readouterr().out)
    assert main([*words, "--friction", "robot"]) == 2
    assert not unnamed(capsys.readouterr().err, "--friction", "scene file")
