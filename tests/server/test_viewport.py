"""The viewport's camera, over a bare socket."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
from wire import Wire, float32

from urlab_client.server.editor.viewport import Track, Viewport
from urlab_client.values.rotation import rotate

POSE = {"location", "rotation_quat", "rotation_euler", "fov"}


@pytest.fixture
def robots(serve: Callable[..., Wire]) -> Wire:
    return serve("bot", "prop")


def same_rotation(quat: list[float], other: list[float], tolerance: float = 1e-4) -> bool:
    return abs(abs(sum(a * b for a, b in zip(quat, other, strict=True))) - 1.0) < tolerance


def test_default_view_sees_the_origin(editor: Wire) -> None:
    view = editor.ask("get_camera")
    assert set(view) == {"op", *POSE}
    assert view["fov"] == 90.0
    ahead = rotate(tuple(view["rotation_quat"]), (1.0, 0.0, 0.0))
    distance = math.hypot(*view["location"])
    assert sum(-a * b for a, b in zip(ahead, view["location"], strict=True)) / distance > 0.95


def test_euler_angles_come_back(editor: Wire) -> None:
    placed = editor.ask("set_camera", location=[1, 2, 3], rotation_euler=[0, -30, 45])
    assert placed["location"] == [1.0, 2.0, 3.0]
    view = editor.ask("get_camera")
    assert view["rotation_euler"] == pytest.approx([0, -30, 45])
    assert same_rotation(view["rotation_quat"], [0.0990, 0.2391, -0.3696, 0.8924])
    assert {key: view[key] for key in POSE} == {key: placed[key] for key in POSE}


def test_quaternions_change_frame(editor: Wire) -> None:
    x, y, z, w = 0.1, 0.5, -0.1, math.sqrt(0.73)
    placed = editor.ask("set_camera", location=[0, 0, 0], rotation_quat=[x, y, z, w], rotation_euler=[9, 9, 9])
    assert same_rotation(placed["rotation_quat"], [-x, y, -z, w], 1e-12)


def test_looking_straight_down(editor: Wire) -> None:
    placed = editor.ask("set_camera", location=[0, 0, 5], rotation_euler=[0, -90, 30])
    assert placed["rotation_euler"] == [0.0, -90.0, 30.0]
    assert rotate(tuple(placed["rotation_quat"]), (1.0, 0.0, 0.0)) == pytest.approx((0, 0, -1), abs=1e-12)


def test_what_is_absent_stays(editor: Wire) -> None:
    before = editor.ask("set_camera", location=[1, 1, 1], rotation_euler=[5, 6, 7], fov=60.1)
    assert before["fov"] == float32(60.1)
    for fields in ({"fov": 0}, {"fov": -5}, {"fov": math.nan}, {"rotation_quat": [0, 0, 1]}, {"rotation_euler": [1]}):
        after = editor.ask("set_camera", location=[2, 2, 2], **fields)
        assert after["fov"] == before["fov"]
        assert after["rotation_euler"] == before["rotation_euler"]
    assert after["location"] == [2.0, 2.0, 2.0]


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"location": [1, 2]},
        {"location": None},
        {"location": [0, 0, math.inf]},
        {"location": [0, 0, 0], "rotation_quat": [0, 0, 0, 0]},
        {"location": [0, 0, 0], "rotation_euler": [0, math.nan, 0]},
    ],
)
def test_unusable_poses(editor: Wire, fields: dict[str, Any]) -> None:
    before = editor.ask("get_camera")
    assert editor.refused("set_camera", **fields) == "missing_field"
    assert editor.ask("get_camera") == before


def test_framing_keeps_the_direction_and_fits_the_box(robots: Wire) -> None:
    robots.ask("set_camera", location=[0, 0, 0], rotation_euler=[0, -20, 110], fov=60)
    view = robots.ask("frame_actor", target="prop")
    assert view["rotation_euler"] == pytest.approx([0, -20, 110])
    assert view["fov"] == 60.0
    box = robots.ask("get_actor_bounds", target="prop", components_only=True)
    away = [center - place for center, place in zip(box["center"], view["location"], strict=True)]
    ahead = rotate(tuple(view["rotation_quat"]), (1.0, 0.0, 0.0))
    distance = math.hypot(*away)
    assert [value / distance for value in away] == pytest.approx(ahead)
    half_height = distance * math.tan(math.radians(30)) / (16 / 9)
    assert half_height == pytest.approx(math.hypot(*box["extents"]))


def test_framing_finds_by_id_unless_told_otherwise(robots: Wire) -> None:
    name = robots.ask("spawn_actor", blueprint="/Game/MuJoCoImports/bot", actor_id="second")["actor_name"]
    assert name != "second"
    assert robots.refusal("frame_actor", target=name) == ("unknown_actor", name)
    by_id = robots.ask("frame_actor", target="second")
    assert robots.ask("frame_actor", target=name, target_by="Actor_Name") == by_id
    assert robots.refusal("frame_actor", target="second", target_by="actor_name") == ("unknown_actor", "second")


def test_framing_what_has_no_box(editor: Wire) -> None:
    editor.ask("spawn_light", kind="point", actor_id="lamp")
    assert editor.refused("frame_actor", target="lamp") == "no_bounds"
    assert editor.refused("frame_actor", target="") == "missing_field"
    assert editor.refused("frame_actor") == "missing_field"


@pytest.mark.parametrize("mode", ["lit", "Unlit", "WireFrame", "COLLISION"])
def test_view_modes_echo(editor: Wire, mode: str) -> None:
    assert editor.ask("set_viewport_mode", mode=mode) == {"op": "set_mode_ok", "mode": mode}


def test_view_modes_that_are_none(editor: Wire) -> None:
    assert editor.refused("set_viewport_mode", mode="x") == "invalid_mode"
    assert editor.refused("set_viewport_mode", mode="") == "missing_field"
    assert editor.refused("set_viewport_mode") == "missing_field"
    assert editor.refused("set_viewport_mode", mode="Reflections") == "unsupported"


def test_tracking_starts_and_ends(robots: Wire) -> None:
    assert robots.ask("untrack")["was_tracking"] is False
    path = robots.ask("track_actor", target="bot")["tracked_actor_path"]
    assert path.endswith(":PersistentLevel.bot")
    assert robots.ask("track_actor", target="prop")["tracked_actor_path"].endswith(".prop")
    assert robots.ask("untrack")["was_tracking"] is True
    assert robots.ask("untrack")["was_tracking"] is False
    assert robots.refusal("track_actor", target="nobody") == ("unknown_actor", "nobody")


def test_tracking_ends_with_the_actor(robots: Wire) -> None:
    robots.ask("track_actor", target="bot")
    robots.ask("destroy_actor", target="bot")
    assert robots.ask("untrack")["was_tracking"] is False


def test_the_camera_follows_an_edited_actor(robots: Wire) -> None:
    robots.ask("track_actor", target="bot")
    robots.ask("set_actor_transform", target="bot", location=[5, 5, 1], rotation_euler=[0, 0, 90])
    view = robots.ask("get_camera")
    assert view["location"] == pytest.approx([7, 5, 2])
    ahead = rotate(tuple(view["rotation_quat"]), (1.0, 0.0, 0.0))
    assert ahead == pytest.approx([-2 / math.sqrt(5), 0, -1 / math.sqrt(5)], abs=1e-9)


def test_the_camera_follows_a_simulated_robot(serve: Callable[..., Wire]) -> None:
    wire = serve("bot", play=True, step_mode="direct", unpaused=True)
    wire.ask("track_actor", target="bot", offset=[-1, 0, 0])
    height = wire.ask("get_camera")["location"][2]
    state = wire.ask("step", n_steps=200)["per_articulation"]["bot"]
    view = wire.ask("get_camera")
    assert view["location"][2] < height - 0.1
    assert view["location"][2] == pytest.approx(state["qpos"][2], abs=0.2)


def test_smoothing_depends_on_time_not_on_looks() -> None:
    once, often = Viewport(), Viewport()
    for viewport in (once, often):
        viewport.start_tracking(Track(actor_name="a", smoothing=0.9))
        viewport.follow((10.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), 0.0)
    once.follow((10.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), 0.5)
    for tick in range(1, 51):
        often.follow((10.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), 0.01 * tick)
    assert once.view.location == pytest.approx(often.view.location)
    assert once.view.location[0] == pytest.approx(10.0 - 13.0 * 0.9**31)


def test_smoothing_is_clamped() -> None:
    viewport = Viewport()
    for smoothing, kept in ((5.0, 0.99), (-1.0, 0.0), (math.nan, 0.0)):
        viewport.start_tracking(Track(actor_name="a", smoothing=smoothing))
        assert viewport.track is not None
        assert viewport.track.smoothing == kept
