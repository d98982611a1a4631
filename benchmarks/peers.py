"""The same mechanism in other simulators: MuJoCo, Drake, trep, and DOP853, SciPy's or compiled, on Pinocchio's ``aba``.

Each takes part where it is installed (``pip install "varpin[peers]"``; trep has no release for Python 3 and has to be
ported by hand). :func:`require_same` holds every model against Pinocchio's before anybody races: mass matrix, energy
and acceleration, with gravity, dampers, springs and torques. Robots of revolute joints without armature, and no more.
"""

from __future__ import annotations

import ctypes
import importlib
import importlib.metadata
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp
from scipy.integrate._ivp import dop853_coefficients as dop853

import varpin as vp

# MuJoCo accepts no moment of inertia of zero [kg m^2]: a slender rod's own axis gets this, about which nothing turns.
LEAST_INERTIA = 1e-9


class PeerBlewUp(RuntimeError):
    """A simulator's motion is no longer finite, or it gave up."""


@dataclass(frozen=True)
class Case:
    """A motion: from (q0, v0) under torques u + swing sin(omega t), or under rows of torques.

    Attributes:
        name: For people.
        scene: Every joint actuated; of its forces peers know dampers and springs.
        q0: (n,) [rad].
        v0: (n,) [rad/s].
        u: (n,) [N m]; or (N, n), each row for duration / N.
        duration: [s].
        swing: (n,) [N m]; None for constant torques.
        omega: Of the swing [rad/s].
        friction: Level of smooth friction, of SciPy's and the compiled DOP853 alone (n,) [N m]; None for none.
        width: Its width [rad/s].
    """

    name: str
    scene: vp.Scene
    q0: np.ndarray
    v0: np.ndarray
    u: np.ndarray
    duration: float = 1.0
    swing: np.ndarray | None = None
    omega: float = 1.0
    friction: np.ndarray | None = None
    width: float = 1.0

    @property
    def rows(self) -> np.ndarray:
        """Torques by row (N, n) [N m]; a single row unless they jump."""
        return np.atleast_2d(self.u)


@dataclass(frozen=True)
class Body:
    """A link and the revolute joint that carries it, in the axes of the joint at q = 0."""

    parent: int
    placement: pin.SE3
    axis: np.ndarray
    inertia: pin.Inertia


def available(name: str) -> ModuleType | None:
    """The module, or None where it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


def version_of(module: str) -> str:
    """Of the distribution that a module came with; empty where there is none."""
    for name in importlib.metadata.packages_distributions().get(module, []):
        return importlib.metadata.version(name)
    return ""


def bodies(robot: vp.Robot) -> list[Body]:
    """The links of a robot from the base outwards; ``parent`` counts from 1, 0 being the base."""
    model, data = robot.model, robot.model.createData()
    if model.nq != model.nv or not all(
        "Revolute" in j.shortname() or "JointModelR" in j.shortname() for j in model.joints[1:]
    ):
        raise ValueError(f"{robot.name} has joints that do not turn about one axis with limits")
    if np.any(model.armature):
        raise ValueError(f"{robot.name} has armature")
    own = []
    for j in range(1, model.njoints):
        column = pin.computeJointJacobian(model, data, pin.neutral(model), j).reshape(6, -1)[3:, model.joints[j].idx_v]
        own.append(Body(int(model.parents[j]), model.jointPlacements[j], column, model.inertias[j]))
    return own


def moments_of(moments: np.ndarray) -> np.ndarray:
    """Central moments of inertia, with something in place of those of slender axes that cannot be told from it."""
    return np.where(moments <= 1e-9 * moments.max(), min(LEAST_INERTIA, 1e-3 * moments.max()), moments)


def forces(scene: vp.Scene, q: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Torques, dampers and springs (n,) [N m]."""
    return scene.actuation @ u - scene.damping * v - scene.stiffness * (q - scene.rest)


