"""Recordings of real robots: what the client saw is in the file, also after a crash, and stepping never waits."""

from __future__ import annotations

import asyncio
import errno
import gc
import json
import math
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
from children import child
from made_recordings import Robot, messages_of, write_messages, write_recording
from mcap.reader import make_reader
from mcap.writer import IndexType
from waiting import eventually, until

import urlab_client
from urlab_client.aio import URLabClient as AsyncClient
from urlab_client.aio.state.step_pictures import StepPictures
from urlab_client.errors import NotReady
from urlab_client.integrations._feed.messages import (
    ArticulationMessage,
    CameraCalibration,
    CompressedImage,
    FrameTransforms,
    JointStates,
    RawImage,
    Time,
    encode,
    schema_name,
    schema_of,
)
from urlab_client.integrations.record import RecordingError, Run, read_run, record
from urlab_client.integrations.record import recorder as recording
from urlab_client.integrations.record import writer as writing
from urlab_client.integrations.record.reader import _DECODERS
from urlab_client.server import Faults, Refuse, SimulatedServer

# Fields of Foxglove's schemas of these names.
FOXGLOVE = {
    CompressedImage: {"timestamp", "frame_id", "data", "format"},
    RawImage: {"timestamp", "frame_id", "width", "height", "encoding", "step", "data"},
    FrameTransforms: {"transforms"},
    JointStates: {"timestamp", "joints"},
    CameraCalibration: {"timestamp", "frame_id", "width", "height", "distortion_model", "D", "K", "R", "P"},
}


@pytest.fixture(scope="module")
def server() -> Iterator[SimulatedServer]:
    with SimulatedServer("quadruped", "arm", play=True) as made:
        yield made


@pytest.fixture
def client(server: SimulatedServer) -> Iterator[urlab_client.URLabClient]:
    with urlab_client.URLabClient(**server.client_options(), step_mode="direct") as made:
        made.discover()
        made.reset()
        yield made


def messages(path: Path) -> list[tuple[str, str, int, dict[str, Any]]]:
    """Topic, schema, log time and content of each message, as another MCAP reader sees them."""
    with path.open("rb") as file:
        found = make_reader(file).iter_messages(log_time_order=False)
        return [(c.topic, s.name if s else "", m.log_time, json.loads(m.data)) for s, c, m in found]


def bits(values: Any) -> bytes:
    return np.asarray(values, dtype=np.float64).tobytes()


def watch(client: Any, seen: list[dict[str, Any]]) -> None:
    seen.append(
        {
            "time": client.sim_time,
            "step": client.step_count,
            **{
                f"{key}/{field}": bits(values)
                for key, art in client.articulations.items()
                for field, values in (
                    ("qpos", art.qpos_array),
                    ("qvel", art.qvel_array),
                    ("ctrl", art.last_applied_ctrl),
                    ("set_points", art.ctrl_array),
                    ("sensors", np.concatenate([*art.get_sensors().values()])),
                )
            },
        }
    )


def assert_equal_to(run: Run, seen: list[dict[str, Any]]) -> None:
    table = run.table()
    assert len(table) == len(seen)
    for row, expected in enumerate(seen):
        assert table.sim_time[row] == expected["time"]
        assert table.step[row] == expected["step"]
        for name in expected.keys() - {"time", "step"}:
            assert bits(table.columns[name].values[row]) == expected[name], (row, name)


