"""Argument types and the parser that the commands share."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal, NoReturn, Protocol, TypeVar, cast

from urlab_client.cli._common import CommandError, joined
from urlab_client.enums import StepMode
from urlab_client.values.names import did_you_mean

ADDRESSES = (
    "HOST[:PORT], tcp://HOST[:PORT], ipc://PATH, or sim://MODEL to start a simulated server just for this command"
)

Example = tuple[str, str]
"""A command line, and what it does."""

C = TypeVar("C")
E = TypeVar("E", bound=StrEnum)

_STEP_PORT = 5559
_LARGEST_IMAGE = 16384


class Parser(argparse.ArgumentParser):
    """Reports wrong arguments in one line and exits with code 2.

    Attributes:
        examples: Shown at the end of the help.
    """

    def __init__(self, *, examples: Sequence[Example] = (), **options: Any) -> None:
        # An abbreviation that works today could become ambiguous when an option is added.
        super().__init__(allow_abbrev=False, **options)
        self.examples = examples

    @property
    def commands(self) -> dict[str, Parser]:
        """The parser of each command that was added, by name."""
        choices: list[Any] = [action.choices for action in self._actions]
        groups = [cast("dict[str, Parser]", group) for group in choices if isinstance(group, dict)]
        return {name: parser for group in groups for name, parser in group.items()}

    def format_help(self) -> str:
        """See `argparse.ArgumentParser.format_help`."""
        text = super().format_help()
        if self.examples:
            text += "\nexamples:\n" + "".join(f"  {command}\n      {what}\n" for command, what in self.examples)
        return text

    def parse_known_args(  # pyright: ignore[reportIncompatibleMethodOverride]  # the base class has overloads
        self, args: Sequence[str] | None = None, namespace: Any = None
    ) -> tuple[Any, list[str]]:
        """See `argparse.ArgumentParser.parse_known_args`; a command's parser rejects unknown arguments."""
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            word = unknown[0]
            if not word.startswith("-"):
                self.error(f"{word!r} is one argument too many")
            option = word.partition("=")[0]
            options = [name for action in self._actions for name in action.option_strings]
            self.error(f"{option} is not an option.{did_you_mean(option, options)}")
        return found, unknown

    def error(self, message: str) -> NoReturn:
        """See `argparse.ArgumentParser.error`."""
        self.exit(2, f"{self.prog}: {joined(message)} (see {self.prog} --help)\n")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            known = [str(choice) for choice in action.choices]
            raise argparse.ArgumentError(action, _not_one_of(str(value), known))


class Commands(Protocol):
    """What a command adds its parser to."""

    def add_parser(
        self,
        name: str,
        *,
        help: str,  # noqa: A002 - argparse's word
        description: str,
        examples: Sequence[Example],
    ) -> Parser: ...


class ServerArguments(argparse.Namespace):
    """How to reach a server, besides its address; see `add_ports`, `add_keys`, `add_mjcf_options`, `add_handshake`."""

    handshake: Path | None
    mjcf_options: bool
    step_port: int
    state_port: int | None
    server_key: str | None
    client_key: str | None


def make_client(flavour: Callable[..., C], address: str, arguments: ServerArguments, **options: Any) -> C:
    """Return a client of one of the two classes for the server that the arguments name.

    A MuJoCo version that differs from the server's is not an error: the client warns and compiles the model locally.

    Raises:
        CommandError: The address or an option is malformed.
    """
    if arguments.mjcf_options:
        if not address.startswith("sim://"):
            raise CommandError(
                f"--mjcf-options is for sim://MODEL; {address} is already running, and takes the option at its start"
            )
        address = f"{address}{'&' if '?' in address else '?'}mjcf-options"
    if arguments.handshake is not None:
        if address.startswith("sim://"):
            raise CommandError("--handshake is for a server that another client drives, not for sim://MODEL")
        options = {**options, "read_only": True}
    if arguments.state_port is not None:
        options = {**options, "state_port": arguments.state_port}
    try:
        return flavour(
            address,
            step_port=arguments.step_port,
            server_key=arguments.server_key,
            client_key=arguments.client_key,
            **{"mujoco_version_check": False, **options},
        )
    except ValueError as error:
        raise CommandError(str(error)) from None


def add_address(parser: argparse.ArgumentParser, default: str | None = "tcp://localhost", otherwise: str = "") -> None:
    """Add the server's address, and `--mjcf-options` for a server that the command starts.

    Args:
        parser: The command's parser.
        default: Address without the argument.
        otherwise: What happens without the argument, if that is not the default address.
    """
    parser.add_argument(
        "address",
        nargs="?",
        type=address,
        default=default,
        metavar="ADDRESS",
        help=f"{ADDRESSES} (default: {otherwise or '%(default)s'})",
    )
    add_mjcf_options(parser, "with sim://MODEL")