def acceleration(case: Case) -> Callable[..., np.ndarray]:
    """Forward dynamics by ``pin.aba``, a function of (q, v), the time and a row of torques; of the first at t = 0."""
    scene = case.scene
    model = scene.robot.model.copy()
    model.gravity.linear = scene.gravity
    data, still = model.createData(), np.zeros(scene.robot.dof)
    pushes, damping, stiffness, rest = case.rows @ scene.actuation.T, scene.damping, scene.stiffness, scene.rest
    swing = still if case.swing is None else case.swing
    friction = still if case.friction is None else case.friction

    def rate(q: np.ndarray, v: np.ndarray, t: float = 0.0, row: int = 0) -> np.ndarray:
        driven = pushes[row] + swing * np.sin(case.omega * t) - friction * np.tanh(v / case.width)
        return pin.aba(model, data, q, v, driven - damping * v - stiffness * (q - rest))

    return rate


# SciPy --------------------------------------------------------------------------------------------------------------


def scipy_run(case: Case, rtol: float, method: str = "DOP853") -> Callable[[], np.ndarray]:
    """A run of SciPy's integrator on ``pin.aba`` that gives the last q; it begins anew where torques jump."""
    n, aba, rows = case.scene.robot.dof, acceleration(case), len(case.rows)
    start, each = np.concatenate([case.q0, case.v0]), case.duration / len(case.rows)

    def rate(t: float, x: np.ndarray, row: int) -> np.ndarray:
        return np.concatenate([x[n:], aba(x[:n], x[n:], t, row)])

    def run() -> np.ndarray:
        x = start
        for row in range(rows):
            span = row * each, (row + 1) * each
            solution = solve_ivp(rate, span, x, method=method, rtol=rtol, atol=rtol, args=(row,))
            if not solution.success:
                raise PeerBlewUp(solution.message)
            x = solution.y[:, -1]
        return x[:n]

    return run


# Compiled DOP853 ----------------------------------------------------------------------------------------------------


@cache
def _dop853_library() -> ctypes.CDLL | None:
    """dop853.cpp, compiled against the headers of the ``pin`` wheel; None without a compiler or Eigen's headers.

    It takes two minutes, once a process.
    """
    headers = Path(pin.__file__).parents[4] / "include"
    eigen, compiler = headers / "eigen3", shutil.which("c++")
    if compiler is None or not eigen.is_dir():
        return None
    # As Pinocchio's own pkg-config file has them.
    defines = ("-DBOOST_MPL_LIMIT_LIST_SIZE=30", "-DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS")
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "dop853.so"
        source = Path(__file__).with_name("dop853.cpp")
        options = ("-w", "-std=c++17", "-O3", "-DNDEBUG", *defines, f"-I{headers}", f"-I{eigen}", "-shared", "-fPIC")
        subprocess.run([compiler, *options, str(source), "-o", str(library)], check=True)
        loaded = ctypes.CDLL(str(library))
    loaded.varpin_problem.restype = ctypes.c_void_p
    loaded.varpin_integrate.restype = ctypes.c_long
    return loaded


