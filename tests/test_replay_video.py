"""Films of replays, taken by a real browser."""

import importlib.util
import shutil

import imageio.v3 as imageio
import numpy as np
import pytest
from PIL import Image, ImageSequence
from refusals import refused, unnamed

import varpin as vp
from varpin import replay
from varpin.cli import main
from varpin.show.replay import video

Q = np.linspace([0.0, 0.0], [1.2, -0.8], 11)


@pytest.fixture(scope="module")
def chain():
    return vp.planar_chain(2)


def frames(path):
    return np.array(
        [np.asarray(frame.convert("RGB"), dtype=float) for frame in ImageSequence.Iterator(Image.open(path))]
    )


def test_frames_are_at_exact_times(browser, chain, tmp_path):
    q = np.repeat([[0.0, 0.0], [1.0, 0.5]], [6, 5], axis=0)  # moves between 0.5 s and 0.6 s alone
    path = tmp_path / "jump.gif"
    assert replay(chain, q, dt=0.1, video=path, fps=10.0, size=(320, 240)) == path
    film = frames(path)
    assert film.shape == (11, 240, 320, 3)
    assert Image.open(path).info["duration"] == 100  # [ms]
    assert (film[:6] == film[0]).all()
    assert (film[6:] == film[-1]).all()
    assert (np.abs(film[6] - film[5]).max(axis=-1) > 40.0).mean() > 1e-3


def test_an_mp4_and_its_page(browser, chain, tmp_path):
    path, page = tmp_path / "chain.mp4", tmp_path / "chain.html"
    assert replay(chain, Q, dt=0.1, html=page, video=path, fps=5.0, size=(320, 240), speed=2.0) == path
    film = imageio.imread(path, plugin="FFMPEG").astype(float)
    assert film.shape == (3, 240, 320, 3)
    assert (np.abs(film[2] - film[0]).max(axis=-1) > 40.0).mean() > 1e-3
    assert page.stat().st_size > 10_000


def test_frame_times():
    np.testing.assert_allclose(video.frame_times(".mp4", 30.0, 1.0, 99), np.arange(31) / 30.0)
    np.testing.assert_allclose(video.frame_times(".gif", 30.0, 1.0, 99), 0.03 * np.arange(34))
    np.testing.assert_allclose(video.frame_times(".gif", 1000.0, 0.1, 99), 0.02 * np.arange(6))
    assert [len(video.frame_times(kind, 30.0, 100.0, 11)) for kind in video.FORMATS] == [11, 11]
    np.testing.assert_array_equal(video.frame_times(".gif", 30.0, 0.0, 99), [0.0])


def test_says_what_is_missing_and_how_to_get_it(chain, tmp_path, monkeypatch):
    found, which = importlib.util.find_spec, shutil.which

    def without(*gone):
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name in gone else found(name))
        monkeypatch.setattr(shutil, "which", lambda name: None if name in gone else (which(name) or f"/usr/bin/{name}"))
        with pytest.raises(vp.MissingDependency) as caught:
            replay(chain, Q, dt=0.1, video=tmp_path / "chain.gif")
        return caught.value

    error = without("imageio", "imageio_ffmpeg")
    assert (error.missing, error.command) == (("imageio", "imageio-ffmpeg"), 'pip install "varpin[video]"')
    assert isinstance(error, ImportError)
    assert without("selenium").missing == ("selenium",)
    nothing = without("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chromedriver")
    assert nothing.missing == ("chromium", "chromedriver")
    assert not (tmp_path / "chain.gif").exists()


def test_refuses_other_formats_and_sizes(chain, tmp_path):
    for name, size, facts in [
        ("chain.avi", (320, 240), ("video", ".gif", ".mp4", "'chain.avi'")),
        ("chain.mp4", (321, 240), ("size", "even", "321 x 240")),
        ("chain.mp4", 320, ("size", "width", "height", "320")),
        ("chain.mp4", (320, 2), ("size", "16", "2")),
    ]:
        with refused(vp.InputError, facts):
            replay(chain, Q, dt=0.1, video=tmp_path / name, size=size)


@pytest.mark.slow
def test_the_command_line_films_with_traces(browser, tmp_path, capsys):
    path = tmp_path / "finger.gif"
    start = ["simulate", "finger", "--no-gravity", "--v0", "2", "1", "1", "--dt", "1e-2", "--steps", "10"]
    assert main([*start, "--video", str(path), "--trace", "tip", "--speed", "0.5", "--quiet"]) == 0
    assert len(frames(path)) == 7  # 0.2 s of playback, 0.03 s each
    assert main([*start, "--html", str(tmp_path / "page.html"), "--trace", "nail"]) == 2
    assert not unnamed(" ".join(capsys.readouterr().err.split()), "--trace", "'finger'", "'nail'")
    assert main([*start, "--video", str(tmp_path / "finger.avi")]) == 2
    assert not unnamed(capsys.readouterr().err, "video", ".gif", ".mp4")
