"""The configuration of a server, and the state that its op handlers share: its world, its session and its play.

Handlers get it as their first argument; `open_server` creates it.
"""

from __future__ import annotations

import copy
import logging
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal

import mujoco

from urlab_client._mujoco import copy_options
from urlab_client.enums import CameraMode, ObservationLevel, PIEState, StepMode
from urlab_client.protocol.base import Request
from urlab_client.protocol.codec import encode_reply
from urlab_client.protocol.messages.session import ErrorReply, Hello, InstanceInfo, Step
from urlab_client.randomise.declaration import MODEL_TEXT, Randomisation
from urlab_client.server.assets.actors import Actor
from urlab_client.server.assets.uploads import UPLOADS, Uploads
from urlab_client.server.compile.mjcf_options import OptionPolicy
from urlab_client.server.compile.scene import CompiledScene, compile_scene
from urlab_client.server.compile.scene_index import ArticulationIndex
from urlab_client.server.dialects import ALPHA, Dialect
from urlab_client.server.editor.jobs import EditorJobs
from urlab_client.server.editor.markers import Drawings
from urlab_client.server.editor.viewport import Viewport
from urlab_client.server.editor.world import EditorWorld
from urlab_client.server.faults import Faults
from urlab_client.server.limits import Limits
from urlab_client.server.physics.engine import Engine
from urlab_client.server.physics.observe import UserChannels
from urlab_client.server.physics.play import Play, Running
from urlab_client.server.physics.replay import recordings, replay_folder
from urlab_client.server.physics.variation import SceneVariation
from urlab_client.server.refusal import CompileFailed, Refusal
from urlab_client.server.render.camera_renderer import CameraRenderer
from urlab_client.server.system.threads import Health, trim
from urlab_client.server.transport.curve_authentication import CurveServer
from urlab_client.simulation.appearance import Appearance, RenderQuality
from urlab_client.simulation.controller_config import ControllerConfig


@dataclass(frozen=True, kw_only=True)
class ServerConfig:
    """Configuration of a server; `SimulatedServer` describes and checks it."""

    models: tuple[str, ...] = ()
    play: bool = False
    unpaused: bool = False
    step_mode: StepMode = StepMode.AUTO
    host: str = "127.0.0.1"
    curve: CurveServer | None = None
    insecure_no_auth: bool = False
    limits: Limits = field(default_factory=Limits)
    step_port: int = 0
    state_port: int = 0
    ctrl_port: int = 0
    info_port: int = 0
    camera_port: int = 0
    saved_dir: Path | None = None
    model_roots: tuple[Path, ...] | None = None
    controllers: Mapping[str, ControllerConfig] = field(default_factory=dict[str, ControllerConfig])
    camera_modes: Mapping[str, CameraMode] = field(default_factory=dict[str, CameraMode])
    camera_size: tuple[int, int] | None = None
    render_quality: RenderQuality = "auto"
    mjcf_options: bool = False
    actor_names: Literal["model", "plugin"] = "model"
    faults: Faults | None = None
    shm_dir: Path | None = None
    dialect: Dialect = ALPHA
    user_channels: Mapping[str, Any] = field(default_factory=dict[str, Any])
    randomise: Randomisation | None = None
    instance_id: str = "live"
    index: int = -1

    def controller(self, index: ArticulationIndex) -> ControllerConfig | None:
        """Return the controller of an articulation: the configured one, otherwise that of the level or its MJCF."""
        for name in (index.actor_id, index.key, "*"):
            if name and name in self.controllers:
                return self.controllers[name]
        return None if index.controller is None else index.controller

    def camera_mode(self, index: ArticulationIndex, camera: str) -> CameraMode:
        """Return the mode of an articulation's camera."""
        for name in (index.actor_id, index.key):
            if name and f"{name}/{camera}" in self.camera_modes:
                return self.camera_modes[f"{name}/{camera}"]
        return CameraMode.REAL


logger: logging.Logger = logging.getLogger("urlab_client.server")

_SEGMENTATIONS: Final = (CameraMode.SEMANTIC, CameraMode.INSTANCE)


class ServerSession:
    """State that the server keeps between requests, apart from the world.

    It survives play sessions and level changes, and ends with the server or the next `hello`. It does not time out.

    Attributes:
        id: Active session id, a lower-case GUID; empty before the first `hello`.
        json: Whether replies are JSON instead of msgpack, for all clients.
        level: Observation level of replies that carry state.
    """

    __slots__ = ("id", "json", "level")

    def __init__(self) -> None:
        self.id: str = ""
        self.json: bool = False
        self.level: ObservationLevel = ObservationLevel.STANDARD

    def open(self, *, observations: str | None, encoding: str | None) -> str:
        """Start a new session, which ends the previous one, and return its id.

        Args:
            observations: Level name, case-insensitive; an unknown name means standard, None keeps the level.
            encoding: `json`, case-insensitive, for JSON replies; anything else means msgpack.
        """
        self.id = str(uuid.uuid4())
        self.json = encoding is not None and encoding.lower() == "json"
        if observations is not None:
            self.level = _level(observations) or ObservationLevel.STANDARD
        return self.id

    def accepts(self, session_id: str) -> bool:
        """Whether a request with this id belongs to the active session."""
        return session_id != "" and session_id == self.id

    def level_of(self, observations: str | None) -> ObservationLevel:
        """Return the level that a step requests; the session's, if it requests none or an unknown one."""
        return self.level if observations is None else _level(observations) or self.level


