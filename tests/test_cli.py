"""The ``varpin`` command: what it prints, writes and returns."""

import io
import logging
import re
import shlex
import signal
import subprocess
import sys

import numpy as np
import pytest
from chromium import commands
from findings import about
from mechanisms import joint, link, write_urdf
from refusals import naming, unnamed
from rich.console import Console

import varpin as vp
import varpin_command
from varpin.cli import console, main
from varpin.model import load_robot


@pytest.fixture
def arm(tmp_path):
    joints = joint("shoulder", "base", "upper", "continuous") + joint("elbow", "upper", "lower", "continuous")
    return str(write_urdf(tmp_path, link("upper"), link("lower"), re.sub("<limit.*?/>", "", joints), name="arm"))


@pytest.fixture
def run(capsys):
    """A function that runs a command and returns what it prints on stdout and stderr; its status is as expected."""

    def command(*words, status=0):
        capsys.readouterr()
        try:
            found = main([*map(str, words)])
        except SystemExit as stop:
            found = stop.code
        assert found == status
        return capsys.readouterr()

    return command


def full(self, path):
    raise OSError(28, "No space left on device")


def interrupt(*_):
    raise KeyboardInterrupt


def test_trajectory_is_what_the_options_say(arm, tmp_path, run):
    path = tmp_path / "motion.npz"
    options = "--q0 -0.5 2e-1 --v0 1 --gravity 0 -1e-1 -5 --damping elbow=0.2 --stiffness 3 --torque -1e-2 0.5"
    options += " --friction 0.1"
    options += f" --integrator Midpoint(0.25) --dt 5e-3 --duration 0.5 --quiet --save {path}"
    run("simulate", arm, *options.split())
    saved = vp.Trajectory.load(path)
    scene = vp.Scene(load_robot(arm), gravity=[0.0, -0.1, -5.0], damping=[0.0, 0.2], friction=0.1, stiffness=3.0)
    again = vp.simulate(
        scene, [-0.5, 0.2], [1.0, 1.0], dt=5e-3, steps=100, controls=[-0.01, 0.5], integrator=vp.Midpoint(alpha=0.25)
    )
    for name in ("t", "q", "v", "p", "u", "energy"):
        np.testing.assert_array_equal(getattr(saved, name), getattr(again, name))


def test_start_is_at_rest_at_zero_under_earths_gravity_for_two_seconds(arm, tmp_path, run):
    path = tmp_path / "motion.npz"
    run("simulate", arm, "--quiet", "--save", path)
    saved = vp.Trajectory.load(path)
    assert (saved.steps, saved.dt) == (2000, 1e-3)
    assert not saved.q[0].any()
    assert not saved.v[0].any()
    again = vp.simulate(vp.Scene(load_robot(arm)), [0, 0], [0, 0], dt=1e-3, steps=2000)
    np.testing.assert_array_equal(saved.q, again.q)
    # Or near it, where the step does not divide it.
    run("simulate", arm, "--quiet", "--dt", "0.3", "--save", path)
    assert vp.Trajectory.load(path).steps == 7


def test_outputs_are_written_and_listed(arm, tmp_path, run):
    npz, png, html = (tmp_path / name for name in ("a.npz", "a.png", "a.html"))
    out, _ = run("simulate", arm, "--steps", 30, "--dt", 0.01, "--save", npz, "--plot", png, "--html", html)
    assert vp.Trajectory.load(npz).steps == 30
    assert png.read_bytes().startswith(b"\x89PNG")
    assert b"<html" in html.read_bytes()[:500].lower()
    assert len(re.findall(r"^  written\b", out, re.M)) == 3
    assert not unnamed(out, "arm: Gauss(stages=2)", "30 of 0.01 s, 0.3 s in all", "energy change")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.html", "a.npz", "a.png", "arm.urdf"]


