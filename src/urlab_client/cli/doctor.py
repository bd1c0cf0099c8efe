"""`urlab doctor`: why is my robot not moving?

Check a server from its sockets to the set-points, and show what keeps robots from moving. This opens a session, which
takes the server over from the client that drives it, unless you pass --handshake; in your own program, client.explain()
does the same. Exit code 0 if nothing is wrong, 1 if something is.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from argparse import Namespace

from urlab_client._installation import conflict
from urlab_client.aio import URLabClient
from urlab_client.aio.client_types import Diagnosis
from urlab_client.cli._arguments import Parser, add_address, add_client, handshake, make_client, one_of, seconds
from urlab_client.cli._common import import_mujoco, json_line
from urlab_client.enums import StepMode
from urlab_client.errors import URLabError

_UNHEALTHY = 1

logger: logging.Logger = logging.getLogger("urlab_client.cli")


EXAMPLES = (
    ("urlab doctor", "the server on this machine"),
    ("urlab doctor 'sim://arm?unpaused'", "a simulated server, started for this command"),
    ("urlab doctor --step-mode direct --json", "for a program that steps; print JSON"),
)


def add_arguments(parser: Parser) -> None:
    """Add the options."""
    add_address(parser)
    parser.add_argument(
        "--step-mode",
        type=one_of(*StepMode),
        metavar="MODE",
        default=StepMode.AUTO,
        help="the mode your program asks for: auto, live, direct or puppet (default: %(default)s)",
    )
    parser.add_argument("--timeout", type=seconds, default=2.0, metavar="S", help="deadline (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    add_client(parser, handshake=True)


def run(arguments: Namespace) -> int:
    """Print the diagnosis and return 0 when nothing keeps robots from moving, else 1."""
    if found := conflict():
        logger.warning("%s", found)
    import_mujoco()
    diagnosis = asyncio.run(_diagnose(arguments))
    print(json_line(diagnosis) if arguments.json else diagnosis)
    return 0 if diagnosis.healthy else _UNHEALTHY


async def _diagnose(arguments: Namespace) -> Diagnosis:

    client = make_client(
        URLabClient,
        arguments.address,
        arguments,
        step_mode=arguments.step_mode,
        # Promoting the server would repair a fault that the diagnosis has to find.
        auto_promote_step_mode=False,
        rcv_timeout_ms=round(arguments.timeout * 1000),
    )
    async with client:
        with contextlib.suppress(URLabError):  # the diagnosis reports it
            await client.discover(handshake=handshake(arguments))
        return await client.explain()
