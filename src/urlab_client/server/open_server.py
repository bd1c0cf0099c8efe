"""An open server: its sockets, threads, play session and folders; opening, restoring, drawing and closing it."""

from __future__ import annotations

import contextlib
import datetime as dt
import logging
import os
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from urlab_client._platform.files import write_whole
from urlab_client._sandbox.confinement import is_available
from urlab_client.enums import PIEState, Transport
from urlab_client.errors import URLabError
from urlab_client.protocol import instances
from urlab_client.protocol.messages.session import InstanceInfo
from urlab_client.server.assets.bundled_robots import bundled_models, unknown_model
from urlab_client.server.assets.content import ContentRoot
from urlab_client.server.compile.scene import CompiledScene
from urlab_client.server.core import DriverLease, ServerConfig, ServerCore, ServerSession
from urlab_client.server.editor.markers import Drawings
from urlab_client.server.editor.viewport import Viewport
from urlab_client.server.editor.world import EditorWorld
from urlab_client.server.faults import FaultyEndpoint, Injector
from urlab_client.server.handlers import HANDLERS
from urlab_client.server.handlers.viewport import look
from urlab_client.server.refusal import CompileFailed, Refusal
from urlab_client.server.render.viewport_picture import ViewportPicture
from urlab_client.server.rpc.dispatch import Dispatcher, Watchdog
from urlab_client.server.streams.camera_streams import CameraStreams
from urlab_client.server.streams.commands import CameraEndpoint
from urlab_client.server.streams.publishing import StreamServer
from urlab_client.server.system.temporary_folder import TemporaryFolder
from urlab_client.server.system.threads import Health, ServedThread
from urlab_client.server.transport.curve_authentication import CurveKeys, UnprotectedServer, is_loopback
from urlab_client.server.transport.endpoint import RpcEndpoint, numeric_host, tcp
from urlab_client.server.transport.shared_memory import MAX_REPLY_BYTES, SharedMemoryServer
from urlab_client.simulation.opengl import RenderingUnavailable, need_backend

logger: logging.Logger = logging.getLogger("urlab_client.server")


class Registration(ServedThread):
    """Keeps the file of one server in the registry for as long as the server is open."""

    def __init__(self, directory: Path, describe: Callable[[], InstanceInfo], health: Health) -> None:
        super().__init__(health.thread("urlab-registry", self._run))
        self._directory = directory
        self._describe = describe
        self._path: Path | None = None

    def start(self) -> None:
        """Write the file, and renew it before it would be considered stale."""
        self._write()
        super().start()

    def join(self, timeout: float) -> bool:
        """Wait for the thread to end and remove the file; return False if the thread is still busy."""
        ended = super().join(timeout)
        if self._path is not None:
            with contextlib.suppress(OSError):
                self._path.unlink()
        return ended

    def _run(self) -> None:
        while not self._stopping.wait(instances.REWRITE_S):
            self._write()

    def _write(self) -> None:
        instance = self._describe()
        path = self._directory / f"{instance.instance_id}_{instance.pid}.json"
        try:
            write_whole(path, instances.encode(instance, dt.datetime.now(dt.UTC)), durable=False)
        except OSError as error:
            logger.warning("the server is not in the registry: %s", error)
        else:
            self._path = path


CLOSE_S: Final = 1.0
"""Longest time for closing the server."""

_NO_LIMIT: Final = float("inf")

Part: TypeAlias = ServedThread | RpcEndpoint | SharedMemoryServer | ServerCore
"""A part of a server that is stopped, then joined."""

GAP_M: Final = 1.0
"""Free space between the models placed side by side, metres."""

LARGEST_PIXELS: Final = 16384
"""Longest side in pixels, the maximum of common drivers."""

IDLE_DEADLINE_S: Final = 10.0
"""Longest wait for the request in progress."""

_FRAMING_FOV: Final = 40.0


