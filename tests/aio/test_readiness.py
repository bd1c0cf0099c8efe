"""The async client on an event loop that watches no sockets, which on Windows is the default."""

from __future__ import annotations

import asyncio
import gc
import sys
import threading
import weakref
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest
import zmq
from bare_loop import BareLoop, run_bare
from waiting import DEADLINE_S, eventually, gives_up, until

from urlab_client import ClientClosed, OutcomeUnknown, URLabTimeoutError
from urlab_client.aio import URLabClient
from urlab_client.aio.transport import waiting as transport_waiting
from urlab_client.events import ServerAnswers, ServerLost, ServerSilent
from urlab_client.server import SimulatedServer

# Wine takes a hundred times as long for each as Linux.
CLIENTS = 20 if sys.platform == "win32" else 100  # each takes five of the 1024 files that a user may have open

Main = Callable[[URLabClient], Coroutine[Any, Any, None]]


def watchers() -> list[threading.Thread]:
    """Return the threads that watch sockets for a loop."""
    return [thread for thread in threading.enumerate() if thread.name == "urlab-waiter"]


@pytest.fixture
def run(scripted: Any) -> Callable[[Main], None]:
    """Run something with a client of the scripted server; afterwards no thread is left."""

    async def with_client(main: Main) -> None:
        async with URLabClient("tcp://127.0.0.1", step_port=scripted.port, local_model=False) as client:
            await main(client)
        assert not watchers()

    return lambda main: run_bare(with_client(main))


def test_a_simulation_is_stepped_and_watched() -> None:
    async def main() -> list[int]:
        async with URLabClient("sim://arm", step_mode="direct") as client:
            await client.discover()
            async with client.state_stream("all") as states:
                await until(lambda: states.stats.received)
                assert len(watchers()) == 1
                for _ in range(50):
                    await client.step(2)
                seen = [0]
                async with asyncio.timeout(DEADLINE_S):
                    while seen[-1] < 100:  # a paused play repeats its state
                        seen.append((await anext(states)).step)
                return sorted({*seen})

    assert run_bare(main()) == list(range(0, 102, 2))
    assert not watchers()


def test_shared_memory_and_what_tells_of_news_in_it(tmp_path: Path) -> None:
    async def main() -> None:
        with SimulatedServer("arm", play=True, shm_dir=tmp_path) as server:
            async with URLabClient(**server.client_options(), transport="shm") as client:
                await client.discover()
                for _ in range(20):
                    await client.step()
                assert client.transport_stats.over_shm >= 10

    run_bare(main())


def test_many_clients_of_one_loop_share_one_thread(scripted: Any) -> None:
    async def main() -> None:
        address = f"tcp://127.0.0.1:{scripted.port}"
        clients = [URLabClient(address, local_model=False, rcv_timeout_ms=60_000) for _ in range(CLIENTS)]
        for _ in range(2):
            assert all(await asyncio.gather(*(client.meta() for client in clients)))
            assert len(watchers()) == 1
        await asyncio.gather(*(client.close() for client in clients))
        assert not watchers()

    run_bare(main())


def test_a_reply_that_comes_late_is_dropped_and_told_of(run: Callable[[Main], None], scripted: Any) -> None:
    async def main(client: URLabClient) -> None:
        async with client.events() as events:
            assert await client.meta()
            scripted.on("meta", None)
            with pytest.raises(URLabTimeoutError, match="no reply"):
                await client.meta(timeout=0.05)
            scripted.release({"op": "meta_ok", "ops": []})
            told: list[object] = []
            async with asyncio.timeout(DEADLINE_S):
                while not told or not isinstance(told[-1], ServerAnswers):
                    told.append(await anext(events))
            assert [type(event) for event in told[-2:]] == [ServerSilent, ServerAnswers]
            assert client.transport_stats.late == 1

    run(main)


def test_a_call_is_cancelled_and_the_next_one_works(run: Callable[[Main], None], scripted: Any) -> None:
    async def main(client: URLabClient) -> None:
        assert await client.meta()
        answer = scripted.answers["meta"]
        scripted.on("meta", None)
        scripted.seen.queue.clear()
        await gives_up(client.meta, scripted.held.qsize, "cancelled")
        scripted.release({"op": "meta_ok", "ops": []})
        scripted.on("meta", answer)
        assert await client.meta()
        assert client.transport_stats.late == 1

    run(main)


def test_closing_ends_a_call_under_way(run: Callable[[Main], None], scripted: Any) -> None:
    async def main(client: URLabClient) -> None:
        scripted.on("meta", None)
        call = asyncio.create_task(client.meta())
        await until(lambda: not scripted.held.empty())
        await client.close()
        with pytest.raises(ClientClosed):
            await call

    run(main)


def test_a_server_that_dies_is_noticed_at_once(run: Callable[[Main], None], scripted: Any) -> None:
    async def main(client: URLabClient) -> None:
        async with client.events() as events:
            scripted.on("reset", None)
            call = asyncio.create_task(client.reset(timeout=None))
            await until(lambda: not scripted.held.empty())
            scripted.close()
            with pytest.raises(OutcomeUnknown):
                await call
            async with asyncio.timeout(DEADLINE_S):
                while not isinstance(await anext(events), ServerLost):
                    pass

    run(main)