def test_the_file_holds_to_the_bit_what_the_client_saw(client: urlab_client.URLabClient, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    seen: list[dict[str, Any]] = []
    with record(client, tmp_path / "run.mcap") as recorder:
        for i in range(120):
            for art in client.articulations.values():
                art.ctrl_array[:] = rng.uniform(-0.3, 0.3, len(art.ctrl_array))
            reply = client.reset() if i == 60 else client.step(n_steps=2)
            for state in reply.per_articulation.values():
                state.qpos[:] = math.nan  # a reply's arrays are the caller's
            watch(client, seen)
    assert (recorder.stats.states, recorder.stats.dropped_states) == (120, 0)
    run = read_run(recorder.path)
    assert recorder.stats.duration_s == pytest.approx(run.table().time[-1] - run.table().time[0], abs=1e-9)
    assert_equal_to(run, seen)
    table = run.table()
    assert table.episode.tolist() == [0] * 60 + [1] * 60
    assert (np.diff(table.time) > 0).all()
    assert np.allclose(np.diff(table.time), 0.004)
    assert (np.diff(table.wall_ns) >= 0).all()
    assert table.columns["arm/qpos"].names[:2] == list(client.articulations["arm"].joints)[:2]
    assert table.columns["quadruped/qpos"].names[:8] == [
        *(f"root.{part}" for part in ("x", "y", "z", "qw", "qx", "qy", "qz")),
        "FL_hip",
    ]
    summary = run.summary()
    assert (summary.complete, summary.episodes, summary.dropped_states) == (True, 2, 0)
    assert summary.about["step_mode"] == "direct"
    assert summary.topics["/state/arm"].messages == 120
    assert summary.topics["/state/arm"].rate_hz == pytest.approx(250)
    with recorder.path.open("rb") as file:
        numbers = [m.sequence for _, c, m in make_reader(file).iter_messages(topics=["/state/arm"])]
    assert numbers == [*range(120)], "by which readers of MCAP find what is missing"
    assert math.isclose(summary.duration_s, 0.004 * 119)
    assert summary.wall_s == pytest.approx((table.wall_ns[-1] - table.wall_ns[0]) / 1e9)
    assert summary.wall_s > 0


async def test_the_async_flavour_writes_the_same(server: SimulatedServer, tmp_path: Path) -> None:
    seen: list[dict[str, Any]] = []
    async with AsyncClient(**server.client_options(), step_mode="direct") as client:
        await client.discover()
        await client.reset()
        async with record(client, tmp_path / "run.mcap") as recorder:
            for _ in range(30):
                await client.step()
                watch(client, seen)
        await client.step()  # no longer recorded
    assert recorder.stats.states == 30
    assert_equal_to(read_run(recorder.path), seen)


def test_poses_joint_states_and_contacts_are_those_of_the_state(
    client: urlab_client.URLabClient, tmp_path: Path
) -> None:
    robot, arm = client.articulations["quadruped"], client.articulations["arm"]
    client.step(n_steps=1000)
    with record(client, tmp_path / "run.mcap", pose_hz=100, contacts=True):
        for _ in range(20):
            client.step(n_steps=5)
    found = messages(tmp_path / "run.mcap")
    kinds = {topic: schema for topic, schema, _, _ in found}
    for topic, _, log_time, content in found:
        (stamp,) = {
            (at["sec"], at["nsec"])
            for part in (content, *content.get("transforms", ()), *content.get("entities", ()))
            if (at := part.get("timestamp"))
        }
        assert stamp == divmod(log_time, 10**9), topic
    assert kinds["/tf"] == "foxglove.FrameTransforms"
    assert kinds["/joint_states"] == "foxglove.JointStates"
    poses = [content for topic, _, _, content in found if topic == "/tf"]
    assert len(poses) == 20
    last = {frame["child_frame_id"]: frame for frame in poses[-1]["transforms"]}
    trunk = last[f"quadruped_{next(iter(robot.bodies))}"]
    assert trunk["parent_frame_id"] == "world"
    assert bits(list(trunk["translation"].values())) == bits(robot.root_pos_w)
    assert [trunk["rotation"][axis] for axis in "wxyz"] == pytest.approx(robot.root_quat_w.tolist())
    joints = [content for topic, _, _, content in found if topic == "/joint_states"][-1]["joints"]
    position = {joint["name"]: joint["position"] for joint in joints}
    for name, value in arm.get_qpos().items():
        assert position[f"arm_{name}"] == value

    with record(client, tmp_path / "contacts.mcap", contacts=True):
        client.runtime.forward()  # the server's contacts are those of the state before the last step
        theirs = client.runtime.get_contacts().contacts
    (ours,) = [c["contacts"] for topic, _, _, c in messages(tmp_path / "contacts.mcap") if topic == "/contacts"]
    assert len(ours) == len(theirs) > 3
    for mine, other in zip(ours, theirs, strict=True):
        assert (mine["body1"], mine["body2"]) == (other.body1, other.body2)
        assert list(mine["position"].values()) == pytest.approx(list(other.pos), abs=1e-6)
        assert mine["distance"] == pytest.approx(other.dist, abs=1e-6)
    carried = sum(contact["force"]["z"] for contact in ours)
    assert carried == pytest.approx(
        9.81 * client.model.body_mass[[body.id for body in robot.bodies.values()]].sum(), rel=0.2
    )


def test_two_recordings_at_once_and_one_inside_the_other(client: urlab_client.URLabClient, tmp_path: Path) -> None:
    with record(client, tmp_path / "a.mcap") as outer:
        client.step()
        with record(client, tmp_path / "b.mcap", pose_hz=0) as inner:
            client.step()
        client.step()
    assert (outer.stats.states, inner.stats.states) == (3, 1)
    assert set(read_run(inner.path).summary().topics) == {"/state/arm", "/state/quadruped"}


def test_an_existing_file_is_not_overwritten_unasked(client: urlab_client.URLabClient, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(FileExistsError, match="overwrite=True replaces it"), record(client, path):
        pass
    assert path.read_bytes() == b"precious"
    with record(client, path, overwrite=True):
        client.step()
    assert len(read_run(path).table()) == 1


def test_a_client_closed_inside_the_block_leaves_a_whole_file(server: SimulatedServer, tmp_path: Path) -> None:
    client = urlab_client.URLabClient(**server.client_options(), step_mode="direct")
    client.discover()
    with record(client, tmp_path / "run.mcap"):
        client.step()
        client.close()
    assert read_run(tmp_path / "run.mcap").summary().complete


def test_wrong_arguments_are_refused(client: urlab_client.URLabClient, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    for options in (
        {"camera_hz": 0},
        {"pose_hz": -1},
        {"jpeg_quality": 100},
        {"buffer_mib": 0},
        {"image_format": "gif"},
        {"cameras": "arm/wrist"},
        {"contacts": True, "pose_hz": 0},
    ):
        with pytest.raises(ValueError, match=next(iter(options))):
            record(client, path, **options)
    with pytest.raises(KeyError, match="arm/wrist"), record(client, path, cameras=["nose"]):
        pass
    stranger = urlab_client.URLabClient("tcp://127.0.0.1:1")
    with pytest.raises(urlab_client.URLabError, match="discover") as early, record(stranger, path):
        pass
    assert early.value.hint == "Call discover() first, during play."
    stranger.close()
    assert not path.exists()


def test_a_recorder_records_once(client: urlab_client.URLabClient, tmp_path: Path) -> None:
    recorder = record(client, tmp_path / "run.mcap")
    with pytest.raises(urlab_client.URLabError, match="No recording is under way") as early:
        recorder.mark("success")
    assert early.value.hint == "Call mark() inside the block."
    with recorder, pytest.raises(urlab_client.URLabError, match="A recorder records once") as twice, recorder:
        pass
    assert twice.value.hint == "Call record() again."


# Pictures


@pytest.mark.opengl
def test_pictures_come_when_due_and_are_those_of_the_client(client: urlab_client.URLabClient, tmp_path: Path) -> None:
    view = client.articulations["arm"].cameras["wrist"]
    with record(client, tmp_path / "run.mcap", cameras=["arm/wrist"], camera_hz=50, image_format="png") as recorder:
        shots = []
        for _ in range(20):
            client.step(n_steps=4)
            shots.append((client.sim_time, view.latest_frame))
    assert recorder.stats.frames == pytest.approx(0.16 * 50, abs=1)
    run = read_run(recorder.path)
    assert run.cameras() == ["arm/wrist"]
    by_time = {round(time, 9): pixels for time, pixels in shots}
    pictures = list(run.frames("arm/wrist"))
    assert len(pictures) == recorder.stats.frames
    for picture in pictures:
        assert np.array_equal(picture.pixels, by_time[round(picture.time, 9)][..., :3])
    calibration = next(c for topic, _, _, c in messages(recorder.path) if topic == "/camera/arm/wrist/calibration")
    assert (calibration["width"], calibration["height"]) == view.resolution
    frames = {
        frame["child_frame_id"]
        for topic, _, _, content in messages(recorder.path)
        if topic == "/tf"
        for frame in content["transforms"]
    }
    assert "arm/wrist" in frames
    with pytest.raises(KeyError, match="arm/wrist"):
        next(run.frames("arm/nose"))


@pytest.mark.parametrize("steps", [0, 1])
def test_a_block_that_fails_leaves_a_file_only_of_what_was_recorded(
    steps: int, server: SimulatedServer, tmp_path: Path
) -> None:
    file = tmp_path / "run.mcap"

    def recorded(client: urlab_client.URLabClient) -> None:
        with record(client, file):
            for _ in range(steps):
                client.step()
            raise ZeroDivisionError

    with urlab_client.URLabClient(**server.client_options(), step_mode="direct") as client:
        client.discover()
        with pytest.raises(ZeroDivisionError):
            recorded(client)
    assert file.exists() == bool(steps)
    assert not steps or len(read_run(file).table()) == steps


# Live mode


@pytest.mark.opengl
def test_a_step_that_fails_costs_no_picture(tmp_path: Path) -> None:
    faults = Faults()
    with (
        SimulatedServer("arm", play=True, faults=faults, camera_size=(16, 12)) as server,
        urlab_client.URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        with record(client, tmp_path / "run.mcap", cameras=["arm/wrist"], camera_hz=1) as recorder:
            for _ in range(2):
                with faults.add(Refuse("step", code="not_ready", times=1)), pytest.raises(NotReady):
                    client.step()
            assert client.step().cameras
            assert not client.step().cameras
        assert recorder.stats.frames == 1


async def test_ended_streams_are_not_kept(server: SimulatedServer, tmp_path: Path) -> None:
    async with AsyncClient(**server.client_options()) as client:
        await client.discover()
        async with record(client, tmp_path / "run.mcap"):
            for _ in range(5):
                await client.runtime.set_mode("direct")
                await client.step()
                await client.runtime.set_mode("live")
                await client.step()
            await until(lambda: sum(task.get_name() == "urlab-feed" for task in asyncio.all_tasks()) == 1)
            gc.collect()
            kept = [found for found in gc.get_objects() if isinstance(found, asyncio.Task)]
            assert sum(task.get_name() == "urlab-feed" for task in kept) == 1


async def test_live_mode_records_every_snapshot_and_modes_may_change(tmp_path: Path) -> None:
    with SimulatedServer("arm", play=True) as server:
        async with AsyncClient(**server.client_options(), step_mode="live") as client:
            await client.discover()
            await client.runtime.set_paused(False)
            async with (
                client.state_stream("all", buffer=10_000) as snapshots,
                record(client, tmp_path / "run.mcap") as recorder,
            ):
                await until(lambda: recorder.stats.states >= 50)
                await client.runtime.set_mode("direct")
                await client.step()
                first = client.sim_time
                for _ in range(5):
                    await client.step()
                last = client.sim_time
                came = []
                while (snapshot := snapshots.receive_nowait()) is not None:
                    came.append(snapshot.time)
    table = read_run(recorder.path).table()
    live = [time for time in table.sim_time.tolist() if time < first]
    start = came.index(live[0])  # the stream was opened before
    assert len(live) >= 50
    assert live == came[start : start + len(live)]
    assert [time for time in table.sim_time if first <= time <= last] == pytest.approx(
        np.linspace(first, last, 6).tolist()
    )


def test_a_recording_shows_the_robot_without_anything_else(client: urlab_client.URLabClient, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with record(client, path):
        client.step()
    model = read_run(path).model()
    assert client.model is not None
    assert (model.nq, model.ngeom) == (client.model.nq, client.model.ngeom)
    with path.open("rb") as file:
        scenes = [message for _, channel, message in make_reader(file).iter_messages() if channel.topic == "/scene"]
    (update,) = [json.loads(message.data) for message in scenes]
    frames = {entity["frame_id"] for entity in update["entities"]}
    assert {"arm", "quadruped"} <= {frame.partition("_")[0] for frame in frames}
    shapes = [
        shape for entity in update["entities"] for kind in ("cubes", "spheres", "cylinders") for shape in entity[kind]
    ]
    assert len(shapes) > 10


def test_a_recording_without_a_model_says_so(server: SimulatedServer, tmp_path: Path) -> None:
    options = {**server.client_options(), "local_model": False, "step_mode": "direct"}
    path = tmp_path / "run.mcap"
    with urlab_client.URLabClient(**options) as client:
        client.discover()
        with record(client, path, pose_hz=0):
            client.step()
    with pytest.raises(RecordingError, match="no model"):
        read_run(path).model()


# What goes wrong

CHILD = """
import sys
from urlab_client import URLabClient
from urlab_client.integrations.record import record
address, path = sys.argv[1:]
with URLabClient(address, step_mode="direct") as client:
    client.discover()
    client.reset()
    with record(client, path) as recorder:
        while True:
            client.step()
            print(client.step_count, recorder.stats.states, recorder.stats.file_bytes, flush=True)
"""


def test_a_killed_process_leaves_what_was_written(server: SimulatedServer, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    address = f"{server.address}:{server.step_port}"
    with child("-c", CHILD, address, path, stderr=None) as recording:
        assert recording.stdout is not None
        start = 0
        for line in recording.stdout:
            _, _, written = map(int, line.split())
            if written > start:
                start = written
                if len(read_run(path).table()):  # and not the model alone
                    break
    run = read_run(path)
    table = run.table()
    assert len(table) > 0
    assert table.step.tolist() == list(range(1, len(table) + 1))
    summary = run.summary()
    assert not summary.complete
    assert summary.about["mujoco_version"]


def test_a_cut_file_is_read_up_to_the_cut(client: urlab_client.URLabClient, tmp_path: Path) -> None:
    path, cut = tmp_path / "run.mcap", tmp_path / "cut.mcap"
    with record(client, path, pose_hz=0):
        for _ in range(50):
            client.step()
    whole, table = path.read_bytes(), read_run(path).table()
    steps = []
    for size in sorted({8, 9, 17, *np.linspace(100, len(whole) - 1, 40, dtype=int).tolist()}):
        cut.write_bytes(whole[:size])
        run = read_run(cut)
        part = run.table()
        assert run.damage
        steps.append(len(part))
        assert part.step.tolist() == table.step[: len(part)].tolist()
        end = run.state_at(1e9)
        assert (0 if end is None else end.step) in {0, *table.step[: len(part) + 1].tolist()}
        assert run.summary().topics.keys() <= {"/state/arm", "/state/quadruped"}
    assert steps == sorted(steps)
    assert steps[-1] == 50
    assert read_run(cut).model().nq == client.model.nq, "of a recorder that was killed"
    cut.write_bytes(whole[: whole.index(b"model.mjb")])
    with pytest.raises(RecordingError, match="the model in it cannot be read"):
        read_run(cut).model()
    for size in (0, 7):
        cut.write_bytes(whole[:size])
        with pytest.raises(RecordingError, match="neither an MCAP file"):
            read_run(cut)
    cut.write_bytes(b"PK" + whole)
    with pytest.raises(RecordingError, match="neither an MCAP file"):
        read_run(cut)


def test_a_sample_is_left_out_if_the_file_ends_within_it(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    both = {"arm": Robot([1.0]), "leg": Robot([2.0])}
    write_recording(path, [(both, {}), (both, {}), ({"arm": Robot([3.0])}, {})])
    assert read_run(path).table().step.tolist() == [0, 1, 2], "a robot may leave"
    path.write_bytes(path.read_bytes()[:-1])
    run = read_run(path)
    assert run.table().step.tolist() == [0, 1]
    assert run.damage


def test_what_is_recorded_is_soon_in_the_file(
    client: urlab_client.URLabClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording, "_FLUSH_S", 0.0)
    path = tmp_path / "run.mcap"
    with record(client, path, pose_hz=0):
        for count in (1, 2):  # also what comes after it was written once
            client.step()
            eventually(lambda count=count: len(read_run(path).table()) == count)


def test_messages_out_of_order_are_found_without_an_index(tmp_path: Path) -> None:
    source, shuffled = tmp_path / "run.mcap", tmp_path / "shuffled.mcap"
    write_recording(source, (({"arm": Robot([float(number)])}, {}) for number in range(6)))
    content = messages_of(source)
    unindexed = {"index_types": IndexType.NONE}
    write_messages(shuffled, [content[number] for number in (3, 1, 0, 5, 2, 4)], **unindexed)
    for time in np.arange(-0.005, 0.06, 0.005).tolist():
        expected, found = read_run(source).state_at(time), read_run(shuffled).state_at(time)
        assert (expected is None) == (found is None)
        if expected is not None and found is not None:
            assert found.articulations["arm"].qpos.tolist() == expected.articulations["arm"].qpos.tolist()


def test_damage_costs_what_is_damaged_and_no_more(
    client: urlab_client.URLabClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writing, "_CHUNK_BYTES", 20_000)
    path = tmp_path / "run.mcap"
    with record(client, path, pose_hz=0):
        for _ in range(100):
            client.step()
    table = read_run(path).table()
    with path.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    assert len(chunks) > 4
    whole = read_run(path)
    for moment, step in zip(table.time, table.step, strict=True):  # also where one robot's state is in the next chunk
        found = whole.state_at(moment)
        assert found is not None
        assert (found.step, len(found.articulations)) == (step, 2)
    hurt = chunks[len(chunks) // 2]
    with path.open("r+b") as file:
        file.seek(hurt.chunk_start_offset + hurt.chunk_length // 2)
        file.write(b"\0" * 16)
    run = read_run(path)
    first, last = run.state_at(table.time[0]), run.state_at(table.time[-1])  # what is there does not depend on the rest
    assert first is not None
    assert last is not None
    assert (first.step, last.step) == (table.step[0], table.step[-1])
    with pytest.raises(RecordingError, match=f"damaged at byte {hurt.chunk_start_offset}"):
        run.state_at(hurt.message_start_time / 1e9)
    assert run.summary().complete, "the index says nothing of it"
    checked = run.summary(verify=True)
    assert not checked.complete
    assert checked.damage
    assert 0 < len(run.table()) < len(table)


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_full_disk_is_told_and_costs_the_simulation_nothing(
    client: urlab_client.URLabClient, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    import resource

    path = tmp_path / "run.mcap"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    recorder = record(client, path)
    rng = np.random.default_rng(0)
    try:
        with pytest.raises(RecordingError, match=r"broke off: File too large.*can be read") as caught, recorder:  # noqa: PT012
            start, steps = recorder.stats.file_bytes, 0
            for steps in range(1, 200_001):  # noqa: B007
                for art in client.articulations.values():
                    art.ctrl_array[:] = rng.uniform(-1, 1, len(art.ctrl_array))
                client.step()
                if recorder.failed:
                    break
                if recorder.stats.file_bytes > start and resource.getrlimit(resource.RLIMIT_FSIZE) == before:
                    start = recorder.stats.file_bytes
                    if len(read_run(path).table()):  # and not the model alone
                        resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 1000, before[1]))
            assert recorder.failed
            written = recorder.stats.states
            client.step()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    cause = caught.value.__cause__
    assert isinstance(cause, OSError)
    assert cause.errno == errno.EFBIG
    assert recorder.stats.states == written
    # Each state is one or the other; only the one that met the full disk may be neither.
    assert steps <= recorder.stats.states + recorder.stats.dropped_states <= steps + 1
    assert recorder.stats.dropped_frames == 0
    assert "recording stopped" in caplog.text
    run = read_run(path)
    table = run.table()
    assert 0 < len(table) <= written
    assert table.step.tolist() == list(range(1, len(table) + 1))
    assert not run.summary().complete


def test_what_the_file_cannot_keep_up_with_is_dropped_and_counted(
    client: urlab_client.URLabClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    going = threading.Event()
    write: Callable[..., None] = writing._Sink.write

    def slowly(self: Any, item: Any) -> None:
        assert going.wait(30)
        write(self, item)

    monkeypatch.setattr(writing._Sink, "write", slowly)

    def drive() -> Any:
        with record(client, tmp_path / "run.mcap", buffer_mib=0.1, lossless=False) as recorder:
            for _ in range(200):
                client.step()
            assert recorder.stats.waiting_bytes <= 0.1 * 2**20
            going.set()
        return recorder

    with pytest.warns(UserWarning, match=r"run\.mcap: 1\d\d states and 0 pictures were lost"):
        recorder = drive()
    dropped = recorder.stats.dropped_states
    assert 100 < dropped < 200
    table, summary = read_run(recorder.path).table(), read_run(recorder.path).summary()
    assert (len(table), summary.dropped_states) == (200 - dropped, dropped)
    assert table.step.tolist() == list(range(1, 201 - dropped))


@pytest.fixture
def seeing() -> Iterator[urlab_client.URLabClient]:
    """A client of a server that draws small pictures."""
    with (
        SimulatedServer("arm", play=True, camera_size=(64, 48)) as server,
        urlab_client.URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        yield client


@pytest.mark.opengl
def test_steps_wait_for_a_file_that_cannot_keep_up(
    seeing: urlab_client.URLabClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    going = threading.Event()
    write: Callable[..., None] = writing._Sink.write
    seen: list[int] = []

    def slowly(self: Any, item: Any) -> None:
        assert going.wait(30)
        write(self, item)

    room, waiting = writing.WriterThread.room, threading.Event()

    async def watched(self: Any) -> None:
        waits = asyncio.ensure_future(room(self))
        await asyncio.sleep(0)
        if not waits.done():
            waiting.set()
        await waits

    monkeypatch.setattr(writing._Sink, "write", slowly)
    monkeypatch.setattr(writing.WriterThread, "room", watched)
    with record(seeing, tmp_path / "run.mcap", cameras=["arm/wrist"], camera_hz=500, buffer_mib=0.2) as recorder:

        def drive() -> None:
            for _ in range(40):
                seeing.step()
                seen.append(recorder.stats.waiting_bytes)

        stepping = threading.Thread(target=drive)
        stepping.start()
        eventually(lambda: waiting.is_set() or not stepping.is_alive())
        assert stepping.is_alive(), "a step waits"
        assert 0.1 * 2**20 < max(seen) < 0.2 * 2**20
        going.set()
        stepping.join()
    summary = read_run(recorder.path).summary()
    assert (summary.dropped_states, summary.dropped_frames) == (0, 0)
    assert summary.topics["/state/arm"].messages == summary.topics["/camera/arm/wrist"].messages == 40


def test_a_file_that_takes_nothing_any_more_is_not_waited_for_without_end(
    client: urlab_client.URLabClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    going = threading.Event()
    write: Callable[..., None] = writing._Sink.write

    def never(self: Any, item: Any) -> None:
        assert going.wait(30)
        write(self, item)

    monkeypatch.setattr(writing._Sink, "write", never)
    monkeypatch.setattr(writing, "_STALL_S", 0.1)

    def drive() -> None:
        with record(client, tmp_path / "run.mcap", buffer_mib=0.05):
            for _ in range(100):
                client.step()
            going.set()

    with pytest.warns(UserWarning, match=r"\d\d+ states and 0 pictures were lost"):
        drive()


@pytest.mark.opengl
def test_pictures_that_a_server_did_not_send_are_told(
    seeing: urlab_client.URLabClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    take: Callable[..., None] = StepPictures.take
    monkeypatch.setattr(
        StepPictures, "take", lambda self, reply: take(self, reply) if reply.step > 3 else setattr(reply, "cameras", {})
    )

    def drive() -> None:
        with record(seeing, tmp_path / "run.mcap", cameras=["arm/wrist"], camera_hz=500):
            for _ in range(5):
                seeing.step()

    with pytest.warns(UserWarning, match="0 states and 3 pictures were lost"):
        drive()
    assert read_run(tmp_path / "run.mcap").summary().dropped_frames == 3


# Messages

FLOATS = st.floats(allow_nan=True, allow_infinity=True, width=64)


@hypothesis.given(st.lists(FLOATS, max_size=5), FLOATS)
def test_numbers_survive_to_the_bit(numbers: list[float], time: float) -> None:
    message = ArticulationMessage(
        timestamp=Time.of(1_000_000_001),
        sim_time=time,
        sample=0,
        step=0,
        episode=0,
        wall_time=Time.of(0),
        qpos=numbers,
        qvel=[],
        sensors={"null": numbers},
    )
    read = _DECODERS[schema_name(ArticulationMessage)](encode(message))
    for back in (read.qpos, read.sensors["null"]):
        assert len(back) == len(numbers)
        for got, expected in zip(back, numbers, strict=True):
            assert bits(got) == bits(expected) or (math.isnan(got) and math.isnan(expected))
    assert json.loads(encode(message))["timestamp"] == {"sec": 1, "nsec": 1}


@pytest.mark.parametrize(("kind", "fields"), FOXGLOVE.items(), ids=lambda value: getattr(value, "__name__", ""))
def test_schemas_are_foxgloves_and_hold_no_references(kind: type, fields: set[str]) -> None:
    text = schema_of(kind)
    schema = json.loads(text)
    assert schema["title"] == f"foxglove.{kind.__name__}"
    assert set(schema["properties"]) == fields
    assert b"$ref" not in text
    if "data" in fields:
        assert schema["properties"]["data"] == {"type": "string", "contentEncoding": "base64"}
