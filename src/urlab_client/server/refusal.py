"""The way a handler of the simulated server answers with an error."""

from __future__ import annotations

__all__ = ["Refusal"]


class Refusal(Exception):
    """A request cannot be served; the dispatcher turns this into an error reply.

    Attributes:
        code: Stable wire code, for example `spawn_failed`.
        message: What was wrong, where, and what would be right; one line.
        absolute_path: The file that could not be written; `recording_save` only.
    """

    code: str
    message: str
    absolute_path: str | None

    def __init__(self, code: str, message: str, *, absolute_path: str | None = None) -> None:
        super().__init__(code, message)
        self.absolute_path = absolute_path
        self.code = code
        self.message = message

    def __str__(self) -> str:
        return f"{self.code}: {self.message}"
