"""The resources of an open server: sockets, threads, play session, folders; opening, restoring and closing them."""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from urlab_client._landlock import is_available
from urlab_client.protocol.control_messages import CameraEndpoint
from urlab_client.protocol.dialects import Dialect
from urlab_client.protocol.enums import PIEState, Transport
from urlab_client.protocol.instances import registry_directory
from urlab_client.protocol.messages.session import InstanceInfo
from urlab_client.server.assets.content import ContentRoot
from urlab_client.server.core import PhysicsConfig, ServerCore
from urlab_client.server.editor.markers import Drawings
from urlab_client.server.editor.viewport import Viewport
from urlab_client.server.editor.world import EditorWorld
from urlab_client.server.faults import Faults, FaultyEndpoint, Injector
from urlab_client.server.handlers import HANDLERS
from urlab_client.server.initial_level import ModelError, populate
from urlab_client.server.lease import DriverLease
from urlab_client.server.limits import Limits
from urlab_client.server.refusal import Refusal
from urlab_client.server.rpc.dispatch import Dispatcher
from urlab_client.server.rpc.served_request import ServedRequest
from urlab_client.server.rpc.watchdog import Watchdog
from urlab_client.server.session import ServerSession
from urlab_client.server.snapshot import take_snapshot
from urlab_client.server.streams.camera_streams import CameraStreams
from urlab_client.server.streams.publishing import StreamServer
from urlab_client.server.streams.registration import Registration
from urlab_client.server.system.health import Health
from urlab_client.server.system.temporary_folder import TemporaryFolder
from urlab_client.server.transport.curve_authentication import CurveKeys, CurveServer, UnprotectedServer, is_loopback
from urlab_client.server.transport.endpoint import RpcEndpoint, numeric_host, tcp
from urlab_client.server.transport.shared_memory import MAX_REPLY_BYTES, SharedMemoryServer

__all__ = ["OpenServer", "ServerConfig", "ServerPorts"]

logger: logging.Logger = logging.getLogger("urlab_client.server")


CLOSE_S: Final = 1.0
"""Longest time for closing the server."""

_NO_LIMIT: Final = float("inf")


@dataclass(frozen=True, kw_only=True)
class ServerPorts:
    """Port numbers; 0 for any free port."""

    step: int
    state: int
    ctrl: int
    info: int
    camera: int


@dataclass(frozen=True, kw_only=True)
class ServerConfig:
    """Configuration of a server; see `SimulatedServer`."""

    models: tuple[str, ...]
    play: bool
    host: str
    curve: CurveServer | None
    insecure_no_auth: bool
    limits: Limits
    ports: ServerPorts
    saved_dir: Path | None
    model_roots: tuple[Path, ...] | None
    actor_names: Literal["model", "plugin"]
    physics: PhysicsConfig
    faults: Faults | None
    shm_dir: Path | None
    dialect: Dialect
    instance_id: str
    index: int


