"""A recording replayed for all viewers: its states replace the server's, at the pace of its clock.

The replay sends no requests to the server, so it works with any server and any recording, seeks immediately, and has a
position in seconds. Only the current moment is in memory, however long the recording is. On request, it also places the
robots of the simulation, in puppet mode. `recorded_handshake` describes the robots where there is no simulation.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import anyio
import anyio.to_thread
import msgspec
import numpy as np
from msgspec import Struct

from urlab_client._mujoco import saved_model
from urlab_client.aio.articulation import compiled_prefixes
from urlab_client.aio.model.layout import articulation_layouts
from urlab_client.aio.model.mirror import require_local
from urlab_client.console.messages import ReplayView
from urlab_client.console.pictures import OF_SCENE, Cameras
from urlab_client.console.shared_view import SharedView
from urlab_client.enums import ControlMode, StepMode
from urlab_client.errors import URLabError
from urlab_client.protocol.codec import encode_reply
from urlab_client.protocol.messages.session import ArticulationInfo, CameraInfo, ControllerInfo, HelloOk
from urlab_client.protocol.messages.streams import StateSnapshot
from urlab_client.values.names import NameMap, lasting_names, robot_prefixes

if TYPE_CHECKING:
    from urlab_client.aio import URLabArticulation, URLabClient
    from urlab_client.integrations.record.contents import RecordedArticulation, RecordedPicture, RecordedState
    from urlab_client.integrations.record.reader import Run

_PERIOD_S = 1 / 60
_PLACED_S = 1 / 25
_PAST_STATES = 200
_ROUNDING_S = 1e-6  # of slider values in browsers; and a picture may be a nanosecond later than its state


class _Before(Struct):
    """The simulation's state and mode before a replay, to be restored."""

    mode: StepMode
    qpos: Any
    qvel: Any


class _Robot(Struct):
    """The location of a robot's joint positions: all or part of an articulation of the recording."""

    source: str
    size: int
    places: list[int] | None = None


