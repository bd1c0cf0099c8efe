"""Streams and latencies of cameras as users set them, beside what streams need by themselves; names of step modes."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path
from typing import Any

import pytest
from scripted import client_of
from scripted_beta import ROBOT, ScriptedBeta
from waiting import DEADLINE_S, pass_time, until

from urlab_client.aio import URLabClient
from urlab_client.errors import UnknownOp
from urlab_client.server import SimulatedServer
from urlab_client.types import CameraDelay, CameraTransports

BOTH, NEITHER = (True, True), (False, False)


@pytest.fixture
def client(beta_client: URLabClient) -> URLabClient:
    return beta_client


async def streams(beta: ScriptedBeta, expected: tuple[bool, bool], name: str = "arm_a/wrist") -> None:
    """Wait until a camera streams so."""
    await until(lambda: beta.streaming.get(name, NEITHER) == expected)


async def test_cameras_are_switched_by_the_users_names(client: URLabClient, beta: ScriptedBeta) -> None:
    told = await client.runtime.set_camera_streaming({"arm a/wrist": True, "arm_C_1/wrist": CameraTransports(zmq=True)})
    assert list(told) == ["arm a/wrist", "arm_C_1/wrist"]
    assert (told["arm a/wrist"].zmq, told["arm a/wrist"].shm) == BOTH
    assert told["arm_C_1/wrist"].zmq_topic == "arm_C_1/wrist"
    assert beta.streaming == {"arm_a/wrist": BOTH, "arm_C_1/wrist": (True, False)}
    assert await client.runtime.set_camera_streaming({}) == {}
    for unknown in ("wrist", "elbow", "arm_a/elbow"):
        with pytest.raises(KeyError, match=unknown):
            await client.runtime.set_camera_streaming({unknown: True})


async def test_a_camera_that_was_switched_on_stays_on_when_its_stream_ends(
    client: URLabClient, beta: ScriptedBeta
) -> None:
    await client.runtime.set_camera_streaming({"arm_a/wrist": True})
    other = client.articulations["arm_C_1"].cameras["wrist"]
    async with client.articulations["arm_a"].cameras["wrist"].frames(), other.frames():
        await streams(beta, BOTH, "arm_C_1/wrist")
    await streams(beta, NEITHER, "arm_C_1/wrist")
    assert beta.streaming["arm_a/wrist"] == BOTH
    await client.close()
    assert beta.streaming["arm_a/wrist"] == BOTH


async def test_a_camera_that_was_switched_off_waits_for_the_next_stream(
    client: URLabClient, beta: ScriptedBeta
) -> None:
    camera = client.articulations["arm_a"].cameras["wrist"]
    other = client.articulations["arm_C_1"].cameras["wrist"]
    async with camera.frames():
        await streams(beta, BOTH)
        await client.runtime.set_camera_streaming({"arm_a/wrist": False})
        # What other cameras need does not switch this one on again.
        async with other.frames():
            await streams(beta, BOTH, "arm_C_1/wrist")
        assert beta.streaming["arm_a/wrist"] == NEITHER
        async with camera.frames():
            await streams(beta, BOTH)
    await streams(beta, NEITHER)


async def test_a_camera_stays_on_for_the_stream_that_is_left(client: URLabClient, beta: ScriptedBeta) -> None:
    camera = client.articulations["arm_a"].cameras["wrist"]
    other = client.articulations["arm_C_1"].cameras["wrist"]
    async with camera.frames():
        async with camera.frames():
            await streams(beta, BOTH)
        async with other.frames():
            await streams(beta, BOTH, "arm_C_1/wrist")
        await streams(beta, NEITHER, "arm_C_1/wrist")
        assert beta.streaming["arm_a/wrist"] == BOTH
    await streams(beta, NEITHER)


async def test_background_pictures_do_not_switch_a_camera_on_again(beta: ScriptedBeta) -> None:
    async with URLabClient("tcp://127.0.0.1", step_port=beta.port) as client:
        await client.discover()
        await client.runtime.set_mode("live")
        await streams(beta, BOTH)
        await streams(beta, BOTH, "arm_C_1/wrist")
        await client.runtime.set_camera_streaming({"arm_a/wrist": False})
        await client.runtime.set_mode("direct")
        await streams(beta, NEITHER, "arm_C_1/wrist")
        await client.runtime.set_mode("live")
        await streams(beta, BOTH, "arm_C_1/wrist")
        assert beta.streaming["arm_a/wrist"] == NEITHER


async def test_a_stream_adds_the_socket_it_needs(client: URLabClient, beta: ScriptedBeta) -> None:
    await client.runtime.set_camera_streaming({"arm_a/wrist": CameraTransports(shm=True)})
    async with client.articulations["arm_a"].cameras["wrist"].frames():
        await streams(beta, BOTH)
    await streams(beta, (False, True))


async def test_what_was_set_ends_with_play(client: URLabClient, beta: ScriptedBeta) -> None:
    await client.runtime.set_camera_streaming({"arm_a/wrist": True})
    await client.discover()  # another handshake, the same play
    await streams(beta, BOTH)
    await client.sim.stop()
    await client.sim.start()
    other = client.articulations["arm_C_1"].cameras["wrist"]
    async with other.frames():
        await streams(beta, BOTH, "arm_C_1/wrist")
    assert beta.streaming.get("arm_a/wrist", NEITHER) == NEITHER


def never_heard(beta: ScriptedBeta) -> None:
    """The next requests to switch cameras are carried out, and their replies are lost."""
    beta.on("set_camera_streaming", lambda request: beta._set_camera_streaming(request) and None)


async def test_an_abandoned_switch_is_undone_for_certain(client: URLabClient, beta: ScriptedBeta) -> None:
    answer = beta.answers["set_camera_streaming"]
    never_heard(beta)
    abandoned = asyncio.create_task(client.runtime.set_camera_streaming({"arm_a/wrist": True}))
    await streams(beta, BOTH)
    beta.on("set_camera_streaming", answer)
    abandoned.cancel()
    await asyncio.wait((abandoned,))
    await client.resync()
    assert beta.streaming["arm_a/wrist"] == NEITHER


async def test_a_stream_whose_switch_timed_out_is_switched_off_in_the_end(
    client: URLabClient, beta: ScriptedBeta
) -> None:
    answer = beta.answers["set_camera_streaming"]
    never_heard(beta)
    async with client.articulations["arm_a"].cameras["wrist"].frames():
        await streams(beta, BOTH)
        beta.on("set_camera_streaming", answer)
        pass_time(DEADLINE_S)
        await client.runtime.set_paused(False)  # the line is free: that request has been given up
    await streams(beta, NEITHER)


async def test_latencies(client: URLabClient, beta: ScriptedBeta) -> None:
    told = await client.runtime.set_camera_delay(
        {"arm a/wrist": 0.25, "arm_C_1/wrist": CameraDelay(delay_s=0.5, jitter_s=0.1, clock="wall", max_fps=30)}
    )
    assert (told["arm a/wrist"].delay_s, told["arm a/wrist"].clock) == (0.25, "sim")
    assert (told["arm_C_1/wrist"].jitter_s, told["arm_C_1/wrist"].max_fps) == (0.1, 30)
    sent = beta.of("set_camera_delay")[0]["cameras"]
    assert sent["arm_a/wrist"] == {"delay_s": 0.25}
    assert sent["arm_C_1/wrist"] == {"delay_s": 0.5, "jitter_s": 0.1, "clock": "wall", "max_fps": 30.0}


@pytest.mark.opengl
async def test_a_camera_of_the_simulated_server_is_late(tmp_path: Path) -> None:
    arm = tmp_path / "arm.xml"
    arm.write_text(ROBOT)
    async with (
        SimulatedServer(arm, play=True, dialect="beta", camera_size=(16, 12)) as server,
        URLabClient(**server.client_options(), live_pictures=False) as client,
    ):
        await client.discover()
        await client.runtime.set_mode("direct")
        await client.runtime.set_camera_delay({"wrist": 0.1})
        early = await client.step(include_cameras={"wrist": "latest"})
        assert not early.cameras
        await client.step(n_steps=500)
        latest = await client.step(include_cameras={"wrist": "latest"})
        assert latest.cameras is not None
        assert latest.cameras["wrist"].sim_time == pytest.approx(early.time)
        now = await client.step(include_cameras={"wrist": "sync"})
        assert now.cameras is not None
        assert now.cameras["wrist"].frame_id == now.frame_id


@pytest.mark.parametrize(
    ("bad", "problem"),
    [
        (-0.1, ": delay_s must be at least 0, got -0.1"),
        (math.nan, " takes a finite number"),
        (CameraDelay(jitter_s=-1), ": jitter_s must be at least 0, got -1"),
        (CameraDelay(clock="sun"), ": clock must be 'sim' or 'wall', not 'sun'"),
        (CameraDelay(max_fps=math.inf), ": max_fps takes a finite number"),
        (CameraDelay(max_fps=-1), ": max_fps must be at least 0, got -1"),
    ],
)
async def test_latencies_that_cannot_be(
    client: URLabClient, beta: ScriptedBeta, bad: float | CameraDelay, problem: str
) -> None:
    beta.arrived()
    with pytest.raises(ValueError, match=f"camera 'arm_a/wrist'{problem}"):
        await client.runtime.set_camera_delay({"arm_a/wrist": bad})
    assert beta.arrived() == []


async def test_a_server_whose_cameras_always_stream(tmp_path: Path) -> None:
    arm = tmp_path / "arm.xml"
    arm.write_text(ROBOT)
    async with (
        SimulatedServer(arm, play=True) as server,
        URLabClient(**server.client_options(), live_pictures=False) as client,
    ):
        await client.discover()
        told = await client.runtime.set_camera_streaming({"wrist": True})
        assert told["wrist"].zmq_endpoint == client.articulations["arm"].cameras["wrist"].info.zmq_endpoint
        with pytest.raises(UnknownOp, match="always stream"):
            await client.runtime.set_camera_streaming({"wrist": False})
        with pytest.raises(UnknownOp):
            await client.runtime.set_camera_delay({"wrist": 0.1})


async def test_a_mode_by_another_name(beta: ScriptedBeta) -> None:
    """What a server calls the mode that it was asked for is shown, and means that mode."""

    def set_mode(request: dict[str, Any]) -> dict[str, Any]:
        words = {"live": "clocked", "direct": "driven", "puppet": "posed"}
        if request["mode"] not in {*words, *words.values()}:
            return {"op": "error", "code": "bad_mode", "message": request["mode"]}
        previous, beta.mode = (
            beta.mode,
            {word: mode for mode, word in words.items()}.get(request["mode"], request["mode"]),
        )
        return {"op": "set_mode_ok", "previous_mode": words[previous], "current_mode": words[beta.mode]}

    beta.on("set_mode", set_mode)
    async with client_of(beta, step_mode="direct") as client:
        await client.discover()
        assert (client.step_mode, client.server.step_mode) == ("direct", "driven")
        await client.step(5)
        assert client.sim_time == 0.01
        assert await client.runtime.set_mode("puppet") == "puppet"
        assert client.server.step_mode == "posed"
        await client.step()
    assert beta.mode == "live", "close() goes back to the mode before, by the server's own word"
