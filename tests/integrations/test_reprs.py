"""What users see of an object that they type at a prompt: what it is, in one line."""

from __future__ import annotations

from pathlib import Path

from urlab_client.aio import URLabClient
from urlab_client.integrations.ik import InverseKinematics
from urlab_client.integrations.record import read_run, record
from urlab_client.integrations.teleop import HandControl
from urlab_client.server import ControllerConfig, SimulatedServer


def test_a_server() -> None:
    with SimulatedServer("arm") as server:
        assert repr(server) == f"<SimulatedServer arm at tcp://127.0.0.1:{server.step_port}>"
    assert repr(server) == "<SimulatedServer arm at closed>"
    assert repr(SimulatedServer()) == "<SimulatedServer empty at closed>"


async def test_a_client_and_what_it_has(tmp_path: Path) -> None:
    arm = "<URLabArticulation 'arm' 8 joints, 7 actuators>"
    with SimulatedServer("arm", play=True, controllers={"arm": ControllerConfig(kp=40.0)}) as server:
        client = URLabClient(**server.client_options(), step_mode="direct")
        assert repr(client) == "<URLabClient tcp://127.0.0.1 not connected>"
        async with client:
            await client.discover()
            robot = client.articulations["arm"]
            shown = {
                client: "<URLabClient tcp://127.0.0.1 connected, direct at 0.000 s: arm>",
                robot: arm,
                robot.joints["elbow"]: "<Joint 'elbow' hinge id=2>",
                robot.actuators["elbow"]: "<Actuator 'elbow' position id=2>",
                robot.sensors["grip_position"]: "<Sensor 'grip_position' framepos id=0 dim=3>",
                robot.bodies["shoulder"]: "<Body 'shoulder' id=2>",
                robot.cameras["wrist"]: "<URLabCameraView 'wrist' real 640x480>",
                robot.controller: "<URLabPDController pd of 'arm'>",
                InverseKinematics(client, site="grip"): "<InverseKinematics site 'grip' of 'arm'>",
                HandControl(client): "<HandControl of 'grip' of 'arm'>",
            }
            assert [repr(one) for one in shown] == list(shown.values())
            assert repr(client.articulations) == f"{{'arm': {arm}}}"
            assert repr(client.debug).startswith(f"<DebugNamespace tcp://127.0.0.1:{server.step_port}: ")
            stream = client.state_stream(max_rate=50.0)
            idle = "idle: 0 delivered, 0 dropped, 0 waiting"
            assert repr(stream) == f"<Stream state_stream latest at most 50 per s, {idle}>"
            recording = record(client, tmp_path / "a.mcap")
            assert repr(recording) == f"<AsyncRecorder '{tmp_path}/a.mcap' not begun, 0 states, 0 pictures>"
            async with recording, client.state_stream("all") as states:
                assert repr(await client.step(2)) == "<StepOk step 2 at 0.004 s: arm>"
                assert repr(await states.receive()) == "<StateSnapshot step 2 at 0.004 s: arm>"
                await client.step(3)
                assert repr(recording).partition("' ")[2].startswith("recording, ")
            assert repr(states).startswith("<Stream state_stream all, closed: 1 delivered, ")
            assert repr(recording).partition("' ")[2] == "ended, 2 states, 0 pictures>"
            assert repr(await client.reset()) == "<ResetOk step 0 at 0.000 s: arm>"
        assert repr(client) == "<URLabClient tcp://127.0.0.1 closed>"
    run = read_run(tmp_path / "a.mcap")
    assert repr(run) == f"<Run '{tmp_path}/a.mcap'>"
    assert repr(run.table()) == "<Table states: 2, 0.004 to 0.010 s, columns: 6>"
