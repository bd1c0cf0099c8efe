"""Argument types and the parser that the commands share."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any, NoReturn, Protocol

__all__ = ["Commands", "Parser", "add_keys", "count", "image_size", "port", "seconds"]

_LARGEST_IMAGE = 16384


class Parser(argparse.ArgumentParser):
    """Says in one line what is wrong with the arguments, and exits with code 2."""

    def __init__(self, **options: Any) -> None:
        # An abbreviation that works today would be ambiguous, or another option, tomorrow.
        super().__init__(allow_abbrev=False, **options)

    def error(self, message: str) -> NoReturn:
        """See `argparse.ArgumentParser.error`."""
        self.exit(2, f"{self.prog}: {' '.join(message.split())} (see {self.prog} --help)\n")


class Commands(Protocol):
    """What a command adds its parser to."""

    def add_parser(self, name: str, *, help: str, description: str) -> Parser: ...  # noqa: A002 - argparse's word


def add_keys(parser: argparse.ArgumentParser) -> None:
    """Add the options of a client that talks to a server with CURVE keys."""
    parser.add_argument(
        "--server-key", metavar="FILE", help="public key of a server that uses keys (default: $URLAB_SERVER_KEY)"
    )
    parser.add_argument(
        "--client-key", metavar="FILE", help="own secret key, if the server knows its clients ($URLAB_CLIENT_KEY)"
    )


def port(text: str) -> int:
    """Parse a TCP port, 0 to 65535."""
    return _whole(text, 0, 65535, "a port is a whole number from 0 (any free one) to 65535")


def count(text: str) -> int:
    """Parse a number of times, 1 or more."""
    return _whole(text, 1, 10**9, "give a whole number above 0")


def seconds(text: str) -> float:
    """Parse a duration in seconds, above 0."""
    return _number(text, lambda value: 0 < value < 1e6, "give a number of seconds above 0")


def image_size(text: str) -> tuple[int, int]:
    """Parse width and height of an image, pixels."""
    width, cross, height = text.lower().partition("x")
    if cross and width.isdecimal() and height.isdecimal():
        size = int(width), int(height)
        if all(0 < side <= _LARGEST_IMAGE for side in size):
            return size
    raise argparse.ArgumentTypeError(f"{text!r}: write WIDTHxHEIGHT in pixels, 1 to {_LARGEST_IMAGE}, as in 640x480")


def _whole(text: str, low: int, high: int, advice: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = low - 1
    if not low <= value <= high:
        raise argparse.ArgumentTypeError(f"{text!r}: {advice}")
    return value


def _number(text: str, fits: Callable[[float], bool], advice: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not fits(value):
        raise argparse.ArgumentTypeError(f"{text!r}: {advice}")
    return value
