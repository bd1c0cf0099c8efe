"""The errors that the client finds itself: connection, deadlines, bytes, versions, streams. No answer of a server."""

from __future__ import annotations

from typing import Any

__all__ = [
    "AuthenticationFailed",
    "ClientClosed",
    "ConcurrentReadError",
    "ConnectionLost",
    "ForkedError",
    "NotSettled",
    "OutcomeUnknown",
    "PictureTimeout",
    "ProtocolError",
    "ReadOnlyClient",
    "ServerUnreachable",
    "StreamOverflow",
    "URLabConnectionError",
    "URLabError",
    "URLabTimeoutError",
    "URLabVersionMismatch",
]


def _rebuild(cls: type[URLabError], args: tuple[Any, ...], state: dict[str, Any]) -> URLabError:
    error = cls.__new__(cls)
    error.args = args
    error.__dict__.update(state)
    return error


def _sentence(text: str) -> str:
    """Return a text that another sentence may follow: a server's message may lack its full stop."""
    return text if not text or text.endswith((".", "!", "?", "…")) else f"{text}."


class URLabError(Exception):
    """Base of everything this package raises on purpose.

    Attributes:
        op: Name of the op that failed, or None.
        code: Short stable code; empty where no server was involved.
        hint: What to do next; part of `str()` already.
    """

    op: str | None
    code: str
    hint: str | None

    def __init__(self, message: str, *, op: str | None = None, code: str = "", hint: str | None = None) -> None:
        super().__init__(message)
        self.op = op
        self.code = code
        self.hint = hint

    def __str__(self) -> str:
        text = str(self.args[0]) if self.args else ""
        return f"{_sentence(text)} {self.hint}" if self.hint else text

    def to_dict(self) -> dict[str, Any]:
        """Return the error as data that JSON can hold: `error` (the class), `message`, `op`, `code` and `hint`."""
        return {
            "error": type(self).__name__,
            "message": str(self),
            "op": self.op,
            "code": self.code,
            "hint": self.hint,
        }

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild, (type(self), self.args, dict(self.__dict__))


class URLabConnectionError(URLabError, ConnectionError):
    """The link to the server is unusable."""


class ServerUnreachable(URLabConnectionError):
    """No connection could be made within the deadline; nothing was sent."""


class AuthenticationFailed(ServerUnreachable):
    """Server and client do not accept each other's CURVE keys, or only one of them uses such keys; nothing was sent."""


class ConnectionLost(URLabConnectionError):
    """The connection broke. Nothing that changes the simulation was under way."""


class OutcomeUnknown(URLabConnectionError):
    """The connection broke after a request was sent that changes state: it may or may not have been executed.

    Attributes:
        job_id: The editor's job that carries it out, if it is one.
    """

    job_id: str | None = None


class ClientClosed(URLabConnectionError):
    """The client was closed, before this call or during it."""


class ForkedError(URLabConnectionError):
    """The client was made in another process; a forked child must make its own."""


class URLabTimeoutError(URLabError, TimeoutError):
    """No reply arrived within the deadline. A request that was sent may still be executed by the server.

    Attributes:
        job_id: The editor's job that carries it out, if it is one; it goes on.
    """

    job_id: str | None = None


class NotSettled(URLabTimeoutError):
    """Joints are not where `move_to()` was to take them. Their set-points stay.

    Attributes:
        remaining: How far each of them has to go, by joint name: radians or metres, with sign.
    """

    remaining: dict[str, float]

    def __init__(self, message: str, *, remaining: dict[str, float], hint: str | None = None) -> None:
        super().__init__(message, hint=hint)
        self.remaining = remaining


class PictureTimeout(URLabTimeoutError):
    """Cameras delivered no picture in time.

    Attributes:
        cameras: Which ones.
    """

    cameras: list[str]

    def __init__(self, message: str, *, cameras: list[str], hint: str | None = None) -> None:
        super().__init__(message, hint=hint)
        self.cameras = cameras


class ProtocolError(URLabError):
    """A frame from the server could not be understood.

    Attributes:
        raw: The first bytes of the frame.
    """

    raw: bytes

    def __init__(self, message: str, *, op: str | None = None, raw: bytes = b"", hint: str | None = None) -> None:
        super().__init__(message, op=op, hint=hint)
        self.raw = raw[:256]


class ReadOnlyClient(URLabError):
    """The client looks on and asks the server for nothing: it was made with `read_only=True`. Nothing was sent."""


class URLabVersionMismatch(URLabError):
    """Client and server MuJoCo builds differ, so the compiled model cannot be loaded here.

    Attributes:
        server_version: MuJoCo version of the server.
        client_version: MuJoCo version installed here.
    """

    server_version: str
    client_version: str

    def __init__(self, server_version: str, client_version: str, *, hint: str | None = None) -> None:
        super().__init__(
            f"The server runs MuJoCo {server_version}, this process has MuJoCo {client_version}.",
            op="hello",
            hint=hint
            or (
                f"Install mujoco=={server_version}, or pass mujoco_version_check=False to go on with a warning, "
                "or local_model=False to work without a local model."
            ),
        )
        self.server_version = server_version
        self.client_version = client_version


class StreamOverflow(URLabError):
    """A stream read with policy `all` fell behind its bounded buffer. Reading goes on with the oldest that is left.

    Attributes:
        lost: Messages that were lost.
    """

    lost: int

    def __init__(self, message: str, *, lost: int, hint: str | None = None) -> None:
        super().__init__(message, hint=hint)
        self.lost = lost


class ConcurrentReadError(URLabError):
    """A second task tried to read a stream that already has a reader."""
