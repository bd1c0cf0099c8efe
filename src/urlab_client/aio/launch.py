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
import re
import signal
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import IO, TypeVarTuple
from urllib.parse import parse_qsl, urlencode

import msgspec
from msgspec import Struct

from urlab_client._platform.children import APART
from urlab_client.aio.background import Tell, background_task, background_thread
from urlab_client.aio.transport.base import LateReply, RequestTransport, TransportStats
from urlab_client.aio.transport.connection import ClientKeys
from urlab_client.aio.transport.zmq import ZmqTransport
from urlab_client.errors import ClientClosed, ServerUnreachable, URLabError
from urlab_client.events import ClientEvent
from urlab_client.protocol.base import Op
from urlab_client.protocol.messages.session import Hello, HelloOk

log: logging.Logger = logging.getLogger("urlab_client.launch")

Ts = TypeVarTuple("Ts")

SCHEME = "sim://"
_START_S = 60.0
_START_TIMEOUT = "start-timeout"
_CHUNK_BYTES = 65536
_LOOK_S = 0.05
_OPENING = frozenset({"allow-any-client", "allow-client", "insecure-no-auth", "server-key"})
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
        ValueError: No model is named, or an option would open the server to others.
    """
    models, options = _parsed(address)
    for key, _ in options:
        name = key.partition("=")[0]  # `server-key%3DFILE` is one key, and sets the option, too
        if name in _OPENING:
            raise ValueError(
                f"{address!r}: '{name}' is for a server that others use, and this one is for its client alone; start "
                "it with `urlab serve`"
            )
    arguments = [f"--{key}={value}" if value else f"--{key}" for key, value in options if key != _START_TIMEOUT]
    return [*models, *arguments]


def _parsed(address: str) -> tuple[list[str], list[tuple[str, str]]]:
    """Return the models of a `sim://` address and its options."""
    model, _, query = address.removeprefix(SCHEME).partition("?")
    items = parse_qsl(query, keep_blank_values=True)
    models = [model, *(value for key, value in items if key == "model")]
    for name in models:
        if not name or name.startswith("-"):  # an option, to the command line
            raise ValueError(
                f"{address!r} names no model{name and f' but the option {name!r}'}; write for example sim://arm or "
                "sim:///path/to/robot.xml"
            )
    return models, [(key, value) for key, value in items if key != "model"]


def check_address(
    address: str, *, models: Collection[str] = (), options: Collection[str] = (), servers: Collection[str] = ()
) -> str:
    """Return an address that comes from outside, such as a form of a web page, if all that it says is allowed.

    Without this, a `sim://` address reads and writes files of this machine, because it is a command line, and the
    other addresses reach every server that this machine reaches.

    Args:
        address: The address.
        models: Models that a `sim://` address may name, such as `arm`.
        options: Options that it may set, to any value, such as `camera-size`.
        servers: Other addresses that are allowed, such as `tcp://localhost`.

    Raises:
        ValueError: The address says something else, which the message names.
    """
    if not address.startswith(SCHEME):
        if address not in servers:
            raise ValueError(f"the server {address!r} is not one of those that are allowed")
        return address
    named, given = _parsed(address)
    for what, used, allowed in (("model", named, models), ("option", [key for key, _ in given], options)):
        if refused := [name for name in used if name not in allowed]:
            raise ValueError(f"{address!r}: the {what} {refused[0]!r} is not one of those that are allowed")
    serve_arguments(address)
    return address


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

    @property
    def owed(self) -> bool:
        """See `RequestTransport.owed`."""
        return self._inner is not None and self._inner.owed

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
            # Until Python 3.13 the wait ends with the pipes, which what the server has forked may hold for longer.
            with contextlib.suppress(TimeoutError, URLabError):  # a pipe that could not be read was reported
                async with asyncio.timeout(_STOP_S):
                    await process.wait()
                    # asyncio warns later about a pipe that is still open when its loop is closed.
                    if drain is not None:
                        await asyncio.wait((drain,))
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
        process = await _start(command, self.on_event)
        self._process = process
        try:
            ready = await self._ready_line(process, op)
        except BaseException:  # also if cancelled: the next call starts another server
            _kill(process)
            raise
        if process.stderr is not None:
            self._drain = background_task("urlab-server-log", _log_lines(process.stderr), tell=self.on_event)
        transport = ZmqTransport(f"{ready.address}:{ready.step_port}")
        transport.stats = self.stats
        transport.on_event = self.on_event
        transport.lost_at = self._lost_at
        transport.refused = True
        ending = self._tell_end(process, transport)
        self._watch = background_task("urlab-server-end", ending, tell=self.on_event, failed=transport.fail_waiting)
        self._state_port = ready.state_port
        self.scene_warnings = ready.scene_warnings
        for warning in ready.scene_warnings:
            warnings.warn(f"{self._address}: {warning}", stacklevel=2)
        return transport

    async def _ready_line(self, process: asyncio.subprocess.Process | _Watched, op: Op) -> _Ready:
        """Return what the server says when it is ready, or raise with the server's error output."""
        output, errors = process.stdout, process.stderr
        if output is None or errors is None:
            raise TypeError("the server's output must be a pipe")
        try:
            async with asyncio.timeout(self._start_s):
                line = await output.readline()
                if line:
                    return msgspec.json.decode(line, type=_Ready)
                reason = (await errors.read()).decode(errors="replace").strip()
                await process.wait()
        except TimeoutError:
            reason = f"not ready within {self._start_s:g} s; add ?{_START_TIMEOUT}=SECONDS to the address for more"
        except (ValueError, RecursionError) as error:
            reason = f"its first line is not a server's: {error}"
        raise ServerUnreachable(
            f"{op.name}: no simulated server for {self._address}: {reason or 'it exited without output'}", op=op.name
        )