class OpenServer:
    """The parts of an open server. Does not refer to its `SimulatedServer`, so that it can be collected."""

    def __init__(self, config: ServerConfig) -> None:
        """Open a server; release everything if that fails.

        Raises:
            UnprotectedServer: Other machines could use it without keys, and `insecure_no_auth` is not set.
            ModelError: A model or level cannot be used.
        """
        self.config: ServerConfig = config
        self.host: str = numeric_host(config.host)
        host = self.host
        self.curve_keys: CurveKeys | None = None if config.curve is None else CurveKeys(config.curve)
        self._pid = os.getpid()
        if self.curve_keys is None and not config.insecure_no_auth and not is_loopback(host):
            raise UnprotectedServer(
                f"{config.host} ({host}) can be reached from other machines, and a client can read and write "
                "files of this one.",
                hint="Protect the server with CURVE keys (--server-key and --allow-client, or curve=…), "
                "or pass --insecure-no-auth (insecure_no_auth=True).",
            )
        with ExitStack() as resources:
            self._open(config, resources)
            self._resources = resources.pop_all()
        if not is_available():
            tell = logger.info if is_loopback(host) else logger.warning
            tell("this system has no Landlock: files that clients' models name are checked, but not kept from MuJoCo")
        if self.curve_keys is None and not is_loopback(host):
            logger.warning("open to anyone who reaches %s, without authentication or encryption", host)
        logger.info("serving at %s:%d", tcp(host), self.endpoint.port)

    def _open(self, config: ServerConfig, resources: ExitStack) -> None:
        """Make all parts and start them."""
        health = Health()
        content = _content(config, resources)
        parts: list[Part] = []
        resources.callback(_end, parts)
        where: dict[str, Any] = {"host": self.host, "curve_keys": self.curve_keys, "health": health}
        memory = None if config.shm_dir is None else SharedMemoryServer(config.shm_dir, health)
        self.memory: SharedMemoryServer | None = memory
        parts += [] if memory is None else [memory]
        self.cameras: CameraStreams = CameraStreams(
            **where, port=config.camera_port, memory=memory, dialect=config.dialect
        )
        parts.append(self.cameras)
        self.streams: StreamServer = StreamServer(
            partial(_camera_endpoints, self.cameras),
            **where,
            state_port=config.state_port,
            ctrl_port=config.ctrl_port,
            info_port=config.info_port,
            memory=memory,
        )
        parts.append(self.streams)
        self.core: ServerCore = ServerCore(
            world=EditorWorld(content, actor_names=config.actor_names),
            config=config,
            camera_endpoint=self.cameras.endpoint,
            switch_camera=self.cameras.switch,
            shm_directory=None if memory is None else str(memory.directory),
            health=health,
        )
        core = self.core
        core.play.listeners += [self.cameras.show, self.streams.show]  # the second announces the first's ports
        injector = None if config.faults is None else Injector(config.faults, core.refuse)
        if injector is not None:
            self.streams.filter = self.cameras.filter = injector.publish
        self.cameras.start()
        self.streams.start()
        # Bound before the models are read, which takes longer; requests wait in the socket until then.
        self.dispatcher: Dispatcher = Dispatcher(core, HANDLERS)
        make = RpcEndpoint if injector is None else partial(FaultyEndpoint, injector)
        self.endpoint: RpcEndpoint = make(
            self.dispatcher.answer,
            **where,
            port=config.step_port,
            refuse=core.refuse,
            request_bytes=config.limits.request_bytes,
        )
        watchdog = Watchdog(core, self.dispatcher, health)
        parts += [self.endpoint, watchdog]
        self._served = [part for part in parts if not isinstance(part, ServerCore)]
        parts.append(core)
        if injector is not None:
            resources.callback(injector.close)
        core.instance = self._instance if config.dialect.instance else None
        _begin(core)
        self._authored = _mark(core)
        self.dispatcher.served = [part.serving for part in (self.endpoint, memory) if part is not None]
        watchdog.start()
        self.endpoint.start()
        if config.dialect.instance and (config.index >= 0 or os.environ.get("URLAB_REGISTRY_DIR")):
            registration = Registration(instances.registry_directory(), self._instance, health)
            parts.append(registration)
            registration.start()
        if memory is not None:
            in_memory = partial(self.dispatcher.answer, transport=Transport.SHM, max_reply_bytes=MAX_REPLY_BYTES)
            memory.start(in_memory if injector is None else partial(injector.answer_in_memory, answer=in_memory))

    def _instance(self) -> InstanceInfo:
        core = self.core
        return InstanceInfo(
            instance_id=core.config.instance_id,
            index=core.config.index,
            pid=self._pid,
            host=socket.gethostname(),
            step_port=self.endpoint.port,
            state_port=self.streams.state_port,
            cam_base_port=self.cameras.port,
            manager_present=core.play.manager_present,
            busy=core.lease.held,
            urlab_version=core.dialect.urlab_version,
            capabilities=[
                "render_sync",
                "render_async",
                *(["shm_rpc"] if self.memory is not None else []),
                "model_upload",
                "content_cache",
            ],
        )

    def restore(self) -> bool:
        """Restore the state after the start, or return False if that requires a restart."""
        core = self.core
        if self.config.faults is not None:
            self.config.faults.reset()
        if core.health.failure is not None or not all(served.alive for served in self._served):
            return False
        with self.dispatcher.standstill(CLOSE_S) as idle:
            if not idle or _mark(core) != self._authored:
                return False
            core.lease = DriverLease()
            core.session = ServerSession()
            core.viewport = Viewport()
            core.drawings = Drawings(limit=core.limits.markers)
            core.world.actors.selected = ""
            if self.config.play:
                return core.begin_play_again(CLOSE_S)
            core.stop_play()
            return True

    def snapshot(self, size: tuple[int, int], *, frame_all: bool) -> NDArray[np.uint8]:
        """Draw the viewport; see `SimulatedServer.snapshot`. Requests are not answered while the state is read."""
        need_backend()
        core = self.core
        with self.dispatcher.standstill(IDLE_DEADLINE_S) as idle:
            if not idle:
                raise RenderingUnavailable(f"a request has been in progress for more than {IDLE_DEADLINE_S:g} s")
            view = look(core)
            picture = ViewportPicture(
                size=size,
                view=replace(view, fov=min(view.fov, _FRAMING_FOV)) if frame_all else view,
                fit=frame_all,
                mode=core.viewport.mode,
                primitives=core.drawings.take_frame(in_play=core.world.pie_running),
                overlay=core.drawings.overlay,
                selected=core.world.actors.selected,
            )
            running = core.play.current
            try:
                if running is not None:
                    with running.engine.lock:
                        visible = running.cameras.capture_viewport()
                    renderer = running.cameras
                else:
                    renderer = core.authored_renderer()
                    visible = renderer.capture_viewport()
            except Refusal as refusal:
                raise RenderingUnavailable(f"the state cannot be read: {refusal.message}") from None
            except CompileFailed as error:
                raise RenderingUnavailable(f"the level does not compile: {error.message}") from None
        try:
            return renderer.paint(visible, picture)
        finally:
            if running is None:
                renderer.close()

    def close(self) -> None:
        """Release everything. Idempotent; does nothing in a forked child, which does not own the resources."""
        if os.getpid() == self._pid:
            self._resources.close()


