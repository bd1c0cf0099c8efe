"""The viewport's picture: what ops over a bare socket have set up, drawn for real."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from wire import Wire

from urlab_client.server import RenderingUnavailable, SimulatedServer
from urlab_client.server.editor.markers import Drawings
from urlab_client.server.render import viewport_picture
from urlab_client.server.render.viewport_picture import SELECTED
from urlab_client.simulation import opengl

# A grey cube that collides, on a stick that does not, and a ball that falls away.
MODEL = """
<mujoco model="things">
  <worldbody>
    <light pos="0 0 5" dir="1 0 -1" directional="true"/>
    <body name="cube"><geom type="box" size=".5 .5 .5" rgba=".5 .5 .5 1"/>
      <geom type="box" pos="0 0 1" size=".1 .1 .5" rgba=".5 .5 .5 1" contype="0" conaffinity="0"/></body>
    <body name="ball" pos="0 3 0"><freejoint/><geom size=".4" rgba="0 1 0 1" mass="1"/></body>
  </worldbody>
</mujoco>
"""
SIZE = (160, 120)
CENTER = (60, 80)
RED = [1, 0, 0]

Image = np.ndarray[Any, Any]


class Stage:
    """A server and its bare client, which looks along +x at the cube from 4 m away; 1 m there is 40 pixels."""

    def __init__(self, server: SimulatedServer, wire: Wire) -> None:
        self.server, self.wire = server, wire

    def picture(self) -> Image:
        image = self.server.snapshot(SIZE)
        assert image.shape == (120, 160, 4)
        assert image.dtype == np.uint8
        assert (image[:, :, 3] == 255).all()
        return image

    def before_and_after(self, op: str, **fields: Any) -> tuple[Image, Image]:
        before = self.picture()
        self.wire.ask(op, **fields)
        return before, self.picture()

    def changed(self, op: str, **fields: Any) -> np.ndarray[Any, Any]:
        """Return which pixels an op changes."""
        before, after = self.before_and_after(op, **fields)
        return (before != after).any(axis=2)


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimulatedServer]:
    path = tmp_path_factory.mktemp("models") / "things.xml"
    path.write_text(MODEL)
    with SimulatedServer(path, play=True, unpaused=True, step_mode="direct") as server:
        yield server


@pytest.fixture
def stage(served: SimulatedServer) -> Iterator[Stage]:
    served.restore()
    with Wire(served) as wire:
        wire.hello()
        wire.ask("set_camera", location=[-4, 0, 0], rotation_euler=[0, 0, 0], fov=53.13)
        yield Stage(served, wire)


def shade(image: Image, row: int, column: int) -> list[int]:
    return [int(value) for value in image[row, column, :3]]


@pytest.mark.opengl
def test_the_camera_is_that_of_the_ops(stage: Stage) -> None:
    assert stage.server.can_render
    ahead = stage.picture()
    assert len(set(shade(ahead, *CENTER))) == 1  # the cube is grey
    assert shade(ahead, 60, 10) == [0, 0, 0]
    width = int((ahead[60, :, :3].any(axis=1)).sum())
    assert width == pytest.approx(160 / (2 * 3.5 * 0.5), abs=2)  # fov 53.13 degrees: as wide as it is far
    stage.wire.ask("set_camera", location=[-4, 3, 0], rotation_euler=[0, 0, 0])
    red, green, blue = shade(stage.picture(), *CENTER)
    assert green > red + 30
    assert red == blue


@pytest.mark.opengl
def test_unreal_yaw_turns_right_and_roll_tilts(stage: Stage) -> None:
    stage.wire.ask("set_camera", location=[-4, 0, 0], rotation_euler=[0, 0, 20])
    columns = np.flatnonzero(stage.picture()[60, :, :3].any(axis=1))
    assert columns.max() < 80
    stage.wire.ask("set_camera", location=[-6, 0, 1], rotation_euler=[90, 0, 0])
    stick = stage.picture()[:, :, :3].any(axis=2)
    rows, columns = np.flatnonzero(stick.any(axis=1)), np.flatnonzero(stick.any(axis=0))
    assert len(columns) > 1.5 * len(rows)


@pytest.mark.opengl
def test_play_shows_the_state_and_no_play_the_level(stage: Stage) -> None:
    stage.wire.ask("set_camera", location=[-4, 3, 0])
    assert shade(stage.picture(), *CENTER)[1] > 50
    stage.wire.ask("step", n_steps=1000)
    assert shade(stage.picture(), *CENTER) == [0, 0, 0]
    stage.wire.ask("stop_pie")
    assert shade(stage.picture(), *CENTER)[1] > 50
    stage.wire.ask("set_actor_transform", target="things", location=[0, 0, 50])
    assert shade(stage.picture(), *CENTER) == [0, 0, 0]


@pytest.mark.opengl
def test_a_tracked_actor_stays_in_the_middle(stage: Stage) -> None:
    stage.wire.ask("track_actor", target="things", offset=[0, -4, 0])
    assert shade(stage.picture(), *CENTER) != [0, 0, 0]


@pytest.mark.opengl
def test_a_picture_of_everything(stage: Stage) -> None:
    stage.wire.ask("set_camera", location=[900, 0, 0], rotation_euler=[0, 0, 0], fov=90)
    image = stage.server.snapshot(SIZE, frame_all=True)
    seen = image[:, :, :3].any(axis=2)
    assert seen.any()
    assert not seen[[0, -1]].any()
    assert not seen[:, [0, -1]].any()
    assert stage.wire.ask("get_camera")["location"] == [900.0, 0.0, 0.0]


@pytest.mark.opengl
def test_a_picture_larger_than_any_camera(stage: Stage) -> None:
    image = stage.server.snapshot((1000, 700))
    assert image.shape == (700, 1000, 4)
    assert image[350, 500, :3].any()
    assert not image[0, 0, :3].any()


@pytest.mark.opengl
def test_unlit_shows_the_material_and_lit_the_light(stage: Stage) -> None:
    lit, unlit = stage.before_and_after("set_viewport_mode", mode="Unlit")
    assert shade(unlit, *CENTER) == pytest.approx([128, 128, 128], abs=1)
    assert shade(lit, *CENTER) != shade(unlit, *CENTER)


@pytest.mark.opengl
def test_wireframe_shows_through(stage: Stage) -> None:
    lit, wires = stage.before_and_after("set_viewport_mode", mode="wireframe")
    solid, lines = (int(image[:, :, :3].any(axis=2).sum()) for image in (lit, wires))
    assert 0 < lines < solid / 2
    stage.wire.ask("set_viewport_mode", mode="lit")
    assert (stage.picture() == lit).all()


@pytest.mark.opengl
def test_collision_leaves_out_what_does_not_collide(stage: Stage) -> None:
    changed = stage.changed("set_viewport_mode", mode="collision")
    assert changed[25, 80]  # the stick
    assert not changed[60, 80]
    stage.wire.ask("set_viewport_mode", mode="lit")
    assert stage.picture()[25, 80, :3].any()


@pytest.mark.opengl
@pytest.mark.parametrize(
    ("op", "fields", "colored"),
    [
        ("draw_marker", {"location": [-1, 0, 0], "color": RED}, {CENTER}),
        ("draw_line", {"from": [-1, -9, 0], "to": [-1, 9, 0], "color": RED, "thickness": 3}, {(60, 10), (60, 150)}),
        ("draw_box", {"center": [-1, 0, 0], "half_extents": [0, 0.75, 0.375], "color": RED}, {(40, 80), (60, 40)}),
        (
            "draw_arrow",
            {"from": [-1, 0, 0], "to": [-1, 0, 1], "color": RED, "thickness": 3, "arrow_size": 0.5},
            {(50, 80), (33, 80)},
        ),
    ],
)
def test_drawing(stage: Stage, op: str, fields: dict[str, Any], colored: set[tuple[int, int]]) -> None:
    _, image = stage.before_and_after(op, **fields, ttl=-1)
    red = (image[:, :, 0] > 200) & (image[:, :, 1:3] < 50).all(axis=2)
    for row, column in colored:
        assert red[row - 2 : row + 3, column - 2 : column + 3].any(), (row, column)
    assert red.sum() < 0.1 * red.size
    stage.wire.ask("clear_markers")
    assert not (stage.picture()[:, :, 0] > 200).any()


@pytest.mark.opengl
def test_an_arrow_has_a_head_at_its_tip(stage: Stage) -> None:
    fields = {"from": [-2, 0, 0], "to": [-2, 0, 1], "arrow_size": 0.4}
    changed = stage.changed("draw_arrow", **fields, color=RED, ttl=-1)
    widths = [int(np.ptp(np.flatnonzero(row))) + 1 if row.any() else 0 for row in changed]
    tip = next(row for row, width in enumerate(widths) if width)
    assert max(widths[tip : tip + 36]) > 3 * max(widths[tip + 40 : 60]) > 0


@pytest.mark.opengl
def test_axes_are_those_of_unreal(stage: Stage) -> None:
    stage.wire.ask("set_camera", location=[-2, 0, 4], rotation_euler=[0, -90, 0], fov=53.13)  # +x is up, -y right
    _, image = stage.before_and_after("draw_axes", location=[-2, 0, 2], scale=0.5, ttl=-1)
    red, green = (
        (image[:, :, here] > 200) & (image[:, :, there] < 50) & (image[:, :, 2] < 50)
        for here, there in ((0, 1), (1, 0))
    )
    rows, columns = np.nonzero(red)
    assert rows.mean() < 55
    assert columns.mean() == pytest.approx(80, abs=3)
    rows, columns = np.nonzero(green)
    assert columns.mean() > 85
    assert rows.mean() == pytest.approx(60, abs=3)


@pytest.mark.opengl
def test_labels_are_text_at_their_place(stage: Stage) -> None:
    before = stage.picture()
    stage.wire.ask("draw_marker", location=[-1, 0.9, 0.7], color=RED, ttl=-1)
    marked = stage.picture()
    stage.wire.ask("draw_marker", location=[-1, 0.9, 0.7], color=RED, ttl=-1, label="näme\n")
    labelled = stage.picture()
    rows, columns = np.nonzero((labelled != marked).any(axis=2))
    places = np.nonzero((marked != before).any(axis=2))
    assert len(rows) > 20
    assert abs(rows.mean() - places[0].mean()) < 15
    assert abs(columns.mean() - places[1].mean()) < 40


@pytest.mark.opengl
def test_what_lives_for_one_frame_is_seen_once(stage: Stage) -> None:
    before, first = stage.before_and_after("draw_marker", location=[-1, 0, 0], color=RED)
    assert (first != before).any()
    assert (stage.picture() == before).all()


@pytest.mark.opengl
def test_time_to_live_ends(stage: Stage) -> None:
    now = [0.0]
    core = stage.server._running.core
    assert core is not None
    core.drawings = Drawings(lambda: now[0])
    before, marked = stage.before_and_after("draw_marker", location=[-1, 0, 0], color=RED, ttl=2)
    stage.wire.ask("set_overlay_text", text="hello")
    now[0] = 1.9
    assert (stage.picture() != marked).any()
    now[0] = 2.0
    gone = stage.picture()
    assert shade(gone, *CENTER) == shade(before, *CENTER)
    assert (gone != before).any()
    now[0] = 10.0
    assert (stage.picture() == before).all()


@pytest.mark.opengl
def test_overlay_text_is_in_the_upper_left_corner(stage: Stage) -> None:
    rows, columns = np.nonzero(stage.changed("set_overlay_text", text="näh\N{BELL}"))
    assert rows.max() < 40
    assert columns.max() < 80
    stage.wire.ask("set_overlay_text", text="")


@pytest.mark.opengl
def test_what_is_selected_has_a_box(stage: Stage) -> None:
    stage.wire.ask("set_camera", location=[-9, 1.5, 0], rotation_euler=[0, 0, 0])
    _, image = stage.before_and_after("select_actor", target="things")
    assert (np.abs(image[:, :, :3].astype(int) - np.array(SELECTED) * 255) < 8).all(axis=2).sum() > 50


@pytest.mark.opengl
def test_drawings_of_play_and_level_are_apart(stage: Stage) -> None:
    _, playing = stage.before_and_after("draw_marker", location=[-1, 0, 0], color=RED, ttl=-1)
    stage.wire.ask("stop_pie")
    assert shade(stage.picture(), *CENTER) != shade(playing, *CENTER)
    _, edited = stage.before_and_after("draw_marker", location=[-1, 0, 0], color=RED, ttl=-1)
    assert shade(edited, *CENTER) == shade(playing, *CENTER)


@pytest.mark.opengl
def test_another_level_shows_nothing_of_what_was_drawn_before(stage: Stage) -> None:
    stage.wire.ask("stop_pie")
    stage.wire.ask("draw_marker", location=[-1, 0, 0], color=RED, ttl=-1)
    drawn = stage.picture()
    stage.wire.ask("create_level", name="Empty", force_overwrite=True)
    assert shade(stage.picture(), *CENTER) != shade(drawn, *CENTER)


@pytest.mark.opengl
def test_robot_cameras_show_no_drawing(stage: Stage, tmp_path: Path) -> None:
    path = tmp_path / "eye.xml"
    path.write_text(
        "<mujoco><worldbody><camera name='eye' xyaxes='0 -1 0 0 0 1' resolution='8 8'/>"
        "<geom pos='4 0 0' size='.1'/></worldbody></mujoco>"
    )
    with SimulatedServer(path, play=True, unpaused=True, step_mode="direct") as server, Wire(server) as wire:
        wire.hello()
        wire.ask("set_viewport_mode", mode="wireframe")
        wire.ask("set_camera", location=[0, 0, 0], rotation_euler=[0, 0, 0])
        frames = []
        for op, fields in [("draw_marker", {"location": [1, 0, 0], "color": RED, "ttl": -1}), ("clear_markers", {})]:
            wire.ask(op, **fields)
            server.snapshot((8, 8))
            frames.append(wire.ask("step", include_cameras={"eye": "sync"})["cameras"]["eye"]["data"])
        assert frames[0] == frames[1]


@pytest.mark.opengl
def test_an_empty_level_is_an_empty_picture(tmp_path: Path) -> None:
    with SimulatedServer() as server:
        assert not server.snapshot((16, 9))[:, :, :3].any()
        assert not server.snapshot((16, 9), frame_all=True)[:, :, :3].any()


@pytest.mark.parametrize("size", [(0, 5), (5, 100_000), (1, 2, 3)])
def test_sizes_that_are_none(stage: Stage, size: Any) -> None:
    with pytest.raises(ValueError, match="size must be a width and a height"):
        stage.server.snapshot(size)


def test_a_closed_server_has_no_picture() -> None:
    with pytest.raises(RuntimeError, match="closed"):
        SimulatedServer().snapshot()


def test_no_opengl_is_a_clear_error(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "disable")
    assert not stage.server.can_render
    with pytest.raises(RenderingUnavailable, match="MUJOCO_GL=disable"):
        stage.server.snapshot(SIZE)


def test_broken_opengl_names_the_package(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(opengl, "_PROBE", "import os; os.abort()  # {name}")
    monkeypatch.setattr(opengl, "_find", opengl._find.__wrapped__)
    with pytest.raises(RenderingUnavailable, match=f"{opengl.ADVICE}.*exited with code"):
        stage.server.snapshot(SIZE)


@pytest.mark.opengl
def test_drawing_that_fails_is_an_error(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: object) -> None:
        raise RuntimeError("the driver is gone")

    monkeypatch.setattr(viewport_picture.ViewportStage, "paint", fail)
    for _ in range(2):
        with pytest.raises(RenderingUnavailable, match="log"):
            stage.server.snapshot(SIZE)
    stage.wire.ask("stop_pie")
