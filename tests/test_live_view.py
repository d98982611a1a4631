"""Motions and plans in a real browser while they are computed."""

import contextlib
import itertools
import logging
import time

import numpy as np
import pytest
from chromium import connect, names, severe, shapes_stand, wait_until
from refusals import refused

import varpin as vp
from varpin.show.replay import live, page


@pytest.fixture(scope="module")
def scene():
    return vp.Scene(vp.planar_chain(2))


@pytest.fixture
def opened():
    with contextlib.ExitStack() as stack:
        yield lambda *given, **options: stack.enter_context(vp.LiveView(*given, open=False, **options))


@pytest.fixture
def seen(opened, browser):
    def make(*given, **options):
        view = opened(*given, **options)
        connect(browser, online=True)
        browser.get(view.url)
        assert view.wait(60.0)
        return view

    return make


def test_the_robot_is_where_the_motion_is_while_it_is_computed(seen, browser):
    finger = vp.load_robot("finger")
    scene = vp.Scene(finger, gravity=False, damping=1e-3)
    view = seen(scene, marks=vp.Marks(trace=True), speed=None, fps=1e6)
    looks = []

    def progress(done, steps, nodes):
        view.progress(done, steps, nodes)
        if len(looks) < 4 or done == steps:
            wait_until(lambda: shapes_stand(browser, finger, nodes.q[-1]))
            looks.append(done)

    vp.simulate(scene, [0.1, 0.2, 0.3], [2.0, 1.0, 1.0], dt=1e-5, steps=60_000, progress=progress)
    assert looks[0] == 0
    assert looks[-1] == 60_000
    assert 0 < looks[1] < looks[2] < looks[3] < 60_000
    assert any("tip" in name or finger.end_effector in name for name in names(browser, ["notes", "live"]))
    assert "words" in names(browser, ["notes"])
    assert severe(browser) == []


def test_a_motion_takes_the_time_that_it_would_take(opened, scene, monkeypatch):
    view = opened(scene, speed=2.0, fps=20.0)
    motion = {"dt": 1e-3, "steps": 1000, "progress": view.progress, "check": False}
    begin = time.monotonic()
    vp.simulate(scene, [0.3, 0.0], [0.0, 0.0], **motion)
    # Nobody looks, so nobody waits.
    assert time.monotonic() - begin < 0.45
    monkeypatch.setattr(live._Window, "watched", property(lambda window: True))
    shown, move = [], view._move
    monkeypatch.setattr(view, "_move", lambda t, q, now, *rest, **last: shown.append(now) or move(t, q, now, *rest))
    begin = time.monotonic()
    end = vp.simulate(scene, [0.3, 0.0], [0.0, 0.0], **motion).t[-1]
    assert time.monotonic() - begin > 0.45
    assert shown == sorted(shown)
    assert len(shown) <= 13
    assert shown[-1] == end


def test_a_controllers_run_is_shown(opened, scene):
    cost = vp.TrackingCost([0.5, -1.0], 10.0) + vp.VelocityCost(0.1) + vp.ControlCost(1e-4)
    problem = vp.OptimalControlProblem(scene, cost, [0.0, 0.0], [0.0, 0.0], dt=2e-2, steps=20)
    view = opened(problem, speed=None)
    parts = []

    def progress(done, ticks, nodes):
        view.progress(done, ticks, nodes)
        parts.append(nodes)

    run = vp.Mpc(problem).run(duration=0.2, progress=progress)
    np.testing.assert_array_equal(np.concatenate([part.q[1:] for part in parts]), run.motion.q[1:])
    np.testing.assert_allclose(np.concatenate([part.t[1:] for part in parts]), run.motion.t[1:], rtol=1e-12)
    np.testing.assert_array_equal(view._q, run.motion.q[-1])


def test_the_camera_moves_back_from_what_leaves_the_view(opened, scene):
    view = opened(scene.robot)
    before = view._in_view
    view._keep_in_view(np.array([[9.0, 0.0, 0.0]]))
    assert view._in_view.max() > 10.0
    after = view._in_view
    view._keep_in_view(np.array([[9.5, 0.0, 0.0]]))
    assert view._in_view is after is not before


def test_ctrl_c_ends_the_motion_and_not_the_view(opened, scene):
    view = opened(scene, speed=None)

    def progress(done, steps, nodes):
        view.progress(done, steps, nodes)
        if done:
            # As if it came between a command and its answer.
            view._window.zmq_socket.send_multipart([b"url"])
            raise KeyboardInterrupt

    with pytest.raises(vp.Interrupted) as caught:
        vp.simulate(scene, [0.3, 0.0], [0.0, 0.0], dt=1e-4, steps=100_000, progress=progress)
    assert 0 < caught.value.trajectory.steps < 100_000
    motion = vp.simulate(scene, [0.3, 0.0], [0.0, 0.0], dt=1e-3, steps=10, progress=view.progress)
    np.testing.assert_array_equal(view._q, motion.q[-1])


