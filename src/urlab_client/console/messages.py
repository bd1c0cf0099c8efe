"""Messages to and from viewers: one declaration each, from which the AsyncAPI document is also generated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, TypeAlias, cast

import msgspec
import numpy as np
from msgspec import Meta, Struct

from urlab_client.console.description import WorldDescription
from urlab_client.enums import StepMode
from urlab_client.protocol.messages.streams import StateSnapshot

Numbers: TypeAlias = list[float | None]
"""Numbers with five digits; null for a number that is not finite."""


class Link(Struct):
    """The connection to the server: `connecting`, `connected`, `lost`, `silent` or `taken_over`, and why.

    `since` is when this began, Unix time in seconds: without contact, when the server was last in contact.
    """

    state: str
    reason: str = ""
    since: float = 0.0


class LogEntry(Struct):
    """One line of the log. `kind` is `call`, `error` or `event`; `at` is Unix time in seconds."""

    n: int
    at: float
    kind: str
    who: str
    what: str
    text: str
    ms: float | None = None


class You(Struct, tag_field="type", tag="you"):
    """The first message: `viewer` is the value for the header `X-URLab-Viewer`, `name` is shown to other viewers."""

    viewer: str
    name: str


class World(Struct, tag_field="type", tag="world"):
    """The description of the world: sent first, and whenever it changes."""

    world: WorldDescription


class ArticulationSample(Struct):
    """One robot: positions, velocities, controls, sensor readings, and the set-points that viewers commanded."""

    qpos: Numbers
    qvel: Numbers
    ctrl: Numbers | None
    sensors: dict[str, Numbers | None]
    targets: Sequence[float | None] | None


class EntitySample(Struct):
    """One body: its position in the world frame, metres."""

    xpos: Numbers


class State(Struct, tag_field="type", tag="state"):
    """The newest state, at most 60 per second. `time` is simulation time in seconds, `made` Unix time in ms.

    If `recorded` is true, the state is part of the replayed recording, and `time` is on that recording's clock.
    """

    seq: int
    time: float
    step: int
    made: float
    articulations: dict[str, ArticulationSample]
    entities: dict[str, EntitySample]
    recorded: bool = False


class StateList(Struct):
    """States, oldest first."""

    states: list[State]


class RunningRecording(Struct):
    """The recording that is under way: its file's name, length so far in seconds of its clock, states, pictures, bytes.

    `failed` says that it can no longer be written.
    """

    name: str
    seconds: float
    states: int
    pictures: int
    bytes: int
    failed: bool


class Conversion(Struct):
    """A recording that is being converted for download, and how much of it has been read, 0 to 1."""

    name: str
    kind: str
    camera: str
    share: float = 0.0


class ReplayView(Struct):
    """Position of a replay, in seconds of the recording's clock. `placing`: whether the simulation's robots follow.

    `alone`: whether there is no simulation besides. `cameras` lists the cameras whose recorded pictures are shown, as
    `ARTICULATION/CAMERA` or `-/CAMERA`. `damage`: why the file ends early, if it does.
    """

    name: str
    time: float
    seconds: float
    playing: bool
    rate: float
    placing: bool
    alone: bool
    cameras: list[str]
    damage: str


class Status(Struct, tag_field="type", tag="status"):
    """Connection, play, time, recording, replay and driver, from one viewer's view; sent whenever it changes.

    `rate` is simulation time relative to real time, `mode_chosen` whether a viewer has chosen the mode, `speed` the
    pacing of live mode in percent, `holding` the robots that hold their home pose, `mine` whether this viewer drives,
    and `lease_left` for how many seconds the driver keeps the controls without using them.
    """

    link: Link
    address: str
    playing: bool
    moving: bool
    running: bool
    rate: float
    mode: StepMode
    mode_chosen: bool
    speed: float | None
    source: str | None
    recording: RunningRecording | None
    conversions: list[Conversion]
    replay: ReplayView | None
    twists: dict[str, tuple[float, float, float]]
    holding: list[str]
    viewers: int
    driver: str | None
    mine: bool
    lease_left: float
    lease: float


class Log(Struct, tag_field="type", tag="log"):
    """New entries of the log, newest last."""

    entries: list[LogEntry]


class Refused(Struct, tag_field="type", tag="refused"):
    """A message was refused: `code`, `message` and `hint`, as in HTTP responses."""

    error: dict[str, Any]


class Pong(Struct, tag_field="type", tag="pong"):
    """The reply to `ping`: its `at`, and the console's Unix time in ms."""

    at: float
    now: float


