"""`record()`: write the states and pictures of a client to one file during a run."""

from __future__ import annotations

import logging
import os
import time
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Literal, get_args

import anyio.to_thread
import msgspec
import numpy as np
from numpy.typing import ArrayLike

from urlab_client.aio.arguments import finite_array
from urlab_client.aio.articulation import compiled_prefixes
from urlab_client.aio.client import URLabClient as AsyncClient
from urlab_client.errors import URLabError
from urlab_client.integrations._feed.follower import Follower
from urlab_client.integrations._feed.messages import EpisodeOutcome
from urlab_client.integrations._feed.samples import EpisodeMark
from urlab_client.integrations._flavours import AsyncBlock, Block, BlockingBlock, flavoured, in_flavour, opened
from urlab_client.integrations._variation import wire_variation
from urlab_client.integrations.record.writer import RecorderStats, WriterOptions, WriterThread
from urlab_client.protocol.messages.session import ControllerInfo
from urlab_client.randomise.variation import declared_in
from urlab_client.sync.client import URLabClient
from urlab_client.values.names import lasting_names

log: logging.Logger = logging.getLogger("urlab_client.record")

_MIB = 1 << 20
_LIVE_ITEMS = 10_000
_FLUSH_S = 1.0
_NS = 1_000_000_000


class Recording(Block):
    """A recording in progress, of either flavour."""

    def __init__(
        self,
        client: AsyncClient,
        path: Path,
        options: WriterOptions,
        *,
        cameras: Sequence[str] | Literal["all"],
        camera_hz: float,
    ) -> None:
        needs = ", or pass pose_hz=0" if options.pose_ns > 0 else None
        self._follower = Follower(
            client, name=f"record {path}", cameras=cameras, camera_hz=camera_hz, needs_model=needs, buffer=_LIVE_ITEMS
        )
        self._client = client
        self._options = options
        self._path = path
        self._writer: WriterThread | None = None
        self._used = self._ended = False

    def __repr__(self) -> str:
        running = "failed" if self.failed else "ended" if self._ended else "recording"
        stats, state = self.stats, running if self._used else "not begun"
        held = f"{stats.states} states, {stats.frames} pictures"
        return f"<{type(self).__name__} {str(self._path)!r} {state}, {held}>"

    @property
    def path(self) -> Path:
        """The file."""
        return self._path

    @property
    def stats(self) -> RecorderStats:
        """Current counters. Thread-safe."""
        if self._writer is None:
            return RecorderStats(
                states=0, frames=0, duration_s=0.0, dropped_states=0, dropped_frames=0, waiting_bytes=0, file_bytes=0
            )
        return self._writer.stats

    @property
    def failed(self) -> bool:
        """Whether writing has failed; leaving the block raises the reason."""
        return self._writer is not None and self._writer.error is not None

    @property
    def without_pictures(self) -> list[str]:
        """Cameras to record without a picture in the file so far."""
        there = frozenset[str]() if self._writer is None else self._writer.cameras
        return [name for name in self._follower.cameras if name not in there]

    def _mark(self, outcome: EpisodeOutcome, goal: Mapping[str, ArrayLike]) -> None:
        if outcome not in get_args(EpisodeOutcome):
            raise ValueError(f"outcome must be one of {', '.join(get_args(EpisodeOutcome))}, not {outcome!r}")
        given = {name: finite_array(f"goal {name!r}", np.ravel(values)).tolist() for name, values in goal.items()}
        if self._writer is None or self._ended:
            raise URLabError(
                "No recording is under way, so no episode can be marked.", hint="Call mark() inside the block."
            )
        self._writer.mark(EpisodeMark(outcome, given, time.time_ns()))

    async def _begin(self) -> None:
        if self._used:
            raise URLabError("A recorder records once.", hint="Call record() again.")
        self._follower.check()
        self._used = True
        about = _about(self._client)
        self._writer = writer = await opened(lambda: WriterThread(self._path, self._options, about), WriterThread.close)
        self._follower.start(
            writer.put, room=writer.room, lost=writer.lose_frames, failed=writer.give_up, note=writer.note
        )

    async def _end(self, error: BaseException | None) -> None:
        self._follower.detach()
        self._ended = True
        writer = self._writer
        if writer is not None:
            writer.end()  # from here on it finishes the file, even if the caller is cancelled
        await self._follower.ended()
        if writer is None:
            return
        try:
            await anyio.to_thread.run_sync(writer.close, abandon_on_cancel=True)
        except URLabError:
            if error is None:
                raise  # otherwise it was logged, and the exception that ends the block takes precedence
            return
        stats = writer.stats
        if error is not None and not (stats.states or stats.frames):
            self._path.unlink(missing_ok=True)  # nothing was recorded
            return
        if missing := self.without_pictures:
            log.warning(
                "%s: no picture of %s came. Physics was paused, or the server has no OpenGL, as its log says.",
                self._path,
                ", ".join(missing),
            )
        if stats.dropped_states or stats.dropped_frames:
            lost = f"{stats.dropped_states} states and {stats.dropped_frames} pictures"
            warnings.warn(f"{self._path}: {lost} were lost, see /recording/gaps in it.", stacklevel=3)

    def _finish(self) -> None:
        self._follower.forget()
        if self._writer is not None:
            self._writer.close()


