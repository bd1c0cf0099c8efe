"""Checks of pictures: those in replies, those that are published, their numbers and their delays."""

from __future__ import annotations

import asyncio
import struct
import time
from pathlib import Path
from typing import Any, Final

from urlab_client.conformance.bench import Bench, holds, same
from urlab_client.conformance.declarations import ALPHA, BETA, NEWER, Differs, Group, NotTried, check
from urlab_client.conformance.wire import Message
from urlab_client.errors import ProtocolError
from urlab_client.protocol import shm
from urlab_client.values.pictures import PictureStamp, picture_stamp

PLAY: Final = Group.PLAY
_WAIT_MS: Final = 10_000.0
_HEADER: Final = 40
_DAY_S: Final = 86_400


async def _drawn(bench: Bench, how: Any = "sync", **fields: Any) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """Take a step with a picture of the first camera; return the reply and the picture."""
    name, info = bench.camera
    reply = await bench.wire.ask("step", include_cameras={name: how}, **fields)
    pictures: dict[str, dict[str, Any]] = reply.get("cameras") or {}
    same("names of pictures", set(), pictures.keys() - {name})
    picture = pictures.get(name)
    if picture is not None:
        size = int(picture["width"]), int(picture["height"])
        same("size", tuple(info.resolution), size)
        same("bytes", 4 * size[0] * size[1], len(picture["data"]))
        same("dtype", "float32" if info.mode == "depth" else "bgra8", picture["dtype"])
    return reply, picture


async def _fresh(bench: Bench) -> tuple[dict[str, Any], dict[str, Any]]:
    """Take steps until one brings a picture of its own."""
    for _ in range(5):
        reply, picture = await _drawn(bench, render="sync", camera_timeout_ms=_WAIT_MS)
        if picture is not None:
            return reply, picture
    raise NotTried("needs a server that draws: five steps brought no picture")


@check("Session 8.4", group=PLAY, dialects=ALPHA, needs=("camera",))
async def pictures_in_steps(bench: Bench) -> None:
    """A step brings the picture that it asks for, in the size of the handshake"""
    await bench.direct()
    for how in ("sync", "latest"):
        for _ in range(5):
            if (await _drawn(bench, how))[1] is not None:
                break
        else:
            raise NotTried("needs a server that draws: five steps brought no picture")
    reply = await bench.wire.ask("step", include_cameras={"no such camera": "latest"})
    same("pictures of an unknown camera", None, reply.get("cameras"))


@check("Beta 50", "Generation 2 25", group=PLAY, dialects=BETA, needs=("camera",))
async def rendered_with_the_step(bench: Bench) -> None:
    """With `render` `sync` a step brings a picture of its own state, with the step's number and time"""
    await bench.direct()
    await _fresh(bench)
    before = 0
    for _ in range(3):
        reply, picture = await _fresh(bench)
        same("fields", {"width", "height", "frame_id", "sim_time", "dtype", "data"}, set(picture))
        number, own = int(picture["frame_id"]), int(reply["frame_id"])
        holds(number >= own, f"frame_id {own} or more", number)
        holds(number > before, f"frame_id above {before}", number)
        if number == own:
            same("sim_time", float(reply["time"]), float(picture["sim_time"]), 1e-6)
        before = number


@check("Session 8.4", group=PLAY, dialects=NEWER, needs=("camera",))
async def pictures_change(bench: Bench) -> None:
    """Pictures have the size of the handshake, and are not the same bytes for ever where the world moves"""
    await bench.direct()
    first = bytes((await _fresh(bench))[1]["data"])
    holds(any(first), "a picture that is not all zero", f"{len(first)} zero bytes")


@check("Beta 48", group=PLAY, dialects=BETA, needs=("camera",))
async def bare_names(bench: Bench) -> None:
    """A camera's bare name means nothing, without error"""
    await bench.direct()
    bare = bench.camera[0].partition("/")[2]
    same("cameras", None, (await bench.wire.ask("step", include_cameras={bare: "latest"})).get("cameras"))


@check("Beta 49", group=PLAY, dialects=BETA, needs=("camera",))
async def pictures_in_live(bench: Bench) -> None:
    """A live step brings a picture"""
    await bench.direct()
    bench.later("set_mode", mode="direct")
    await bench.wire.ask("set_mode", mode="live")
    await bench.wire.ask("set_paused", paused=False)
    await _fresh(bench)


