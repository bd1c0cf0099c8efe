"""What a client needs to talk to a server that demands keys, and which servers it takes binary models from."""

from __future__ import annotations

import ipaddress
import os
from dataclasses import dataclass

import zmq

from urlab_client.keys import KeyPair, public_key, read_pair

__all__ = ["SERVER_KEY_HINT", "ClientKeys", "client_keys", "is_local"]

SERVER_KEY_HINT = "Does the server demand CURVE keys? Then pass server_key=…, and client_key=… if it knows its clients."

_SERVER_VARIABLE = "URLAB_SERVER_KEY"
_CLIENT_VARIABLE = "URLAB_CLIENT_KEY"


@dataclass(frozen=True)
class ClientKeys:
    """Whom a client expects, and who it says it is.

    Attributes:
        server: The server's public key, Z85.
        own: The client's key pair.
    """

    server: bytes
    own: KeyPair

    def protect(self, socket: zmq.Socket[bytes]) -> None:
        """Make a socket speak CURVE; before it connects."""
        socket.curve_serverkey = self.server
        socket.curve_publickey = self.own.public
        socket.curve_secretkey = self.own.secret


def is_local(address: str) -> bool:
    """Whether the server at an address runs on this machine, so that nobody can stand in for it on the way."""
    scheme, _, rest = address.partition("://")
    if scheme != "tcp":
        return True
    head, _, tail = rest.rpartition(":")
    host = (head if tail.isdigit() and head else rest).strip("[]")
    try:
        return host == "localhost" or ipaddress.ip_address(host.partition("%")[0]).is_loopback
    except ValueError:
        return False


def client_keys(address: str, server_key: str | None, client_key: str | None) -> ClientKeys | None:
    """Return the keys for a server, None for one without.

    Args:
        address: Of the server. For one on another machine the environment may name files that are not given here.
        server_key: The server's public key, or a file with it; empty for none, whatever the environment says.
        client_key: The client's secret key file; None or empty for a key made up now.

    Raises:
        KeyFileError: A key is malformed.
        ValueError: Keys that cannot be used together, or for this address.
    """
    if not is_local(address):
        server_key = os.environ.get(_SERVER_VARIABLE) if server_key is None else server_key
        client_key = os.environ.get(_CLIENT_VARIABLE) if client_key is None and server_key else client_key
    if not server_key:
        if client_key:
            raise ValueError("client_key needs server_key: the client must know which server it talks to")
        return None
    if not address.startswith("tcp://"):
        raise ValueError(f"server_key is for servers at tcp:// addresses, not {address!r}")
    return ClientKeys(public_key(server_key), read_pair(client_key) if client_key else KeyPair.new())