def test_a_server_that_dies_costs_the_picture_alone(opened, scene, caplog, monkeypatch):
    monkeypatch.setattr(live, "_ANSWER_LIMIT", 0.2)
    view = opened(scene, speed=None)
    view._window.server_proc.kill()
    with caplog.at_level(logging.WARNING, logger="varpin.show.replay"):
        motion = vp.simulate(scene, [0.3, 0.0], [0.0, 0.0], dt=1e-3, steps=10, progress=view.progress)
    assert motion.steps == 10
    assert caplog.text.count("the computation continues without it") == 1


def test_a_browser_is_started_and_waited_for(scene, monkeypatch, caplog, capfd):
    asked = []
    monkeypatch.setattr(page.webbrowser, "open", lambda url, new=0: asked.append(url) or True)
    monkeypatch.setattr(live.LiveView.wait, "__defaults__", (0.1,))
    with vp.LiveView(scene) as view:
        assert asked == [view.url]
        assert f'<iframe src="{view.url}"' in view._repr_html_()
    assert "no browser shows" in caplog.text
    assert capfd.readouterr().out == ""
    assert "closed" in repr(view)
    # What is told a closed view is lost, and nothing else.
    vp.simulate(scene, [0.3, 0.0], [0.0, 0.0], dt=1e-3, steps=10, progress=view.progress)


def test_says_what_does_not_fit(opened, scene):
    problem = vp.OptimalControlProblem(scene, vp.ControlCost(1.0), [0.0, 0.0], [0.0, 0.0], dt=1e-2, steps=5)
    other, tell = vp.Scene(vp.planar_chain(3)), opened(scene).progress
    with refused(vp.InputError, "progress"):
        vp.solve(problem, progress=tell)
    with refused(vp.InputError, "'chain2'", "2", "3"):
        vp.simulate(other, np.zeros(3), np.zeros(3), dt=1e-3, steps=10, progress=tell)
    for given, options, kind, facts in (
        (scene, {"marks": vp.Marks(ghost=[[0.0, 0.0]])}, vp.InputError, "ghost"),
        (scene, {"marks": vp.Marks(trace="hand")}, vp.UnknownFrame, ("trace", "'chain2'", "'hand'")),
        (scene, {"speed": 0.0}, vp.InputError, ("speed", "0.0")),
        (scene.robot.model, {}, vp.InputError, ("LiveView", "Robot", "Scene", "OptimalControlProblem")),
    ):
        with refused(kind, facts):
            vp.LiveView(given, **options)


def law(t, q, v):
    return np.array([np.sin(t), -q[0]])


CONTROLS = [
    None,
    law,
    vp.OpenLoop(lambda t: [np.sin(t), 0.0]),
    vp.FirstOrderHold(np.linspace(0, 1, 802).reshape(401, 2)),
]


@pytest.mark.parametrize("controls", CONTROLS)
def test_who_asks_for_nodes_gets_all_of_them_once(scene, controls, monkeypatch):
    monkeypatch.setattr("varpin.simulation.simulate._CHUNK", 50)
    parts = []

    def progress(done, steps, nodes):
        assert steps == 400
        assert nodes.t[-1] == pytest.approx(done * 1e-3)
        parts.append(nodes)

    given = {"q0": [0.3, 0.0], "v0": [0.0, 0.0], "dt": 1e-3, "steps": 400, "controls": controls}
    given |= {"period": 3} if controls is law else {}
    told, plain = vp.simulate(scene, **given, progress=progress), vp.simulate(scene, **given)
    assert len(parts) > 10
    for name in ("t", "q", "v"):
        rows = np.concatenate([getattr(parts[0], name)[:1], *(getattr(part, name)[1:] for part in parts)])
        np.testing.assert_array_equal(rows, getattr(told, name))
        np.testing.assert_array_equal(rows, getattr(plain, name))
    for before, after in itertools.pairwise(parts):
        assert before.t[-1] == after.t[0]
        np.testing.assert_array_equal(before.q[-1], after.q[0])


def test_functions_of_two_arguments_are_told_as_before(scene, capsys):
    start = {"q0": [0.3, 0.0], "v0": [0.0, 0.0], "dt": 1e-3, "steps": 10}
    told = []
    vp.simulate(scene, **start, progress=lambda done, steps: told.append((done, steps)))
    vp.simulate(scene, **start, progress=lambda *given: told.append(given))
    assert told == [(10, 10), (10, 10)]
    vp.simulate(scene, **start, progress=print)
    assert capsys.readouterr().out == "10 10\n"
    for wrong in (lambda done: None, 3):
        with refused(vp.InputError, "progress"):
            vp.simulate(scene, **start, progress=wrong)
    vp.simulate(scene, **(start | {"steps": 0}), progress=lambda done, steps, nodes: told.append(nodes.q))
    np.testing.assert_array_equal(told[-1], [[0.3, 0.0]])
