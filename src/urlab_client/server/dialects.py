"""The differences between the wire dialects of the plugin, for a server that speaks one of them. No I/O.

Requests, replies and names have one form inside the server, that of `messages`. A `Dialect` is a table of flags and
functions; code tests the individual flag, never the dialect's name. Clients do not choose a dialect: they follow
`features`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Final, Literal

import msgspec
from msgspec import Struct

from urlab_client.protocol.base import DialectName, Op
from urlab_client.protocol.messages.session import ForwardOk, ResetOk, StepOk
from urlab_client.protocol.messages.streams import StateSnapshot
from urlab_client.protocol.registry import dialect_ops
from urlab_client.values.names import cleaned_name


class _Shape:
    """A reply's fields as one dialect sends them: which, in which order, under which names."""

    def __init__(self, reply: type[Struct], *names: str) -> None:
        info = {found.name: found for found in msgspec.structs.fields(reply)}
        self._names = names
        self._struct = msgspec.defstruct(
            f"{reply.__name__}Shape",
            [(name, info[name].type, None) for name in names],
            tag_field="op",
            tag=str(reply.__struct_config__.tag),
            kw_only=True,
            omit_defaults=True,
        )

    def __call__(self, reply: Any) -> Struct:
        """Return a reply in this shape."""
        return self._struct(**{name: self._value(reply, name) for name in self._names})

    @staticmethod
    def _value(reply: Any, name: str) -> Any:
        if name == "user":
            return reply.user or None  # left out when nothing is declared
        inside = _INSIDE.get(name)
        return getattr(reply, name) if inside is None else getattr(reply, inside) or {}


_INSIDE: Final[Mapping[str, str]] = {"arts": "per_articulation", "scene": "entities"}
_CLOCKS: Final = ("time", "step", "sim_time", "wall_time")


@cache
def _beta_shapes() -> Mapping[str, _Shape]:
    """Return the shapes of the beta by the reply's `op`."""
    return {
        "step_ok": _Shape(StepOk, *_CLOCKS, "frame_id", "arts", "scene", "cameras", "perturbation", "replay"),
        "reset_ok": _Shape(ResetOk, *_CLOCKS, "arts"),
        "forward_ok": _Shape(ForwardOk, *_CLOCKS, "arts"),
        "state_full": _Shape(StateSnapshot, *_CLOCKS, "arts", "scene", "user"),
    }


@cache
def _alpha_shapes() -> Mapping[str, _Shape]:
    return {"state_full": _Shape(StateSnapshot, *_CLOCKS, "per_articulation", "entities", "user")}


@dataclass(frozen=True, kw_only=True)
class Dialect:
    """How one generation of the plugin differs from the others; what it does not do is left out of its table.

    Attributes:
        name: Its name.
        urlab_version: What the handshake says.
        jobs: Ops that take long answer `op_started`.
        claims: Writes to a robot are refused unless the writer owns it.
        cameras_on: Cameras stream from the start of play.
        cameras_repeat: Cameras stream the same state over and over, else each state once.
        camera_headers: Streamed pictures begin with number, time and size.
        camera_forms: Pictures carry `frame_id` and `sim_time` in replies, live steps bring them, and steps can wait.
        qualified_cameras: Cameras are called `<robot>/<camera>`, on topics, too, and under no other name.
        public_names: Robots are called by their actor id where they have one, and `actor_name` tells the object's.
        frame_ids: Steps are numbered by `frame_id`.
        steps_published: State is published in every step mode, else in live mode only.
        rows_published: Single joints, sensors and so on are published.
        live_commands: A live step applies all of its commands.
        late_steps: A direct step that timed out before it began is done all the same.
        level_sticks: The observation level of a step holds for later replies, too.
        auto_mode: `auto` is a step mode beside live, else another name of it.
        controls_float32: Set-points are rounded to single precision.
        options_float32: Options are kept in single precision and keywords in lower case.
        options_merged: The `<option>` of every imported robot reaches the scene.
        robots_attached: The XML of the handshake attaches a document for each robot, else it is one flat model.
        instance: The handshake says which of several servers this is, and its own shared-memory regions.
        actor_names: How robots are named unless the server is told: after their model, or as the plugin does.
        first_camera_port: Default port of the first camera.
        shapes: What replies look like, by their `op`, where that is not how `messages` declares them.
    """

    name: DialectName
    urlab_version: str
    jobs: bool = False
    claims: bool = False
    cameras_on: bool = False
    cameras_repeat: bool = False
    camera_headers: bool = False
    camera_forms: bool = False
    qualified_cameras: bool = False
    public_names: bool = False
    frame_ids: bool = False
    steps_published: bool = False
    rows_published: bool = False
    live_commands: bool = False
    late_steps: bool = False
    level_sticks: bool = False
    auto_mode: bool = False
    controls_float32: bool = False
    options_float32: bool = False
    options_merged: bool = False
    robots_attached: bool = False
    instance: bool = False
    actor_names: Literal["model", "plugin"] = "model"
    first_camera_port: int
    shapes: Callable[[], Mapping[str, Callable[[Any], Struct]]] = field(default=_alpha_shapes)

    @property
    def ops(self) -> Mapping[str, Op]:
        """The ops it has, by name."""
        return dialect_ops(self.name)

    def shaped(self, reply: Struct) -> Struct:
        """Return what to encode for a reply."""
        shape = self.shapes().get(str(reply.__struct_config__.tag))
        return reply if shape is None else shape(reply)

    def robot_key(self, actor_id: str, object_name: str) -> str:
        """Return what a robot is called in requests and replies."""
        return cleaned_name(actor_id) if self.public_names and actor_id else object_name

    def camera_key(self, robot: str, camera: str) -> str:
        """Return what a camera is called in requests and replies, from the robot's key and its own name."""
        return f"{robot}/{self.camera_part(camera)}" if self.qualified_cameras else camera

    def camera_part(self, camera: str) -> str:
        """Return what stands for a camera behind its robot's key and a slash."""
        return cleaned_name(camera) if self.qualified_cameras else camera

    def camera_topic(self, robot: str, camera: str) -> str:
        """Return the topic of a camera's stream, without the space that messages carry behind it."""
        return self.camera_key(robot, camera) if self.qualified_cameras else f"{robot}/camera/{camera}"


ALPHA: Final = Dialect(
    name="alpha",
    urlab_version="urlab/0.1",
    cameras_on=True,
    cameras_repeat=True,
    steps_published=True,
    rows_published=True,
    late_steps=True,
    level_sticks=True,
    auto_mode=True,
    controls_float32=True,
    options_float32=True,
    first_camera_port=5558,
)
"""The plugin's main branch of June 2026."""

BETA: Final = Dialect(
    name="beta",
    urlab_version="urlab/0.2",
    jobs=True,
    claims=True,
    camera_headers=True,
    camera_forms=True,
    qualified_cameras=True,
    public_names=True,
    frame_ids=True,
    live_commands=True,
    options_merged=True,
    robots_attached=True,
    instance=True,
    actor_names="plugin",
    first_camera_port=5561,
    shapes=_beta_shapes,
)
"""0.6.0-beta of August 2026 and the main branch of that age."""

DIALECTS: Final[Mapping[DialectName, Dialect]] = {dialect.name: dialect for dialect in (ALPHA, BETA)}
"""Every dialect by its name."""
