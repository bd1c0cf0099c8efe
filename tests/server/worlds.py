"""Models and worlds for the tests of the simulated editor."""

from __future__ import annotations

import struct
from pathlib import Path

import gymnasium
import numpy as np

from urlab_client.server.assets.content import ContentRoot
from urlab_client.server.editor.world import ActorNames, EditorWorld

GYMNASIUM = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
DATA = Path(__file__).parent / "data"

BOT = (DATA / "bot.xml").read_text()

TETRAHEDRON = "v 0 0 0\nv {0} 0 0\nv 0 {0} 0\nv 0 0 {0}\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def write_obj(path: Path, size: float) -> Path:
    """Write a tetrahedron with edges of `size` metres along the axes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(TETRAHEDRON.format(size))
    return path


def write_stl(path: Path, size: float) -> Path:
    """Write the same tetrahedron as binary STL."""
    path.parent.mkdir(parents=True, exist_ok=True)
    corners = np.array([[0, 0, 0], [size, 0, 0], [0, size, 0], [0, 0, size]], dtype="<f4")
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    body = b"".join(bytes(12) + corners[list(face)].tobytes() + bytes(2) for face in faces)
    path.write_bytes(bytes(80) + struct.pack("<I", len(faces)) + body)
    return path


def mjcf(body: str, *, model: str = "", head: str = "", tail: str = "") -> str:
    """Return an MJCF document around the content of its world body."""
    name = f' model="{model}"' if model else ""
    return f"<mujoco{name}>{head}<worldbody>{body}</worldbody>{tail}</mujoco>"


BALL_BODY = '<body name="ball" pos="0 0 1"><freejoint name="root"/><geom size="0.1" mass="1"/></body>'


class Workspace:
    """A world on temporary folders: `models` is the only model root, `saved` the content root."""

    def __init__(self, folder: Path, *, actor_names: ActorNames = "model") -> None:
        self.models = folder / "models"
        self.saved = folder / "saved"
        self.models.mkdir(parents=True, exist_ok=True)
        self.content = ContentRoot(self.saved, model_roots=[self.models])
        self.world = EditorWorld(self.content, actor_names=actor_names)

    def write(self, name: str, text: str) -> Path:
        path = self.models / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return path

    def blueprint(self, name: str, text: str) -> str:
        """Write `<name>.xml`, import it and return the class path."""
        return self.world.blueprints.import_xml(str(self.write(f"{name}.xml", text)))[0].class_path