def test_all_warnings_are_printed(tmp_path, run):
    path = tmp_path / "a.npz"
    start = ["--dt", 0.05, "--steps", 20, "--v0", 8, *[0] * 5, "--save", path, "--integrator", "midpoint"]
    said = " ".join("".join(run("simulate", "ur5", *start)).replace("warning ", "").split())
    told = vp.Trajectory.load(path).warnings
    assert len(told) > 1
    assert not unnamed(said, *(str(finding.joint) for finding in told), *(finding.kind[:-1] for finding in told[1:]))


MISTAKES = [
    ("simulate ARM --damping 1 2 3", ("--damping", "2", "3")),
    # What simulate refuses is refused in its words.
    ("simulate ARM --damping -1", ("damping[0]", "-1.0")),
    ("simulate ARM --duration 1 --dt 0.003", ("duration = 1 s", "dt = 0.003 s", f"dt = {1 / 333!r} s")),
    ("simulate ARM --tolerance 1e-6 --dt 0.1", ("dt", "tolerance")),
    ("simulate ARM --tolerance 1e-6 --steps 1", ("steps", "tolerance")),
    ("simulate ARM --integrator gaus", ("'gaus'", "Gauss", "Midpoint")),
    ("simulate ARM --integrator RungeKutta4(stages=2)", ("'stages'", "RungeKutta4")),
    ("simulate ARM --q0 elbow=1 2", ("--q0", "JOINT=VALUE")),
    ("simulate ARM --v0 elbow=1 elbow=2", ("--v0", "once", "elbow=2")),
    ("simulate ARM --lock elbow", ("--lock", "elbow", "JOINT=VALUE")),
    ("simulate ARM --xacro-args dof", ("--xacro-args", "NAME=VALUE", "dof")),
    ("simulate ARM --xacro-args dof=7", "xacro_args need a xacro file"),
    ("simulate ARM --save a.txt", ("--save", ".npz", "'a.txt'")),
    ("simulate nobody.urdf", "'nobody.urdf'"),
    ("advise ARM --tolerance 0", "tolerance"),
    ("replay SAVED", ("'arm'", "URDF")),
    ("replay SAVED --robot ur5", ("shoulder, elbow", "'ur5'", "shoulder_pan_joint")),
    ("replay SAVED --robot ARM --trace nose", ("--trace", "'arm'", "'nose'")),
    ("replay SAVED --robot ARM --html a.html --ghost no.npz", "no.npz"),
    ("replay SAVED --robot ARM --speed 0", "--speed"),
    ("simulate scene.toml --dt 0.1", ("--dt", "scene file")),
    ("simulate scene.toml --no-gravity", ("--no-gravity", "scene file")),
    *(
        (f"simulate scene.toml --{option} 1", (f"--{option}", "scene file"))
        for option in ("q0", "v0", "damping", "friction", "stiffness", "rest", "torque", "steps", "tolerance")
    ),
    ("inspect scene.toml --lock dip=0", ("--lock", "scene file")),
    ("inspect scene.toml --xacro-args a=1", ("--xacro-args", "scene file")),
    ("solve finger", "finger_tracking"),
    ("simulate scen.toml", "'scen.toml'"),
    ("solve scene.toml --resume none.npz", "none.npz"),
    ("solve scene.toml --save no/plan.npz", "folder"),
    ("solve broken.toml", "broken.toml: robot.source"),
]
USAGE = [
    ("", ("varpin: error", "COMMAND")),
    ("simulat finger", ("varpin: error", "'simulat'", "'simulate'")),
    ("simulate", ("varpin simulate: error", "ROBOT")),
    ("simulate finger --steps 1.5", ("--steps", "'1.5'")),
    ("simulate finger --steps 1 --duration 1", ("--steps", "--duration")),
    ("simulate finger --no-gravity --gravity 0 0 -1", ("--gravity", "--no-gravity")),
    ("simulate finger --dur 1", "--dur"),
]


