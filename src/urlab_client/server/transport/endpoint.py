"""The request socket of a server: one ZeroMQ REP socket, served by one thread. Also helpers for binding sockets.

For `SimulatedServer`. Handles frames without interpreting them; a callback answers each.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import socket
from collections.abc import Callable
from typing import ClassVar, Final

import zmq

from urlab_client._platform.signals import uninterrupted
from urlab_client.server.limits import Limits
from urlab_client.server.system.threads import Health, ServingThread
from urlab_client.server.transport.curve_authentication import CurveKeys, ZapAuthenticator

logger: logging.Logger = logging.getLogger("urlab_client.server")

LINGER_MS: Final = 500
"""How long an unsent reply may keep the socket open after the end."""

HEARTBEAT_MS: Final = 2000
SILENCE_MS: Final = 10_000
"""A peer that answers no heartbeat for this long is disconnected. Its I/O thread answers even if its program is
busy."""

HANDSHAKE_MS: Final = 5000
"""Deadline for the ZeroMQ handshake of a connection, after which it is closed."""

BACKLOG: Final = 128
"""Length of the queue of connections to accept."""

QUEUED_REQUESTS: Final = 16
"""Requests of one peer that may wait; beyond that, ZeroMQ stops reading from the peer. Clients send one at a time.
ZeroMQ wakes its I/O thread after half of this number of requests: with 4, a step takes 5 % longer."""

_WAKE = "inproc://urlab-wake"


class PortInUse(OSError):
    """Another program, often another server, uses the port.

    Attributes:
        host: Address of the interface.
        port: TCP port.
    """

    host: str
    port: int

    def __init__(self, host: str, port: int, option: str = "port") -> None:
        """Build the message; `option` is the setting that chooses another port."""
        super().__init__(
            errno.EADDRINUSE,
            f"{tcp(host)}:{port} is in use: end the program that uses it, "
            f"or choose another {option} (0 picks a free one; on the command line --{option.replace('_', '-')} 0)",
        )
        self.host = host
        self.port = port
        self._option = option

    def __reduce__(self) -> tuple[type[PortInUse], tuple[str, int, str]]:
        return type(self), (self.host, self.port, self._option)


def numeric_host(host: str) -> str:
    """Return the IP address to bind for `host`; empty or `*` means all IPv4 interfaces.

    Raises:
        OSError: The host does not exist.
    """
    if host in ("", "*"):
        return "0.0.0.0"  # noqa: S104 - asked for
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except socket.gaierror as error:
        raise OSError(error.errno, f"cannot bind to {host!r}: {error.strerror}") from error
    # IPv4 first, like clients, which resolve `localhost` to 127.0.0.1.
    family_first = sorted(found, key=lambda entry: entry[0] != socket.AF_INET)
    return str(family_first[0][4][0])


def connect_host(host: str) -> str:
    """Return the host for clients on this machine of a server bound to the address `host`."""
    return {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)  # noqa: S104


def tcp(host: str) -> str:
    """Return the ZeroMQ address of an IP address, without a port."""
    return f"tcp://[{host}]" if ":" in host else f"tcp://{host}"


def bind_tcp(socket: zmq.Socket[bytes], host: str, port: int, option: str) -> int:
    """Bind a ZeroMQ socket, whose options for new connections are set, and return its port.

    Raises:
        PortInUse: The port is in use.
        OSError: The address does not belong to this machine.
    """
    socket.ipv6 = ":" in host
    try:
        socket.bind(f"{tcp(host)}:{port}")
    except zmq.ZMQError as error:
        if error.errno == zmq.Errno.EADDRINUSE:  # on Windows a different number from Python's
            raise PortInUse(host, port, option) from error
        raise OSError(error.errno, f"cannot bind {tcp(host)}:{port}: {error.strerror}") from error
    return int(socket.get_string(zmq.LAST_ENDPOINT).rpartition(":")[2])


def bound_peers(socket: zmq.Socket[bytes]) -> None:
    """Disconnect peers that are gone, half-open or do not speak ZeroMQ. Call before binding the socket."""
    socket.heartbeat_ivl = HEARTBEAT_MS
    socket.heartbeat_timeout = SILENCE_MS
    socket.heartbeat_ttl = SILENCE_MS
    socket.handshake_ivl = HANDSHAKE_MS
    socket.backlog = BACKLOG


class RpcEndpoint:
    """Receives requests one at a time and sends what `answer` returns."""

    kind: ClassVar[int] = zmq.REP
    port: int
    serving: ServingThread

    def __init__(
        self,
        answer: Callable[[bytes], bytes],
        *,
        refuse: Callable[[str, str], bytes],
        health: Health,
        host: str = "127.0.0.1",
        port: int = 0,
        curve_keys: CurveKeys | None = None,
        request_bytes: int = Limits.request_bytes,
    ) -> None:
        """Bind the socket; `start` begins to serve.

        Args:
            answer: Turns the frame of a request into the frame of its reply; must not raise.
            refuse: Builds the frame of an error from its code and message, in case `answer` raises nevertheless.
            health: Notified when the thread dies.
            host: IP address of the interface.
            port: TCP port; 0 picks a free one.
            curve_keys: Who may connect; None for anyone who can reach the interface.
            request_bytes: Largest request that is processed.

        Raises:
            PortInUse: The port is in use.
            OSError: The address does not belong to this machine.
        """
        self._answer = answer
        self._refuse = refuse
        self._health = health
        self._context = zmq.Context()
        self._context.linger = LINGER_MS
        self._authenticator = ZapAuthenticator(self._context, curve_keys, health)
        self._socket = self._context.socket(self.kind)
        self._authenticator.protect(self._socket)
        bound_peers(self._socket)
        # A frame between the two limits is refused with the reason; for one beyond both, the connection is closed.
        self._socket.maxmsgsize = 2 * request_bytes
        self._socket.rcvhwm = QUEUED_REQUESTS
        try:
            self.port = bind_tcp(self._socket, host, port, "step_port")
        except BaseException:
            self._authenticator.close()
            with uninterrupted():
                self._context.destroy(linger=0)
            raise
        self._socket.bind(_WAKE)
        self._waker = self._context.socket(zmq.DEALER)
        self._waker.connect(_WAKE)
        self._stopping = False
        self.serving = ServingThread("urlab-rpc", self._run, health)

    @property
    def alive(self) -> bool:
        """Whether requests are served."""
        return self.serving.alive

    def start(self) -> None:
        """Start the thread that serves."""
        self.serving.start()

    def stop(self) -> None:
        """Ask the thread to end after the current request, without waiting. Call once."""
        self._stopping = True
        with contextlib.suppress(zmq.ZMQError):  # the thread has ended already
            self._waker.send_multipart([b"", b""], zmq.NOBLOCK)
        self._waker.close()

    def join(self, timeout: float) -> bool:
        """Wait for the thread to end after `stop`.

        Returns False if the current request took longer; the thread then closes the socket when it has finished.
        """
        if not self.serving.started:
            self._close()
            return True
        return self.serving.join(timeout)

    def _run(self, owed: bytes | None) -> None:
        try:
            if owed is not None:
                self._send_owed(owed)
            while self._serve():
                pass
        finally:
            if self.serving.is_current:
                self._close()

    def _serve(self) -> bool:
        """Answer one request, with the error if that fails; return False when the thread must end."""
        try:
            return self._exchange()
        except zmq.ZMQError:
            raise
        except BaseException as error:  # noqa: BLE001 - clients wait; from now on the answer says what happened
            if not self.serving.finish():
                return False
            reason = self._health.report(error)
            with contextlib.suppress(zmq.ZMQError):  # no request is pending
                self._send_owed(self._refuse("internal_error", reason))
            return True

    def _send_owed(self, reply: bytes) -> None:
        """Answer the last received request if it is still unanswered."""
        self._socket.send(reply, zmq.NOBLOCK)

    def _exchange(self) -> bool:
        """Answer one request; return False when the thread must end."""
        socket = self._socket
        frame = socket.recv()
        # A request of several frames is invalid: executing the first one would be a guess.
        while socket.getsockopt(zmq.RCVMORE):
            socket.recv()
            frame = b""
        if self._stopping:
            return False
        self.serving.begin()
        reply = self._answer(frame)
        if not self.serving.finish():
            return False
        socket.send(reply)
        return True

    def _close(self) -> None:
        self._socket.close()
        self._authenticator.close()
        with uninterrupted():
            self._context.term()
