"""The parser and the options that commands share."""

from __future__ import annotations

import argparse
import re
import sys
from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal, NoReturn, TypeAlias, TypeVar, cast
from urllib.parse import urlsplit

from urlab_client._installation import need
from urlab_client.cli._common import CommandError, joined, refusing
from urlab_client.values.names import did_you_mean

if TYPE_CHECKING:
    from urlab_client.integrations.gym import Task

Example = tuple[str, str]
"""A command line, and what it does."""

Kinds: TypeAlias = Mapping[str, Callable[[str], Any]]
"""How values are read, by the names of arguments and options as attributes."""

C = TypeVar("C")

_LARGEST_IMAGE = 16384
_LARGEST = 1e6
_LOOPBACK = ("localhost", "127.0.0.1", "::1")


class Parser(argparse.ArgumentParser):
    """Reports wrong arguments in one line and exits with code 2.

    Attributes:
        examples: Shown at the end of the help.
    """

    def __init__(self, **options: Any) -> None:
        # An abbreviation that works today could become ambiguous when an option is added.
        super().__init__(allow_abbrev=False, **options)
        self.examples: list[Example] = []

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
        found, unknown = super().parse_known_args(args and self._arguments_first(args), namespace)
        if unknown:
            if unknown[0].startswith("-"):
                self._refuse_option(unknown[0])
            self.error(f"{unknown[0]!r} is one argument too many")
        return found, unknown

    def _refuse_option(self, word: str) -> NoReturn:
        option = word.partition("=")[0]
        self.error(f"{option} is not an option.{did_you_mean(option, self._option_string_actions)}")

    def _arguments_first(self, words: Sequence[str]) -> Sequence[str]:
        """Put what is no option first: argparse gives as many arguments as it can to the words before an option.

        An unknown option is refused here, before argparse says what is missing.
        """
        arguments, options, left = list[str](), list[str](), list(words)
        while left:
            name, equals, _ = (word := left.pop(0)).partition("=")
            option = self._option_string_actions.get(name)
            if self.commands or word == "--":
                return words
            if option is None and word.startswith("--"):
                self._refuse_option(word)
            if option is None and word.startswith("-") and word != "-":  # with its value, or not one either
                return words
            (arguments if option is None else options).append(word)
            if option is None or equals:
                continue
            most = option.nargs if isinstance(option.nargs, int) else 1 if option.nargs in (None, "?") else len(left)
            while most > 0 and left and left[0].partition("=")[0] not in self._option_string_actions:
                options.append(left.pop(0))
                most -= 1
        return [*arguments, *options]

    def error(self, message: str) -> NoReturn:
        """See `argparse.ArgumentParser.error`."""
        self.exit(2, f"{self.prog}: {joined(message)} (see {self.prog} --help)\n")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            known = [str(choice) for choice in action.choices]
            raise argparse.ArgumentError(action, _not_one_of(str(value), known))


def add_usage(parser: Parser, usage: str, kinds: Kinds = MappingProxyType({})) -> None:
    """Add the arguments, options and examples that a text declares.

    An entry is what the user writes, two spaces, and what it means; indented lines continue it. A line such as
    `network:` begins a group, and `options:` ends it. Command lines stand below `examples:`, at the end.

    `NAME=5` is a value with its default, `NAME?` a value that can be left out, `NAME+` several of them, and `NAME...`
    the value of an option that can be repeated; `a|b` lists the values there are. The name says how the value is read:
    see `_KINDS`. An option without a value is a flag, and `--[no-]name` one with two names. Options that begin with
    `| `, one after another, exclude each other.

    Args:
        parser: The command's parser.
        usage: The text.
        kinds: How further values are read.
    """
    text, _, examples = usage.partition("\nexamples:\n")
    parser.examples += _entries(examples)
    group: Any = parser
    exclusive: Any = None
    for head, meaning in _entries(text):
        if not meaning:
            group = parser if head == "options:" else parser.add_argument_group(head.removesuffix(":"))
            continue
        exclusive = (exclusive or group.add_mutually_exclusive_group()) if head.startswith("| ") else None
        names, options = _argument(head.removeprefix("| "), meaning, kinds)
        (exclusive or group).add_argument(*names, **options)


def _entries(usage: str) -> Iterator[tuple[str, str]]:
    """Yield what the user writes and what it means, which a group's line lacks."""
    for entry in re.split(r"\n+(?=\S)", usage.strip()):
        head, _, meaning = entry.partition("  ")
        yield head.strip(), " ".join(meaning.split())