def _pointer(values: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(values.ctypes.data)


def compiled_run(case: Case, tolerance: float) -> Callable[[], np.ndarray] | None:
    """A run of DOP853 in C++ on Pinocchio's ``aba`` that gives the last q; None where it cannot be compiled."""
    library = _dop853_library()
    if library is None:
        return None
    scene, own = case.scene, bodies(case.scene.robot)
    parents = np.array([body.parent for body in own], dtype=np.intc)
    placements = np.array([np.append(body.placement.rotation.ravel(), body.placement.translation) for body in own])
    axes = np.array([body.axis for body in own], dtype=float)
    inertias = np.array([body.inertia.toDynamicParameters() for body in own])
    still = np.zeros(len(own))
    swing, friction = (still if x is None else x for x in (case.swing, case.friction))
    forces = np.array([still, scene.damping, scene.stiffness, scene.rest, swing, friction])
    arrays = [np.ascontiguousarray(a) for a in (parents, placements, axes, inertias, scene.gravity, forces)]
    shape = ctypes.c_double(case.omega), ctypes.c_double(case.width)
    # Never freed: it lives as long as the process.
    problem = ctypes.c_void_p(library.varpin_problem(len(own), *map(_pointer, arrays), *shape))
    pushes = np.ascontiguousarray(case.rows @ scene.actuation.T)
    each = case.duration / len(pushes)
    coefficients = [np.ascontiguousarray(a) for a in (dop853.A[:12, :12], dop853.B, dop853.E3, dop853.E5)]
    start = np.concatenate([case.q0, case.v0])

    def run() -> np.ndarray:
        x, asked = start.copy(), ctypes.c_double(tolerance)
        tables = [_pointer(table) for table in coefficients]
        for row, push in enumerate(pushes):
            begin, end = ctypes.c_double(row * each), ctypes.c_double((row + 1) * each)
            if library.varpin_integrate(problem, _pointer(x), _pointer(push), begin, end, asked, *tables) < 0:
                raise PeerBlewUp("the step of DOP853 vanishes")
        return x[: len(own)]

    return run


# MuJoCo -------------------------------------------------------------------------------------------------------------


Servos = tuple[np.ndarray, np.ndarray, np.ndarray]


def mujoco_model(
    scene: vp.Scene,
    dt: float,
    integrator: str = "Euler",
    *,
    energy: bool = False,
    actuators: Literal["motors"] | Servos | None = None,
) -> Any:
    """A scene as a mujoco.MjModel, or None without MuJoCo.

    ``actuators`` are a motor for every joint, or position actuators instead of its springs and dampers: stiffness and
    damping (n,); what they swing from is not the model's.
    """
    mujoco = available("mujoco")
    if mujoco is None:
        return None
    own = bodies(scene.robot)
    servos = actuators if isinstance(actuators, tuple) else None
    damping, stiffness = (scene.damping, scene.stiffness) if servos is None else np.zeros((2, len(own)))
    motors = [
        f'<motor joint="j{k}"/>'
        if servos is None
        else f'<position joint="j{k}" kp="{float(servos[0][k])!r}" kv="{float(servos[1][k])!r}"/>'
        for k in range(len(own) if actuators else 0)
    ]
    texts: list[str] = []
    for k, body in enumerate(own):
        moments, axes = np.linalg.eigh(body.inertia.inertia)
        axes[:, 2] *= np.sign(np.linalg.det(axes))
        texts.append(
            f'<body name="b{k}" pos="{_row(body.placement.translation)}" quat="{_quaternion(body.placement.rotation)}">'
            f'<joint name="j{k}" type="hinge" axis="{_row(body.axis)}" damping="{float(damping[k])!r}"'
            f' stiffness="{float(stiffness[k])!r}" springref="{float(scene.rest[k])!r}"/>'
            f'<inertial pos="{_row(body.inertia.lever)}" quat="{_quaternion(axes)}" mass="{float(body.inertia.mass)!r}"'
            f' diaginertia="{_row(moments_of(moments))}"/>'
        )

    def tree(parent: int) -> str:
        return "".join(f"{texts[k]}{tree(k + 1)}</body>" for k, body in enumerate(own) if body.parent == parent)

    model = mujoco.MjModel.from_xml_string(
        '<mujoco><compiler angle="radian" boundinertia="0" balanceinertia="true"/>'
        f'<option timestep="{dt!r}" integrator="{integrator}" gravity="{_row(scene.gravity)}">'
        '<flag contact="disable" constraint="disable"/></option>'
        f"<worldbody>{tree(0)}</worldbody><actuator>{''.join(motors)}</actuator></mujoco>"
    )
    if energy:
        model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    return model


def mujoco_run(case: Case, dt: float, integrator: str) -> Callable[[], np.ndarray] | None:
    """A run that gives the last q, its loop over the steps in MuJoCo; None without it."""
    mujoco = available("mujoco")
    if mujoco is None:
        return None
    model = mujoco_model(case.scene, dt, integrator)
    data, steps = mujoco.MjData(model), round(case.duration / dt)
    # Else every one of them goes to the terminal and into a file of MuJoCo's own.
    mujoco.set_mju_user_warning(lambda _: None)

    def run() -> np.ndarray:
        _mujoco_start(mujoco, model, data, case)
        mujoco.mj_step(model, data, nstep=steps)
        # MuJoCo resets a motion that has become too fast, and counts that as a warning.
        if data.warning.number.any() or not np.isfinite(data.qpos).all():
            raise PeerBlewUp("MuJoCo warns of an unstable motion")
        return data.qpos.copy()

    return run


def mujoco_driven_run(
    case: Case, dt: float, integrator: str, servos: Servos | None = None
) -> Callable[[], np.ndarray] | None:
    """A run under torques that change in time, or under position servos, that gives the last q; None without MuJoCo.

    A control is held over a step: a row's as it is, a swing's from the step's middle. ``servos`` are stiffness, damping
    and where the goals swing from, each (n,); the swing is then the goals' [rad] and the case's own springs and dampers
    stand for the servos, which are MuJoCo's position actuators instead.
    """
    mujoco = available("mujoco")
    if mujoco is None or case.friction is not None:
        return None
    scene, n, steps = case.scene, case.scene.robot.dof, round(case.duration / dt)
    model = mujoco_model(scene, dt, integrator, actuators=servos or "motors")
    t = (np.arange(steps) + 0.5) * dt
    swing = np.zeros(n) if case.swing is None else case.swing
    pushes = case.rows @ scene.actuation.T if servos is None else servos[2][None]
    swing = swing if servos is None else swing / servos[0]
    rows = np.minimum((t / (case.duration / len(pushes))).astype(int), len(pushes) - 1)
    controls = (pushes[rows] + np.sin(case.omega * t)[:, None] * swing)[None]
    data, whole = mujoco.MjData(model), int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
    data.qpos[:], data.qvel[:] = case.q0, case.v0
    start = np.empty((1, mujoco.mj_stateSize(model, whole)))
    mujoco.mj_getState(model, data, start[0], whole)
    rollout = importlib.import_module("mujoco.rollout").rollout
    mujoco.set_mju_user_warning(lambda _: None)

    def run() -> np.ndarray:
        states, _ = rollout([model], [data], start, controls)
        if not np.isfinite(states).all() or np.abs(states[0, -1]).max() > 1e10:
            raise PeerBlewUp("MuJoCo's motion is not finite")
        return states[0, -1, 1 : 1 + n].copy()

    return run


def mujoco_energies(case: Case, dt: float, integrator: str) -> np.ndarray | None:
    """Total energy [J] at every node (N + 1,); None without MuJoCo."""
    mujoco = available("mujoco")
    if mujoco is None:
        return None
    model = mujoco_model(case.scene, dt, integrator, energy=True)
    data, steps = mujoco.MjData(model), round(case.duration / dt)
    _mujoco_start(mujoco, model, data, case)
    energy = np.empty(steps + 1)
    # The energy in ``data`` after a step is that of its last stage: at the node it has to be asked for.
    for k in range(steps + 1):
        mujoco.mj_forward(model, data)
        energy[k] = data.energy.sum()
        mujoco.mj_step(model, data)
    return energy


def _mujoco_start(mujoco: ModuleType, model: Any, data: Any, case: Case) -> None:
    mujoco.mj_resetData(model, data)
    data.qpos[:], data.qvel[:] = case.q0, case.v0
    data.qfrc_applied[:] = case.scene.actuation @ case.rows[0]


# Drake --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DrakeModel:
    """A scene as a MultibodyPlant."""

    plant: Any
    case: Case

    def context(self, q: np.ndarray, v: np.ndarray) -> Any:
        """A context at (q, v) under the case's torques."""
        context = self.plant.CreateDefaultContext()
        self.plant.SetPositions(context, q)
        self.plant.SetVelocities(context, v)
        self.plant.get_actuation_input_port().FixValue(context, self.case.scene.actuation @ self.case.u)
        return context

    def energy(self, context: Any) -> float:
        """Total energy [J]."""
        return float(self.plant.CalcPotentialEnergy(context) + self.plant.CalcKineticEnergy(context))

    def simulator(self, scheme: str | None, accuracy: float) -> Any:
        """At the case's initial state; a plant in discrete steps has no scheme."""
        analysis = importlib.import_module("pydrake.systems.analysis")
        simulator = analysis.Simulator(self.plant, self.context(self.case.q0, self.case.v0))
        if scheme is not None:
            integrator = analysis.ResetIntegratorFromFlags(simulator, scheme, 0.1)
            integrator.set_target_accuracy(accuracy)
        simulator.Initialize()
        return simulator


def drake_model(case: Case, dt: float = 0.0) -> DrakeModel | None:
    """A case in Drake, continuous or in steps of ``dt`` [s]; None without it."""
    if available("pydrake.multibody.plant") is None:
        return None
    rigid = importlib.import_module("pydrake.math")
    tree = importlib.import_module("pydrake.multibody.tree")
    plant = importlib.import_module("pydrake.multibody.plant").MultibodyPlant(dt)
    scene = case.scene
    links = [plant.world_body()]
    for k, body in enumerate(bodies(scene.robot)):
        I = body.inertia.inertia  # noqa: E741
        about = tree.RotationalInertia(I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2])
        inertia = tree.SpatialInertia.MakeFromCentralInertia(body.inertia.mass, body.inertia.lever, about)
        link = plant.AddRigidBody(f"b{k}", inertia)
        pose = rigid.RigidTransform(rigid.RotationMatrix(body.placement.rotation), body.placement.translation)
        frame = plant.AddFrame(tree.FixedOffsetFrame(f"f{k}", links[body.parent].body_frame(), pose))
        joint = tree.RevoluteJoint(f"j{k}", frame, link.body_frame(), body.axis, float(scene.damping[k]))
        joint = plant.AddJoint(joint)
        plant.AddJointActuator(f"a{k}", joint)
        if scene.stiffness[k] > 0.0:
            plant.AddForceElement(tree.RevoluteSpring(joint, float(scene.rest[k]), float(scene.stiffness[k])))
        links.append(link)
    plant.mutable_gravity_field().set_gravity_vector(scene.gravity)
    plant.Finalize()
    return DrakeModel(plant, case)


