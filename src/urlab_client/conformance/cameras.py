"""Checks of pictures: those in replies, those that are published, their numbers and their delays."""

from __future__ import annotations

import asyncio
import struct
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

from urlab_client.conformance.bench import Bench
from urlab_client.conformance.declarations import (
    ALPHA,
    BETA,
    NEWER,
    Body,
    Differs,
    Group,
    NotTried,
    check,
    expecting,
    has,
    holds,
    same,
)
from urlab_client.conformance.wire import Message
from urlab_client.protocol import shm
from urlab_client.values.pictures import PictureStamp, picture_stamp

pictured: Callable[..., Callable[[Body], Body]] = partial(check, group=Group.PLAY, needs=("camera",))

_WAIT: Final[dict[str, Any]] = {"render": "sync", "camera_timeout_ms": 10_000.0}
_HEADER: Final = 40
_DAY_S: Final = 86_400


async def _drawn(bench: Bench, how: Any = "sync", **fields: Any) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """Take a step with a picture of the first camera; return the reply and the picture."""
    name, info = bench.camera
    reply = await bench.step(include_cameras={name: how}, **fields)
    pictures: dict[str, dict[str, Any]] = reply.get("cameras") or {}
    same("names of pictures", set(), pictures.keys() - {name})
    picture = pictures.get(name)
    if picture is not None:
        size = int(picture["width"]), int(picture["height"])
        same("size", tuple(info.resolution), size)
        same("bytes", 4 * size[0] * size[1], len(picture["data"]))
        has(picture, dtype="float32" if info.mode == "depth" else "bgra8")
    return reply, picture


