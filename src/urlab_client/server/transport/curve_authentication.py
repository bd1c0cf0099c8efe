"""Authentication of a server's clients: CURVE on each of its sockets, and ZeroMQ's authentication protocol (ZAP).

For `SimulatedServer` and the modules that own its sockets. ZeroMQ asks once per connection, before it reads anything
else from the peer.
"""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import zmq
import zmq.utils.z85

from urlab_client.errors import URLabError
from urlab_client.keys import KeyFileError, KeyPair, public_keys, read_pair
from urlab_client.server.system.threads import Health

logger: logging.Logger = logging.getLogger("urlab_client.server")

_ZAP: Final = "inproc://zeromq.zap.01"
_STOP: Final = "inproc://urlab-auth-stop"
_DOMAIN: Final = b"urlab"


class UnprotectedServer(URLabError, ValueError):
    """A server was to be opened to a network without a choice of protection."""


@dataclass(frozen=True, kw_only=True)
class CurveServer:
    """The key of a server and the clients that may connect. Contains file names, no secrets.

    Attributes:
        server_key: The server's secret key file (`NAME.key_secret`).
        allow: Public key files of clients, and folders of them; files are read when the server starts.
        allow_any: Accept everyone who knows the server's public key instead: traffic is encrypted, but clients are not
            authenticated.
    """

    server_key: str | os.PathLike[str]
    allow: Sequence[str | os.PathLike[str]] = ()
    allow_any: bool = False

    def __post_init__(self) -> None:
        if bool(self.allow) == self.allow_any:
            raise ValueError("state who may connect: key files of clients (allow), or anyone (allow_any)")


class CurveKeys:
    """The keys of a `CurveServer`, read from its files."""

    def __init__(self, curve: CurveServer) -> None:
        """Read the key files.

        Raises:
            KeyFileError: A file cannot be used.
        """
        self._pair: KeyPair = read_pair(curve.server_key)
        self._welcome = None if curve.allow_any else public_keys(curve.allow)
        if self._welcome is not None and self._pair.public in self._welcome and len(self._welcome) == 1:
            raise KeyFileError(
                "the only client let in would be the server itself.",
                hint="Create a key for each client: urlab keys new",
            )

    @property
    def public_key(self) -> str:
        """The server's public key, which clients need."""
        return self._pair.public.decode()

    @property
    def clients(self) -> int | None:
        """Number of clients that may connect; None for any."""
        return None if self._welcome is None else len(self._welcome)

    def welcomes(self, key: bytes) -> bool:
        """Whether the holder of a public key may connect."""
        return self._welcome is None or key in self._welcome

    def protect(self, socket: zmq.Socket[bytes]) -> None:
        """Enable CURVE on a socket. Call before binding it."""
        socket.curve_server = True
        socket.curve_publickey = self._pair.public
        socket.curve_secretkey = self._pair.secret
        socket.zap_domain = _DOMAIN


class ZapAuthenticator:
    """Authenticates the peers of one ZeroMQ context. Without keys it does nothing and has no thread."""

    # Not zmq.auth.thread.ThreadAuthenticator: it logs refused peers only at a hidden level and passes no address to its
    # callback; if its thread dies, it reports nothing and new clients wait forever; and it needs an event loop, which
    # on Windows requires tornado.

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], curve_keys: CurveKeys | None, health: Health) -> None:
        self._curve_keys = curve_keys
        self._thread: threading.Thread | None = None
        if curve_keys is None:
            return
        questions = context.socket(zmq.REP)
        questions.linger = 0
        questions.bind(_ZAP)
        stop = context.socket(zmq.PAIR)
        stop.bind(_STOP)
        self._stopper = context.socket(zmq.PAIR)
        self._stopper.linger = 0
        self._stopper.connect(_STOP)
        self._thread = health.thread("urlab-auth", _answer, curve_keys, questions, stop)
        self._thread.start()

    def protect(self, socket: zmq.Socket[bytes]) -> None:
        """Enable CURVE on a socket of the context, if there are keys. Call before binding it."""
        if self._curve_keys is not None:
            self._curve_keys.protect(socket)

    def close(self) -> None:
        """Stop the thread and close its sockets. Call before terminating the context. Idempotent."""
        thread, self._thread = self._thread, None
        if thread is not None:
            with contextlib.suppress(zmq.ZMQError):  # the thread died
                self._stopper.send(b"", zmq.NOBLOCK)
            thread.join()
            self._stopper.close()


def _answer(curve_keys: CurveKeys, questions: zmq.Socket[bytes], stop: zmq.Socket[bytes]) -> None:
    """Answer ZAP requests (ZeroMQ RFC 27) until told to stop."""
    poller = zmq.Poller()
    poller.register(questions, zmq.POLLIN)
    poller.register(stop, zmq.POLLIN)
    refused = 0
    with questions, stop:
        while stop not in dict(poller.poll()):
            version, number, _, address, _, mechanism, *credentials = questions.recv_multipart()
            welcome = (
                mechanism == b"CURVE"
                and len(credentials) == 1
                and curve_keys.welcomes(zmq.utils.z85.encode(credentials[0]))
            )
            status = (b"200", b"OK") if welcome else (b"400", b"this key is not welcome")
            questions.send_multipart([version, number, *status, b"", b""])
            refused += not welcome
            if not welcome and refused & (refused - 1) == 0:  # a refused client tries again
                logger.warning("a client at %s was refused: unknown key (%d so far)", address.decode(), refused)


def is_loopback(address: str) -> bool:
    """Whether an IP address can be reached only from this machine."""
    return ipaddress.ip_address(address.partition("%")[0]).is_loopback
