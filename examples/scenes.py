"""Solve the scenes that come with varpin, or those named on the command line, and replay each."""

import sys
from pathlib import Path

import varpin as vp
from varpin.io.scenefile import scenes

out = Path("out")
out.mkdir(exist_ok=True)

for name in sys.argv[1:] or scenes():
    scene = vp.load_scene(name)
    plan = scene.solve()
    print(f"{name}: {scene.robot.dof} of {scene.required.described} joints, cost {plan.cost:.4g}, {plan.status.value}")
    plan.save(out / f"{name}.npz")
    marks = scene.marks()  # targets, references and traces of what the cost is about
    print(
        vp.replay(
            scene.robot, plan.trajectory, html=out / f"{name}.html", speed=scene.outputs.get("speed", 1.0), marks=marks
        )
    )