async def _start(command: Sequence[str], tell: Tell | None) -> asyncio.subprocess.Process | _Watched:
    pipe = subprocess.PIPE
    try:
        return await asyncio.create_subprocess_exec(*command, stdin=pipe, stdout=pipe, stderr=pipe, **APART)
    except NotImplementedError:  # asyncio raises it on a loop that cannot start processes
        process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, **APART)  # noqa: ASYNC220, S603
        return _Watched(process, tell)


class _Watched:
    """A process that threads read from and wait for, with the part of `asyncio.subprocess.Process` used here.

    For loops that cannot start processes: the selector loop on Windows and, up to Python 3.13, loops of a policy
    without a child watcher, such as uvloop's.
    """

    def __init__(self, process: subprocess.Popen[bytes], tell: Tell | None) -> None:
        self.pid = process.pid
        self.stdin = process.stdin
        self.stdout = asyncio.StreamReader()
        self.stderr = asyncio.StreamReader()
        self._process = process
        self._loop = asyncio.get_running_loop()
        self._ended = asyncio.Event()
        background_thread("urlab-server", self._watch, tell=tell, failed=lambda _: self._soon(self._ended.set)).start()
        for reader, pipe in ((self.stdout, process.stdout), (self.stderr, process.stderr)):
            if pipe is not None:
                fail = partial(self._fail, reader)
                background_thread("urlab-server", self._feed, reader, pipe, tell=tell, failed=fail).start()

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
        while self._process.poll() is None:  # noqa: ASYNC110 - the thread that waits for it died
            await asyncio.sleep(_LOOK_S)

    def _feed(self, reader: asyncio.StreamReader, pipe: IO[bytes]) -> None:
        with pipe:
            while data := os.read(pipe.fileno(), _CHUNK_BYTES):
                self._soon(reader.feed_data, data)
        self._soon(reader.feed_eof)

    def _fail(self, reader: asyncio.StreamReader, error: URLabError) -> None:
        self._soon(reader.set_exception, error)

    def _watch(self) -> None:
        self._process.wait()
        self._soon(self._ended.set)

    def _soon(self, callback: Callable[[*Ts], object], *arguments: *Ts) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(callback, *arguments)


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


_HOST = re.compile(r"(\[[^\[\]\s]+\]|[^:\[\]\s]+)(:(?P<port>[0-9]+))?")
_LAST_PORT = 65535


def transport_to(address: str, step_port: int, keys: ClientKeys | None, *, shm: bool) -> RequestTransport:
    """Return the transport to a server at an address.

    Raises:
        ValueError: The address is malformed.
    """
    if address.startswith(SCHEME):
        return LaunchedTransport(address, shm=shm)
    scheme, separator, rest = address.partition("://")
    if not separator or scheme not in {"tcp", "ipc"} or not rest:
        raise ValueError(f"{address!r} is not a valid address; write tcp://HOST, ipc://PATH or sim://MODEL")
    own_port = False
    if scheme == "tcp":
        host = _HOST.fullmatch(rest)
        if host is None or not 0 < int(host["port"] or 1) <= _LAST_PORT:
            raise ValueError(
                f"{address!r} is not a valid address; write tcp://HOST or tcp://HOST:PORT, as in tcp://[::1]:5559"
            )
        own_port = host["port"] is not None
    return ZmqTransport(address if own_port else f"{address}:{step_port}", keys)
