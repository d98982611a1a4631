"""A Kinova opens a door that a spring closes: a spring joins its hand to the handle, servos lead it along its path."""

from pathlib import Path

import coal
import matplotlib.pyplot as plt
import numpy as np
import pinocchio as pin
from scipy.interpolate import CubicSpline

import varpin as vp
from varpin import plots
from varpin.model import geometry

out = Path("out")
out.mkdir(exist_ok=True)

arm = vp.load_robot("kinova")
HAND, WIDTH = "j2s6s200_end_effector", 0.5  # of the door, from hinge to handle [m]

# The door: one hinge that stands upright, a board of 8 kg, and the frame of its handle.
door, board = pin.Model(), pin.GeometryModel()
hinge = door.addJoint(0, pin.JointModelRZ(), pin.SE3.Identity(), "hinge")
middle = pin.SE3(np.eye(3), np.array([0.5 * WIDTH, 0.0, 0.0]))
door.appendBodyToJoint(hinge, pin.Inertia.FromBox(8.0, WIDTH + 0.1, 0.03, 0.8), middle)
door.addFrame(pin.Frame("handle", hinge, pin.SE3(np.eye(3), np.array([WIDTH, 0.05, 0.0])), pin.FrameType.OP_FRAME))
for name, size, place in (
    ("board", (WIDTH + 0.1, 0.03, 0.8), middle.translation),
    ("knob", (0.03, 0.05, 0.03), [WIDTH, 0.03, 0]),
):
    shape = pin.GeometryObject(name, hinge, pin.SE3(np.eye(3), np.array(place)), coal.Box(*size))
    shape.meshColor = np.array([0.55, 0.4, 0.25, 1.0])
    board.addGeometryObject(shape)
place = pin.SE3(pin.utils.rotate("z", 0.5 * np.pi), np.array([0.75, -0.35, 0.5]))
model, shapes = pin.appendModel(arm.model, door, geometry(arm), board, 0, place)
robot = vp.load_robot(pin.RobotWrapper(model, visual_model=shapes))
joints = list(arm.joint_names)

# The closer turns the door back with a spring and a damper; a stiff spring joins hand and handle.
CLOSER, SLACK, GRIP = 12.0, -0.4, 2e4  # [N m/rad], [rad], [N/m]
stiffness = np.array([2000.0, 2000.0, 2000.0, 300.0, 300.0, 300.0])  # [N m/rad]
damping = 0.03 * stiffness  # [N m s/rad]
servos = vp.PositionServo(dict(zip(joints, stiffness, strict=True)), dict(zip(joints, damping, strict=True)))
forces = [
    vp.JointSpring({"hinge": CLOSER}, {"hinge": SLACK}),
    vp.JointDamper({"hinge": 3.0}),
    vp.FrameSpring(HAND, "handle", GRIP),
    vp.FrameDamper(HAND, "handle", 200.0),
    servos,
]
scene = vp.Scene(robot, forces=forces, damping=0.0, actuation=joints)
free = vp.Scene(arm, damping=0.0)


def handle(angle):
    """Where the handle is at a hinge's angle [m]."""
    return place.act(pin.utils.rotate("z", angle) @ np.array([WIDTH, 0.05, 0.0]))


def posture(goal, q):
    """The arm's joints for a place of the hand, near a posture: damped Gauss-Newton steps."""
    data, frame = arm.model.createData(), arm.model.getFrameId(HAND)
    for _ in range(100):
        J = pin.computeFrameJacobian(arm.model, data, arm.configuration(q), frame, pin.LOCAL_WORLD_ALIGNED)[:3]
        miss = goal - arm.frame_positions(q, HAND)
        q = q + J.T @ np.linalg.solve(J @ J.T + 1e-6 * np.eye(3), np.clip(miss, -0.05, 0.05))
    return q


times, wide = np.linspace(0.0, 5.0, 81), 0.9  # [s], how far the door is to open [rad]
angles = wide * (0.5 - 0.5 * np.cos(np.pi * np.clip(times / 4.0, 0.0, 1.0)))
way = [posture(handle(0.0), np.array([0.3, 2.6, 1.3, 1.5, 1.5, 0.0]))]
for angle in angles:
    way.append(posture(handle(angle), way[-1]))
way = np.array(way[1:])
way = CubicSpline(times, way)


def command(t):
    """Where the servos are to go: the posture for the handle's path, their lag and the arm's weight made up for."""
    return way(t) + (damping * way(t, 1) + free.holding_torque(way(t))) / stiffness


q0 = np.append(way(0.0), 0.0)
start = {"q0": q0, "v0": np.zeros(7)}
motion = vp.simulate(scene, **start, dt=5e-3, steps=1000, controls=vp.OpenLoop(command), integrator=vp.Radau(3))
fine = vp.simulate(
    scene, **start, dt=2.5e-3, steps=2000, controls=vp.OpenLoop(command), integrator=vp.Radau(3), check=False
)
angle = motion.q[:, -1]
held = robot.frame_positions(motion.q, "handle")
pull = GRIP * (robot.frame_positions(motion.q, HAND) - held)  # the hand's on the handle [N]
moment = np.cross(held - place.translation, pull)[:, 2]  # about the hinge [N m]
closer = CLOSER * (angle - SLACK)
print(motion)
print(f"the door is open by {np.degrees(angle[-1]):.2f} of {np.degrees(wide):.2f} degrees")
print(f"at the end the hand pulls with {np.linalg.norm(pull[-1]):.1f} N, of which {moment[-1]:.3f} N m turn the door")
print(f"the closer turns it back with {closer[-1]:.3f} N m")
print(f"error of the integration: {1e3 * np.abs(motion.q - fine.q[::2]).max():.4f} mrad")

figure, (above, below) = plt.subplots(2, 1, sharex=True, figsize=(8.0, 6.0), layout="constrained")
above.plot(motion.t, np.degrees(angle), label="door")
above.plot(times, np.degrees(angles), color="0.3", linestyle="--", linewidth=0.9, label="where servos lead it")
below.plot(motion.t, moment, label="hand")
below.plot(motion.t, closer, color="0.3", linestyle="--", linewidth=0.9, label="spring of the closer")
for axes, label in ((above, "angle [degrees]"), (below, "moment about the hinge [N m]")):
    plots.apply_style(axes)
    axes.set_ylabel(label)
    axes.legend(fontsize=8)
below.set_xlabel("time [s]")
figure.savefig(out / "kinova_door.png", dpi=120)
print(vp.replay(robot, motion, html=out / "kinova_door.html", marks=vp.Marks(trace=[HAND])))
