"""The parser and the options that commands share."""

from __future__ import annotations

import argparse
import sys
from argparse import Namespace
from collections.abc import Callable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NoReturn, TypeAlias, TypeVar, cast
from urllib.parse import urlsplit

from urlab_client._installation import need
from urlab_client.cli._common import CommandError, joined, refusing
from urlab_client.enums import StepMode
from urlab_client.values.names import did_you_mean

if TYPE_CHECKING:
    from urlab_client.integrations.gym import Task

Example = tuple[str, str]
"""A command line, and what it does."""

Options: TypeAlias = argparse._ActionsContainer  # pyright: ignore[reportPrivateUsage]  # noqa: SLF001
"""What an option can be added to: a parser or one of its groups."""

C = TypeVar("C")
E = TypeVar("E", bound=StrEnum)

_LARGEST_IMAGE = 16384
_LOOPBACK = ("localhost", "127.0.0.1", "::1")


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


def make_client(flavour: Callable[..., C], address: str, arguments: Namespace, **options: Any) -> C:
    """Return a client of one of the two classes for the server that the arguments name.

    A MuJoCo version that differs from the server's is not an error: the client warns and compiles the model locally.
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


def add_address(parser: Parser, default: str | None = "tcp://localhost", otherwise: str = "") -> None:
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
        help="HOST[:PORT], tcp://HOST[:PORT], ipc://PATH, or sim://MODEL to start a simulated server just for this "
        f"command (default: {otherwise or '%(default)s'})",
    )
    add_mjcf_options(parser, "with sim://MODEL")


def add_mjcf_options(parser: Parser, when: str) -> None:
    """Add `--mjcf-options`, which applies when a model is loaded."""
    parser.add_argument(
        "--mjcf-options",
        action="store_true",
        help=f"{when}: use the <option> of each model (timestep, integrator, ...) instead of the plugin's defaults",
    )


def add_client(parser: Parser, *, state: bool = True, handshake: bool = False) -> None:
    """Add how to reach a server besides its address: ports and CURVE keys.

    Args:
        parser: The command's parser.
        state: Whether the command uses the state stream.
        handshake: Whether the command can watch alongside the driving client.
    """
    group = parser.add_argument_group("connection")
    parser.set_defaults(handshake=None, state_port=None)
    group.add_argument(
        "--step-port",
        type=port,
        default=5559,
        metavar="PORT",
        help="RPC port of the server, if the address has none (default: %(default)s)",
    )
    if state:
        group.add_argument(
            "--state-port",
            type=port,
            metavar="PORT",
            help="port of the server's state stream (default: the one that the server announces, otherwise 5555)",
        )
    group.add_argument(
        "--server-key", metavar="FILE", help="public key of a server that uses keys (default: $URLAB_SERVER_KEY)"
    )
    group.add_argument(
        "--client-key",
        metavar="FILE",
        help="this client's secret key, if the server requires one (default: $URLAB_CLIENT_KEY)",
    )
    if handshake:
        group.add_argument(
            "--handshake",
            type=Path,
            metavar="FILE",
            help="watch alongside the driving client, without taking over its session: FILE holds what its "
            "client.handshake() returns, or GET /api/handshake of its console",
        )


def handshake(arguments: Namespace) -> bytes | None:
    """Return what a command's client passes to `discover()`."""
    return None if arguments.handshake is None else arguments.handshake.read_bytes()


def add_dialect(parser: Options) -> None:
    """Add `--dialect` to a command that starts a simulated server."""
    parser.add_argument(
        "--dialect",
        choices=("alpha", "beta"),
        default="alpha",
        metavar="NAME",
        help="plugin generation to simulate: alpha (June 2026) or beta (August 2026) (default: alpha)",
    )


def add_step_mode(parser: Parser) -> None:
    """Add the choice between watching physics run and stepping it."""
    parser.add_argument(
        "--step-mode",
        type=one_of(StepMode.LIVE, StepMode.DIRECT),
        metavar="MODE",
        default=StepMode.LIVE,
        help="live or direct (default: %(default)s)",
    )


def add_cameras(parser: Parser, what: str, hz: float | None = 30.0) -> None:
    """Add `--camera`, which may be repeated and whose values `cameras` interprets, and `--camera-hz`.

    Args:
        parser: The command's parser.
        what: What the camera is used for.
        hz: Default rate; None for a command without the option, which takes 30.
    """
    parser.add_argument(
        "--camera",
        action="append",
        default=[],
        metavar="NAME",
        help=f"{what}, as ARTICULATION/CAMERA, or 'all'; may be repeated",
    )
    parser.set_defaults(camera_hz=30.0)
    if hz is not None:
        parser.add_argument(
            "--camera-hz", type=hertz, default=hz, metavar="HZ", help="pictures per second (default: %(default)s)"
        )


