"""Camera images in step replies, over a bare socket and drawn for real, and their colours."""

from __future__ import annotations

import concurrent.futures
import contextlib
import importlib
import logging
import math
import sys
import threading
import types
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from wire import Wire

from urlab_client.server import SimulatedServer
from urlab_client.simulation import drawing, opengl, painting
from urlab_client.simulation.appearance import APPEARANCE_TEXT, Appearance, tint
from urlab_client.simulation.drawing import NO_HIT_CM
from urlab_client.simulation.opengl import Backend, find_backend, free_context, make_context, search_backend

# Looks along +x at a wall 2 m away, whose upper half is red and whose lower half is blue.
WALL = """
<mujoco model="wall">
  <compiler angle="degree"/>
  <worldbody>
    <light pos="0 0 0" dir="1 0 0" directional="true"/>
    <camera name="eye" xyaxes="0 -1 0 0 0 1" fovy="60" resolution="40 30"/>
    <camera name="away" xyaxes="0 1 0 0 0 1" resolution="8 4"/>
    <camera name="flat" xyaxes="0 -1 0 0 0 1" projection="orthographic" fovy="2" resolution="8 4"/>
    <geom name="upper" type="box" pos="2.5 0 5" size="0.5 9 5" rgba="1 0 0 1"/>
    <geom name="lower" type="box" pos="2.5 0 -5" size="0.5 9 5" rgba="0 0 1 1"/>
    <site name="mark" pos="1 0 0" size="0.3"/>
  </worldbody>
</mujoco>
"""

# Looks down from 10 m at a ball, which falls.
DROP = """
<mujoco model="drop">
  <worldbody>
    <camera name="above" pos="0 0 10" fovy="20" resolution="31 31"/>
    <camera name="plain" pos="0 0 10"/>
    <body name="ball" pos="0 0 2"><freejoint name="root"/><geom name="ball" size="0.5" mass="1"/></body>
  </worldbody>
</mujoco>
"""

# Two blocks on one robot, seen from above.
PAIR = """
<mujoco model="pair">
  <worldbody>
    <camera name="above" pos="0 0 4" fovy="45" resolution="64 48"/>
    <body name="left" pos="-0.5 0 0"><joint name="l" type="slide"/><geom type="box" size=".3 .3 .3"/></body>
    <body name="right" pos="0.5 0 0"><joint name="r" type="slide"/><geom type="box" size=".3 .3 .3"/></body>
  </worldbody>
</mujoco>
"""


# Looks down at a floor with a ball over its middle, whose shadow falls to the left.
SHADE = """
<mujoco model="shade">
  <worldbody>
    <light pos="0 0 3" dir="-1 0 -1" directional="true"/>
    <camera name="above" pos="0 0 8" fovy="45" resolution="64 64"/>
    <geom type="plane" size="5 5 1"/>
    <geom type="sphere" size="0.7" pos="0 0 2.4"/>
  </worldbody>
</mujoco>
"""


# The same far from where the light is.
FAR_SHADE = (
    SHADE.replace('pos="0 0 8"', 'pos="30 0 8"')
    .replace('pos="0 0 2.4"', 'pos="30 0 2.4"')
    .replace('size="5 5 1"', 'size="50 50 1"')
)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    for name, text in {"wall": WALL, "drop": DROP, "pair": PAIR, "shade": SHADE, "far": FAR_SHADE}.items():
        (folder / f"{name}.xml").write_text(text)
    return folder


Play = Callable[..., Wire]


@pytest.fixture
def play(scenes: Path, connect: Callable[[SimulatedServer], Wire]) -> Iterator[Play]:
    servers: list[SimulatedServer] = []

    def start(*names: str, modes: dict[str, str] | None = None, step_mode: str = "direct", **options: Any) -> Wire:
        paths = [scenes / f"{name}.xml" for name in names]
        server = SimulatedServer(
            *paths, play=True, unpaused=True, step_mode=step_mode, camera_modes=modes or {}, **options
        )
        servers.append(server.start())
        wire = connect(server)
        wire.hello()
        return wire

    yield start
    for server in servers:
        server.close()


def pixels(frame: dict[str, Any]) -> np.ndarray[Any, Any]:
    """Check a frame's form and return its pixels."""
    assert set(frame) == {"width", "height", "dtype", "data"}
    width, height = int(frame["width"]), int(frame["height"])
    assert len(frame["data"]) == width * height * 4
    if frame["dtype"] == "float32":
        return np.frombuffer(frame["data"], "<f4").reshape(height, width)
    assert frame["dtype"] == "bgra8"
    image = np.frombuffer(frame["data"], np.uint8).reshape(height, width, 4)
    assert (image[:, :, 3] == 255).all()
    return image


