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
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Collection, Sequence
from typing import IO, Final, TypeVarTuple, cast
from urllib.parse import parse_qsl, urlencode
from weakref import WeakMethod

import msgspec
from msgspec import Struct

from urlab_client._platform.signals import APART
from urlab_client.aio.background import Tell, background_thread
from urlab_client.aio.transport.base import Deadlines, LateReply
from urlab_client.aio.transport.connection import ClientKeys
from urlab_client.aio.transport.shm import ShmRequests
from urlab_client.aio.transport.shm_regions import ServerRegions
from urlab_client.aio.transport.zmq import ZmqTransport
from urlab_client.errors import ServerUnreachable, URLabError
from urlab_client.events import ClientEvent
from urlab_client.protocol.base import Op
from urlab_client.protocol.messages.session import Hello

log: logging.Logger = logging.getLogger("urlab_client.launch")

Ts = TypeVarTuple("Ts")

SCHEME = "sim://"
SHARED_MEMORY: Final = "/dev/shm"  # noqa: S108 - a server creates its own directory in it, accessible to its user only
_START_S = 60.0
_START_TIMEOUT = "start-timeout"
_CHUNK_BYTES = 65536
_WARNS = "urlab serve: warning: "
_LOOK_S = 0.01
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


def with_option(address: str, name: str, value: str = "", *, default: bool = False) -> str:
    """Return a `sim://` address with a further option for its server. Other addresses do not change.

    Args:
        address: The address.
        name: Name of the option.
        value: Its value; empty for a switch.
        default: Only if the address does not set the option itself, nor its opposite.
    """
    _, separator, query = address.partition("?")
    named = {key for key, _ in parse_qsl(query, keep_blank_values=True)}
    if not address.startswith(SCHEME) or (default and named & {name, f"no-{name}"}):
        return address
    item = urlencode({name: value}) if value else name
    return f"{address}{'&' if query else '' if separator else '?'}{item}"


def with_model_options(address: str) -> str:
    """Return a `sim://` address whose server honours the model's `<option>`, unless the address sets that itself.

    Environments and policies use it, to train and evaluate the model as its author wrote it. A plain `sim://` address
    behaves like the plugin, which ignores the options.
    """
    return with_option(address, "mjcf-options", default=True)


class LaunchedTransport(ZmqTransport):
    """Transport to a simulated server that it starts.

    Attributes:
        scene_warnings: Warnings of the server about its scene, from its start.
    """

    def __init__(self, address: str, *, shm: bool = False) -> None:
        super().__init__(address)  # the endpoint until the server runs
        self._address = address
        self._arguments = serve_arguments(address)
        self._start_s = start_seconds(address)
        if shm and not any(argument.startswith("--shm-dir") for argument in self._arguments):
            self._arguments.append(f"--shm-dir={_memory_directory()}")
        self._process: _ServerProcess | None = None
        self.scene_warnings: tuple[str, ...] = ()

    async def request(self, frame: bytes, op: Op, deadlines: Deadlines, *, late: LateReply | None = None) -> bytes:
        """See `ZmqTransport.request`. The first request also starts the server, which its deadline does not cover.

        If the server has died, a handshake starts another one; the new server would refuse any other request.
        """
        process = self._process
        if process is None or process.returncode is not None:
            if self.connected:
                self._lose()  # the server's end is known before that of the connection
            if process is not None and op.request is not Hello:
                raise self._ended(process, op)
            loop = asyncio.get_running_loop()
            before = loop.time()
            await self._launch(op)
            took = loop.time() - before
            reply, connect = (None if by is None else by + took for by in (deadlines.reply, deadlines.connect))
            deadlines = Deadlines(reply, connect)
        return await super().request(frame, op, deadlines, late=late)

    async def aclose(self) -> None:
        """See `ZmqTransport.aclose`. Waits a bounded time for the server to end."""
        await super().aclose()
        process, self._process = self._process, None
        if process is None:
            return
        try:
            if not await process.end(_STOP_S):
                log.warning("%s: the server did not exit within %g s and was killed", self._address, _STOP_S)
        finally:  # also if cancelled: no process may be left behind
            await process.kill()

    async def _launch(self, op: Op) -> None:
        """Start a server, and wait until it is ready."""
        if self._closed:
            raise self._was_closed()
        self._disconnect()
        if self._process is not None:
            await self._process.kill()
        command = [sys.executable, "-m", "urlab_client", "serve", *_DEFAULTS, *self._arguments]
        process = self._process = _ServerProcess(command, self._on_end, self._tell)
        try:
            ready = await self._ready_line(process, op)
        except BaseException as error:  # also if cancelled: the next call starts another server
            try:
                await process.kill()
            finally:  # also if cancelled again
                self._process = None
            if self._closed and isinstance(error, URLabError):
                raise self._was_closed() from None
            raise
        process.logs.set()
        self.endpoint = f"{ready.address}:{ready.step_port}"
        self.refused = True
        self.state_port = ready.state_port
        self.scene_warnings = ready.scene_warnings
        for warning in ready.scene_warnings:
            warnings.warn(f"{self._address}: {warning}", stacklevel=2)

    def _on_end(self) -> None:
        """Fail unsent requests that wait for a connection once the server has exited."""
        process = self._process
        if process is not None and process.logs.is_set() and process.returncode is not None:
            self.fail_waiting(self._ended(process))

    def _ended(self, process: _ServerProcess, op: Op | None = None) -> ServerUnreachable:
        return ServerUnreachable(
            f"{f'{op.name}: ' if op else ''}the simulated server of {self._address} has exited with code "
            f"{process.returncode}. Nothing was sent.",
            op=op.name if op else None,
            hint="discover() starts another one.",
        )

    async def _ready_line(self, process: _ServerProcess, op: Op) -> _Ready:
        """Return what the server says when it is ready, or raise with the server's error output."""
        try:
            async with asyncio.timeout(self._start_s):
                line = await process.first_line
                if line:
                    return msgspec.json.decode(line, type=_Ready)
                reason = await process.last_words()
        except TimeoutError:
            reason = f"not ready within {self._start_s:g} s; add ?{_START_TIMEOUT}=SECONDS to the address for more"
        except (ValueError, RecursionError) as error:
            reason = f"its first line is not a server's: {error}"
        raise ServerUnreachable(
            f"{op.name}: no simulated server for {self._address}: {reason or 'it exited without output'}", op=op.name
        )


