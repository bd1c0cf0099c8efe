"""Recordings of the console: MCAP files in one folder, made by `record()`, listed, converted, taken in and removed."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import tempfile
from collections.abc import AsyncGenerator, AsyncIterator
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import anyio
import anyio.to_thread
from msgspec import Struct

from urlab_client._installation import MissingExtra, need
from urlab_client.console.file_jobs import Progress, run_job, write_chunks
from urlab_client.console.messages import Conversion, RunningRecording
from urlab_client.errors import URLabError

if TYPE_CHECKING:
    from urlab_client.aio import URLabClient
    from urlab_client.integrations._feed.messages import EpisodeOutcome
    from urlab_client.integrations.record.recorder import AsyncRecorder

KINDS = ("csv", "mp4", "npz")
"""What a recording is converted to for download, besides what it is."""

_NAME = re.compile(r"[\w][\w .()+-]{0,100}\.(mcap|json)", re.ASCII)
_LARGEST_FILE = 4 << 30

_CAMERA_HZ = 30.0


class RecordingView(Struct):
    """One recording of the folder; `at` is Unix time in seconds."""

    name: str
    bytes: int
    at: float


class RecordingContents(RecordingView):
    """A recording and what is in it: length in seconds, number of states, robots, cameras, and why it is incomplete.

    `lost` counts states and pictures that came too fast to be written. `unavailable` holds the formats that the
    recording cannot be converted to here, each with what is missing.
    """

    seconds: float
    states: int
    robots: list[str]
    cameras: list[str]
    damage: str
    lost: int
    unavailable: dict[str, str]


class Recordings:
    """The recordings of one console."""

    def __init__(self, client: URLabClient, folder: Path) -> None:
        self.folder = folder
        self.conversions: list[Conversion] = []
        self._client = client
        self._recorder: AsyncRecorder | None = None
        self._open = contextlib.AsyncExitStack()
        self._changing = anyio.Lock()
        self._described: dict[str, tuple[float, RecordingContents]] = {}

    @property
    def running(self) -> RunningRecording | None:
        """The running recording, or None."""
        if self._recorder is None:
            return None
        stats = self._recorder.stats
        return RunningRecording(
            self._recorder.path.name,
            round(stats.duration_s, 1),
            stats.states,
            stats.frames,
            stats.file_bytes,
            self._recorder.failed,
        )

    async def start(self, *, cameras: bool) -> str:
        """Start a recording and return its file's name."""
        async with self._changing:
            if self._recorder is not None:
                raise ValueError("a recording runs already: stop it first")
            from urlab_client.integrations.record import record

            if not self._client.manager_present:
                raise URLabError("There is nothing to record.", hint="Begin play first.")
            self.folder.mkdir(parents=True, exist_ok=True)
            now = f"{datetime.now().astimezone():%Y-%m-%d_%H.%M.%S}"
            names = (f"{now}.mcap", *(f"{now}-{number}.mcap" for number in range(2, 100)))  # several in a second
            path = next(one for one in (self.folder / name for name in names) if not one.exists())
            recorder = record(
                self._client,
                path,
                cameras="all" if cameras else (),
                camera_hz=_CAMERA_HZ,
                pose_hz=0.0 if self._client.model is None else 50.0,
            )
            self._recorder = await self._open.enter_async_context(recorder)
            return path.name

    async def mark(self, outcome: EpisodeOutcome) -> None:
        """Record the outcome of the current episode."""
        if self._recorder is None:
            raise ValueError("no recording runs, so the outcome of an episode cannot be recorded: start one first")
        await self._recorder.mark(outcome)

    async def stop(self) -> RecordingContents:
        """End the recording and describe it."""
        async with self._changing:
            recorder, self._recorder = self._recorder, None
            if recorder is None:
                raise ValueError("no recording runs")
            await self._open.aclose()
        return await self.describe(recorder.path.name)

    async def end(self) -> None:
        """End a running recording, so that its file is complete."""
        async with self._changing:
            self._recorder = None
            with contextlib.suppress(URLabError):  # the recorder has logged it
                await self._open.aclose()

    def list(self) -> list[RecordingView]:
        """Return the recordings of the folder, newest first."""
        if not self.folder.is_dir():
            return []
        running = self._recorder.path.name if self._recorder is not None else ""
        found = [file for file in self.folder.iterdir() if _NAME.fullmatch(file.name) and file.name != running]
        views = [RecordingView(file.name, file.stat().st_size, file.stat().st_mtime) for file in found]
        return sorted(views, key=lambda view: view.at, reverse=True)

    def path(self, name: str) -> Path:
        """Return the file of a recording."""
        file = self.folder / name
        if not _NAME.fullmatch(name) or not file.is_file():
            raise KeyError(f"no recording is called {name!r}")
        return file

    async def describe(self, name: str) -> RecordingContents:
        """Return name, size, length in seconds, robots, cameras, and why the file is incomplete, if it is.

        `unavailable` holds the formats that it cannot be converted to here, each with what is missing.
        """
        file = self.path(name)
        changed = file.stat().st_mtime
        known = self._described.get(name)
        if known is None or known[0] != changed:
            known = self._described[name] = changed, await anyio.to_thread.run_sync(_described, file)
        return known[1]

    @contextlib.asynccontextmanager
    async def converted(self, name: str, kind: str, camera: str = "") -> AsyncGenerator[Path]:
        """Yield a recording as a file of another format, which is deleted afterwards."""
        file = self.path(name)
        if kind not in KINDS:
            raise ValueError(f"a recording is converted to {', '.join(KINDS)}, not {kind!r}")
        # Beside the recordings: where the system keeps temporary files there may be no room for those of a night.
        beside = self.folder if os.access(self.folder, os.W_OK) else None
        with tempfile.TemporaryDirectory(prefix=".urlab-", dir=beside, ignore_cleanup_errors=True) as folder:
            target = Path(folder) / f"{file.stem}.{kind}"
            size, conversion = max(1, file.stat().st_size), Conversion(name, kind, camera)

            def progress(count: int) -> None:
                conversion.share = round(count / size, 2)

            self.conversions.append(conversion)
            try:
                await run_job(lambda told: _convert(file, target, kind, camera, told), progress)
            finally:
                self.conversions.remove(conversion)
            yield target

    async def take_in(self, name: str, chunks: AsyncIterator[bytes]) -> RecordingContents:
        """Add a recording that was made elsewhere, and describe it."""
        if not _NAME.fullmatch(name):
            raise ValueError(f"{name!r} is not a valid name of a recording: it must end in .mcap or .json")
        self.folder.mkdir(parents=True, exist_ok=True)
        target = self.folder / name
        if target.exists():
            raise ValueError(f"there is a recording {name!r} already")
        partial = target.with_name(f".{name}.{secrets.token_hex(4)}.part")  # concurrent uploads may have the same name
        try:
            await write_chunks(partial, chunks, _LARGEST_FILE, "a recording")
            await run_job(lambda told: _described(partial, told))
            if target.exists():  # by now
                raise ValueError(f"there is a recording {name!r} already")
            partial.rename(target)
        finally:
            partial.unlink(missing_ok=True)
        return await self.describe(name)

    def remove(self, name: str) -> None:
        """Delete a recording."""
        if self._recorder is not None and self._recorder.path.name == name:
            raise ValueError(f"{name} is being recorded: stop that first")
        self.path(name).unlink()
        self._described.pop(name, None)