@pytest.mark.opengl
def test_colors_come_as_bgra_from_the_top(play: Play) -> None:
    image = pixels(play("wall").ask("step", include_cameras={"wall/eye": "sync"})["cameras"]["wall/eye"])
    assert image.shape == (30, 40, 4)
    blue, _, red = (image[:, :, channel].astype(int) for channel in range(3))
    assert (red[:14] > blue[:14] + 50).all()
    assert (blue[16:] > red[16:] + 50).all()


@pytest.mark.opengl
def test_shadows_are_a_matter_of_quality(play: Play) -> None:
    below_the_ball = {}
    for quality in ("auto", "fast", "high"):
        wire = play("shade", render_quality=quality)
        image = pixels(wire.ask("step", include_cameras={"above": "sync"})["cameras"]["above"])
        below_the_ball[quality] = int(image[32, 8, :3].sum()) / int(image[8, 8, :3].sum())
    assert below_the_ball["fast"] > 0.95
    assert below_the_ball["high"] < 0.8
    backend = find_backend()
    assert backend is not None
    assert below_the_ball["auto"] == below_the_ball["fast" if backend.software else "high"]


@pytest.mark.opengl
def test_shadows_follow_what_the_picture_shows(play: Play) -> None:
    image = pixels(
        play("far", render_quality="high").ask("step", include_cameras={"above": "sync"})["cameras"]["above"]
    )
    assert int(image[32, 8, :3].sum()) < 0.8 * int(image[8, 8, :3].sum())


def test_an_unknown_quality_is_refused() -> None:
    with pytest.raises(ValueError, match="auto, fast, high"):
        SimulatedServer(render_quality="best")  # type: ignore[arg-type]  # what is tested


@pytest.mark.parametrize("text", ["{", "[]", '{"quality": 3}', '{"x": ' + "[" * 20_000], ids=lambda text: text[:9])
def test_a_scene_that_tells_its_appearance_wrongly_is_refused(text: str) -> None:
    spec = mujoco.MjSpec()
    spec.add_text(name=APPEARANCE_TEXT, data=text)
    with pytest.raises(ValueError, match=f"the scene's text '{APPEARANCE_TEXT}': "):
        Appearance.of(spec.compile())


@pytest.mark.opengl
def test_depth_is_planar_and_in_centimetres(play: Play) -> None:
    wire = play("wall", modes={f"wall/{name}": "depth" for name in ("eye", "away", "flat")})
    cameras = wire.ask("step", include_cameras=dict.fromkeys(("eye", "away", "flat"), "sync"))["cameras"]
    assert pixels(cameras["eye"]) == pytest.approx(np.full((30, 40), 200.0), rel=1e-4)
    assert pixels(cameras["flat"]) == pytest.approx(np.full((4, 8), 200.0), rel=1e-4)
    assert (pixels(cameras["away"]) == np.float32(NO_HIT_CM)).all()


@pytest.mark.opengl
def test_the_vertical_field_of_view_is_true(play: Play) -> None:
    wire = play("drop", modes={"drop/above": "semantic"})
    image = pixels(wire.ask("step", include_cameras={"above": "sync"})["cameras"]["above"])
    rows = np.flatnonzero(image[:, :, :3].any(axis=(1, 2)))
    angle = 2 * math.degrees(math.asin(0.5 / 8.0))
    assert len(rows) == pytest.approx(31 * angle / 20, abs=1.5)


@pytest.mark.opengl
def test_sync_shows_the_state_after_the_step(play: Play) -> None:
    wire = play("drop", modes={"drop/above": "depth"})
    for _ in range(5):
        reply = wire.ask("step", n_steps=50, include_cameras={"above": "SYNC"})
        top = reply["per_articulation"]["drop"]["qpos"][2] + 0.5
        assert pixels(reply["cameras"]["above"])[15, 15] == pytest.approx(100 * (10 - top), abs=0.02)


@pytest.mark.opengl
def test_a_long_step_shows_its_end(play: Play) -> None:
    wire = play("drop", modes={"drop/above": "depth"})
    wire.ask("reset")
    reply = wire.ask("step", n_steps=400, include_cameras={"above": "sync"})
    top = reply["per_articulation"]["drop"]["qpos"][2] + 0.5
    assert pixels(reply["cameras"]["above"])[15, 15] == pytest.approx(100 * (10 - top), rel=1e-4)


