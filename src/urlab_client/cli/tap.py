"""`urlab tap`: print and record what clients and a server say to each other, and replay it.

Relay between clients and a server, and print each op with its sizes and its time. Clients connect to the port that is
printed instead of the server's; requests, state and pictures pass unchanged, except for the ports that replies name.
--save keeps every frame, without pixels unless --images is given, and --replay answers requests from such a file,
without a server. Shared memory goes past the relay: leave clients at transport="zmq", which is the default.
"""

from __future__ import annotations

import time
from argparse import Namespace
from contextlib import AbstractContextManager, closing, nullcontext
from pathlib import Path
from typing import Any, Final, cast

from urlab_client.aio.launch import transport_to
from urlab_client.aio.transport.connection import client_keys
from urlab_client.cli._arguments import CLIENT
from urlab_client.cli._common import CommandError, check_ending, refusing, sigterm_interrupts
from urlab_client.conformance.sessions import Passed, Ports, Relay, Replay, SessionWriter, read_session
from urlab_client.conformance.wire import oddities, plain, reply_oddities
from urlab_client.keys import read_pair
from urlab_client.protocol.registry import OPS

USAGE = f"""
ADDRESS=tcp://localhost  HOST[:PORT] or tcp://HOST[:PORT]
--listen [HOST:]PORT=6559  where clients connect
--listen-state PORT  port for the state stream (default: the one after --listen)
--listen-key KEY_FILE  secret key for clients on other machines, who must know its public half
--save FILE  keep every frame in this MCAP file
--images  with --save: keep pixels, too
--strict  name what our declarations do not know
--quiet  do not print ops
--replay FILE  answer from this recorded session
{CLIENT}
examples:
urlab tap tcp://localhost --listen 6559  print what a client at port 6559 does with the editor
urlab tap tcp://localhost --listen 6559 --save session.mcap  record it, to send it
urlab tap --replay session.mcap --listen 6559  answer a client as the recorded server did
"""
_LONGEST: Final = 100
_LAST_PORT: Final = 65535


def run(arguments: Namespace) -> int:
    """Relay, or replay, until Ctrl-C."""
    host, _, number = arguments.listen.rpartition(":")
    if not number.isdigit() or int(number) >= _LAST_PORT:  # the next one is for the state stream
        raise CommandError(f"--listen: {arguments.listen!r} is not a port below {_LAST_PORT}, nor HOST:PORT")
    with refusing(ValueError, option="--listen"):
        key = None if arguments.listen_key is None else read_pair(arguments.listen_key)
        ports = Ports((host or "127.0.0.1").strip("[]"), key)
    own = {"port": int(number), "state_port": arguments.listen_state or (int(number) + 1 if int(number) else 0)}
    with sigterm_interrupts():
        if arguments.replay is not None:
            return _replay(arguments.replay, ports, own)
        return _relay(arguments, ports, own)


def _replay(path: Path, ports: Ports, own: dict[str, int]) -> int:
    with refusing(ValueError):
        session = read_session(path)
    with Replay(session, ports, **own) as replay:
        print(
            f"{path}: {len(session)} exchanges at {ports.host}:{replay.port}, state at {replay.state_port}", flush=True
        )
        replay.join()
    return 0


def _relay(arguments: Namespace, ports: Ports, own: dict[str, int]) -> int:
    if not arguments.address.startswith("tcp://"):
        raise CommandError(f"{arguments.address} cannot be relayed: give tcp://HOST or tcp://HOST:PORT")
    with refusing(ValueError):
        endpoint = transport_to(arguments.address, arguments.step_port, None).endpoint
        keys = client_keys(endpoint, arguments.server_key, arguments.client_key)
    with (
        _saved(arguments) as writer,
        _Tap(arguments, writer, endpoint, keys, arguments.state_port or 5555, ports, **own) as tap,
    ):
        print(f"{endpoint} at {ports.host}:{tap.port}, state at {tap.state_port}", flush=True)
        tap.join()
    return 0


def _saved(arguments: Namespace) -> AbstractContextManager[SessionWriter | None]:
    if arguments.save is None:
        return nullcontext()
    check_ending(arguments.save, ".mcap")
    if arguments.save.exists():
        raise CommandError(f"{arguments.save} exists; choose another name")
    return closing(SessionWriter(arguments.save, images=arguments.images))


class _Tap(Relay):
    """A relay that prints, judges and records."""

    def __init__(self, arguments: Namespace, writer: SessionWriter | None, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._quiet, self._strict, self._writer = arguments.quiet, arguments.strict, writer
        self._known: set[str] = set()

    def on_exchange(self, passed: Passed) -> bytes:
        if self._writer is not None:
            self._writer.exchange(passed)
        if not self._quiet:
            print(described(passed), flush=True)
        for line in departures(passed) if self._strict else ():
            if line not in self._known:
                self._known.add(line)
                print(f"  {line}", flush=True)
        return passed.reply

    def on_message(self, source: str, topic: bytes, payload: bytes) -> tuple[bytes, bytes] | None:
        if self._writer is not None:
            self._writer.message(source, topic, payload)
        return topic, payload


def described(passed: Passed) -> str:
    """Return an exchange on one line."""
    at = time.strftime("%H:%M:%S", time.localtime(passed.at / 1e9))
    return (
        f"{at} {passed.op or '?'}({_fields(passed.request, _ENVELOPE)}) {len(passed.request)} B -> "
        f"{_fields(passed.reply, frozenset())} {len(passed.reply)} B, {1e3 * passed.seconds:.2f} ms"
    )


_ENVELOPE: Final = frozenset({"op", "session_id", "control_owner"})
_LARGE: Final = 1 << 14


def _fields(frame: bytes, hidden: frozenset[str]) -> str:
    if len(frame) > _LARGE:
        return "…"
    try:
        value = plain(frame)
    except ValueError as error:
        return str(error)
    shown = (f"{name}={_value(item)}" for name, item in value.items() if name not in hidden)
    text = ", ".join(shown)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}…"


def _value(item: Any) -> str:
    match item:
        case dict():
            return "{" + ", ".join(map(str, cast("dict[str, Any]", item))) + "}"
        case list():
            return f"[{len(cast('list[Any]', item))}]"
        case bytes():
            return f"{len(item)} B"
        case float():
            return f"{item:g}"
        case _:
            return str(item)


def departures(passed: Passed) -> list[str]:
    """Return how a request and its reply depart from the declarations."""
    op = OPS.get(passed.op)
    if op is None:
        return [f"the op {passed.op!r} is not declared"]
    try:
        request, reply = plain(passed.request), plain(passed.reply)
    except ValueError as error:
        return [f"{passed.op}: {error}"]
    lines = [f"{passed.op}: {line}" for line in oddities(request, op.request)]
    return [*lines, *(f"{reply.get('op')}: {line}" for line in reply_oddities(op, reply))]
