"""Output of commands: progress bars, tables, counts."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Callable, Generator
from typing import TYPE_CHECKING

import msgspec

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["counted", "json_line", "output", "progress_bar"]

_COLUMNS = 120  # where the output is not a terminal


@contextlib.contextmanager
def progress_bar(description: str, total: float) -> Generator[Callable[[float], None]]:
    """Show a bar while the block runs, if standard error is a terminal; yields a callback that sets its position."""
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.console import Console  # noqa: PLC0415
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn  # noqa: PLC0415

    columns = TextColumn("{task.description}", markup=False), BarColumn(), TaskProgressColumn(), TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(description, total=total)
        yield lambda done: progress.update(task, completed=done)


def output() -> Console:
    """Return a console that writes tables to standard output, with brackets and colons in names as they are."""
    from rich.console import Console  # noqa: PLC0415

    console = Console(markup=False, emoji=False)
    if not console.is_terminal:
        console.width = _COLUMNS
    return console


def json_line(value: object) -> str:
    """Return a value as JSON in ASCII, which every terminal and locale can encode; NaN is null."""
    return json.dumps(msgspec.json.decode(msgspec.json.encode(value, enc_hook=str)))


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, as in `1 joint` and `2 joints`."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
