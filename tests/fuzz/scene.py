"""Scene files: TOML damaged in its keys, values and bytes, loaded, inspected, and some of it simulated and solved."""

from __future__ import annotations

import copy
import functools
import json
import random
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import varpin as vp
from fuzz.damage import WORDS, Case, Special, damaged_bytes, damaged_tree, places, require_finite
from varpin.io.scenefile import scenes

DOCS = Path(__file__).resolve().parents[2] / "docs" / "scenes.md"
ROBOT = Path(__file__).resolve().parents[2] / "models" / "finger.urdf"
PATHS = [
    *("/dev/zero", "/dev/stdin", "/dev/zero.csv", "/etc/passwd", "/etc/passwd.urdf", "../secret.csv", "fifo.csv"),
    *("fifo.urdf", "folder.csv", "folder.urdf", "link.csv", "link.urdf", "loop.npz", "/proc/self/environ", "file.csv"),
    *(
        "/proc/self/fd/0",
        "~/.bashrc",
        "a" * 300 + ".csv",
        "x/" * 400 + "a.urdf",
        "https://localhost/a.urdf",
        "zero.npz",
    ),
    *("robot.urdf", "./robot.urdf", "folder/../robot.urdf", "C:\\a.urdf", "file:///etc/passwd", "//a.csv", "."),
]
# Beside the scene, for paths to lead to.
BESIDE = {
    "fifo.csv": Special("fifo"),
    "fifo.urdf": Special("fifo"),
    "folder.csv": Special("folder"),
    "folder": Special("folder"),
    "link.csv": Special("link", "/etc/passwd"),
    "link.urdf": Special("link", "/dev/zero"),
    "loop.npz": Special("link", "loop.npz"),
    "zero.npz": Special("link", "/dev/zero"),
    "file.csv": b"t,mcp,pip,dip\n0,1,2,3\n9,1,2,3\n",
    "robot.urdf": ROBOT.read_bytes(),
}

Corpus = list[dict[str, Any]]


def corpus() -> Corpus:
    """The bundled scenes, those of the finger more often, and the documented one."""
    found = {name: tomllib.loads(path.read_text()) for name, path in scenes().items()}
    (whole, *_) = re.findall(r"^```toml\n(.*?)^```$", DOCS.read_text(), re.M | re.S)
    small = [data for name, data in found.items() if name.startswith("finger") or name.startswith("double")]
    return [found["finger_noise"], *small * 3, *found.values(), tomllib.loads(whole)]


def whole(corpus: Corpus) -> Case:
    """A finger with noise and costs."""
    return Case("solve", {"input.toml": toml(_short(corpus[0])).encode()})


def make(rng: random.Random, corpus: Corpus) -> Case:
    """A damaged scene; of a share of them more is asked than to be loaded."""
    if rng.random() < 0.03:
        return Case("load", {"input.toml": extreme(rng)})
    data, form = copy.deepcopy(rng.choice(corpus)), "load"
    if rng.random() < 0.3:
        data, form = _short(data), "solve"
    names = sorted({str(key) for place in places(data) for key in place if isinstance(key, str)})
    if rng.random() < 0.9:
        data = damaged_tree(data, rng, [*names, *WORDS])
    if rng.random() < 0.1 and isinstance(data, dict):
        _put_path(data, rng)
    content = toml(data).encode("utf-8", errors="replace")
    return Case(form, {"input.toml": damaged_bytes(content, rng) if rng.random() < 0.1 else content, **BESIDE})


def _short(data: dict[str, Any]) -> dict[str, Any]:
    """The scene over four steps."""
    horizon = {"dt": data["horizon"]["dt"], "steps": 4}
    return {**data, "horizon": horizon, "solve": {"max_iterations": 2}}


def _put_path(data: dict[str, Any], rng: random.Random) -> None:
    path = rng.choice(PATHS)
    change = rng.randrange(4)
    if change == 0:
        data["robot"] = {"source": path}
    elif change == 1 and isinstance(data.get("robot"), dict):
        data["robot"]["package_dirs"] = [path]
    elif change == 2:
        data["outputs"] = {rng.choice(["save", "plot", "html"]): path}
    else:
        data["cost"] = [{"type": "tracking", "reference": {"file": path}}]
        data["robot"] = {"source": "finger"}


