"""What type checkers see of the blocking client. Checked by pyright and mypy in `.ci/run`, never executed.

`assert_type` fails on any other type, `Any` included. `asynchronous.py` says the same of the async client.
"""

from __future__ import annotations

from typing import Any, assert_type

import numpy as np
from numpy.typing import NDArray

from urlab_client import (
    ActorInfo,
    Actuator,
    ActuatorType,
    Body,
    CameraMode,
    ControllerKind,
    ControlMode,
    Joint,
    PIEStartResult,
    ScalarJoint,
    Sensor,
    SimOptions,
    StepMode,
    URLabArticulation,
    URLabAsset,
    URLabBlueprint,
    URLabCameraView,
    URLabClient,
    URLabController,
    URLabEntity,
    URLabPDController,
    URLabSpawnHandle,
)
from urlab_client.events import ClientEvent, PlayEnded
from urlab_client.protocol.messages.scene import CurrentLevel, CurrentLevelOk
from urlab_client.protocol.messages.session import ArticulationState, OpInfo, ResetOk, StepOk
from urlab_client.protocol.messages.streams import CameraSample, StateSnapshot
from urlab_client.sync.namespaces import (
    DebugNamespace,
    OutlinerNamespace,
    RecordingNamespace,
    ReplayNamespace,
    RuntimeNamespace,
    SceneNamespace,
    SimNamespace,
    ViewportNamespace,
)
from urlab_client.sync.streams import Stream
from urlab_client.types import CameraPose, ClientConfig, ContactsResult, Diagnosis, KeyframeInfo
from urlab_client.values.names import NameMap

Floats = NDArray[np.float64]


def session() -> None:
    with URLabClient("sim://quadruped", step_mode="direct") as client:
        assert_type(client, URLabClient)
        assert_type(client.discover("full", timeout=10.0), None)
        reply = client.step(5, include_cameras={"head": "sync"}, observations="minimal")
        assert_type(reply, StepOk)
        assert_type(reply.per_articulation["quadruped"], ArticulationState)
        assert_type(client.reset("home", seed=1, per_articulation_qpos={"quadruped": {"FL_hip": 0.1}}), ResetOk)
        assert_type(client.meta(), list[OpInfo])
        assert_type(client.explain(), Diagnosis)
        assert_type(client.call(CurrentLevel()), CurrentLevelOk)
        assert_type(client.close(), None)


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


def controller(robot: URLabArticulation) -> None:
    assert_type(robot.controller, URLabController | None)
    if isinstance(robot.controller, URLabPDController):
        assert_type(robot.controller.kind, ControllerKind | str)
        assert_type(robot.controller.kp["FL_hip"], float)
        assert_type(robot.controller.set_gains(kp={"FL_hip": 40.0}), dict[str, Any])
        assert_type(robot.controller.configure(default_kp=40.0), dict[str, Any])


def authoring(client: URLabClient) -> None:
    blueprint = client.scene.import_xml("robot.xml")
    assert_type(blueprint, URLabBlueprint)
    handle = client.scene.spawn_actor(blueprint, "robot", location=np.zeros(3), rotation_euler=(0, 0, 90))
    assert_type(handle, URLabSpawnHandle)
    assert_type(handle.location, tuple[float, float, float])
    assert_type(handle.runtime(client), URLabArticulation | None)
    assert_type(client.scene.spawn_grid(blueprint, "g", 2, 2), dict[str, URLabSpawnHandle])
    assert_type(client.scene.apply_scene("lab", [URLabAsset("a", "a.xml")]), dict[str, URLabSpawnHandle])
    assert_type(client.scene.create_level("lab"), None)
    assert_type(client.scene.ensure_manager(), bool)
    assert_type(client.scene.current_level(), str)
    assert_type(client.outliner.find_actors(tag="robot"), list[ActorInfo])
    assert_type(client.sim.start(timeout_s=5), PIEStartResult)


def running(client: URLabClient) -> None:
    assert_type(client.runtime.set_mode(StepMode.DIRECT), StepMode)
    assert_type(client.runtime.set_paused(paused=True), bool)
    assert_type(client.runtime.get_contacts(body1="robot_foot"), ContactsResult)
    assert_type(client.runtime.set_sim_options(timestep=0.001), SimOptions)
    assert_type(client.runtime.list_keyframes(), list[KeyframeInfo])
    assert_type(client.camera("eye").capture(), CameraSample)
    assert_type(client.capture(["eye"]), dict[str, CameraSample])
    assert_type(client.events(kinds=["lost", PlayEnded]), Stream[ClientEvent])
    assert_type(client.state_stream(max_rate=60), Stream[StateSnapshot])
    assert_type(client.discover(handshake=client.handshake()), None)
    with client.sim.playing() as started:
        assert_type(started, PIEStartResult)
    with client.scene.edit() as nothing:
        assert_type(nothing, None)
    assert_type(client.viewport.get_camera(timeout=None), CameraPose)


def namespaces(client: URLabClient) -> None:
    assert_type(client.scene, SceneNamespace)
    assert_type(client.sim, SimNamespace)
    assert_type(client.runtime, RuntimeNamespace)
    assert_type(client.outliner, OutlinerNamespace)
    assert_type(client.debug, DebugNamespace)
    assert_type(client.viewport, ViewportNamespace)
    assert_type(client.recording, RecordingNamespace)
    assert_type(client.replay, ReplayNamespace)


def mistakes(client: URLabClient, robot: URLabArticulation) -> None:
    # Both checkers must object to each of these lines: an ignore that ignores nothing is an error in itself.
    client.step("2")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    client.step(1, True)  # type: ignore[call-arg]  # pyright: ignore[reportCallIssue]
    client.discover(observation="full")  # type: ignore[call-arg]  # pyright: ignore[reportCallIssue]
    client.sim_time = 1.0  # type: ignore[misc]  # pyright: ignore[reportAttributeAccessIssue]
    robot.set_ctrl({"FL_hip": "1"})  # type: ignore[dict-item]  # pyright: ignore[reportArgumentType]
    client.runtime.set_sim_speed("fast")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    URLabClient(step_mode="drect")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    URLabClient(transport="smh")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    URLabClient(encoding="jsn")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    client.discover("ful")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    client.step(observations="minmal")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    client.runtime.set_mode("drect")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    client.state_stream("newest")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    client.row_stream(policy="newest")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    robot.cameras["head"].frames("newest")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]


async def mistaken_for_the_async_client(client: URLabClient) -> None:
    await client.step()  # type: ignore[misc]  # pyright: ignore[reportGeneralTypeIssues]
    async with client:  # type: ignore[attr-defined]  # pyright: ignore[reportGeneralTypeIssues]
        pass