class Replay:
    """The replay of one console, at most one at a time.

    Attributes:
        cameras: Names in the recording of the cameras of which it has pictures, by `ARTICULATION/CAMERA` or `-/CAMERA`.
        alone: Whether there is no simulation besides.
    """

    def __init__(self, client: URLabClient, view: SharedView, cameras: Cameras, *, alone: bool = False) -> None:
        self.cameras: dict[str, str] = {}
        self.alone: bool = alone
        self._client = client
        self._view = view
        self._shown_cameras = cameras
        self._run: Run | None = None
        self._robots: dict[str, _Robot] = {}
        self._start = self._seconds = 0.0
        self._at = 0.0
        self._playing = False
        self._rate = 1.0
        self._before: _Before | None = None
        self._placed_at = 0.0
        self._state: RecordedState | None = None
        self._wake = asyncio.Event()
        self._showing = asyncio.Lock()

    @property
    def view(self) -> ReplayView | None:
        """The replay's position and options, or None if nothing is replayed."""
        if self._run is None:
            return None
        return ReplayView(
            self._run.path.name,
            round(self._at, 3),
            round(self._seconds, 6),
            self._playing,
            self._rate,
            self._before is not None,
            self.alone,
            [] if self._before is not None else sorted(self.cameras),
            self._run.damage,
        )

    @property
    def open(self) -> bool:
        """Whether a recording is shown."""
        return self._run is not None

    @property
    def rate(self) -> float:
        """Seconds of the recording per second; 0 while paused."""
        return self._rate if self._playing else 0.0

    @property
    def at(self) -> float:
        """The position, seconds from the recording's start."""
        return self._at

    @property
    def _moment(self) -> float:
        """Position on the recording's clock, seconds, late enough for times that were rounded."""
        return self._start + self._at + _ROUNDING_S

    async def picture(self, camera: str) -> tuple[float, RecordedPicture] | None:
        """Return a camera's picture at the replay's position, and its time in seconds from the recording's start."""
        run, at, name = self._run, self._moment, self.cameras.get(camera)
        if run is None or name is None:
            return None
        found = await anyio.to_thread.run_sync(lambda: run.encoded_picture_at(name, at))
        return found.time - self._start, found

    async def past(self, seconds: float) -> list[StateSnapshot]:
        """Return states of the last seconds before the replay's position, evenly spaced, oldest first."""
        run, robots, start, at = self._run, self._robots, self._start, self._at
        if run is None:
            raise ValueError("no recording is replayed")

        def read() -> list[StateSnapshot]:
            found: dict[float, StateSnapshot] = {}
            for moment in np.linspace(max(0.0, at - seconds), at, _PAST_STATES).tolist():
                state = run.state_at(start + moment)
                if state is not None and state.time not in found:
                    found[state.time] = state.snapshot(state.time - start, _present(state, robots))
            return [*found.values()]

        return await anyio.to_thread.run_sync(read)

    async def begin(self, file: Path, *, placing: bool = False) -> None:
        """Show a recording from its start."""
        run, (start, end), names, prefixes, cameras = await anyio.to_thread.run_sync(lambda: _opened(file))
        if not names:
            raise ValueError(f"{file.name} holds no states of robots.")
        arts, recorded = self._client.articulations, {name: key for key, name in lasting_names(prefixes).items()}
        known = {key: recorded.get(name, "") for key, name in lasting_names(compiled_prefixes(arts)).items()}
        robots = {
            key: found
            for key, art in arts.items()
            if (found := _robot(names, key if key in names else known[key], art))
        }
        if not robots:
            there = ", ".join(self._client.articulations) or "none"
            raise ValueError(f"{file.name} is a recording of other robots than the current ones ({there}).")
        await self.end()
        if placing and not self.alone:
            await self._take_over()
        self._run, self._robots, keys = run, robots, {robot.source: key for key, robot in robots.items()}
        parts = {name: name.partition("/") for name in cameras}
        self.cameras = {
            f"{keys.get(owner, owner)}/{short}" if slash else OF_SCENE + name: name
            for name, (owner, slash, short) in parts.items()
        }
        self._start, self._seconds = start, end - start
        self._at, self._rate, self._state = 0.0, 1.0, None
        self._playing = True
        await self._show_pictures()
        self._wake.set()
        self._view.notify()

    async def change(
        self, *, at: float | None = None, playing: bool | None = None, rate: float | None = None
    ) -> ReplayView:
        """Seek, play or pause, and set the pace; None leaves a value unchanged."""
        if self._run is None:
            raise ValueError("no recording is replayed")
        if rate is not None:
            if not 0.05 <= rate <= 20:
                raise ValueError(f"the pace must be from 0.05 to 20, not {rate}")
            self._rate = rate
        if at is not None:
            self._at = self._seconds if at > self._seconds - _ROUNDING_S else max(at, 0.0)
        if playing is not None:
            if playing and at is None and self._at >= self._seconds:
                self._at = 0.0
            self._playing = playing
        await self._show()
        await self._place()
        self._wake.set()
        self._view.notify()
        return cast("ReplayView", self.view)

    async def end(self) -> None:
        """Show the server's state again, and restore the simulation's state and mode."""
        if self._run is None:
            return
        self._run, self._playing = None, False
        before, self._before = self._before, None
        await self._show_pictures()
        self._view.notify()
        data = self._client.data
        if before is not None and data is not None and data.qpos.shape == before.qpos.shape:
            data.qpos[:], data.qvel[:] = before.qpos, before.qvel
            try:
                await self._client.step(0)
            finally:
                await self._client.runtime.set_mode(before.mode)

    async def keep_playing(self) -> None:
        """Advance the replay while it plays."""
        while True:
            if not self._playing:
                self._wake.clear()
                await self._wake.wait()
                continue
            began = time.monotonic()
            await anyio.sleep(_PERIOD_S)
            if not self._playing:
                continue
            self._at = min(self._at + self._rate * (time.monotonic() - began), self._seconds)
            self._playing = self._at < self._seconds
            shown = False
            try:
                await self._show()
                shown = True
            except (URLabError, OSError) as error:
                self._view.note("error", "console", "replay", str(error))
            finally:
                self._playing = self._playing and shown
            try:
                await self._place()
            except (URLabError, ValueError) as error:
                self._before = None
                await self._show_pictures()
                self._view.note("error", "console", "replay", str(error))

    async def _show(self) -> None:
        async with self._showing:  # one at a time, each of the present moment: none comes after a later one
            run, at = self._run, self._moment
            if run is None:
                return
            state = await anyio.to_thread.run_sync(lambda: run.state_at(at))
            if state is None or self._run is not run:
                return
            self._state = state
            robots = _present(state, self._robots)
            targets = {key: values.set_points.tolist() for key, values in robots.items() if len(values.set_points)}
            self._view.show(state.snapshot(state.time - self._start, robots), targets, recorded=True)

    async def _show_pictures(self) -> None:
        """Show recorded pictures; those of the simulation while its robots are placed, too."""
        await self._shown_cameras.show(self if self._run is not None and self._before is None else None)

    # The simulation

    async def _take_over(self) -> None:
        data = require_local(self._client.data, "Placing robots")
        mode = self._client.step_mode
        await self._client.runtime.set_mode(StepMode.PUPPET)
        self._before = _Before(mode, data.qpos.copy(), data.qvel.copy())

    async def _place(self) -> None:
        """Place the simulation's robots as recorded; while they move, only so often."""
        model, data = self._client.model, self._client.data
        if self._before is None or model is None or data is None:
            return
        if self._playing and time.monotonic() - self._placed_at < _PLACED_S:
            return
        self._placed_at = time.monotonic()
        prefixes = compiled_prefixes(self._client.articulations)
        for key, layout in articulation_layouts(model, prefixes).items():
            robot = self._robots.get(key)
            values = None if robot is None or self._state is None else _values(self._state, robot)
            if values is not None and len(values.qpos) == len(layout.qpos_adr):
                data.qpos[layout.qpos_adr] = values.qpos
        data.qvel[:] = 0.0
        # In mode puppet pictures come with replies alone.
        await self._client.step(0, include_cameras=dict.fromkeys(self._shown_cameras.watched(), "latest") or False)


