"""`client.explain()`: each reason why a robot does not move is named, with what to do."""

from __future__ import annotations

import re
import socket
from pathlib import Path
from typing import Any

import pytest

from urlab_client.server import ControllerConfig
from urlab_client.types import Verdict


def problems(diagnosis: Any) -> str:
    return "\n".join(f.text for f in diagnosis.findings if f.verdict is Verdict.PROBLEM)


async def test_nobody_there(connect: Any) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    client = connect(address="tcp://127.0.0.1", step_port=port, rcv_timeout_ms=500)
    diagnosis = await client.explain()
    assert not diagnosis.healthy
    (finding,) = diagnosis.findings  # what else does not work follows from it
    assert finding.text.startswith(f"127.0.0.1:{port}: Connection refused; is the server running")


async def test_a_state_stream_that_cannot_be_reached_is_a_note(connect: Any, serve: Any) -> None:
    with serve("arm", play=True) as server, socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
        diagnosis = await connect(server, step_mode="live", state_port=port).explain()
    (note,) = [finding for finding in diagnosis.findings if finding.subject == "state stream"]
    assert note.verdict is Verdict.NOTE
    assert note.text.startswith(f"127.0.0.1:{port}: Connection refused; is the server running")


async def test_the_default_port_of_the_state_stream_is_tried(connect: Any) -> None:
    with socket.create_server(("localhost", 0)) as silent:
        port = silent.getsockname()[1]
        diagnosis = await connect(address="tcp://localhost", step_port=port, rcv_timeout_ms=300).explain()
    (found,) = [finding for finding in diagnosis.findings if finding.subject == "state stream"]
    tried = ("localhost:5555 accepts connections.", "localhost:5555: Connection refused")  # something may listen there
    assert found.text.startswith(tried)


async def test_no_session(connect: Any, serve: Any) -> None:
    with serve("arm", play=True) as server:
        assert "Call discover() first" in problems(await connect(server).explain())


async def test_a_session_that_was_taken_over_is_not_a_problem_of_play(connect: Any, serve: Any) -> None:
    with serve("arm", play=True) as server:
        client, other = connect(server), connect(server)
        await client.discover()
        await other.discover()
        diagnosis = await client.explain()
        assert not diagnosis.healthy
        (taken,) = [finding for finding in diagnosis.findings if finding.verdict is Verdict.PROBLEM]
        assert taken.subject == "session"
        assert "Call discover()" in taken.text


async def test_no_play(connect: Any, serve: Any) -> None:
    with serve("arm") as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        assert "Play is off. Call sim.start()" in problems(await client.explain())


async def test_paused(connect: Any, serve: Any) -> None:
    with serve("arm", play=True) as server:
        client = connect(server, step_mode="live")
        await client.discover()
        assert "it is paused. Call runtime.set_paused(False)" in problems(await client.explain())
        await client.runtime.set_paused(False)
        assert "paused" not in problems(await client.explain())


