"""A bare client for the tests of the server: a REQ socket, msgpack, nothing of the package's own client or codec."""

from __future__ import annotations

import contextlib
import struct
import threading
from collections.abc import Generator, Iterator, Mapping
from pathlib import Path
from typing import Any, Self

import msgspec
import zmq
from waiting import attempts

from urlab_client.server import SimulatedServer

pack = msgspec.msgpack.encode


def set_points(values: Mapping[int, float]) -> bytes:
    """Return the payload of a control topic with these values by actuator id."""
    entries = (struct.pack("<if", actuator, value) for actuator, value in values.items())
    return struct.pack("<i", len(values)) + b"".join(entries)


BOT = """
<mujoco model="bot">
  <compiler angle="radian"/>
  <option timestep="0.005" gravity="0 0 -1" integrator="RK4"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1" pos="0 0 -5"/>
    <body name="base" pos="0 0 1">
      <freejoint name="root"/>
      <geom name="ball" type="sphere" size="0.1" mass="1"/>
      <camera name="cam"/>
      <body name="arm" pos="0 0 0.2">
        <joint name="j" axis="0 1 0"{joint}/>
        <geom name="link" type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="m" joint="j" ctrlrange="-1 1" ctrllimited="{limited}"/></actuator>
  <sensor><jointpos name="s" joint="j"/></sensor>
  <keyframe><key name="home" time="1.5" qpos="0 0 1 1 0 0 0 0.5" ctrl="0.3"/></keyframe>
</mujoco>
"""

BALL = """
<mujoco model="ball">
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1"/>
    <body name="ball" pos="0 0 {height}"><freejoint/><geom name="ball" size="0.1" mass="1"/></body>
  </worldbody>
</mujoco>
"""

PROP = """
<mujoco model="prop">
  <worldbody>
    <body name="box"><joint name="slide" type="slide"/><geom type="box" size=".1 .1 .1"/></body>
  </worldbody>
</mujoco>
"""

MOCAP = """
<mujoco model="hand">
  <worldbody>
    <body name="hand" mocap="true" pos="0 0 1"><geom name="palm" size=".1"/></body>
  </worldbody>
</mujoco>
"""

BROKEN = "<mujoco><worldbody><body><joint type='hinge'/></body></worldbody></mujoco>"


def write_models(folder: Path) -> Path:
    """Write the models of these tests to a folder and return it."""
    texts = {
        "bot": BOT.format(joint="", limited="true"),
        "limited": BOT.format(joint=' range="-0.2 0.2"', limited="false"),
        "ball": BALL.format(height="0.5"),
        "resting": BALL.format(height="0.0999"),
        "prop": PROP,
        "hand": MOCAP,
        "broken": BROKEN,
    }
    for name, text in texts.items():
        (folder / f"{name}.xml").write_text(text)
    return folder


def write_level(path: Path, *, size: float, quick_convert: bool = False) -> Path:
    """Write a level with a manager and a static mesh `crate`, for which no op exists; MuJoCo rejects tiny bodies."""
    crate = {"name": "Crate_0", "kind": "static_mesh", "actor_id": "crate", "location": [0, 0, 2]}
    crate["mesh"] = {"shape": "box", "size": [size] * 3}
    if quick_convert:
        crate["quick_convert"] = {}
    actors = [crate, {"name": "AMjManager_0", "kind": "manager"}]
    path.write_bytes(msgspec.json.encode({"format": "urlab-level", "version": 1, "blueprints": {}, "actors": actors}))
    return path


def server_threads() -> set[threading.Thread]:
    """Return the threads of the servers in this process. One that was closed may take a moment to end its own."""
    urlab = {thread for thread in threading.enumerate() if thread.name.startswith("urlab")}
    return {thread for thread in urlab if thread.name != "urlab-io"}  # a client's


@contextlib.contextmanager
def files_of_at_most(size: int) -> Generator[None]:
    """Let no file of this process grow beyond a size: to a program that is much like a full disk."""
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