@pytest.mark.parametrize(("words", "facts"), [*MISTAKES, *USAGE])
def test_mistakes_are_one_line_and_status_2(words, facts, arm, saved, scene, tmp_path, run):
    (tmp_path / "broken.toml").write_text("[robot]\n[horizon]\ndt = 1\nsteps = 1\n")
    names = {"ARM": arm, "SAVED": saved}
    out, err = run(*(names.get(word, word) for word in words.split()), status=2)
    *warnings, line = err.splitlines()
    assert out == ""
    assert re.match(r"varpin( \w+)?: error: ", line)
    assert not unnamed(line, facts)
    if (words, facts) in USAGE:
        assert not warnings
        assert re.search(r" \(see varpin( \w+)? --help\)$", line)


def test_what_advise_answers_is_a_motion_within_the_tolerance(arm, tmp_path, run):
    options = ["--duration", 0.3, "--q0", "shoulder=0.3", "--v0", "-1e-1", 0, "--damping", 0.1]
    options += ["--torque", "elbow=-2.5", "--gravity", 1, 0, -9, "--package-dir", tmp_path]
    out = run("advise", arm, "--tolerance", 1e-6, *options).out
    (line,) = [line for line in out.splitlines() if line.startswith("run it: varpin ")]
    words = shlex.split(line.removeprefix("run it: varpin ").partition(", and")[0])
    path = tmp_path / "a.npz"
    run(*words, *options[2:], "--save", path, "--quiet")
    motion = vp.Trajectory.load(path)
    assert motion.duration == pytest.approx(0.3, rel=1e-12)
    scene = vp.Scene(load_robot(arm), gravity=[1, 0, -9], damping=0.1)
    start = [0.3, 0.0], [-0.1, 0.0]
    true = vp.simulate(scene, *start, dt=0.3, steps=1, controls=[0.0, -2.5], integrator=vp.Reference(rtol=1e-12))
    assert np.abs(motion.q[-1] - true.q[-1]).max() < 1e-6


@pytest.fixture
def saved(arm, tmp_path):
    motion = vp.simulate(vp.Scene(load_robot(arm)), [0.3, 0.1], [0.0, 0.0], dt=0.01, steps=20)
    return str(motion.save(tmp_path / "motion.npz"))


def drawn(page):
    return [command["path"] for command in commands(page) if command["type"] == "set_object"]


def test_a_saved_motion_is_replayed(arm, saved, tmp_path, run):
    page = tmp_path / "page.html"
    words = ["--trace", "lower", "--ghost", saved, "--speed", 0.5, "--frames", "upper"]
    assert run("replay", saved, "--robot", arm, "--html", page, *words).out == f"written: {page}\n"
    assert any(path.endswith("motion lower") for path in drawn(page))
    assert any(path.endswith("frame upper") for path in drawn(page))


def test_plans_are_replayed_with_their_task(scene, tmp_path, run):
    run("solve", scene, "--max-iterations", 1, "--save", "plan.npz", "--quiet", status=console.STEP_FAILED)
    run("replay", "plan.npz", "--robot", scene, "--html", "plan.html")
    run("replay", "plan.npz", "--html", "bare.html")
    run("solve", scene, "--html", "motion.html", "--trace", "pip", "--quiet")
    for page in ("plan.html", "motion.html"):
        assert any(path.startswith("/meshcat/ghost/") for path in drawn(tmp_path / page))
    traces = {path.split("/")[3] for path in drawn(tmp_path / page) if " motion " in path or " ghost " in path}
    assert traces == {"0 motion pip"}  # and the ghost's joints stay


def test_replay_opens_a_window_until_ctrl_c(saved, arm, monkeypatch, run):
    shown, viewer = [], type("Viewer", (), {"url": lambda self: "http://here"})
    monkeypatch.setattr("varpin.show.replay.motion.replay", lambda *words, **options: shown.append(options) or viewer())
    monkeypatch.setattr("varpin.cli.views.time.sleep", interrupt)
    assert not unnamed(run("replay", saved, "--robot", arm).err, "http://here", "Ctrl-C")
    assert shown[0]["open"]


