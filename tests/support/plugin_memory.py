"""The plugin's end of shared memory: no doorbell, a worker that polls, and replies that vanish when they do not fit."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
from written_region import WrittenRegion

from urlab_client.protocol import shm
from urlab_client.protocol.registry import OPS

Answer = Callable[[dict[str, Any]], "dict[str, Any] | bytes | None"]


class PluginMemory:
    """Serves `req.shm` and `rep.shm` in a directory, from a thread that looks every 100 microseconds.

    Args:
        directory: Where; the plugin calls it `live`.
        answers: Answer by op, shared with whoever answers on the socket. Silence is None.
        session_id: The session that is open.
        stride: Bytes per slot.

    Attributes:
        seen: Ops served, in order; questions asked only to synchronise are not among them.
        held: Requests that got silence.
    """

    def __init__(
        self,
        directory: Path,
        answers: dict[str, Answer],
        *,
        session_id: str,
        stride: int = shm.RPC_STRIDE,
        period: float = 100e-6,
    ) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        self.directory = directory
        self.answers = answers
        self.session_id = session_id
        self.seen: list[str] = []
        self.held: queue.Queue[dict[str, Any]] = queue.Queue()
        self.requests = WrittenRegion(directory / shm.REQUEST_FILE, stride)
        self.replies = WrittenRegion(directory / shm.REPLY_FILE, stride)
        self._last = 0
        self._period = period
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def reply(self, answer: dict[str, Any]) -> None:
        """Publish a reply to whatever was asked."""
        self.replies.publish(msgspec.msgpack.encode(answer))

    def stop(self) -> None:
        """Stop serving."""
        self._stop.set()
        self._thread.join(60)

    def close(self) -> None:
        """Stop serving and remove the files."""
        self.stop()
        self.requests.close()
        self.replies.close()

    def _run(self) -> None:
        while not self._stop.wait(self._period):
            found = self.requests.region.read_latest(self._last)
            if found is None:
                continue
            self._last = found.sequence
            request = msgspec.msgpack.decode(found.payload)
            answer = self._answer(request)
            if answer is not None:
                self.replies.publish(answer if isinstance(answer, bytes) else msgspec.msgpack.encode(answer))

    def _answer(self, request: dict[str, Any]) -> dict[str, Any] | bytes | None:
        name = request["op"]
        if name in OPS and OPS[name].needs.value == "editor_only":
            return {"op": "error", "code": "wrong_transport", "message": f"op '{name}' is not served here"}
        session = request.get("session_id", "")
        if session != self.session_id:
            return {"op": "error", "code": "session_expired", "message": f"session '{session}' is not active"}
        self.seen.append(name)
        answer = self.answers.get(name, lambda _: None)(request)
        if answer is None:
            self.held.put(request)
        return answer
