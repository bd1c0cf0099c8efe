"""The exceptions of what a server cannot do: serve a request, compile a scene."""

from __future__ import annotations


class Refusal(Exception):
    """A request cannot be served; the dispatcher turns this into an error reply.

    Attributes:
        code: Stable wire code, for example `spawn_failed`.
        message: What is wrong, where, and how to correct it; one line.
        details: The other fields of the reply, such as `owner`; see `ErrorReply`.
    """

    def __init__(self, code: str, message: str, **details: str) -> None:
        super().__init__(code, message)
        self.code: str = code
        self.message: str = message
        self.details: dict[str, str] = details

    def __str__(self) -> str:
        return f"{self.code}: {self.message}"


class CompileFailed(Exception):
    """MuJoCo rejects the scene."""

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.message: str = message