def drake_run(case: Case, accuracy: float, scheme: str = "runge_kutta3") -> Callable[[], np.ndarray] | None:
    """A run that gives the last q; None without Drake."""
    own = drake_model(case)
    if own is None:
        return None
    simulator = own.simulator(scheme, accuracy)

    def run() -> np.ndarray:
        context = simulator.get_mutable_context()
        context.SetTime(0.0)
        own.plant.SetPositions(context, case.q0)
        own.plant.SetVelocities(context, case.v0)
        simulator.Initialize()
        try:
            simulator.AdvanceTo(case.duration)
        except RuntimeError as error:
            raise PeerBlewUp(str(error)) from None
        return own.plant.GetPositions(context).copy()

    return run


def drake_energies(case: Case, accuracy: float, every: float, scheme: str = "runge_kutta3") -> np.ndarray | None:
    """Total energy [J] every so many seconds; None without Drake."""
    own = drake_model(case)
    if own is None:
        return None
    simulator = own.simulator(scheme, accuracy)
    context = simulator.get_context()
    energy = [own.energy(context)]
    for k in range(1, round(case.duration / every) + 1):
        simulator.AdvanceTo(k * every)
        energy.append(own.energy(context))
    return np.array(energy)


# trep ---------------------------------------------------------------------------------------------------------------


