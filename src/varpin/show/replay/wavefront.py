"""Wavefront (.obj) meshes, split by material, as a mesh in meshcat has one material."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

logger = logging.getLogger(__name__)

# Suffixes of images that browsers can show.
_PICTURES = frozenset([".png", ".jpg", ".jpeg", ".gif", ".bmp", ".webp"])

# A corner of a face: indices of its vertex, texture coordinate and normal, from 0 on.
Corner = tuple[int, int | None, int | None]


@dataclass(frozen=True)
class Material:
    """A material of a material library.

    Attributes:
        color: Diffuse red, green and blue from 0 to 1; None if it is not given.
        opacity: Opacity from 0 to 1.
        texture: Path of an image, or empty.
    """

    color: tuple[float, ...] | None = None
    opacity: float = 1.0
    texture: str = ""


@dataclass(frozen=True)
class Part:
    """The faces of a mesh that share a material.

    Attributes:
        text: A Wavefront file of these faces alone.
        color: As in :class:`Material`.
        opacity: As in :class:`Material`.
        texture: As in :class:`Material`.
        mapped: Whether every corner has texture coordinates.
        colored: Whether vertices have colours of their own.
    """

    text: str
    color: tuple[float, ...] | None
    opacity: float
    texture: str
    mapped: bool
    colored: bool


@dataclass
class _Mesh:
    """The content of a file read so far."""

    points: dict[str, list[str]] = field(default_factory=lambda: {"v": [], "vt": [], "vn": []})
    faces: dict[str, list[list[Corner]]] = field(default_factory=dict)
    materials: dict[str, Material] = field(default_factory=dict)


def parts(path: Path) -> list[Part]:
    """The parts of a mesh file, one for each material that its faces use.

    The log names a missing material library.
    """
    mesh, name = _Mesh(), ""
    for line in path.read_text(encoding="utf-8", errors="replace").replace("\\\n", " ").splitlines():
        word, _, rest = line.strip().partition(" ")
        if word in mesh.points:
            mesh.points[word].append(rest)
        elif word == "f":
            corners = [_corner(corner, mesh) for corner in rest.split()]
            mesh.faces.setdefault(name, []).append(corners)
        elif word == "usemtl":
            name = rest.strip()
        elif word == "mtllib":
            mesh.materials |= _library(path.parent / rest.strip(), path)
    return [_part(mesh, faces, mesh.materials.get(name, Material())) for name, faces in mesh.faces.items()]


def _corner(text: str, mesh: _Mesh) -> Corner:
    found = []
    for word, points in zip(([*text.split("/"), "", ""])[:3], mesh.points.values(), strict=True):
        number = int(word) if word.strip("-").isdigit() else 0
        # Negative numbers count back from the last point so far.
        found.append(None if number == 0 else number - 1 if number > 0 else len(points) + number)
    return found[0] or 0, found[1], found[2]


def _part(mesh: _Mesh, faces: list[list[Corner]], material: Material) -> Part:
    """Some faces, with the points that they use renumbered."""
    whole = [all(corner[kind] is not None for face in faces for corner in face) for kind in range(3)]
    orders: list[dict[int, int]] = [{}, {}, {}]
    lines = []
    for face in faces:
        words = []
        for corner in face:
            numbers = [
                str(order.setdefault(at, len(order) + 1)) if kept and at is not None else ""
                for order, kept, at in zip(orders, whole, corner, strict=True)
            ]
            words.append("/".join(numbers).rstrip("/"))
        lines.append("f " + " ".join(words))
    head = []
    for (kind, points), order in zip(mesh.points.items(), orders, strict=True):
        head += [f"{kind} {points[at]}" for at in order if -1 < at < len(points)]
    first = mesh.points["v"][0].split() if mesh.points["v"] else []
    colored = len(first) >= 6 and material.color is None
    white = (1.0, 1.0, 1.0) if colored else material.color
    return Part("\n".join([*head, *lines]), white, material.opacity, material.texture, whole[1], colored)


def _library(path: Path, mesh: Path) -> dict[str, Material]:
    """Materials by name."""
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        logger.info("%s: its material library %r is missing, so its colours are unknown", mesh, path.name)
        return {}
    found: dict[str, dict[str, str]] = {}
    here: dict[str, str] = {}
    for line in lines:
        word, _, rest = line.strip().partition(" ")
        if word == "newmtl":
            here = found.setdefault(rest.strip(), {})
        elif rest:
            here[word.lower()] = rest.strip()
    return {name: _material(entries, path) for name, entries in found.items()}


def _material(entries: dict[str, str], library: Path) -> Material:
    color = tuple(_numbers(entries.get("kd", "").split()))
    opacity = _numbers(entries.get("d", "").split()[-1:])
    texture = ""
    if "map_kd" in entries:
        # Options may precede the name of the file.
        names = (entries["map_kd"], entries["map_kd"].split()[-1])
        places = [library.parent / name.replace("\\", "/") for name in names]
        texture = next((str(place) for place in places if place.is_file()), "")
        if not texture:
            logger.warning("%s: its texture %r is not there", library, names[0])
        elif Path(texture).suffix.lower() not in _PICTURES:
            logger.warning("%s: its texture %r is of a kind that browsers do not show", library, names[0])
            texture = ""
    return Material(color if len(color) == 3 else None, (opacity or [1.0])[0], texture)


def _numbers(words: Iterable[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError:
        return []
