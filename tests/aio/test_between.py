"""Servers between the generations: the beta without one of its features, or with the alpha's, and one program."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Mapping
from typing import Any

import pytest
from waiting import DEADLINE_S

from urlab_client.aio import URLabClient
from urlab_client.protocol.base import Op
from urlab_client.server import SimulatedServer
from urlab_client.server.dialects import ALPHA, BETA, Dialect

JOBS = ("op_status",)
CLAIMS = ("claim_control", "release_control")
CAMERAS = ("set_camera_streaming", "set_camera_delay")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Between(Dialect):
    """A dialect without some ops."""

    without: tuple[str, ...] = ()

    @property
    def ops(self) -> Mapping[str, Op]:
        return {name: op for name, op in super().ops.items() if name not in self.without}


def between(*without: str, **changes: Any) -> Between:
    fields = {field.name: getattr(BETA, field.name) for field in dataclasses.fields(BETA)}
    return Between(**{**fields, **changes}, without=without)


SERVERS = {
    "the beta": between(),
    "no jobs": between(*JOBS, jobs=False),
    "no claims": between(*CLAIMS, claims=False),
    "cameras always on": between(*CAMERAS, cameras_on=True),
    "bare pixels": between(camera_headers=False),
    "no camera forms": between(camera_forms=False),
    "names of objects": between(public_names=False),
    "no frame ids": between(frame_ids=False),
    "steps are published": between(steps_published=True),
    "live commands are ignored": between(live_commands=False),
    "single precision": between(controls_float32=True, options_float32=True),
    "robots' options stay away": between(options_merged=False),
    "no instance": between(instance=False),
    # What is published, and whether levels stick, shows in nothing but the shape of the state: they come together.
    "the alpha's state": between(
        shapes=ALPHA.shapes, steps_published=True, rows_published=True, level_sticks=True, live_commands=False
    ),
    "no leases": between("acquire_lease", "release_lease"),
    "no uploads": between("upload_model_manifest", "upload_model_chunk", "upload_model_commit"),
    "no user channels": between("set_user_channels"),
}


@pytest.mark.opengl
@pytest.mark.parametrize("name", SERVERS)
async def test_the_same_program_runs(name: str) -> None:
    """Beta statement 67, feature by feature."""
    server = SimulatedServer("arm", play=True, camera_size=(16, 12), actor_names="plugin")
    server._config = dataclasses.replace(server._config, dialect=SERVERS[name])
    async with server, URLabClient(**server.client_options(), step_mode="direct") as client:
        await client.discover()
        (arm,) = client.articulations.values()
        assert client.articulations_by_id["arm"] is arm
        arm.ctrl_array[:] = 0.125
        reply = await client.step(5)
        assert reply.step == client.step_count == 5
        assert arm.last_applied_ctrl.tolist() == [0.125] * len(arm.ctrl_array)
        assert arm.qpos_array.tolist() == reply.per_articulation[arm.prefix].qpos.tolist()
        full = await client.step(observations="full")
        assert full.per_articulation[arm.prefix].bodies
        assert (await client.step()).per_articulation[arm.prefix].bodies is None

        async with client.state_stream() as states:
            stepped = await client.step()
            async with asyncio.timeout(DEADLINE_S):
                while (await states.receive(timeout=10)).time < stepped.time:
                    pass

        for _ in range(2):
            await client.step(include_cameras={"wrist": "sync"})
            assert arm.cameras["wrist"].delivered
            assert arm.cameras["wrist"].sim_time == client.sim_time

        await client.reset("home")
        await client.runtime.set_qpos("arm", arm.qpos_array)
        options = await client.runtime.set_sim_options(timestep=0.004, integrator="rk4")
        assert (options.integrator, options.timestep) == ("rk4", pytest.approx(0.004))

        blueprint = await client.scene.import_xml("ball")
        assert (await client.scene.spawn_actor(blueprint, "toy")).actor_id == "toy"
        await client.scene.destroy_actor("toy")

        await client.runtime.set_mode("puppet")
        client.data.qpos[0] = 0.25
        await client.step(0)
        assert arm.qpos_array[0] == 0.25

        await client.runtime.set_mode("live")
        await client.runtime.set_paused(False)
        async with client.state_stream() as states:
            first = await states.receive(timeout=10)
            async with asyncio.timeout(DEADLINE_S):
                while (await states.receive(timeout=10)).time <= first.time:
                    pass
        async with arm.cameras["wrist"].frames() as frames:
            for _ in range(2):
                assert (await frames.receive(timeout=20)).pixels.shape == (12, 16, 4)
        assert (await client.explain()).findings
