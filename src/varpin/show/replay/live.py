"""Live view of motions and plans in meshcat while they are computed."""

from __future__ import annotations

import contextlib
import html as markup
import io
import logging
import math
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import meshcat
import numpy as np
import umsgpack
import zmq
from meshcat.animation import Animation, AnimationClip, AnimationTrack
from meshcat.visualizer import ViewerWindow
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.mechanics.scene import Scene
from varpin.model import Robot
from varpin.model.tree import z_to
from varpin.show.replay import marks
from varpin.show.replay.annotations import frame_names, references, rows_at, target, target_tracks
from varpin.show.replay.drawing import draw, joint_motion, joint_track
from varpin.show.replay.legend import TRACE_COLORS
from varpin.show.replay.page import lowered
from varpin.show.replay.script import Actor, Script
from varpin.show.replay.surroundings import goals, parts_of, regions, ties
from varpin.show.replay.view import set_view
from varpin.show.replay.viewer import open_browser
from varpin.support.checks import flag, positive
from varpin.trajectory import Nodes, Trajectory

if TYPE_CHECKING:
    from varpin.control import Iteration, OptimalControlProblem, Solution
    from varpin.control.mpc import MpcRun


logger = logging.getLogger(__name__)

# Time limits for an answer of the server, and for a browser to connect [s].
_ANSWER_LIMIT, _BROWSER_LIMIT = 20.0, 20.0
# Largest delay that is caught up by faster playback [s].
_SLACK = 0.1
# Shortest time between two changes of the text beside the robot [s].
_TEXT_INTERVAL = 0.1
# Height of the text, relative to the size of the robot.
_LABEL = 0.045
# A path is sent in pieces, as meshcat sends a changed object whole: points of a piece, largest number of pieces, and
# largest number of points between two pictures.
_PIECE, _PIECES, _BETWEEN = 60, 100, 50
# Shortest distance of points of a path, and its thickness, relative to the size of the robot.
_APART, _TUBE = 0.004, 0.003
# Number of iterates of a plan whose paths stay in view, points of such a path, and keyframes of all joints together.
_ITERATES, _PATH, _KEYS = 8, 200, 3000
# Random postures that give the reach of a robot for the view, and their largest angle from the start [rad].
_POSTURES, _TURN = 40, np.pi
# Opacity of the paths of earlier iterates.
_PALE = 0.25


