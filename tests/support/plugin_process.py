"""The plugin's two transports in a process of its own, to be killed: `python plugin_process.py DIRECTORY PORT`.

A step is answered with the number of steps that was asked for, so that no reply can pass for another one's. Prints a
line when it serves.
"""

from __future__ import annotations

import sys
import uuid
from pathlib import Path
from typing import Any

import msgspec
import zmq
from hello import hello_ok
from plugin_memory import PluginMemory

from urlab_client.protocol.registry import OPS

__all__: list[str] = []


def main() -> None:
    """Serve until killed."""
    directory, port = Path(sys.argv[1]), sys.argv[2]
    session = str(uuid.uuid4())
    hello = hello_ok(session_id=session, shm_session_dir=str(directory))
    ops = [{"name": op.name, "category": str(op.needs), "namespace": op.ns} for op in OPS.values()]
    answers: dict[str, Any] = {
        "hello": lambda _: hello,
        "meta": lambda _: {"op": "meta_ok", "ops": ops},
        "set_mode": lambda _: {"op": "set_mode_ok", "previous_mode": "live", "current_mode": "direct"},
        "step": lambda request: {
            "op": "step_ok",
            "time": 0.0,
            "step": float(request.get("n_steps", 1)),
            "per_articulation": {},
        },
    }
    socket = zmq.Context().socket(zmq.REP)
    socket.bind(f"tcp://127.0.0.1:{port}")
    PluginMemory(directory, answers, session_id=session)
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    while True:
        request = msgspec.msgpack.decode(socket.recv())
        # The client's own probes, too, when it has waited long.
        unknown = {"op": "error", "code": "unknown_op", "message": request["op"]}
        socket.send(msgspec.msgpack.encode(answers[request["op"]](request) if request["op"] in answers else unknown))


if __name__ == "__main__":
    main()