async def _fresh(bench: Bench, how: Any = "sync", **fields: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """Take steps until one brings a picture."""
    for _ in range(5):
        reply, picture = await _drawn(bench, how, **fields)
        if picture is not None:
            return reply, picture
    raise NotTried("needs a server that draws: five steps brought no picture")


@pictured("Session 8.4", dialects=ALPHA)
async def pictures_in_steps(bench: Bench) -> None:
    """A step brings the picture that it asks for, in the size of the handshake"""
    for how in ("sync", "latest"):
        await _fresh(bench, how)
    has(await bench.step(include_cameras={"no such camera": "latest"}), cameras=None)


@pictured("Beta 50", "Generation 2 25", dialects=BETA)
async def rendered_with_the_step(bench: Bench) -> None:
    """With `render` `sync` a step brings a picture of its own state, with the step's number and time"""
    await _fresh(bench, **_WAIT)
    before = 0
    for _ in range(3):
        reply, picture = await _fresh(bench, **_WAIT)
        same("fields", {"width", "height", "frame_id", "sim_time", "dtype", "data"}, set(picture))
        number, own = int(picture["frame_id"]), int(reply["frame_id"])
        holds(number >= own, f"frame_id {own} or more", number)
        holds(number > before, f"frame_id above {before}", number)
        if number == own:
            same("sim_time", float(reply["time"]), float(picture["sim_time"]), 1e-6)
        before = number


@pictured("Session 8.4", dialects=NEWER)
async def pictures_change(bench: Bench) -> None:
    """Pictures have the size of the handshake, and are not the same bytes for ever where the world moves"""
    first = bytes((await _fresh(bench, **_WAIT))[1]["data"])
    holds(any(first), "a picture that is not all zero", f"{len(first)} zero bytes")


@pictured("Beta 48", dialects=BETA)
async def bare_names(bench: Bench) -> None:
    """A camera's bare name means nothing, without error"""
    bare = bench.camera[0].partition("/")[2]
    has(await bench.step(include_cameras={bare: "latest"}), cameras=None)


@pictured("Beta 49", dialects=BETA)
async def pictures_in_live(bench: Bench) -> None:
    """A live step brings a picture"""
    await _fresh(bench, **_WAIT)  # it draws
    await bench.enter("live")
    for _ in range(5):
        if (await _drawn(bench, **_WAIT))[1] is not None:
            return
    raise Differs("a picture", "none in five steps")


@pictured("Beta 51", dialects=BETA)
async def short_waits(bench: Bench) -> None:
    """A step that waits a millisecond for its picture succeeds"""
    await _fresh(bench, **_WAIT)
    reply, picture = await _drawn(bench, render="sync", camera_timeout_ms=1.0)
    if picture is not None and int(picture["frame_id"]) < int(reply["frame_id"]):
        holds(float(picture["sim_time"]) <= float(reply["time"]), "an older sim_time", picture["sim_time"])


@pictured("Beta 52", "Generation 2 27", "Generation 2 28", dialects=NEWER)
async def pictures_by_number(bench: Bench) -> None:
    """A picture is asked for by number: one not drawn yet brings none, an earlier one that or a later"""
    _, picture = await _fresh(bench, **_WAIT)
    same("cameras", None, (await _drawn(bench, {"frame_id": 1e15}))[1])
    number = int(picture["frame_id"])
    found = (await _drawn(bench, {"frame_id": number}))[1]
    holds(found is None or int(found["frame_id"]) >= number, f"frame_id {number} or more, or none", found)


@pictured("Generation 2 26", dialects=NEWER)
async def pictures_stay(bench: Bench) -> None:
    """The newest picture is there for a second request"""
    await _fresh(bench, **_WAIT)
    for _ in range(2):
        holds((await _drawn(bench, "latest"))[1] is not None, "a picture", "none")


# Streams


async def _switch(bench: Bench, how: Any) -> dict[str, Any]:
    """Switch the stream of the first camera until the check is over; return its state."""
    name = bench.camera[0]
    if how is not False:
        bench.later("set_camera_streaming", cameras={name: False})
    reply = (await bench.ask("set_camera_streaming", cameras={name: how}))["cameras"]
    same("number of cameras", 1, len(reply))
    holds(bench.dialect != "beta" or name in reply, name, set(reply))
    return next(iter(reply.values()))


@pictured("Beta 53", "Generation 2 36", "Generation 2 37", "Generation 2 38", dialects=NEWER)
async def switch(bench: Bench) -> None:
    """Cameras are switched on twice alike, and off; unknown ones are left out"""
    first = await _switch(bench, {"zmq": True})
    has(first, streaming=True, zmq=True, shm=False)
    same("the same again", first, await _switch(bench, {"zmq": True}))
    has(await _switch(bench, False), streaming=False)
    same("cameras", {}, (await bench.ask("set_camera_streaming", cameras={"no such/camera": True}))["cameras"])
    await bench.refused("bad_request", "set_camera_streaming", cameras={})
    await bench.refused("missing_field", "set_camera_streaming")


def _stamp(bench: Bench, message: Message) -> PictureStamp:
    width, height = bench.camera[1].resolution
    with expecting("a picture with its header"):
        stamp = picture_stamp(message.payload, width, height)
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
            replies.append(await bench.step(n_steps=n_steps))
            await asyncio.sleep(0.02)

    messages, _ = await asyncio.gather(listen(), steps())
    return messages, replies


@pictured("Beta 56", "Generation 2 35", "Generation 2 40", dialects=NEWER)
async def streamed(bench: Bench) -> None:
    """Streamed pictures come under their topic and one space, with numbers, time and size before the pixels"""
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
            same(
                f"sim_time of picture {stamp.frame_id}", known.get(stamp.frame_id, stamp.sim_time), stamp.sim_time, 1e-6
            )


@pictured("Beta 55", "Generation 2 34", dialects=BETA)
async def streams_are_silent(bench: Bench) -> None:
    """A camera publishes nothing before it is switched on, nor while the simulation is paused"""
    endpoint = bench.endpoint(bench.camera[1].zmq_endpoint)
    await bench.enter("live")
    same("pictures", 0, len(await bench.wire.listen(endpoint, 2.0, bool)))
    told = await _switch(bench, {"zmq": True})
    await bench.enter("live", paused=True)
    await bench.wire.listen(bench.endpoint(told["zmq_endpoint"]), 0.5, lambda _: False)  # what was on its way
    same("pictures", 0, len(await bench.wire.listen(bench.endpoint(told["zmq_endpoint"]), 1.0, bool)))


@check("Transports 5.2", group=Group.PLAY, dialects=ALPHA, needs=("camera",))
async def streamed_bare(bench: Bench) -> None:
    """Streamed pictures come under their topic and one space, and are the pixels alone"""
    info = bench.camera[1]
    await bench.enter("live")
    messages = await bench.wire.listen(bench.endpoint(info.zmq_endpoint), 10.0, lambda got: len(got) >= 2)
    holds(messages, f"pictures at {info.zmq_endpoint}", "none within 10 s")
    topics = {f"{one.zmq_topic} ".encode() for robot in bench.robots for one in robot.info.camera_topics.values()}
    same("topics", set(), {message.topic for message in messages} - topics)
    sizes = {len(message.payload) for message in messages if message.topic == f"{info.zmq_topic} ".encode()}
    same("other sizes", set(), sizes - {4 * info.resolution[0] * info.resolution[1]})


@check("Beta 54", group=Group.PLAY, dialects=BETA, needs=("camera", "model"))
async def delays(bench: Bench) -> None:
    """With a delay, `latest` is old, and `sync` is not"""
    name, delay = bench.camera[0], 0.1
    bench.later("set_camera_delay", cameras={name: 0.0})
    told = (await bench.ask("set_camera_delay", cameras={name: delay}))["cameras"][name]
    same("fields", {"delay_s", "jitter_s", "clock", "on_state_change", "max_fps"}, set(told))
    has(told, 1e-6, delay_s=delay)
    each = max(1, round(0.02 / float(bench.compiled.opt.timestep)))
    for _ in range(11):
        await _drawn(bench, n_steps=each, **_WAIT)
    reply, newest = await _fresh(bench, n_steps=each, **_WAIT)
    holds(int(newest["frame_id"]) >= int(reply["frame_id"]), "a picture of the step with sync", newest["frame_id"])
    reply, latest = await _drawn(bench, "latest", n_steps=each)
    if latest is not None:
        age = float(reply["time"]) - float(latest["sim_time"])
        holds(age >= delay - 1e-3, f"a picture at least {delay} s old", f"{age:.4f} s")


@check("Beta 94", group=Group.PLAY, dialects=BETA, needs=("camera",))
async def long_delays(bench: Bench) -> None:
    """With a delay of 10 s a picture by number does not come, one with `sync` does"""
    name = bench.camera[0]
    bench.later("set_camera_delay", cameras={name: 0.0})
    await bench.ask("set_camera_delay", cameras={name: 10.0})
    reply, _ = await _fresh(bench, **_WAIT)
    same("cameras", None, (await _drawn(bench, {"frame_id": reply["frame_id"]}))[1])


@check("Generation 2 41", "Transports 6.8", group=Group.PLAY, dialects=NEWER, needs=("camera", "shm"))
async def camera_region(bench: Bench) -> None:
    """A camera's region has the size of its pictures and their header"""
    name, info = bench.camera
    await _fresh(bench, **_WAIT)  # the first picture takes seconds where a processor draws
    await _switch(bench, {"shm": True})
    file = shm.camera_file(*name.split("/", 1)) if "/" in name else shm.camera_file(bench.robot.key, name)
    folders = shm.region_directories(bench.plain_hello["shm_session_dir"], file)
    paths = [Path(folder) / file for folder in folders]
    for _ in range(400):
        await bench.step()
        path = next((path for path in paths if path.exists()), None)
        if path is not None and path.stat().st_size > shm.HEADER_SIZE:
            header = shm.parse_header(path.read_bytes())
            if header.sequence:
                same("stride", shm.camera_stride(*info.resolution) + _HEADER, header.stride)
                return
        await asyncio.sleep(0.05)
    raise Differs(f"{file} with a picture", "none within 20 s")