def recorded_handshake(run: Run) -> bytes:
    """Return the handshake of a server with the scene of a recording, whose model MuJoCo does not check.

    Raises:
        RecordingError: The recording has no model or no states, or is damaged.
    """
    import mujoco

    from urlab_client.integrations.record import RecordingError

    model, cameras = run.model(), {name: _camera(run, name) for name in run.cameras()}
    controllers = _controllers(run)
    if not run.positions():
        raise RecordingError(f"{run.path}: the recording has no states of robots.")
    robots = [
        ArticulationInfo(
            prefix=key,
            actor_id=key,
            actor_name=prefix,
            default_control_mode=ControlMode.UE_CONTROLLER if key in controllers else ControlMode.RAW,
            controller=controllers.get(key),
            camera_topics={name: info for name, info in cameras.items() if name.startswith(f"{key}/")},
        )
        for key, prefix in run.prefixes().items()
    ]
    hello = HelloOk(
        session_id="",
        urlab_version="",
        mujoco_version_int=mujoco.mj_version(),
        mujoco_version=mujoco.mj_versionString(),
        manager_present=True,
        mjb=saved_model(model),
        articulations=robots,
        global_cameras={name: info for name, info in cameras.items() if "/" not in name},
    )
    return encode_reply(hello)


def _controllers(run: Run) -> dict[str, ControllerInfo]:
    """Return the controllers of robots, as they were when the recording began; earlier releases wrote none."""
    from urlab_client.integrations.record import RecordingError

    try:
        return msgspec.json.decode(run.summary().about.get("controllers", "{}"), type=dict[str, ControllerInfo])
    except msgspec.MsgspecError as error:
        raise RecordingError(f"{run.path}: the controllers in its metadata are damaged: {error}.") from None


def _camera(run: Run, name: str) -> CameraInfo:
    """Describe a camera by its first picture; nobody publishes others."""
    first = run.encoded_picture_at(name, run.time_range()[0])
    height, width = first.pixels().shape[:2]
    return CameraInfo(mode=first.mode, resolution=(width, height), fovy=45.0, zmq_endpoint="", zmq_topic=name)


def _opened(file: Path) -> tuple[Run, tuple[float, float], dict[str, list[str]], NameMap[str], list[str]]:
    from urlab_client.integrations.record import read_run

    run = read_run(file)
    prefixes = robot_prefixes((key, "", prefix) for key, prefix in run.prefixes().items())
    return run, run.time_range(), run.positions(), prefixes, run.cameras()


def _robot(names: Mapping[str, list[str]], key: str, art: URLabArticulation) -> _Robot | None:
    """Return where a robot is in a recording, of which the names of joint positions are given; None if it is not.

    Args:
        names: Names of joint positions by articulation of the recording.
        key: Key of the robot there.
        art: The robot.
    """
    size = len(art.qpos_array)
    if key in names:
        return _Robot(key, size) if len(names[key]) == size else None
    together = names.get("joints")  # as a server saves them, by compiled joints
    places: list[int] = []
    for joint in sorted(art.joints.values(), key=lambda one: one.qpos_local_offset):
        name = f"{art.compiled_prefix}_{joint.name}"
        own = [i for i, given in enumerate(together or ()) if given == name or given.rpartition(".")[0] == name]
        if not own:
            return None
        places += own
    return _Robot("joints", size, places) if len(places) == size else None


def _present(state: RecordedState, robots: Mapping[str, _Robot]) -> dict[str, RecordedArticulation]:
    return {key: found for key, robot in robots.items() if (found := _values(state, robot))}


def _values(state: RecordedState, robot: _Robot) -> RecordedArticulation | None:
    """Return a robot's values, None if it is not in the scene then, or another of its name is."""
    found = state.articulations.get(robot.source)
    if found is not None and robot.places is not None:
        # Of velocities it is not known where they are among those of all joints.
        found = replace(found, qpos=found.qpos[robot.places], qvel=np.zeros(0))
    return found if found is not None and len(found.qpos) == robot.size else None