class AsyncRecorder(Recording, AsyncBlock):
    """A recording in progress, for the duration of an `async with` block. Created by `record`."""

    async def mark(self, outcome: EpisodeOutcome, *, goal: Mapping[str, ArrayLike] = MappingProxyType({})) -> None:
        """Mark the outcome of the current episode, from the last reset to the next one.

        Conversions omit discarded episodes and, if any episode is marked, those without a mark. If an episode is marked
        several times, the last mark counts.

        Args:
            outcome: `success`, `failure` or `discarded`.
            goal: Goal of the episode, numbers or arrays by name, which becomes part of observations.

        Raises:
            ValueError: The outcome is unknown, or the goal contains NaN or infinity.
            URLabError: The recording has not started, or has ended.
        """
        self._mark(outcome, goal)


class Recorder(Recording, BlockingBlock):
    """A recording in progress, for the duration of a `with` block. Created by `record`."""

    def mark(self, outcome: EpisodeOutcome, *, goal: Mapping[str, ArrayLike] = MappingProxyType({})) -> None:
        """Mark the outcome of the current episode; see `AsyncRecorder.mark`."""
        self._mark(outcome, goal)


@flavoured(AsyncRecorder, Recorder)
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
    lossless: bool = True,
    buffer_mib: float = 64.0,
    overwrite: bool = False,
) -> AsyncRecorder | Recorder:
    """Record the states and pictures of a client into an MCAP file; a context manager of the client's flavour.

    In `direct` and `puppet` mode, every reply to `step`, `reset` and `forward` is one state, for calls from any task.
    In `live` mode, every published snapshot is one state, unless time stands still. A thread encodes and writes. When
    it falls behind by half of `buffer_mib`, steps in `direct` and `puppet` mode wait before they are sent, so nothing
    is lost. In `live` mode, which cannot wait, and with `lossless=False`, pictures are dropped at that point, and
    states when `buffer_mib` is full. Losses are counted in `stats` and in the file, and leaving the block warns about
    them.

    Args:
        client: A client after `discover()`, during play.
        path: The file. A chunk is written at least every second, so a killed process loses at most that.
        cameras: Cameras to record, `ARTICULATION/CAMERA` or a scene-level name; `all` for all of them.
            In `direct` and `puppet` mode they are drawn with the step in which they are due, which then takes longer.
        camera_hz: Maximum number of pictures per second of simulation time.
        image_format: Format of colour pictures; other pictures are always stored losslessly.
        jpeg_quality: 1 to 95.
        pose_hz: Sets of poses and joint states per second of simulation time, for 3-D views; 0 for none.
        contacts: Record contacts with each set of poses, computed from the state with the client's local model.
        lossless: Make steps wait instead of dropping data, except in `live` mode.
        buffer_mib: Size of the write buffer, MiB.
        overwrite: Replace an existing file.

    Raises:
        ValueError: An option is out of range.

    Entering the block raises `FileExistsError` or another `OSError` if the file cannot be created, `KeyError` for an
    unknown camera, and `URLabError` before `discover()`. If an exception ends the block before anything was recorded,
    the file is removed. Leaving it raises `RecordingError` if writing failed, for example because the disk is full.
    """
    _check(camera_hz=camera_hz, pose_hz=pose_hz, jpeg_quality=jpeg_quality, buffer_mib=buffer_mib)
    if image_format not in ("jpeg", "png"):
        raise ValueError(f"image_format must be 'jpeg' or 'png', not {image_format!r}")
    if contacts and pose_hz == 0:
        raise ValueError("contacts come with the poses: pose_hz must be above 0")
    options = WriterOptions(
        image_format=image_format,
        jpeg_quality=jpeg_quality,
        pose_ns=round(_NS / pose_hz) if pose_hz else 0,
        contacts=contacts,
        buffer_bytes=round(buffer_mib * _MIB),
        flush_s=_FLUSH_S,
        overwrite=overwrite,
        lossless=lossless,
    )
    return in_flavour(client, AsyncRecorder, Recorder, Path(path), options, cameras=cameras, camera_hz=camera_hz)


def _about(client: AsyncClient) -> dict[str, str]:
    """Return the metadata of a recording: also robots' controllers, and the randomisation of server or environment."""
    model = client.model
    about = {
        "address": client.address,
        "step_mode": str(client.step_mode),
        "urlab_version": client.urlab_version,
        "mujoco_version": client.mujoco_version,
        "timestep": "" if model is None else repr(float(model.opt.timestep)),
    }
    called = lasting_names(compiled_prefixes(client.articulations))  # as the topics are
    controllers = {
        called[key]: ControllerInfo(kind=str(one.kind), params=dict(one.params), schema=dict(one.schema))
        for key, art in client.articulations.items()
        if (one := art.controller) is not None
    }
    if controllers:
        about["controllers"] = msgspec.json.encode(controllers).decode()
    declared = None if model is None else declared_in(model)
    if declared is None and (varied := wire_variation(client)) is not None:
        declared = varied.declaration
    return about if declared is None else {**about, "randomise": declared.to_json()}


def _check(*, camera_hz: float, pose_hz: float, jpeg_quality: int, buffer_mib: float) -> None:
    if not 0 < camera_hz <= 1e6:
        raise ValueError(f"camera_hz must be above 0, not {camera_hz}")
    if not 0 <= pose_hz <= 1e6:
        raise ValueError(f"pose_hz must be 0 or more, not {pose_hz}")
    if not 1 <= jpeg_quality <= 95:
        raise ValueError(f"jpeg_quality must be 1 to 95, not {jpeg_quality}")
    if not 0 < buffer_mib < 1e6:
        raise ValueError(f"buffer_mib must be above 0, not {buffer_mib}")