def test_outputs_are_checked_before_the_run(arm, tmp_path, run, monkeypatch):
    monkeypatch.setattr("varpin.cli.runs.simulate", lambda *_, **__: pytest.fail("the run must not start"))
    kept, film, png, html = (tmp_path / name for name in ("kept.npz", "kept.gif", "same.png", "same.html"))
    html.symlink_to(png)
    for words, facts in (
        (["--save", kept, "--html", "/nowhere/a.html"], "/nowhere/a.html"),
        (["--save", kept, "--plot", "/nowhere/a.png"], "/nowhere/a.png"),
        (["--save", tmp_path], str(tmp_path)),
        (["--video", film, "--save", film], ("--save", ".npz")),
        (["--plot", png, "--html", html], "one file"),
    ):
        out, err = run("simulate", arm, *words, status=2)
        assert (out, len(err.splitlines())) == ("", 1)
        assert not unnamed(err, facts)


def test_output_that_fails_after_the_run_leaves_the_others(arm, tmp_path, run, monkeypatch):
    monkeypatch.setattr(vp.Trajectory, "save", full)
    npz, png = tmp_path / "a.npz", tmp_path / "a.png"
    out, err = run("simulate", arm, "--steps", 5, "--save", npz, "--plot", png, status=2)
    assert err.startswith(f"varpin: error: {npz} was not written: ")
    assert "No space left on device" in err
    assert png.exists()
    assert "a.png" in out
    assert "a.npz" not in out


def test_a_solution_that_was_not_saved_is_not_continued_from(scene, run, monkeypatch):
    monkeypatch.setattr(vp.Solution, "save", full)
    words = "solve", scene, "--max-iterations", 1, "--save", "part.npz"
    err = run(*words, status=console.STEP_FAILED).err
    assert not unnamed(err, "No space left on device", "not converged", "--save NPZ")
    assert "--resume" not in err


def test_failed_step_keeps_what_was_before_it(arm, tmp_path, run, monkeypatch):
    def failing(*arguments, **options):
        part = vp.simulate(*arguments, **{**options, "steps": 7})
        failure = type("Failure", (), {"reason": "the step is at a fold", "residual": 3.5})
        raise vp.StepFailure(part.steps, part.t[-1], failure, part)

    monkeypatch.setattr("varpin.cli.runs.simulate", failing)
    path = tmp_path / "a.npz"
    out, err = run("simulate", arm, "--steps", 20, "--save", path, status=3)
    (line,) = err.splitlines()
    assert not unnamed(line, "varpin: error", "step 7", "t = 0.007 s", "the step is at a fold")
    assert not unnamed(out, "7", "0.001 s")
    assert vp.Trajectory.load(path).steps == 7


def test_long_run_without_a_terminal_says_how_far_it_is(arm, run, monkeypatch):
    monkeypatch.setattr(console, "INTERVAL", 0.0)
    err = run("simulate", arm, "--dt", 1e-4, "--steps", 40000).err
    assert "varpin: 15000 of 40000 steps" in err.splitlines()


def test_progress_bar_on_a_terminal_vanishes_without_hiding_warnings():
    stream = io.StringIO()
    terminal = Console(file=stream, force_terminal=True, width=80)
    with console.progress_bar(terminal, 10, quiet=False) as progress, console.logged(terminal, logging.WARNING):
        progress(5, 10)
        logging.getLogger("varpin.simulation.simulate").warning("something [bold] happened")
    assert "varpin: warning: something [bold] happened" in stream.getvalue()
    assert "varpin" in stream.getvalue()


def test_inspect_prints_tables_and_then_warnings(run):
    out, err = run("inspect", "panda", "--lock", "panda_joint7=0.5", "panda_joint6=-1", "--q", "-0.1")
    assert err == ""
    for words in ("panda: joints", "locked at -1.0", "panda: links", "degrees of freedom", "at q"):
        assert words in out
    lines = out.splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith("warning: "))
    assert all(line.startswith("warning: ") for line in lines[first:])
    assert max(map(len, lines[:first])) <= 80
    assert naming(lines[:first], "panda_finger_joint2", "mimic", "1 * panda_finger_joint1")