def test_a_loop_that_is_closed_underneath_clients_takes_its_thread_along(
    scripted: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(transport_waiting, "_CHECK_S", 0.05)

    async def main() -> URLabClient:
        client = URLabClient("tcp://127.0.0.1", step_port=scripted.port, local_model=False)
        await client.meta()
        return client

    others = weakref.WeakSet(obj for obj in gc.get_objects() if isinstance(obj, BareLoop))  # which older anyio keeps
    client = run_bare(main())
    eventually(lambda: not watchers(), "the thread did not end")
    asyncio.run(client.close())
    loops = [obj for obj in gc.get_objects() if isinstance(obj, BareLoop) and obj not in others]
    assert loops
    gone = [weakref.ref(loop) for loop in loops]
    del client, loops
    gc.collect()
    assert not [loop for loop in gone if loop() is not None]


@pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning")
def test_a_client_that_nobody_closed_goes_with_its_loop(scripted: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """And not only when the thread sees that the loop is closed: the next client wants the server's memory."""
    monkeypatch.setattr(transport_waiting, "_CHECK_S", 5.0)

    async def main() -> tuple[weakref.ref[URLabClient], weakref.ref[object]]:
        client = URLabClient("tcp://127.0.0.1", step_port=scripted.port, local_model=False)
        await client.meta()
        return weakref.ref(client), weakref.ref(client._state.session.transport)

    gone = run_bare(main())
    gc.collect()
    assert [reference() for reference in gone] == [None, None]
    eventually(lambda: not watchers(), "the thread did not end")


def test_two_loops_have_a_thread_each(scripted: Any) -> None:
    meet = threading.Barrier(2)
    seen: list[int] = []

    async def main() -> None:
        async with URLabClient("tcp://127.0.0.1", step_port=scripted.port, local_model=False) as client:
            await client.meta()
            meet.wait(DEADLINE_S)
            seen.append(len(watchers()))
            meet.wait(DEADLINE_S)
            assert await client.meta()

    threads = [threading.Thread(target=run_bare, args=[main()]) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(DEADLINE_S)
    assert seen == [2, 2]
    assert not watchers()


def test_a_socket_that_was_closed_meanwhile_does_not_hide_the_others(
    run: Callable[[Main], None], scripted: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Windows refuses to watch any when one of them is closed; Linux says which one it is."""
    poll, closed = zmq.zmq_poll, set[int]()

    def as_on_windows(items: list[tuple[int, int]], timeout: int) -> list[tuple[int, int]]:
        if closed & {fd for fd, _ in items}:
            raise zmq.ZMQError(zmq.ENOTSOCK)
        return poll(items, timeout)

    async def main(client: URLabClient) -> None:
        loop = asyncio.get_running_loop()
        with zmq.Context() as context, context.socket(zmq.PAIR) as pair:
            dead = transport_waiting.Watch(loop, lambda: None, fd=pair.fileno())
            closed.add(pair.fileno())
            assert await client.meta()
            dead.close()

    monkeypatch.setattr(zmq, "zmq_poll", as_on_windows)
    run(main)


def test_what_a_reader_raises_does_not_deafen_it() -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        told = list[dict[str, Any]]()
        loop.set_exception_handler(lambda _, context: told.append(context))
        heard = list[bytes]()
        with zmq.Context() as context, context.socket(zmq.PULL) as pull, context.socket(zmq.PUSH) as push:
            pull.bind("inproc://here")

            def hear() -> None:
                while pull.get(zmq.EVENTS) & zmq.POLLIN:
                    heard.append(pull.recv())
                raise RuntimeError("what was heard")

            watched = transport_waiting.Watch(loop, hear, fd=pull.fileno())
            push.connect("inproc://here")
            for word in (b"one", b"two"):
                push.send(word)
                await until(lambda word=word: word in heard)
            watched.close()
        assert all(isinstance(context["exception"], RuntimeError) for context in told)

    run_bare(main())


async def test_news_in_a_region_is_reported_once_each_time_it_is_expected() -> None:
    news, reports = threading.Event(), list[bool]()

    def report() -> None:
        reports.append(news.is_set())
        news.clear()

    watch = transport_waiting.Watch(asyncio.get_running_loop(), report, has_news=news.is_set, fastest_s=1e-4)
    assert len(watchers()) == 1
    for _ in range(3):
        news.set()
        watch.expect()
        await until(lambda: not news.is_set())
    watch.expect()
    watch.close()
    assert reports == [True] * 3
    assert not watchers()


async def test_a_thread_that_sleeps_until_a_signal_looks_when_it_comes() -> None:
    signal, pauses, came = threading.Event(), list[float](), asyncio.Event()

    def block(seconds: float) -> None:
        pauses.append(seconds)
        signal.wait(DEADLINE_S)

    loop = asyncio.get_running_loop()
    watch = transport_waiting.Watch(loop, came.set, has_news=signal.is_set, fastest_s=1e-4, block=block)
    watch.expect()
    await until(lambda: pauses)
    signal.set()
    await asyncio.wait_for(came.wait(), DEADLINE_S)
    watch.close()
    assert all(1e-4 <= pause <= 5e-3 for pause in pauses)


def test_one_thread_watches_sockets_and_regions_of_a_loop() -> None:
    async def main() -> None:
        loop, heard, news = asyncio.get_running_loop(), list[bytes](), threading.Event()
        with zmq.Context() as context, context.socket(zmq.PULL) as pull, context.socket(zmq.PUSH) as push:
            pull.bind("inproc://here")
            push.connect("inproc://here")

            def hear() -> None:
                while pull.get(zmq.EVENTS) & zmq.POLLIN:
                    heard.append(pull.recv())

            socket_watch = transport_waiting.Watch(loop, hear, fd=pull.fileno())
            region_watch = transport_waiting.Watch(loop, news.clear, has_news=news.is_set, fastest_s=1e-4)
            region_watch.expect()
            assert len(watchers()) == 1
            push.send(b"one")
            await until(lambda: heard)
            news.set()
            await until(lambda: not news.is_set())
            push.send(b"two")
            await until(lambda: len(heard) == 2)
            socket_watch.close()
            region_watch.close()
        assert not watchers()

    run_bare(main())
