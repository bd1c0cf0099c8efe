"""What the checks stand on: the server's handshake and model, a world to act in, and the way back to the user's."""

from __future__ import annotations

import asyncio
import contextlib
import re
import tempfile
from collections.abc import Callable, Coroutine, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from urlab_client.aio.features import Features
from urlab_client.aio.model.layout import ArticulationLayout, articulation_layouts
from urlab_client.aio.transport.connection import is_local
from urlab_client.conformance.declarations import Differs, NotTried, expecting, has, holds, same
from urlab_client.conformance.wire import Message, Wire, plain
from urlab_client.errors import URLabConnectionError, URLabError, URLabTimeoutError
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


def write_robot(folder: str | Path) -> str:
    """Write the robot of the checks into a folder; return the file."""
    path = Path(folder) / "urlab_conformance_robot.xml"
    path.write_text(ROBOT, encoding="utf-8")
    return str(path)


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
        start: State at the start of a check that plays.
        blueprint: Of the robot in the level of this run.
        own_server: Whether the server was started for this run.
        trusted: Whether its binary model is loaded; by default if it is on this machine.
        import_file: The user's MJCF for the checks that import one; None for one in a temporary folder.
        measured: Numbers that checks measured besides.
        names: Names of robots and hosts in the handshakes so far, each with a word to replace it.
        left: What could not be put back.
    """

    def __init__(
        self, wire: Wire, *, own_server: bool = False, trusted: bool | None = None, import_file: str | None = None
    ) -> None:
        self.wire = wire
        self.ask: Callable[..., Coroutine[Any, Any, dict[str, Any]]] = wire.ask
        self.refused: Callable[..., Coroutine[Any, Any, dict[str, Any]]] = wire.refused
        self.plain_hello: dict[str, Any] = {}
        self.hello: HelloOk
        self.ops: dict[str, dict[str, Any]] = {}
        self.features: Features = Features()
        self.model: mujoco.MjModel | None = None
        self.robots: list[Robot] = []
        self.start: dict[str, Any] = {}
        self.blueprint: str = ""
        self.own_server = own_server
        self.trusted: bool = is_local(wire.transport.endpoint) if trusted is None else trusted
        self.import_file = import_file
        self.measured: dict[str, Any] = {}
        self.names: dict[str, str] = {}
        self.left: list[str] = []
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
        meta = await self.ask("meta")
        self.ops = {op["name"]: op for op in meta["ops"]}
        await self.greet()
        self.features = self.features.with_ops(self.ops).with_hello(self.hello)

    async def greet(self, **fields: Any) -> None:
        """Open a session anew, and take over the handshake with its model."""
        reply = await self.ask("hello", client_version="urlab conformance", **fields)
        self.plain_hello, self.wire.session_id = reply, str(reply.get("session_id", ""))
        with expecting("a handshake"):
            self.hello = decode_reply(OPS["hello"], HelloOk, msgspec.msgpack.encode(reply))
        self._note_names(self.hello)
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

    def _note_names(self, hello: HelloOk) -> None:
        if hello.instance is not None and hello.instance.host:
            self.names.setdefault(hello.instance.host, "host")
        for info in hello.articulations:
            own = {name for name in (info.prefix, info.actor_name, info.actor_id) if name}
            known = next((self.names[name] for name in own if name in self.names), None)
            word = known or f"robot_{len({*self.names.values()} - {'host'}) + 1}"
            self.names |= dict.fromkeys(own - self.names.keys(), word)

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

    async def put_back(self, keep: int = 0) -> None:
        """Undo everything but the oldest `keep` changes."""
        await to_the_end(self._put_back(keep))

    async def _put_back(self, keep: int) -> None:
        loop = asyncio.get_running_loop()
        give_up = loop.time() + _BACK_S
        while len(self._undo) > keep:
            op, fields = self._undo[-1]
            try:
                reply = await self._persist(op, fields, give_up)
                give_up = loop.time() + _BACK_S
                # A lease that is gone, or another client's, is refused like a malformed request.
                if reply.get("op") == "error" and reply.get("code") not in _GONE and op != "release_lease":
                    self.left.append(f"{op}: {reply.get('code')}: {reply.get('message', '')}")
                elif reply.get("state", "ready") != "ready":
                    self.left.append(f"{op}: play is {reply['state']}")
            except (URLabError, Differs) as error:
                self.left.append(f"{op}: {error}")
            self._undo.pop()

    async def _persist(self, op: str, fields: dict[str, Any], give_up: float) -> dict[str, Any]:
        """Send an op, also after a lost connection or session, until a time of the loop's clock."""
        while True:
            try:
                reply = await self.wire.job(op, **fields)
            except (URLabConnectionError, URLabTimeoutError):
                if asyncio.get_running_loop().time() > give_up:
                    raise
                await asyncio.sleep(_POLL_S)
                continue
            if reply.get("code") != "session_expired" or asyncio.get_running_loop().time() > give_up:
                return reply
            hello = await self.ask("hello")
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
        else:
            self.later("set_paused", paused=await self._stands_still())
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

    async def _stands_still(self) -> bool:
        """Whether play is paused, which no op says."""
        if "pie_status" not in self.ops:
            return False
        before = (await self.ask("pie_status")).get("sim_time")
        await asyncio.sleep(0.2)
        return (await self.ask("pie_status")).get("sim_time") == before

    async def enter(self, mode: str = "direct", *, paused: bool = False) -> None:
        """Choose the step mode; the next check begins in direct mode again."""
        await self.ask("set_mode", mode=mode)
        await self.ask("set_paused", paused=paused)

    async def restart(self) -> dict[str, Any]:
        """Bring the play session to its start in direct mode; return the state."""
        await self.enter()
        return await self.ask("reset")

    async def step(self, **fields: Any) -> dict[str, Any]:
        """Send a step that must succeed."""
        return await self.ask("step", **fields)

    def drive(self, values: Iterable[float] = (), /, robot: Robot | None = None, **command: Any) -> dict[str, Any]:
        """Return the fields of a step that sets a robot's controls, past its controller."""
        command = {"ctrl": [float(value) for value in values], "control_mode": "raw", **command}
        return {"per_articulation": {(robot or self.robot).key: command}}

    def states(self, reply: Mapping[str, Any]) -> dict[str, Any]:
        """Return the robots' states in a reply."""
        states = reply.get(self.state_key)
        if not isinstance(states, dict):
            raise Differs(f"a map {self.state_key}", states)
        return cast("dict[str, Any]", states)

    def state(self, reply: Mapping[str, Any], robot: Robot | None = None) -> dict[str, Any]:
        """Return a robot's state in a reply, without what only some robots have."""
        state: dict[str, Any] = self.states(reply).get((robot or self.robot).key) or {}
        return {name: value for name, value in state.items() if name not in {"twist", "actions", "user"}}

    def vector(self, reply: Mapping[str, Any], field: str, robot: Robot | None = None) -> NDArray[np.float64]:
        """Return an array of a robot's state."""
        state = self.state(reply, robot)
        if not isinstance(state.get(field), list):
            raise Differs(f"{field} of {(robot or self.robot).key}", state)
        return np.array(state[field], dtype=np.float64)

    async def author(self) -> None:
        """Open a level of this run's own, with the blueprint of a robot."""
        if "create_level" not in self.ops:
            raise NotTried("needs an editor; this is a packaged build")
        level = str((await self.ask("current_level"))["level_path"])
        if not self.own_server and (not level.startswith("/Game/") or level.startswith("/Game/Levels/Untitled")):
            raise NotTried("needs the open level to be saved under a name, so that it can be opened again")
        if self.hello.manager_present:
            if not self.own_server:
                self.later("begin_pie", timeout_s=60)
            await self.ask("stop_pie")
        await self._create_level(level)
        await self.ask("ensure_manager")
        with tempfile.TemporaryDirectory(prefix="urlab-") as folder:
            imported = await self.wire.job("import_xml", path=self.import_file or write_robot(folder))
        if imported.get("op") != "import_xml_ok":
            text = f"{imported.get('code')}: {imported.get('message')}"
            raise NotTried(f"needs an MJCF that the server can read and may import (--import FILE): {text}")
        self.blueprint = str(imported["blueprint_class_path"])
        if imported["imported_now"]:  # otherwise it is the user's
            self._undo.insert(0, ("destroy_asset", {"asset_path": re.sub(r"_C$", "", self.blueprint)}))

    async def _create_level(self, opened: str) -> None:
        made: dict[str, Any] = {}
        for number in range(1, 100):
            name = LEVEL if number == 1 else f"{LEVEL}_{number}"
            before = self.undone
            self.later("destroy_asset", asset_path=f"/Game/Levels/{name}.{name}")
            if not self.own_server:
                self.later("load_level", level_path=opened)
            made = await self.wire.job("create_level", name=name)
            if made.get("op") == "create_level_ok":
                return
            del self._undo[before:]
        raise NotTried(f"needs a level that can be created: {made}")

    # Streams

    def endpoint(self, told: str) -> str:
        """Return the address to connect to from an endpoint that the server reports."""
        host = self.wire.transport.endpoint.partition("://")[2].rpartition(":")[0] or "127.0.0.1"
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
        """Return the first messages of the state stream, a number of whole ticks; at least one."""
        messages = await self.wire.listen(
            self.state_endpoint, seconds, lambda got: sum(m.topic == b"state/full" for m in got) >= count
        )
        holds(messages, f"messages at {self.state_endpoint}", f"none within {seconds:g} s")
        return messages