def test_robots_are_listed_with_their_joints(run):
    out, err = run("robots")
    assert err == ""
    rows = dict(re.findall(r"^  (\S+) +(\d+)$", out, flags=re.MULTILINE))
    assert tuple(rows) == vp.robot_names()
    assert (rows["finger"], rows["ur5"], rows["panda"]) == ("3", "6", "8")


def test_version_and_help(run):
    assert run("--version").out == f"varpin {vp.__version__}\n"
    for words in ([], ["simulate"], ["inspect"], ["tradeoff"], ["advise"]):
        assert "usage: varpin" in run(*words, "--help").out


def test_interruption_while_python_imports_is_no_traceback():
    code = """
import importlib.abc, os, signal, sys, varpin_command

# Whoever runs the tests may ignore it, and children inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

class Interrupt(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == "pinocchio":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupt())
varpin_command.main()
"""
    done = subprocess.run([sys.executable, "-c", code], check=False, timeout=300, capture_output=True, text=True)
    assert done.returncode == -signal.SIGINT
    assert done.stderr == ""


def test_plain_run_imports_neither_matplotlib_nor_meshcat(arm):
    code = (
        "import sys; from varpin.cli import main; "
        f"status = main(['simulate', {arm!r}, '--steps', '2', '--quiet']); "
        "sys.exit(status or 'matplotlib' in sys.modules or 'meshcat' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=300).returncode == 0


def test_tradeoff_prints_a_table_and_writes_files(arm, tmp_path, run):
    files = ["--save", tmp_path / "trade.csv", "--plot", tmp_path / "trade.png"]
    options = ["--duration", 0.5, "--dt", 0.05, 0.01, "--q0", 0.3, "--repeats", 1, *files]
    printed, err = run("tradeoff", arm, *options)
    # On a slow machine it says how far it is.
    assert all(re.fullmatch(r"varpin: \d+ of \d+ runs", line) for line in err.splitlines())
    for words in ("arm", "0.5 s", "RungeKutta4", "Midpoint", "Pareto"):
        assert words in printed
    assert printed.splitlines()[-2:] == [f"written: {path}" for path in files[1::2]]
    assert files[3].read_bytes().startswith(b"\x89PNG")
    assert run("tradeoff", arm, *options, "--quiet").out == ""


def test_tradeoff_interrupted_is_status_130(arm, run, monkeypatch):
    monkeypatch.setattr("varpin.study.precision._measure", interrupt)
    err = run("tradeoff", arm, "--duration", 0.5, "--dt", 0.05, "--quiet", status=130).err
    assert not unnamed(err, "interrupted", "0")


def test_advise_says_what_to_take(arm, tmp_path, run):
    options = ["--duration", 0.5, "--q0", 0.3, "--damping", 0.1]
    out, err = run("advise", arm, "--tolerance", 1e-6, *options)
    assert "a minute at most" in err
    assert not unnamed(out.splitlines()[0], "dt", "1e-06", "0.5 s")
    assert out.count("  Gauss") >= 2
    out, _ = run("advise", arm, "--budget", 2e-3, "--save", tmp_path / "advice.csv", *options)
    assert (tmp_path / "advice.csv").read_text().startswith("integrator,dt [s],")
    assert not unnamed(out.splitlines()[0], "0.5 s", "0.002 s")
    assert about(run("advise", arm, "--tolerance", 1e-20, *options, status=3).out, "out of reach")


SCENE = """
title = "A finger straightens"
gravity = false
[robot]
source = "finger"
[initial]
q = [0.5, 0.3, 0.2]
[horizon]
dt = 5e-3
steps = 20
[[cost]]
type = "tracking"
reference = 0.0
weight = 10.0
[[cost]]
type = "control"
weight = 1e3
[outputs]
save = "kept.npz"
"""


@pytest.fixture
def scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(SCENE)
    return "scene.toml"


def test_scene_is_simulated(scene, tmp_path, run):
    assert not unnamed(run("simulate", scene, "--plot", "motion.png").out, "20", "0.005 s")
    assert {path.name for path in tmp_path.iterdir()} == {"scene.toml", "kept.npz", "motion.png"}
    assert vp.Trajectory.load("kept.npz").steps == 20


def test_scene_is_solved_saved_and_resumed(scene, tmp_path, run):
    out, err = run("solve", scene, "--max-iterations", 1, "--save", "part.npz", status=console.STEP_FAILED)
    assert "3 of 3 computed" in out
    assert "not converged" in err
    assert "varpin solve scene.toml --resume part.npz" in err
    assert "solve(problem" not in out + err
    assert "converged" in run("solve", scene, "--resume", "part.npz", "--html", "plan.html").out
    file = vp.load_scene(scene)
    np.testing.assert_array_equal(file.solve().controls, file.load_solution("kept.npz").controls)
    assert (tmp_path / "plan.html").is_file()


def test_scene_is_inspected(scene, run):
    out = run("inspect", "allegro_finger").out
    for words in ("4 of 16", "nothing touches", "joint_12.0 at 0.0"):
        assert words in out
    assert re.search(r"gravity +none", run("inspect", scene).out)


def test_a_plan_that_cannot_be_is_told_with_its_constraint(scene, tmp_path, run):
    rule = '[[plan_constraint]]\ntype = "reach_frame"\nframe = "pip"\nposition = [9.0, 0.0, 0.0]\n[outputs]'
    (tmp_path / "scene.toml").write_text(SCENE.replace("[outputs]", rule).replace("steps = 20", "steps = 4"))
    err = run("solve", scene, "--quiet", status=console.STEP_FAILED).err
    assert "infeasible: ReachFrame" in err
    assert "plan.reason" not in err


def test_split_steps_are_flagged_in_the_table(arm, run):
    out, err = run("simulate", arm, "--integrator", "midpoint", "--dt", 0.3, "--steps", 20, "--v0", 5, 0)
    flag = r"split steps \d+ of 20, into up to \d+ parts: a smaller dt keeps the structure"
    assert re.search(flag, " ".join(out.split()))
    assert re.search(r"^varpin: warning: q is off by up to \S+ rad, .* Use integrator=", err, re.MULTILINE)


def test_lack_of_memory_is_no_traceback(arm, run, monkeypatch):
    def exhausted(*_, **__):
        raise MemoryError("Unable to allocate 7 TiB")

    monkeypatch.setattr("varpin.cli.runs.simulate", exhausted)
    out, err = run("simulate", arm, status=2)
    assert (out, len(err.splitlines())) == ("", 1)
    assert not unnamed(err, "varpin: error", "Unable to allocate 7 TiB")


def test_inspect_takes_what_simulate_refuses(tmp_path, run):
    path = write_urdf(tmp_path, '<link name="ghost"/>', joint("hinge", "base", "ghost", kind="continuous"))
    assert not unnamed(run("simulate", path, status=2).err, "'hinge'")
    out = run("inspect", path).out
    assert not unnamed(out, "singular")
    assert naming(out.splitlines(), "warning", "'ghost'", "'hinge'")


def test_installed_command_leaves_ctrl_c_to_the_command_line(monkeypatch):
    """What a run does at Ctrl-C is its own matter again once everything is imported."""
    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr("varpin.cli.main", lambda: int(signal.getsignal(signal.SIGINT) is before))
    assert varpin_command.main() == 1


@pytest.mark.parametrize(("words", "speed"), [([], 0.5), (["--speed", "1"], 1.0), (["--speed", "0.25"], 0.25)])
def test_speed_of_a_scene_s_replay(tmp_path, monkeypatch, run, words, speed):
    """The file's own, 0.5, unless one is asked for."""
    asked = []
    monkeypatch.setattr(
        "varpin.show.replay.motion.replay", lambda *_, speed, html, **__: asked.append(speed) or html.touch()
    )
    run("simulate", "ur5_reach", "--html", tmp_path / "a.html", "--quiet", *words)
    assert asked == [speed]
