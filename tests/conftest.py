import functools
import importlib
import os
import shutil
from pathlib import Path

import pytest

import varpin as vp
from varpin.model.names import FIXED_BASE

# example-robot-data 6.0.0 dropped the Bravo 7 that 5.0.0 has.
ROBOTS = [name for name in FIXED_BASE if not name.startswith("bravo7_")] + ["finger"]
# Slow, too: cases of more than a second, most of them in functions that quicker cases run.
SLOW = frozenset((Path(__file__).parent / "slow.txt").read_text(encoding="utf-8").splitlines())


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--slow", action="store_true", help="run the tests marked slow, too")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    config.unknown_slow = SLOW - {item.nodeid for item in items}
    if not config.getoption("--slow"):
        slow = {item for item in items if "slow" in item.keywords or item.nodeid in SLOW}
        config.hook.pytest_deselected(items=list(slow))
        items[:] = [item for item in items if item not in slow]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "robot_name" in metafunc.fixturenames:
        metafunc.parametrize("robot_name", ROBOTS)


load_once = functools.cache(vp.load_robot)


@pytest.fixture
def robot(robot_name: str) -> vp.Robot:
    """Each fixed-base robot in turn. Robots are frozen, so one copy serves all tests."""
    return load_once(robot_name)


@pytest.fixture
def load():
    """``varpin.load_robot`` for names, each loaded once a session."""
    return load_once


@pytest.fixture(scope="session")
def script():
    """Modules of benchmarks by name, which find each other there as when they are run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).resolve().parents[1] / "benchmarks"))
        yield importlib.import_module


@pytest.fixture(scope="session")
def chromium_session(tmp_path_factory):
    """Headless Chromium, for the tests of whole pages; they are skipped where there is none, except in CI."""
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if not (chromium and driver):
        reason = "needs chromium and chromedriver on the PATH"
        pytest.fail(reason) if os.environ.get("CI") else pytest.skip(reason)
    from chromium import session  # noqa: PLC0415 - selenium is needed by few tests

    with session(chromium, driver, tmp_path_factory.mktemp("chromium")) as opened:
        yield opened


@pytest.fixture
def browser(chromium_session):
    """The session's browser. A page left open would go on drawing, at the cost of the tests after it."""
    yield chromium_session
    chromium_session.get("about:blank")


@pytest.fixture
def show(browser, tmp_path):
    """A function that replays on a page, opens that and returns its path; to the end the page has no errors."""
    from chromium import severe, visit  # noqa: PLC0415 - as above

    def make(*given, **options):
        path = vp.replay(*given, html=tmp_path / "page.html", **options)
        visit(browser, path)
        return path

    yield make
    assert severe(browser) == []