async def test_forgotten_set_points_then_healthy(connect: Any, serve: Any) -> None:
    with serve("arm", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        text = str(await client.explain())
        assert "step() has not been called" in text
        assert "All set-points are 0" in text
        (arm,) = client.articulations.values()
        arm.ctrl_array[:] = 0.1
        await client.step(5)
        diagnosis = await client.explain()
        assert diagnosis.healthy, str(diagnosis)
        assert "Set-points act directly" in str(diagnosis)


async def test_control_source(connect: Any, serve: Any) -> None:
    with serve("arm", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        (arm,) = client.articulations.values()
        arm.ctrl_array[:] = 0.1
        await client.runtime.set_control_source("ui")
        await client.step(5)
        assert "set_control_source('zmq')" in problems(await client.explain())


async def test_a_torque_limit_of_zero(connect: Any, serve: Any) -> None:
    with serve("quadruped", play=True, controllers={"*": ControllerConfig(torque_limit=0)}) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        assert "A torque limit of 0 means no torque at all" in problems(await client.explain())


async def test_another_client_changed_the_mode(connect: Any, serve: Any) -> None:
    with serve("ball", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        reply = await client.call(_live())
        assert reply.current_mode == "live"
        assert "Time passes without steps" in problems(await client.explain())


def _live() -> Any:
    from urlab_client.protocol.messages.runtime import SetMode

    return SetMode(mode="live")


async def test_cameras_that_were_never_switched_on(connect: Any, serve: Any, dialect: str) -> None:
    with serve("arm", play=True) as server:
        client = connect(server, live_pictures=False)
        await client.discover()

        async def said() -> list[str]:
            return [f.text for f in (await client.explain()).findings if f.subject == "cameras"]

        if dialect == "alpha":
            assert await said() == []
            return
        assert "not switched on arm/overview, arm/wrist" in (await said())[0]
        await client.runtime.set_camera_streaming({"wrist": True, "overview": True})
        diagnosis = await client.explain()
        assert not [f for f in diagnosis.findings if f.subject == "cameras"]
        (state,) = [f for f in diagnosis.findings if f.subject == "state stream"] or [None]
        assert state is None or state.verdict is Verdict.OK, "the server says on which port it is"


async def test_the_generation_is_named(connect: Any, serve: Any, dialect: str) -> None:
    with serve("arm", play=True) as server:
        client = connect(server)
        await client.discover()
        (versions,) = (finding for finding in (await client.explain()).findings if finding.subject == "versions")
        assert f", generation {dialect}, with MuJoCo" in versions.text
        other = connect(server, local_model=False)
        await other.discover()
        (versions,) = (finding for finding in (await other.explain()).findings if finding.subject == "versions")
        assert versions.text.endswith("; there is no local model.")


async def test_who_controls_a_robot(connect: Any, serve: Any, dialect: str) -> None:
    """Only the beta has owners: the first write claims a robot, and another client's writes are refused."""

    async def said(client: Any) -> str:
        return next((one.text for one in (await client.explain()).findings if "control" in one.text.lower()), "")

    with serve("arm", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        if dialect == "alpha":
            assert "This client does not control it yet." not in await said(client)
            return
        assert "The first write claims it." in await said(client)
        await client.articulations["arm"].claim()
        assert await said(client) == "This client controls it."
        await client.articulations["arm"].release()
        shy = connect(server, step_mode="direct", claim_control=False)
        await shy.discover()
        shy.articulations["arm"].set_ctrl({"elbow": 0.5})
        assert "Call articulation.claim(), or leave claim_control on." in problems(await shy.explain())


async def test_a_scene_without_robots(connect: Any, serve: Any) -> None:
    with serve(play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        assert "Spawn a robot before sim.start()" in problems(await client.explain())


async def test_set_points_beyond_their_range_are_a_note(connect: Any, serve: Any) -> None:
    with serve("arm", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        client.articulations["arm"].set_ctrl({"elbow": 99.0})
        await client.step()
        (note,) = [one for one in (await client.explain()).findings if one.text.startswith("Set-points out of range")]
        assert note.verdict is Verdict.NOTE
        assert "elbow" in note.text


async def test_a_simulation_that_diverges(
    connect: Any, serve: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    model = tmp_path / "stiff.xml"
    model.write_text("""<mujoco><option timestep="0.02" integrator="Euler"/><worldbody><body gravcomp="1">
      <joint name="j" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".1"/></body></worldbody>
    <actuator><general name="a" joint="j" gainprm="1e7" biastype="affine" biasprm="0 -1e7 -1e5"/></actuator>
    </mujoco>""")
    with serve(str(model), play=True, mjcf_options=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        await client.step(5)
        assert not problems(await client.explain())
        client.articulations["stiff"].set_ctrl({"a": 1.0})
        for _ in range(6):
            await client.step()
        said = problems(await client.explain())
        assert "it has diverged: try a shorter timestep, or weaker gains" in said
        assert "not applied" not in said, "that follows from it"
        told = [one.getMessage() for one in caplog.records if "in a step: it diverged" in one.getMessage()]
        assert re.match(r"simulation time went from 0\.1\d* s to 0\.02 s", told[0])
        await client.reset()
        client.articulations["stiff"].set_ctrl({"a": 0.0})
        await client.step(2)
        assert not problems(await client.explain()), "a reset begins anew"
