"""The end: from any state, from a signal handler, at interpreter exit; and readers that never read."""

from __future__ import annotations

import subprocess
import sys
import tracemalloc
from collections.abc import Iterator

import pytest
from publisher import Publisher
from waiting import until

from urlab_client.aio import URLabClient
from urlab_client.aio.streams.stream import Stream
from urlab_client.errors import StreamOverflow

SERVED = """
import asyncio, os, signal, sys, threading, urlab_client, urlab_client.aio
from urlab_client.server import SimulatedServer
server = SimulatedServer("arm", play=True)
server.start()
client = urlab_client.URLabClient(**server.client_options(), step_mode="live")
client.discover()
states = client.state_stream("all")
states.receive()
events = client.events()
"""

ENDS = {
    "from a signal handler": """
signal.signal(signal.SIGTERM, lambda *_: client.close())
os.kill(os.getpid(), signal.SIGTERM)
client.close()
""",
    "while other threads read and step": """
def go_on(what):
    try:
        while True:
            what()
    except urlab_client.ClientClosed:
        pass
others = [threading.Thread(target=go_on, args=[what]) for what in (lambda: states.receive(timeout=None), client.step)]
for other in others:
    other.start()
client.close()
for other in others:
    other.join(30)
    assert not other.is_alive()
""",
    "without closing anything": "",
    "with the server gone first": "server.close(); client.close()",
}


@pytest.mark.parametrize("end", ENDS)
def test_the_blocking_client_ends_without_a_word(end: str) -> None:
    threads = "assert not [t.name for t in threading.enumerate() if t.name == 'urlab-io'], threading.enumerate()"
    check = threads if "clos" in ENDS[end] else ""
    script = SERVED + ENDS[end] + "\n" + check
    command = [sys.executable, "-W", "ignore::ResourceWarning", "-c", script]  # which development mode shows
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
    assert (done.returncode, done.stderr) == (0, "")


async def test_a_reader_that_stops_reading_costs_a_bounded_amount(unused_publisher: Publisher) -> None:
    """Forty megabytes are published, two are kept, and the reader is told what it missed."""
    publisher, payload = unused_publisher, bytes(20_000)
    client = URLabClient("tcp://127.0.0.1", state_port=publisher.port, local_model=False)
    source = client._publishers.state()
    stream = Stream(source, policy="all", buffer_bytes=2_000_000)
    async with client, stream:
        await publisher.subscribed(b"state/full")
        tracemalloc.start()
        for sent in range(1, 2001):
            publisher.send(b"state/full", payload)
            if sent % 100 == 0:
                await until(lambda sent=sent: stream.stats.received >= sent)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 6_000_000
        assert stream.stats.waiting == 100
        with pytest.raises(StreamOverflow) as overflow:
            await stream.receive()
        assert overflow.value.lost == 1900


@pytest.fixture
def unused_publisher() -> Iterator[Publisher]:
    publisher = Publisher()
    yield publisher
    publisher.close()
