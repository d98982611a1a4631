"""Scene files: a robot, its surroundings and a task in one TOML file."""

from varpin.io.scenefile.reading import SceneFileError as SceneFileError
from varpin.io.scenefile.scene_file import SceneFile as SceneFile
from varpin.io.scenefile.scene_file import load_scene as load_scene
from varpin.io.scenefile.scene_file import scenes as scenes