class Twin:
    """The model of the handshake in MuJoCo here, which starts as the server does and takes the same steps.

    Attributes:
        model: The model.
        data: Its state.
        values: The controls of the first robot; those of the others are 0.
    """

    def __init__(self, bench: Bench) -> None:
        import mujoco

        self._bench = bench
        self.model: mujoco.MjModel = bench.compiled
        self.data: mujoco.MjData = mujoco.MjData(self.model)
        self.values: NDArray[np.float64] = np.zeros(len(bench.robot.layout.ctrl_adr))
        mujoco.mj_forward(self.model, self.data)

    def inputs(self, scale: float = 1.0) -> None:
        """Choose small controls that float32 represents, different for each input."""
        place = np.arange(len(self.values))
        self.values = np.asarray(scale * 0.0625 * (1 + place % 4) * np.where(place % 2, -1.0, 1.0), np.float64)

    async def step(self, n: int = 1, tolerance: float = 1e-9, **fields: Any) -> dict[str, Any]:
        """Let both take steps in which no controller acts, and compare them; `command` is for the first robot."""
        import mujoco

        bench, layout = self._bench, self._bench.robot.layout
        command: dict[str, Any] = fields.pop("command", {})
        commands: dict[str, Any] = {}
        for robot in bench.robots:
            idle = np.zeros(len(robot.layout.ctrl_adr))
            commands |= bench.drive(idle, robot)["per_articulation"]
        commands |= bench.drive(self.values, **command)["per_articulation"]
        fields |= {"n_steps": n} if n > 1 else {}
        reply = await bench.step(per_articulation=commands, **fields)
        self.data.ctrl[layout.ctrl_adr] = self.values
        mujoco.mj_step(self.model, self.data, nstep=n)
        self.agrees(reply, tolerance)
        return reply

    def agrees(self, reply: Mapping[str, Any], tolerance: float = 1e-12) -> None:
        """Check that the robots of a reply, and its time, are those of this model."""
        for robot in self._bench.robots:
            layout = robot.layout
            for name, expected in {
                "qpos": self.data.qpos[layout.qpos_adr],
                "qvel": self.data.qvel[layout.qvel_adr],
            }.items():
                same(f"{name} of {robot.key}", expected, self._bench.vector(reply, name, robot), tolerance)
        has(reply, tolerance, time=float(self.data.time))


def _model_of(hello: HelloOk) -> mujoco.MjModel | None:
    import mujoco

    if hello.mjb is None or hello.mujoco_version_int != mujoco.mj_version():
        return None
    with expecting("a model in `mjb`"):
        return mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": hello.mjb})


_GONE: Final = frozenset({"not_control_owner", "no_active_manager", "unknown_op", "not_ready", "destroy_failed"})
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
    "shm": (
        lambda bench: bench.hello.shm_session_dir is not None and Path(bench.hello.shm_session_dir).is_dir(),
        "needs a server on this machine that offers shared memory",
    ),
    "editor": (lambda bench: "current_level" in bench.ops, "needs an editor; this is a packaged build"),
}


async def to_the_end(work: Coroutine[Any, Any, None]) -> None:
    """Await work that notes what has to be undone, and let it end if this is cancelled meanwhile."""
    task = asyncio.ensure_future(work)
    try:
        await asyncio.wait((task,))  # which, if it is cancelled, does not cancel the task
    except asyncio.CancelledError:
        await asyncio.gather(task, return_exceptions=True)
        raise
    task.result()


def decoded(message: Message) -> dict[str, Any]:
    """Return a published map as plain data."""
    with expecting("a map"):
        return plain(message.payload)
