"""The doorbell beside the shared-memory regions: a Unix stream socket over which our client and server wake each other.

The regions are authoritative; a ring is only a hint to check them. So a ring may be lost, doubled or late without harm,
and either side works without the other's doorbell: the plugin has none.

The server listens on `FILE` in the directory of `req.shm`. Each byte is one message. A client sends `REQUEST` after it
published a request, and `WANT_STATE` or `WANT_CAMERAS` once to be told of those publications too. The server sends
`REPLY` after it published a reply, `STATE` and `CAMERA` to clients that requested them. Both send without blocking and
drop a ring if the peer's buffer is full, because the peer then has rings waiting. Unknown bytes are ignored.
"""

from __future__ import annotations

from typing import Final

FILE: Final = "doorbell.sock"
"""Name of the socket in the session directory."""

MAX_PATH_BYTES: Final = 103
"""Longest path that every system's `sockaddr_un` holds; with a longer one there is no doorbell."""

REQUEST: Final = b"q"
REPLY: Final = b"r"
STATE: Final = b"s"
CAMERA: Final = b"c"
WANT_STATE: Final = b"S"
WANT_CAMERAS: Final = b"C"
