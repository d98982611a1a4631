"""Scene files: a robot, its surroundings and a task in one TOML file."""

from varpin.scenefile.required import Required as Required
from varpin.scenefile.scene_file import SceneFile as SceneFile
from varpin.scenefile.scene_file import load_scene as load_scene
from varpin.scenefile.spec import SceneSpec as SceneSpec
from varpin.scenefile.spec import scenes as scenes
from varpin.scenefile.table import SceneFileError as SceneFileError
