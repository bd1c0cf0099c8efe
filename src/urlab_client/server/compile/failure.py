"""Why a scene cannot be compiled."""

from __future__ import annotations

__all__ = ["CompileFailed"]


class CompileFailed(Exception):
    """MuJoCo rejects the scene.

    Attributes:
        message: MuJoCo's message on one line.
    """

    message: str

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.message = message
