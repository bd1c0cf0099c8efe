"""What the checks stand on: the server's handshake and model, a world to act in, and the way back to the user's."""

from __future__ import annotations

import asyncio
import contextlib
import re
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from urlab_client.aio.features import Features
from urlab_client.aio.model.layout import ArticulationLayout, articulation_layouts
from urlab_client.aio.transport.connection import is_local
from urlab_client.conformance.declarations import Differs, NotTried
from urlab_client.conformance.frames import plain
from urlab_client.conformance.wire import OWNER, Message, Wire
from urlab_client.errors import ProtocolError, URLabConnectionError, URLabError, URLabTimeoutError
from urlab_client.protocol.codec import decode_reply
from urlab_client.protocol.messages.session import ArticulationInfo, CameraInfo, HelloOk
from urlab_client.protocol.registry import OPS
from urlab_client.protocol.topics import resolve_endpoint

if TYPE_CHECKING:
    import mujoco

LEVEL: Final = "urlab_conformance"
ROBOT: Final = """<mujoco model="urlab_conformance_robot">
  <worldbody>
    <body name="base" pos="0 0 1">
      <freejoint name="root"/>
      <geom name="base" type="sphere" size="0.1" mass="1"/>
      <body name="arm" pos="0 0 0.2">
        <joint name="j" axis="0 1 0"/>
        <geom name="arm" type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="m" joint="j" ctrlrange="-1 1"/></actuator>
  <sensor><jointpos name="s" joint="j"/></sensor>
</mujoco>
"""

_BACK_S: Final = 20.0
_POLL_S: Final = 0.05


class Robot(Struct):
    """A robot of the handshake.

    Attributes:
        info: As the handshake describes it.
        layout: Where its values stand in the model; empty without a model.
    """

    info: ArticulationInfo
    layout: ArticulationLayout

    @property
    def key(self) -> str:
        """Key in requests and replies."""
        return self.info.prefix