def _content(config: ServerConfig, resources: ExitStack) -> ContentRoot:
    folder = config.saved_dir
    if folder is None:
        temporary = TemporaryFolder()
        resources.callback(temporary.close)
        folder = temporary.path
    roots = config.model_roots
    if roots is None:
        files = [Path(model).resolve() for model in config.models if Path(model).is_file()]
        roots = tuple(dict.fromkeys(file.parent for file in files)) or (Path.cwd(),)
    return ContentRoot(folder, model_roots=roots, limits=config.limits)


def _camera_endpoints(cameras: CameraStreams, scene: CompiledScene) -> list[CameraEndpoint]:
    return [
        CameraEndpoint(camera.name, cameras.endpoint(index.key, camera.name))
        for index in scene.articulations
        for camera in index.cameras
    ]


def _begin(core: ServerCore) -> None:
    """Open the initial level, and start play if configured."""
    try:
        populate(core.world, core.config.models)
    except Refusal as refusal:
        raise ModelError(refusal.message) from None
    if core.config.play:
        # Here all actors exist already; with a later begin_pie, more may be spawned first.
        core.begin_play(names_fit=True)
        if core.play.wait(_NO_LIMIT) is not PIEState.READY:
            raise ModelError(f"play cannot start: {core.play.compile_error}")


