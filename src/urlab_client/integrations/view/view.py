"""A view of a client's simulation: a thread that shows the newest state and skips the others; MuJoCo's window."""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal

import anyio.to_thread
import numpy as np
from msgspec import Struct

from urlab_client.aio.background import background_thread
from urlab_client.aio.client import URLabClient as AsyncClient
from urlab_client.errors import URLabError
from urlab_client.integrations._feed.follower import Follower
from urlab_client.integrations._feed.samples import CameraPicture, SampleClock, State
from urlab_client.integrations._feed.scene import FollowedScene, Lens, RecordedCamera, Simulation, camera_id
from urlab_client.integrations._flavours import AsyncBlock, Block, BlockingBlock, flavoured, in_flavour, opened
from urlab_client.protocol.base import Floats
from urlab_client.protocol.messages.session import EntityState, StepOk
from urlab_client.protocol.messages.streams import StateSnapshot
from urlab_client.sync.client import URLabClient
from urlab_client.values.plain import Serializable

if TYPE_CHECKING:
    import mujoco

    from urlab_client.integrations.record.contents import RecordedState
    from urlab_client.integrations.record.reader import Run

log: logging.Logger = logging.getLogger("urlab_client.view")

_NS = 1_000_000_000
_ROUNDING_S = 1e-6  # a picture may be a nanosecond later than its state
_PAUSE_S = 1.0  # at the end of a recording, before it begins again
_FOVY = 45.0  # MuJoCo's, for recorded cameras that the model lacks


class ViewStats(Serializable, Struct, kw_only=True, frozen=True):
    """Counters of a view.

    Attributes:
        states: States shown.
        frames: Pictures shown.
        dropped_states: States that a newer one replaced before they could be shown.
        dropped_frames: Pictures that a newer one replaced before they could be shown.
    """

    states: int
    frames: int
    dropped_states: int
    dropped_frames: int


@dataclass(frozen=True, slots=True)
class Moment:
    """A state to show.

    Attributes:
        ns: Simulation time, nanoseconds, which continues across resets.
        wall_ns: UTC, nanoseconds.
        step: Step counter of the session.
        scene: Names of the scene.
        simulation: Poses and contacts.
        episode: Number of preceding resets.
        contacts: Whether contacts were requested.
        state: State from the server; None for the first one, which is the client's own state.
    """

    ns: int
    wall_ns: int
    step: int
    scene: FollowedScene
    simulation: Simulation
    episode: int
    contacts: bool
    state: State | None


class ViewBackend(ABC):
    """Display of a view. Used only by the view's thread, except `open` and `address`."""

    @property
    def address(self) -> str:
        """Address of the served view; empty if nothing is served."""
        return ""

    @abstractmethod
    def open(self) -> None:
        """Open the display, or raise `OSError` or `URLabError`."""

    @abstractmethod
    def use(self, simulation: Simulation, scene: FollowedScene) -> None:
        """Show this scene from now on."""

    @abstractmethod
    def show(self, moment: Moment) -> None:
        """Show a state."""

    def show_picture(self, picture: CameraPicture, ns: int) -> None:  # noqa: B027  # a window shows none
        """Show a picture taken at `ns` on the view's clock."""

    def idle(self) -> bool:
        """Process events without a new state; return whether the display is still open."""
        return True

    @abstractmethod
    def close(self) -> None:
        """Close the display."""


@dataclass(frozen=True, slots=True)
class _Start:
    """The client's state when the view starts."""

    scene: FollowedScene
    qpos: Floats
    qvel: Floats
    nanoseconds: int
    step: int