class Bench:
    """A server under examination.

    Attributes:
        wire: The connection.
        plain_hello: The last handshake as plain data.
        hello: The same, decoded.
        ops: What `meta` lists, by name.
        features: What the server can do.
        model: The model of the handshake; None without play or with another MuJoCo.
        robots: The robots of the handshake.
        own_server: Whether the server was started for this run.
        trusted: Whether its binary model is loaded; by default if it is on this machine.
        import_file: The user's MJCF for the checks that import one; None for one in a temporary folder.
        measured: Numbers that checks measured besides.
    """

    def __init__(
        self, wire: Wire, *, own_server: bool = False, trusted: bool | None = None, import_file: str | None = None
    ) -> None:
        self.wire = wire
        self.plain_hello: dict[str, Any] = {}
        self.hello: HelloOk
        self.ops: dict[str, dict[str, Any]] = {}
        self.features: Features = Features()
        self.model: mujoco.MjModel | None = None
        self.robots: list[Robot] = []
        self.own_server = own_server
        self.trusted: bool = is_local(wire.endpoint) if trusted is None else trusted
        self.import_file = import_file
        self.measured: dict[str, Any] = {}
        self._undo: list[tuple[str, dict[str, Any]]] = []
        self._others: set[str] = set()
        self._session_owns = False

    @property
    def dialect(self) -> str:
        """`alpha`, `june` or `beta`, which also stands for what follows."""
        return {"": "alpha", "3": "beta"}.get(self.features.generation, self.features.generation)

    @property
    def robot(self) -> Robot:
        """The first robot with a control input, or else the first."""
        return next((robot for robot in self.robots if len(robot.layout.ctrl_adr)), self.robots[0])

    @property
    def camera(self) -> tuple[str, CameraInfo]:
        """The first camera, under the name that requests use."""
        return next((name, info) for robot in self.robots for name, info in robot.info.camera_topics.items())

    @property
    def state_key(self) -> str:
        """Field of replies that has the robots' states."""
        return "arts" if self.dialect == "beta" else "per_articulation"

    @property
    def compiled(self) -> mujoco.MjModel:
        """The model; a check that uses it needs `model`."""
        if self.model is None:
            raise NotTried(NEEDS["model"][1])
        return self.model

    # The session

    async def open(self) -> None:
        """Open a session and learn who answers."""
        meta = await self.wire.ask("meta")
        self.ops = {op["name"]: op for op in meta["ops"]}
        await self.greet()
        self.features = self.features.with_ops(self.ops).with_hello(self.hello)

    async def greet(self, **fields: Any) -> None:
        """Open a session anew, and take over the handshake with its model."""
        reply = await self.wire.ask("hello", client_version="urlab conformance", **fields)
        self.plain_hello, self.wire.session_id = reply, str(reply.get("session_id", ""))
        try:
            self.hello = decode_reply(OPS["hello"], HelloOk, msgspec.msgpack.encode(reply))
        except ProtocolError as error:
            raise Differs("a handshake", str(error)) from error
        self.model = _model_of(self.hello) if self.trusted else None
        prefixes = {info.prefix: info.compiled_prefix for info in self.hello.articulations}
        layouts = {} if self.model is None else articulation_layouts(self.model, prefixes)
        self.robots = [
            Robot(info, layouts.get(info.prefix, ArticulationLayout()))
            for info in self.hello.articulations
            if info.prefix not in self._others
        ]
        if self._session_owns:  # the session before this one still has the claims
            for robot in self.robots:
                await self.wire.raw("claim_control", articulation=robot.key, force=True)
        with contextlib.suppress(URLabConnectionError):
            await self.wire.follow(self.hello)

    def need(self, what: str) -> None:
        """Raise `NotTried` unless something is there."""
        there, sentence = NEEDS[what]
        if not there(self):
            raise NotTried(sentence)

    # The way back

    def later(self, op: str, **fields: Any) -> None:
        """Send an op at the end, to undo what is about to be done; the newest is undone first."""
        self._undo.append((op, fields))

    @property
    def undone(self) -> int:
        """Number of ops that wait to be sent at the end."""
        return len(self._undo)

    async def put_back(self, keep: int = 0) -> list[str]:
        """Undo everything but the oldest `keep` changes; return what could not be undone."""
        failed: list[str] = []
        while len(self._undo) > keep:
            op, fields = self._undo[-1]
            try:
                reply = await self._persist(op, fields)
                if reply.get("op") == "error" and reply.get("code") not in _GONE:
                    failed.append(f"{op}: {reply.get('code')}: {reply.get('message', '')}")
                elif reply.get("state", "ready") != "ready":
                    failed.append(f"{op}: play is {reply['state']}")
            except (URLabError, Differs) as error:
                failed.append(f"{op}: {error}")
            self._undo.pop()
        return failed

    async def _persist(self, op: str, fields: dict[str, Any]) -> dict[str, Any]:
        """Send an op, also after a lost connection or session."""
        give_up = asyncio.get_running_loop().time() + _BACK_S
        while True:
            try:
                reply = await self.job(op, **fields)
            except (URLabConnectionError, URLabTimeoutError):
                if asyncio.get_running_loop().time() > give_up:
                    raise
                await asyncio.sleep(_POLL_S)
                continue
            if reply.get("code") != "session_expired" or asyncio.get_running_loop().time() > give_up:
                return reply
            hello = await self.wire.ask("hello")
            self.wire.session_id = hello["session_id"]

    # A world to act in

    async def play(self) -> None:
        """Have a play session in direct mode whose robots this run controls."""
        await self.greet()
        if not self.hello.manager_present:
            if "begin_pie" not in self.ops:
                raise NotTried("needs a play session")
            self.later("stop_pie")
            started = await self.wire.raw("begin_pie", timeout_s=60)
            if started.get("op") != "begin_pie_ok" or started.get("state") != "ready":
                raise NotTried(f"needs a level that can be played: begin_pie says {started.get('state') or started}")
            await self.greet()
        elif "pie_status" in self.ops:
            times = [(await self.wire.ask("pie_status")).get("sim_time")]
            await asyncio.sleep(0.2)
            times.append((await self.wire.ask("pie_status")).get("sim_time"))
            if times[0] == times[1]:
                self.later("set_paused", paused=True)
        mode = await self.wire.raw("set_mode", mode="direct")
        if mode.get("op") == "error":
            raise NotTried(f"needs a server whose step mode is free: {mode.get('message')}")
        self.later("set_mode", mode="live" if mode["previous_mode"] == "auto" else mode["previous_mode"])
        self.later("reset")
        for robot in tuple(self.robots) if self.features.claims else ():
            claim = await self.wire.raw("claim_control", articulation=robot.key)
            if claim.get("op") == "error":
                self.robots.remove(robot)
                self._others.add(robot.key)
            else:
                self._session_owns = claim.get("owner") == self.wire.session_id
                self.later("release_control", articulation=robot.key)
        if self.features.claims and not self.robots and self.hello.articulations:
            raise NotTried("needs a robot that no other client controls")

    async def direct(self) -> dict[str, Any]:
        """Bring the play session to its start in direct mode; return the state."""
        await self.wire.ask("set_mode", mode="direct")
        await self.wire.ask("set_paused", paused=False)
        return await self.wire.ask("reset")

    def drive(self, robot: Robot, values: Any, **command: Any) -> dict[str, Any]:
        """Return the fields of a step that sets a robot's controls, past its controller."""
        numbers = [float(value) for value in values]
        return {"per_articulation": {robot.key: {"ctrl": numbers, "control_mode": "raw", **command}}}

    def states(self, reply: Mapping[str, Any]) -> dict[str, Any]:
        """Return the robots' states in a reply."""
        states = reply.get(self.state_key)
        if not isinstance(states, dict):
            raise Differs(f"a map {self.state_key}", states)
        return cast("dict[str, Any]", states)

    def vector(self, reply: Mapping[str, Any], field: str, robot: Robot | None = None) -> NDArray[np.float64]:
        """Return an array of a robot's state."""
        key = (robot or self.robot).key
        state: dict[str, Any] = self.states(reply).get(key) or {}
        if not isinstance(state.get(field), list):
            raise Differs(f"{field} of {key}", state)
        return np.array(state[field], dtype=np.float64)

    async def job(self, op: str, /, **fields: Any) -> dict[str, Any]:
        """Send an editor op, and return what its job comes to, whatever that says."""
        reply = await self.wire.raw(op, **fields)
        while reply.get("op") == "op_started":
            await asyncio.sleep(_POLL_S)
            status = await self.wire.ask("op_status", job_id=reply["job_id"])
            if status["state"] in {"done", "failed"}:
                return status["result"]
        return reply

    async def edit(self, op: str, /, **fields: Any) -> dict[str, Any]:
        """Send an editor op, and return its successful result."""
        result = await self.job(op, **fields)
        if result.get("op") != OPS[op].reply_name:
            raise Differs(OPS[op].reply_name, result)
        return result

    async def refuse(self, code: str, op: str, /, **fields: Any) -> None:
        """Send an editor op that must fail, at once or as a job."""
        result = await self.job(op, **fields)
        if result.get("op") != "error" or result.get("code") != code:
            raise Differs(f"{op} to be refused with {code}", result)

    async def author(self) -> str:
        """Open a level of this run's own; return the blueprint of a robot."""
        if "create_level" not in self.ops:
            raise NotTried("needs an editor; this is a packaged build")
        level = str((await self.wire.ask("current_level"))["level_path"])
        if not self.own_server and (not level.startswith("/Game/") or level.startswith("/Game/Levels/Untitled")):
            raise NotTried("needs the open level to be saved under a name, so that it can be opened again")
        if self.hello.manager_present:
            if not self.own_server:
                self.later("begin_pie", timeout_s=60)
            await self.wire.ask("stop_pie")
        name, made = LEVEL, dict[str, Any]()
        for number in range(2, 100):
            self.later("destroy_asset", asset_path=f"/Game/Levels/{name}.{name}")
            if not self.own_server:
                self.later("load_level", level_path=level)
            made = await self.job("create_level", name=name)
            if made.get("op") == "create_level_ok":
                break
            del self._undo[-1 if self.own_server else -2 :]
            name = f"{LEVEL}_{number}"
        else:
            raise NotTried(f"needs a level that can be created: {made}")
        await self.edit("ensure_manager")
        with tempfile.TemporaryDirectory(prefix="urlab-") as folder:
            own = Path(folder) / "urlab_conformance_robot.xml"
            own.write_text(ROBOT, encoding="utf-8")
            imported = await self.job("import_xml", path=self.import_file or str(own))
        if imported.get("op") != "import_xml_ok":
            text = f"{imported.get('code')}: {imported.get('message')}"
            raise NotTried(f"needs an MJCF that the server can read and may import (--import FILE): {text}")
        blueprint = str(imported["blueprint_class_path"])
        if imported["imported_now"]:  # otherwise it is the user's
            self._undo.insert(0, ("destroy_asset", {"asset_path": re.sub(r"_C$", "", blueprint)}))
        return blueprint

    # Streams

    def endpoint(self, told: str) -> str:
        """Return the address to connect to from an endpoint that the server reports."""
        host = self.wire.endpoint.partition("://")[2].rpartition(":")[0] or "127.0.0.1"
        return resolve_endpoint(told, host.strip("[]"))

    @property
    def state_endpoint(self) -> str:
        """Address of the state stream."""
        told = self.hello.instance.state_port if self.hello.instance is not None else 0
        port = told or self.state_port
        return self.endpoint(f"tcp://0.0.0.0:{port}")

    state_port: int = 5555
    """Port of the state stream where the server tells none."""

    async def state_messages(self, count: int, seconds: float = 5.0) -> list[Message]:
        """Return the first messages of the state stream, a number of whole ticks."""
        return await self.wire.listen(
            self.state_endpoint, seconds, lambda got: sum(m.topic == b"state/full" for m in got) >= count
        )


