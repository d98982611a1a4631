"""Live view of motions in meshcat while they are computed."""

from __future__ import annotations

import contextlib
import html as markup
import io
import logging
import math
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Self

import meshcat
import numpy as np
import umsgpack
import zmq
from meshcat.visualizer import ViewerWindow

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.marks import Marks
from varpin.mechanics.scene import Scene
from varpin.model import Robot
from varpin.show.replay import shapes
from varpin.show.replay.drawing import draw, set_view
from varpin.show.replay.figure import Shown, require_marks, rows_at
from varpin.show.replay.marks import KINDS, LABEL, TUBE, rod
from varpin.show.replay.page import open_browser
from varpin.show.replay.picture import label
from varpin.show.replay.stage import Stage, joint_items, mark_items
from varpin.support.checks import flag, positive
from varpin.trajectory import Nodes

if TYPE_CHECKING:
    from varpin.control import OptimalControlProblem

logger = logging.getLogger(__name__)

# Time limits for an answer of the server, and for a browser to connect [s].
_ANSWER_LIMIT, _BROWSER_LIMIT = 20.0, 20.0
# Largest delay that is caught up by faster playback [s].
_SLACK = 0.1
# Shortest time between two changes of the text beside the robot [s].
_TEXT_INTERVAL = 0.1
# Points of a path that stay: 100 kB a picture, as meshcat sends a changed object whole; and the largest number of new
# ones in a picture.
_TRACE, _BETWEEN = 400, 50
# Shortest distance of points of a path, and how far bodies may leave the view, relative to the size of the robot.
_APART, _EDGE = 0.004, 0.1


