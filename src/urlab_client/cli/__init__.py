"""The `urlab` command: servers, diagnoses, demonstrations, recordings, views and policies at the terminal.

Each command has a module of its own and imports what is heavy (MuJoCo, the server, the demo's libraries) when it
runs. A failure that can be foreseen is one line on standard error and exit code 2.
"""

from __future__ import annotations

import argparse
import errno
import logging
import os
import signal
import sys
import warnings
from collections.abc import Callable, Sequence
from importlib import import_module

import urlab_client
from urlab_client._extras import MissingExtra
from urlab_client.cli._arguments import Parser
from urlab_client.cli._failure import CommandError, one_line
from urlab_client.protocol.errors import URLabError

__all__ = ["main"]

logger: logging.Logger = logging.getLogger("urlab_client.cli")

_COMMANDS = (
    "serve",
    "console",
    "mcp",
    "ping",
    "doctor",
    "demo",
    "robots",
    "keys",
    "snapshot",
    "record",
    "info",
    "convert",
    "plot",
    "run-policy",
    "evaluate",
    "teleop",
    "view",
)

_FAILED = 2
_INTERRUPTED = 128 + signal.SIGINT


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code.

    Args:
        argv: Arguments without the program's name; default those of this process.
    """
    argv = sys.argv[1:] if argv is None else argv
    if (reconfigure := getattr(sys.stdout, "reconfigure", None)) is not None:
        reconfigure(errors="backslashreplace")  # not every terminal has the characters of every file's name
    if not argv:
        print(_parser().format_help(), end="")
        return 0
    # Every `sim://` server is an `urlab serve`, which starts sooner without the modules of the other commands.
    parser = _parser(*(name for name in argv[:1] if name in _COMMANDS))
    arguments = parser.parse_args(argv)
    run: Callable[[object], int] = arguments.run
    name = f"{parser.prog} {arguments.command}"
    handler = _StderrHandler(name)
    logging.getLogger("urlab_client").addHandler(handler)
    try:
        with warnings.catch_warnings():
            # What users are to know, as that there is another MuJoCo here, is a line like any other.
            warnings.simplefilter("default", UserWarning)
            warnings.showwarning = _log_warning
            return run(arguments)
    except KeyboardInterrupt:
        return _INTERRUPTED
    except (CommandError, MissingExtra, URLabError, OSError) as error:
        if _is_broken_pipe(error):
            # Whoever read the output has gone; what the interpreter would still flush at its end goes nowhere, too.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return _FAILED
        sys.stderr.write(f"{name}: {one_line(error)}\n")
        return _FAILED
    finally:
        logging.getLogger("urlab_client").removeHandler(handler)


def _is_broken_pipe(error: Exception) -> bool:
    """Whether nobody reads a pipe any more, of which Windows says that the argument is invalid."""
    if os.name == "nt":
        return isinstance(error, OSError) and error.errno in {errno.EPIPE, errno.EINVAL} and error.filename is None
    return isinstance(error, BrokenPipeError)


def _parser(*commands: str) -> Parser:
    """Return the parser of some commands, by default of all."""
    parser = Parser(
        prog="urlab",
        description="Clients and a simulated server for URLab, the Unreal plugin that embeds MuJoCo.",
        epilog="Exit codes: 0 success, 1 a result with problems (each command's help says which), 2 wrong usage or a "
        "failure explained on standard error, 130 Ctrl-C.",
        examples=(
            ("urlab demo", "see a robot move; needs no Unreal"),
            ("urlab robots", "the robots that are included"),
            ("urlab COMMAND --help", "options and examples of a command"),
        ),
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show program's version number and exit")
    subparsers = parser.add_subparsers(title="commands", dest="command", metavar="COMMAND", required=True)
    for name in commands or _COMMANDS:
        import_module(f"{__name__}.{name.replace('-', '_')}").add_parser(subparsers)
    return parser


def _log_warning(message: Warning | str, *_: object) -> None:
    logger.warning("%s", message)


class _Version(argparse.Action):  # argparse's own needs the version in advance, and reading it takes a while
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        print(f"urlab_client {urlab_client.__version__}")
        parser.exit()


class _StderrHandler(logging.Handler):
    """Writes warnings as lines of the command that runs, above a progress bar if there is one."""

    def __init__(self, name: str) -> None:
        super().__init__(logging.WARNING)
        self._name = name

    def emit(self, record: logging.LogRecord) -> None:
        # Looked up each time: a progress bar replaces the stream while it is shown.
        sys.stderr.write(f"{self._name}: {record.levelname.lower()}: {self.format(record)}\n")
