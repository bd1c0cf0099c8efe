"""The `urlab` command: servers, diagnoses, demonstrations, recordings, views and policies at the terminal.

Each command has a module with its `USAGE`, which `add_usage` reads, and `run(arguments)`; its docstring, without the
first line, describes the command to users. Only the module of the command that is run is imported, because every
`sim://` server is an `urlab serve`, and none for `urlab --help`. An expected failure prints one line on standard error
and exits with code 2.
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
from urlab_client._installation import MissingExtra
from urlab_client.cli._arguments import Parser, add_usage
from urlab_client.cli._common import CommandError, one_line
from urlab_client.errors import URLabError
from urlab_client.values.names import UnknownName

__all__ = ["main"]

logger: logging.Logger = logging.getLogger("urlab_client.cli")

COMMANDS = {
    "serve": "run a simulated server",
    "console": "show a simulation in the browser, and interact with it",
    "mcp": "let an agent look at a simulation, and drive it if you allow that",
    "ping": "show which server answers at an address, and how fast",
    "conformance": "check a server against the statements about the wire",
    "tap": "print, record and replay what clients and a server say to each other",
    "doctor": "find out why a robot does not move",
    "demo": "drive a robot end to end; keep a plot, a picture and the configuration",
    "robots": "list the bundled robots",
    "keys": "make and show CURVE keys",
    "snapshot": "write a picture of a model, a level or a camera",
    "record": "record a running simulation to an MCAP file",
    "info": "show what is in a recording",
    "convert": "turn a recording into CSV, NumPy, Parquet, MP4 or a LeRobot dataset",
    "plot": "draw curves of a recording",
    "run-policy": "let a network from an ONNX file drive a robot",
    "evaluate": "measure how good a policy is, with confidence intervals",
    "teleop": "move a robot's hand with the keyboard, and record episodes",
    "view": "show a simulation or a recording in MuJoCo's window, a browser, Rerun or Foxglove",
}

_USAGE = """
examples:
urlab demo  see a robot move; needs no Unreal
urlab robots  list the bundled robots
urlab COMMAND --help  show the options and examples of a command
"""

_FAILED = 2
_INTERRUPTED = 128 + signal.SIGINT
_UNREAD = 128 + 13  # SIGPIPE, which Windows lacks


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code.

    Args:
        argv: Arguments without the program's name. Defaults to those of this process.
    """
    if "_ARGCOMPLETE" in os.environ:
        _complete(os.environ.get("COMP_LINE", ""))
    try:
        try:
            return _run(sys.argv[1:] if argv is None else argv)
        finally:
            for stream in filter(None, (sys.stdout, sys.stderr)):
                stream.flush()
    except OSError as error:  # of the output; commands report their own
        _discard_output()
        if _is_broken_pipe(error):
            return _UNREAD
        sys.stderr.write(f"urlab: {one_line(error)}\n")
        return _FAILED


def _complete(line: str) -> None:
    """Answer the shell, which asks for the words that can come next, and exit."""
    import argcomplete

    argcomplete.autocomplete(_parser(next(iter(line.split()[1:]), "")))


def _run(argv: Sequence[str]) -> int:
    if (reconfigure := getattr(sys.stdout, "reconfigure", None)) is not None:
        reconfigure(errors="backslashreplace")  # not every terminal can encode every file name
    if not argv:
        print(_parser("").format_help(), end="")
        return 0
    if argv[0] == "help":  # as git and others have it
        argv = [*argv[1:], "--help"]
    parser = _parser(next((word for word in argv if not word.startswith("-")), ""))
    arguments = parser.parse_args(argv)
    run: Callable[[object], int] = arguments.run
    name = f"{parser.prog} {arguments.name}"
    handler = _StderrHandler(name)
    logging.getLogger("urlab_client").addHandler(handler)
    try:
        with warnings.catch_warnings():
            # A warning for users, such as about a different MuJoCo version, is logged like any other.
            warnings.simplefilter("default", UserWarning)
            warnings.showwarning = _log_warning
            return run(arguments)
    except KeyboardInterrupt:
        return _INTERRUPTED
    except (CommandError, MissingExtra, UnknownName, URLabError, OSError) as error:
        if _is_broken_pipe(error):
            raise
        sys.stderr.write(f"{name}: {one_line(error)}\n")
        return _FAILED
    finally:
        logging.getLogger("urlab_client").removeHandler(handler)


def _discard_output() -> None:
    """Discard what cannot be written: the interpreter would try again at exit, complain, and change the exit code."""
    for stream in filter(None, (sys.stdout, sys.stderr)):
        try:
            stream.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _is_broken_pipe(error: Exception) -> bool:
    """Whether the reader of a pipe has gone, which Windows reports as an invalid argument."""
    if os.name == "nt":
        return isinstance(error, OSError) and error.errno in {errno.EPIPE, errno.EINVAL} and error.filename is None
    return isinstance(error, BrokenPipeError)


def _parser(command: str | None = None) -> Parser:
    """Return the parser, with the options of the given command, by default of all."""
    parser = Parser(
        prog="urlab",
        description="Clients and a simulated server for URLab, the Unreal plugin that embeds MuJoCo.",
        epilog="urlab help COMMAND says what a command does and takes. "
        "Exit codes: 0 success, 1 a result with problems (each command's help says which), 2 wrong usage or a "
        "failure explained on standard error, 130 Ctrl-C, 141 the output's reader has gone.",
    )
    add_usage(parser, _USAGE)
    parser.add_argument("-V", "--version", action=_Version, nargs=0, help="show program's version number and exit")
    subparsers = parser.add_subparsers(title="commands", dest="name", metavar="COMMAND", required=True)
    for name, brief in COMMANDS.items():
        if command not in (None, name):
            subparsers.add_parser(name, help=brief)
            continue
        module = import_module(f"{__name__}.{name.replace('-', '_')}")
        description = (module.__doc__ or "").partition("\n\n")[2]  # none with python -OO
        own = subparsers.add_parser(name, help=brief, description=description)
        own.set_defaults(run=module.run)
        add_usage(own, module.USAGE, getattr(module, "KINDS", {}))
        if hasattr(module, "add_actions"):
            module.add_actions(own)
    return parser


def _log_warning(message: Warning | str, *_: object) -> None:
    logger.warning("%s", message)


class _Version(argparse.Action):  # argparse's own action needs the version up front, and reading it is slow
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        print(f"urlab_client {urlab_client.__version__}")
        parser.exit()


class _StderrHandler(logging.Handler):
    """Writes warnings as lines prefixed with the command, above its progress bar if there is one."""

    def __init__(self, name: str) -> None:
        super().__init__(logging.WARNING)
        self._name = name

    def emit(self, record: logging.LogRecord) -> None:
        # Looked up each time: a progress bar replaces the stream while it is shown.
        sys.stderr.write(f"{self._name}: {record.levelname.lower()}: {self.format(record)}\n")
