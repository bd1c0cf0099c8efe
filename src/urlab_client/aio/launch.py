"""`sim://…` addresses: a simulated server in a child process, started when first needed and stopped with the client.

The child runs this package's own command line, so the client does not import the server. The child exits when its
standard input closes, so it cannot outlive the client, however the client dies. A Ctrl-C that interrupts the client
does not reach the child: the simulation is still there afterwards.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import os
import signal
import subprocess
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Sequence
from typing import IO
from urllib.parse import parse_qsl, urlencode

import msgspec
from msgspec import Struct

from urlab_client._children import APART
from urlab_client.aio.transport.base import LateReply, TransportStats
from urlab_client.aio.transport.zmq import ZmqTransport
from urlab_client.protocol.base import Op
from urlab_client.protocol.errors import ClientClosed, ServerUnreachable
from urlab_client.protocol.messages.session import Hello, HelloOk
from urlab_client.protocol.messages.streams import ClientEvent

__all__ = [
    "SCHEME",
    "LaunchedTransport",
    "serve_arguments",
    "start_seconds",
    "with_model_options",
    "with_option",
    "with_start_timeout",
]

log: logging.Logger = logging.getLogger("urlab_client.launch")

SCHEME = "sim://"
_START_S = 60.0
_START_TIMEOUT = "start-timeout"
_CHUNK_BYTES = 65536
_STOP_S = 10.0  # it takes 0.2 s on an idle machine, and 3 s with eight programs per processor


class _Ready(Struct):
    """The line that `urlab serve --json` prints when clients can connect."""

    address: str
    step_port: int
    state_port: int
    scene_warnings: tuple[str, ...] = ()


def serve_arguments(address: str) -> list[str]:
    """Return the `urlab serve` arguments for a `sim://` address.

    `sim://MODEL` names an MJCF file, a saved level or a bundled robot. `?model=…` adds another one. Any other query
    item is an option of `urlab serve`: `sim://arm?model=ball&mjcf-options&controller=arm=pd`. `start-timeout=SECONDS`
    is for the client that starts the server; see `start_seconds`.

    Raises:
        ValueError: No model is named.
    """
    model, _, query = address.removeprefix(SCHEME).partition("?")
    if not model:
        raise ValueError(f"{address!r} names no model; write for example sim://arm or sim:///path/to/robot.xml")
    models, options = [model], list[str]()
    for key, value in parse_qsl(query, keep_blank_values=True):
        if key == "model":
            models.append(value)
        elif key != _START_TIMEOUT:
            options.append(f"--{key}={value}" if value else f"--{key}")
    return [*models, *options]


def start_seconds(address: str) -> float:
    """Return the seconds that the server of a `sim://` address may take to start: its `start-timeout`, or 60.

    Raises:
        ValueError: `start-timeout` is not a number of seconds above 0.
    """
    given = dict(parse_qsl(address.partition("?")[2])).get(_START_TIMEOUT)
    try:
        seconds = _START_S if given is None else float(given)
    except ValueError:
        seconds = math.nan
    if not 0 < seconds < math.inf:
        raise ValueError(f"{address!r}: {_START_TIMEOUT} must be a number of seconds above 0, not {given!r}")
    return seconds


def with_start_timeout(address: str, seconds: float) -> str:
    """Return a `sim://` address with a start timeout, unless it already has one. Other addresses do not change."""
    _, _, query = address.partition("?")
    if not address.startswith(SCHEME) or _START_TIMEOUT in dict(parse_qsl(query, keep_blank_values=True)):
        return address
    return f"{address}{'&' if query else '?'}{_START_TIMEOUT}={seconds:g}"


def with_option(address: str, name: str, value: str) -> str:
    """Return a `sim://` address with a further option for its server."""
    return f"{address}{'&' if '?' in address else '?'}{urlencode({name: value})}"


def with_model_options(address: str) -> str:
    """Return a `sim://` address whose server honours the model's `<option>`, unless the address sets that itself.

    Environments and policies use it, to train and evaluate the model as its author wrote it. A plain `sim://` address
    behaves like the plugin, which ignores the options.
    """
    model, _, query = address.partition("?")
    named = {key for key, _ in parse_qsl(query, keep_blank_values=True)}
    if not address.startswith(SCHEME) or named & {"mjcf-options", "no-mjcf-options"}:
        return address
    return f"{model}?{query}{'&' if query else ''}mjcf-options"


class LaunchedTransport:
    """Transport to a simulated server that it starts.

    Attributes:
        scene_warnings: Warnings of the server about its scene, from its start.
    """

    def __init__(self, address: str, *, shm: bool = False) -> None:
        self.stats: TransportStats = TransportStats()
        self._address = address
        self._arguments = serve_arguments(address)
        self._start_s = start_seconds(address)
        if shm and not any(argument.startswith("--shm-dir") for argument in self._arguments):
            self._arguments.append(f"--shm-dir={_memory_directory()}")
        self._process: asyncio.subprocess.Process | _Watched | None = None
        self._drain: asyncio.Task[None] | None = None
        self._watch: asyncio.Task[None] | None = None
        self._inner: ZmqTransport | None = None
        self._launching: asyncio.Task[ZmqTransport] | None = None
        self._state_port: int | None = None
        self._lost_at = 0.0
        self._closed = False
        self.on_event: Callable[[ClientEvent], None] | None = None
        self.scene_warnings: tuple[str, ...] = ()

    @property
    def state_port(self) -> int | None:
        """See `Transport.state_port`; None before the server runs."""
        return self._state_port

    @property
    def endpoint(self) -> str:
        """The server's RPC endpoint once it runs; the address before that."""
        return self._address if self._inner is None else self._inner.endpoint

    @property
    def connected(self) -> bool:
        """Whether the server is running and connected."""
        return self._inner is not None and self._inner.connected

    async def request(
        self, frame: bytes, op: Op, *, deadline: float | None, connect_by: float | None, late: LateReply | None = None
    ) -> bytes:
        """See `RequestTransport.request`. The first request also starts the server, which its deadline does not cover.

        If the server has died, a handshake starts another one; the new server would refuse any other request.
        """
        process = self._process
        if self._inner is not None and process is not None and process.returncode is not None:
            if op.request is not Hello:
                raise self._ended(process, op)
            self._lost_at = self._inner.lost_at
            await self._stop_server()
        if self._inner is None:
            loop = asyncio.get_running_loop()
            before = loop.time()
            self._inner = await self._started(op)
            took = loop.time() - before
            deadline = None if deadline is None else deadline + took
            connect_by = None if connect_by is None else connect_by + took
        return await self._inner.request(frame, op, deadline=deadline, connect_by=connect_by, late=late)

    async def follow(self, hello: HelloOk) -> None:
        """See `Transport.follow`. Does nothing: there is only one path."""

    async def aclose(self) -> None:
        """See `Transport.aclose`. Waits a bounded time for the server to end."""
        if self._closed:
            return
        self._closed = True
        if self._launching is not None:
            self._launching.cancel()
            await asyncio.wait((self._launching,))
        await self._stop_server()

    async def _stop_server(self) -> None:
        """Release the resources of the server that was started last, and wait a bounded time for its exit."""
        inner, self._inner = self._inner, None
        process, self._process = self._process, None
        drain, self._drain = self._drain, None
        watch, self._watch = self._watch, None
        if watch is not None:
            watch.cancel()
        if inner is not None:
            await inner.aclose()
        if process is None:
            return
        if process.stdin is not None:
            process.stdin.close()
        try:
            async with asyncio.timeout(_STOP_S):
                await process.wait()
        except TimeoutError:
            log.warning("%s: the server did not exit within %g s and was killed", self._address, _STOP_S)
        finally:  # also if cancelled: no process or pipe may be left behind
            _kill(process)
            await process.wait()
            # asyncio warns later about a pipe that is still open when its loop is closed.
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_STOP_S):
                    if drain is not None:
                        await drain
                    for pipe in (process.stdout, process.stderr):
                        if pipe is not None:
                            await pipe.read()

    async def _started(self, op: Op) -> ZmqTransport:
        """Start a server in a separate task, which both `aclose` and the waiting caller can cancel."""
        if self._closed:
            raise self._was_closed()
        await self._stop_server()  # remains of a cancelled start
        task = self._launching = asyncio.create_task(self._launch(op), name="urlab-launch")
        try:
            # If cancelled, this cancels the task and waits for its end.
            (transport,) = await asyncio.gather(task, return_exceptions=True)
        finally:
            self._launching = None
        if self._closed:
            raise self._was_closed()
        if isinstance(transport, BaseException):
            raise transport
        return transport

    async def _tell_end(self, process: asyncio.subprocess.Process | _Watched, transport: ZmqTransport) -> None:
        """Fail unsent requests that wait for a connection once the server has exited."""
        await process.wait()
        transport.fail_waiting(self._ended(process))

    def _ended(self, process: asyncio.subprocess.Process | _Watched, op: Op | None = None) -> ServerUnreachable:
        return ServerUnreachable(
            f"{f'{op.name}: ' if op else ''}the simulated server of {self._address} has exited with code "
            f"{process.returncode}. Nothing was sent.",
            op=op.name if op else None,
            hint="discover() starts another one.",
        )

    def _was_closed(self) -> ClientClosed:
        return ClientClosed(f"The client of {self._address} was closed.", hint="Create a new client.")

    async def _launch(self, op: Op) -> ZmqTransport:
        command = [sys.executable, "-m", "urlab_client", "serve", *_DEFAULTS, *self._arguments]
        process = await _start(command)
        self._process = process
        try:
            line = await self._first_line(process, op)
        except BaseException:  # also if cancelled: the next call starts another server
            _kill(process)
            raise
        ready = msgspec.json.decode(line, type=_Ready)
        if process.stderr is not None:
            self._drain = asyncio.create_task(_log_lines(process.stderr), name="urlab-server-log")
        transport = ZmqTransport(f"{ready.address}:{ready.step_port}")
        transport.stats = self.stats
        transport.on_event = self.on_event
        transport.lost_at = self._lost_at
        transport.refused = True
        self._watch = asyncio.create_task(self._tell_end(process, transport), name="urlab-server-end")
        self._state_port = ready.state_port
        self.scene_warnings = ready.scene_warnings
        for warning in ready.scene_warnings:
            warnings.warn(f"{self._address}: {warning}", stacklevel=2)
        return transport

    async def _first_line(self, process: asyncio.subprocess.Process | _Watched, op: Op) -> bytes:
        """Return the ready line, or raise with the server's error output."""
        output, errors = process.stdout, process.stderr
        if output is None or errors is None:
            raise TypeError("the server's output must be a pipe")
        try:
            async with asyncio.timeout(self._start_s):
                line = await output.readline()
                if line:
                    return line
                reason = (await errors.read()).decode(errors="replace").strip()
                await process.wait()
        except TimeoutError:
            reason = f"not ready within {self._start_s:g} s; add ?{_START_TIMEOUT}=SECONDS to the address for more"
        raise ServerUnreachable(
            f"{op.name}: no simulated server for {self._address}: {reason or 'it exited without output'}", op=op.name
        )


