"""Robots: found, parsed, locked and laid out as the flat tree that the core runs on."""

from varpin.robot.chain import planar_chain as planar_chain
from varpin.robot.model import Robot as Robot
from varpin.robot.model import build_robot as build_robot
from varpin.robot.model import check_inertia as check_inertia
from varpin.robot.model import geometry as geometry
from varpin.robot.model import load_robot as load_robot
from varpin.robot.model import readable_geometry as readable_geometry
from varpin.robot.payload import Payload as Payload
from varpin.robot.sources import bundled_robots as bundled_robots
from varpin.robot.sources import models_dir as models_dir
from varpin.robot.sources import robot_names as robot_names
from varpin.robot.tree import require_sound as require_sound
