"""`record()`: what a client goes through, written to one file while it goes on."""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Literal, Self, overload

import anyio.to_thread

from urlab_client.aio.cameras import URLabCameraView
from urlab_client.aio.client import URLabClient as AsyncClient
from urlab_client.aio.state import SimState
from urlab_client.integrations.record.scene import Scene
from urlab_client.integrations.record.writer import Picture, RecorderStats, Schedule, State, WriterOptions, WriterThread
from urlab_client.protocol.enums import StepMode
from urlab_client.protocol.errors import ClientClosed, StreamOverflow, URLabError
from urlab_client.protocol.messages.session import ResetOk, StateReply, StepOk
from urlab_client.protocol.messages.streams import StateSnapshot
from urlab_client.sync._portal import Portal, aio_of
from urlab_client.sync.client import URLabClient

__all__ = ["AsyncRecorder", "Recorder", "record"]

log = logging.getLogger("urlab_client.record")

_MIB = 1 << 20
_LIVE_ITEMS = 10_000
_FLUSH_S = 1.0
_NS = 1_000_000_000


class AsyncRecorder:
    """A recording that is under way between `async with` and its end. Made by `record`."""

    def __init__(
        self,
        client: AsyncClient,
        path: Path,
        *,
        cameras: Sequence[str] | Literal["all"],
        camera_hz: float,
        pose_hz: float,
        options: Callable[[], WriterOptions],
    ) -> None:
        self._client = client
        self._state: SimState = client._state  # noqa: SLF001  # pyright: ignore[reportPrivateUsage]
        self._wanted_cameras = cameras
        self._camera_ns = round(_NS / camera_hz)
        self._pictures = Schedule(self._camera_ns)
        self._needs_model = pose_hz > 0
        self._options = options
        self._path = path
        self._writer: WriterThread | None = None
        self._scene: Scene | None = None
        self._described: object = None
        self._expected = False
        self._tasks: list[asyncio.Task[None]] = []
        self._live = False

    @property
    def path(self) -> Path:
        """The file."""
        return self._path

    @property
    def stats(self) -> RecorderStats:
        """Counters up to now, from any thread."""
        if self._writer is None:
            return RecorderStats(states=0, frames=0, dropped_states=0, dropped_frames=0, waiting_bytes=0, file_bytes=0)
        return self._writer.stats

    @property
    def failed(self) -> bool:
        """Whether writing has failed; leaving the block raises the reason."""
        return self._writer is not None and self._writer.error is not None

    async def __aenter__(self) -> Self:
        if self._writer is not None:
            raise URLabError("A recorder records once.", hint="Call record() again.")
        if self._state.hello is None:
            raise URLabError(
                "record: what there is to record is not known yet.", hint="Call discover() first, during play."
            )
        self._current()
        self._writer = WriterThread(self._path, self._options())
        await anyio.to_thread.run_sync(self._writer.open)
        self._state.observers.append(self)
        if self._state.mode is StepMode.LIVE:
            self._listen()
        return self

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._detach()
        for outcome in await asyncio.gather(*self._tasks, return_exceptions=True):
            if isinstance(outcome, Exception):
                log.warning("%s: a stream was not recorded to its end: %s", self._path, outcome)
        writer = self._writer
        if writer is None:
            return
        try:
            await anyio.to_thread.run_sync(writer.close, abandon_on_cancel=True)
        except URLabError:
            if exc is None:
                raise  # else it has been logged, and what ends the block matters more

    def finish(self) -> None:
        """Finish the file when the client's loop is gone already. Blocks."""
        if self in self._state.observers:
            self._state.observers.remove(self)
        if self._writer is not None:
            self._writer.close()

    # What the client calls

    def on_state(self, reply: StateReply | StateSnapshot) -> None:
        """Take a state over; see `StateObserver`."""
        live = self._state.mode is StepMode.LIVE
        if live is not self._live:
            if live:
                self._listen()
            else:
                self._ignore()
        if not live:
            self._put(reply)

    def wanted_pictures(self, asked: bool | dict[str, str | None], n_steps: int) -> bool | dict[str, str | None]:
        """Add the cameras to a step when their next picture is due; see `StateObserver`."""
        state = self._state
        if state.mode is StepMode.LIVE or not self._wanted_cameras:
            return asked
        timestep = 0.0 if state.mirror.model is None else state.mirror.model.opt.timestep
        then = round((state.sim_time + max(n_steps, 1) * timestep) * _NS)
        self._expected = self._pictures.due(then)
        if asked is True or not self._expected:
            return asked
        chosen = dict(asked or {})
        known = {id(state.camera(name)) for name in chosen}
        for view, camera in self._current().cameras.items():
            if view not in known:
                chosen[camera.name] = "sync"
        return chosen or False

    # Inside

    def _current(self) -> Scene:
        """Return the scene, described anew when there was another handshake."""
        model = self._state.mirror.model
        if self._scene is None or model is not self._described:
            self._described = model
            try:
                self._scene = self._describe()
            except (KeyError, URLabError) as error:
                if self._scene is None:
                    raise
                # The client goes on, and so does the recording, with what it knows.
                log.warning("%s: the new scene lacks what is recorded: %s", self._path, error)
        return self._scene

    def _describe(self) -> Scene:
        state = self._state
        if self._needs_model and state.mirror.model is None:
            raise URLabError(
                "record: poses are computed with the local model, and there is none.",
                hint="Call discover() during play, with local_model=True, or pass pose_hz=0.",
            )
        return Scene.of(state, self._views())

    def _views(self) -> list[tuple[str, URLabCameraView]]:
        state = self._state
        every = {
            f"{key}/{name}": view for key, art in state.articulations.items() for name, view in art.cameras.items()
        }
        every |= dict(state.global_cameras)
        if self._wanted_cameras == "all":
            return list(every.items())
        names = {id(view): name for name, view in every.items()}
        chosen: dict[int, tuple[str, URLabCameraView]] = {}
        for wanted in self._wanted_cameras:
            view = state.camera(wanted)
            if view is None:
                raise KeyError(f"no camera {wanted!r}; there are: {', '.join(every) or 'none'}")
            chosen[id(view)] = names[id(view)], view
        return list(chosen.values())

    def _put(self, reply: StateReply | StateSnapshot) -> None:
        writer = self._writer
        if writer is None:
            return
        state, scene = self._state, self._current()
        clock, wall = reply.sim_time, reply.wall_time
        nanoseconds = round(reply.time * _NS) if clock is None else clock.sec * _NS + clock.nsec
        wall_ns = state.recv_wall_time_ns if wall is None else wall.sec * _NS + wall.nsec
        set_points = {key: record.ctrl.tolist() for key, record in state.records.items()}
        writer.put(State(scene, reply, set_points, nanoseconds, isinstance(reply, ResetOk), wall_ns))
        if isinstance(reply, StepOk) and reply.cameras and self._expected:
            self._expected = False
            for name, frame in reply.cameras.items():
                camera = scene.cameras.get(id(state.camera(name)))
                if camera is not None:
                    writer.put(Picture(camera, frame, nanoseconds, wall_ns))

    def _listen(self) -> None:
        """Follow the streams, as live mode brings nothing by replies."""
        self._live = True
        scene = self._current()
        self._tasks = [asyncio.create_task(self._follow_states(), name="urlab-record")]
        self._tasks += [asyncio.create_task(self._follow_camera(view), name="urlab-record") for view in scene.cameras]

    def _ignore(self) -> None:
        self._live = False
        for task in self._tasks:
            task.cancel()

    def _detach(self) -> None:
        if self in self._state.observers:
            self._state.observers.remove(self)
        self._ignore()
        if self._writer is not None:
            self._writer.end()  # from here on it finishes the file, whatever becomes of the caller

    async def _follow_states(self) -> None:
        last: float | None = None
        async with self._client.state_stream("all", buffer=_LIVE_ITEMS, timeout=None) as states:
            while True:
                try:
                    snapshot = await states.receive(timeout=None)
                except StreamOverflow as lost:
                    log.warning("%s: %s", self._path, lost)
                    continue
                except ClientClosed:
                    return
                if (
                    self._state.mode is StepMode.LIVE and snapshot.time != last
                ):  # while paused the same state comes with every tick
                    last = snapshot.time
                    self._put(snapshot)

    async def _follow_camera(self, identity: int) -> None:
        camera = self._current().cameras[identity]
        schedule = Schedule(self._camera_ns)
        async with camera.view.frames("latest", timeout=None) as frames:
            while True:
                try:
                    sample = await frames.receive(timeout=None)
                except ClientClosed:
                    return
                nanoseconds = round((self._state.sim_time if sample.sim_time is None else sample.sim_time) * _NS)
                if self._writer is not None and schedule.due(nanoseconds):
                    self._writer.put(Picture(camera, sample.pixels, nanoseconds, sample.recv_wall_time_ns))


