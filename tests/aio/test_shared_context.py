"""Clients share a ZeroMQ context, and nobody notices."""

from __future__ import annotations

import asyncio
import gc
import os
import threading
from typing import Any

import pytest

from urlab_client.aio import URLabClient
from urlab_client.aio.transport import connection as shared
from urlab_client.errors import ClientClosed, ServerUnreachable


async def test_those_that_stay_go_on_when_others_are_closed(scripted: Any) -> None:
    address = f"tcp://127.0.0.1:{scripted.port}"
    clients = [URLabClient(address) for _ in range(40)]
    await asyncio.gather(*(client.meta() for client in clients))
    for client in clients[::2]:
        await client.close()
        with pytest.raises(ClientClosed):
            await client.meta()
    assert all(await asyncio.gather(*(client.meta() for client in clients[1::2])))
    for client in clients[1::2]:
        await client.close()
    async with URLabClient(address) as late:
        assert await late.meta()


async def test_a_client_that_finds_no_server_gives_it_back_and_one_without_an_address_does_at_once() -> None:
    gc.collect()  # clients of other tests that were not closed
    users = shared.shared_context._users
    async with URLabClient("tcp://127.0.0.1:9", rcv_timeout_ms=100) as lost:
        with pytest.raises(ServerUnreachable):
            await lost.meta()
        assert shared.shared_context._users == users + 1
    assert shared.shared_context._users == users
    async with URLabClient(f"ipc:///tmp/{'a' * 200}") as wrong:  # longer than a path may be there
        with pytest.raises(ValueError, match="not an address"):
            await wrong.meta()
        assert shared.shared_context._users == users


def test_the_last_one_ends_it_and_the_next_one_gets_another() -> None:
    before = shared.shared_context.borrow()
    assert shared.shared_context.borrow() is before
    shared.shared_context.give_back(before)
    assert not before.closed
    shared.shared_context.give_back(before)
    # Whether it is over depends on clients of other tests that were not closed.
    after = shared.shared_context.borrow()
    assert not after.closed
    assert before.closed or before is after
    shared.shared_context.give_back(after)


def test_borrowed_from_several_threads_at_once() -> None:
    start = threading.Barrier(8)
    failures: list[BaseException] = []

    def use() -> None:
        try:
            start.wait(10)
            for _ in range(50):
                context = shared.shared_context.borrow()
                assert not context.closed
                shared.shared_context.give_back(context)
        except BaseException as failure:  # noqa: BLE001 - told to the test
            failures.append(failure)

    threads = [threading.Thread(target=use) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    assert not failures


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no forks on this system")
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_a_fork_gets_a_context_of_its_own() -> None:
    ours = shared.shared_context.borrow()
    child = os.fork()
    if child == 0:
        own = shared.shared_context.borrow()
        fine = own is not ours and not own.closed
        shared.shared_context.give_back(ours)  # nothing to it: it is the parent's
        shared.shared_context.give_back(own)
        os._exit(0 if fine and own.closed else 1)
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == 0
    assert not ours.closed
    shared.shared_context.give_back(ours)