def _described(file: Path, progress: Progress | None = None) -> RecordingContents:
    from urlab_client.integrations.record import read_run

    summary = read_run(file).summary(progress)
    cameras = [name.removeprefix("/camera/") for name in summary.topics if name.startswith("/camera/")]
    return RecordingContents(
        name=file.name,
        bytes=file.stat().st_size,
        at=file.stat().st_mtime,
        seconds=round(summary.duration_s, 3),
        states=max((topic.messages for name, topic in summary.topics.items() if name.startswith("/state/")), default=0),
        robots=[name.removeprefix("/state/") for name in summary.topics if name.startswith("/state/")],
        cameras=[name for name in cameras if not name.endswith("/calibration")],
        damage=summary.damage,
        lost=summary.dropped_states + summary.dropped_frames,
        unavailable=_unavailable(),
    )


def _unavailable() -> dict[str, str]:
    try:
        need("av", extra="video")
    except MissingExtra as error:
        return {"mp4": str(error)}
    return {}


def _convert(file: Path, target: Path, kind: str, camera: str, progress: Progress) -> None:
    from urlab_client.integrations.record import export, read_run

    run = read_run(file)
    try:
        if kind == "csv":
            export.write_csv(run, target, progress)
        elif kind == "npz":
            export.write_npz(run, target, progress=progress)
        else:
            export.write_mp4(run, target, camera, progress)
    except MissingExtra as error:
        raise URLabError(str(error)) from None
