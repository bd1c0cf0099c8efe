"""Who may connect to a server: CURVE on each of its sockets, and the answer to ZeroMQ's question who is welcome.

For `SimulatedServer` and the modules that own its sockets. ZeroMQ asks once per connection, before anything else of
the peer is read.
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

from urlab_client.keys import KeyFileError, KeyPair, public_keys, read_pair
from urlab_client.protocol.errors import URLabError
from urlab_client.server.system.health import Health

__all__ = ["CurveKeys", "CurveServer", "UnprotectedServer", "ZapAuthenticator", "is_loopback"]

logger: logging.Logger = logging.getLogger("urlab_client.server")

_ZAP: Final = "inproc://zeromq.zap.01"
_STOP: Final = "inproc://urlab-auth-stop"
_DOMAIN: Final = b"urlab"


class UnprotectedServer(URLabError, ValueError):
    """A server was to be open to the network without saying how it is protected."""


@dataclass(frozen=True, kw_only=True)
class CurveServer:
    """The key of a server and who may talk to it. Holds names of files, no secrets.

    Attributes:
        server_key: The server's secret key file (`NAME.key_secret`).
        allow: Public key files of clients, and folders of such; files are read when the server starts.
        allow_any: Let in whoever knows the server's public key instead: traffic is then encrypted, and clients are
            not told apart.
    """

    server_key: str | os.PathLike[str]
    allow: Sequence[str | os.PathLike[str]] = ()
    allow_any: bool = False

    def __post_init__(self) -> None:
        if bool(self.allow) == self.allow_any:
            raise ValueError("state who may connect: key files of clients (allow), or anyone (allow_any)")


class CurveKeys:
    """What is known of a `CurveServer` once its files are read."""

    def __init__(self, curve: CurveServer) -> None:
        """Read the key files.

        Raises:
            KeyFileError: One of them is unusable.
        """
        self._pair: KeyPair = read_pair(curve.server_key)
        self._welcome = None if curve.allow_any else public_keys(curve.allow)
        if self._welcome is not None and self._pair.public in self._welcome and len(self._welcome) == 1:
            raise KeyFileError(
                "the only client let in would be the server itself.", hint="Make a key for each client: urlab keys new"
            )

    @property
    def public_key(self) -> str:
        """The server's public key, which clients need."""
        return self._pair.public.decode()

    @property
    def clients(self) -> int | None:
        """How many clients are welcome; None for any."""
        return None if self._welcome is None else len(self._welcome)

    def welcomes(self, key: bytes) -> bool:
        """Whether the holder of a public key may connect."""
        return self._welcome is None or key in self._welcome

    def protect(self, socket: zmq.Socket[bytes]) -> None:
        """Make a socket speak CURVE; before it is bound."""
        socket.curve_server = True
        socket.curve_publickey = self._pair.public
        socket.curve_secretkey = self._pair.secret
        socket.zap_domain = _DOMAIN


class ZapAuthenticator:
    """Guards the sockets of one ZeroMQ context. Without keys it has nothing to do, and no thread."""

    # Not zmq.auth.thread.ThreadAuthenticator: who is refused is not told at a level that is shown, nor its address to a
    # callback; when its thread dies nobody is told and every new client waits for ever; and it needs an event loop,
    # which on Windows takes tornado.

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
        arguments = (curve_keys, questions, stop, health)
        self._thread = threading.Thread(target=_answer, args=arguments, name="urlab-auth", daemon=True)
        self._thread.start()

    def protect(self, socket: zmq.Socket[bytes]) -> None:
        """Make a socket of the context speak CURVE, if there are keys; before it is bound."""
        if self._curve_keys is not None:
            self._curve_keys.protect(socket)

    def close(self) -> None:
        """End the thread and its sockets, before the context is terminated. Idempotent."""
        thread, self._thread = self._thread, None
        if thread is not None:
            with contextlib.suppress(zmq.ZMQError):  # it died
                self._stopper.send(b"", zmq.NOBLOCK)
            thread.join()
            self._stopper.close()


def _answer(curve_keys: CurveKeys, questions: zmq.Socket[bytes], stop: zmq.Socket[bytes], health: Health) -> None:
    """Answer ZAP requests (ZeroMQ RFC 27) until told to stop."""
    poller = zmq.Poller()
    poller.register(questions, zmq.POLLIN)
    poller.register(stop, zmq.POLLIN)
    refused = 0
    with health.watch(), questions, stop:
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
            if not welcome and refused & (refused - 1) == 0:  # whoever is refused tries again
                logger.warning("a client at %s was refused: unknown key (%d so far)", address.decode(), refused)


def is_loopback(address: str) -> bool:
    """Whether an IP address is reached from this machine alone."""
    return ipaddress.ip_address(address.partition("%")[0]).is_loopback