class Viewing(Block):
    """A view of either flavour.

    Raises:
        ValueError: An option is out of range.
    """

    def __init__(
        self,
        client: AsyncClient,
        backend: ViewBackend,
        name: str,
        *,
        cameras: Sequence[str] | Literal["all"],
        camera_hz: float,
        max_hz: float,
        contacts: bool,
    ) -> None:
        for key, value in (("max_hz", max_hz), ("camera_hz", camera_hz)):
            if not 0 < value <= 1000:
                raise ValueError(f"{key} must be above 0 and at most 1000, not {value}")
        self._client = client
        self._backend = backend
        self._name = name
        self._period = 1 / max_hz
        self._contacts = contacts
        self._follower = Follower(client, name=name, cameras=cameras, camera_hz=camera_hz, needs_model="", buffer=0)
        self._states: deque[State | _Start] = deque(maxlen=1)
        self._pictures: dict[int, CameraPicture] = {}
        self._counts = {"states": 0, "frames": 0, "dropped_states": 0, "dropped_frames": 0}
        self._clock = SampleClock()
        self._simulation: Simulation | None = None
        self._scene: FollowedScene | None = None
        self._shown: int = 0
        self._stop = threading.Event()
        self._gone = threading.Event()
        self._thread = background_thread("urlab-view", self._run, failed=self._fail)
        self._error: Exception | None = None
        self._opened = False

    @property
    def stats(self) -> ViewStats:
        """Current counters. Thread-safe."""
        return ViewStats(**self._counts)

    @property
    def address(self) -> str:
        """Address of the served view; empty before the block, and if nothing is served."""
        return self._backend.address

    @property
    def closed(self) -> bool:
        """Whether the view has ended: the window was closed, displaying failed, or the block has ended."""
        return self._gone.is_set()

    @property
    def error(self) -> Exception | None:
        """The error with which displaying failed; the simulation continues without the view."""
        return self._error

    async def _begin(self) -> None:
        if self._opened:
            raise URLabError("A view opens once.", hint="Call the function that made it again.")
        scene = self._follower.check()
        self._opened = True
        await opened(self._backend.open, lambda _: self._backend.close())
        if not self._client.config.read_only:  # a read-only client has no state until the first one is published
            self._states.append(self._start(scene))
        self._thread.start()
        self._follower.start(self._put, failed=self._fail)

    async def _end(self, error: BaseException | None) -> None:
        self._follower.detach()
        self._stop.set()
        await self._follower.ended()
        await anyio.to_thread.run_sync(self._thread.join, abandon_on_cancel=True)

    def _start(self, scene: FollowedScene) -> _Start:
        client = self._client
        with client._data_lock:  # noqa: SLF001  # pyright: ignore[reportPrivateUsage]  # public by the reference
            data = client.data
            if data is None:
                return _Start(scene, np.zeros(0), np.zeros(0), round(client.sim_time * _NS), client.step_count)
            return _Start(scene, data.qpos.copy(), data.qvel.copy(), round(data.time * _NS), client.step_count)

    def _finish(self) -> None:
        self._follower.forget()
        self._stop.set()
        self._thread.join()

    # On the client's loop

    def _put(self, item: State | CameraPicture) -> None:
        if self._gone.is_set():
            return
        if isinstance(item, State):
            if self._states:
                self._counts["dropped_states"] += 1
            self._states.append(item)  # replaces the waiting one
        else:
            if id(item.camera.view) in self._pictures:
                self._counts["dropped_frames"] += 1
            self._pictures[id(item.camera.view)] = item

    # In the thread

    def _run(self) -> None:
        pause = 0.0
        try:
            # At intervals instead of at each state, which would take the interpreter lock from the stepping thread.
            while not self._stop.wait(pause):
                started = time.monotonic()
                self._drain()
                if not self._backend.idle():
                    break
                took = time.monotonic() - started
                pause = max(self._period - took, took)  # at most half of a processor's time
            else:
                self._drain()
        except Exception as error:  # noqa: BLE001  # whatever it was, the simulation goes on
            self._error = error
            log.warning("%s: the view ended: %s", self._name, error)
        finally:
            try:
                self._backend.close()
            except Exception as error:  # noqa: BLE001
                self._error = self._error or error
                log.warning("%s: closing the view failed: %s", self._name, error)
        self._gone.set()

    def _fail(self, error: URLabError) -> None:
        self._error = error
        self._stop.set()
        self._gone.set()

    def _drain(self) -> None:
        if self._states:
            self._show(self._states.popleft())
        while self._pictures:
            _, picture = self._pictures.popitem()
            ns = self._shown if picture.nanoseconds is None else max(0, self._clock.offset + picture.nanoseconds)
            self._backend.show_picture(picture, ns)
            self._counts["frames"] += 1

    def _show(self, item: State | _Start) -> None:
        simulation = self._simulation
        if simulation is None or item.scene is not self._scene:
            if item.scene.model is None:
                return  # the next scene has no model; the last one stays
            simulation = Simulation(item.scene, item.scene.model)
            self._simulation, self._scene = simulation, item.scene
            self._backend.use(simulation, item.scene)
        state = item if isinstance(item, State) else None
        contacts = self._contacts
        if isinstance(item, State):
            reply = item.reply
            entities: dict[str, EntityState] = {}
            if isinstance(reply, StepOk | StateSnapshot):
                entities = dict(reply.entities or {})
            simulation.take(reply.per_articulation, entities, forces=contacts)
            step, wall_ns, restarts = reply.step, item.wall_ns, item.restarts
        else:
            simulation.start_from(item.qpos, item.qvel, forces=contacts)
            step, wall_ns, restarts = item.step, time.time_ns(), False
        self._shown = self._clock.advance(item.nanoseconds, restarts)
        self._backend.show(
            Moment(self._shown, wall_ns, step, item.scene, simulation, self._clock.episode, contacts, state)
        )
        self._counts["states"] += 1