class Ack(Struct, tag_field="type", tag="ack"):
    """A state was shown. At most two states are sent without an acknowledgement."""


class Ping(Struct, tag_field="type", tag="ping"):
    """Asks for a `pong`, to compare clocks."""

    at: float = 0.0


class Name(Struct, tag_field="type", tag="name"):
    """The name that other viewers see."""

    name: str = ""


class Ctrl(Struct, tag_field="type", tag="ctrl"):
    """Set-points by articulation and actuator. Requires the controls."""

    values: Annotated[dict[str, dict[str, float]], Meta(description="Articulation to actuator to set-point.")] = {}


class Hand(Struct, tag_field="type", tag="hand"):
    """Velocities of a robot's hand for a quarter of a second, or until the next message. Requires the controls.

    Linear velocities are shares of 0.25 m/s along the world's axes, angular ones shares of 1 rad/s about them.
    `gripper` moves it towards its largest (1) or smallest (-1) set-point. `site` names the hand if the robot has
    several sites.
    """

    articulation: str
    linear: tuple[float, float, float] = (0.0, 0.0, 0.0)
    angular: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gripper: float = 0.0
    site: str = ""


FromViewer: TypeAlias = Ack | Ctrl | Ping | Name | Hand
"""Messages from a viewer."""

ToViewer: TypeAlias = You | World | State | Status | Log | Refused | Pong
"""Messages to a viewer."""


def tag_of(kind: type[Struct]) -> str:
    """Return the `type` by which a message says what it is."""
    return str(kind.__struct_config__.tag)


class PictureHead(Struct):
    """Header of a picture: `received` is Unix time in ms, `sim_time` is in seconds.

    If `recorded` is true, the picture is part of the replayed recording, and `sim_time` is on that recording's clock.
    """

    seq: int
    received: float
    sim_time: float | None
    mode: str
    recorded: bool = False


_DIGITS = 5


def state_message(
    seq: int, snapshot: StateSnapshot, targets: Mapping[str, list[float] | None], *, recorded: bool = False
) -> State:
    """Return the message of a state, with what viewers have commanded by articulation."""
    wall = snapshot.wall_time.sec + snapshot.wall_time.nsec / 1e9
    received = snapshot.recv_wall_time_ns / 1e9
    # The server's own clock where it can be the same as ours; else what we know, when it got here.
    made = wall if 0 <= received - wall < 10 else received
    return State(
        seq=seq,
        time=snapshot.time,
        step=snapshot.step,
        made=made * 1e3,
        articulations={
            key: ArticulationSample(
                qpos=rounded(state.qpos),
                qvel=rounded(state.qvel),
                ctrl=None if state.ctrl is None else rounded(state.ctrl),
                sensors={name: rounded(value) for name, value in (state.sensors or {}).items()},
                targets=targets.get(key),
            )
            for key, state in snapshot.per_articulation.items()
        },
        entities={name: EntitySample(rounded(pose.xpos)) for name, pose in snapshot.entities.items()},
        recorded=recorded,
    )


def rounded(values: Any) -> list[Any]:
    """Return numbers of as many digits as browsers are told."""
    return np.round(np.asarray(values, dtype=np.float64), _DIGITS).tolist()


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return cast("np.ndarray[Any, Any]", value).tolist()
    if isinstance(value, np.generic):
        return cast("np.generic[Any]", value).item()
    raise TypeError(f"{type(value).__name__} has no JSON form")


_encoder = msgspec.json.Encoder(enc_hook=_plain)


def encode(value: object) -> bytes:
    """Return JSON; arrays become lists, and binary values base64 text."""
    return _encoder.encode(value)