def trep_system(scene: vp.Scene) -> Any:
    """A scene of links about parallel y axes as a trep.System, or None without trep."""
    trep = available("trep")
    if trep is None:
        return None
    own = bodies(scene.robot)
    if any((body.axis != [0.0, 1.0, 0.0]).any() or (body.placement.rotation != np.eye(3)).any() for body in own):
        raise ValueError(f"{scene.robot.name} has joints that do not turn about y")

    def frames(parent: int) -> list[Any]:
        found: list[Any] = []
        for k, body in enumerate(own):
            if body.parent != parent:
                continue
            moments = moments_of(np.diag(body.inertia.inertia))
            mass = trep.const_txyz(body.inertia.lever, name=f"m{k}", mass=(body.inertia.mass, *moments))
            joint = [trep.ry(f"q{k}"), [mass, *frames(k + 1)]]
            found += [trep.const_txyz(body.placement.translation, name=f"j{k}"), joint]
        return found

    system = trep.System()
    system.import_frames(frames(0))
    trep.potentials.Gravity(system, tuple(scene.gravity))
    for k in np.flatnonzero(scene.stiffness):
        trep.potentials.ConfigSpring(system, f"q{k}", float(scene.stiffness[k]), float(scene.rest[k]))
    for k in np.flatnonzero(scene.damping):
        trep.forces.Damping(system, 0.0, {f"q{k}": float(scene.damping[k])})
    return system


