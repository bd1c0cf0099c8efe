"""A program that keeps its event loop for long while a stream is open. In a child, which libzmq might end."""

from __future__ import annotations

from forked import program

BLOCKED = """
import asyncio, time
from urlab_client.aio import URLabClient
from urlab_client.aio.transport import connection, subscriber
from urlab_client.server import SimulatedServer, open_server

open_server.CLOSE_S = 60.0  # on a busy machine its threads take longer to end

async def main():
    async with SimulatedServer("arm", play=True) as server, URLabClient(**server.client_options()) as client:
        await client.discover()
        # Only the stream's connection is to be given up: on a busy machine, the requests' would be, too.
        connection.HEARTBEAT_MS, connection.SILENCE_MS, subscriber._QUEUED_MESSAGES = 100, 300, 10
        async with client.state_stream(timeout=None) as states:
            for _ in range(3):
                await states.receive()
                time.sleep(1.0)  # the queue fills, heartbeats are not seen, and the connection is given up
            for _ in range(20):
                await states.receive()
            await client.runtime.forward()

asyncio.run(main())
print("well")
"""


def test_a_stream_goes_on_after_its_connection_was_given_up() -> None:
    running = program(BLOCKED)
    out, err = running.communicate(timeout=240)
    assert (running.returncode, out.strip(), err) == (0, "well", "")