def add_dialect(parser: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:  # pyright: ignore[reportPrivateUsage]
    """Add `--dialect` to a command that starts a simulated server."""
    parser.add_argument(
        "--dialect",
        choices=("alpha", "beta"),
        default="alpha",
        metavar="NAME",
        help="plugin generation to simulate: alpha (June 2026) or beta (August 2026) (default: alpha)",
    )


def add_mjcf_options(parser: argparse.ArgumentParser, when: str) -> None:
    """Add `--mjcf-options` to a command that can load models.

    Args:
        parser: The command's parser.
        when: When the option applies.
    """
    parser.add_argument(
        "--mjcf-options",
        action="store_true",
        help=f"{when}: use the <option> of each model (timestep, integrator, ...) instead of the plugin's defaults",
    )


def add_ports(parser: argparse.ArgumentParser, *, state: bool = True) -> None:
    """Add the ports of a server.

    Args:
        parser: The command's parser.
        state: Whether the command uses the state stream.
    """
    parser.set_defaults(handshake=None)  # only some commands have the option
    parser.add_argument(
        "--step-port",
        type=port,
        default=_STEP_PORT,
        metavar="PORT",
        help="RPC port of the server, if the address has none (default: %(default)s)",
    )
    if state:
        parser.add_argument(
            "--state-port",
            type=port,
            metavar="PORT",
            help="port of the server's state stream (default: the one that the server announces, otherwise 5555)",
        )
    else:
        parser.set_defaults(state_port=None)


def add_step_mode(parser: argparse.ArgumentParser) -> None:
    """Add the choice between watching physics run and stepping it."""
    parser.add_argument(
        "--step-mode",
        type=one_of(StepMode.LIVE, StepMode.DIRECT),
        metavar="MODE",
        default=StepMode.LIVE,
        help="live or direct (default: %(default)s)",
    )


def add_cameras(parser: argparse.ArgumentParser, what: str) -> None:
    """Add `--camera`, which may be repeated; `cameras` interprets its values.

    Args:
        parser: The command's parser.
        what: What the camera is used for.
    """
    parser.add_argument(
        "--camera",
        action="append",
        default=[],
        metavar="NAME",
        help=f"{what}, as ARTICULATION/CAMERA, or 'all'; may be repeated",
    )


def cameras(given: list[str]) -> list[str] | Literal["all"]:
    """Return the cameras that were given with `--camera`."""
    return "all" if "all" in given else given


def add_keys(parser: argparse.ArgumentParser) -> None:
    """Add the options of a client that talks to a server with CURVE keys."""
    parser.add_argument(
        "--server-key", metavar="FILE", help="public key of a server that uses keys (default: $URLAB_SERVER_KEY)"
    )
    parser.add_argument(
        "--client-key",
        metavar="FILE",
        help="this client's secret key, if the server requires one (default: $URLAB_CLIENT_KEY)",
    )


def add_handshake(parser: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:  # pyright: ignore[reportPrivateUsage]
    """Add `--handshake` to a command that can watch alongside the driving client; see `handshake`."""
    parser.add_argument(
        "--handshake",
        type=Path,
        metavar="FILE",
        help="watch alongside the driving client, without taking over its session: FILE holds what its "
        "client.handshake() returns, or GET /api/handshake of its console",
    )


def handshake(arguments: ServerArguments) -> bytes | None:
    """Return what a command's client passes to `discover()`.

    Raises:
        OSError: The file cannot be read.
    """
    return None if arguments.handshake is None else arguments.handshake.read_bytes()


def address(text: str) -> str:
    """Parse the address of a server; a host without a scheme is reached over TCP."""
    if "://" in text:
        return text
    from urlab_client.server.assets.bundled_robots import bundled_models

    if text in bundled_models() or text.endswith((".xml", ".json")):
        raise argparse.ArgumentTypeError(f"{text!r} is a model, not an address; write sim://{text} to start a server")
    return f"tcp://{text}"


def running_address(text: str) -> str:
    """Parse the address of a running server."""
    if text.startswith("sim://"):
        raise argparse.ArgumentTypeError(f"{text!r} would start a server; give the address of a running one")
    return address(text)


def one_of(*allowed: E) -> Callable[[str], E]:
    """Return a function that parses one of the given members of an enumeration."""

    def parse(text: str) -> E:
        try:
            found = type(allowed[0])(text)  # the enumeration may accept aliases
        except ValueError:
            found = None
        if found not in allowed:
            raise argparse.ArgumentTypeError(_not_one_of(text, [str(member) for member in allowed]))
        return found

    return parse


def port(text: str) -> int:
    """Parse a TCP port, 0 to 65535."""
    return _whole(text, 0, 65535, "a port is a whole number from 0 (any free one) to 65535")


def index(text: str) -> int:
    """Parse the number of a server among several, 0 or more."""
    return _whole(text, 0, 5000, "an index is a whole number from 0 to 5000")


def count(text: str) -> int:
    """Parse a count, 1 or more."""
    return _whole(text, 1, 10**9, "give a whole number above 0")


def seconds(text: str) -> float:
    """Parse a duration in seconds, above 0."""
    return _number(text, lambda value: 0 < value < 1e6, "give a number of seconds above 0")


def hertz(text: str) -> float:
    """Parse a rate per second, above 0."""
    return _number(text, lambda value: 0 < value < 1e6, "give a number per second, above 0")


def image_size(text: str) -> tuple[int, int]:
    """Parse width and height of an image, pixels."""
    width, cross, height = text.lower().partition("x")
    if cross and width.isdecimal() and height.isdecimal():
        size = int(width), int(height)
        if all(0 < side <= _LARGEST_IMAGE for side in size):
            return size
    raise argparse.ArgumentTypeError(f"{text!r}: write WIDTHxHEIGHT in pixels, 1 to {_LARGEST_IMAGE}, as in 640x480")


def _not_one_of(value: str, known: Sequence[str]) -> str:
    return f"{value!r} is not one of {', '.join(known)}.{did_you_mean(value, known)}"


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