def trep_run(case: Case, dt: float) -> Callable[[], np.ndarray] | None:
    """A run of trep's midpoint integrator that gives the last q, without torques; None without trep."""
    trep, system = available("trep"), trep_system(case.scene)
    if trep is None:
        return None
    steps, p0 = round(case.duration / dt), vp.lagrangian_jet(case.scene, case.q0, case.v0).Lv

    def run() -> np.ndarray:
        integrator = trep.MidpointVI(system)
        integrator.initialize_from_state(0.0, case.q0, p0)
        for k in range(1, steps + 1):
            integrator.step(k * dt)
        return np.array(integrator.q2)

    return run


# Whole motions ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Motion:
    """What a simulator makes of a case, as far as it goes.

    Attributes:
        q: At every node (K + 1, n) [rad].
        v: (K + 1, n) [rad/s].
        said: What it says of it, or does to it; empty if nothing.
    """

    q: np.ndarray
    v: np.ndarray
    said: str = ""


def mujoco_motion(case: Case, dt: float, integrator: str) -> Motion | None:
    """A motion by MuJoCo, with what it sets back on the way; None without MuJoCo.

    Where a position, a velocity or an acceleration is not finite or above 1e10, MuJoCo sets the whole state back to the
    model's, which is q = 0 at rest at t = 0, and goes on. It counts that as a warning; other warnings change nothing.

    Raises:
        RuntimeError: What it calls a reset is none.
    """
    mujoco = available("mujoco")
    if mujoco is None:
        return None
    model = mujoco_model(case.scene, dt, integrator)
    data, steps = mujoco.MjData(model), round(case.duration / dt)
    mujoco.set_mju_user_warning(lambda _: None)
    fresh = mujoco.MjData(model)
    mujoco.mj_step(model, fresh)
    _mujoco_start(mujoco, model, data, case)
    q, v, resets, others = [data.qpos.copy()], [data.qvel.copy()], [], set()
    bad = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{what}")) for what in ("QPOS", "QVEL", "QACC")]
    for k in range(1, steps + 1):
        # A reset clears every count but its own, which is 1 however many there were before.
        for kind in bad:
            data.warning[kind].number = 0
        mujoco.mj_step(model, data)
        counted = data.warning.number
        others |= {mujoco.mjtWarning(int(kind)).name for kind in np.flatnonzero(counted) if kind not in bad}
        if counted[bad].any():
            back = np.array_equal(data.qpos, fresh.qpos) and np.array_equal(data.qvel, fresh.qvel)
            if not (back and data.time == fresh.time):
                raise RuntimeError(f"MuJoCo warns in step {k} of what it sets back, and does not set it back")
            resets.append(k * dt)
        q.append(data.qpos.copy())
        v.append(data.qvel.copy())
    said = [f"set back to q = 0 {_often(len(resets))}, first after {resets[0]:.3g} s"] if resets else []
    said += [f"warns of {name}" for name in sorted(others)]
    return Motion(np.array(q), np.array(v), "; ".join(said))


def _often(times: int) -> str:
    return "once" if times == 1 else f"{times} times"


def drake_motion(case: Case, dt: float, scheme: str | None = None, patience: float = 10.0) -> Motion | None:
    """A motion by Drake, in discrete steps or by one of its error-controlled schemes at the default 1e-4.

    None without Drake; given up where it takes longer than ``patience`` [s].
    """
    own = drake_model(case, dt if scheme is None else 0.0)
    if own is None:
        return None
    q, v, begin = [case.q0], [case.v0], time.process_time()
    simulator = own.simulator(scheme, 1e-4)
    context = simulator.get_context()
    status = importlib.import_module("pydrake.systems.framework").EventStatus
    late = status.ReachedTermination(own.plant, "out of patience")
    simulator.set_monitor(lambda _: late if time.process_time() - begin > patience else status.DidNothing())
    said = ""
    for k in range(1, round(case.duration / dt) + 1):
        try:
            simulator.AdvanceTo(k * dt)
        except RuntimeError as error:
            said = f"gives up after {(k - 1) * dt:.3g} s: {str(error).splitlines()[0]}"
            break
        if time.process_time() - begin > patience:
            said = f"gives up after {(k - 1) * dt:.3g} s: its steps are too small to go on for {patience:g} s"
            break
        q.append(own.plant.GetPositions(context).copy())
        v.append(own.plant.GetVelocities(context).copy())
    return Motion(np.array(q), np.array(v), said)


