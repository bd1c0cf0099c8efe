"""Keys for servers that require them, and the check for servers on this machine."""

from __future__ import annotations

import ipaddress
import os
from dataclasses import dataclass

import zmq

from urlab_client.keys import KeyPair, public_key, read_pair

SERVER_KEY_HINT = "If the server requires CURVE keys, pass server_key=…, and client_key=… if it knows its clients."

_SERVER_VARIABLE = "URLAB_SERVER_KEY"
_CLIENT_VARIABLE = "URLAB_CLIENT_KEY"


@dataclass(frozen=True)
class ClientKeys:
    """The key of the expected server and the client's own keys.

    Attributes:
        server: The server's public key, Z85.
        own: The client's key pair.
    """

    server: bytes
    own: KeyPair

    def protect(self, socket: zmq.Socket[bytes]) -> None:
        """Enable CURVE on a socket. Call before it connects."""
        socket.curve_serverkey = self.server
        socket.curve_publickey = self.own.public
        socket.curve_secretkey = self.own.secret


def is_local(address: str) -> bool:
    """Return whether the server at an address is on this machine, where no attacker can impersonate it."""
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
    """Return the keys for a server, or None for a server without keys.

    Args:
        address: Address of the server. For a server on another machine, environment variables supply missing keys.
        server_key: The server's public key or a file with it; empty for none, overriding the environment.
        client_key: The client's secret key file; None or empty to generate a key.

    Raises:
        KeyFileError: A key is malformed.
        ValueError: The keys cannot be used together or with this address.
    """
    if not is_local(address):
        server_key = os.environ.get(_SERVER_VARIABLE) if server_key is None else server_key
        client_key = os.environ.get(_CLIENT_VARIABLE) if client_key is None and server_key else client_key
    if not server_key:
        if client_key:
            raise ValueError("client_key requires server_key: the client must know which server it connects to")
        return None
    if not address.startswith("tcp://"):
        raise ValueError(f"server_key requires a tcp:// address, got {address!r}")
    return ClientKeys(public_key(server_key), read_pair(client_key) if client_key else KeyPair.new())
