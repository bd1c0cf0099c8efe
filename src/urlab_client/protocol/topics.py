"""Topics of the publish/subscribe sockets: what a message carries, how to subscribe, where to connect."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

from msgspec import Struct

from urlab_client.enums import Word
from urlab_client.errors import ProtocolError
from urlab_client.values.layouts import BytesLike


class TopicKind(Word):
    """What a topic carries; the value is the topic's fixed part."""

    JOINT = "joint"
    BASE_STATE = "base_state"
    SENSOR = "sensor"
    TWIST = "twist"
    ACTIONS = "actions"
    CONTROL = "control"
    SET_GAINS = "set_gains"
    CAMERA = "camera"
    XPOS = "xpos"
    XQUAT = "xquat"
    QPOS = "qpos"
    QVEL = "qvel"
    STATE_FULL = "state/full"


STATE_FULL = b"state/full"
"""Topic of the msgpack snapshot that closes each tick."""

_SCENE = "scene"
SCENE_SIZES = {TopicKind.XPOS: 3, TopicKind.XQUAT: 4, TopicKind.QPOS: 7, TopicKind.QVEL: 6}
_OF_COMPONENT = frozenset({TopicKind.JOINT, TopicKind.BASE_STATE, TopicKind.SENSOR, TopicKind.CAMERA})
_OF_ARTICULATION = frozenset({TopicKind.TWIST, TopicKind.ACTIONS, TopicKind.CONTROL, TopicKind.SET_GAINS})
_SPACED = frozenset({TopicKind.CONTROL, TopicKind.SET_GAINS, TopicKind.CAMERA})
_COMPONENT_KINDS: Mapping[str, TopicKind] = {kind.value: kind for kind in _OF_COMPONENT}
_ARTICULATION_KINDS: Mapping[str, TopicKind] = {kind.value: kind for kind in _OF_ARTICULATION}
_SCENE_KINDS: Mapping[str, TopicKind] = {kind.value: kind for kind in SCENE_SIZES}


class StreamTopic(Struct, frozen=True):
    """Address of a message on the publish/subscribe sockets.

    An articulation may itself be called `scene`; a topic that reads as `scene/<entity>/xpos` (or `xquat`, `qpos`,
    `qvel`) is always a scene row.

    Attributes:
        kind: What the message carries.
        owner: Articulation key, or the entity of a scene row; empty for `state/full`.
        name: Component name for joint, base state, sensor and camera topics, else empty. Here, as in the name of an
            entity, `/` is part of the name: models made of attached parts have such names.
    """

    kind: TopicKind
    owner: str = ""
    name: str = ""

    def __str__(self) -> str:
        if self.kind is TopicKind.STATE_FULL:
            return self.kind.value
        if self.kind in SCENE_SIZES:
            return f"{_SCENE}/{self.owner}/{self.kind}"
        text = f"{self.owner}/{self.kind}/{self.name}" if self.name else f"{self.owner}/{self.kind}"
        return f"{text} " if self.kind in _SPACED else text

    def encode(self) -> bytes:
        """Return the topic frame, with the trailing space that control, gains and camera topics carry.

        Raises:
            ValueError: If a name is missing, superfluous or ends in a space, or an articulation key contains `/`.
        """
        if bool(self.owner) == (self.kind is TopicKind.STATE_FULL):
            raise ValueError(f"a {self.kind} topic needs {'no owner' if self.owner else 'an owner'}")
        if bool(self.name) != (self.kind in _OF_COMPONENT):
            raise ValueError(f"a {self.kind} topic needs {'no name' if self.name else 'a component name'}")
        if self.kind not in SCENE_SIZES:
            _check_key(self.owner)
        for name in (self.owner, self.name):
            if name.endswith(" "):
                raise ValueError(f"{name!r} cannot stand in a topic: it ends in a space")
        return str(self).encode()

    @staticmethod
    def parse(frame: BytesLike) -> StreamTopic:
        """Read a topic frame.

        Raises:
            ProtocolError: If it is not one of the wire's topics, including a missing or extra trailing space.
        """
        return _parse_topic(bytes(frame))


def _check_key(key: str) -> None:
    if "/" in key:
        raise ValueError(f"articulation key {key!r} cannot stand in a topic: it contains '/'")


