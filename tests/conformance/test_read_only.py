"""A client that looks on beside the one that drives: what it knows and sees, and that it takes nothing over."""

from __future__ import annotations

from typing import Any

import pytest

from urlab_client.errors import ReadOnlyClient


@pytest.fixture
def server(serve: Any) -> Any:
    with serve("arm", play=True, camera_size=(32, 24)) as server:
        yield server


def looking_on(connect: Any, server: Any) -> Any:
    return connect(server, transport="zmq", read_only=True)


@pytest.mark.opengl
async def test_it_sees_what_the_driver_sees_and_disturbs_nobody(connect: Any, server: Any) -> None:
    driver, other = connect(server, step_mode="live"), looking_on(connect, server)
    await driver.discover()
    await driver.runtime.set_paused(False)
    await other.discover(handshake=driver.handshake())
    theirs, ours = driver.describe().articulations, other.describe().articulations
    assert [robot.name for robot in ours] == [robot.name for robot in theirs] == ["arm"]
    assert [joint.limits for joint in ours[0].joints] == [joint.limits for joint in theirs[0].joints]
    assert other.model.nq == driver.model.nq
    await other.wait_until(lambda: other.sim_time > 0.05)
    assert other.articulations["arm"].qpos_array.shape == driver.articulations["arm"].qpos_array.shape
    picture = await other.camera("wrist").capture()
    assert picture.pixels.shape == (24, 32, 4)
    assert other.session_id == ""
    driver.articulations["arm"].set_ctrl({"elbow": 0.5})
    await driver.step()


async def test_whatever_needs_a_session_is_refused(connect: Any, server: Any) -> None:
    driver, other = connect(server, step_mode="direct"), looking_on(connect, server)
    await driver.discover()
    with pytest.raises(ReadOnlyClient, match="hello: this client is read-only"):
        await other.discover()
    await other.discover(handshake=driver.handshake())
    calls = [
        other.step,
        other.reset,
        other.resync,
        other.sim.start,
        other.scene.snapshot,
        lambda: other.runtime.set_paused(True),
        lambda: other.runtime.set_mode("direct"),
        other.articulations["arm"].claim,
    ]
    for call in calls[: None if other.server.features.claims else -1]:
        with pytest.raises(ReadOnlyClient, match=r"Nothing was sent\. It has no session"):
            await call()
    assert "read-only" in str(await other.explain())
    assert len(await other.meta()) > 50
    assert (await driver.step()).step == 1


async def test_the_next_play_takes_the_next_handshake(connect: Any, server: Any) -> None:
    driver, other = connect(server, step_mode="live"), looking_on(connect, server)
    await driver.discover()
    await other.discover(handshake=driver.handshake())
    await driver.sim.stop()
    await driver.sim.start()
    await other.discover(handshake=driver.handshake())
    await driver.runtime.set_paused(False)
    await other.wait_until(lambda: other.sim_time > 0.02)


async def test_contradictions_are_refused(connect: Any, server: Any) -> None:
    for options in ({"step_mode": "direct"}, {"transport": "shm"}, {"address": "sim://arm"}):
        with pytest.raises(ValueError, match="read_only needs"):
            connect(server, **({"transport": "zmq", "read_only": True} | options))
    driver, other = connect(server), looking_on(connect, server)
    await driver.discover()
    with pytest.raises(ValueError, match="read_only=True"):
        await driver.discover(handshake=driver.handshake())
    with pytest.raises(ValueError, match=r"not a result of handshake\(\)"):
        await other.discover(handshake=b"junk")
