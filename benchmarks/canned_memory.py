"""A server that answers at once over shared memory, and over ZeroMQ what is not for shared memory, in a child process.

With a doorbell it sleeps until it is rung, unless requests follow each other quickly, as `urlab serve` does. Without
one it is like the plugin and looks every 100 microseconds. It can also write pictures into a camera region, as often
as it is told. The child is this very file run as a script; it ends when its standard input closes.
"""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import os
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import msgspec
import zmq

from urlab_client.protocol import shm

__all__ = ["memory_server"]

_POLL_S = 100e-6
_BRISK_S = 200e-6
_PR_SET_TIMERSLACK = 29
_RUNG_FOR_REPLY = b"r"


@contextlib.contextmanager
def memory_server(
    answers: Mapping[str, bytes], directory: Path, *, doorbell: bool, camera: tuple[str, int, int, float] | None = None
) -> Iterator[int]:
    """Run the server; yield its port.

    Args:
        answers: Reply by op; `hello` is made to point at `directory`.
        directory: Where the regions go.
        doorbell: Whether to have a doorbell.
        camera: File name, width, height and pictures per second of a camera that is written all the time.
    """
    hello = msgspec.msgpack.decode(answers["hello"]) | {"shm_session_dir": str(directory), "manager_present": True}
    material = dict(answers) | {"hello": msgspec.msgpack.encode(hello)}
    command = [sys.executable, __file__]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        stdin, stdout = process.stdin, process.stdout
        assert stdin is not None and stdout is not None  # noqa: S101, PT018
        encoded = msgspec.msgpack.encode((material, str(directory), doorbell, camera))
        stdin.write(len(encoded).to_bytes(8, "big") + encoded)
        stdin.flush()
        try:
            yield int(stdout.readline())
        finally:
            stdin.close()


# In the child


def _region(path: Path, stride: int) -> shm.Region:
    with path.open("w+b") as file:
        file.truncate(shm.region_size(stride))
        file.write(struct.pack("<IIIIQI36x", shm.MAGIC, shm.VERSION, stride, 2, 0, 0))
        file.flush()
        return shm.Region(memoryview(mmap.mmap(file.fileno(), shm.region_size(stride))), fence=lambda: None)


def _answer_zmq(answers: Mapping[bytes, bytes], rep: zmq.Socket[bytes]) -> None:
    while True:
        rep.send(answers[_name(rep.recv())])


def _name(request: bytes) -> bytes:
    return request[5 : 5 + (request[4] & 31)]  # a map whose first entry is `op` and a short string


class _Memory:
    def __init__(self, answers: Mapping[bytes, bytes], directory: Path) -> None:
        self._answers = answers
        self._requests = _region(directory / shm.REQUEST_FILE, shm.RPC_STRIDE)
        self._replies = _region(directory / shm.REPLY_FILE, shm.RPC_STRIDE)
        self._last = 0

    def serve(self) -> bool:
        found = self._requests.read_latest(self._last)
        if found is None:
            return False
        self._last = found.sequence
        token = found.payload.find(b"sync-")
        if token >= 0:
            error = {"op": "error", "code": "session_expired", "message": found.payload[token : token + 21].decode()}
            self._replies.publish(msgspec.msgpack.encode(error))
        else:
            self._replies.publish(self._answers[_name(found.payload)])
        return True


def _write_pictures(directory: Path, camera: tuple[str, int, int, float]) -> None:
    file, width, height, rate = camera
    region = _region(directory / file, shm.camera_stride(width, height))
    pictures = [bytes([i]) * (width * height * 4) for i in range(4)]
    due = time.perf_counter()
    while True:
        for picture in pictures:
            region.publish(picture)
            due = max(due + 1 / rate, time.perf_counter())  # what was missed is not made up for
            time.sleep(max(0.0, due - time.perf_counter()))


def _main() -> None:
    stdin = sys.stdin.buffer
    material = stdin.read(int.from_bytes(stdin.read(8), "big"))
    kinds = tuple[dict[str, bytes], str, bool, tuple[str, int, int, float] | None]
    by_name, folder, doorbell, camera = msgspec.msgpack.decode(material, type=kinds)
    answers = {name.encode(): reply for name, reply in by_name.items()}
    directory = Path(folder)

    def end_with_parent() -> None:
        stdin.read()
        os._exit(0)

    threading.Thread(target=end_with_parent, daemon=True).start()
    rep = zmq.Context().socket(zmq.REP)
    port = rep.bind_to_random_port("tcp://127.0.0.1")
    threading.Thread(target=_answer_zmq, args=(answers, rep), daemon=True).start()
    memory = _Memory(answers, directory)
    if camera is not None:
        threading.Thread(target=_write_pictures, args=(directory, camera), daemon=True).start()
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    if doorbell:
        listener.bind(str(directory / "doorbell.sock"))
        listener.listen()
    print(port, flush=True)
    if not doorbell:
        if sys.platform == "linux":  # or each sleep would take half as long again
            ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1)
        due = time.perf_counter()
        while True:
            memory.serve()
            now = time.perf_counter()
            due = max(due + _POLL_S, now)  # a sleep takes longer than it is told
            time.sleep(due - now)
    while True:
        client, _ = listener.accept()
        with contextlib.suppress(ConnectionError):  # the benchmark is over
            while client.recv(4096):
                served_at = -_BRISK_S
                while True:
                    if memory.serve():
                        client.send(_RUNG_FOR_REPLY)
                        served_at = time.monotonic()
                    elif time.monotonic() - served_at > _BRISK_S:
                        break


if __name__ == "__main__":
    _main()