def same(what: str, expected: Any, got: Any, tolerance: float = 0.0) -> None:
    """Check that two values agree, arrays within a tolerance.

    Raises:
        Differs: They do not.
    """
    if isinstance(expected, np.ndarray) or isinstance(got, np.ndarray):
        one, other = np.asarray(expected, dtype=float), np.asarray(got, dtype=float)
        if one.shape != other.shape:
            raise Differs(f"{what} of shape {one.shape}", other.shape)
        gap = np.abs(one - other) > tolerance * np.maximum(1.0, np.abs(one))
        if np.any(gap | (np.isnan(one) != np.isnan(other))):
            at = int(np.argmax(gap))
            raise Differs(f"{what}[{at}] = {one.flat[at]!r}", f"{other.flat[at]!r}")
    elif isinstance(expected, float) and tolerance and isinstance(got, int | float):
        if abs(expected - got) > tolerance:
            raise Differs(f"{what} = {expected!r}", got)
    elif expected != got:
        raise Differs(f"{what} = {expected!r}", got)


def holds(condition: object, expected: str, got: object) -> None:
    """Check a condition.

    Raises:
        Differs: It is false.
    """
    if not condition:
        raise Differs(expected, got)


def _model_of(hello: HelloOk) -> mujoco.MjModel | None:
    import mujoco

    if hello.mjb is None or hello.mujoco_version_int != mujoco.mj_version():
        return None
    try:
        return mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": hello.mjb})
    except ValueError as error:
        raise Differs("a model in `mjb`", str(error)) from error