def _level(name: str) -> ObservationLevel | None:
    try:
        return ObservationLevel(name.lower())
    except ValueError:
        return None


class DriverLease:
    """By which clients announce that the server is in use. It is advisory, and expires without requests."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._id = ""
        self._ttl_s = 0.0
        self._touched = 0.0

    @property
    def held(self) -> bool:
        """Whether it is held."""
        return bool(self._id) and self._clock() - self._touched <= self._ttl_s and self._ttl_s > 0

    def acquire(self, ttl_s: float) -> str:
        """Take it and return its id."""
        if self.held:
            # As the plugin does, although with the id anybody can release the lease. No message and no log has it.
            raise Refusal("busy", "another client holds the driver lease", lease_id=self._id)
        self._id, self._ttl_s, self._touched = str(uuid.uuid4()).upper(), ttl_s, self._clock()
        return self._id

    def release(self, lease_id: str) -> None:
        """Give it back."""
        if not self.held or lease_id != self._id:
            raise Refusal("bad_request", "lease_id is not the id of the lease that is held")
        self._id = ""

    def touch(self) -> None:
        """Renew the lease: the server is in use."""
        if self.held:
            self._touched = self._clock()


def _no_switch(key: str, *, zmq: bool, shm: bool) -> None:
    """Do nothing, for servers without streams."""


@dataclass(kw_only=True)
class ServerCore:
    """A server without its sockets.

    Attributes:
        camera_endpoint: Returns the endpoint of a camera, given articulation key and camera name.
        switch_camera: Starts or stops the streams of a camera, given as `ARTICULATION/CAMERA`.
        shm_directory: Directory of the shared-memory regions; None without shared memory.
        health: Whether the server's threads run.
        compiled: The level that the last play session was started with.
        instance: Returns the identity of this server among several; None in dialects without one.
    """

    world: EditorWorld
    config: ServerConfig
    camera_endpoint: Callable[[str, str], str]
    switch_camera: Callable[..., None] = _no_switch
    shm_directory: str | None = None
    session: ServerSession = field(default_factory=ServerSession)
    play: Play = field(init=False)
    viewport: Viewport = field(default_factory=Viewport)
    drawings: Drawings = field(init=False)
    health: Health = field(default_factory=Health)
    compiled: _Compiled | None = None
    jobs: EditorJobs = field(init=False)
    lease: DriverLease = field(default_factory=DriverLease)
    instance: Callable[[], InstanceInfo] | None = None
    uploads: Uploads = field(init=False)

    def refuse(self, code: str, message: str) -> bytes:
        """Return the frame of an error reply."""
        return encode_reply(ErrorReply(code=code, message=message), json=self.session.json)

    def __post_init__(self) -> None:
        self.play = Play(self.health)
        self.jobs = EditorJobs(self.health)
        self.drawings = Drawings(limit=self.limits.markers)
        self.uploads = Uploads(self.world.content.root / UPLOADS, self.limits.upload_cache_bytes)

    @property
    def dialect(self) -> Dialect:
        """Wire dialect."""
        return self.config.dialect

    @property
    def limits(self) -> Limits:
        """Limits on what clients can request."""
        return self.world.content.limits

    def least_reply_bytes(self, request: Request[Any] | None) -> int:
        """Return a lower bound of the size of the reply, as far as it is known before the request is executed."""
        running = self.play.current
        if running is None:
            return 0
        if isinstance(request, Hello):
            return mujoco.mj_sizeModel(running.scene.model) * 7 // 3  # as bytes and in base64
        if isinstance(request, Step) and running.engine.mode in (StepMode.DIRECT, StepMode.PUPPET):
            return running.cameras.frame_bytes(request.include_cameras)
        return 0

    def begin_play(self, *, names_fit: bool = False) -> None:
        """Start play with the current level; `play.wait` returns the outcome.

        Args:
            names_fit: Whether to fail if a configured controller or camera mode matches nothing in the level.
        """
        actors = self.world.freeze()
        config = self.config

        def build() -> Running:
            scene = compile_scene(
                actors,
                options=self._options,
                camera_size=config.camera_size,
                texts=self._texts(actors),
                limits=self.limits,
            )
            self.compiled = _Compiled(actors, scene, copy.copy(scene.model.opt))
            return self._run(scene, actors, names_fit=names_fit)

        self.play.begin(build)
        self.world.pie_running = True

    def begin_play_again(self, timeout: float) -> bool:
        """Restart play with the scene that was compiled last, and return when it is ready.

        Returns:
            False if stopping took longer, or the level has changed since it was compiled.
        """
        compiled, actors = self.compiled, self.world.freeze()
        if compiled is None or compiled.actors != actors:
            return False
        running = self.play.current
        if running is not None and not running.close(timeout):
            return False
        model = compiled.scene.model
        copy_options(compiled.options, model.opt)

        def build() -> Running:
            data = mujoco.MjData(model)
            mujoco.mj_forward(model, data)
            return self._run(replace(compiled.scene, data=data), actors)

        self.play.begin(build)
        self.world.pie_running = True
        return self.play.wait(timeout) is PIEState.READY

    def _run(self, scene: CompiledScene, actors: Sequence[Actor], *, names_fit: bool = False) -> Running:
        config = self.config
        files = recordings(replay_folder(self.world.content.root))
        controllers = {index.key: found for index in scene.articulations if (found := config.controller(index))}
        for problem in _unmatched_names(scene, config):
            if names_fit:
                raise CompileFailed(problem)
            logger.warning("%s", problem)
        engine = Engine(
            scene,
            pinned_mode=config.step_mode,
            paused=not config.unpaused,
            controllers=controllers,
            health=self.health,
            dialect=self.dialect,
        )
        varied: Sequence[str] = ()
        if config.randomise is not None:
            try:
                engine.variation = SceneVariation(scene, config.randomise, engine.articulations)
            except ValueError as error:
                raise CompileFailed(f"what is to vary: {error}") from None
            varied = engine.variation.visible_fields
        modes = {
            (index.key, camera.name): config.camera_mode(index, camera.name)
            for index in scene.articulations
            for camera in index.cameras
        }
        cameras = self._camera_renderer(scene, actors, modes, engine.articulations.names, varied)
        return Running(engine.start(), cameras, UserChannels(config.user_channels), files, self.limits)

    @property
    def _options(self) -> OptionPolicy:
        if self.config.mjcf_options:
            return "first"
        return "merged" if self.dialect.options_merged else "ignored"

    def authored_renderer(self) -> CameraRenderer:
        """Compile the current level and return its renderer; the caller closes it.

        Raises:
            CompileFailed: MuJoCo rejects the level.
        """
        actors = self.world.freeze()
        scene = compile_scene(actors, options=self._options, limits=self.limits)
        return self._camera_renderer(scene, actors, {}, {})

    def _camera_renderer(
        self,
        scene: CompiledScene,
        actors: Sequence[Actor],
        modes: Mapping[tuple[str, str], CameraMode],
        names: Mapping[str, str],
        varied: Sequence[str] = (),
    ) -> CameraRenderer:
        return CameraRenderer(
            scene,
            modes,
            self._appearance(actors),
            self.health,
            names=names,
            varied=varied,
            dialect=self.dialect,
        )

    def _appearance(self, actors: Sequence[Actor]) -> Appearance:
        return Appearance(quality=self.config.render_quality, classes={actor.name: _kind(actor) for actor in actors})

    def _texts(self, actors: Sequence[Actor]) -> dict[str, str]:
        """Return the handshake's facts about the compiled model."""
        config, appearance = self.config, self._appearance(actors)
        if not any(mode in _SEGMENTATIONS for mode in config.camera_modes.values()):
            appearance = Appearance(quality=appearance.quality)
        varied = {} if config.randomise is None else {MODEL_TEXT: config.randomise.to_json()}
        return varied | appearance.texts()

    def stop(self) -> None:
        """Let go of jobs and uploads, as the server closes."""
        self.jobs.close()
        self.uploads.close()

    def join(self, timeout: float) -> bool:
        """End play permanently; return False if physics is busy for longer than half of `timeout` seconds."""
        return self.play.close(timeout / 2)

    def stop_play(self) -> None:
        """Stop play if it is running."""
        self.play.stop()
        self.world.pie_running = False
        self.drawings.clear(in_play=True)
        trim()


@dataclass(frozen=True)
class _Compiled:
    """A compiled level, and the original options of its model."""

    actors: tuple[Actor, ...]
    scene: CompiledScene
    options: mujoco.MjOption


def _kind(actor: Actor) -> str:
    """Return the label of an actor in a semantic image: its class, or its mesh."""
    mesh = actor.mesh
    return actor.class_name if mesh is None else Path(mesh.file).stem or mesh.shape


def _unmatched_names(scene: CompiledScene, config: ServerConfig) -> Iterator[str]:
    """Yield messages for configured names that match nothing in a scene; most likely they are misspelt."""
    named = [(name, index) for index in scene.articulations for name in (index.actor_id, index.key) if name]
    actors = {name for name, _ in named}
    cameras = {f"{name}/{camera.name}" for name, index in named for camera in index.cameras}
    for what, wanted, kind, known in (
        ("controller", config.controllers.keys() - {"*"}, "articulations", actors),
        ("camera mode", config.camera_modes.keys(), "cameras", cameras),
    ):
        for unknown in sorted(wanted - known):
            listed = ", ".join(sorted(known)) or "none"
            yield f"a {what} is configured for '{unknown}', but the {kind} are {listed}"
