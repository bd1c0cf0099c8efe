"""Contents of the scene from the last handshake: articulations, entities and cameras, looked up by name."""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Iterable, Mapping

from urlab_client.aio.arguments import text
from urlab_client.aio.articulation import Move, URLabArticulation, URLabEntity
from urlab_client.aio.cameras import URLabCameraView
from urlab_client.aio.model.articulation_state import MirroredArticulation, MirroredEntity
from urlab_client.aio.model.mirror import Mirror
from urlab_client.aio.session.session import Session
from urlab_client.aio.state.handshake import Examined
from urlab_client.aio.streams.publishers import Publishers
from urlab_client.enums import CameraMode
from urlab_client.protocol.messages.session import CameraFrame, CameraInfo, HelloOk, StepOk
from urlab_client.values.names import NameMap, UnknownName, unknown_name

log: logging.Logger = logging.getLogger("urlab_client.client")

# Unreal's actor names: class, then a number or a generated id.
_ENGINE_NAME = re.compile(r"(?P<stem>.+)_C_(?:\d+|UAID_\w+)")


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
        """Resolve `<articulation>/<camera>` or just `<camera>` to one of `camera_names`.

        Raises:
            UnknownName: The name matches no camera or several.
        """
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
        """Return the camera named `<articulation>/<camera>` or just `<camera>`.

        Raises:
            KeyError: The name matches no camera or several.
        """
        if name in self.global_cameras:
            return self.global_cameras[name]
        owner, _, short = self.camera_name(name).rpartition("/")
        return self.articulations[owner].cameras[short] if owner else self.global_cameras[short]

    def note_missing_frames(self, requested: Iterable[str], reply: StepOk) -> None:
        """Mark the cameras whose requested frame is missing, because the server omits it without an error."""
        views = [view for view in map(self.camera, requested) if view is not None]
        delivered = {id(self.camera(name)) for name in reply.cameras or {}}
        for view in views:
            if view.delivered and id(view) not in delivered:
                log.warning("camera %s delivered no frame; its latest_frame is older than the state", view.name)
            view.delivered = id(view) in delivered

    def _bind_articulations(self, hello: HelloOk, examined: Examined, *, keep: bool) -> None:
        wrappers: dict[str, URLabArticulation] = {}
        aliases: dict[str, list[str]] = {}
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
            found = _ENGINE_NAME.fullmatch(info.compiled_prefix)
            for alias in {info.actor_id, info.compiled_prefix, found["stem"] if found else ""} - {"", key}:
                aliases.setdefault(alias, []).append(key)
        self.records = {key: self.records[key] for key in wrappers}
        self.articulations = NameMap(wrappers, aliases, kind="articulation")
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
        self.entities = NameMap({**self.articulations, **plain}, kind="entity")

    def _global_camera(self, name: str, info: CameraInfo) -> URLabCameraView:
        view = self.global_cameras.get(name)
        if view is None:
            return URLabCameraView(name, info, self._publishers)
        view.camera.info = info
        return view
