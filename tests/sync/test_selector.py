"""The loop under the blocking client, which asks the system for sockets less often than asyncio does."""

from __future__ import annotations

import asyncio
import socket

from urlab_client.sync._portal import Portal


def test_callbacks_that_never_rest_keep_neither_timers_nor_sockets_waiting() -> None:
    portal = Portal()
    near, far = socket.socketpair()

    async def rest_only_when_both_have_come() -> set[str]:
        loop = asyncio.get_running_loop()
        come: set[str] = set()
        loop.add_reader(near, lambda: come.add("socket"))
        loop.call_later(0.01, come.add, "timer")
        far.send(b"x")
        for _ in range(200_000):  # rounds: far more than fit into the time of the timer
            await asyncio.sleep(0)
            if come == {"socket", "timer"}:
                break
        loop.remove_reader(near)
        return come

    with near, far:
        assert portal.call(rest_only_when_both_have_come) == {"socket", "timer"}
    portal.close()