def _mark(core: ServerCore) -> object:
    """Return a value that compares equal until something is authored, or written to the server's own folder."""
    files: set[tuple[Path, int, int]] = set()
    if core.config.saved_dir is None:
        for file in core.world.content.root.rglob("*"):
            status = file.lstat()
            files.add((file, status.st_mtime_ns, status.st_size))
    return core.world.authored(), files


def _end(parts: Sequence[Part]) -> None:
    """Stop all parts, then wait for them, the last one first: the streams write to shared memory."""
    deadline = time.monotonic() + CLOSE_S
    for part in reversed(parts):
        part.stop()
    ended = [part.join(max(0.0, deadline - time.monotonic())) for part in reversed(parts)]
    if not all(ended):
        logger.warning("a request was still running when the server closed; its thread ends after it")


class ModelError(URLabError, ValueError):
    """A model or level given at the start is missing or cannot be used."""


def is_level(model: str) -> bool:
    """Whether a name given at the start is that of a saved level."""
    return model.lower().endswith(".json")


def populate(world: EditorWorld, models: Sequence[str]) -> None:
    """Open the level among `models`, place the other models, and add a manager if there is none."""
    for level in filter(is_level, models):
        world.levels.load_file(Path(level))
    names = [row.name for row in list(world.actors)]
    edge: float | None = None
    sources: dict[str, str] = {}
    for model in models:
        if is_level(model):
            continue
        for name in names:  # only if another model follows, because the bounding box may require compilation
            edge = _beyond(world, name, edge)
        names = [_place(world, model, sources, edge)]
    world.ensure_manager()


def _place(world: EditorWorld, model: str, sources: dict[str, str], edge: float | None) -> str:
    """Import a model, place it beyond `edge`, the largest y in use, if any, and return the actor's name.

    `sources` holds the files imported so far by blueprint.
    """
    bundled = bundled_models()
    if not Path(model).suffix and not Path(model).is_file() and model not in bundled:
        raise ModelError(unknown_model(model))
    path = model if model in bundled and not Path(model).is_file() else str(Path(model).absolute())
    # Files named on the command line are imported anew, even if an earlier run imported them.
    blueprint, _ = world.blueprints.import_xml(path, force_reimport=path not in sources.values(), trusted=True)
    other = sources.setdefault(blueprint.stem, path)
    if other != path:
        raise ModelError(f"{model} and {other} would both become blueprint '{blueprint.stem}': rename one of the files")
    actor = world.spawn_actor(blueprint.class_path, world.actors.unused_id(Path(path).stem)).actor
    if edge is not None:
        bounds = world.get_actor_bounds(actor.name, components_only=True)
        if bounds.extents != (0.0, 0.0, 0.0):
            world.set_actor_transform(actor.name, location=(0.0, edge + GAP_M - bounds.min[1], 0.0))
    return actor.name


def _beyond(world: EditorWorld, actor_name: str, edge: float | None) -> float | None:
    """Return the larger of `edge` and the actor's largest y; an actor without a bounding box has none."""
    bounds = world.get_actor_bounds(actor_name, components_only=True)
    if bounds.extents == (0.0, 0.0, 0.0):
        return edge
    return bounds.max[1] if edge is None else max(edge, bounds.max[1])
