"""The exceptions of what a server cannot do: serve a request, compile a scene."""

from __future__ import annotations


class Refusal(Exception):
    """A request cannot be served; the dispatcher turns this into an error reply.

    Attributes:
        code: Stable wire code, for example `spawn_failed`.
        message: What is wrong, where, and how to correct it; one line.
        absolute_path: The file that could not be written; `recording_save` only.
        owner: Owner of the robot that the request is about.
        lease_id: The lease that another client holds.
    """

    code: str
    message: str
    absolute_path: str | None
    owner: str | None
    lease_id: str | None

    def __init__(
        self,
        code: str,
        message: str,
        *,
        absolute_path: str | None = None,
        owner: str | None = None,
        lease_id: str | None = None,
    ) -> None:
        super().__init__(code, message)
        self.absolute_path = absolute_path
        self.owner = owner
        self.lease_id = lease_id
        self.code = code
        self.message = message

    def __str__(self) -> str:
        return f"{self.code}: {self.message}"


class CompileFailed(Exception):
    """MuJoCo rejects the scene."""

    message: str

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.message = message
