"""A motion as one HTML file that plays by itself: meshcat's viewer and the commands it is to obey."""

from __future__ import annotations

import base64
import gzip
import html as markup
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import meshcat
import umsgpack

from varpin.errors import InputError


class Page:
    """In place of meshcat's window: keeps the commands that a window would send to its server."""

    def __init__(self) -> None:
        self.commands: list[bytes] = []

    def send(self, command: Any) -> None:
        """Keep a command."""
        # three.js computes in single precision; half the bytes say the same.
        try:
            self.commands.append(umsgpack.packb(command.lower(), force_float_precision="single"))
        except OverflowError:
            raise InputError("what is to be shown has sizes or places beyond 3e38, which no viewer draws") from None

    def html(self, title: str) -> str:
        """The page: meshcat's viewer and the commands, compressed."""
        viewer = Path(meshcat.viewer_assets_path(), "dist", "main.min.js").read_text(encoding="utf-8")
        stream = b"".join(len(command).to_bytes(4, "little") + command for command in self.commands)
        packed = base64.b64encode(gzip.compress(stream, 6, mtime=0)).decode()
        return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>{markup.escape(title)} - varpin</title>
<link rel="icon" href="data:,">
<style>body {{ margin: 0; }} #meshcat-pane {{ width: 100vw; height: 100vh; overflow: hidden; }}</style>
</head>
<body>
<div id="meshcat-pane"></div>
<script>{viewer}</script>
<script id="commands" type="text/plain">{packed}</script>
<script>{_PLAYER}</script>
</body>
</html>
"""


@dataclass(frozen=True, eq=False)
class Inline:
    """A page that a notebook shows as the value of a cell.

    Attributes:
        html: The whole page.
        title: Its title.
        size: Most of its width, and its height [pixels].
    """

    html: str
    title: str
    size: tuple[int, int]

    def __repr__(self) -> str:
        return f"Inline(replay of {self.title}, {len(self.html) / 1e6:.1f} MB)"

    def _repr_html_(self) -> str:
        """The page in a frame of its own, cut off from the notebook's."""
        width, height = self.size
        return (
            f'<iframe srcdoc="{markup.escape(self.html)}" title="{markup.escape(self.title)}" sandbox="allow-scripts" '
            f'style="width: 100%; max-width: {width}px; height: {height}px; border: 0"></iframe>'
        )


# The commands go to the viewer one after the other, for a property or an animation needs the object it speaks of.
# A mesh that three.js cannot take is left out; the rest plays.
_PLAYER = """
var viewer;
async function play() {
    viewer = new MeshCat.Viewer(document.getElementById("meshcat-pane"));
    const packed = atob(document.getElementById("commands").textContent);
    const bytes = new Uint8Array(packed.length);
    for (let i = 0; i < packed.length; i++) bytes[i] = packed.charCodeAt(i);
    const unzip = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    const data = await new Response(unzip).arrayBuffer();
    const view = new DataView(data);
    for (let at = 0; at < data.byteLength;) {
        const size = view.getUint32(at, true);
        try {
            viewer.handle_command_bytearray(new Uint8Array(data.slice(at + 4, at + 4 + size)));
        } catch (error) {
            console.error(error);
        }
        at += 4 + size;
    }
    document.documentElement.dataset.loaded = "true";
}
play().catch(error => {
    console.error(error);
    document.getElementById("meshcat-pane").textContent = "This motion cannot be shown here: " + error.message;
});
"""
