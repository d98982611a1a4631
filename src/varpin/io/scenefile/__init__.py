"""Scene files: a robot, its surroundings and a task in one TOML file."""

from varpin.io.scenefile.reading import scenes as scenes
from varpin.io.scenefile.required import Required as Required
from varpin.io.scenefile.scene_file import SceneFile as SceneFile
from varpin.io.scenefile.scene_file import load_scene as load_scene
from varpin.io.scenefile.table import SceneFileError as SceneFileError
