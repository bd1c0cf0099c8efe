"""A beta over shared memory: the simulated server names its files, and the client uses them."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path

from scripted_beta import ROBOT

from urlab_client.aio import URLabClient
from urlab_client.protocol.messages.session import Hello
from urlab_client.server import SimulatedServer


async def test_requests_go_through_the_files_that_the_handshake_names(tmp_path: Path) -> None:
    """Generation 2 statements 15, 16 and 58."""
    arm = tmp_path / "arm.xml"
    arm.write_text(ROBOT)
    async with (
        SimulatedServer(arm, play=True, dialect="beta", shm_dir=tmp_path) as server,
        URLabClient(**server.client_options(), step_mode="direct", transport="shm") as client,
    ):
        await client.discover()
        told = (await client.call(Hello())).shm_rpc
        assert told is not None
        assert told.n_buffers == 2
        for path, stride in ((told.req_path, told.req_stride), (told.rep_path, told.rep_stride)):
            size = await asyncio.to_thread(os.path.getsize, path)
            assert size == told.header_size + told.n_buffers * stride
        await client.discover()
        client.articulations["arm"].set_ctrl({"m": 0.5})
        for _ in range(3):
            await client.step()
        assert client.transport_stats.over_shm >= 2
        assert client.articulations["arm"].qvel_array[0] != 0.0
        await client.sim.stop()
        assert (await client.call(Hello())).shm_rpc is None


async def test_models_travel_over_zeromq_all_the_same(tmp_path: Path) -> None:
    """Beta statement 81."""
    arm = tmp_path / "arm.xml"
    arm.write_text(ROBOT)
    async with (
        SimulatedServer(arm, play=True, dialect="beta", shm_dir=tmp_path) as server,
        URLabClient(**server.client_options(), step_mode="direct", transport="shm") as client,
    ):
        await client.discover()
        for _ in range(2):
            await client.step()
        before = client.transport_stats.over_shm
        assert before
        blueprint = await client.scene.upload_model(arm)
        assert blueprint.class_path.endswith("_C")
        assert client.transport_stats.over_shm == before