class Recorder:
    """A recording that is under way between `with` and its end. Made by `record`."""

    def __init__(self, recorder: AsyncRecorder, portal: Portal) -> None:
        self._aio = recorder
        self._portal = portal

    @property
    def path(self) -> Path:
        """The file."""
        return self._aio.path

    @property
    def stats(self) -> RecorderStats:
        """Counters up to now."""
        return self._aio.stats

    @property
    def failed(self) -> bool:
        """Whether writing has failed; leaving the block raises the reason."""
        return self._aio.failed

    def __enter__(self) -> Self:
        self._portal.call(self._aio.__aenter__())
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            self._portal.call(self._aio.__aexit__(exc_type, exc, traceback))
        except ClientClosed:
            self._aio.finish()


@overload
def record(
    client: AsyncClient,
    path: str | os.PathLike[str],
    *,
    cameras: Sequence[str] | Literal["all"] = ...,
    camera_hz: float = ...,
    image_format: Literal["jpeg", "png"] = ...,
    jpeg_quality: int = ...,
    pose_hz: float = ...,
    contacts: bool = ...,
    buffer_mib: float = ...,
    overwrite: bool = ...,
) -> AsyncRecorder: ...
@overload
def record(
    client: URLabClient,
    path: str | os.PathLike[str],
    *,
    cameras: Sequence[str] | Literal["all"] = ...,
    camera_hz: float = ...,
    image_format: Literal["jpeg", "png"] = ...,
    jpeg_quality: int = ...,
    pose_hz: float = ...,
    contacts: bool = ...,
    buffer_mib: float = ...,
    overwrite: bool = ...,
) -> Recorder: ...
def record(
    client: AsyncClient | URLabClient,
    path: str | os.PathLike[str],
    *,
    cameras: Sequence[str] | Literal["all"] = (),
    camera_hz: float = 30.0,
    image_format: Literal["jpeg", "png"] = "jpeg",
    jpeg_quality: int = 90,
    pose_hz: float = 50.0,
    contacts: bool = False,
    buffer_mib: float = 64.0,
    overwrite: bool = False,
) -> AsyncRecorder | Recorder:
    """Record what a client goes through into an MCAP file: a context manager, of the client's own flavour.

    In `direct` and `puppet` mode every reply of `step`, `reset` and `forward` is one state, whoever made the call; in
    `live` mode every snapshot that the server publishes is, unless time stands still. A thread encodes and writes;
    stepping never waits for it. When it falls behind by `buffer_mib`, states are dropped, and by half of that,
    pictures; what was dropped is counted in `stats` and in the file.

    Args:
        client: A client after `discover()`, during play.
        path: The file. A chunk is written at least each second, so a killed process loses no more than that.
        cameras: Cameras whose pictures to keep, `ARTICULATION/CAMERA` or a scene-level name; `all` for each of them.
            In `direct` and `puppet` mode they are drawn with the step in which they are due, which takes longer then.
        camera_hz: Pictures per second of simulation time, at most.
        image_format: How colour pictures are stored; others are always stored without loss.
        jpeg_quality: 1 to 95.
        pose_hz: Sets of poses and joint states per second of simulation time, for 3D views; 0 for none.
        contacts: Keep contacts with each set of poses, computed from the state with the client's own model.
        buffer_mib: MiB that may wait to be written.
        overwrite: Replace a file that exists.

    Raises:
        ValueError: An option is out of range.

    Entering the block raises `FileExistsError` or another `OSError` when the file cannot be made, `KeyError` for an
    unknown camera, and `URLabError` before `discover()`; leaving it raises `RecordingError` when writing failed, for
    example because the disk is full.
    """
    _check(camera_hz=camera_hz, pose_hz=pose_hz, jpeg_quality=jpeg_quality, buffer_mib=buffer_mib)
    if image_format not in ("jpeg", "png"):
        raise ValueError(f"image_format is 'jpeg' or 'png', not {image_format!r}")
    if contacts and pose_hz == 0:
        raise ValueError("contacts come with the poses: pose_hz must be above 0")
    if isinstance(cameras, str) and cameras != "all":
        raise ValueError(f"cameras is a sequence of names or 'all', not {cameras!r}")
    core = aio_of(client) if isinstance(client, URLabClient) else client

    def options() -> WriterOptions:
        return WriterOptions(
            image_format=image_format,
            jpeg_quality=jpeg_quality,
            pose_ns=round(_NS / pose_hz) if pose_hz else 0,
            contacts=contacts,
            buffer_bytes=round(buffer_mib * _MIB),
            flush_s=_FLUSH_S,
            overwrite=overwrite,
            about={
                "address": core.address,
                "step_mode": str(core.step_mode),
                "urlab_version": core.urlab_version,
                "mujoco_version": core.mujoco_version,
                "timestep": "" if core.model is None else repr(float(core.model.opt.timestep)),
            },
        )

    chosen = cameras if cameras == "all" else tuple(cameras)
    recorder = AsyncRecorder(core, Path(path), cameras=chosen, camera_hz=camera_hz, pose_hz=pose_hz, options=options)
    if isinstance(client, URLabClient):
        return Recorder(recorder, client._portal)  # noqa: SLF001  # pyright: ignore[reportPrivateUsage]
    return recorder


def _check(*, camera_hz: float, pose_hz: float, jpeg_quality: int, buffer_mib: float) -> None:
    if not 0 < camera_hz <= 1e6:
        raise ValueError(f"camera_hz is above 0, not {camera_hz}")
    if not 0 <= pose_hz <= 1e6:
        raise ValueError(f"pose_hz is 0 or more, not {pose_hz}")
    if not 1 <= jpeg_quality <= 95:
        raise ValueError(f"jpeg_quality is 1 to 95, not {jpeg_quality}")
    if not 0 < buffer_mib < 1e6:
        raise ValueError(f"buffer_mib is above 0, not {buffer_mib}")
