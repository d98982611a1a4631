"""MJCF files, read by MuJoCo's own compiler: bodies, joints, equalities and geoms of its model become Pinocchio's."""

from __future__ import annotations

import enum
import logging
import warnings
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.errors import RobotError
from varpin.model.equalities import Closure, End, Equality, Gear, rounded_normal
from varpin.model.meshes import MeshPart, coal_shape
from varpin.model.packages import optional
from varpin.model.urdf import captured_stderr, read_xml

coal = pin.coal
logger = logging.getLogger(__name__)

# Arrays of MuJoCo's model that are zero unless the file has what the model leaves out. Older versions lack some.
_LEFT_OUT = {
    "body_gravcomp": "gravity compensation",
    "jnt_stiffness": "joint springs",
    "jnt_stiffnesspoly": "nonlinear joint springs",
    "dof_dampingpoly": "nonlinear joint dampers",
    "actuator_dampingpoly": "nonlinear dampers of actuators",
    "nflex": "deformable bodies",
}
# MuJoCo's viewer shows geoms of the groups up to this one. Those of later groups usually stand for others in contacts.
_SHOWN = 2
# MuJoCo's colour of geoms without one, in whose place it shows the material's.
_GREY = np.array([0.5, 0.5, 0.5, 1.0], dtype=np.float32)
# Half the thickness of the plate that shows a plane [m]: coal's planes are infinite.
_PLATE = 5e-4


def is_mjcf(path: Path) -> bool:
    """Whether a file is an MJCF by its root element; only ``.xml`` and ``.mjcf`` files are opened."""
    try:
        return path.suffix.lower() in (".xml", ".mjcf") and read_xml(path).tag in ("mujoco", "mujocoinclude")
    except RobotError:
        return False


def read_mjcf(path: Path) -> tuple[pin.Model, tuple[str, ...], tuple[Equality, ...]]:
    """Read an MJCF file.

    Returns:
        Its bodies, joints, sites, keyframes and gravity as a model; what that leaves out, in words; and the file's
        active equality constraints.
    """
    walk = _Walk(path)
    walk.add_parameters()
    equalities = walk.equalities()
    found = [f"{what} ({count})" for what, count in walk.left_out.items() if count]
    remarks = (f"the file has {', '.join(found)}, which the model leaves out",) if found else ()
    return walk.model, remarks, equalities


def mjcf_shapes(path: Path) -> tuple[pin.Model, pin.GeometryModel]:
    """The geoms of an MJCF file that MuJoCo's viewer shows, and those without contacts, on the joints of its model."""
    walk = _Walk(path)
    return walk.model, walk.shapes()


