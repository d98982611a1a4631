"""Robot descriptions that are odd or damaged: refused in words, or read as Pinocchio reads them."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from mechanisms import INERTIAL, joint, link, random_tree, write_urdf
from refusals import refused

import varpin as vp


class TestUrdf:
    def test_entities_that_expand_without_bound(self, tmp_path):
        laughs = "".join(f'<!ENTITY e{k} "{f"&e{k - 1};" * 10}">' for k in range(1, 12))
        path = tmp_path / "a.urdf"
        path.write_text(f'<!DOCTYPE robot [<!ENTITY e0 "ha">{laughs}]><robot name="a"><link name="&e11;"/></robot>')
        with pytest.raises(vp.RobotError):
            vp.load_robot(path)

    def test_masses_beyond_floating_point(self, tmp_path):
        heavy = INERTIAL.replace('ixx="0.02"', 'ixx="1e308"').replace('iyy="0.03"', 'iyy="1e308"')
        path = write_urdf(
            tmp_path, link("l1", heavy), link("l2", heavy), joint("j1", "base", "l1"), joint("j2", "l1", "l2")
        )
        with refused(vp.RobotError, "'made_up'", "finite"):
            vp.load_robot(path)
        with refused(vp.RobotError, "finite"):
            vp.inspect_robot(path)

    @pytest.mark.parametrize("axis", ["1e-200 0 0", "0 1e-320 0"])
    def test_axes_beyond_floating_point(self, tmp_path, axis):
        # What is not normalised moves other inertia in Pinocchio than in varpin, whose rotations were NaN.
        path = write_urdf(
            tmp_path, link("l1"), link("l2"), joint("j1", "base", "l1"), joint("j2", "l1", "l2", axis=axis)
        )
        with refused(vp.RobotError, "'j2'", "axis"):
            vp.load_robot(path)


class TestModels:
    @pytest.mark.parametrize(
        ("change", "facts"),
        [
            (lambda model: model.parents.__setitem__(2, 77), "parent"),
            (lambda model: setattr(model, "armature", np.zeros(1)), ("armature", "1", "3")),
            (lambda model: setattr(model, "lowerPositionLimit", np.zeros(9)), ("lowerPositionLimit", "9")),
            (lambda model: model.names.append("more"), ("names", "5", "4")),
            (lambda model: model.inertias.append(pin.Inertia.Zero()), ("inertias", "5")),
            (lambda model: setattr(model.frames[1], "parentJoint", 99), "frame"),
        ],
    )
    def test_whose_parts_do_not_fit(self, change, facts):
        model = random_tree(0, 3, branching=False)
        model.addFrame(pin.Frame("tool", 1, 0, pin.SE3.Identity(), pin.FrameType.OP_FRAME))
        while any(joint.nq != 1 for joint in list(model.joints)[1:]):
            model = random_tree(int(model.name[4:]) + 1, 3, branching=False)
            model.addFrame(pin.Frame("tool", 1, 0, pin.SE3.Identity(), pin.FrameType.OP_FRAME))
        change(model)
        with refused(vp.RobotError, facts):
            vp.load_robot(model)
