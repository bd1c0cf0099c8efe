"""From a client's address to its transport."""

from __future__ import annotations

import re

from urlab_client.aio.launch import SCHEME, LaunchedTransport
from urlab_client.aio.transport.base import RequestTransport
from urlab_client.aio.transport.connection import ClientKeys
from urlab_client.aio.transport.zmq import ZmqTransport

_HOST = re.compile(r"(\[[^\[\]\s]+\]|[^:\[\]\s]+)(:(?P<port>[0-9]+))?")
_LAST_PORT = 65535


def transport_to(address: str, step_port: int, keys: ClientKeys | None, *, shm: bool) -> RequestTransport:
    """Return the transport to a server at an address.

    Args:
        address: Address given by the user.
        step_port: RPC port, if the address names none.
        keys: CURVE keys for the server; None if it needs none.
        shm: Whether a server that this process starts offers shared memory.

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
