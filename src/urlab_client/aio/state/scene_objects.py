"""Contents of the scene from the last handshake: articulations, entities and cameras, looked up by name.

Ids, offsets, sizes and names from a handshake index MuJoCo's and NumPy's memory for the whole session, so `examine`
checks each of them against the model once, before any part of the handshake is applied.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from msgspec import Struct

from urlab_client._mujoco import model_names
from urlab_client.aio.controllers import check_controller
from urlab_client.aio.model.layout import FREE, ArticulationLayout, articulation_layouts
from urlab_client.errors import ProtocolError
from urlab_client.protocol.messages.session import CameraInfo, EntityInfo, HelloOk
from urlab_client.values.names import owner_of
from urlab_client.values.pictures import check_picture_size

if TYPE_CHECKING:
    import mujoco

import logging
from collections import Counter
from collections.abc import Iterable

from urlab_client.aio.arguments import text
from urlab_client.aio.articulation import Move, URLabArticulation, URLabEntity
from urlab_client.aio.cameras import URLabCameraView
from urlab_client.aio.model.articulation_state import MirroredArticulation, MirroredEntity
from urlab_client.aio.model.mirror import Mirror
from urlab_client.aio.session.session import Session
from urlab_client.aio.streams.publishers import Publishers
from urlab_client.enums import CameraMode
from urlab_client.protocol.messages.session import CameraFrame, StepOk
from urlab_client.values.names import NameMap, UnknownName, robot_prefixes, unknown_name

log: logging.Logger = logging.getLogger("urlab_client.client")


class SceneObjects:
    """Articulations, entities and cameras. Users keep these objects, so a later handshake rebinds the same ones.

    Attributes:
        articulations: Articulations by key.
        articulations_by_id: Articulations that have an actor id, by that id.
        entities: Every dynamic body by name, articulations included.
        global_cameras: Scene-level cameras.
        records: Mirrored state of the articulations, by key.
        entity_records: Mirrored state of the plain entities, by name.
        move: Moves the joints of an articulation; set by the client.
    """

    move: Move

    def __init__(self, session: Session, publishers: Publishers, mirror: Mirror) -> None:
        self.articulations: NameMap[URLabArticulation] = NameMap(kind="articulation")
        self.articulations_by_id: dict[str, URLabArticulation] = {}
        self.entities: NameMap[URLabEntity] = NameMap(kind="entity")
        self.global_cameras: NameMap[URLabCameraView] = NameMap(kind="camera")
        self.records: dict[str, MirroredArticulation] = {}
        self.entity_records: dict[str, MirroredEntity] = {}
        self._session = session
        self._publishers = publishers
        self._mirror = mirror

    def bind(self, hello: HelloOk, examined: Examined, *, keep: bool) -> None:
        """Adopt the contents of a handshake; `keep` says whether the known state is also that of its world."""
        self._bind_articulations(hello, examined, keep=keep)
        self._bind_entities(examined, keep=keep)
        cameras = hello.global_cameras or {}
        self.global_cameras = NameMap({n: self._global_camera(n, info) for n, info in cameras.items()}, kind="camera")

    def views(self) -> list[URLabCameraView]:
        """Return all cameras, bound to their descriptions in the handshake."""
        own = [view for art in self.articulations.values() for view in art.cameras.values()]
        return [*own, *self.global_cameras.values()]

    def announced_camera(self, name: str, frame: CameraFrame) -> URLabCameraView | None:
        """Return a view of a scene camera that only its picture announced, or None if there are no such cameras."""
        if not self.hidden_cameras:
            return None
        mode = CameraMode.DEPTH if frame.dtype == "float32" else CameraMode.REAL
        info = CameraInfo(mode=mode, resolution=(frame.width, frame.height), fovy=0.0, zmq_endpoint="", zmq_topic=name)
        view = URLabCameraView(name, info, self._publishers)
        self.global_cameras = NameMap({**self.global_cameras, name: view}, kind="camera")
        return view

    def camera_names(self) -> list[str]:
        """Return a unique name of each camera: `<articulation>/<camera>`, or the name of a scene camera."""
        own = [f"{art.prefix}/{name}" for art in self.articulations.values() for name in art.cameras]
        return [*own, *self.global_cameras]

    def shown_cameras(self, names: Iterable[str]) -> dict[str, str]:
        """Map names from `camera_names` to the names shown to users: the bare name where it is unique."""
        short = {name: name.rpartition("/")[2] for name in names}
        counts = Counter(short.values())
        return {name: bare if counts[bare] == 1 else name for name, bare in short.items()}

    def camera_name(self, name: str) -> str:
        """Resolve `<articulation>/<camera>` or just `<camera>` to one of `camera_names`. Raises `UnknownName`."""
        names = self.camera_names()
        owner, slash, short = text("camera", name).rpartition("/")
        if slash:
            art = self.articulations.get(owner)
            found = [f"{art.prefix}/{short}"] if art is not None and short in art.cameras else []
        else:
            found = [known for known in names if known == name or known.endswith(f"/{name}")]
        if not found:
            raise unknown_name("camera", name, names)
        if len(found) > 1:
            raise UnknownName("camera", name, tuple(found), tuple(names), ())
        return found[0]

    def with_cameras(
        self, asked: bool | dict[str, str | None], more: Mapping[str, str]
    ) -> bool | dict[str, str | None]:
        """Return the pictures to request with a step: those that the caller requested, plus existing ones of `more`."""
        if asked is True:
            return True
        chosen = dict(asked or {})
        known = {id(self.camera(name)) for name in chosen} | {id(None)}
        chosen |= {name: how for name, how in more.items() if id(self.camera(name)) not in known}
        return chosen or False

    @property
    def hidden_cameras(self) -> bool:
        """Whether the scene may have cameras that are missing from the handshake."""
        return any("/" in name for record in self.records.values() for name in record.info.camera_topics)

    def camera(self, name: str) -> URLabCameraView | None:
        """Return the camera named `<articulation>/<camera>` or just `<camera>`, or None."""
        try:
            return self.require_camera(name)
        except KeyError:
            return None

    def require_camera(self, name: str) -> URLabCameraView:
        """Return the camera named `<articulation>/<camera>` or just `<camera>`. Raises `UnknownName`."""
        if text("camera: name", name) in self.global_cameras:
            return self.global_cameras[name]
        owner, _, short = self.camera_name(name).rpartition("/")
        return self.articulations[owner].cameras[short]

    def note_missing_frames(self, requested: Iterable[str], reply: StepOk) -> None:
        """Mark the cameras whose requested frame is missing, because the server omits it without an error."""
        views = [view for view in map(self.camera, requested) if view is not None]
        delivered = {id(self.camera(name)) for name in reply.cameras or {}}
        for view in views:
            if view.delivered and id(view) not in delivered:
                log.warning("camera %s delivered no frame; its latest_frame is older than the state", view.name)
            view.pictures.delivered = id(view) in delivered

    def _bind_articulations(self, hello: HelloOk, examined: Examined, *, keep: bool) -> None:
        wrappers: dict[str, URLabArticulation] = {}
        self._mirror.prefixes = examined.prefixes
        for info in hello.articulations:
            key = info.prefix
            layout = examined.layouts[key]
            record = self.records.get(key)
            if record is None:
                record = self.records[key] = MirroredArticulation(self._mirror, info, layout)
            else:
                record.bind(info, layout, keep=keep)
            wrappers[key] = self.articulations.get(key) or URLabArticulation(
                record, self._session, self._publishers, self.move
            )
        self.records = {key: self.records[key] for key in wrappers}
        self.articulations = examined.prefixes.over(wrappers)
        self.articulations_by_id = {art.actor_id: art for art in wrappers.values() if art.actor_id}

    def _bind_entities(self, examined: Examined, *, keep: bool) -> None:
        plain: dict[str, URLabEntity] = {}
        records: dict[str, MirroredEntity] = {}
        for name, info in examined.entities.items():
            record = self.entity_records.get(name) or MirroredEntity(self._mirror, name)
            record.bind_entity(info, keep=keep)
            records[name] = record
            known = self.entities.get(name)
            plain[name] = known if known is not None and type(known) is URLabEntity else URLabEntity(record)
        self.entity_records = records
        self.entities = NameMap({**self.articulations, **plain}, self.articulations.aliases, kind="entity")

    def _global_camera(self, name: str, info: CameraInfo) -> URLabCameraView:
        view = self.global_cameras.get(name)
        if view is None:
            return URLabCameraView(name, info, self._publishers)
        view.camera.info = info
        return view


_LAST_PORT = 65535


class Examined(Struct, frozen=True):
    """The result of checking a handshake against its model.

    Attributes:
        prefixes: What the compiled names of each articulation's elements begin with, by key.
        layouts: Layout of each articulation's values, by key; empty layouts without a model.
        entities: Plain entities by name.
    """

    prefixes: NameMap[str]
    layouts: Mapping[str, ArticulationLayout]
    entities: Mapping[str, EntityInfo]


def examine(hello: HelloOk, model: mujoco.MjModel | None) -> Examined:
    """Check a handshake against its model and derive the layouts and entities. Raises `ProtocolError`."""
    keys = [info.prefix for info in hello.articulations]
    if "" in keys or len(set(keys)) < len(keys):
        raise _refused(f"its articulations are called {', '.join(map(repr, keys))}; keys must be unique and not empty")
    if hello.instance is not None and not 0 <= hello.instance.state_port <= _LAST_PORT:
        raise _refused(f"its state stream is on port {hello.instance.state_port}, which is not a valid port")
    for info in hello.articulations:
        _check_cameras(f"articulation {info.prefix!r}", info.camera_topics)
        if info.controller is not None:
            check_controller(info.prefix, info.controller)
    _check_cameras("the scene", hello.global_cameras or {})
    entities = hello.plain_entities
    for name, entity in entities.items():
        _check_entity(name, entity, model)
    prefixes = robot_prefixes((info.prefix, info.actor_id, info.compiled_prefix) for info in hello.articulations)
    if model is None:
        return Examined(prefixes, {key: ArticulationLayout() for key in keys}, entities)
    try:
        layouts = articulation_layouts(model, prefixes)
        return Examined(prefixes, layouts, entities or entities_of(model, frozenset(prefixes.values())))
    except UnicodeDecodeError as error:
        raise _refused(f"a name in its model is not text: {error}") from error


def _refused(problem: str) -> ProtocolError:
    return ProtocolError(f"hello: {problem}.", op="hello")


def _check_cameras(owner: str, cameras: Mapping[str, CameraInfo]) -> None:
    for name, info in cameras.items():
        try:
            check_picture_size(*info.resolution)
        except ValueError as error:
            raise _refused(f"camera {name!r} of {owner}: {error}") from None


def _check_entity(name: str, info: EntityInfo, model: mujoco.MjModel | None) -> None:
    reported = (info.free_joint_id, info.qpos_offset, info.qvel_offset)
    if model is None:
        if info.id < 1 or any(number is not None and number < 0 for number in reported):
            raise _refused(f"entity {name!r} has the invalid body {info.id} or joint and offsets {reported}")
        return
    if not 0 < info.id < model.nbody:
        raise _refused(f"entity {name!r} is body {info.id}, but the bodies of its model are 1 to {model.nbody - 1}")
    joint = int(model.body_jntadr[info.id])
    free = joint >= 0 and model.jnt_type[joint] == FREE
    if free != info.has_free_base:
        raise _refused(f"entity {name!r} has {'a' if info.has_free_base else 'no'} free base, unlike its model")
    places = (joint, int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])) if free else (None, None, None)
    if any(number not in (None, place) for number, place in zip(reported, places, strict=True)):
        raise _refused(f"entity {name!r} has joint and offsets {reported}, but in its model they are {places}")


def entities_of(model: mujoco.MjModel, keys: frozenset[str]) -> dict[str, EntityInfo]:
    """Find the dynamic bodies outside articulations in the model, because the plugin does not list them."""
    bodies, joints = model_names(model, "body"), model_names(model, "joint")
    found: dict[str, EntityInfo] = {}
    for body_id, name in enumerate(bodies):
        if body_id == 0 or not name or owner_of(name, keys) is not None:
            continue
        joint = int(model.body_jntadr[body_id])
        if joint >= 0 and model.jnt_type[joint] == FREE:
            found[name] = EntityInfo(
                id=body_id,
                has_free_base=True,
                free_joint=joints[joint] or None,
                free_joint_id=joint,
                qpos_offset=int(model.jnt_qposadr[joint]),
                qvel_offset=int(model.jnt_dofadr[joint]),
            )
        elif model.body_mocapid[body_id] >= 0:
            found[name] = EntityInfo(id=body_id, has_free_base=False)
    return found