def add_record(parser: Parser, hz: float | None = 30.0) -> None:
    """Add `--record` and what belongs to it; see `recorded`."""
    parser.add_argument("--record", type=Path, metavar="FILE", help="record into a .mcap file (extra 'mcap')")
    add_cameras(parser, "with --record: a camera to record", hz)
    parser.add_argument("--overwrite", action="store_true", help="with --record: replace FILE if it exists")


def cameras(given: list[str]) -> list[str] | Literal["all"]:
    """Return the cameras that were given with `--camera`."""
    return "all" if "all" in given else given


def add_recording(parser: Parser) -> None:
    """Add the recording that a command reads."""
    parser.add_argument("recording", type=Path, metavar="FILE", help="a .mcap file, or a server's .json recording")


def add_policy(parser: Parser, robot: str) -> None:
    """Add the policy that a command runs, its declaration and `--robot`."""
    parser.add_argument("policy", type=Path, metavar="POLICY", help="the network, a .onnx file")
    parser.add_argument(
        "--declaration",
        type=Path,
        metavar="FILE",
        help="the .toml file (default: the one beside POLICY with the same name)",
    )
    parser.add_argument("--robot", metavar="ROBOT", help=robot)


def add_task(parser: Parser) -> None:
    """Add `--task`, which `task_named` resolves."""
    parser.add_argument(
        "--task",
        metavar="TASK",
        help="a task, such as urlab/Reach-v0, or module:Class of your own, found from the current folder",
    )


def task_named(name: str) -> type[Task]:
    """Return the task that `--task` names."""
    need("gymnasium", extra="gym")
    from urlab_client.integrations.gym import task_named as found

    if (here := str(Path.cwd())) not in sys.path:
        sys.path.insert(0, here)  # an installed command does not look there
    with refusing(ValueError, option="--task"):
        return found(name)


def add_page(parser: Parser, default_port: int) -> None:
    """Add the options of a page that the command serves."""
    parser.add_argument(
        "--recordings",
        type=Path,
        default=Path("recordings"),
        metavar="FOLDER",
        help="folder for recordings, created with the first one (default: %(default)s)",
    )
    network = parser.add_argument_group("network")
    network.add_argument("--port", type=port, help=f"port to serve at; 0: any free one (default: {default_port})")
    network.add_argument(
        "--host",
        default="127.0.0.1",
        help="interface to bind (default: %(default)s); others need --allow-host. Nothing is encrypted: use a TLS "
        "proxy or an SSH tunnel",
    )
    network.add_argument(
        "--allow-host",
        action="append",
        default=[],
        metavar="NAME",
        help="host name by which browsers and programs reach the page, besides localhost; repeatable",
    )
    network.add_argument(
        "--public-url",
        type=_public_url,
        metavar="URL",
        help="URL by which browsers and programs reach the page through a proxy, which removes its path",
    )
    network.add_argument("--open", action="store_true", help="open the page in the browser")


def _public_url(text: str) -> str:
    parts = urlsplit(text)
    if parts.scheme not in {"http", "https"} or not parts.hostname or parts.query or parts.fragment:
        raise argparse.ArgumentTypeError(f"{text!r} is not a URL of a page, such as https://lab.example/robots/")
    return text.rstrip("/")


def check_page(arguments: Namespace) -> None:
    """Admit the host of the public URL, and refuse an interface that no host name reaches."""
    if host := urlsplit(str(arguments.public_url or "")).hostname:
        arguments.allow_host = [*arguments.allow_host, host]
    if arguments.host not in _LOOPBACK and not arguments.allow_host:
        raise CommandError(f"--host {arguments.host}: pass --allow-host NAME, the name by which browsers reach it")


def host_names(arguments: Namespace) -> list[str]:
    """Return the host names by which the page is reached."""
    return [*_LOOPBACK, *(name.lower() for name in arguments.allow_host)]


def page_url(arguments: Namespace, number: int) -> str:
    """Return the URL of the page that is served at a port."""
    return arguments.public_url or f"http://{arguments.allow_host[0] if arguments.allow_host else '127.0.0.1'}:{number}"


def address(text: str) -> str:
    """Parse the address of a server; a host without a scheme is reached over TCP."""
    if "://" in text:
        return text
    from urlab_client.server.assets.bundled_robots import bundled_models

    if text in bundled_models() or text.endswith((".xml", ".json")):
        raise argparse.ArgumentTypeError(f"{text!r} is a model, not an address; write sim://{text} to start a server")
    return f"tcp://{text}"


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
