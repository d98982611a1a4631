"""Steps under constraints: what one costs beside a step without, and what stays closed, beside MuJoCo's equalities.

python benchmarks/constraints.py          # both tables, some 20 s; needs ``pip install mujoco``
"""

from __future__ import annotations

import time

import mujoco
import numpy as np
from timing import in_turns

import varpin as vp
from varpin.mechanics.assembly import along_constraints

GROUND = (1.3, 0.0, 0.2)
BODY = """<body name="l{k}" pos="{x} 0 0"><joint name="joint{k}" axis="0 1 0"/>
<inertial pos="0.5 0 0" mass="1" diaginertia="1e-12 0.08333333333333333 0.08333333333333333"/>{inner}</body>"""


def four_bar() -> tuple[vp.Scene, np.ndarray, np.ndarray]:
    """A loop of three links of 1 m and the ground, and a state in it."""
    scene = vp.Scene(vp.planar_chain(3), constraints=vp.PointOnPoint("tip", GROUND, axes="xz"))
    q = vp.assemble(scene, [-1.5, 1.5, 1.5])
    return scene, q, along_constraints(scene, q, np.array([1.0, 0.0, 0.0]))


def microseconds(scene: vp.Scene, q: np.ndarray, v: np.ndarray, integrator: vp.Midpoint | vp.Gauss) -> float:
    """Of a step, the fastest of seven runs, in time of the processor: other programs count little."""
    steps = 2000
    run = lambda: vp.simulate(scene, q, v, dt=1e-3, steps=steps, integrator=integrator, check=False)  # noqa: E731
    return 1e6 * in_turns({"": run}, 7, time.process_time)[""].min() / steps


def costs() -> None:
    """Steps with and without the loop."""
    scene, q, v = four_bar()
    free = vp.Scene(scene.robot)
    print("| integrator | with the loop [us] | the same tree without [us] | ratio |\n|---|---|---|---|")
    for integrator in (vp.Midpoint(), vp.Gauss(2), vp.Gauss(3)):
        closed, opened = microseconds(scene, q, v, integrator), microseconds(free, q, v, integrator)
        print(f"| {integrator} | {closed:.2f} | {opened:.2f} | {closed / opened:.2f} |")


def mujoco_chain(dt: float, method: str, stiff: bool) -> str:
    """The same four-bar as MJCF, closed by a connect: with MuJoCo's defaults, or as stiff as its manual has it go."""
    closure = f'solref="{2 * dt} 1" solimp="0.9999 0.9999 0.001"' if stiff else ""
    body = ""
    for k in (3, 2, 1):
        site = '<site name="tip" pos="1 0 0"/>' if k == 3 else ""
        body = BODY.format(k=k, x=0 if k == 1 else 1, inner=body + site)
    x, y, z = GROUND
    return f"""<mujoco><option timestep="{dt}" integrator="{method}"><flag contact="disable"/></option>
<worldbody><site name="ground" pos="{x} {y} {z}"/>{body}</worldbody>
<equality><connect site1="tip" site2="ground" {closure}/></equality></mujoco>"""


def drift(duration: float = 10.0) -> None:
    """How far the loop opens, and how the energy changes, over some seconds."""
    scene, q, v = four_bar()
    print("| method | dt [s] | loop opens by [m] | energy changes by [J] |\n|---|---|---|---|")
    for dt in (2e-3, 1e-3):
        for integrator in (vp.Midpoint(), vp.Gauss(2)):
            steps = round(duration / dt)
            motion = vp.simulate(scene, q, v, dt=dt, steps=steps, integrator=integrator, check=False)
            opened = np.abs(scene.core.constraints(motion.q)[0]).max()
            print(f"| {integrator} | {dt} | {opened:.1e} | {np.abs(motion.energy - motion.energy[0]).max():.1e} |")
        for method in ("implicitfast", "RK4"):
            for stiff in (False, True):
                opened, energy = of_mujoco(dt, method, stiff, q, v, round(duration / dt))
                name = f"MuJoCo, {method}{', stiffest' if stiff else ''}"
                print(f"| {name} | {dt} | {opened:.1e} | {energy:.1e} |")


def of_mujoco(dt: float, method: str, stiff: bool, q: np.ndarray, v: np.ndarray, steps: int) -> tuple[float, float]:
    """MuJoCo's own worst opening [m] and change of energy [J]."""
    model = mujoco.MjModel.from_xml_string(mujoco_chain(dt, method, stiff))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = q, v
    free, worst, energies = vp.Scene(vp.planar_chain(3)), 0.0, []
    for _ in range(steps):
        mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        worst = max(worst, float(np.abs(data.site_xpos[1] - data.site_xpos[0])[[0, 2]].max()))
        jet = vp.lagrangian_jet(free, data.qpos.copy(), data.qvel.copy())
        energies.append(float(jet.Lv @ data.qvel - jet.L))
    jet = vp.lagrangian_jet(free, q, v)
    return worst, float(np.abs(np.array(energies) - (jet.Lv @ v - jet.L)).max())


if __name__ == "__main__":
    costs()
    print()
    drift()