def toml(value: Any) -> str:
    """A table as TOML, one line for each of its keys; what TOML has no word for is left out."""
    if not isinstance(value, dict):
        return f"a = {_inline(value)}"
    return "\n".join(f"{_text(key)} = {_inline(entry)}" for key, entry in value.items() if entry is not None)


def _inline(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_text(k)} = {_inline(v)}" for k, v in value.items() if v is not None) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_inline(entry) for entry in value if entry is not None) + "]"
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, float):
        return repr(value)
    return str(value).lower() if isinstance(value, bool) or abs(value) < 10**4000 else hex(abs(value))


def _text(word: str) -> str:
    return json.dumps(word, ensure_ascii=False)


def extreme(rng: random.Random) -> bytes:
    """Nested, long, of many tables, or of long keys."""
    size = int(10 ** rng.uniform(1.0, 5.3))
    base = '[robot]\nsource = "finger"\n[horizon]\ndt = 0.01\nsteps = 4\n'
    texts: list[Callable[[], str]] = [
        lambda: base + "a" + ".a" * size + " = 1",
        lambda: base + '"a b"' + '."a, b"' * size + " = 1",
        lambda: base + "1.5" + "-1.5" * size + " = 1",
        lambda: base + "[" + "a." * size + "a]",
        lambda: base + "a = " + "[" * size + "]" * size,
        lambda: base + "a = " + "{a = " * size + "1" + "}" * size,
        lambda: base + '[[cost]]\ntype = "control"\n' * size,
        lambda: base + '[[noise]]\ntype = "additive"\nintensity = 1.0\n' * size,
        lambda: base + '[[robot.payload]]\nframe = "tip"\nmass = 1e-9\n' * size,
        lambda: (
            base + '[[cost]]\ntype = "tracking"\n[cost.reference]\n' + "[[cost.reference.sines]]\nof = 'mcp'\n" * size
        ),
        lambda: (
            base
            + '[[cost]]\ntype = "tracking"\nreference = '
            + f"{{ times = {list(range(size))}, values = {[[0, 0, 0]] * size} }}"
        ),
        lambda: base + "[actuation]\njoints = [" + ", ".join(f'"j{k}"' for k in range(size)) + "]",
        lambda: base + "damping = {" + ", ".join(f"j{k} = 1.0" for k in range(size)) + "}",
        lambda: base + f'title = "{"x" * size}"',
        lambda: base + f'"{"k" * size}" = 1',
        lambda: base + f"[simulate]\nseed = {'9' * size}",
        lambda: base + f"[simulate]\nseed = 0x{'f' * size}",
        lambda: base + f"[solve]\nmax_iterations = 0x{'f' * size}",
        lambda: base.replace("steps = 4", f"steps = {size * 1000}") + '[[cost]]\ntype = "control"\n',
        lambda: base.replace("steps = 4", f"duration = {size}.0") + '[[cost]]\ntype = "tracking"\nreference = 1.0\n',
        lambda: base + "#" + "." * size,
        lambda: base + "\n" * size * 10,
        lambda: base + "x" * size * 10,
        lambda: "\0" * size,
        lambda: rng.randbytes(size).decode("latin-1"),
        lambda: "\ufeffa = 1",
    ]
    return rng.choice(texts)().encode(rng.choice(["utf-8", "utf-8", "utf-8", "latin-1", "utf-16"]), errors="replace")


def read(path: Path, form: str) -> str:
    """Load it and look at what it says; a short one is simulated and solved too."""
    try:
        file = vp.load_scene(path)
    except vp.VarpinError as error:
        if "\n" in str(error) or len(str(error)) > 20_000:
            raise AssertionError(f"an error of several lines, or a long one: {str(error)[:300]!r}") from None
        return type(error).__name__
    repr(file), repr(file.required), file.required.terms
    if form == "load" or file.spec.steps > 20:
        return "taken"
    uses = {"simulated": file.simulate}
    if file.spec.costs:
        uses["solved"] = functools.partial(
            file.solve, max_iterations=min(2, file.spec.options.get("max_iterations", 2))
        )
    for name, use in uses.items():
        try:
            found = use()
        except vp.VarpinError as error:
            return f"taken, not {name}: {type(error).__name__}"
        require_finite(found if name == "simulated" else found.trajectory)
        assert name == "simulated" or np.isfinite(found.cost), "a plan whose cost is not finite"
    return "taken"
