"""Errors detected by the client: connection, deadlines, bytes, versions, streams."""

from __future__ import annotations

from typing import Any


def _rebuild(cls: type[URLabError], args: tuple[Any, ...], state: dict[str, Any]) -> URLabError:
    error = cls.__new__(cls)
    error.args = args
    error.__dict__.update(state)
    return error


def _sentence(text: str) -> str:
    """Return a text that ends with a full stop, which a server's message may lack."""
    return text if not text or text.endswith((".", "!", "?", "…")) else f"{text}."


class URLabError(Exception):
    """Base class of all exceptions of this package.

    Attributes:
        op: Name of the op that failed, or None.
        code: Short stable code; empty if no server was involved.
        hint: What to do next; included in `str()`.
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
        """Return the error as JSON-compatible data: `error` (the class), `message`, `op`, `code` and `hint`."""
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
    """The connection to the server cannot be used."""


class ServerUnreachable(URLabConnectionError):
    """No connection could be made within the deadline; nothing was sent."""


class AuthenticationFailed(ServerUnreachable):
    """Server and client do not accept each other's CURVE keys, or only one of them uses keys; nothing was sent."""


class ConnectionLost(URLabConnectionError):
    """The connection was lost. No request that changes the simulation was in progress."""


class OutcomeUnknown(URLabConnectionError):
    """The connection was lost after a request that changes state was sent; it may or may not have been executed.

    Attributes:
        job_id: The editor's job that executes it, if any.
    """

    job_id: str | None = None


class ClientClosed(URLabConnectionError):
    """The client was closed, before this call or during it."""


class ForkedError(URLabConnectionError):
    """The client was created in another process; a forked child must create its own."""


class URLabTimeoutError(URLabError, TimeoutError):
    """No reply arrived within the deadline. A request that was sent may still be executed by the server.

    Attributes:
        job_id: The editor's job that executes it, if any; it continues.
    """

    job_id: str | None = None


class NotSettled(URLabTimeoutError):
    """Joints did not reach the targets of `move_to()`. Their set-points are kept.

    Attributes:
        remaining: Signed distance to the target by joint name, radians or metres.
    """

    remaining: dict[str, float]

    def __init__(self, message: str, *, remaining: dict[str, float], hint: str | None = None) -> None:
        super().__init__(message, hint=hint)
        self.remaining = remaining


class PictureTimeout(URLabTimeoutError):
    """Cameras delivered no picture in time.

    Attributes:
        cameras: Names of the cameras.
    """

    cameras: list[str]

    def __init__(self, message: str, *, cameras: list[str], hint: str | None = None) -> None:
        super().__init__(message, hint=hint)
        self.cameras = cameras


class ProtocolError(URLabError):
    """A frame from the server could not be decoded.

    Attributes:
        raw: The first bytes of the frame.
    """

    raw: bytes

    def __init__(self, message: str, *, op: str | None = None, raw: bytes = b"", hint: str | None = None) -> None:
        super().__init__(message, op=op, hint=hint)
        self.raw = raw[:256]


class ReadOnlyClient(URLabError):
    """The client was created with `read_only=True` and sends no requests. Nothing was sent."""


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
    """A stream with policy `all` overflowed its bounded buffer. Reading continues with the oldest remaining message.

    Attributes:
        lost: Number of lost messages.
    """

    lost: int

    def __init__(self, message: str, *, lost: int, hint: str | None = None) -> None:
        super().__init__(message, hint=hint)
        self.lost = lost


class ConcurrentReadError(URLabError):
    """A second task tried to read a stream that already has a reader."""