# A stream repeats a few hundred topics for ever.
@lru_cache(maxsize=4096)
def _parse_topic(frame: bytes) -> StreamTopic:
    if frame == STATE_FULL:
        return StreamTopic(TopicKind.STATE_FULL)
    try:
        text = frame.decode()
    except UnicodeDecodeError as exc:
        raise ProtocolError(f"topic {frame[:64]!r}: not UTF-8 text.", raw=frame) from exc
    topic = _split_topic(text.removesuffix(" "))
    if topic is None:
        problem = "expected <articulation>/<kind>[/<component>], scene/<entity>/<quantity> or state/full"
        raise ProtocolError(f"topic {text[:64]!r}: {problem}.", raw=frame)
    if text.endswith(" ") != (topic.kind in _SPACED):
        problem = "must end in one space" if topic.kind in _SPACED else "must not end in a space"
        raise ProtocolError(f"topic {text[:64]!r}: a {topic.kind} topic {problem}.", raw=frame)
    if topic.owner.endswith(" ") or topic.name.endswith(" "):
        raise ProtocolError(f"topic {text[:64]!r}: a name ends in a space.", raw=frame)
    return topic


def _split_topic(text: str) -> StreamTopic | None:
    head, _, quantity = text.rpartition("/")
    entity = head.removeprefix(f"{_SCENE}/")
    if quantity in _SCENE_KINDS and entity and entity != head:
        return StreamTopic(_SCENE_KINDS[quantity], entity)
    match text.split("/", 2):
        case [owner, kind] if owner and kind in _ARTICULATION_KINDS:
            return StreamTopic(_ARTICULATION_KINDS[kind], owner)
        case [owner, kind, name] if owner and name and kind in _COMPONENT_KINDS:
            return StreamTopic(_COMPONENT_KINDS[kind], owner, name)
        case _:
            return None


def articulation_filter(key: str, kind: TopicKind | None = None) -> bytes:
    """Return the subscription for all topics of one articulation, or for those of one kind.

    ZMQ matches by prefix. These filters end where a name ends, so `g1` does not bring in `g10`. A filter for a single
    joint or sensor row cannot be exact (`g1/joint/knee` also brings in `knee2`): compare the whole topic on receipt.

    Raises:
        ValueError: If `key` cannot stand in a topic, or `kind` is not one that belongs to an articulation.
    """
    _check_key(key)
    if not key:
        raise ValueError("an articulation key is never empty")
    if kind is None:
        return f"{key}/".encode()
    if kind in _OF_COMPONENT:
        return f"{key}/{kind}/".encode()
    if kind in _OF_ARTICULATION:
        return StreamTopic(kind, key).encode()
    raise ValueError(f"an articulation has no {kind} topic")


def scene_filter(entity: str = "") -> bytes:
    """Return the subscription for the scene rows of one entity, or of all."""
    return f"{_SCENE}/{entity}/".encode() if entity else f"{_SCENE}/".encode()


def camera_filter(zmq_topic: str) -> bytes:
    """Return the subscription for one camera from the `zmq_topic` of the handshake.

    That string lacks the trailing space which the published topic has; without it `wrist` also brings in `wrist2`.
    """
    return f"{zmq_topic.removesuffix(' ')} ".encode()


_UNSPECIFIED_HOSTS = frozenset({"", "*", "0.0.0.0", "::", "[::]"})  # noqa: S104  (recognised, never bound)


def resolve_endpoint(endpoint: str, host: str) -> str:
    """Return an endpoint to connect to, from one that may be in bind form.

    Args:
        endpoint: As the server reports it, for example `tcp://0.0.0.0:5558`.
        host: Name or address under which the server was reached; takes the place of an unspecified host.

    Raises:
        ProtocolError: If a TCP endpoint has no usable port, or there is no scheme.
        ValueError: If `host` is itself unspecified.
    """
    if host in _UNSPECIFIED_HOSTS:
        raise ValueError(f"host {host!r} is not an address to connect to")
    scheme, separator, address = endpoint.partition("://")
    if not separator:
        raise ProtocolError(f"endpoint {endpoint!r}: no scheme, expected tcp://HOST:PORT.")
    if scheme != "tcp":
        return endpoint
    bound, colon, port = address.rpartition(":")
    if not (colon and port.isascii() and port.isdigit() and 0 < int(port) < 65536):
        raise ProtocolError(f"endpoint {endpoint!r}: no port in 1..65535, expected tcp://HOST:PORT.")
    if bound not in _UNSPECIFIED_HOSTS:
        return endpoint
    return f"tcp://[{host}]:{port}" if ":" in host and not host.startswith("[") else f"tcp://{host}:{port}"