class OpenServer:
    """The resources of an open server. Does not refer to its `SimulatedServer`, so that it can be collected."""

    def __init__(self, config: ServerConfig) -> None:
        self.host: str = numeric_host(config.host)
        self.curve_keys: CurveKeys | None = None if config.curve is None else CurveKeys(config.curve)
        if self.curve_keys is None and not config.insecure_no_auth and not is_loopback(self.host):
            raise UnprotectedServer(
                f"{config.host} ({self.host}) can be reached from other machines, and a client can read and write "
                "files of this one.",
                hint="Protect the server with CURVE keys (--server-key and --allow-client, or curve=…), "
                "or pass --insecure-no-auth (insecure_no_auth=True).",
            )
        self.health: Health = Health()
        self.request_callbacks: list[Callable[[ServedRequest], None]] = []
        self._cameras: CameraStreams | None = None
        self._streams: StreamServer | None = None
        self._temporary_folder: TemporaryFolder | None = None
        self._injector: Injector | None = None
        self._dispatcher: Dispatcher | None = None
        self._plays = config.play
        self._faults = config.faults
        self._authored: object = None
        self._endpoint: RpcEndpoint | None = None
        self._watchdog: Watchdog | None = None
        self._memory: SharedMemoryServer | None = None
        self._core: ServerCore | None = None
        self._registration: Registration | None = None
        self._instance_id, self._index = config.instance_id, config.index
        self._closed = False
        self._pid = os.getpid()

    @classmethod
    def open(cls, config: ServerConfig) -> OpenServer:
        """Open a server; release everything if that fails."""
        opened = cls(config)
        try:
            opened._start(config)
        except BaseException:
            opened.close()
            raise
        return opened

    @property
    def endpoint(self) -> RpcEndpoint:
        """The request socket."""
        if self._endpoint is None:
            raise RuntimeError("the server is still starting")
        return self._endpoint

    @property
    def streams(self) -> StreamServer:
        """The sockets of state, controls and info."""
        if self._streams is None:
            raise RuntimeError("the server is still starting")
        return self._streams

    @property
    def cameras(self) -> CameraStreams:
        """The sockets of camera images."""
        if self._cameras is None:
            raise RuntimeError("the server is still starting")
        return self._cameras

    @property
    def memory(self) -> SharedMemoryServer | None:
        """The shared memory, if any."""
        return self._memory

    @property
    def scene_warnings(self) -> tuple[str, ...]:
        """Warnings from compiling the scene; empty outside play."""
        core = self._core
        return core.play.running().scene.warnings if core is not None and core.world.pie_running else ()

    @property
    def saved_dir(self) -> Path:
        """Folder of the content root."""
        if self._core is None:
            raise RuntimeError("the server is still starting")
        return self._core.world.content.root

    def _start(self, config: ServerConfig) -> None:
        ports = config.ports
        memory = self._memory = None if config.shm_dir is None else SharedMemoryServer(config.shm_dir, self.health)
        cameras = self._cameras = CameraStreams(
            health=self.health,
            host=self.host,
            port=ports.camera,
            curve_keys=self.curve_keys,
            memory=memory,
            dialect=config.dialect,
        )
        self._streams = StreamServer(
            lambda scene: [
                CameraEndpoint(camera.name, cameras.endpoint(index.key, camera.name))
                for index in scene.articulations
                for camera in index.cameras
            ],
            health=self.health,
            host=self.host,
            state_port=ports.state,
            ctrl_port=ports.ctrl,
            info_port=ports.info,
            curve_keys=self.curve_keys,
            memory=memory,
        )
        core = ServerCore(
            world=EditorWorld(self._content(config), actor_names=config.actor_names),
            physics=config.physics,
            camera_endpoint=cameras.endpoint,
            switch_camera=cameras.switch,
            dialect=config.dialect,
            instance=self._instance if config.dialect.instance else None,
            shm_directory=None if memory is None else str(memory.directory),
            health=self.health,
        )
        self._core = core
        if config.faults is not None:
            self._injector = injector = Injector(config.faults, core.refuse)
            self._streams.filter = cameras.filter = injector.publish
        core.play.listeners += [cameras.show, self._streams.show]  # the second announces the first's ports
        cameras.start()
        self._streams.start()
        # Bound before the models are read, which takes longer; requests wait in the socket until then.
        self._dispatcher = Dispatcher(core, HANDLERS)
        self._dispatcher.callbacks = self.request_callbacks
        answer = self._dispatcher.answer
        where: dict[str, Any] = {"host": self.host, "port": ports.step, "curve_keys": self.curve_keys}
        where |= {"refuse": core.refuse, "health": self.health}
        where["request_bytes"] = config.limits.request_bytes
        self._endpoint = (
            RpcEndpoint(answer, **where) if self._injector is None else FaultyEndpoint(self._injector, answer, **where)
        )
        try:
            populate(core.world, config.models)
        except Refusal as refusal:
            raise ModelError(refusal.message) from None
        if config.play:
            # Here all actors exist already; with a later begin_pie, more may be spawned first.
            core.begin_play(names_fit=True)
            if core.play.wait(_NO_LIMIT) is not PIEState.READY:
                raise ModelError(f"play cannot start: {core.play.compile_error}")
        self._authored = self._mark(core)
        self._dispatcher.served = [served.serving for served in (self._endpoint, memory) if served is not None]
        self._watchdog = Watchdog(core, self._dispatcher, self.health)
        self._watchdog.start()
        self._endpoint.start()
        if config.dialect.instance and (config.index >= 0 or os.environ.get("URLAB_REGISTRY_DIR")):
            self._registration = Registration(registry_directory(), self._instance, self.health)
            self._registration.start()
        if memory is not None:
            in_memory = partial(answer, transport=Transport.SHM, max_reply_bytes=MAX_REPLY_BYTES)
            injector = self._injector
            memory.start(in_memory if injector is None else partial(injector.answer_in_memory, answer=in_memory))
        if not is_available():
            tell = logger.info if is_loopback(self.host) else logger.warning
            tell("this system has no Landlock: files that clients' models name are checked, but not kept from MuJoCo")
        if self.curve_keys is None and not is_loopback(self.host):
            logger.warning("open to anyone who reaches %s, without authentication or encryption", self.host)
        logger.info("serving at %s:%d", tcp(self.host), self._endpoint.port)

    def _instance(self) -> InstanceInfo:
        core = self._core
        return InstanceInfo(
            instance_id=self._instance_id,
            index=self._index,
            pid=self._pid,
            host=socket.gethostname(),
            step_port=self.endpoint.port,
            state_port=self.streams.state_port,
            cam_base_port=self.cameras.port,
            manager_present=core is not None and core.play.manager_present,
            busy=core is not None and core.lease.held,
            urlab_version="" if core is None else core.dialect.urlab_version,
            capabilities=[
                *(["render_sync", "render_async"] if core is not None and core.dialect.draws_for_steps else []),
                *(["shm_rpc"] if self._memory else []),
                "model_upload",
                "content_cache",
            ],
        )

    def _content(self, config: ServerConfig) -> ContentRoot:
        folder = config.saved_dir
        if folder is None:
            self._temporary_folder = TemporaryFolder()
            folder = self._temporary_folder.path
        roots = config.model_roots
        if roots is None:
            files = [Path(model).resolve() for model in config.models if Path(model).is_file()]
            roots = tuple(dict.fromkeys(file.parent for file in files)) or (Path.cwd(),)
        return ContentRoot(folder, model_roots=roots, limits=config.limits)

    @property
    def sim_time(self) -> float | None:
        """See `SimulatedServer.sim_time`."""
        running = None if self._core is None else self._core.play.current
        return None if running is None else running.engine.time

    def restore(self) -> bool:
        """Restore the state after the start, or return False if that requires a restart."""
        core, dispatcher = self._core, self._dispatcher
        if core is None or dispatcher is None:
            return False
        if self._faults is not None:
            self._faults.reset()
        if self.health.failure is not None or not all(served.alive for served in self._served()):
            return False
        with dispatcher.standstill(CLOSE_S) as idle:
            if not idle or self._mark(core) != self._authored:
                return False
            core.lease = DriverLease()
            core.session, core.viewport, core.drawings = (
                ServerSession(),
                Viewport(),
                Drawings(limit=core.limits.markers),
            )
            core.world.selected = ""
            if self._plays:
                return core.begin_play_again(CLOSE_S)
            core.stop_play()
            return True

    def snapshot(self, size: tuple[int, int], *, frame_all: bool) -> NDArray[np.uint8]:
        """Draw the viewport; see `SimulatedServer.snapshot`."""
        core, dispatcher = self._core, self._dispatcher
        if core is None or dispatcher is None:
            raise RuntimeError("the server is still starting")
        return take_snapshot(core, dispatcher, size, frame_all=frame_all)

    def _mark(self, core: ServerCore) -> object:
        """Return a value that compares equal until something is authored or written."""
        files: set[tuple[Path, int, int]] = set()
        if self._temporary_folder is not None:
            for file in self._temporary_folder.path.rglob("*"):
                status = file.lstat()
                files.add((file, status.st_mtime_ns, status.st_size))
        return core.world.authored(), files

    def _served(self) -> list[Watchdog | RpcEndpoint | StreamServer | CameraStreams | SharedMemoryServer]:
        """Return all parts with a thread; shared memory last, because the streams write to it."""
        every = (self._watchdog, self._endpoint, self._streams, self._cameras, self._memory)
        return [served for served in every if served is not None]

    def close(self) -> None:
        """Release everything. Idempotent; does nothing in a forked child, which does not own the resources."""
        if self._closed or os.getpid() != self._pid:
            return
        self._closed = True
        deadline = time.monotonic() + CLOSE_S
        if self._injector is not None:
            self._injector.close()
        for served in self._served():
            served.stop()
        idle = True
        if self._registration is not None:
            self._registration.stop()
            idle = self._registration.join(max(0.0, deadline - time.monotonic()))
        if self._core is not None:
            self._core.jobs.close()
            self._core.uploads.close()
            idle = self._core.play.close(CLOSE_S / 2) and idle
        for served in self._served():
            idle = served.join(max(0.0, deadline - time.monotonic())) and idle
        if not idle:
            logger.warning("a request was still running when the server closed; its thread ends after it")
        if self._temporary_folder is not None:
            self._temporary_folder.close()
