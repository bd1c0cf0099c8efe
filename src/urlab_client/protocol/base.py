"""Vocabulary of the op declarations: `Request`, `Reply`, `Op` and the field types they share.

For modules that declare ops (`messages/*`) or derive something from the declarations. No I/O.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from typing import Annotated, Any, Final, Generic, Literal, TypeAlias, TypeVar

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from urlab_client.values.plain import Serializable
from urlab_client.values.rotation import Quat, Vec3

Floats: TypeAlias = NDArray[np.float64]
"""A vector of numbers on the wire; here an array of shape `(n,)`."""


DialectName: TypeAlias = Literal["alpha", "beta"]
"""The supported wire dialects of the plugin; see `server.dialects`."""


INT32_MIN: Final = -(2**31)
INT32_MAX: Final = 2**31 - 1

Int32: TypeAlias = Annotated[int, Meta(ge=INT32_MIN, le=INT32_MAX)]
"""An integer of a request that the server decodes directly: the plugin reads one beyond 32 bits as absent."""


def doc(text: str) -> Meta:
    """Describe a field: `percent: Annotated[float, doc("Percent of real time.")]`."""
    return Meta(description=text)


Location: TypeAlias = Annotated[Vec3, doc("Position in the world frame, metres.")]
QuatXYZW: TypeAlias = Annotated[Quat, doc("Rotation in MuJoCo's world frame, unit quaternion (x, y, z, w).")]
QuatWXYZ: TypeAlias = Annotated[Quat, doc("Unit quaternion (w, x, y, z), world frame.")]
EulerDeg: TypeAlias = Annotated[Vec3, doc("Rotation (roll, pitch, yaw) in degrees, Unreal's rotator convention.")]
Color: TypeAlias = Annotated[Vec3, doc("Red, green, blue in [0, 1].")]
ActorId: TypeAlias = Annotated[str, doc("Stable id given by the client; empty when none.")]
ActorTarget: TypeAlias = Annotated[str, doc("Actor id, or the engine's actor name with `by_name`.")]
TargetBy: TypeAlias = Annotated[
    Literal["actor_id", "actor_name"], doc("Look `target` up by the engine's actor name instead of the actor id.")
]
RequiresPieRestart: TypeAlias = Annotated[
    bool, doc("True while a play session runs: the edit shows after the next start.")
]


class Reply(Serializable, Struct, tag_field="op", kw_only=True):
    """A successful answer; the tag is its `op` on the wire."""


R_co = TypeVar("R_co", bound=Reply, covariant=True)


class Request(Struct, Generic[R_co], tag_field="op", kw_only=True, omit_defaults=True):
    """A request whose reply is an `R_co`. The session sets `session_id` when it sends the request."""

    session_id: Annotated[str, doc("Session id from the latest `hello_ok`.")] = ""


class ControlRequest(Request[R_co], Generic[R_co], kw_only=True):
    """A request that writes to a robot. Some servers accept it only from the robot's owner."""

    control_owner: Annotated[
        str | None, doc("Name of the client that writes; absent stands for the session. Not known to the alpha.")
    ] = None


EDITOR_TIMEOUT_S: Final = 30.0
"""Timeout of an editor op, seconds: it waits for the game thread, which level or mesh work can occupy for long."""


class Needs(StrEnum):
    """What must be running on the server for an op; the op's category on the wire."""

    NOTHING = "no_manager"
    EDITOR = "editor_only"
    MANAGER = "manager_required"


class Effect(StrEnum):
    """What the caller may assume if the reply to an op is lost."""

    READ = "read"
    """Changes nothing, so it may be sent again."""
    WRITE = "write"
    """May have been executed, so it is never sent again automatically."""


