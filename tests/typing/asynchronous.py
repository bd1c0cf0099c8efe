"""What type checkers see of the async client. Checked by pyright and mypy in `.ci/run`, never executed.

`assert_type` fails on any other type, `Any` included. `blocking.py` says the same of the façade.
"""

from __future__ import annotations

from typing import Any, assert_type

import numpy as np
from numpy.typing import NDArray

from urlab_client import (
    ActorInfo,
    ActuatorType,
    CameraMode,
    ControllerKind,
    ControlMode,
    PIEStartResult,
    SimOptions,
    StepMode,
    URLabAsset,
    URLabBlueprint,
    URLabSpawnHandle,
)
from urlab_client.aio import (
    Actuator,
    Body,
    Joint,
    ScalarJoint,
    Sensor,
    URLabArticulation,
    URLabCameraView,
    URLabClient,
    URLabController,
    URLabEntity,
    URLabPDController,
)
from urlab_client.aio.namespaces._ops import DebugNamespace, ViewportNamespace
from urlab_client.aio.namespaces.outliner import OutlinerNamespace
from urlab_client.aio.namespaces.recording import RecordingNamespace, ReplayNamespace
from urlab_client.aio.namespaces.runtime import RuntimeNamespace
from urlab_client.aio.namespaces.scene import SceneNamespace
from urlab_client.aio.namespaces.sim import SimNamespace
from urlab_client.aio.streams.stream import Stream
from urlab_client.events import ClientEvent, PlayEnded
from urlab_client.protocol.messages.scene import CurrentLevel, CurrentLevelOk
from urlab_client.protocol.messages.session import ArticulationState, OpInfo, ResetOk, StepOk
from urlab_client.protocol.messages.streams import CameraSample, StateSnapshot
from urlab_client.types import CameraPose, ClientConfig, ContactsResult, Diagnosis, KeyframeInfo
from urlab_client.values.names import NameMap

Floats = NDArray[np.float64]


async def session() -> None:
    async with URLabClient("sim://quadruped", step_mode="direct") as client:
        assert_type(client, URLabClient)
        assert_type(await client.discover("full", timeout=10.0), None)
        reply = await client.step(5, include_cameras={"head": "sync"}, observations="minimal")
        assert_type(reply, StepOk)
        assert_type(reply.per_articulation["quadruped"], ArticulationState)
        assert_type(await client.reset("home", seed=1, per_articulation_qpos={"quadruped": {"FL_hip": 0.1}}), ResetOk)
        assert_type(await client.meta(), list[OpInfo])
        assert_type(await client.explain(), Diagnosis)
        assert_type(await client.call(CurrentLevel()), CurrentLevelOk)
        assert_type(await client.close(), None)


def state(client: URLabClient) -> None:
    assert_type(client.config, ClientConfig)
    assert_type(client.connected, bool)
    assert_type(client.session_id, str)
    assert_type(client.step_mode, StepMode)
    assert_type(client.step_count, int)
    assert_type(client.sim_time, float)
    assert_type(client.sim_time_nsec, int)
    assert_type(client.articulations, NameMap[URLabArticulation])
    assert_type(client.articulations["quadruped"], URLabArticulation)
    assert_type(client.articulations.get("quadruped"), URLabArticulation | None)
    assert_type(client.articulations_by_id, dict[str, URLabArticulation])
    assert_type(client.entities, NameMap[URLabEntity])
    assert_type(client.global_cameras, NameMap[URLabCameraView])


def articulation(robot: URLabArticulation) -> None:
    joint = robot.joints["FL_hip"]
    assert_type(joint, Joint)
    assert_type(joint.position, float | Floats)
    if isinstance(joint, ScalarJoint):
        assert_type(joint.position, float)
        assert_type(joint.velocity, float)
    assert_type(robot.actuators["FL_hip"], Actuator)
    assert_type(robot.sensors["imu_gyro"], Sensor)
    assert_type(robot.bodies["trunk"], Body)
    assert_type(robot.cameras["head"], URLabCameraView)
    assert_type(robot.joints["FL_hip"].range, tuple[float, float] | None)
    assert_type(robot.actuators["FL_hip"].type, ActuatorType | str | None)
    assert_type(robot.sensors["imu_gyro"].latest, Floats | None)
    assert_type(robot.cameras["head"].mode, CameraMode | str)
    assert_type(robot.qpos_array, Floats)
    assert_type(robot.ctrl_array, Floats)
    assert_type(robot.root_pos_w, Floats)
    assert_type(robot.control_mode, ControlMode)
    assert_type(robot.get_ctrl(), dict[str, float])
    assert_type(robot.get_sensors(), dict[str, Floats])
    assert_type(robot.resolve_joint("FL_hip"), str | None)
    assert_type(robot.set_ctrl({"FL_hip": 0.5}), None)
    robot.control_mode = "raw"
    robot.ctrl_array = [0.0] * 12
    robot.apply_xfrc("trunk", force=(0, 0, 10))


