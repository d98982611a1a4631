"""A replay's page in real, headless Chromium, cut off from the network, and what it holds."""

import base64
import contextlib
import gzip
import io
import re
import time

import numpy as np
import pinocchio as pin
import umsgpack
from PIL import Image
from selenium import webdriver
from selenium.webdriver.chrome.service import Service

from varpin.model import geometry

FLAGS = ["--headless", "--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader"]
FLAGS += ["--enable-unsafe-swiftshader", "--disable-component-update", "--disable-dev-shm-usage"]
FLAGS += ["--window-size=800,600"]

# Without a graphics card drawing takes most of the time, and most tests look at what is drawn, not at the picture.
UNDRAWN = """
    for (const method of ["drawElements", "drawArrays"]) {
        const draw = WebGL2RenderingContext.prototype[method];
        WebGL2RenderingContext.prototype[method] = function(...given) { if (window.drawn) draw.apply(this, given); };
    }"""


@contextlib.contextmanager
def session(chromium, driver, profile):
    """A browser with a new profile."""
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for flag in [*FLAGS, f"--user-data-dir={profile}"]:
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = webdriver.Chrome(options=options, service=Service(driver))
    browser.set_script_timeout(60)
    browser.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": UNDRAWN})
    try:
        yield browser
    finally:
        browser.quit()


def wait_until(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "the page did not get there"
        time.sleep(0.05)


def connect(browser, online):
    browser.get_log("browser")
    browser.execute_cdp_cmd("Network.enable", {})
    speeds = {"latency": 0, "downloadThroughput": -1, "uploadThroughput": -1}
    browser.execute_cdp_cmd("Network.emulateNetworkConditions", {"offline": not online, **speeds})


def visit(browser, path):
    """Load a page offline; returns once every command has reached the viewer.

    It moves, but is not drawn until there is a picture of it.
    """
    connect(browser, online=False)
    browser.get(path.as_uri())
    wait_until(lambda: browser.execute_script("return document.documentElement.dataset.loaded"))


def seek(browser, seconds):
    """Stop the animation at a time; returns once that is on the screen."""
    browser.execute_async_script(
        "viewer.animator.pause(); viewer.animator.seek(arguments[0]);"
        "requestAnimationFrame(() => requestAnimationFrame(() => requestAnimationFrame(arguments[1])));",
        seconds,
    )


def picture(browser):
    """The scene (height, width, 3), without the strip that holds meshcat's controls, the bar and the key to colours."""
    browser.execute_async_script(
        """
        document.getElementById('about').style.visibility = 'hidden';
        window.drawn = true;
        viewer.set_dirty();
        requestAnimationFrame(() => requestAnimationFrame(() => requestAnimationFrame(arguments[0])));"""
    )
    bar = browser.execute_script("return document.getElementById('bar')?.offsetHeight ?? 0")
    image = Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")
    return np.asarray(image, dtype=float)[40 : image.height - bar]


# In scripts: the transform of a node in the world of meshcat's root.
PLACE = """
    const root = viewer.scene_tree.find(["meshcat"]).object;
    root.updateMatrixWorld(true);
    const place = node => root.matrixWorld.clone().invert().multiply(node.matrixWorld).toArray();
"""


def pose(browser, path):
    """The transform (4, 4) of a node."""
    script = PLACE + "return place(viewer.scene_tree.find(['meshcat', ...arguments[0]]).object);"
    return np.reshape(browser.execute_script(script, path), (4, 4)).T


def poses(browser, figure, which):
    """The transforms (4, 4) of the nodes of a figure for which a condition on ``node`` holds, by their names."""
    script = f"""
        const poses = {{}};
        viewer.scene_tree.find(["meshcat", ...arguments[0]]).object.traverse(node => {{
            if ({which}) poses[node.name] = place(node);
        }});
        return poses;"""
    found = browser.execute_script(PLACE + script, figure)
    return {name: np.reshape(numbers, (4, 4)).T for name, numbers in found.items()}


def shape_poses(browser, figure="robot"):
    """Those of the robot's or its ghost's shapes, by index."""
    found = poses(browser, [figure], "node.parent && node.parent.name == 'shapes'")
    return {int(name.split(" ")[0]): place for name, place in found.items()}


def shapes_stand(browser, robot, q, figure="robot", shift=0.0):
    """Whether every shape of a robot, or every moving one of its ghost, is where Pinocchio puts it, and shifted."""
    model, shapes = robot.model, geometry(robot)
    data, placements = model.createData(), shapes.createData()
    pin.updateGeometryPlacements(model, data, shapes, placements, robot.configuration(np.asarray(q)))
    found = shape_poses(browser, figure)
    moving = [k for k, shape in enumerate(shapes.geometryObjects) if shape.parentJoint > 0]
    assert sorted(found) == (moving if figure.startswith("ghost") else list(range(shapes.ngeoms)))
    off = [found[k] - placements.oMg[k].homogeneous for k in found]
    return np.abs(off - np.pad(np.reshape(shift, (-1, 1)) * np.ones((3, 1)), ((0, 1), (3, 0)))).max() < 2e-5


def severe(browser):
    """Errors of the page, but for the icon that a server has not."""
    entries = browser.get_log("browser")
    return [entry for entry in entries if entry["level"] == "SEVERE" and "favicon" not in entry["message"]]


def names(browser, path):
    """The nodes below a path."""
    return browser.execute_script(
        "return Object.keys(viewer.scene_tree.find(['meshcat', ...arguments[0]]).children)", path
    )


def commands(path):
    """What a page tells the viewer, read without a browser."""
    packed = re.search(r'<script id="commands" type="text/plain">([^<]*)</script>', path.read_text()).group(1)
    stream = gzip.decompress(base64.b64decode(packed))
    found = []
    while stream:
        size = int.from_bytes(stream[:4], "little")
        found.append(umsgpack.unpackb(stream[4 : 4 + size]))
        stream = stream[4 + size :]
    return found


def animation(path):
    """Times and values by joint node, and the options."""
    (command,) = [command for command in commands(path) if command["type"] == "set_animation"]
    tracks = {}
    for part in command["animations"]:
        (track,) = part["clip"]["tracks"]
        keys = track["keys"]
        assert part["clip"]["fps"] == 1
        tracks[part["path"], track["name"]] = [[key["time"] for key in keys], [key["value"] for key in keys]]
    return tracks, command["options"]
