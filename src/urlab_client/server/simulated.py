"""`SimulatedServer`: a server that speaks the plugin's protocol, with real MuJoCo and without Unreal."""

from __future__ import annotations

import inspect
import os
import threading
import warnings
import weakref
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, Final, Literal, Self, get_args

import anyio
import anyio.to_thread
import numpy as np
from numpy.typing import NDArray

from urlab_client.enums import CameraMode, StepMode, StepModeName
from urlab_client.protocol.base import DialectName
from urlab_client.randomise.declaration import Randomisation
from urlab_client.server.core import ServerConfig
from urlab_client.server.dialects import DIALECTS
from urlab_client.server.faults import Faults
from urlab_client.server.limits import Limits
from urlab_client.server.open_server import LARGEST_PIXELS, OpenServer, is_level
from urlab_client.server.physics.observe import channel_problem
from urlab_client.server.rpc.dispatch import ServedRequest
from urlab_client.server.transport.curve_authentication import CurveServer, is_loopback
from urlab_client.server.transport.endpoint import connect_host, tcp
from urlab_client.simulation.appearance import RenderQuality
from urlab_client.simulation.controller_config import ControllerConfig
from urlab_client.simulation.opengl import find_backend

_FIRST_PORT: Final = 5559
_PORTS_EACH: Final = 10
_LAST_INDEX: Final = 5000
_DEFAULT_LIMITS: Final = Limits()
_INTERFACES: Final = {"0.0.0.0": "every network of this machine", "::": "every network of this machine"}  # noqa: S104


