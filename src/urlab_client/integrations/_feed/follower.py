"""Follows a client: passes on each state and picture that it receives, by replies or by streams."""

from __future__ import annotations

import asyncio
import copy
import logging
from collections.abc import Awaitable, Callable, Mapping, Sequence
from functools import partial
from typing import Literal, TypeVar

import numpy as np
from msgspec import Struct

from urlab_client.aio.articulation import compiled_prefixes
from urlab_client.aio.background import background_task
from urlab_client.aio.cameras import URLabCameraView
from urlab_client.aio.client import URLabClient
from urlab_client.aio.client_types import ClientObserver
from urlab_client.aio.model.mirror import require_local
from urlab_client.enums import StepMode
from urlab_client.errors import ClientClosed, StreamOverflow, URLabError
from urlab_client.integrations._feed.messages import Transition
from urlab_client.integrations._feed.samples import CameraPicture, Schedule, State
from urlab_client.integrations._feed.scene import CameraLayout, FollowedScene
from urlab_client.integrations._variation import wire_variation
from urlab_client.protocol.messages.session import ResetOk, StateReply, StepOk
from urlab_client.protocol.messages.streams import StateSnapshot
from urlab_client.values.names import lasting_names

log = logging.getLogger("urlab_client.feed")

_NS = 1_000_000_000

S = TypeVar("S", bound=Struct)