_GONE: Final = frozenset({"not_control_owner", "no_active_manager", "unknown_op", "not_ready"})
"""Refusals of an undoing op that mean that nothing is left to undo."""

NEEDS: Final[Mapping[str, tuple[Callable[[Bench], object], str]]] = {
    "play": (lambda bench: bench.hello.manager_present, "needs a play session (--play begins one)"),
    "no_play": (lambda bench: not bench.hello.manager_present, "needs a server without a play session"),
    "model": (
        lambda bench: bench.model is not None,
        "needs play, the server's MuJoCo here, and a server that is trusted with binary models (--trust-server)",
    ),
    "robots": (lambda bench: bench.robots, "needs a robot"),
    "robot": (
        lambda bench: bench.robots and len(bench.robot.layout.ctrl_adr),
        "needs a robot with an actuator, and its model",
    ),
    "camera": (
        lambda bench: any(robot.info.camera_topics for robot in bench.robots),
        "needs a robot with a camera",
    ),
    "keyframe": (lambda bench: bench.model is not None and bench.model.nkey, "needs a model with a keyframe"),
    "local": (lambda bench: is_local(bench.wire.endpoint), "needs the server on this machine"),
    "shm": (
        lambda bench: bench.hello.shm_session_dir is not None and Path(bench.hello.shm_session_dir).is_dir(),
        "needs a server on this machine that offers shared memory",
    ),
    "editor": (lambda bench: "current_level" in bench.ops, "needs an editor; this is a packaged build"),
}


def decoded(message: Message) -> dict[str, Any]:
    """Return a published map as plain data."""
    try:
        return plain(message.payload)
    except ValueError as error:
        raise Differs("a map", str(error)) from error


__all__ = ["NEEDS", "OWNER", "Bench", "Robot", "decoded", "holds", "same"]