class SimulatedServer:
    """A URLab server without Unreal, for tests, demonstrations and offline work.

    It runs in its own threads, so one program may hold it and any number of clients::

        with SimulatedServer("arm", play=True) as server:
            client = URLabClient(**server.client_options())

    `async with` does the same without blocking the event loop. The server answers as the plugin does, with these
    differences: a broken MJCF is refused instead of imported empty, positions in replies are correct, entities are
    reported, requests of all transports are handled one at a time, and ops without a counterpart answer `unsupported`.

    Each MJCF becomes a blueprint and one actor whose id is the file stem, made unique with `_1`, `_2`, …. The first
    is at the origin, the others beside it along +y, with a metre between the bounding boxes of their geoms in the
    reference pose. Planes are infinite and do not count: a model that consists of a floor stays at the origin. The
    level has no name and contains a manager, so play can start immediately.
    """

    def __init__(
        self,
        *models: str | os.PathLike[str],
        play: bool = False,
        unpaused: bool = False,
        step_mode: StepMode | StepModeName = "auto",
        host: str = "127.0.0.1",
        curve: CurveServer | None = None,
        insecure_no_auth: bool = False,
        limits: Limits = _DEFAULT_LIMITS,
        step_port: int = 0,
        state_port: int = 0,
        ctrl_port: int = 0,
        info_port: int = 0,
        camera_port: int = 0,
        saved_dir: str | os.PathLike[str] | None = None,
        model_roots: Sequence[str | os.PathLike[str]] | None = None,
        controllers: Mapping[str, ControllerConfig] = MappingProxyType({}),
        camera_modes: Mapping[str, CameraMode | str] = MappingProxyType({}),
        camera_size: tuple[int, int] | None = None,
        render_quality: RenderQuality = "auto",
        mjcf_options: bool = False,
        actor_names: Literal["model", "plugin"] | None = None,
        faults: Faults | None = None,
        shm_dir: str | os.PathLike[str] | None = None,
        dialect: DialectName = "alpha",
        user_channels: Mapping[str, Any] = MappingProxyType({}),
        randomise: Randomisation | str | os.PathLike[str] | None = None,
        instance_id: str = "",
        instance_index: int | None = None,
    ) -> None:
        """Configure a server; `start`, or entering the context, opens it.

        Args:
            models: MJCF files, names of bundled robots (see `bundled_models`), and at most one saved level (`.json`),
                which becomes the open level.
            play: Start a play session immediately.
            unpaused: Let physics run from the start of each play session; the plugin starts paused.
            step_mode: `live`, `direct` or `puppet` pins the mode; `auto` starts live and lets clients choose.
            host: Interface to bind, an address or a name. Anything but loopback requires `curve` or `insecure_no_auth`.
            curve: Encrypt all traffic and accept only clients with the right keys.
            insecure_no_auth: Serve everyone who can reach the interface, with all rights of a client.
            limits: Limits on what clients can request.
            step_port: Port of requests; 0 selects a free port, as for the other ports.
            state_port: Port of the state stream. Like the next two, it is bound while the server is open, and sends
                nothing outside play.
            ctrl_port: Port of streamed controls.
            info_port: Port of the info stream.
            camera_port: Port of the first camera's images; the other cameras get the free ports after it.
            saved_dir: Folder of levels and imported models; None for a temporary one that is removed when the server
                closes.
            model_roots: Folders below which clients may import MJCF files. None for the folders of `models`, or the
                current folder if those contain no files.
            controllers: Controller by actor id or articulation key; `*` matches all others. They take precedence over
                those of the level and the MJCF. With `play`, a name that matches nothing is refused; otherwise it is
                logged when play starts, because the actor may be spawned before that.
            camera_modes: Meaning of the pixels by `ACTOR/CAMERA`.
            camera_size: Width and height of cameras without a resolution in their MJCF, pixels; default 640 by 480.
            render_quality: `fast`, without shadows, reflections and antialiasing; `high`, with them; or `auto`: `fast`
                with software rendering, `high` on a graphics card.
            mjcf_options: Use the `<option>` of the first model. Otherwise the alpha ignores all, and the beta merges
                them.
            actor_names: Name articulations after their MJCF's model name (`robot`, `copy1_robot`), the default of the
                alpha, or as the plugin does (`robot_C_0`, `robot_C_1`), that of the beta.
            faults: Faults injected into replies and published messages, for tests; they may change while the server
                runs.
            shm_dir: Directory in which the server creates its own directory for shared-memory regions; a tmpfs such as
                `/dev/shm` avoids disk writes. None for no shared memory.
            dialect: Wire dialect of the plugin: `alpha` (June 2026) or `beta` (August 2026).
            user_channels: Initial values of the level's user channels by `ROBOT/CHANNEL` or `scene/CHANNEL`. The kind
                of the value is that of the channel. Beta only.
            randomise: Variations drawn at each reset from its seed: a `Randomisation`, or a TOML file.
            instance_id: Name of this server among several; by default `live`, or derived from its index.
            instance_index: Number of this server among several. It determines the ports that are not given: 5559 + 10
                times the index for requests, then state, then cameras.

        Raises:
            ValueError: A port, mode, size, dialect, channel, index or randomisation is invalid, there are two levels,
                or both `curve` and `insecure_no_auth` are given.
            OSError: The randomisation file cannot be read.
        """
        names = tuple(os.fspath(model) for model in models)
        if sum(map(is_level, names)) > 1:
            raise ValueError(f"only one level can be open: {', '.join(filter(is_level, names))}")
        if actor_names not in ("model", "plugin", None):
            raise ValueError(f"actor_names must be 'model' or 'plugin', not {actor_names!r}")
        if render_quality not in get_args(RenderQuality):
            raise ValueError(f"render_quality must be {', '.join(get_args(RenderQuality))}, not {render_quality!r}")
        if camera_size is not None and (len(camera_size) != 2 or min(camera_size) < 1):
            raise ValueError(f"camera_size must be a width and a height of at least 1 pixel, not {camera_size!r}")
        if curve is not None and insecure_no_auth:
            raise ValueError(
                "curve and insecure_no_auth exclude each other: a server with keys is not open to everyone"
            )
        if dialect not in DIALECTS:
            raise ValueError(f"dialect must be {' or '.join(DIALECTS)}, not {dialect!r}")
        for channel, value in user_channels.items():
            if problem := channel_problem(channel, value):
                raise ValueError(f"user_channels: {problem}")
        if instance_index is not None:
            if not 0 <= instance_index <= _LAST_INDEX:
                raise ValueError(f"instance_index must be a number from 0 to {_LAST_INDEX}, not {instance_index}")
            base = _FIRST_PORT + _PORTS_EACH * instance_index
            step_port, state_port, camera_port = step_port or base, state_port or base + 1, camera_port or base + 2
        ports = {"step": step_port, "state": state_port, "ctrl": ctrl_port, "info": info_port, "camera": camera_port}
        for name, port in ports.items():
            if not 0 <= port <= 65535:
                raise ValueError(f"{name}_port must be a number from 0 to 65535, not {port}")
        self._config = ServerConfig(
            models=names,
            play=play,
            unpaused=unpaused,
            step_mode=StepMode(step_mode),
            host=host,
            curve=curve,
            insecure_no_auth=insecure_no_auth,
            limits=limits,
            step_port=step_port,
            state_port=state_port,
            ctrl_port=ctrl_port,
            info_port=info_port,
            camera_port=camera_port,
            saved_dir=None if saved_dir is None else Path(saved_dir),
            model_roots=None if model_roots is None else tuple(map(Path, model_roots)),
            controllers=dict(controllers),
            camera_modes={camera: CameraMode(mode) for camera, mode in camera_modes.items()},
            camera_size=camera_size,
            render_quality=render_quality,
            mjcf_options=mjcf_options,
            actor_names=actor_names or DIALECTS[dialect].actor_names,
            faults=faults,
            shm_dir=None if shm_dir is None else Path(shm_dir),
            dialect=DIALECTS[dialect],
            user_channels=dict(user_channels),
            randomise=None if randomise is None else Randomisation.of(randomise),
            instance_id=instance_id or ("live" if instance_index is None else f"instance_{instance_index}"),
            index=-1 if instance_index is None else instance_index,
        )
        self._lock = threading.Lock()
        self._opened: OpenServer | None = None
        self._made_at = _caller()
        self._finalizer: weakref.finalize[..., Self] | None = None

    def __repr__(self) -> str:
        opened = self._opened
        where = "closed" if opened is None else f"{self.address}:{opened.endpoint.port}"
        if self.failure is not None:
            where += f", failed: {self.failure}"
        return f"<{type(self).__name__} {' '.join(self._config.models) or 'empty'} at {where}>"

    # Life

    def start(self) -> Self:
        """Open the server and return it once it answers; no effect if it is already open.

        After `close` it starts again from the models.

        Raises:
            PortInUse: A port is in use.
            OSError: The host is not an address of this machine, or `saved_dir` cannot be used.
            UnprotectedServer: The host is not loopback, and neither `curve` nor `insecure_no_auth` was given.
            KeyFileError: A key file cannot be used.
            ModelError: A model is missing or broken, or `play` is set and MuJoCo rejects the scene.
        """
        with self._lock:
            if self._opened is None:
                self._opened = OpenServer(self._config)
                self._finalizer = weakref.finalize(self, self._opened.close)
        return self

    def close(self) -> None:
        """Close the server within about a second, whatever it is doing; no effect if it is already closed.

        A request in progress is answered with `shutting_down` if it can be aborted.
        """
        with self._lock:
            opened, self._opened = self._opened, None
            if opened is not None:
                if self._finalizer is not None:
                    self._finalizer.detach()
                opened.close()

    def restore(self) -> None:
        """Restore the state after `start`, for the next test; no effect if the server is closed.

        Ends the session, restarts play from the level's initial state or stops it, and resets modes, options,
        controllers, recordings, drawings and faults. This takes milliseconds. If a level was edited, a file was
        written, or the server hangs or has failed, the server is closed and started again instead; automatically
        chosen ports then change. Files in a `saved_dir` that the caller gave are kept.

        Raises:
            OSError, ModelError: The server could not be started again; see `start`.
        """
        with self._lock:
            opened = self._opened
        if opened is not None and not opened.restore():
            self.close()
            self.start()

    def snapshot(self, size: tuple[int, int] = (1280, 720), *, frame_all: bool = False) -> NDArray[np.uint8]:
        """Draw the viewport as the editor would show it, with debug drawings, overlay text and the selection.

        The camera and the view mode are those that the `viewport` ops have set. During play it shows the simulation,
        otherwise the level as authored. `collision` mode shows the colliding geoms, with meshes as convex hulls. Blocks
        until the picture is drawn; in async code call `anyio.to_thread.run_sync(server.snapshot)`.

        Args:
            size: Width and height, pixels.
            frame_all: Move the camera for this picture, without turning it, so that everything is visible.

        Returns:
            Red, green, blue and alpha, rows from the top, shape (height, width, 4).

        Raises:
            RenderingUnavailable: This machine has no OpenGL (the message names the packages), the level does not
                compile, or the server is busy.
            ValueError: An invalid size.
            RuntimeError: The server is closed.
        """
        if len(size) != 2 or not all(1 <= side <= LARGEST_PIXELS for side in size):
            raise ValueError(f"size must be a width and a height from 1 to {LARGEST_PIXELS} pixels, not {size!r}")
        return self._running.snapshot((int(size[0]), int(size[1])), frame_all=frame_all)

    @property
    def failure(self) -> str | None:
        """Which thread of the server died, and why; None while all of them run, and while the server is closed.

        A server that has failed refuses every request with `internal_error` and this text, until it is closed and
        started again.
        """
        opened = self._opened
        return None if opened is None else opened.core.health.failure

    def add_failure_callback(self, callback: Callable[[str], None]) -> None:
        """Call `callback` with `failure` when a thread of the server dies, on that thread; immediately if one has died.

        The callback is removed when the server closes.

        Raises:
            RuntimeError: The server is closed.
        """
        self._running.core.health.add_callback(callback)

    def add_request_callback(self, callback: Callable[[ServedRequest], None]) -> None:
        """Call `callback` with each answered request, on the thread that answers, until the server is closed.

        It must be fast, because the next request waits for it. Exceptions that it raises are logged and ignored.

        Raises:
            RuntimeError: The server is closed.
        """
        self._running.dispatcher.callbacks.append(callback)

    @property
    def sim_time(self) -> float | None:
        """Simulation time of the play session, seconds; None without one."""
        opened = self._opened
        running = None if opened is None else opened.core.play.current
        return None if running is None else running.engine.time

    @property
    def can_render(self) -> bool:
        """Whether this machine can draw pictures; the check takes about a second, once per process."""
        return find_backend() is not None

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    async def __aenter__(self) -> Self:
        try:
            await anyio.to_thread.run_sync(self.start)
        except BaseException:
            # Cancelled during the start: nothing else would close it.
            await self._aclose()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self._aclose()

    async def _aclose(self) -> None:
        with anyio.CancelScope(shield=True):
            await anyio.to_thread.run_sync(self.close)

    def __del__(self) -> None:
        if getattr(self, "_opened", None) is not None:
            # Without `source`, which would keep the object from its finalizer for as long as the warning is kept.
            warnings.warn(f"{self!r} was not closed; it was created at {self._made_at}", ResourceWarning, stacklevel=2)

    # Where it is

    @property
    def address(self) -> str:
        """Address for a client on this machine, without a port: `tcp://127.0.0.1`."""
        return tcp(connect_host(self._running.host))

    @property
    def step_port(self) -> int:
        """Port of requests."""
        return self._running.endpoint.port

    @property
    def state_port(self) -> int:
        """Port of the state stream."""
        return self._running.streams.state_port

    @property
    def ctrl_port(self) -> int:
        """Port of streamed controls."""
        return self._running.streams.ctrl_port

    @property
    def info_port(self) -> int:
        """Port of the info stream."""
        return self._running.streams.info_port

    @property
    def camera_port(self) -> int:
        """Port of the first camera's images; `hello` names those of the others."""
        return self._running.cameras.port

    @property
    def scene_warnings(self) -> tuple[str, ...]:
        """Warnings from compiling the current scene, for example about options of a model that have no effect."""
        core = self._running.core
        return core.play.running().scene.warnings if core.world.pie_running else ()

    @property
    def saved_dir(self) -> Path:
        """Folder of levels and imported models."""
        return self._running.core.world.content.root

    @property
    def shm_dir(self) -> Path | None:
        """Directory of the shared-memory regions, used by this server only; None without shared memory."""
        memory = self._running.memory
        return None if memory is None else memory.directory

    @property
    def open_to(self) -> str:
        """Who can use the server, as text: this machine only, holders of keys, or anyone on an interface."""
        host, curve_keys = self._running.host, self._running.curve_keys
        where = "this machine" if is_loopback(host) else _INTERFACES.get(host, f"the network at {host}")
        if curve_keys is None:
            return f"any program on {where}" if is_loopback(host) else f"anyone on {where}, without authentication"
        who = "everyone with the server's key" if curve_keys.clients is None else f"{curve_keys.clients} client key(s)"
        return f"{who} on {where}, encrypted"

    @property
    def faults(self) -> Faults | None:
        """The `faults` argument."""
        return self._config.faults

    def client_options(self) -> dict[str, Any]:
        """Return the arguments for a client of this server: `URLabClient(**server.client_options())`.

        With `curve` they include the server's public key. If the server requires client keys, add `client_key`.
        """
        curve_keys = self._running.curve_keys
        return ({} if curve_keys is None else {"server_key": curve_keys.public_key}) | {
            "address": self.address,
            "step_port": self.step_port,
            "state_port": self.state_port,
            "ctrl_port": self.ctrl_port,
            "info_port": self.info_port,
        }

    @property
    def _running(self) -> OpenServer:
        opened = self._opened
        if opened is None:
            raise RuntimeError("the server is closed: use it in a with block, or call start() first")
        return opened


def _caller() -> str:
    """Return file and line of the code that called into this module."""
    frame = inspect.currentframe()
    while frame is not None and frame.f_code.co_filename == __file__:
        frame = frame.f_back
    return "an unknown place" if frame is None else f"{frame.f_code.co_filename}:{frame.f_lineno}"
