"""Failures of commands."""

from __future__ import annotations

__all__ = ["CommandError", "one_line"]


class CommandError(Exception):
    """An expected failure; its text is one line that says what failed, where, and what would be right."""


def one_line(error: BaseException) -> str:
    """Return an exception's text on one line."""
    text = str(error)
    if isinstance(error, OSError) and error.strerror:
        # Leave out the error number, which does not help users.
        text = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return " ".join(text.split()) or type(error).__name__