@pytest.mark.opengl
def test_puppet_shows_what_was_pushed(play: Play) -> None:
    wire = play("drop", modes={"drop/above": "depth"}, step_mode="puppet")
    for height in (0.0, 5.0):
        reply = wire.ask("step", qpos=[0, 0, height, 1, 0, 0, 0], include_cameras={"drop/above": "sync"})
        assert pixels(reply["cameras"]["drop/above"])[15, 15] == pytest.approx(100 * (9.5 - height), rel=1e-4)


@pytest.mark.opengl
def test_keys_are_those_of_the_request(play: Play) -> None:
    wire = play("drop", "wall")
    wanted = {
        "drop/above": "sync",
        "above": "latest",
        "eye": "anything",
        "nobody": "sync",
        "x/eye": "sync",
        "away": None,
    }
    assert set(wire.ask("step", include_cameras=wanted)["cameras"]) == {"drop/above", "above", "eye"}
    assert set(wire.ask("step", include_cameras=True)["cameras"]) == {"above", "plain", "eye", "away", "flat"}


@pytest.mark.parametrize("wanted", [False, {}, {"nobody": "sync"}, {"above": None}, None])
def test_without_a_frame_there_is_no_block(play: Play, wanted: object) -> None:
    assert "cameras" not in play("drop").ask("step", include_cameras=wanted)


def test_live_ignores_cameras(play: Play) -> None:
    assert "cameras" not in play("drop", step_mode="live").ask("step", include_cameras={"above": "sync"})


@pytest.mark.opengl
def test_a_bare_name_means_the_last_robot(play: Play) -> None:
    wire = play("wall", "wall", modes={"wall/eye": "depth", "copy1_wall/eye": "real"})
    frame = wire.ask("step", include_cameras={"eye": "sync", "wall/eye": "sync"})["cameras"]
    assert frame["eye"]["dtype"] == "bgra8"
    assert frame["wall/eye"]["dtype"] == "float32"


@pytest.mark.opengl
def test_latest_is_always_there(play: Play) -> None:
    wire = play("drop")
    for _ in range(3):
        frames = wire.ask("step", include_cameras={"above": "latest"})["cameras"]
        assert set(frames) == {"above"}


@pytest.mark.opengl
def test_handshake_and_frames_agree(play: Play) -> None:
    wire = play("drop", camera_size=(24, 16))
    topics = wire.hello()["articulations"][0]["camera_topics"]
    assert topics["plain"]["resolution"] == [24, 16]
    assert topics["plain"]["fovy"] == 45.0
    assert topics["plain"]["mode"] == "real"
    assert pixels(wire.ask("step", include_cameras={"plain": "sync"})["cameras"]["plain"]).shape == (16, 24, 4)


def colors(image: np.ndarray[Any, Any]) -> set[tuple[int, int, int]]:
    """Return red, green, blue of all pixels."""
    return {(int(red), int(green), int(blue)) for blue, green, red, _ in image.reshape(-1, 4)}


@pytest.mark.opengl
def test_one_class_has_one_semantic_color(play: Play) -> None:
    wire = play("pair", "pair", modes={"pair/above": "semantic", "copy1_pair/above": "semantic"})
    frames = wire.ask("step", include_cameras={"pair/above": "sync", "copy1_pair/above": "sync"})["cameras"]
    expected = {(0, 0, 0), tint(zlib.crc32(b"pair_C"), None)}
    assert [colors(pixels(frame)) for frame in frames.values()] == [expected, expected]


@pytest.mark.opengl
def test_each_body_has_an_instance_color(play: Play) -> None:
    wire = play("pair", "pair", modes={"pair/above": "instance", "copy1_pair/above": "instance"})
    frames = wire.ask("step", include_cameras={"pair/above": "sync", "copy1_pair/above": "sync"})["cameras"]
    group = zlib.crc32(b"pair_C")
    first, second = (colors(pixels(frame)) - {(0, 0, 0)} for frame in frames.values())
    assert {tint(group, 1), tint(group, 2)} <= first
    assert {tint(group, 3), tint(group, 4)} <= second


def test_tints_follow_the_formula() -> None:
    # Seed 1: hue 1/7, saturation 2/3, value 0.68; seed 2: 2/7, 5/6, 0.76.
    assert tint(0, None) == (173, 157, 58)
    assert tint(1, None) == (78, 194, 32)
    assert tint(0, 1) == tint(1, None)
    assert tint(0x80000000, None) == tint(0, None)


def test_without_opengl_frames_are_left_out(
    play: Play, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "off")
    wire = play("drop")
    with caplog.at_level(logging.WARNING, logger="urlab_client.server"):
        for _ in range(3):
            assert "cameras" not in wire.ask("step", n_steps=2, include_cameras={"above": "sync"})
    assert wire.ask("step")["step"] == 7
    assert [record.message for record in caplog.records if "camera images" in record.message] == [
        "camera images are left out: MUJOCO_GL=off disables OpenGL; unset it"
    ]


