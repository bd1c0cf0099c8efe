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

from urlab_client import aio
from urlab_client._installation import conflict
from urlab_client.aio.client_types import Diagnosis
from urlab_client.cli._arguments import WATCHER, address_usage, handshake, make_client
from urlab_client.cli._common import import_mujoco, json_line
from urlab_client.errors import URLabError

_UNHEALTHY = 1

logger: logging.Logger = logging.getLogger("urlab_client.cli")

USAGE = f"""
{address_usage()}
--step-mode auto|live|direct|puppet=auto  the mode your program asks for
--timeout S=2  deadline
--json  print JSON
{WATCHER}
examples:
urlab doctor  the server on this machine
urlab doctor 'sim://arm?unpaused'  a simulated server, started for this command
urlab doctor --step-mode direct --json  for a program that steps; print JSON
"""


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
        aio.URLabClient,
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