def trep_motion(case: Case, dt: float) -> Motion | None:
    """A motion by trep's midpoint integrator, without torques; None without trep."""
    trep, system = available("trep"), trep_system(case.scene)
    if trep is None:
        return None
    q, v, said = [case.q0], [case.v0], ""
    integrator = trep.MidpointVI(system)
    integrator.initialize_from_state(0.0, case.q0, vp.lagrangian_jet(case.scene, case.q0, case.v0).Lv)
    for k in range(1, round(case.duration / dt) + 1):
        try:
            integrator.step(k * dt)
        except (trep.ConvergenceError, ArithmeticError, ValueError) as error:
            said = f"gives up after {(k - 1) * dt:.3g} s: {type(error).__name__}"
            break
        q.append(np.array(integrator.q2))
        mass = vp.lagrangian_jet(case.scene, q[-1], np.zeros_like(q[-1])).Lvv
        v.append(np.linalg.solve(mass, np.array(integrator.p2)))
    return Motion(np.array(q), np.array(v), said)


# The same mechanism? ------------------------------------------------------------------------------------------------


def require_same(case: Case, states: int = 5, tolerance: float = 1e-9) -> list[str]:
    """Raise unless every peer has the case's mass matrix, energy and acceleration; their names."""
    scene, aba = case.scene, acceleration(case)
    rng = np.random.default_rng(0)
    points = rng.uniform(-2.0, 2.0, (states, 2, scene.robot.dof))
    jets = [vp.lagrangian_jet(scene, q, v) for q, v in points]
    want = {
        "mass matrix": [jet.Lvv for jet in jets],
        "energy": np.array([v @ jet.Lv - jet.L for (_, v), jet in zip(points, jets, strict=True)]),
        "acceleration": [aba(q, v) for q, v in points],
    }
    # Potentials count from zeros of their own.
    want["energy"] -= want["energy"][0]
    found = {"pin.aba": want} | dict(_peers_at(case, points))
    for name, own in found.items():
        own["energy"] = own["energy"] - own["energy"][0]
        for quantity, values in own.items():
            scale = max(1.0, float(np.abs(want[quantity]).max()))
            off = float(np.abs(np.subtract(values, want[quantity])).max()) / scale
            if not off <= tolerance:
                raise RuntimeError(
                    f"{name} is not the same mechanism as {case.name}: its {quantity} is off by {off:.1e}"
                )
    return list(found)


def _peers_at(case: Case, points: np.ndarray) -> Iterator[tuple[str, dict[str, Any]]]:
    n = case.scene.robot.dof
    mujoco = available("mujoco")
    if mujoco is not None:
        model = mujoco_model(case.scene, 1e-3, energy=True)
        data, M = mujoco.MjData(model), np.zeros((n, n))
        own: dict[str, Any] = {"mass matrix": [], "energy": [], "acceleration": []}
        for q, v in points:
            _mujoco_start(mujoco, model, data, case)
            data.qpos[:], data.qvel[:] = q, v
            mujoco.mj_forward(model, data)
            for j, unit in enumerate(np.eye(n)):
                mujoco.mj_mulM(model, data, M[j], unit)
            for name, value in zip(own, (M.copy(), data.energy.sum(), data.qacc.copy()), strict=True):
                own[name].append(value)
        yield "MuJoCo", own | {"energy": np.array(own["energy"])}
    drake = drake_model(case)
    if drake is not None:
        contexts = [drake.context(q, v) for q, v in points]
        yield (
            "Drake",
            {
                "mass matrix": [drake.plant.CalcMassMatrix(context) for context in contexts],
                "energy": np.array([drake.energy(context) for context in contexts]),
                "acceleration": [
                    drake.plant.EvalTimeDerivatives(context).get_generalized_velocity().CopyToVector()
                    for context in contexts
                ],
            },
        )


def _row(values: Any) -> str:
    return " ".join(repr(float(value)) for value in values)


def _quaternion(rotation: np.ndarray) -> str:
    q = pin.Quaternion(rotation).normalized()
    return _row((q.w, q.x, q.y, q.z))