def test_a_machine_without_opengl_is_told_what_to_install(
    play: Play, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(opengl, "_candidates", lambda choice: ("egl", "osmesa"))
    monkeypatch.setattr(opengl, "_PROBE", "raise SystemExit('no {name} today')")
    monkeypatch.setattr(opengl, "_find", opengl._find.__wrapped__)
    wire = play("drop")
    with caplog.at_level(logging.WARNING, logger="urlab_client.server"):
        assert "cameras" not in wire.ask("step", include_cameras={"above": "sync"})
        assert "cameras" not in wire.ask("step", include_cameras={"above": "sync"})
    (message,) = [record.message for record in caplog.records if "camera images" in record.message]
    assert ("apt install libegl1" if sys.platform == "linux" else "install a graphics driver") in message
    assert "egl: no egl today; osmesa: no osmesa today" in message


def test_a_driver_that_kills_its_process_kills_no_server(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor is what Python's fault handler says of it taken for the reason."""
    monkeypatch.setenv("PYTHONFAULTHANDLER", "1")
    monkeypatch.setattr(opengl, "_PROBE", "import os; os.abort()  # {name}")
    assert "exited with code" in str(opengl._probe("egl"))


def fail(*arguments: object) -> None:
    raise RuntimeError("the driver is gone")


@pytest.mark.opengl
def test_a_frame_that_cannot_be_drawn_is_left_out_alone(play: Play, monkeypatch: pytest.MonkeyPatch) -> None:
    wire = play("drop")
    for _ in range(painting.MAX_FAILED):
        with monkeypatch.context() as patch:
            patch.setattr(drawing.Stage, "draw", fail)
            assert "cameras" not in wire.ask("step", include_cameras={"above": "sync"})
        assert "cameras" in wire.ask("step", include_cameras={"above": "sync"})


@pytest.mark.opengl
def test_drawing_that_fails_again_and_again_is_given_up(
    play: Play, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    wire = play("drop")
    with monkeypatch.context() as patch, caplog.at_level(logging.ERROR, logger="urlab_client.server"):
        patch.setattr(drawing.Stage, "draw", fail)
        for _ in range(painting.MAX_FAILED + 1):
            assert "cameras" not in wire.ask("step", include_cameras={"above": "sync"})
    assert caplog.text.count("drawing failed") == 1
    assert "cameras" not in wire.ask("step", include_cameras={"above": "sync"})
    wire.ask("stop_pie")
    wire.ask("begin_pie")
    assert "cameras" in wire.ask("step", include_cameras={"above": "sync"})


def test_the_backend_is_looked_for_once() -> None:
    assert search_backend() is search_backend()


@pytest.mark.opengl
def test_play_can_start_again(play: Play) -> None:
    wire = play("drop")
    for _ in range(2):
        assert wire.ask("step", include_cameras={"above": "sync"})["cameras"]
        wire.ask("stop_pie")
        wire.ask("begin_pie")


def test_contexts_are_made_and_freed_one_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """GLFW crashes where two threads are in it: two servers of a process on Windows."""
    both = threading.Barrier(2)
    met: list[str] = []

    class Context:
        def __init__(self, width: int, height: int) -> None:
            self.meet("making")

        def make_current(self) -> None:
            self.meet("making current")

        def free(self) -> None:
            self.meet("freeing")

        def meet(self, what: str) -> None:
            with contextlib.suppress(threading.BrokenBarrierError):
                both.wait(0.1)
                met.append(what)

    def one(_: int) -> None:
        free_context(make_context(Backend("glfw", "a card"), 16, 16), sound=False)

    monkeypatch.setitem(sys.modules, "mujoco.glfw", types.SimpleNamespace(GLContext=Context))
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        list(pool.map(one, range(2)))
    assert met == []


@pytest.mark.opengl
def test_the_next_play_session_draws_with_the_context_of_the_one_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """A new one compiles its shaders, which takes ten times as long as a picture without a graphics card."""
    backend = find_backend()
    assert backend is not None
    module = importlib.import_module(f"mujoco.{backend.name}")
    made: list[Any] = []
    monkeypatch.setattr(module, "GLContext", lambda *size, make=module.GLContext: made.append(make(*size)) or made[-1])
    pictures: list[bytes] = []
    for name in ("arm", "quadruped", "arm"):
        with SimulatedServer(name, play=True) as server:
            pictures.append(server.snapshot((64, 48)).tobytes())
    assert pictures[0] == pictures[2] != pictures[1]
    assert len(made) <= 1 if backend.name == "egl" else len(made) == 3
