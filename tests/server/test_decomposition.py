"""Quick Convert of a mesh with a notch: one hull closes it, a convex decomposition leaves it open."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from urlab_client import URLabClient
from urlab_client.errors import AddQuickConvertFailed
from urlab_client.server import ModelError, SimulatedServer
from urlab_client.server.assets.decomposition import convex_parts

# A trough along y: two walls and a floor, 0.4 m high, the inside 0.4 m wide and 0.3 m deep.
PROFILE = ((-0.3, 0.0), (0.3, 0.0), (0.3, 0.4), (0.2, 0.4), (0.2, 0.1), (-0.2, 0.1), (-0.2, 0.4), (-0.3, 0.4))
CAPS = ((0, 1, 4), (0, 4, 5), (1, 2, 3), (1, 3, 4), (0, 5, 6), (0, 6, 7))

BALL = """
<mujoco model="ball">
  <worldbody><body name="ball"><freejoint/><geom size="0.05" mass="1"/></body></worldbody>
</mujoco>
"""


def trough(folder: Path) -> Path:
    n = len(PROFILE)
    lines = [f"v {x} {y} {z}" for y in (-0.4, 0.4) for x, z in PROFILE]
    faces = [(a, c, b) for a, b, c in CAPS] + [(a + n, b + n, c + n) for a, b, c in CAPS]
    for i in range(n):
        j = (i + 1) % n
        faces += [(i, j, j + n), (i, j + n, i + n)]
    lines += [f"f {a + 1} {c + 1} {b + 1}" for a, b, c in faces]
    file = folder / "trough.obj"
    file.write_text("\n".join(lines) + "\n")
    return file


def level(folder: Path, **convert: object) -> Path:
    trough(folder)
    (folder / "ball.xml").write_text(BALL)
    actors = [
        {"name": "ball", "kind": "articulation", "actor_id": "ball", "blueprint": "ball", "location": [0, 0, 0.8]},
        {
            "name": "trough",
            "kind": "static_mesh",
            "mesh": {"shape": "file", "file": "trough.obj"},
            "quick_convert": {"static": True, **convert},
        },
        {"name": "manager", "kind": "manager"},
    ]
    blueprints = {"ball": {"source": "ball.xml"}}
    file = folder / "level.json"
    file.write_text(json.dumps({"format": "urlab-level", "version": 1, "blueprints": blueprints, "actors": actors}))
    return file


def resting_height(file: Path) -> float:
    with (
        SimulatedServer(file, play=True) as server,
        URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        client.step(1500)
        return float(client.articulations["ball"].root_pos_w[2])


def test_a_ball_falls_into_the_notch_only_where_the_mesh_was_decomposed(tmp_path: Path) -> None:
    assert resting_height(level(tmp_path)) == pytest.approx(0.45, abs=0.01)
    assert resting_height(level(tmp_path, complex_mesh=True)) == pytest.approx(0.15, abs=0.01)


def test_parts_are_convex_cover_the_mesh_and_come_out_the_same_again(tmp_path: Path) -> None:
    parts = convex_parts(trough(tmp_path), 0.05)
    assert len(parts) >= 3
    corners = np.concatenate([vertices for vertices, _ in parts])
    assert np.allclose(corners.min(axis=0), (-0.3, -0.4, 0.0), atol=0.02)
    assert np.allclose(corners.max(axis=0), (0.3, 0.4, 0.4), atol=0.02)
    for vertices, faces in parts:
        centre = vertices.mean(axis=0)
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        outward = np.sign(np.einsum("ij,ij->i", normals, a - centre))
        heights = np.einsum("fj,fvj->fv", normals * outward[:, None], vertices[None] - a[:, None])
        assert heights.max() < 1e-6
    assert convex_parts(trough(tmp_path), 0.05) is parts


def test_without_the_library_it_is_refused_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("editor.world", "assets.level"):
        monkeypatch.setattr(f"urlab_client.server.{module}.is_available", lambda: False)
    with pytest.raises(ModelError, match=r"\[coacd\]"), SimulatedServer(level(tmp_path, complex_mesh=True)):
        pass
    with SimulatedServer(level(tmp_path)) as server, URLabClient(**server.client_options()) as client:
        client.discover()
        with pytest.raises(AddQuickConvertFailed, match=r"\[coacd\]"):
            client.outliner.add_quick_convert("trough", complex_mesh=True)
        client.outliner.add_quick_convert("trough", static=True)
