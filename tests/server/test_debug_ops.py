"""Debug drawing: the ops over a bare socket, and what is kept of it."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from wire import Wire

from urlab_client.server import SimulatedServer
from urlab_client.server.editor.markers import Drawings, Primitive, line, sphere
from urlab_client.server.handlers.viewport import _color
from urlab_client.server.limits import Limits

COLOR = [1, 0, 0]
VALID: dict[str, dict[str, Any]] = {
    "draw_marker": {"location": [0, 0, 1], "color": COLOR},
    "draw_line": {"from": [0, 0, 0], "to": [1, 0, 0], "color": COLOR},
    "draw_box": {"center": [0, 0, 0], "half_extents": [-1, 1, 1], "color": COLOR},
    "draw_arrow": {"from": [0, 0, 0], "to": [1, 0, 0], "color": COLOR},
    "draw_axes": {"location": [0, 0, 0]},
    "clear_markers": {},
    "set_overlay_text": {"text": "hello"},
}
REQUIRED = [(op, field) for op, fields in VALID.items() for field in fields]
VECTORS = [(op, field) for op, field in REQUIRED if field not in ("color", "text")]


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture(scope="module")
def wire() -> Iterator[Wire]:
    with SimulatedServer() as server, Wire(server) as bare:
        bare.hello()
        yield bare


@pytest.mark.parametrize("op", VALID)
def test_replies_say_nothing_else(wire: Wire, op: str) -> None:
    extras = {"ttl": 2.5, "tag": "t", "label": "x", "thickness": 3, "arrow_size": 0.1, "scale": -1, "anchor": "nowhere"}
    extras |= {"rotation_quat": [0, 0, 1, 0], "rotation_euler": [1, 2, 3]}
    assert wire.ask(op, **VALID[op]) == {"op": f"{op}_ok"}
    assert wire.ask(op, **VALID[op], **extras) == {"op": f"{op}_ok"}


@pytest.mark.parametrize(("op", "field"), REQUIRED)
def test_required_fields(wire: Wire, op: str, field: str) -> None:
    code, message = wire.refusal(op, **{key: value for key, value in VALID[op].items() if key != field})
    assert code == "missing_field"
    assert field in message


@pytest.mark.parametrize(("op", "field"), VECTORS)
@pytest.mark.parametrize("value", [[1, 2], [], None, "x", [0, 0, math.nan]])
def test_malformed_vectors(wire: Wire, op: str, field: str, value: object) -> None:
    assert wire.refused(op, **{**VALID[op], field: value}) == "missing_field"


@pytest.mark.parametrize(
    ("color", "drawn"),
    [([1], (1.0, 1.0, 0.0)), (None, (1.0, 1.0, 0.0)), ("red", (1.0, 1.0, 0.0)), ([2, -1, math.nan], (1.0, 0.0, 0.0))],
)
def test_malformed_colors_are_replaced_or_cut(wire: Wire, color: object, drawn: tuple[float, float, float]) -> None:
    wire.ask("clear_markers")
    wire.ask("draw_marker", location=[0, 0, 0], color=color, ttl=-1)
    assert wire.core.drawings.take_frame(in_play=False) == [sphere((0.0, 0.0, 0.0), drawn)]


@pytest.mark.parametrize("op", ["draw_box", "draw_axes"])
def test_rotations_that_are_none(wire: Wire, op: str) -> None:
    assert wire.refused(op, **VALID[op], rotation_quat=[0, 0, 0, 0]) == "missing_field"
    assert wire.refused(op, **VALID[op], rotation_euler=[math.inf, 0, 0]) == "missing_field"
    wire.ask("clear_markers")
    wire.ask(op, **VALID[op], rotation_quat=[0, 0, 1])
    wire.ask(op, **VALID[op])
    drawn = wire.core.drawings.take_frame(in_play=False)
    assert drawn[: len(drawn) // 2] == drawn[len(drawn) // 2 :] != [], "a rotation that is not four numbers is none"


@pytest.mark.parametrize("text", ["", None])
def test_empty_overlay_text_clears_it(wire: Wire, text: object) -> None:
    wire.ask("set_overlay_text", text="hello")
    assert wire.core.drawings.overlay == "hello"
    wire.ask("set_overlay_text", text=text)
    assert wire.core.drawings.overlay == ""


def test_drawing_works_during_play(serve: Callable[..., Wire]) -> None:
    playing = serve("ball", play=True)
    drawings = playing.core.drawings
    for op in ("draw_marker", "draw_line", "draw_box", "draw_arrow", "draw_axes"):
        playing.ask(op, **VALID[op], ttl=-1)
        assert drawings.take_frame(in_play=True)
        playing.ask("clear_markers")
        assert (drawings.take_frame(in_play=True), drawings.take_frame(in_play=False)) == ([], [])


@pytest.mark.parametrize(
    ("op", "field", "default"),
    [
        ("draw_line", "thickness", 1.0),
        ("draw_arrow", "thickness", 1.0),
        ("draw_arrow", "arrow_size", 0.2),  # of a length of 1
        ("draw_axes", "scale", 0.2),
    ],
)
def test_sizes_that_are_none_are_the_default_ones(wire: Wire, op: str, field: str, default: float) -> None:
    def drawn(**fields: float) -> list[Primitive]:
        wire.ask("clear_markers")
        wire.ask(op, **VALID[op], **fields, ttl=-1)
        return wire.core.drawings.take_frame(in_play=False)

    expected = drawn(**{field: default})
    assert drawn() == drawn(**{field: math.nan}) == expected
    assert drawn(**{field: 2 * default}) != expected
    if field != "scale":
        assert drawn(**{field: 0.0}) == drawn(**{field: -1.0}) == drawn(**{field: math.inf}) == expected


@pytest.mark.parametrize(
    ("fields", "edges"),
    [
        ({"to": [0, 0, 1.34e154]}, 4),  # its square is larger than any number
        ({"from": [-1.7e308, 0, 0], "to": [1.7e308, 0, 0]}, 0),
        ({"to": [1, 1, 0], "arrow_size": 1.79e308}, 0),
        ({"from": [1, 2, 3], "to": [1, 2, 3]}, 0),
    ],
)
def test_an_arrow_of_any_size_is_drawn_and_has_a_head_where_there_is_room(
    wire: Wire, fields: dict[str, Any], edges: int
) -> None:
    wire.ask("clear_markers")
    wire.ask("draw_arrow", **VALID["draw_arrow"] | fields, ttl=-1)
    (drawn,) = wire.core.drawings.take_frame(in_play=False)
    assert len(drawn) == 1 + edges
    places = [value for stroke in drawn for value in (*stroke.at, *(stroke.end or ()))]
    assert all(map(math.isfinite, places))


def test_a_label_without_a_time_to_live_stays(wire: Wire) -> None:
    wire.ask("clear_markers")
    wire.ask("draw_marker", **VALID["draw_marker"], label="here")
    sphere_and_label = wire.core.drawings.take_frame(in_play=False)
    assert len(sphere_and_label) == 2
    assert wire.core.drawings.take_frame(in_play=False) == sphere_and_label[1:]


def test_colors_are_bytes_cut_off() -> None:
    assert _color((0.5, 2.0, -1.0)) == (127 / 255, 1.0, 0.0)


def ball(x: float) -> Primitive:
    return sphere((x, 0.0, 0.0), (1.0, 0.0, 0.0))


def test_time_to_live() -> None:
    clock = Clock()
    drawings = Drawings(clock)
    drawings.add([ball(0)], ttl=0.0, in_play=False)
    drawings.add([ball(1)], ttl=0.5, in_play=False)
    drawings.add([ball(2)], ttl=-1.0, in_play=False)
    assert drawings.take_frame(in_play=False) == [ball(0), ball(1), ball(2)]
    assert drawings.take_frame(in_play=False) == [ball(1), ball(2)]
    clock.now = 0.5
    assert drawings.take_frame(in_play=False) == [ball(2)]
    drawings.clear(in_play=False)
    assert drawings.take_frame(in_play=False) == []


def test_worlds_are_apart() -> None:
    drawings = Drawings(Clock())
    drawings.add([ball(0)], ttl=-1.0, in_play=False)
    drawings.add([ball(1)], ttl=-1.0, in_play=True)
    drawings.clear(in_play=True)
    assert drawings.take_frame(in_play=True) == []
    assert drawings.take_frame(in_play=False) == [ball(0)]


def test_overlay_lasts_ten_seconds() -> None:
    clock = Clock()
    drawings = Drawings(clock)
    assert drawings.overlay == ""
    drawings.set_overlay("one")
    drawings.set_overlay("two")
    clock.now = 9.9
    assert drawings.overlay == "two"
    clock.now = 10.0
    assert drawings.overlay == ""
    drawings.set_overlay("three")
    drawings.set_overlay("")
    assert drawings.overlay == ""


def test_the_oldest_gives_way(caplog: pytest.LogCaptureFixture) -> None:
    drawings = Drawings(Clock())
    drawn = line((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    drawings.add([ball(0)], ttl=-1.0, in_play=False)
    with caplog.at_level(logging.WARNING, logger="urlab_client.server"):
        drawings.add([drawn] * Limits.markers, ttl=-1.0, in_play=False)
    assert drawings.take_frame(in_play=False) == [drawn] * Limits.markers
    assert "clear_markers" in caplog.text


@pytest.mark.parametrize("op", ["create_level", "load_level"])
def test_another_level_has_no_drawings_of_the_one_before(wire: Wire, op: str) -> None:
    name = f"next_{op}"
    wire.ask("create_level", name=name, force_overwrite=True)
    wire.ask("draw_marker", **VALID["draw_marker"], ttl=-1)
    wire.ask(op, **({"name": name, "force_overwrite": True} if op == "create_level" else {"level_path": name}))
    assert wire.core.drawings.take_frame(in_play=False) == []