class LiveView:
    """A window that shows motions and plans while they are computed.

        with vp.LiveView(scene, trace=True) as view:
            motion = vp.simulate(scene, q0, v0, dt=1e-3, steps=5000, progress=view.progress)
            plan = vp.solve(problem, callback=view.callback)

    ``progress`` shows the motion of :func:`varpin.simulate` or :meth:`varpin.Mpc.run` up to the present, at most at
    true speed: where computing is faster, it waits. ``callback`` plays the motion of each iterate of
    :func:`varpin.solve` in a loop, with the paths of earlier iterates in a pale colour. Nothing waits while no browser
    is connected. At first the robot is in its initial configuration and the camera shows all that it can reach; the
    camera moves back if that is not enough.

    The server belongs to this process. It ends with :meth:`close`, with the ``with`` block or with the process; the
    browser keeps its last picture. The server listens on every network interface of the machine, as meshcat's always
    does. If it dies, a warning is logged and the computation continues. In a notebook, the view as the value of a cell
    is the window.

    Attributes:
        url: Address of the window, for any browser on this machine.
    """

    def __init__(
        self,
        source: Robot | Scene | OptimalControlProblem,
        *,
        trace: bool | str | Sequence[str] = False,
        reference: ArrayLike | Mapping[str, ArrayLike] | None = None,
        targets: Mapping[str, object] | None = None,
        frames: bool | str | Sequence[str] = False,
        constraints: bool = True,
        speed: float | None = 1.0,
        fps: float = 30.0,
        hold: float = 0.1,
        open: bool = True,
    ) -> None:
        """Open the window, and wait for the browser up to 20 s.

        Main args:
            source: A robot, its scene, or a problem.
            trace: Frames whose paths are drawn; ``True`` for the end effector. A long motion keeps the last part.
            speed: Largest playback speed; 1 is true speed, None as fast as the motion is computed.

        Other Args:
            reference: A path (K, 3) in the world [m] to draw, or several by name.
            targets: Targets by name: a point (3,) [m], a pose (4, 4) or ``pin.SE3``.
            frames: Frames to draw as triads; ``True`` for the end effector.
            constraints: Draw the constraints of the scene or the problem.
            fps: Largest number of pictures a second.
            hold: Shortest time for which each iterate of a plan is shown [s].
            open: Start a web browser. Otherwise open :attr:`url` in one.

        Raises:
            InputError: ``source`` is none of these, a frame does not exist, or a reference or a target is invalid.
        """
        robot = source if isinstance(source, Robot) else getattr(getattr(source, "scene", source), "robot", None)
        if not isinstance(robot, Robot):
            raise InputError(
                f"a LiveView takes a Robot, a Scene or an OptimalControlProblem, got {type(source).__name__}"
            )
        self.robot = robot
        constraints, open = flag("constraints", constraints), flag("open", open)
        self._speed = None if speed is None else positive("speed", speed, "1")
        self._interval = 1.0 / positive("fps", fps, "1/s")
        self._hold = max(positive("hold", hold, "s"), self._interval)
        self._traced = frame_names("trace", [robot], trace)[0]
        held = False if source is robot or not constraints else source
        scene, wanted, begin = parts_of(held, None, robot)
        marked = tuple(target(name, track, np.zeros(1)) for name, track in target_tracks(targets, 0.0).items())
        lower, upper = robot.position_limits
        start = np.clip(np.zeros(robot.dof), lower, upper)
        start = np.asarray(getattr(source, "q0", start), dtype=np.float64)
        self._ties = ties(scene)
        standing = regions(wanted, np.array([begin]))
        if moving := [region.name for region in standing if region.moves]:
            logger.warning("a LiveView shows %s where it is at t = %g s; replays move it", " and ".join(moving), begin)
        actor = Actor(
            robot,
            {"robot": _positions(robot, start[None])},
            frames=frame_names("frames", [robot], frames)[0],
            ties=self._ties,
            regions=standing,
            goals=goals(wanted, marked),
            reach=None if self._ties else _positions(robot, _postures(robot, start)),
        )
        script = Script(np.zeros(1), (actor,), references(reference), marked)
        self._q = start
        self._begin_run()
        self._text, self._text_time = "", -math.inf
        self._iterates: list[tuple[str, ...]] = []
        self._plans = 0
        self._animated = self._closed = False
        self._loop_began = self._drawn = self._planned = -math.inf
        self._window = _Window()
        self.url: str = self._window.web_url
        self._viewer = meshcat.Visualizer(window=self._window)
        self._stage = draw(self._viewer, script)
        self._picture = self._stage.pictures[0]
        self._nodes = self._picture.moving_nodes("robot")
        self._in_view = self._stage.points
        if open and open_browser(self.url):
            self.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def wait(self, seconds: float = _BROWSER_LIMIT) -> bool:
        """Wait until a browser shows the robot, at most ``seconds``; returns whether one does, and warns if not."""
        end = time.monotonic() + positive("seconds", seconds, "s")
        if not self._silent and self._window.connected.wait(seconds):
            # A browser needs some seconds to draw large meshes.
            with self._sending():
                if self._window.has_drawn(max(0.1, end - time.monotonic())):
                    return True
        logger.warning("no browser shows %s within %g s; the view continues without one", self.url, seconds)
        return False

    def close(self) -> None:
        """End the server. The browser keeps its last picture, and continues to play a plan."""
        self._closed = True
        self._window.close()

    def __repr__(self) -> str:
        return f"LiveView({self.robot.name} at {self.url}{', closed' if self._closed else ''})"

    def _repr_html_(self) -> str:
        """The window in a frame of a notebook that runs on this machine."""
        return f'<iframe src="{markup.escape(self.url)}" style="width: 100%; height: 450px; border: 0"></iframe>'

    def progress(self, done: int, steps: int, nodes: Nodes) -> None:
        """Show nodes of a motion, for ``simulate(..., progress=view.progress)``.

        Args:
            done: Number of steps so far.
            steps: Number of steps in all.
            nodes: The new nodes.

        Raises:
            InputError: They are of another robot.
        """
        if not isinstance(nodes, Nodes):
            raise InputError("view.progress is for the progress of simulate and Mpc.run; of solve, give view.callback")
        self._require(nodes.q)
        if self._silent:
            return
        with self._sending():
            t, q = nodes.t, nodes.q
            if t[0] == 0.0:
                self._begin_run()
                self._clear_plans()
            of = f" of {t[-1] * steps / done:.4g} s" if done else ""
            if self._speed is None or not self._window.watched:
                if done == steps or time.monotonic() - self._drawn >= self._interval:
                    self._move(t, q, float(t[-1]), of)
            else:
                self._play(t, q, self._speed, of)
            if done == steps:
                self._move(t, q, float(t[-1]), of, last=True)

    def callback(self, iteration: Iteration, motion: Trajectory) -> None:
        """Show an iterate of a plan, for ``solve(..., callback=view.callback)``.

        Args:
            iteration: Record of the iteration.
            motion: Its motion.

        Raises:
            InputError: The motion is of another robot.
        """
        if not isinstance(motion, Trajectory) or not hasattr(iteration, "cost"):
            raise InputError("view.callback is for the callback of solve; of simulate and Mpc.run, give view.progress")
        self._require(motion.q)
        if self._silent:
            return
        with self._sending():
            if self._window.watched:
                time.sleep(max(0.0, self._planned + self._hold - time.monotonic()))
            elif time.monotonic() - self._planned < self._interval and self._plans:
                return
            if iteration.index == 0:
                self._begin_run()
                self._clear_plans()
            if iteration.step > 0.0 or not self._plans:
                self._draw_plan(motion.t - motion.t[0], motion.q)
            self._set_caption(f"iteration {iteration.index}, cost {iteration.cost:.5g}", last=True)
            self._planned = time.monotonic()

    def show(self, motion: Trajectory | Solution | MpcRun) -> None:
        """Play a motion, a plan or a run in a loop, from its beginning.

        Raises:
            InputError: It is none of these, or of another robot.
        """
        played = getattr(motion, "trajectory", getattr(motion, "motion", motion))
        if not isinstance(played, Trajectory):
            raise InputError(f"motion must be a trajectory, a plan or a run of an Mpc, got {type(motion).__name__}")
        self._require(played.q)
        if self._silent:
            return
        with self._sending():
            self._begin_run()
            self._clear_plans()
            self._loop_began = -math.inf
            self._draw_plan(played.t - played.t[0], played.q)
            self._set_caption(f"{played.duration:.4g} s", last=True)

    @property
    def _silent(self) -> bool:
        return self._closed or self._window.lost

    @contextlib.contextmanager
    def _sending(self) -> Iterator[None]:
        """A block in which an error of the server is logged and ends the view, but not the computation."""
        try:
            yield
        except zmq.ZMQError as error:
            self._window.lost = True
            logger.warning("the server of the live view has ended (%s); the computation continues without it", error)

    def _require(self, q: Floats) -> None:
        if q.shape[1] != self.robot.dof:
            raise InputError(
                f"the view is of robot {self.robot.name!r} with {self.robot.dof} joints, and the motion of one with "
                f"{q.shape[1]}"
            )

    def _begin_run(self) -> None:
        """Reset the view to the start of a motion."""
        self._shown = -math.inf  # time of the last picture [s of motion]
        self._anchor = time.monotonic()  # wall time at which playback of the motion began [s]
        for piece in getattr(self, "_pieces", []):
            self._viewer[piece].delete()
        self._pieces: list[str] = []
        self._count = 0
        self._path: dict[str, list[Floats]] = {name: [] for name in self._traced}

    def _play(self, t: Floats, q: Floats, speed: float, of: str) -> None:
        """Show the motion over new nodes, each picture at its time; late pictures are skipped, except for the last."""
        begin, end = max(self._shown, float(t[0])), float(t[-1])
        count = max(1, math.ceil((end - begin) / (speed * self._interval) - 1e-9))
        for time_ in np.linspace(begin, end, count + 1)[1:].tolist() if end > begin else [begin]:
            due = self._anchor + time_ / speed
            now = time.monotonic()
            if now > due + self._interval and time_ < end:
                continue
            if now < due and self._window.watched:
                time.sleep(due - now)
            elif time.monotonic() - self._drawn < self._interval:
                continue
            self._move(t, q, time_, of)
        self._anchor = max(self._anchor, time.monotonic() - end / speed - _SLACK)

    def _move(self, t: Floats, q: Floats, now: float, of: str, *, last: bool = False) -> None:
        """Show the robot at a time ``now`` [s] of the motion over new nodes."""
        if now == self._shown and not last:
            return
        rows = rows_at(np.array([now]), t, q)
        between = t[(t > self._shown) & (t < now)]
        if len(between) > _BETWEEN:
            between = between[np.linspace(0, len(between) - 1, _BETWEEN).astype(int)]
        if now > self._shown:
            self._draw_path(np.concatenate([rows_at(between, t, q), rows]))
        self._pose(rows[0])
        self._set_caption(f"t = {now:.2f}{of or ' s'}", last=last)
        self._shown, self._drawn = now, time.monotonic()

    def _pose(self, q: Floats) -> None:
        """Update the joints that have moved, the rods between bodies and, if necessary, the camera."""
        self._stop_loop()
        tree = self.robot.tree
        before, positions = _positions(self.robot, self._q[None])[0], _positions(self.robot, q[None])[0]
        for j, node in enumerate(self._nodes):
            if positions[j] != before[j] or self._shown == -math.inf:
                self._viewer[node].set_transform(joint_motion(bool(tree.prismatic[j]), positions[j]))
        self._q = q
        R, p = self._picture.body_poses(positions[None])
        for k, tie in enumerate(self._ties):
            if tie.axis is None:
                a, b = (end[1] if end[0] < 0 else R[0, end[0]] @ end[1] + p[0, end[0]] for end in (tie.a, tie.b))
                self._viewer[f"notes/ties/{k}"].set_transform(_rod(a, b))
        self._keep_in_view(p[0])

    def _keep_in_view(self, points: Floats) -> None:
        """Move the camera back if points (P, 3) are outside its view."""
        low, high = self._in_view.min(axis=0), self._in_view.max(axis=0)
        edge = 0.1 * self._stage.size
        if (points >= low - edge).all() and (points <= high + edge).all():
            return
        # Twice as far as necessary, so that the camera does not move with every picture.
        out = points + np.where(points > high, points - high, 0.0) - np.where(points < low, low - points, 0.0)
        self._in_view = np.concatenate([self._in_view, points, out])
        set_view(self._viewer, self._in_view, self._stage.toward, self._stage.floor, self._stage.size)

    def _draw_path(self, q: Floats) -> None:
        """Extend the paths of the traced frames over configurations (k, n)."""
        for name in self._traced:
            path = self._path[name]
            path += list(self.robot.frame_positions(q, name))
            points = _apart(np.array(path), _APART * self._stage.size)
            if len(points) < 2:
                continue
            color = TRACE_COLORS["motion"]
            if len(path) == len(q) or not self._pieces:
                self._pieces.append(f"notes/live/{self._count} {name}")
                self._count += 1
            node = next(piece for piece in reversed(self._pieces) if piece.endswith(f" {name}"))
            self._viewer[node].set_object(marks.tube(points, _TUBE * self._stage.size, color))
            if len(path) > _PIECE:
                self._path[name] = [points[-1]]
                self._pieces.append(f"notes/live/{self._count} {name}")
                self._count += 1
        while len(self._pieces) > _PIECES * len(self._traced):
            self._viewer[self._pieces.pop(0)].delete()

    def _draw_plan(self, t: Floats, q: Floats) -> None:
        """Play a motion in a loop, from the phase of the previous one, and draw its paths."""
        if self._iterates:
            for node in self._iterates[-1]:
                pale = [*(channel / 255.0 for channel in TRACE_COLORS["motion"].to_bytes(3, "big")), _PALE]
                self._viewer[f"{node}/<object>"].set_property("color", pale)
        rows = q[np.linspace(0, len(q) - 1, min(len(q), _PATH)).astype(int)]
        nodes = []
        for name in self._traced:
            points = _apart(self.robot.frame_positions(rows, name), _APART * self._stage.size)
            if len(points) > 1:
                node = f"notes/plans/{self._plans} {name}"
                color = TRACE_COLORS["motion"]
                self._viewer[node].set_object(marks.tube(points, _TUBE * self._stage.size, color))
                nodes.append(node)
        self._iterates.append(tuple(nodes))
        self._plans += 1
        while len(self._iterates) > _ITERATES:
            for node in self._iterates.pop(0):
                self._viewer[node].delete()
        positions = _positions(self.robot, rows)
        self._keep_in_view(self._picture.body_poses(positions)[1].reshape(-1, 3))
        if t[-1] > 0.0:
            self._loop(t, q)
        else:
            self._pose(q[-1])

    def _loop(self, t: Floats, q: Floats) -> None:
        """Let the page play a motion in a loop, from the phase of the previous one."""
        now, speed, tree = time.monotonic(), self._speed or 1.0, self.robot.tree
        end = float(t[-1]) / speed
        if self._loop_began == -math.inf:
            self._loop_began = now
        phase = (now - self._loop_began) % end
        keys = int(np.clip(_KEYS // len(tree.parent), 10, max(10.0, min(300.0, 30.0 * end))))
        times = np.linspace(0.0, end, keys + 1)
        # From the phase to the end, then from the start to the phase, with a jump in between.
        first, second = np.append(phase, times[times > phase]), np.append(times[times < phase], phase)
        clock = np.concatenate([first - phase, second + (end - phase) + 1e-6])
        rows = _positions(self.robot, rows_at(speed * np.concatenate([first, second]), t, q))
        clips = {}
        for j, node in enumerate(self._nodes):
            name = joint_track(bool(tree.prismatic[j]))
            track = AnimationTrack(name, "number", clock.tolist(), rows[:, j].tolist())
            clips[self._viewer[node].path] = AnimationClip({name: track}, fps=1)
        self._viewer.set_animation(Animation(clips), play=True, repetitions=math.inf)
        self._animated, self._q = True, q[0]

    def _stop_loop(self) -> None:
        """End the page's animation, which would continue to move the robot."""
        if not self._animated:
            return
        path = self._viewer[self._nodes[0]].path
        name = joint_track(bool(self.robot.tree.prismatic[0]))
        still = AnimationTrack(name, "number", [0.0], [float(_positions(self.robot, self._q[None])[0, 0])])
        self._viewer.set_animation(Animation({path: AnimationClip({name: still}, fps=1)}), play=False, repetitions=1)
        self._animated, self._loop_began, self._shown = False, -math.inf, -math.inf

    def _clear_plans(self) -> None:
        for node in [node for nodes in self._iterates for node in nodes]:
            self._viewer[node].delete()
        self._iterates, self._planned = [], -math.inf

    def _set_caption(self, words: str, *, last: bool = False) -> None:
        """Show a text above the robot, not more often than every ``_TEXT_INTERVAL`` unless it is the last."""
        now = time.monotonic()
        if words == self._text or (now - self._text_time < _TEXT_INTERVAL and not last):
            return
        size = self._stage.size
        low, high = self._in_view.min(axis=0), self._in_view.max(axis=0)
        pose = np.eye(4)
        pose[:3, 3] = [*(0.5 * (low + high))[:2], low[2]]
        self._viewer["notes/words"].set_transform(pose)
        self._viewer["notes/words"].set_object(marks.Label(words, _LABEL * size, 0.0))
        self._text, self._text_time = words, now


class _Window(ViewerWindow):
    """A meshcat server that reports whether browsers are connected, and whose answers have a time limit.

    Attributes:
        connected: Set once a browser has connected.
        watched: Whether a browser is connected now.
        lost: Whether the server has ended.
    """

    def __init__(self) -> None:
        self.connected = threading.Event()
        self.lost = False
        self._browsers = 0
        with contextlib.redirect_stdout(io.StringIO()):
            super().__init__(zmq_url=None, start_server=True, server_args=[])
        # The server writes a line for each browser that connects or disconnects.
        threading.Thread(target=self._listen, daemon=True).start()

    @property
    def watched(self) -> bool:
        """Whether a browser is connected."""
        return self._browsers > 0

    def connect_zmq(self) -> None:
        """Connect to the server; an answer that is missing, or unread because of Ctrl-C, does not block."""
        self.zmq_socket = self.context.socket(zmq.REQ)
        for option in (zmq.REQ_RELAXED, zmq.REQ_CORRELATE):
            self.zmq_socket.setsockopt(option, 1)
        self.zmq_socket.setsockopt(zmq.RCVTIMEO, int(1000 * _ANSWER_LIMIT))
        self.zmq_socket.setsockopt(zmq.LINGER, 0)
        self.zmq_socket.connect(self.zmq_url)

    def send(self, command: Any) -> None:
        """Send a command, and wait until the server has accepted it."""
        words = lowered(command)
        self.zmq_socket.send_multipart([words["type"].encode(), words["path"].encode(), umsgpack.packb(words)])
        self.zmq_socket.recv()

    def _listen(self) -> None:
        for line in self.server_proc.stderr:
            if line.startswith(b"opened:"):
                self._browsers += 1
                self.connected.set()
            elif line.startswith(b"closed:"):
                self._browsers -= 1

    def has_drawn(self, seconds: float) -> bool:
        """Whether the browser has executed all commands within ``seconds``, as it executes them in order."""
        if not self.watched:
            return False
        self.zmq_socket.send_multipart([b"capture_image", b"", umsgpack.packb({"type": "capture_image"})])
        if not self.zmq_socket.poll(int(1000 * seconds)):
            return False
        self.zmq_socket.recv()
        return True

    def close(self) -> None:
        """End the server."""
        self.lost = True
        self.zmq_socket.close()
        self.server_proc.kill()
        self.server_proc.wait()


def _postures(robot: Robot, start: Floats) -> Floats:
    """Random configurations (S, n) [rad or m] around ``start``, within the limits."""
    lower, upper = robot.position_limits
    turn = np.where(robot.slides, 0.0, _TURN)
    low = np.where(robot.slides & np.isfinite(lower), lower, np.maximum(lower, start - turn))
    high = np.where(robot.slides & np.isfinite(upper), upper, np.minimum(upper, start + turn))
    shares = np.random.default_rng(0).random((_POSTURES, robot.dof))
    return np.asarray(low + shares * (high - low))


def _positions(robot: Robot, q: Floats) -> Floats:
    """Positions (K, b) of all joints of the tree."""
    tree = robot.tree
    return np.asarray(q[:, tree.coordinate] * tree.ratio + tree.offset)


def _apart(points: Floats, least: float) -> Floats:
    """Points of a path (P, 3) at least ``least`` [m] from the previous one kept, the first and the last among them."""
    kept = [0]
    for k in range(1, len(points)):
        if np.linalg.norm(points[k] - points[kept[-1]]) > least:
            kept.append(k)
    if len(kept) > 1:
        kept[-1] = len(points) - 1
    return points[kept]


def _rod(a: Floats, b: Floats) -> Floats:
    """Transform (4, 4), scaling included, that puts a rod of length 1 along z between two points."""
    span, pose = b - a, np.eye(4)
    length = float(np.linalg.norm(span))
    pose[:3, :3] = (z_to(span / length) if length > 0.0 else np.eye(3)) @ np.diag([1.0, 1.0, length])
    pose[:3, 3] = 0.5 * (a + b)
    return pose