@check("Beta 51", group=PLAY, dialects=BETA, needs=("camera",))
async def short_waits(bench: Bench) -> None:
    """A step that waits a millisecond for its picture succeeds"""
    await bench.direct()
    await _fresh(bench)
    reply, picture = await _drawn(bench, render="sync", camera_timeout_ms=1.0)
    if picture is not None and int(picture["frame_id"]) < int(reply["frame_id"]):
        holds(float(picture["sim_time"]) <= float(reply["time"]), "an older sim_time", picture["sim_time"])


@check("Beta 52", "Generation 2 27", "Generation 2 28", group=PLAY, dialects=NEWER, needs=("camera",))
async def pictures_by_number(bench: Bench) -> None:
    """A picture is asked for by number: one not drawn yet brings none, an earlier one that or a later"""
    await bench.direct()
    _, picture = await _fresh(bench)
    same("cameras", None, (await _drawn(bench, {"frame_id": 1e15}))[1])
    number = int(picture["frame_id"])
    found = (await _drawn(bench, {"frame_id": number}))[1]
    holds(found is None or int(found["frame_id"]) >= number, f"frame_id {number} or more, or none", found)


@check("Generation 2 26", group=PLAY, dialects=NEWER, needs=("camera",))
async def pictures_stay(bench: Bench) -> None:
    """The newest picture is there for a second request"""
    await bench.direct()
    await _fresh(bench)
    for _ in range(2):
        holds((await _drawn(bench, "latest"))[1] is not None, "a picture", "none")


async def _switch(bench: Bench, how: Any) -> dict[str, Any]:
    name = bench.camera[0]
    reply = (await bench.wire.ask("set_camera_streaming", cameras={name: how}))["cameras"]
    same("names", {name} if bench.dialect == "beta" else set(reply), set(reply))
    return next(iter(reply.values()))


@check("Beta 53", "Generation 2 37", "Generation 2 38", group=PLAY, dialects=NEWER, needs=("camera",))
async def switch(bench: Bench) -> None:
    """Cameras are switched on twice alike, and off; unknown ones are left out"""
    bench.later("set_camera_streaming", cameras={bench.camera[0]: False})
    first = await _switch(bench, {"zmq": True})
    same("state", (True, True, False), (first["streaming"], first["zmq"], first["shm"]))
    same("the same again", first, await _switch(bench, {"zmq": True}))
    off = await _switch(bench, False)
    same("streaming", False, off["streaming"])
    same("cameras", {}, (await bench.wire.ask("set_camera_streaming", cameras={"no such/camera": True}))["cameras"])
    await bench.wire.refused("bad_request", "set_camera_streaming", cameras={})
    await bench.wire.refused("missing_field", "set_camera_streaming")


def _stamp(bench: Bench, message: Message) -> PictureStamp:
    width, height = bench.camera[1].resolution
    try:
        stamp = picture_stamp(message.payload, width, height)
    except ProtocolError as error:
        raise Differs("a picture with its header", str(error)) from error
    if stamp is None:
        raise Differs(f"a header of {_HEADER} bytes and {4 * width * height} of pixels", len(message.payload))
    return stamp


async def _watch(bench: Bench, endpoint: str, count: int, n_steps: int) -> tuple[list[Message], list[dict[str, Any]]]:
    """Step while a camera streams; return its messages and the replies."""
    replies: list[dict[str, Any]] = []
    heard = asyncio.Event()

    async def listen() -> list[Message]:
        try:
            return await bench.wire.listen(bench.endpoint(endpoint), 15.0, lambda got: len(got) >= count)
        finally:
            heard.set()

    async def steps() -> None:
        while not heard.is_set():
            replies.append(await bench.wire.ask("step", n_steps=n_steps))
            await asyncio.sleep(0.02)

    messages, _ = await asyncio.gather(listen(), steps())
    return messages, replies