class _ServerProcess:
    """A child process that threads read from, because not every event loop can start processes.

    Such are the selector loop on Windows and, up to Python 3.13, loops of a policy without a child watcher. The threads
    do not hold this object: when it is forgotten, the child's input closes, and the child exits.

    Args:
        command: What to run.
        on_end: Called on the event loop when the process has ended.
        tell: Publishes the event that a thread died.

    Attributes:
        first_line: What it prints first; empty if it prints nothing.
        errors: What it writes to its error output, while `logs` is not set.
        logs: Whether to log that output instead.
    """

    def __init__(self, command: Sequence[str], on_end: Callable[[], object], tell: Tell) -> None:
        pipe = subprocess.PIPE
        process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, **APART)  # noqa: S603
        loop = asyncio.get_running_loop()
        self.pid: int = process.pid
        self.first_line: asyncio.Future[bytes] = loop.create_future()
        self.errors: list[str] = []
        self.logs: threading.Event = threading.Event()
        self._process = process
        self._input, process.stdin = process.stdin, None
        first_line, ended, told = self.first_line, WeakMethod(on_end), WeakMethod(tell)

        def soon(callback: Callable[[*Ts], object], *arguments: *Ts) -> None:
            with contextlib.suppress(RuntimeError):  # the loop is closed
                loop.call_soon_threadsafe(callback, *arguments)

        def read(output: IO[bytes]) -> None:
            with output:
                soon(_settle, first_line, output.readline(_CHUNK_BYTES))
                while output.read(_CHUNK_BYTES):
                    pass  # a full pipe would block the server
            process.wait()
            soon(lambda: (on_end := ended()) and on_end())

        def tell_of(event: ClientEvent) -> None:
            if (tell := told()) is not None:
                tell(event)

        output, errors = cast("IO[bytes]", process.stdout), cast("IO[bytes]", process.stderr)
        self._log = background_thread("urlab-server", _log_lines, errors, self.errors, self.logs, tell=tell_of)
        self._log.start()
        background_thread(
            "urlab-server", read, output, tell=tell_of, failed=lambda error: soon(_settle, first_line, error)
        ).start()

    @property
    def returncode(self) -> int | None:
        """The exit code; None while the process runs."""
        return self._process.poll()

    async def last_words(self) -> str:
        """Wait for the end and return the error output."""
        await self.wait()
        while self._log.is_alive():  # noqa: ASYNC110 - a thread has no event
            await asyncio.sleep(_LOOK_S)
        return "".join(self.errors).strip()

    async def wait(self, seconds: float = math.inf) -> bool:
        """Wait for the end; return whether it came in time."""
        give_up = time.monotonic() + seconds
        while self.returncode is None and time.monotonic() < give_up:  # noqa: ASYNC110 - likewise
            await asyncio.sleep(_LOOK_S)
        return self.returncode is not None

    async def end(self, seconds: float) -> bool:
        """Close the input, which ends the process; return whether it ended in time."""
        if self._input is not None:
            self._input.close()
        return await self.wait(seconds)

    async def kill(self) -> None:
        """End the process at once, if it still runs, and close its input."""
        self._process.kill()
        await self.end(_STOP_S)


def _settle(first_line: asyncio.Future[bytes], result: bytes | URLabError) -> None:
    if first_line.done():
        return
    if isinstance(result, bytes):
        first_line.set_result(result)
    else:
        first_line.set_exception(result)


def _log_lines(pipe: IO[bytes], errors: list[str], logs: threading.Event) -> None:
    """Log what the server prints. An undrained pipe would block the server."""
    with pipe:
        while line := pipe.readline(_CHUNK_BYTES):
            text = line.decode(errors="replace")
            if logs.is_set():
                log.log(logging.WARNING if text.startswith(_WARNS) else logging.INFO, "server: %s", text.rstrip())
            else:
                errors.append(text)


def _memory_directory() -> str:
    """Return the best directory for regions: in memory, if the system has one there."""
    return SHARED_MEMORY if os.access(SHARED_MEMORY, os.W_OK) else tempfile.gettempdir()


_DEFAULTS: Sequence[str] = (
    "--json", "--until-eof", "--play",
    "--step-port=0", "--state-port=0", "--ctrl-port=0", "--info-port=0", "--camera-port=0",
)  # fmt: skip


_HOST = re.compile(r"(\[[^\[\]\s]+\]|[^:\[\]\s]+)(:(?P<port>[0-9]+))?")
_LAST_PORT = 65535


def transport_to(
    address: str, step_port: int, keys: ClientKeys | None, memory: ServerRegions | None = None
) -> ZmqTransport:
    """Return the transport to a server at an address, with requests over shared memory if there is `memory`.

    Raises:
        ValueError: The address is malformed.
    """
    transport = _over_zmq(address, step_port, keys, shm=memory is not None)
    if memory is not None:
        transport.shared = ShmRequests(transport, memory)
    return transport


def _over_zmq(address: str, step_port: int, keys: ClientKeys | None, *, shm: bool) -> ZmqTransport:
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