class _Walk:
    """Pinocchio's model of an MJCF file, part by part."""

    def __init__(self, path: Path) -> None:
        mujoco = optional("mujoco", f"the MJCF file {path}", "mjcf")
        try:
            with captured_stderr() as complaints, warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                # Its parser takes no other suffix.
                name = str(path.with_suffix(".xml"))
                spec = mujoco.MjSpec.from_file(name, include={name: path.read_bytes()})
                # Both keep the motion: bodies without joints have their names, geoms without contacts are drawn.
                spec.compiler.fusestatic = spec.compiler.discardvisual = False
                m = spec.compile()
                for line in (*complaints(), *(warning.message for warning in caught)):
                    logger.info("MuJoCo says of %s: %s", path, line)
        except (ValueError, mujoco.FatalError) as error:
            fault = "; ".join(str(error).replace("Error: ", "").strip().split("\n"))
            raise RobotError(f"MuJoCo cannot read {path}: {fault}") from None
        self.path, self.mujoco, self.m, self.model = path, mujoco, m, pin.Model()
        self.left_out: Counter[str] = Counter()
        self.bodies = _named((m.body(k).name for k in range(m.nbody)), "body{}".format)
        self.joints = _named(
            (m.joint(k).name for k in range(m.njnt)),
            lambda k: f"{self.bodies[m.jnt_bodyid[k]]}_joint{k - m.body_jntadr[m.jnt_bodyid[k]] or ''}",
        )
        # Of each body its joint, its placement there and its frame; of each joint its index.
        self.carriers, self.places, self.frames = [0] * m.nbody, [pin.SE3.Identity()] * m.nbody, [0] * m.nbody
        self.indices = [0] * m.njnt
        self._add_bodies()

    def _add_bodies(self) -> None:
        """Bodies with their masses, joints and sites; a body with several joints hangs on a chain of them."""
        m, model = self.m, self.model
        self.frames[0] = model.addFrame(pin.Frame("world", 0, 0, pin.SE3.Identity(), pin.FrameType.BODY))
        for body in range(1, m.nbody):
            up = m.body_parentid[body]
            carrier, frame = self.carriers[up], self.frames[up]
            place = self.places[up] * _placement(m.body_pos[body], m.body_quat[body])
            first = m.body_jntadr[body]
            for joint in range(first, first + m.body_jntnum[body]):
                kind, before, after = self._joint(joint, place)
                carrier = self.indices[joint] = model.addJoint(carrier, kind, before, self.joints[joint])
                frame, place = model.addJointFrame(carrier, frame), after
            inertia = pin.Inertia(float(m.body_mass[body]), np.zeros(3), np.diag(m.body_inertia[body]))
            model.appendBodyToJoint(carrier, inertia, place * _placement(m.body_ipos[body], m.body_iquat[body]))
            self.carriers[body], self.places[body] = carrier, place
            self.frames[body] = model.addBodyFrame(self.bodies[body], carrier, place, frame)
        for site in range(m.nsite):
            if name := m.site(site).name:
                on, place = self._on_body(m.site_bodyid[site], m.site_pos[site], m.site_quat[site])
                model.addFrame(pin.Frame(name, *on, place, pin.FrameType.OP_FRAME))

    def _on_body(self, body: int, position: Floats, quaternion: Floats) -> tuple[tuple[int, int], pin.SE3]:
        """Joint and frame of a body, and a placement in the body as one in the joint."""
        return (self.carriers[body], self.frames[body]), self.places[body] * _placement(position, quaternion)

    def _joint(self, joint: int, place: pin.SE3) -> tuple[pin.JointModel, pin.SE3, pin.SE3]:
        """A joint of a body at a place; its placement, and that of the body in it."""
        m, axis, anchor = self.m, self.m.jnt_axis[joint].copy(), _placement(self.m.jnt_pos[joint])
        # MuJoCo counts from the reference position.
        back = -float(m.qpos0[m.jnt_qposadr[joint]])
        match _word(self.mujoco.mjtJoint, m.jnt_type[joint]):
            case "FREE":
                # Its position is that of the body in the world.
                return pin.JointModelFreeFlyer(), pin.SE3.Identity(), pin.SE3.Identity()
            case "BALL":
                return pin.JointModelSpherical(), place * anchor, anchor.inverse()
            case "SLIDE":
                kind, zero = pin.JointModelPrismaticUnaligned(axis), _placement(back * axis)
            case _:
                kind, zero = pin.JointModelRevoluteUnaligned(axis), pin.SE3(pin.exp3(back * axis), np.zeros(3))
        return kind, place * anchor * zero, anchor.inverse()

    def add_parameters(self) -> None:
        """Gravity, postures, and of each joint its limits, damping, friction and armature."""
        m, model = self.m, self.model
        model.gravity.linear = np.zeros(3) if self._disabled("GRAVITY") else m.opt.gravity.copy()
        model.upperVelocityLimit[:], model.lowerVelocityLimit[:] = np.inf, -np.inf
        damping = np.zeros(m.nv) if self._disabled("DAMPER", "PASSIVE") else m.dof_damping
        friction = np.zeros(m.nv) if self._disabled("FRICTIONLOSS", "CONSTRAINT") else m.dof_frictionloss
        model.damping[:], model.armature[:] = damping, m.dof_armature
        model.upperDryFrictionLimit[:], model.lowerDryFrictionLimit[:] = friction, -friction
        order: list[int] = []
        for joint, index in enumerate(self.indices):
            kind, q = model.joints[index], int(m.jnt_qposadr[joint])
            if kind.nv > 1:
                # MuJoCo's quaternions are (w, x, y, z), Pinocchio's (x, y, z, w).
                real = q + kind.nq - 4
                order += [*range(q, real), real + 1, real + 2, real + 3, real]
                continue
            order.append(q)
            if m.jnt_limited[joint] and not self._disabled("LIMIT", "CONSTRAINT"):
                model.lowerPositionLimit[kind.idx_q], model.upperPositionLimit[kind.idx_q] = m.jnt_range[joint]
            self._add_drives(joint, kind.idx_v)
        model.referenceConfigurations["qpos0"] = m.qpos0[order]
        for key in range(m.nkey):
            if name := m.key(key).name:
                model.referenceConfigurations[name] = m.key_qpos[key][order]
        for name, what in _LEFT_OUT.items():
            self.left_out[what] += int(np.atleast_2d(np.transpose(getattr(m, name, 0))).any(axis=0).sum())
        servos = m.actuator_biastype != self.mujoco.mjtBias.mjBIAS_NONE
        self.left_out["servos of actuators"] += int(servos.sum())
        self.left_out["forces of plugins"] += int((m.body_plugin >= 0).sum())
        self.left_out["forces of a fluid"] += int(m.opt.density != 0.0 or m.opt.viscosity != 0.0)

    def _disabled(self, *names: str) -> bool:
        """Whether the file disables one of these parts of the physics; older versions lack some."""
        flags = (int(getattr(self.mujoco.mjtDisableBit, f"mjDSBL_{name}", 0)) for name in names)
        return any(int(self.m.opt.disableflags) & flag for flag in flags)

    def _add_drives(self, joint: int, v: int) -> None:
        """The largest force of all actuators of a joint together, and the inertia and damping of their rotors."""
        m, model = self.m, self.model
        limits, found = np.zeros(2), False
        for drive, (of_joint, *_) in enumerate(m.actuator_trnid):
            on = _word(self.mujoco.mjtTrn, m.actuator_trntype[drive])
            # Before version 4 actuators have one control and one force each, no inertia and no damping.
            gear = m.actuator_gear[getattr(m, "actuator_outadr", range(m.nu))[drive], 0]
            if of_joint != joint or on not in ("JOINT", "JOINTINPARENT") or not gear:
                continue
            found = True
            limits += np.sort(gear * self._force_range(drive))
            for parameter in ("armature", "damping"):
                own = getattr(m, f"actuator_{parameter}", np.zeros(m.nu))[drive]
                getattr(model, parameter)[v] += gear**2 * own
        if not found:
            limits = np.array([-np.inf, np.inf])
        if m.jnt_actfrclimited[joint]:
            limits = np.clip(limits, *m.jnt_actfrcrange[joint])
        self.left_out["smaller force limits in one direction"] += int(limits[0] != -limits[1])
        model.upperEffortLimit[v] = np.abs(limits).max()
        model.lowerEffortLimit[v] = -model.upperEffortLimit[v]

    def _force_range(self, drive: int) -> Floats:
        """Least and greatest force (2,) of an actuator, before its gear; infinite where nothing bounds it."""
        m, mujoco = self.m, self.mujoco
        if m.actuator_forcelimited[drive]:
            return np.array(m.actuator_forcerange[drive])
        is_motor = (
            m.actuator_gaintype[drive] == mujoco.mjtGain.mjGAIN_FIXED
            and m.actuator_biastype[drive] == mujoco.mjtBias.mjBIAS_NONE
            and m.actuator_dyntype[drive] == mujoco.mjtDyn.mjDYN_NONE
        )
        control = getattr(m, "actuator_ctrladr", range(m.nu))[drive]
        if is_motor and m.actuator_ctrllimited[control]:
            return np.sort(m.actuator_gainprm[drive, 0] * m.actuator_ctrlrange[control])
        return np.array([-np.inf, np.inf])

    def shapes(self) -> pin.GeometryModel:
        """The geoms that MuJoCo's viewer shows, and those without contacts."""
        m, found = self.m, pin.GeometryModel()
        for geom in range(m.ngeom):
            if m.geom_group[geom] > _SHOWN and (m.geom_contype[geom] or m.geom_conaffinity[geom]):
                continue
            body = m.geom_bodyid[geom]
            name = m.geom(geom).name or f"{self.bodies[body]}_geom{geom - m.body_geomadr[body]}"
            form = self._form(geom)
            if form is None:
                logger.info("%s: %r is an infinite plane or a height field; it is not drawn", self.path, name)
                continue
            on, place = self._on_body(body, m.geom_pos[geom], m.geom_quat[geom])
            shape = pin.GeometryObject(name, *on, place, form)
            shape.meshColor = self._color(geom)
            found.addGeometryObject(shape)
        return found

    def _form(self, geom: int) -> Any:
        """The form of a geom for coal; None for an infinite plane or a height field."""
        m, (x, y, z) = self.m, self.m.geom_size[geom].tolist()
        match _word(self.mujoco.mjtGeom, m.geom_type[geom]):
            case "SPHERE":
                return coal.Sphere(x)
            case "CAPSULE":
                return coal.Capsule(x, 2.0 * y)
            case "CYLINDER":
                return coal.Cylinder(x, 2.0 * y)
            case "ELLIPSOID":
                return coal.Ellipsoid(x, y, z)
            case "BOX":
                return coal.Box(2.0 * x, 2.0 * y, 2.0 * z)
            case "PLANE" if x > 0.0 and y > 0.0:
                return coal.Box(2.0 * x, 2.0 * y, 2.0 * _PLATE)
            case "MESH" | "SDF":
                mesh = m.mesh(m.geom_dataid[geom])
                corner, face = int(mesh.vertadr[0]), int(mesh.faceadr[0])
                vertices = m.mesh_vert[corner : corner + int(mesh.vertnum[0])].astype(float)
                faces = m.mesh_face[face : face + int(mesh.facenum[0])].astype(np.int64)
                return coal_shape([MeshPart(vertices, faces)])
        return None

    def _color(self, geom: int) -> Floats:
        """The colour of a geom (4,) as MuJoCo chooses it; for a texture its mean."""
        m, material, own = self.m, self.m.geom_matid[geom], self.m.geom_rgba[geom]
        if material < 0 or (own != _GREY).any():
            return own.astype(float)
        color = m.mat_rgba[material].astype(float)
        texture = m.mat_texid[material, self.mujoco.mjtTextureRole.mjTEXROLE_RGB]
        if texture >= 0 and m.tex_nchannel[texture] == 3:
            first, size = m.tex_adr[texture], 3 * m.tex_height[texture] * m.tex_width[texture]
            color[:3] *= m.tex_data[first : first + size].reshape(-1, 3).mean(axis=0) / 255.0
        return color

    def equalities(self) -> tuple[Equality, ...]:
        """The active equality constraints of bodies, sites and joints; the others, and tendons, count as left out."""
        m, tied = self.m, set()
        found: list[Equality] = []
        for k in range(m.neq):
            kind, first, second = _word(self.mujoco.mjtEq, m.eq_type[k]), int(m.eq_obj1id[k]), int(m.eq_obj2id[k])
            data, parts = m.eq_data[k], self._tendon(first) if kind == "TENDON" and second < 0 else []
            if not m.eq_active0[k] or self._disabled("EQUALITY", "CONSTRAINT"):
                self.left_out["inactive equality constraints"] += 1
            elif kind in ("CONNECT", "WELD"):
                found.append(self._closure(k, kind == "WELD"))
            elif kind == "JOINT":
                coefficients = data[:5] if second >= 0 else data[:1]
                name = m.eq(k).name or self.joints[first]
                found.append(self._gear(f"<joint> {name!r}", first, second, coefficients))
            elif len(parts) == 2:
                (joint, weight), (leader, other) = parts
                name = m.eq(k).name or m.tendon(first).name
                found.append(self._gear(f"<tendon> {name!r}", joint, leader, np.array([data[0], -other]) / weight))
                tied.add(first)
            else:
                self.left_out[f"equality constraints of kind {kind.lower()}"] += 1
        forces = m.tendon_stiffness, m.tendon_damping, m.tendon_frictionloss, m.tendon_limited
        acting = {k for k in tied if any(np.any(each[k]) for each in forces)}
        self.left_out["tendons"] += m.ntendon - len(tied - acting)
        return tuple(found)

    def _tendon(self, tendon: int) -> list[tuple[int, float]]:
        """The joints of a fixed tendon and their coefficients; none of another tendon."""
        m, first = self.m, self.m.tendon_adr[tendon]
        own = range(first, first + m.tendon_num[tendon])
        fixed = all(_word(self.mujoco.mjtWrap, m.wrap_type[k]) == "JOINT" and m.wrap_prm[k] for k in own)
        return [(int(m.wrap_objid[k]), float(m.wrap_prm[k])) for k in own] if fixed else []

    def _gear(self, name: str, joint: int, leader: int, coefficients: Floats) -> Gear:
        """The tie of a joint to a leader, -1 for none, by a polynomial from the reference positions of both."""
        rest = self.m.qpos0[self.m.jnt_qposadr]
        follows = np.polynomial.Polynomial(coefficients).trim()
        if leader >= 0:
            follows = follows(np.polynomial.Polynomial([-rest[leader], 1.0]))
        whole = tuple((follows + rest[joint]).coef.tolist())
        return Gear(name, self.joints[joint], self.joints[leader] if leader >= 0 else None, whole)

    def _closure(self, k: int, weld: bool) -> Closure:
        """A ``<connect>`` or a ``<weld>``, with its places on the two bodies."""
        m, data = self.m, self.m.eq_data[k]
        ids, turns = [int(m.eq_obj1id[k]), int(m.eq_obj2id[k])], weld and bool(data[10])
        if m.eq_objtype[k] == self.mujoco.mjtObj.mjOBJ_SITE:
            name, bodies = m.site(ids[0]).name, [int(m.site_bodyid[site]) for site in ids]
            places = [_placement(m.site_pos[site], m.site_quat[site]) for site in ids]
        else:
            name, bodies = self.bodies[ids[0]], ids
            here, there = ((data[3:6], data[6:10]), (data[:3],)) if weld else ((data[:3],), (data[3:6],))
            places = [_placement(*here), _placement(*there)]
        a, b = (End(self.bodies[body], place) for body, place in zip(bodies, places, strict=True))
        carried = [(self.carriers[body], self.places[body] * place) for body, place in zip(bodies, places, strict=True)]
        normal = None if turns else rounded_normal(self.model, *carried)
        return Closure(f"<{'weld' if weld else 'connect'}> {m.eq(k).name or name!r}", a, b, turns, normal)


def _named(names: Iterable[str], new: Callable[[int], str]) -> list[str]:
    """The names of all things of a kind; things without one are named by their number."""
    found = list(names)
    for k, name in enumerate(found):
        if not name:
            fresh = new(k)
            while fresh in found:
                fresh += "_"
            found[k] = fresh
    return found


def _word(kinds: type[enum.Enum], value: int) -> str:
    """The last word of a constant of MuJoCo's: ``"HINGE"`` of ``mjJNT_HINGE``."""
    return str(kinds(value).name).rpartition("_")[2]


def _placement(position: ArrayLike, quaternion: ArrayLike = (1.0, 0.0, 0.0, 0.0)) -> pin.SE3:
    """A placement from a position (3,) and MuJoCo's quaternion (w, x, y, z)."""
    w, x, y, z = np.asarray(quaternion, dtype=float)
    return pin.SE3(pin.Quaternion(w, x, y, z).matrix(), np.asarray(position, dtype=float))