@check("Beta 56", "Generation 2 35", "Generation 2 40", group=PLAY, dialects=NEWER, needs=("camera",))
async def streamed(bench: Bench) -> None:
    """Streamed pictures come under their topic and one space, with numbers, time and size before the pixels"""
    await bench.direct()
    bench.later("set_camera_streaming", cameras={bench.camera[0]: False})
    told = await _switch(bench, {"zmq": True})
    messages, replies = await _watch(bench, told["zmq_endpoint"], 3, 2)
    holds(messages, f"pictures at {told['zmq_endpoint']}", "none within 15 s")
    same("topics", {f"{told['zmq_topic']} ".encode()}, {message.topic for message in messages})
    stamps = [_stamp(bench, message) for message in messages]
    numbers = [stamp.frame_id for stamp in stamps]
    holds(numbers == sorted(numbers), "numbers that do not decrease", numbers)
    holds(len(set(numbers)) > 1, "numbers that grow with the steps", numbers)
    captured = [struct.unpack_from("<d", message.payload, _HEADER - 8)[0] for message in messages]
    holds(all(abs(at - time.time()) < _DAY_S for at in captured), "Unix times of this day", captured)
    if bench.dialect == "beta":
        known = {int(reply["frame_id"]): float(reply["time"]) for reply in replies}
        for stamp in stamps:
            if stamp.frame_id in known:
                same(f"sim_time of picture {stamp.frame_id}", known[stamp.frame_id], stamp.sim_time, 1e-6)


@check("Transports 5.2", group=PLAY, dialects=ALPHA, needs=("camera",))
async def streamed_bare(bench: Bench) -> None:
    """Streamed pictures come under their topic and one space, and are the pixels alone"""
    name, info = bench.camera
    del name
    await bench.direct()
    bench.later("set_mode", mode="direct")
    await bench.wire.ask("set_mode", mode="live")
    messages = await bench.wire.listen(bench.endpoint(info.zmq_endpoint), 10.0, lambda got: len(got) >= 2)
    holds(messages, f"pictures at {info.zmq_endpoint}", "none within 10 s")
    topics = {f"{one.zmq_topic} ".encode() for robot in bench.robots for one in robot.info.camera_topics.values()}
    same("topics", set(), {message.topic for message in messages} - topics)
    mine = [message for message in messages if message.topic == f"{info.zmq_topic} ".encode()]
    for message in mine:
        same("bytes", 4 * info.resolution[0] * info.resolution[1], len(message.payload))


@check("Beta 54", group=PLAY, dialects=BETA, needs=("camera", "model"))
async def delays(bench: Bench) -> None:
    """With a delay, `latest` is old, and `sync` is not"""
    await bench.direct()
    name = bench.camera[0]
    bench.later("set_camera_delay", cameras={name: 0.0})
    delay = 0.1
    told = (await bench.wire.ask("set_camera_delay", cameras={name: delay}))["cameras"][name]
    same("fields", {"delay_s", "jitter_s", "clock", "on_state_change", "max_fps"}, set(told))
    holds(abs(float(told["delay_s"]) - delay) < 1e-6, f"delay_s {delay}", told["delay_s"])
    each = max(1, round(0.02 / float(bench.compiled.opt.timestep)))
    for _ in range(11):
        await _drawn(bench, "sync", render="sync", camera_timeout_ms=_WAIT_MS, n_steps=each)
    reply, newest = await _drawn(bench, "sync", render="sync", camera_timeout_ms=_WAIT_MS, n_steps=each)
    if newest is None:
        raise NotTried("needs a server that draws")
    holds(int(newest["frame_id"]) >= int(reply["frame_id"]), "a picture of the step with sync", newest["frame_id"])
    reply, latest = await _drawn(bench, "latest", n_steps=each)
    if latest is not None:
        age = float(reply["time"]) - float(latest["sim_time"])
        holds(age >= delay - 1e-3, f"a picture at least {delay} s old", f"{age:.4f} s")


@check("Generation 2 41", "Transports 6.8", group=PLAY, dialects=NEWER, needs=("camera", "shm"))
async def camera_region(bench: Bench) -> None:
    """A camera's region has the size of its pictures and their header"""
    await bench.direct()
    name, info = bench.camera
    await _fresh(bench)  # the first picture takes seconds where a processor draws
    bench.later("set_camera_streaming", cameras={name: False})
    await _switch(bench, {"shm": True})
    file = shm.camera_file(*name.split("/", 1)) if "/" in name else shm.camera_file(bench.robot.key, name)
    folders = shm.region_directories(bench.plain_hello["shm_session_dir"], file)
    paths = [Path(folder) / file for folder in folders]
    for _ in range(400):
        await bench.wire.ask("step")
        path = next((path for path in paths if path.exists()), None)
        if path is not None and path.stat().st_size > shm.HEADER_SIZE:
            header = shm.parse_header(path.read_bytes())
            if header.sequence:
                same("stride", shm.camera_stride(*info.resolution) + _HEADER, header.stride)
                return
        await asyncio.sleep(0.05)
    raise Differs(f"{file} with a picture", "none within 20 s")