def _argument(signature: str, meaning: str, kinds: Kinds) -> tuple[list[str], dict[str, Any]]:
    """Return the names of an argument or option, and what argparse has to know of it."""
    words = signature.split()
    names = [word for word in words if word.startswith("-")]
    values = words[len(names) :]
    if not values:
        action = argparse.BooleanOptionalAction if "[no-]" in signature else "store_true"
        return [name.replace("[no-]", "") for name in names], {"help": meaning, "action": action, "default": False}
    options: dict[str, Any] = {"const": ""} if values[0].endswith("?") else {}
    if repeated := signature.endswith("..."):
        options |= {"action": "append", "default": []}
    value, equals, default = (values[0].removesuffix("..."), "", "") if repeated else values[0].partition("=")
    if value.endswith(("?", "+")):
        value, options["nargs"] = value[:-1], value[-1]
    if equals:
        options["default"] = default
        meaning += " (default: %(default)s)" if default and "(default" not in meaning else ""
    if "|" in value:
        options["choices"] = value.split("|")
    elif len(values) > 1:
        options |= {"metavar": tuple(values), "nargs": len(values)}
    else:
        options["metavar"] = value
    if not names:
        names = [value.lower() + ("s" if options.get("nargs") == "+" else "")]
        options |= {"nargs": "?"} if equals else {}
    attribute = names[-1].lstrip("-").replace("-", "_")
    options["type"] = kinds.get(attribute) or _KINDS.get(value, str)
    return names, {"help": meaning, **options}


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
    if getattr(arguments, "handshake", None) is not None:
        if address.startswith("sim://"):
            raise CommandError("--handshake is for a server that another client drives, not for sim://MODEL")
        options = {**options, "read_only": True}
    if getattr(arguments, "state_port", None) is not None:
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


def address_usage(value: str = "ADDRESS=tcp://localhost", otherwise: str = "", or_else: str = "") -> str:
    """Return the usage of the server's address, and of `--mjcf-options` for a server that the command starts.

    Args:
        value: The argument, with its default.
        otherwise: What happens without it, if it has no default.
        or_else: What can stand in its place.
    """
    default = f"(default: {otherwise})" if otherwise else ""
    return f"""
{value}  HOST[:PORT], tcp://HOST[:PORT], ipc://PATH, or sim://MODEL to start a simulated server just for this
    command{or_else} {default}
{MJCF_OPTIONS.format("with sim://MODEL")}
"""


MJCF_OPTIONS = (
    "--mjcf-options  {}: use the <option> of each model (timestep, integrator, ...) instead of the plugin's defaults"
)
SESSIONLESS = """
connection:
--step-port PORT=5559  RPC port of the server, if the address has none
--server-key KEY_FILE  public key of a server that uses keys (default: $URLAB_SERVER_KEY)
--client-key KEY_FILE  this client's secret key, if the server requires one (default: $URLAB_CLIENT_KEY)
"""
"""How to reach a server besides its address, for a command that does not use the state stream."""
CLIENT = f"""{SESSIONLESS}
--state-port PORT  port of the server's state stream (default: the one that the server announces, otherwise 5555)
"""
WATCHER = f"""{CLIENT}
--handshake FILE  watch alongside the driving client, without taking over its session: FILE holds what its
    client.handshake() returns, or GET /api/handshake of its console
"""
PAGE = """
--recordings FOLDER=recordings  folder for recordings, created with the first one
network:
--port PORT  port to serve at; 0: any free one (default: {})
--host HOST=127.0.0.1  interface to bind (default: %(default)s); others need --allow-host. Nothing is encrypted: use a
    TLS proxy or an SSH tunnel
--allow-host NAME...  host name by which browsers and programs reach the page, besides localhost; repeatable
--public-url URL  URL by which browsers and programs reach the page through a proxy, which removes its path
--open  open the page in the browser
options:
"""
CAMERA = "--camera NAME...  {}, as ARTICULATION/CAMERA, or 'all'; may be repeated"
CAMERA_HZ = "--camera-hz HZ={}  pictures per second"
RECORD = f"""
--record FILE  record into a .mcap file (extra 'mcap')
{CAMERA.format("with --record: a camera to record")}
{CAMERA_HZ.format(30)}
--overwrite  with --record: replace FILE if it exists
"""
DIALECT = "--dialect alpha|beta=alpha  plugin generation to simulate: alpha (June 2026) or beta (August 2026)"
STEP_MODE = "--step-mode live|direct{}  whether physics runs by itself, or this command steps it{}"
RECORDING = "RECORDING  a .mcap file, or a server's .json recording"
POLICY = """
POLICY  the network, a .onnx file, or the .toml file beside it
--declaration FILE  the .toml file (default: the one beside POLICY with the same name)
"""
TASK = """
--task TASK  a task, such as urlab/Reach-v0, or module:Class of your own, found from the current folder{}
"""