async def controller(robot: URLabArticulation) -> None:
    assert_type(robot.controller, URLabController | None)
    if isinstance(robot.controller, URLabPDController):
        assert_type(robot.controller.kind, ControllerKind | str)
        assert_type(robot.controller.kp["FL_hip"], float)
        assert_type(await robot.controller.set_gains(kp={"FL_hip": 40.0}), dict[str, Any])
        assert_type(await robot.controller.configure(default_kp=40.0), dict[str, Any])


async def authoring(client: URLabClient) -> None:
    blueprint = await client.scene.import_xml("robot.xml")
    assert_type(blueprint, URLabBlueprint)
    handle = await client.scene.spawn_actor(blueprint, "robot", location=np.zeros(3), rotation_euler=(0, 0, 90))
    assert_type(handle, URLabSpawnHandle)
    assert_type(handle.location, tuple[float, float, float])
    assert_type(handle.runtime(client), URLabArticulation | None)
    assert_type(await client.scene.spawn_grid(blueprint, "g", 2, 2), dict[str, URLabSpawnHandle])
    assert_type(await client.scene.apply_scene("lab", [URLabAsset("a", "a.xml")]), dict[str, URLabSpawnHandle])
    assert_type(await client.scene.create_level("lab"), None)
    assert_type(await client.scene.ensure_manager(), bool)
    assert_type(await client.scene.current_level(), str)
    assert_type(await client.outliner.find_actors(tag="robot"), list[ActorInfo])
    assert_type(await client.sim.start(timeout_s=5), PIEStartResult)


async def running(client: URLabClient) -> None:
    assert_type(await client.runtime.set_mode(StepMode.DIRECT), StepMode)
    assert_type(await client.runtime.set_paused(paused=True), bool)
    assert_type(await client.runtime.get_contacts(body1="robot_foot"), ContactsResult)
    assert_type(await client.runtime.set_sim_options(timestep=0.001), SimOptions)
    assert_type(await client.runtime.list_keyframes(), list[KeyframeInfo])
    assert_type(await client.camera("eye").capture(), CameraSample)
    assert_type(await client.capture(["eye"]), dict[str, CameraSample])
    assert_type(client.events(kinds=["lost", PlayEnded]), Stream[ClientEvent])
    assert_type(client.state_stream(max_rate=60), Stream[StateSnapshot])
    assert_type(await client.discover(handshake=client.handshake()), None)
    async with client.sim.playing() as started:
        assert_type(started, PIEStartResult)
    async with client.scene.edit() as nothing:
        assert_type(nothing, None)
    assert_type(await client.viewport.get_camera(timeout=None), CameraPose)


def namespaces(client: URLabClient) -> None:
    assert_type(client.scene, SceneNamespace)
    assert_type(client.sim, SimNamespace)
    assert_type(client.runtime, RuntimeNamespace)
    assert_type(client.outliner, OutlinerNamespace)
    assert_type(client.debug, DebugNamespace)
    assert_type(client.viewport, ViewportNamespace)
    assert_type(client.recording, RecordingNamespace)
    assert_type(client.replay, ReplayNamespace)


async def mistakes(client: URLabClient, robot: URLabArticulation) -> None:
    # Both checkers must object to each of these lines: an ignore that ignores nothing is an error in itself.
    await client.step("2")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    await client.step(1, True)  # type: ignore[call-arg]  # pyright: ignore[reportCallIssue]
    await client.discover(observation="full")  # type: ignore[call-arg]  # pyright: ignore[reportCallIssue]
    client.sim_time = 1.0  # type: ignore[misc]  # pyright: ignore[reportAttributeAccessIssue]
    robot.set_ctrl({"FL_hip": "1"})  # type: ignore[dict-item]  # pyright: ignore[reportArgumentType]
    await client.runtime.set_sim_speed("fast")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    URLabClient(step_mode="drect")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    URLabClient(transport="smh")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    URLabClient(encoding="jsn")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    await client.discover("ful")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    await client.step(observations="minmal")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    await client.runtime.set_mode("drect")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    client.state_stream("newest")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    client.row_stream(policy="newest")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    robot.cameras["head"].frames("newest")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]


def mistaken_for_the_blocking_client(client: URLabClient) -> None:
    with client:  # type: ignore[attr-defined]  # pyright: ignore[reportGeneralTypeIssues]
        pass