async def _start(command: Sequence[str]) -> asyncio.subprocess.Process | _Watched:
    pipe = subprocess.PIPE
    try:
        return await asyncio.create_subprocess_exec(*command, stdin=pipe, stdout=pipe, stderr=pipe, **APART)
    except NotImplementedError:  # asyncio raises it on a loop that cannot start processes
        return _Watched(subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, **APART))  # noqa: ASYNC220, S603


class _Watched:
    """A process that threads read from and wait for, with the part of `asyncio.subprocess.Process` used here.

    For loops that cannot start processes: the selector loop on Windows and, up to Python 3.13, loops of a policy
    without a child watcher, such as uvloop's.
    """

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self.pid = process.pid
        self.stdin = process.stdin
        self.stdout = asyncio.StreamReader()
        self.stderr = asyncio.StreamReader()
        self._process = process
        self._loop = asyncio.get_running_loop()
        self._ended = asyncio.Event()
        for target, *arguments in (
            (self._watch,),
            (self._feed, self.stdout, process.stdout),
            (self._feed, self.stderr, process.stderr),
        ):
            threading.Thread(target=target, args=arguments, name="urlab-server", daemon=True).start()

    @property
    def returncode(self) -> int | None:
        """The exit code; None while the process runs."""
        return self._process.returncode

    def kill(self) -> None:
        """Kill the process."""
        self._process.kill()

    async def wait(self) -> None:
        """Wait for the exit of the process."""
        await self._ended.wait()

    def _feed(self, reader: asyncio.StreamReader, pipe: IO[bytes]) -> None:
        with contextlib.suppress(RuntimeError), pipe:  # the loop is closed
            while data := os.read(pipe.fileno(), _CHUNK_BYTES):
                self._loop.call_soon_threadsafe(reader.feed_data, data)
            self._loop.call_soon_threadsafe(reader.feed_eof)

    def _watch(self) -> None:
        self._process.wait()
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(self._ended.set)


def _memory_directory() -> str:
    """Return the best directory for regions: in memory, if the system has one there."""
    memory = "/dev/shm"  # noqa: S108 - the server creates its own directory in it, accessible to its user only
    return memory if os.access(memory, os.W_OK) else tempfile.gettempdir()


_DEFAULTS: Sequence[str] = (
    "--json", "--until-eof", "--play",
    "--step-port=0", "--state-port=0", "--ctrl-port=0", "--info-port=0", "--camera-port=0",
)  # fmt: skip


def _kill(process: asyncio.subprocess.Process | _Watched) -> None:
    if process.returncode is not None:
        return
    if sys.platform == "win32":
        process.kill()
        return
    # Not `process.kill()`: it would reap a child that has just exited, whose status asyncio's watcher waits for.
    with contextlib.suppress(ProcessLookupError):
        os.kill(process.pid, signal.SIGKILL)


async def _log_lines(stream: asyncio.StreamReader) -> None:
    """Log what the server prints. An undrained pipe would block the server."""
    while True:
        try:
            line = await stream.readline()
        except ValueError:  # longer than the stream's limit, and dropped
            continue
        if not line:
            return
        log.info("server: %s", line.decode(errors="replace").rstrip())