@dataclass(frozen=True, kw_only=True, eq=False)  # each op is a single object
class Op:
    """The declaration of an op, from which everything else is derived.

    Attributes:
        request: The request struct; its tag is the name of the op.
        ns: Namespace on the client (`scene`, …); empty for ops of the client itself.
        method: Name of the client's method; by default the op's name, without the namespace in front of it.
        needs: What must be running.
        effect: Whether it may be sent again after a lost reply.
        timeout: Minimum time to wait for the reply, seconds; None for the client's default.
        hot: Built by the client itself at kilohertz rates or with megabytes of data: sent without checking the struct's
            field types again, and decoded by the server directly. The struct, and those in it, forbid unknown fields.
        infinite: Request fields whose numbers may be infinite; all others are finite.
        errors: Error codes of the op, in addition to those of every request.
        generated: Whether `tools/gen_ops.py` writes the client's method. Methods of ops that mirror state or create
            handles are written by hand.
        returns: For a generated method: name of the reply field to return, a class to fill from the reply's fields
            of the same names, or None.
        positional: For a generated method: number of leading positional parameters.
        undeclared: Required fields that only the op's handler checks and `meta` does not list.
        declares: Reply fields as `meta` lists them, if the plugin's list differs from what it sends.
        dialects: Dialects that have the op.
        job: Whether the beta answers with `op_started` and delivers the reply through `op_status`.
    """

    request: type[Request[Any]]
    ns: str = ""
    method: str = ""
    needs: Needs = Needs.EDITOR
    effect: Effect = Effect.WRITE
    timeout: float | None = None
    hot: bool = False
    infinite: tuple[str, ...] = ()
    errors: tuple[str, ...] = ()
    generated: bool = False
    returns: str | type[Struct] | None = None
    positional: int = 0
    undeclared: tuple[str, ...] = ()
    declares: tuple[str, ...] | None = None
    dialects: tuple[DialectName, ...] = ("alpha", "beta")
    job: bool = False
    name: str = field(init=False)
    reply: type[Any] = field(init=False)  # a `Reply`; which one, only the request's type can tell a type checker

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", str(self.request.__struct_config__.tag))
        object.__setattr__(self, "reply", _reply_type(self.request))
        if not self.method:
            object.__setattr__(self, "method", self.name.removeprefix(f"{self.ns}_"))

    @cached_property
    def reply_name(self) -> str:
        """`op` of the successful reply. Not always the op's name plus `_ok`: see `set_viewport_mode`."""
        return str(self.reply.__struct_config__.tag)

    @cached_property
    def required(self) -> tuple[str, ...]:
        """Wire names of the request fields that have no default, in order of declaration."""
        return tuple(f.encode_name for f in msgspec.structs.fields(self.request) if f.required)

    @cached_property
    def declared_required(self) -> tuple[str, ...]:
        """The required fields that `meta` lists and the dispatcher checks."""
        return tuple(name for name in self.required if name not in self.undeclared)

    @cached_property
    def declared_reply(self) -> tuple[str, ...]:
        """Reply fields as `meta` lists them, `name:type` with `?` for optional ones."""
        if self.declares is not None:
            return self.declares
        fields = (f"{f.encode_name}:{_meta_type(f.type)}{'' if f.required else '?'}" for f in _fields(self.reply))
        return ("op:string", *fields)


def _fields(struct: type[Struct]) -> tuple[msgspec.structs.FieldInfo, ...]:
    return msgspec.structs.fields(struct)


def _reply_type(request: type[Request[Any]]) -> type[Reply]:
    for base in getattr(request, "__orig_bases__", ()):
        for argument in getattr(base, "__args__", ()):
            if isinstance(argument, type) and issubclass(argument, Reply):
                return argument
    raise TypeError(f"{request.__name__} must derive from Request[SomeReply]")


def _meta_type(annotation: Any) -> str:
    info = msgspec.inspect.type_info(annotation)
    info = _bare(info)
    if isinstance(info, msgspec.inspect.UnionType):
        members = (_bare(member) for member in info.types)
        info = next(member for member in members if not isinstance(member, msgspec.inspect.NoneType))
    for kinds, name in _META_TYPES.items():
        if isinstance(info, kinds):
            return name
    raise TypeError(f"meta has no name for {annotation!r}")


def _bare(info: msgspec.inspect.Type) -> msgspec.inspect.Type:
    return info.type if isinstance(info, msgspec.inspect.Metadata) else info


_META_TYPES: Mapping[tuple[type, ...], str] = {
    (msgspec.inspect.StrType, msgspec.inspect.EnumType, msgspec.inspect.LiteralType): "string",
    (msgspec.inspect.BoolType,): "bool",
    (msgspec.inspect.IntType,): "int",
    (msgspec.inspect.FloatType,): "float",
    (msgspec.inspect.ListType, msgspec.inspect.TupleType, msgspec.inspect.VarTupleType): "array",
    (msgspec.inspect.CustomType,): "array",
    (msgspec.inspect.StructType, msgspec.inspect.DictType): "object",
}