class LiveView:
    """A window that shows motions while they are computed.

        with vp.LiveView(scene, marks=vp.Marks(trace=True)) as view:
            motion = vp.simulate(scene, q0, v0, dt=1e-3, steps=5000, progress=view.progress)

    ``progress`` shows the motion of :func:`varpin.simulate` or :meth:`varpin.Mpc.run` up to the present, at most at
    true speed: where computing is faster, it waits. Nothing waits while no browser is connected. At first the robot is
    in its initial configuration; the camera moves back as its motion needs.

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
        marks: Marks | None = None,
        speed: float | None = 1.0,
        fps: float = 30.0,
        open: bool = True,
    ) -> None:
        """Open the window, and wait for the browser up to 20 s.

        Main args:
            source: A robot, its scene, or a problem.
            marks: Traces, of which a long motion keeps the last part; frames, a reference and standing targets. With
                ``constraints=True`` those of the scene or the problem.
            speed: Largest playback speed; 1 is true speed, None as fast as the motion is computed.

        Other Args:
            fps: Largest number of pictures a second.
            open: Start a web browser. Otherwise open :attr:`url` in one.

        Raises:
            InputError: ``source`` is none of these, a frame does not exist, or another mark is invalid or is for
                replays only.
        """
        robot = source if isinstance(source, Robot) else getattr(getattr(source, "scene", source), "robot", None)
        if not isinstance(robot, Robot):
            raise InputError(
                f"a LiveView takes a Robot, a Scene or an OptimalControlProblem, got {type(source).__name__}"
            )
        marks = require_marks(marks)
        if marks.ghost is not None or marks.ahead is not None or marks.torques is not False:
            raise InputError("a LiveView has neither a ghost nor torques: give trace, frames, reference or targets")
        self.robot = robot
        self._speed = None if speed is None else positive("speed", speed, "1")
        self._interval = 1.0 / positive("fps", fps, "1/s")
        lower, upper = robot.position_limits
        start = np.clip(np.zeros(robot.dof), lower, upper)
        self._q = np.asarray(getattr(source, "q0", start), dtype=np.float64)
        self._stage = Stage.of([Shown(robot, source, marks, np.zeros(1), self._q[None])])
        self._size = self._stage.figures[0].size
        self._path: dict[str, list[Floats]] = {name: [] for name in self._stage.figures[0].trace}
        open = flag("open", open)
        self._text, self._text_time = "", -math.inf
        self._drawn = -math.inf
        self._window = _Window()
        self.url: str = self._window.web_url
        self._viewer = meshcat.Visualizer(window=self._window)
        draw(self._viewer, self._stage)
        self._poses: dict[str, bytes] = {}  # those of nodes that have moved
        self._in_view = self._stage.points
        self._begin_run()
        if open and open_browser(self.url):
            self.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def wait(self, seconds: float = _BROWSER_LIMIT) -> bool:
        """Wait until a browser shows the robot, at most ``seconds``; returns whether one does, and warns if not."""
        end = time.monotonic() + positive("seconds", seconds, "s")
        if not self._window.lost and self._window.connected.wait(seconds):
            # A browser needs some seconds to draw large meshes.
            with self._sending():
                if self._window.has_drawn(max(0.1, end - time.monotonic())):
                    return True
        logger.warning("no browser shows %s within %g s; the view continues without one", self.url, seconds)
        return False

    def close(self) -> None:
        """End the server. The browser keeps its last picture."""
        self._window.close()

    def __repr__(self) -> str:
        return f"LiveView({self.robot.name} at {self.url}{', closed' if self._window.lost else ''})"

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
            raise InputError("view.progress is for the progress of simulate and Mpc.run")
        t, q = nodes.t, nodes.q
        if q.shape[1] != self.robot.dof:
            raise InputError(
                f"the view is of robot {self.robot.name!r} with {self.robot.dof} joints, and the motion of one with "
                f"{q.shape[1]}"
            )
        if self._window.lost:
            return
        with self._sending():
            if t[0] == 0.0:
                self._begin_run()
            of = f" of {t[-1] * steps / done:.4g} s" if done else " s"
            if self._speed is not None and self._window.watched:
                self._play(t, q, self._speed, of)
            elif time.monotonic() - self._drawn >= self._interval:
                self._move(t, q, float(t[-1]), of)
            if done == steps:
                self._move(t, q, float(t[-1]), of, last=True)

    @contextlib.contextmanager
    def _sending(self) -> Iterator[None]:
        """A block in which an error of the server is logged and ends the view, but not the computation."""
        try:
            yield
        except zmq.ZMQError as error:
            self._window.lost = True
            logger.warning("the server of the live view has ended (%s); the computation continues without it", error)

    def _begin_run(self) -> None:
        """Reset the view to the start of a motion."""
        self._shown = -math.inf  # time of the last picture [s of motion]
        self._anchor = time.monotonic()  # wall time at which playback of the motion began [s]
        for path in self._path.values():
            path.clear()
        self._viewer["notes/live"].delete()

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
        row = rows_at(np.array([now]), t, q)
        between = t[(t > self._shown) & (t < now)]
        if len(between) > _BETWEEN:
            between = between[np.linspace(0, len(between) - 1, _BETWEEN).astype(int)]
        if now > self._shown:
            self._draw_path(np.concatenate([rows_at(between, t, q), row]))
        self._pose(row)
        self._set_caption(f"t = {now:.2f}{of}", last=last)
        self._shown, self._drawn = now, time.monotonic()

    def _pose(self, row: Floats) -> None:
        """Update the joints and the rods that have moved and, if necessary, the camera, for q (1, n)."""
        figure, self._q = replace(self._stage.figures[0], rows={"robot": row}), row[0]
        items = [*joint_items(figure, "robot")]
        for k, mark in enumerate(self._stage.marks[0]):
            if mark.tied is not None:
                items += mark_items(figure, k, replace(mark, items=[*rod(figure, mark.tied)]))
        for item in items:
            if self._poses.get(item.node) != (pose := item.pose.tobytes()):
                self._viewer[item.node].set_transform(item.pose)
                self._poses[item.node] = pose
        self._keep_in_view(figure.poses[1][0])

    def _keep_in_view(self, points: Floats) -> None:
        """Move the camera back if points (P, 3) are outside its view."""
        low, high = self._in_view.min(axis=0), self._in_view.max(axis=0)
        edge = _EDGE * self._size
        if (points >= low - edge).all() and (points <= high + edge).all():
            return
        # Twice as far as necessary, so that the camera does not move with every picture.
        out = points + np.where(points > high, points - high, 0.0) - np.where(points < low, low - points, 0.0)
        self._in_view = np.concatenate([self._in_view, points, out])
        set_view(self._viewer, self._in_view, self._stage.figures[0])

    def _draw_path(self, q: Floats) -> None:
        """Extend the paths of the traced frames over configurations (k, n)."""
        size = self._size
        for name, path in self._path.items():
            for point in self.robot.frame_positions(q, name):
                if not path or np.linalg.norm(point - path[-1]) > _APART * size:
                    path.append(point)
            del path[:-_TRACE]
            if len(path) > 1:
                tube = shapes.tube(np.array(path), TUBE * size, KINDS["motion"][1])
                self._viewer[f"notes/live/{label(name)}"].set_object(tube)

    def _set_caption(self, words: str, *, last: bool = False) -> None:
        """Show a text above the robot, not more often than every ``_TEXT_INTERVAL`` unless it is the last."""
        now = time.monotonic()
        if words == self._text or (now - self._text_time < _TEXT_INTERVAL and not last):
            return
        low, high = self._in_view.min(axis=0), self._in_view.max(axis=0)
        self._viewer["notes/words"].set_transform(shapes.transform(np.array([*(0.5 * (low + high))[:2], low[2]])))
        self._viewer["notes/words"].set_object(shapes.Label(words, LABEL * self._size, 0.0))
        self._text, self._text_time = words, now


class _Window(ViewerWindow):
    """A meshcat server that reports whether browsers are connected, and whose answers have a time limit.

    Attributes:
        connected: Set once a browser has connected.
        lost: Whether the server has ended or was closed.
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
