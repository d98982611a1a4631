"""Write a robot and its surroundings as a C++ header: ``python arm.py arm.hpp``.

The numbers are hexadecimal, so that C++ has the very bytes that Python has. Robot and scene are set in ``scene`` below;
a URDF of your own is ``varpin.load_robot("arm.urdf")``.
"""

import sys
from pathlib import Path

import numpy as np

import varpin as vp

HEADER = """// Written by arm.py: {robot}.
#pragma once

#include <cmath>
#include <vector>

#include "varpin/mechanism.hpp"

inline varpin::Mechanism arm() {{
    varpin::Mechanism out;
    out.tree.bodies = {{
{bodies}
    }};
    out.tree.armature = {armature};
    out.tree.periodic = {periodic};
    out.tree.group = {group};
    out.tree.groups = {groups};
    out.tree.blocks = {blocks};
    out.tree.light_parts = {light_parts};
    out.gravity = {gravity};
    out.forces = varpin::Forces(std::vector<varpin::Element>{forces});
    out.controls = {controls};
    out.actuation = {actuation};
    return out;
}}
"""
BODY = """        {{.parent = {parent},
         .prismatic = {prismatic},
         .rotation = {rotation},
         .translation = {translation},
         .mass = {mass},
         .center = {center},
         .inertia = {inertia},
         .coordinate = {coordinate},
         .ratio = {ratio},
         .offset = {offset},
         .origin = {origin}}},"""


def scene() -> vp.Scene:
    """The arm that the program plans for."""
    return vp.Scene(vp.load_robot("ur5"), damping=0.5)


def cpp(value: object) -> str:
    """A number or an array, as C++ has it."""
    if isinstance(value, list | tuple | np.ndarray):
        return "{" + ", ".join(cpp(item) for item in value) + "}"
    if isinstance(value, float):
        return value.hex() if np.isfinite(value) else f"{'-' if value < 0.0 else ''}HUGE_VAL"
    return str(int(value))


def elements(scene: vp.Scene) -> str:
    """The forces on single joints."""
    return "{" + ", ".join(f"varpin::{own.kind}{cpp((own.coordinate, *own.values))}" for own in scene.elements) + "}"


def header(scene: vp.Scene) -> str:
    """The header's text; noise is left out, which a controller does not simulate."""
    if scene.constraints:
        raise SystemExit("constraints are not written here: fill Mechanism::constraints by hand")
    if scene.couplings:
        raise SystemExit("forces on frames are not written here: fill Mechanism::couplings by hand, as tests/cpp does")
    tree = scene.robot.tree
    named = ("parent", "mass", "center", "inertia", "coordinate", "ratio", "offset", "translation")
    bodies = [
        BODY.format(
            # Matrices are columns there.
            rotation=cpp(tree.rotation[j].T),
            prismatic="true" if tree.prismatic[j] else "false",
            origin="true" if tree.origin[j] else "false",
            **{name: cpp(getattr(tree, name)[j]) for name in named},
        )
        for j in range(len(tree.parent))
    ]
    begins = [0, *tree.ends[:-1]]
    fields = {name: cpp(getattr(tree, name)) for name in ("periodic", "group", "groups")}
    fields |= {name: cpp(getattr(scene, name)) for name in ("armature", "gravity", "controls")}
    return HEADER.format(
        robot=scene.robot.name,
        bodies="\n".join(bodies),
        blocks=cpp(list(zip(begins, tree.ends, strict=True))),
        forces=elements(scene),
        light_parts=cpp(list(zip(tree.loads, tree.carried, strict=True))),
        actuation=cpp([(r, c, scene.actuation[r, c]) for r, c in np.argwhere(scene.actuation)]),
        **fields,
    )


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(header(scene()), encoding="utf-8")
