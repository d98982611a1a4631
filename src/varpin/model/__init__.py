"""Robots: finding and parsing their files, locking joints, and the flat tree that the core runs on."""

from varpin.model.chain import planar_chain as planar_chain
from varpin.model.combination import combine as combine
from varpin.model.inertia import Payload as Payload
from varpin.model.inertia import check_inertia as check_inertia
from varpin.model.loading import load_robot as load_robot
from varpin.model.names import bundled_robots as bundled_robots
from varpin.model.names import models_dir as models_dir
from varpin.model.names import robot_names as robot_names
from varpin.model.robot import Robot as Robot
from varpin.model.robot import geometry as geometry
from varpin.model.robot import readable_geometry as readable_geometry
from varpin.model.robot import require_robot as require_robot
from varpin.model.units import in_degrees as in_degrees
from varpin.model.units import joint_unit as joint_unit
from varpin.model.units import longest_reach as longest_reach
