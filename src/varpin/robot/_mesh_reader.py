"""Reads meshes in a process of its own; :mod:`varpin.robot.meshes` starts it, and it imports nothing of varpin's."""

import json
import os
import resource
import sys
from pathlib import Path

import pinocchio as pin


def main() -> None:
    """Take a request on stdin; answer with one line for each URDF text: null, or what is wrong with its meshes."""
    request = json.load(sys.stdin)
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    # Whatever libraries print is no answer.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    own = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (own + request["memory"],) * 2)
    resource.setrlimit(resource.RLIMIT_CPU, (request["seconds"],) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for text in request["texts"]:
        answer = None
        try:
            model = pin.buildModelFromXML(text)
            shapes = pin.buildGeomFromUrdfString(model, text, pin.GeometryType.VISUAL, None, request["dirs"])
            for shape in shapes.geometryObjects:
                shape.geometry.computeLocalAABB()
        except MemoryError:
            answer = f"reading takes more than {request['memory'] / 1e6:g} MB"
        except (ValueError, RuntimeError, IndexError) as error:
            answer = " ".join(str(error).split())
        answers.write(json.dumps(answer) + "\n")


if __name__ == "__main__":
    main()
