"""A beta server in play with two robots, and a bare client of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from raw_shm import RawShm
from wire import Wire

from urlab_client.server import SimulatedServer

__all__ = ["ME", "OTHER", "Bench", "Clock"]

ME, OTHER = "lab-7/4711/train", "dashboard"


class Clock:
    """A clock that stands still until a test sets it."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


class Bench:
    """A beta server in play with two bots: `arm_a`, whose actor id is `arm a`, and one without an id.

    Attributes:
        a: Object name of the first; its public name is `arm_a`.
        b: Object and public name of the second.
    """

    def __init__(self, server: SimulatedServer, wire: Wire, models: Path) -> None:
        self.server = server
        self.wire = wire
        wire.hello()
        self.job("create_level", name="bench")
        wire.ask("ensure_manager")
        blueprint = self.job("import_xml", path=str(models / "bot.xml"))["blueprint_class_path"]
        self.a = self.job("spawn_actor", blueprint=blueprint, actor_id="arm a")["actor_name"]
        self.b = self.job("spawn_actor", blueprint=blueprint, actor_id="", location=[0, 2, 0])["actor_name"]

    def job(self, op: str, **fields: Any) -> dict[str, Any]:
        """Do an editor op and return what its job comes to."""
        started = self.raw(op, **fields)
        assert started["op"] == "op_started", started
        return self.end(started["job_id"])

    def end(self, job: str) -> dict[str, Any]:
        for status in self.wire.until("op_status", job_id=job):
            if status["state"] != "running":
                return status["result"]
        raise AssertionError

    def raw(self, op: str, **fields: Any) -> dict[str, Any]:
        return self.wire.raw({"op": op, "session_id": self.wire.session_id, **fields})

    def refused(self, op: str, **fields: Any) -> tuple[str, str | None]:
        """Send an op that must fail; return code and owner."""
        reply = self.raw(op, **fields)
        assert reply["op"] == "error", reply
        assert isinstance(reply["message"], str)
        return reply["code"], reply.get("owner")

    def play(self, mode: str = "direct") -> dict[str, Any]:
        """Begin a play session anew, in which nothing is claimed, and return the handshake."""
        self.wire.ask("stop_pie")
        self.wire.ask("ensure_manager")
        started = self.wire.ask("begin_pie", timeout_s=30)
        assert started["state"] == "ready", started
        self.wire.ask("set_mode", mode=mode)
        return started["handshake_payload"]

    def claim(self, robot: str = "arm_a", owner: str = ME, **fields: Any) -> dict[str, Any]:
        return self.wire.ask("claim_control", articulation=robot, control_owner=owner, **fields)

    def step(self, **fields: Any) -> dict[str, Any]:
        if fields.keys() & {"render", "wait_cameras"}:
            fields.setdefault("camera_timeout_ms", 20_000)
        return self.wire.ask("step", **fields)

    @property
    def core(self) -> Any:
        """The server's inside, for clocks that a test sets."""
        return self.server._running.core  # type: ignore[union-attr]

    def shm(self) -> RawShm:
        """A bare client of the same session over shared memory."""
        assert self.server.shm_dir is not None
        return RawShm(self.server.shm_dir, doorbell=True)

    def drive(self, value: float = 0.25, robot: str = "arm_a", owner: str = ME) -> dict[str, Any]:
        return {"per_articulation": {robot: {"ctrl": [value]}}, "control_owner": owner}