class Follower(ClientObserver):
    """Passes on a client's states and pictures: from replies in `direct` and `puppet` mode, from streams in `live`
    mode.

    Args:
        client: The client, after `discover()`.
        name: Name of the purpose in errors and logs.
        cameras: Names of cameras, or `all`.
        camera_hz: Maximum number of pictures per second of simulation time.
        needs_model: Hint for the error if there is no local model; None if none is needed.
        buffer: Number of published states that may wait so that none is missed; 0 for only the newest.

    Attributes:
        note: Called by an environment over this client with what led to the state before, if anybody wants to know.
    """

    def __init__(
        self,
        client: URLabClient,
        *,
        name: str,
        cameras: Sequence[str] | Literal["all"],
        camera_hz: float,
        needs_model: str | None,
        buffer: int,
    ) -> None:
        if isinstance(cameras, str) and cameras != "all":
            raise ValueError(f"cameras must be a sequence of names or 'all', not {cameras!r}")
        self._client = client
        self._name = name
        self._wanted_cameras = cameras if isinstance(cameras, str) else tuple(cameras)
        self._camera_ns = round(_NS / camera_hz)
        self._pictures = Schedule(self._camera_ns)
        self._needs_model = needs_model
        self._buffer = buffer
        self._put: Callable[[State | CameraPicture], None] | None = None
        self._room: Callable[[], Awaitable[None]] | None = None
        self._lost: Callable[[int], None] | None = None
        self._failed: Callable[[URLabError], None] = lambda _: None
        self.note: Callable[[Transition], None] | None = None
        self._scene: FollowedScene | None = None
        self._described: object = None
        self._due_at: int | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._camera_tasks: list[asyncio.Task[None]] = []
        self._live = False

    def check(self) -> FollowedScene:
        if not self._client.urlab_version:
            raise URLabError(f"{self._name}: the scene is not known yet.", hint="Call discover() first, during play.")
        if self._needs_model is not None:
            require_local(self._client.model, f"{self._name}: computing poses", otherwise=self._needs_model)
        return self._current()

    @property
    def cameras(self) -> list[str]:
        """Names of the requested cameras that exist in the scene; empty before `check`."""
        return [] if self._scene is None else [camera.name for camera in self._scene.cameras.values()]

    def start(
        self,
        put: Callable[[State | CameraPicture], None],
        *,
        room: Callable[[], Awaitable[None]] | None = None,
        lost: Callable[[int], None] | None = None,
        failed: Callable[[URLabError], None],
        note: Callable[[Transition], None] | None = None,
    ) -> None:
        """Start passing on items.

        Args:
            put: Called with each item on the event loop; must be fast.
            room: Returns when there is space for the items of another step, or after a limit.
            lost: Called with the number of pictures that were due but missing in a step.
            failed: Called with an unexpected error, after which states or pictures are missing.
            note: See `note` of the class.
        """
        self._put, self._room, self._lost, self._failed, self.note = put, room, lost, failed, note
        self._client.add_observer(self)
        if self._client.step_mode is StepMode.LIVE:
            self._listen()

    def detach(self) -> None:
        """Stop. Idempotent."""
        self.forget()
        self._ignore()

    def forget(self) -> None:
        """Stop if the client's loop has already ended. Idempotent."""
        self._client.remove_observer(self)
        self._put = self.note = None

    async def ended(self) -> None:
        await asyncio.gather(*self._tasks, return_exceptions=True)

    # Called by the client

    def on_state(self, state: StateReply | StateSnapshot) -> None:
        live = self._client.step_mode is StepMode.LIVE
        if live is not self._live:
            if live:
                self._listen()
            else:
                self._ignore()
        if not live:
            self._pass_on(_detached(state))

    def step_cameras(self, n_steps: int) -> Mapping[str, str]:
        """See the base class; requests the cameras whose next picture is due."""
        client = self._client
        if client.step_mode is StepMode.LIVE or not self._wanted_cameras:
            return {}
        timestep = 0.0 if client.model is None else client.model.opt.timestep
        then = round((client.sim_time + max(n_steps, client.step_mode is not StepMode.PUPPET) * timestep) * _NS)
        # The period counts as used only after the step: it may be refused, or never answered.
        self._due_at = then if self._pictures.is_due(then) else None
        if self._due_at is None:
            return {}
        return {camera.name: "sync" for camera in self._current().cameras.values()}

    async def ready(self) -> None:
        if self._put is not None and self._room is not None:
            await self._room()

    # Inside

    def _current(self) -> FollowedScene:
        """Return the scene, described again after another handshake."""
        described = self._client.articulations  # a new map with each handshake
        if self._scene is None or described is not self._described:
            self._scene = FollowedScene.of(self._client, self._views())
            self._described = described
            if self._live:
                self._follow_cameras(self._scene)
        return self._scene

    def _camera(self, name: str) -> URLabCameraView | None:
        try:
            return self._client.camera(name)
        except KeyError:
            return None

    def _views(self) -> list[tuple[str, URLabCameraView]]:
        """Return the requested cameras; raises `KeyError` for an unknown one, unless an earlier scene had it."""
        client, wanted = self._client, set[int]()
        called = lasting_names(compiled_prefixes(client.articulations))
        arts = client.articulations.items()
        own = {f"{called[key]}/{name}": view for key, art in arts for name, view in art.cameras.items()}
        every = [*own.items(), *client.global_cameras.items()]
        if self._wanted_cameras == "all":
            return every
        for name in self._wanted_cameras:
            try:
                wanted.add(id(client.camera(name)))
            except KeyError as error:
                if self._scene is None:
                    raise
                log.warning("%s: the new scene lacks a camera: %s", self._name, error)
        return [(name, view) for name, view in every if id(view) in wanted]

    def _pass_on(self, reply: StateReply | StateSnapshot) -> None:
        put = self._put
        if put is None:
            return
        client, scene = self._client, self._current()
        clock, wall = reply.sim_time, reply.wall_time
        nanoseconds = round(reply.time * _NS) if clock is None else clock.sec * _NS + clock.nsec
        wall_ns = client.recv_wall_time_ns if wall is None else wall.sec * _NS + wall.nsec
        called = scene.called
        set_points = {called.get(key, key): art.ctrl_array.tolist() for key, art in client.articulations.items()}
        if called:
            states, reply = reply.per_articulation, copy.copy(reply)
            reply.per_articulation = {called.get(key, key): state for key, state in states.items()}
        restarts = isinstance(reply, ResetOk)
        if restarts:
            self._pictures = Schedule(self._camera_ns)  # one of the start is due
        seed = client.reset_seed if restarts else None
        varied = wire_variation(client) if restarts else None
        # A reset of somebody else has another seed, or none.
        draws = varied.draws if varied is not None and varied.draws is not None and varied.draws.seed == seed else None
        put(State(scene, reply, set_points, nanoseconds, restarts, wall_ns, not self._live, seed, draws))
        if isinstance(reply, StepOk) and self._due_at is not None:
            self._pictures.done(self._due_at)
            self._due_at = None
            missing = len(scene.cameras)
            for name, frame in (reply.cameras or {}).items():
                camera = scene.cameras.get(id(self._camera(name)))
                if camera is not None:
                    missing -= 1
                    put(CameraPicture(camera, frame, nanoseconds, wall_ns, waits=True))
            if missing and self._lost is not None:
                self._lost(missing)

    def _listen(self) -> None:
        """Follow the streams, because live mode has no state in replies."""
        scene = self._current()
        self._live = True
        self._begin(self._follow_states)
        self._follow_cameras(scene)

    def _follow_cameras(self, scene: FollowedScene) -> None:
        """Follow this scene's cameras instead of the previous ones."""
        for task in self._camera_tasks:
            task.cancel()
        self._camera_tasks = [self._begin(partial(self._follow_camera, camera)) for camera in scene.cameras.values()]

    def _begin(self, follow: Callable[[], Awaitable[None]]) -> asyncio.Task[None]:
        task = background_task("urlab-feed", self._following(follow), failed=self._failed)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    async def _following(self, follow: Callable[[], Awaitable[None]]) -> None:
        try:
            await follow()
        except URLabError as error:
            log.warning("%s: a stream was not read to its end: %s", self._name, error)

    def _ignore(self) -> None:
        self._live = False
        for task in self._tasks:
            task.cancel()

    async def _follow_states(self) -> None:
        last: float | None = None
        policy = "all" if self._buffer else "latest"
        async with self._client.state_stream(policy, buffer=max(self._buffer, 1), timeout=None) as states:
            while True:
                try:
                    snapshot = await states.receive(timeout=None)
                except StreamOverflow as lost:
                    log.warning("%s: %s", self._name, lost)
                    continue
                except ClientClosed:
                    return
                # While paused, every tick repeats the state; and a restarted server's state arrives before its
                # handshake.
                fresh = self._client.step_mode is StepMode.LIVE and snapshot.time != last
                if fresh and self._client.matches(snapshot):
                    last = snapshot.time
                    self._pass_on(snapshot)

    async def _follow_camera(self, camera: CameraLayout) -> None:
        schedule = Schedule(self._camera_ns)
        async with self._client.camera(camera.name).frames("latest", timeout=None) as frames:
            while True:
                try:
                    sample = await frames.receive(timeout=None)
                except ClientClosed:
                    return
                nanoseconds = round((self._client.sim_time if sample.sim_time is None else sample.sim_time) * _NS)
                if self._put is not None and schedule.due(nanoseconds):
                    self._put(CameraPicture(camera, sample.pixels, nanoseconds, sample.recv_wall_time_ns))


def _detached(reply: StateReply | StateSnapshot) -> StateReply | StateSnapshot:
    """Return a copy of a state: the caller of `step()` may write to the original arrays."""
    own = copy.copy(reply)
    own.per_articulation = {key: _with_own_arrays(state) for key, state in reply.per_articulation.items()}
    if isinstance(own, (StepOk, StateSnapshot)) and own.entities is not None:
        own.entities = {name: _with_own_arrays(state) for name, state in own.entities.items()}
    return own


def _with_own_arrays(struct: S) -> S:
    own = copy.copy(struct)
    for name in own.__struct_fields__:
        value = getattr(own, name)
        if isinstance(value, np.ndarray):
            setattr(own, name, value.copy())
    return own
