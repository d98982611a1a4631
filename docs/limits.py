"""The tables of docs/limits.md, from a record that ``varpin extremes`` wrote; MuJoCo's rows if it is installed.

varpin extremes --out extremes
python docs/limits.py extremes/extremes.json
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from varpin.extremes import TRIALS, Cell, Kind, Record, Trial
from varpin.extremes.battery import families
from varpin.extremes.checks import exact_motion
from varpin.lagrangian import lagrangian_jet
from varpin.scene import Scene

DOCUMENT = Path(__file__).resolve().parent / "limits.md"
VARIATIONAL = ("Midpoint", "Gauss")
# What MuJoCo is asked to do as well: chains that both describe alike.
SHARED = (
    "3 links, dt = 0.01 s",
    "3 links, dt = 0.05 s",
    "3 links, dt = 0.1 s",
    "3 links, dt = 0.5 s",
    "1000 rad/s, dt = 0.001 s",
    "20 links, tip 1e-06 of base",
    "20 links, tip 1e+06 of base",
    "tip of 1e-15 kg",
    "spring, h omega = 10",
    "spring, h omega = 10000",
    "gravity 1e4 m/s^2, dt = 0.01 s",
    "just enough to stand upright",
)


def main() -> None:
    """Rewrite both tables."""
    if len(sys.argv) != 2:
        raise SystemExit("usage: limits.py RECORD")
    record = Record.load(sys.argv[1])
    put("measured", list(measured(record)))
    try:
        import mujoco  # noqa: PLC0415,F401
    except ImportError:
        print("no mujoco: its table stays as it is")  # noqa: T201
    else:
        put("mujoco", list(peers(record)))


def put(name: str, lines: list[str]) -> None:
    """Replace what stands between the markers of that name."""
    begin, end = f"<!-- {name}:begin -->\n", f"<!-- {name}:end -->"
    before, rest = DOCUMENT.read_text(encoding="utf-8").split(begin)
    DOCUMENT.write_text(before + begin + "\n".join(lines) + "\n" + end + rest.split(end)[1], encoding="utf-8")


def measured(record: Record) -> Iterator[str]:
    """A row for each family: how many cells of each kind, and the worst of those that varpin says nothing of."""
    yield "| extreme | cells | accurate | degraded | refused | stopped | silent wrong | worst unsaid error | of |"
    yield "|---|---|---|---|---|---|---|---|---|"
    for family in families(record.cells):
        cells = [cell for cell in record.cells if cell.family == family]
        counts = [sum(cell.kind is kind for cell in cells) for kind in Kind]
        quiet = [cell for cell in cells if cell.kind is Kind.ACCURATE and not math.isnan(cell.error)]
        worst = max(quiet, key=lambda cell: cell.error, default=None)
        text = "| |" if worst is None else f"{worst.error:.1e} | {worst.trial}, {worst.integrator} |"
        yield f"| {family} | {len(cells)} | " + " | ".join(map(str, counts)) + f" | {text}"
    total = record.counts()
    yield f"| all | {len(record.cells)} | " + " | ".join(str(total[kind]) for kind in Kind) + " | | |"


def peers(record: Record) -> Iterator[str]:
    """A row for each shared scene: varpin's integrators, and what MuJoCo's two do and say."""
    yield "| scene | Midpoint | Gauss(4) | RungeKutta4 | MuJoCo Euler | MuJoCo RK4 |"
    yield "|---|---|---|---|---|---|"
    cells = {(cell.trial, cell.integrator): cell for cell in record.cells}
    for trial in TRIALS:
        if trial.name in SHARED:
            own = (cells.get((trial.name, name)) for name in ("Midpoint(alpha=0.5)", "Gauss(stages=4)", "RungeKutta4"))
            texts = [words(cell) for cell in own] + [in_mujoco(trial, method) for method in ("Euler", "RK4")]
            yield f"| {trial.name} | " + " | ".join(texts) + " |"


def words(cell: Cell | None) -> str:
    """A cell in words."""
    if cell is None:
        return ""
    error = "" if math.isnan(cell.error) else f" {cell.error:.0e}"
    short = f" after {cell.done} of {cell.steps}" if cell.kind is Kind.STOPPED else ""
    return f"{cell.kind.value}{error}{short}"


def in_mujoco(trial: Trial, method: str) -> str:
    """Error of MuJoCo's motion from the exact one, its warnings and resets, and its energy error."""
    import mujoco  # noqa: PLC0415

    setup = trial.build()
    scene = setup.scene
    try:
        model = mujoco.MjModel.from_xml_string(mjcf(scene, trial.dt, method))
    except ValueError as error:
        return f"refused: {str(error).splitlines()[0]}"
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = setup.q0, setup.v0
    q, v = [setup.q0.copy()], [setup.v0.copy()]
    for _ in range(trial.steps):
        mujoco.mj_step(model, data)
        q.append(data.qpos.copy())
        v.append(data.qvel.copy())
    resets = sum(int(data.warning[kind].number) for kind in range(len(data.warning)))
    exact = exact_motion(setup, trial.dt, trial.steps, trial.window)
    off = np.array(q)[exact.nodes] - exact.q
    error = np.abs(off).max() / exact.way
    nodes = np.unique(np.linspace(0, trial.steps, 200).astype(int))
    energies, kinetic = [], []
    for k in nodes:
        jet = lagrangian_jet(scene, q[k], v[k])
        kinetic.append(0.5 * v[k] @ jet.Lv)
        energies.append(v[k] @ jet.Lv - jet.L)
    off = np.abs(np.array(energies) - energies[0]).max() / max(*kinetic, np.finfo(float).tiny)
    said = f", {resets} warnings, set back to its start" if resets else ", nothing said"
    return f"{error:.0e}, energy {off:.0e}{said}"


def mjcf(scene: Scene, dt: float, method: str) -> str:
    """The chain of a scene in MuJoCo's language, with contacts and limits off."""
    bodies = ""
    for k, inertia in enumerate(list(scene.robot.model.inertias)[1:]):
        place = scene.robot.model.jointPlacements[k + 1].translation
        moments = np.diag(inertia.inertia)[[1, 1, 2]]  # a rod has none about itself, which MuJoCo refuses
        bodies += (
            f'<body pos="{numbers(place)}">'
            f'<joint axis="0 1 0" stiffness="{numbers(scene.stiffness[k])}" damping="{numbers(scene.damping[k])}"/>'
            f'<inertial pos="{numbers(inertia.lever)}" mass="{numbers(inertia.mass)}" '
            f'diaginertia="{numbers(moments)}"/>'
        )
    return (
        f'<mujoco><compiler angle="radian"/><option timestep="{numbers(dt)}" gravity="{numbers(scene.gravity)}" '
        f'integrator="{method}"><flag constraint="disable" contact="disable" limit="disable"/></option>'
        f"<worldbody>{bodies}{'</body>' * scene.robot.dof}</worldbody></mujoco>"
    )


def numbers(values: ArrayLike) -> str:
    """Numbers to the last bit, as XML takes them."""
    return " ".join(repr(float(value)) for value in np.atleast_1d(values))


if __name__ == "__main__":
    main()