def handshake(arguments: Namespace) -> bytes | None:
    """Return what a command's client passes to `discover()`."""
    return None if arguments.handshake is None else arguments.handshake.read_bytes()


def cameras(given: list[str]) -> list[str] | Literal["all"]:
    """Return the cameras that were given with `--camera`."""
    return "all" if "all" in given else given


def task_named(name: str) -> type[Task]:
    """Return the task that `--task` names."""
    need("gymnasium", extra="gym")
    from urlab_client.integrations.gym import task_named as found

    if (here := str(Path.cwd())) not in sys.path:
        sys.path.insert(0, here)  # an installed command does not look there
    with refusing(ValueError, option="--task"):
        return found(name)


def policy_task(arguments: Namespace, *about_robots: str) -> tuple[Path, type[Task] | None, int]:
    """Return the network of `POLICY`, the task that it runs in, and the number of observations in its input.

    The task is that of `--task`, or else the one that the declaration names, unless an option about robots is given.
    """
    from urlab_client.integrations.policy import policy_files, read_spec

    network, declaration = policy_files(arguments.policy, arguments.declaration)
    spec = read_spec(declaration) if arguments.task is None or declaration.is_file() else None
    given = [name for name in about_robots if getattr(arguments, name)]
    if arguments.task is not None and given:
        raise CommandError(f"--{given[0].replace('_', '-')} cannot be combined with --task, which determines it")
    name = arguments.task or (spec.task if spec is not None and not given else "")
    if ":" in name and arguments.task is None:  # a policy that somebody sends must not run code of this folder
        raise CommandError(f"{declaration} belongs to the task {name}; say --task {name} to run that module's code")
    return network, task_named(name) if name else None, 1 if spec is None else spec.history


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
    if text.endswith(".mcap"):
        raise argparse.ArgumentTypeError(f"{text!r} is a recording, not the address of a server")
    if "/" in text or Path(text).is_file():
        what = "folder" if Path(text).is_dir() else "file"
        raise argparse.ArgumentTypeError(f"{text!r} is a {what}, not the address of a server")
    return f"tcp://{text}"


def address_or_recording(text: str) -> str | Path:
    """Parse the address of a server, or the path of a recording."""
    return Path(text) if text.endswith(".mcap") and "://" not in text else address(text)


def _file(text: str) -> Path:
    """Parse the path of a file."""
    if "://" in text:
        raise argparse.ArgumentTypeError(f"{text!r} is an address, not a file")
    return Path(text)


def image_size(text: str) -> tuple[int, int]:
    """Parse width and height of an image, pixels."""
    width, cross, height = text.lower().partition("x")
    if cross and width.isdecimal() and height.isdecimal():
        size = int(width), int(height)
        if all(0 < side <= _LARGEST_IMAGE for side in size):
            return size
    raise argparse.ArgumentTypeError(f"{text!r}: write WIDTHxHEIGHT in pixels, 1 to {_LARGEST_IMAGE}, as in 640x480")


def _not_one_of(value: str, known: Sequence[str]) -> str:
    return f"{value!r} is not known.{did_you_mean(value, known)} There are: {', '.join(known)}"


def _whole(low: int, high: int, advice: str) -> Callable[[str], int]:
    """Return what parses a whole number in a range."""

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = low - 1
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r}: {advice}")
        return value

    return parse


def _positive(advice: str) -> Callable[[str], float]:
    """Return what parses a number above 0."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = 0.0
        if not 0 < value < _LARGEST:
            raise argparse.ArgumentTypeError(f"{text!r}: {advice}")
        return value

    return parse


_KINDS: Final[Kinds] = {
    "ADDRESS": address,
    "URL": _public_url,
    "WxH": image_size,
    "PORT": _whole(0, 65535, "a port is a whole number from 0 (any free one) to 65535"),
    "INDEX": _whole(0, 5000, "an index is a whole number from 0 to 5000"),
    "SEED": _whole(0, 2**63, "a seed is a whole number, at least 0"),
    "N": _whole(1, 10**9, "give a whole number above 0"),
    **dict.fromkeys(("S", "SECONDS"), _positive("give a number of seconds above 0")),
    **dict.fromkeys(("HZ", "M/S", "RAD/S"), _positive("give a number per second, above 0")),
    **dict.fromkeys(("NUMBER", "P", "VX"), float),
    **dict.fromkeys(("FILE", "PATH", "DIR", "FOLDER", "OUTPUT", "POLICY", "RECORDING"), _file),
}
"""How a value is read, by its name; others are text."""
