"""How a command says that it cannot go on."""

from __future__ import annotations

__all__ = ["CommandError", "one_line"]


class CommandError(Exception):
    """A failure that could be foreseen; its text, one line, says what, where and what would be right."""


def one_line(error: BaseException) -> str:
    """Return an exception's text on one line."""
    text = str(error)
    if isinstance(error, OSError) and error.strerror:
        # Without the number, which tells nobody anything.
        text = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return " ".join(text.split()) or type(error).__name__