class Wire:
    """Talks to a server; checks of every reply what holds for all."""

    def __init__(self, server: SimulatedServer, *, encoding: str = "", timeout_s: float = 30) -> None:
        self._context = zmq.Context()
        self._server = server
        self._endpoint = f"{server.address}:{server.step_port}"
        self._timeout_s = timeout_s
        self._socket = self.connected()
        self._encoding = encoding
        self.session_id = ""

    @property
    def core(self) -> Any:
        """The inside of the server, where no op shows what is asked about."""
        return self._server._running.core  # type: ignore[union-attr]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self._socket.close()
        self._context.term()

    def connected(self, kind: int = zmq.REQ) -> zmq.Socket[bytes]:
        """Return one more socket that is connected to the server."""
        socket = self._context.socket(kind)
        socket.linger = 0
        socket.rcvtimeo = int(1000 * self._timeout_s)
        socket.connect(self._endpoint)
        return socket

    def exchange(self, *frames: bytes) -> bytes:
        """Send a request as it is and return the reply as it is."""
        self._socket.send_multipart(frames)
        try:
            reply = self._socket.recv_multipart()
        except zmq.Again:
            # A REQ socket that was promised a reply takes no other request: what shares it would fail, too.
            self._socket.close()
            self._socket = self.connected()
            raise AssertionError(f"no reply within {self._timeout_s} s to {frames!r:.200}") from None
        assert len(reply) == 1
        return reply[0]

    def raw(self, request: object) -> Any:
        """Send a plain value and return the reply, whatever it says."""
        frame = self.exchange(request if isinstance(request, bytes) else pack(request))
        check_numbers(frame)
        return msgspec.msgpack.decode(frame)

    def hello(self, **fields: Any) -> dict[str, Any]:
        reply = self.raw({"op": "hello", **fields})
        assert reply["op"] == "hello_ok"
        self.session_id = reply["session_id"]
        return reply

    def ask(self, op: str, /, **fields: Any) -> dict[str, Any]:
        """Send an op of the session and return the successful reply."""
        reply = self.raw({"op": op, "session_id": self.session_id, **fields})
        assert reply["op"] == ("set_mode_ok" if op == "set_viewport_mode" else f"{op}_ok"), reply
        return reply

    def refused(self, op: str, /, **fields: Any) -> str:
        """Send an op of the session that must fail and return the code."""
        return self.refusal(op, **fields)[0]

    def refusal(self, op: str, /, **fields: Any) -> tuple[str, str]:
        """Send an op of the session that must fail and return code and message."""
        reply = self.raw({"op": op, "session_id": self.session_id, **fields})
        assert reply["op"] == "error", reply
        assert set(reply) == {"op", "code", "message"}
        assert isinstance(reply["message"], str)
        return reply["code"], reply["message"]

    def until(self, op: str, /, **fields: Any) -> Iterator[dict[str, Any]]:
        """Ask again and again, until the caller has seen enough; fail when that takes too long."""
        for _ in attempts(f"no reply to {op} was what the test waits for"):
            yield self.ask(op, **fields)


def check_numbers(frame: bytes) -> None:
    """Walk a msgpack frame: every number is a float64 and nothing is nil."""
    assert _walk(frame, 0) == len(frame)


def _walk(frame: bytes, at: int) -> int:
    first = frame[at]
    at += 1
    if first in (0xC2, 0xC3):
        return at
    if first == 0xCB:
        return at + 8
    if 0xA0 <= first <= 0xBF:
        return at + (first & 0x1F)
    if first in _SIZED:
        width = _SIZED[first]
        return at + width + int.from_bytes(frame[at : at + width], "big")
    if 0x80 <= first <= 0x9F:
        count = (first & 0x0F) * (2 if first < 0x90 else 1)
    else:
        kind, width = _CONTAINERS[first]
        count = kind * int.from_bytes(frame[at : at + width], "big")
        at += width
    for _ in range(count):
        at = _walk(frame, at)
    return at


_SIZED = {0xC4: 1, 0xC5: 2, 0xC6: 4, 0xD9: 1, 0xDA: 2, 0xDB: 4}
_CONTAINERS = {0xDC: (1, 2), 0xDD: (1, 4), 0xDE: (2, 2), 0xDF: (2, 4)}


def float32(value: float) -> float:
    return struct.unpack("<f", struct.pack("<f", value))[0]