def show_recording(
    run: Run,
    backend: ViewBackend,
    *,
    max_hz: float = 30.0,
    cameras: Sequence[str] | None = None,
    seconds: float | None = None,
    paced: bool = True,
    opened: Callable[[], None] = lambda: None,
    over: Callable[[], bool] = lambda: False,
) -> ViewStats:
    """Show a recording with the model that is in it, which MuJoCo does not check, and close the display.

    It is shown at the pace of its clock and again from its start until `over()`, or else at once, and once. `max_hz`
    and `seconds` are those of its clock; `opened` is called when the display is open.

    Raises:
        OSError: The file cannot be read, or the display not opened.
        KeyError: The file has no pictures of a camera.
        URLabError: The recording has no model, or is damaged; or the display cannot be opened.
    """
    model, prefixes, (start, end) = run.model(), run.prefixes(), run.time_range()
    end = end if seconds is None else min(end, start + seconds)
    firsts = {name: run.encoded_picture_at(name, start) for name in (run.cameras() if cameras is None else cameras)}
    lenses: list[tuple[str, Lens]] = []
    for name, first in firsts.items():
        height, width = first.pixels().shape[:2]
        number = camera_id(model, prefixes, name)
        fovy = float(model.cam_fovy[number]) if number >= 0 else _FOVY
        lenses.append((name, RecordedCamera(first.mode, (width, height), fovy)))
    scene = FollowedScene.recorded(model, prefixes, lenses)
    simulation, clock, counts = Simulation(scene, model), SampleClock(), {"states": 0, "frames": 0}
    times: dict[str, float] = {}  # of what is shown
    backend.open()
    try:
        backend.use(simulation, scene)
        opened()
        for moment in _moments(start, end, 1 / max_hz, paced=paced, stays=bool(backend.address)):
            if over() or not backend.idle():
                break
            state = run.state_at(moment + _ROUNDING_S)
            if state is not None and times.get("") != state.time:
                times[""] = state.time
                backend.show(_moment(state, scene, simulation, clock))
                counts["states"] += 1
            for camera in scene.cameras.values():
                picture = run.encoded_picture_at(camera.name, moment + _ROUNDING_S)
                if times.get(camera.name) != picture.time <= moment + _ROUNDING_S:
                    times[camera.name], ns = picture.time, clock.last or 0
                    wall_ns = 0 if state is None else state.wall_ns
                    backend.show_picture(CameraPicture(camera, picture.pixels(), ns, wall_ns), ns)
                    counts["frames"] += 1
    finally:
        backend.close()
    return ViewStats(**counts, dropped_states=0, dropped_frames=0)


