"""The `urlab` command: a simulated server, a look at who answers, a diagnosis, a demonstration.

Each command has a module of its own and imports what is heavy (MuJoCo, the server, the demo's libraries) when it
runs. A failure that can be foreseen is one line on standard error and exit code 2.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version

from urlab_client.cli import (
    console,
    convert,
    demo,
    doctor,
    info,
    keys,
    ping,
    plot,
    record,
    run_policy,
    serve,
    snapshot,
    view,
)
from urlab_client.cli._arguments import Parser
from urlab_client.cli._failure import CommandError, one_line
from urlab_client.integrations._extras import MissingExtra
from urlab_client.protocol.errors import URLabError

__all__ = ["main"]

_FAILED = 2
_INTERRUPTED = 128 + signal.SIGINT


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code.

    Args:
        argv: Arguments without the program's name; default those of this process.
    """
    parser = _parser()
    arguments = parser.parse_args(argv)
    run: Callable[[object], int] = arguments.run
    name = f"{parser.prog} {arguments.command}"
    handler = _StderrHandler(name)
    logging.getLogger("urlab_client").addHandler(handler)
    try:
        return run(arguments)
    except KeyboardInterrupt:
        return _INTERRUPTED
    except BrokenPipeError:
        # Whoever read the output has gone; what the interpreter would still flush at its end goes nowhere, too.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _FAILED
    except (CommandError, MissingExtra, URLabError, OSError) as error:
        sys.stderr.write(f"{name}: {one_line(error)}\n")
        return _FAILED
    finally:
        logging.getLogger("urlab_client").removeHandler(handler)


def _parser() -> Parser:
    parser = Parser(
        prog="urlab",
        description="Clients and a simulated server for URLab, the Unreal plugin that embeds MuJoCo.",
        epilog="Exit codes: 0 success, 1 a diagnosis with problems, 2 wrong usage or a failure explained on standard "
        "error, 130 Ctrl-C.",
    )
    parser.add_argument("--version", action="version", version=f"urlab_client {version('urlab-client')}")
    commands = parser.add_subparsers(title="commands", dest="command", metavar="COMMAND", required=True)
    for module in (serve, console, ping, doctor, demo, keys, snapshot, record, info, convert, plot, run_policy, view):
        module.add_parser(commands)
    return parser


class _StderrHandler(logging.Handler):
    """Writes warnings as lines of the command that runs, above a progress bar if there is one."""

    def __init__(self, name: str) -> None:
        super().__init__(logging.WARNING)
        self._name = name

    def emit(self, record: logging.LogRecord) -> None:
        # Looked up each time: a progress bar replaces the stream while it is shown.
        sys.stderr.write(f"{self._name}: {record.levelname.lower()}: {self.format(record)}\n")
