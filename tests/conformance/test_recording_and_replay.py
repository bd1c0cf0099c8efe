"""Recording, replay and options in both flavours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from urlab_client.errors import PathNotWritable, ReplayRequiresStepped, ReplaySessionNotFound


async def test_record_save_and_play(connect: Any, serve: Any, tmp_path: Path) -> None:
    with serve("ball", play=True, saved_dir=tmp_path) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        with pytest.raises(PathNotWritable):
            await client.recording.save("ep.json")
        await client.recording.start()
        assert client.recording.is_active
        await client.step(20)
        summary = await client.recording.stop()
        assert (client.recording.is_active, client.recording.frame_count) == (False, 20)
        assert client.recording.sim_duration == summary.sim_duration_s == pytest.approx(19 * 0.002)
        path = await client.recording.save("ep.json")
        assert path.is_file()
        assert client.recording.last_saved_path == path
        session = await client.replay.load("ep.json")
        assert session.name == client.replay.active_session == "ep"
        status = await client.replay.start()
        assert (status.active_session, status.total_frames) == ("ep", 20)
        reply = await client.step(3)
        assert (reply.replay.current_frame, reply.replay.total_frames) == (3, 20)
        await client.replay.stop()
        assert (await client.step()).replay is None
        await client.runtime.set_mode("live")
        with pytest.raises(ReplayRequiresStepped):
            await client.replay.play("ep")


async def test_options_reach_the_mirror(connect: Any, serve: Any) -> None:
    with serve("ball", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        options = await client.runtime.set_sim_options(
            timestep=0.001, gravity=(0, 0, -1.62), solver="CG", integrator="RK4"
        )
        assert client.model.opt.timestep == options.timestep == pytest.approx(0.001)
        assert client.model.opt.gravity[2] == pytest.approx(-1.62)
        assert (options.solver, options.integrator, options.cone) == ("cg", "rk4", "pyramidal")


async def test_clearing_and_choosing_a_session(connect: Any, serve: Any, tmp_path: Path) -> None:
    with serve("ball", play=True, saved_dir=tmp_path) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        await client.recording.start()
        await client.step(5)
        await client.recording.stop()
        await client.recording.save("one.json")
        await client.recording.clear()
        assert client.recording.frame_count == 0
        with pytest.raises(PathNotWritable):
            await client.recording.save("two.json")
        session = await client.replay.load("one.json")
        assert (session.name, client.replay.active_session) == ("one", "one")
        await client.replay.set_active("Live Recording")
        assert client.replay.active_session == "Live Recording"
        with pytest.raises(ReplaySessionNotFound):
            await client.replay.set_active("three")
