"""What the commands share: failures, signals, files and output."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
from argparse import Namespace
from collections.abc import Callable, Container, Generator, Sequence
from importlib.util import find_spec
from pathlib import Path
from types import FrameType

_VARIABLE = "MUJOCO_GL"


class CommandError(Exception):
    """An expected failure; its text is one line that says what failed, where, and what would be right."""


def joined(text: str) -> str:
    """Return a text on one line. Spaces within its lines stay, because they may be part of a file's name."""
    return " ".join(line for part in text.splitlines() if (line := part.strip()))


def one_line(error: BaseException) -> str:
    """Return an exception's text on one line."""
    text = str(error)
    if isinstance(error, OSError) and error.strerror:
        # Leave out the error number, which does not help users.
        text = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    # Which op a command opens a connection with says nothing to its user.
    return joined(text.removeprefix("hello: ").removeprefix("meta: ")) or type(error).__name__


def in_background() -> bool:
    """Whether this command was started so that it ignores Ctrl-C, which is then for others; SIGTERM still ends it."""
    return signal.getsignal(signal.SIGINT) == signal.SIG_IGN


@contextlib.contextmanager
def sigterm_interrupts() -> Generator[None]:
    """Let SIGTERM end the block as SIGINT does, so that it cleans up."""

    def end(_number: int, _frame: FrameType | None) -> None:
        if in_background():
            raise KeyboardInterrupt
        signal.raise_signal(signal.SIGINT)

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def refusing(*kinds: type[Exception], option: str = "") -> Generator[None]:
    """Report errors of some kinds, which the block raises for what the user gave, in one line.

    Args:
        kinds: The kinds.
        option: The option that is to blame.
    """
    try:
        yield
    except kinds as error:
        text = error.args[0] if isinstance(error, KeyError) else error
        raise CommandError(f"{option}: {text}" if option else str(text)) from error


def check_ending(path: Path, *endings: str) -> None:
    """Refuse an output file whose name has another ending."""
    if path.suffix.lower() not in endings:
        better = path.with_suffix(endings[0]).name if path.name else f"FILE{endings[0]}"
        raise CommandError(f"{path}: write a file that ends in {' or '.join(endings)}, for example {better}")


def check_recording(path: Path | None, arguments: Namespace) -> None:
    """Refuse a recording that cannot be written, before the simulation starts."""
    if path is None:
        if arguments.camera or arguments.overwrite:
            raise CommandError("--camera and --overwrite require --record")
        return
    check_ending(path, ".mcap")
    if path.exists() and not arguments.overwrite:
        raise CommandError(f"{path} exists; --overwrite replaces it")
    import urlab_client.integrations.record  # noqa: F401  # pyright: ignore[reportUnusedImport]  # a missing extra


@contextlib.contextmanager
def progress_bar(description: str, total: float) -> Generator[Callable[[float], None]]:
    """Show a bar while the block runs, on a terminal where Rich is; yields a callback that sets its position."""
    if not sys.stderr.isatty() or find_spec("rich") is None:
        yield lambda _: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = TextColumn("{task.description}", markup=False), BarColumn(), TaskProgressColumn(), TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(description, total=total)
        yield lambda done: progress.update(task, completed=done)


def aligned(rows: Sequence[Sequence[str]], right: Container[int] = ()) -> str:
    """Return lines of text with aligned columns, some of them to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if place in right else cell.ljust(width)
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    )


def json_line(value: object) -> str:
    """Return a value as JSON in ASCII, which every terminal and locale can encode; NaN is null."""
    import msgspec

    return json.dumps(msgspec.json.decode(msgspec.json.encode(value, enc_hook=str)))


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, as in `1 joint` and `2 joints`."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def import_mujoco() -> None:
    """Import MuJoCo without OpenGL.

    Importing it loads the OpenGL platform that `MUJOCO_GL` names, and fails if that is missing. A user who sets the
    variable for other programs can still serve and drive robots. Pictures are drawn in a separate process.
    """
    chosen = os.environ.get(_VARIABLE)
    os.environ[_VARIABLE] = "disable"
    try:
        import mujoco  # noqa: F401  # pyright: ignore[reportUnusedImport]  # for its effect
    finally:
        if chosen is None:
            del os.environ[_VARIABLE]
        else:
            os.environ[_VARIABLE] = chosen