def _moments(start: float, end: float, period: float, *, paced: bool, stays: bool) -> Iterator[float]:
    """Yield the times to show, seconds on the recording's clock; at its pace, the end stays for a second."""
    if not paced:
        yield from np.append(np.arange(start, end, period), end).tolist()
    while stays and not paced:  # for those who come later
        time.sleep(_PAUSE_S / 4)
        yield end
    began = time.monotonic()
    while paced:
        yield min(start + (time.monotonic() - began) % (end - start + _PAUSE_S), end)
        time.sleep(min(period, _PAUSE_S))


def _moment(state: RecordedState, scene: FollowedScene, simulation: Simulation, clock: SampleClock) -> Moment:
    """Return a recorded state as one to show, without robots that have other joints than the model's."""
    robots = {
        key: values
        for key, values in state.articulations.items()
        if key in scene.layouts and len(values.qpos) == len(scene.layouts[key].qpos_adr)
    }
    reply = state.snapshot(state.sim_time, robots)
    simulation.take(reply.per_articulation, reply.entities or {}, forces=True)
    set_points = {key: values.set_points.tolist() for key, values in robots.items()}
    ns = clock.advance(round(state.time * _NS), restarts=False)
    shown = State(scene, reply, set_points, ns, False, state.wall_ns, False)
    return Moment(ns, state.wall_ns, state.step, scene, simulation, state.episode, True, shown)


class AsyncView(Viewing, AsyncBlock):
    """A view that is open for the duration of an `async with` block. Created by `rerun_view` and similar functions."""


class View(Viewing, BlockingBlock):
    """A view that is open for the duration of a `with` block. Created by `rerun_view` and similar functions."""


def missing_for_window() -> str:
    """Return why no window can be opened here; empty if it can."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return "there is no display: neither DISPLAY nor WAYLAND_DISPLAY is set"
    if sys.platform == "darwin" and not os.environ.get("MJPYTHON_BIN"):
        return "on macOS windows belong to the main thread: run with mjpython, which comes with MuJoCo"
    return ""


class WindowBackend(ViewBackend):
    """Shows states in `mujoco.viewer`'s window, which is reopened for another scene."""

    def __init__(self) -> None:
        self._viewer: Any = None
        self._data: mujoco.MjData | None = None

    def open(self) -> None:
        missing = missing_for_window()
        if missing:
            raise URLabError(
                f"window_view: {missing}.", hint="Use rerun_view, foxglove_view or `urlab console`, or set a display."
            )

    def use(self, simulation: Simulation, scene: FollowedScene) -> None:
        import mujoco

        viewer: Any = import_module("mujoco.viewer")
        self.close()
        self._data = mujoco.MjData(simulation.model)
        self._viewer = viewer.launch_passive(simulation.model, self._data, show_left_ui=False, show_right_ui=False)

    def show(self, moment: Moment) -> None:
        import mujoco

        if self._data is None or not self._viewer.is_running():
            return
        with self._viewer.lock():
            mujoco.mj_copyData(self._data, moment.simulation.model, moment.simulation.data)
            self._data.time = moment.ns / 1e9
        self._viewer.sync()

    def idle(self) -> bool:
        return self._viewer is None or bool(self._viewer.is_running())

    def close(self) -> None:
        viewer, self._viewer = self._viewer, None
        if viewer is not None:
            viewer.close()


@flavoured(AsyncView, View)
def window_view(client: AsyncClient | URLabClient, *, max_hz: float = 60.0) -> AsyncView | View:
    """Show a client's simulation in MuJoCo's own window; a context manager of the client's flavour.

    The window does not control the simulation. When it is closed, `closed` is true and the client continues.

    Args:
        client: A client after `discover()`, during play, with its local model.
        max_hz: Maximum number of states shown per second of wall time.

    Raises:
        ValueError: `max_hz` is out of range.

    Entering the block raises `URLabError` if no window can be opened; the message says what is missing.
    """
    return in_flavour(
        client, AsyncView, View, WindowBackend(), "window_view", cameras=(), camera_hz=1.0, max_hz=max_hz, contacts=True
    )
