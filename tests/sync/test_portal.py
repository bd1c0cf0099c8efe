"""The blocking façade's machinery: calls, closing, interrupts, forks, interpreter exit, twins."""

from __future__ import annotations

import asyncio
import contextlib
import contextvars
import copy
import gc
import pickle
import signal
import subprocess
import sys
import textwrap
import threading
import traceback
import warnings
import weakref
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import pytest
from forked import Program, program
from waiting import DEADLINE_S, eventually

from urlab_client import URLabClient
from urlab_client.errors import ClientClosed, ForkedError, URLabError, URLabRPCError
from urlab_client.sync import _loop
from urlab_client.sync._facade import Facade, FacadeRoot, wrap
from urlab_client.sync._portal import Portal
from urlab_client.sync._signals import DeferredSignals
from urlab_client.values.names import NameMap


async def answer(value: object = 42) -> object:
    await asyncio.sleep(0)
    return value


async def fail(error: BaseException) -> None:
    await asyncio.sleep(0)
    raise error


async def running_thread() -> threading.Thread:
    return threading.current_thread()


def io_thread(portal: Portal) -> threading.Thread:
    """Return the thread that runs the portal's loop between calls."""
    portal.call(answer)
    (thread,) = [t for t in threading.enumerate() if t.name == "urlab-io" and portal._io and t is portal._io._thread]
    return thread


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give clean-up as long as it takes on a busy machine."""
    monkeypatch.setattr(_loop, "GRACE", DEADLINE_S)


@pytest.fixture
def portal() -> Iterator[Portal]:
    portal = Portal()
    yield portal
    portal.close()


class TestCall:
    def test_returns_the_result(self, portal: Portal) -> None:
        assert portal.call(answer, "x") == "x"

    def test_nothing_starts_before_the_first_call(self) -> None:
        before = set(threading.enumerate())
        portal = Portal()
        assert set(threading.enumerate()) <= before
        assert not portal.is_open

    def test_runs_on_the_calling_thread(self, portal: Portal) -> None:
        with ThreadPoolExecutor(1) as pool:
            assert pool.submit(lambda: portal.call(running_thread) is threading.current_thread()).result()

    def test_runs_on_the_main_thread_that_calls(self, portal: Portal) -> None:
        assert portal.call(running_thread) is threading.current_thread()

    async def test_runs_on_the_daemon_thread_for_a_caller_with_a_loop(self, portal: Portal) -> None:
        thread = portal.call(running_thread)
        assert thread.name == "urlab-io"
        assert thread.daemon

    def test_one_daemon_thread_serves_all_callers(self, portal: Portal) -> None:
        def call(_: int) -> None:
            portal.call(answer)

        before = set(threading.enumerate())
        with ThreadPoolExecutor(8) as pool:
            list(pool.map(call, range(64)))
            threads = [thread for thread in set(threading.enumerate()) - before if thread.name == "urlab-io"]
        assert [thread.daemon for thread in threads] == [True]

    @pytest.mark.parametrize("part", ["_run_loop", "_await_turn", "_main", "_end"])
    async def test_calls_fail_with_the_cause_when_the_thread_dies(
        self, part: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        method, first = getattr(_loop.CallerDrivenLoop, part), iter([True])

        def die(*arguments: Any) -> Any:
            if next(first, False):
                raise MemoryError("none left")
            return method(*arguments)

        async def die_later(*arguments: Any) -> Any:
            return await die(*arguments)

        portal = Portal()
        monkeypatch.setattr(_loop.CallerDrivenLoop, part, die_later if part in {"_main", "_end"} else die)
        with ThreadPoolExecutor(1) as pool:
            waiting = pool.submit(portal.call, asyncio.sleep, 3600)
            if part == "_end":
                eventually(lambda: portal._io)
                portal.close()
            with pytest.raises(ClientClosed) as caught:
                waiting.result(DEADLINE_S)
        if part != "_end":
            assert isinstance(caught.value.__cause__, MemoryError)
            with pytest.raises(ClientClosed, match="urlab-io, which runs its event loop, died of MemoryError"):
                portal.call(answer)
        portal.close()
        assert "urlab-io ended unexpectedly" in caplog.text

    def test_the_loop_goes_on_between_calls(self, portal: Portal) -> None:
        ticked = threading.Event()

        async def tick_after_a_while() -> None:
            asyncio.get_running_loop().call_later(0.02, ticked.set)

        portal.call(tick_after_a_while)
        assert ticked.wait(DEADLINE_S)

    def test_other_calls_go_on_when_the_one_that_ran_the_loop_is_done(self, portal: Portal) -> None:
        first_is_in = threading.Event()

        async def first() -> None:
            second_is_in.append(asyncio.Event())
            first_is_in.set()
            await second_is_in[0].wait()

        async def second() -> threading.Thread:
            first_is_out.append((asyncio.get_running_loop(), asyncio.Event()))
            second_is_in[0].set()
            await first_is_out[0][1].wait()
            return threading.current_thread()

        second_is_in: list[asyncio.Event] = []
        first_is_out: list[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = []
        with ThreadPoolExecutor(2) as pool:
            one = pool.submit(portal.call, first)
            first_is_in.wait()
            two = pool.submit(portal.call, second)
            assert one.result(DEADLINE_S) is None
            loop, out = first_is_out[0]
            loop.call_soon_threadsafe(out.set)
            assert two.result(DEADLINE_S).name == "urlab-io"

    def test_calls_of_several_threads_overlap(self, portal: Portal) -> None:
        everyone_is_in: list[asyncio.Barrier] = []

        async def make() -> None:
            everyone_is_in.append(asyncio.Barrier(4))

        async def meet() -> None:
            await everyone_is_in[0].wait()

        portal.call(make)
        with ThreadPoolExecutor(4) as pool:
            list(pool.map(lambda _: portal.call(meet), range(4)))

    def test_sees_the_callers_context_variables(self, portal: Portal) -> None:
        span: contextvars.ContextVar[str] = contextvars.ContextVar("span")

        async def read() -> str:
            return span.get()

        span.set("rollout-7")
        assert portal.call(read) == "rollout-7"

    async def test_works_while_the_callers_thread_runs_a_loop(self, portal: Portal) -> None:
        assert portal.call(answer) == 42

    def test_refuses_to_wait_for_itself(self, portal: Portal) -> None:
        async def inner() -> None:
            portal.call(answer)

        with pytest.raises(URLabError, match=r"own I/O thread.*urlab_client\.aio"):
            portal.call(inner)
        assert portal.call(answer) == 42

    def test_refuses_to_close_from_its_own_thread(self, portal: Portal) -> None:
        async def inner() -> None:
            portal.close(answer)

        with pytest.raises(URLabError, match="own I/O thread"):
            portal.call(inner)
        assert portal.call(answer) == 42

    def test_one_portal_may_wait_for_another(self, portal: Portal) -> None:
        other = Portal()

        async def inner() -> object:
            return other.call(answer)

        assert portal.call(inner) == 42
        other.close()

    @pytest.mark.parametrize("error", [SystemExit(3), KeyboardInterrupt(), asyncio.CancelledError(), ValueError("x")])
    def test_passes_on_any_exception_and_stays_usable(self, portal: Portal, error: BaseException) -> None:
        with pytest.raises(type(error)):
            portal.call(fail, error)
        assert portal.call(answer) == 42

    def test_ends_an_iteration(self, portal: Portal) -> None:
        async def count() -> AsyncIterator[int]:
            for i in range(3):
                yield i

        class Numbers:
            def __init__(self) -> None:
                self.items = count()

            async def get(self) -> int:
                return await anext(self.items)

            def __iter__(self) -> Iterator[int]:
                return self

            def __next__(self) -> int:
                return portal.next(self.get)

        assert list(Numbers()) == [0, 1, 2]


@pytest.mark.parametrize(
    ("module", "asked", "patched", "who"),
    [
        ("gevent.monkey", "is_module_patched", "threading", "gevent"),
        ("gevent.monkey", "is_module_patched", "select", "gevent"),
        ("eventlet.patcher", "is_monkey_patched", "thread", "Eventlet"),
    ],
)
def test_among_greenlets_a_client_says_at_once_that_it_cannot_be(
    monkeypatch: pytest.MonkeyPatch, module: str, asked: str, patched: str, who: str
) -> None:
    monkeypatch.setitem(sys.modules, module, SimpleNamespace(**{asked: lambda name: name == patched}))
    with pytest.raises(URLabError, match=rf"{who} has replaced in this process\. Use it in a separate process"):
        URLabClient()
    monkeypatch.setitem(sys.modules, module, SimpleNamespace(**{asked: lambda name: False}))
    URLabClient().close()


class TestTracebacks:
    def test_shows_caller_portal_and_coroutine(self, portal: Portal) -> None:
        with pytest.raises(ValueError, match="x") as caught:
            portal.call(fail, ValueError("x"))
        names = [frame.name for frame in traceback.extract_tb(caught.value.__traceback__)]
        assert names == ["test_shows_caller_portal_and_coroutine", "call", "fail"]

    def test_a_refusal_shows_no_inner_frames(self, portal: Portal) -> None:
        with pytest.raises(URLabRPCError) as caught:
            portal.call(fail, URLabRPCError("not_ready", "no model", op="step"))
        names = [frame.name for frame in traceback.extract_tb(caught.value.__traceback__)]
        assert names == ["test_a_refusal_shows_no_inner_frames", "call"]

    def test_keeps_the_frames_of_a_call_made_inside_a_coroutine(self, portal: Portal) -> None:
        other = Portal()

        async def outer() -> None:
            other.call(fail, RuntimeError("inner"))

        with pytest.raises(RuntimeError) as caught:
            portal.call(outer)
        names = [frame.name for frame in traceback.extract_tb(caught.value.__traceback__)]
        assert names[1:] == ["call", "outer", "call", "fail"]
        other.close()

    def test_leaves_no_reference_cycle(self) -> None:
        async def err() -> None:
            await asyncio.sleep(0)
            raise ValueError

        portal = Portal()
        gc.collect()
        gc.disable()
        try:
            with contextlib.suppress(ValueError):
                portal.call(err)
            thread = io_thread(portal)
            del portal
            assert not thread.is_alive()
        finally:
            gc.enable()


class TestClose:
    def test_runs_the_last_coroutine_then_ends_the_thread(self) -> None:
        portal = Portal()
        thread = io_thread(portal)
        seen: list[bool] = []

        async def last() -> None:
            seen.append(True)

        portal.close(last)
        assert seen == [True]
        assert not thread.is_alive()

    def test_again_does_nothing(self) -> None:
        portal = Portal()
        portal.call(answer)
        portal.close(answer)
        portal.close(fail, AssertionError("ran"))
        portal.close()

    def test_refuses_later_calls(self) -> None:
        portal = Portal()
        portal.call(answer)
        portal.close()
        with pytest.raises(ClientClosed):
            portal.call(answer)

    def test_a_thread_that_inherits_the_ended_ones_number_is_not_mistaken_for_it(self) -> None:
        portal = Portal()
        number = io_thread(portal).ident
        portal.close()
        refusals: dict[int, type[BaseException]] = {}

        def call() -> None:
            try:
                portal.call(answer)
            except URLabError as error:
                refusals[threading.get_ident()] = type(error)

        for _ in range(100):
            thread = threading.Thread(target=call)
            thread.start()
            thread.join()
            if number in refusals:
                break
        assert set(refusals.values()) == {ClientClosed}

    def test_before_any_call_starts_no_thread(self) -> None:
        before = set(threading.enumerate())
        portal = Portal()
        portal.close()
        assert set(threading.enumerate()) <= before
        with pytest.raises(ClientClosed):
            portal.call(answer)

    def test_ends_the_thread_though_the_last_coroutine_fails(self) -> None:
        portal = Portal()
        thread = io_thread(portal)
        with pytest.raises(OSError, match="gone"):
            portal.close(fail, OSError("gone"))
        assert not thread.is_alive()

    def test_releases_callers_in_other_threads(self) -> None:
        portal = Portal()
        log: list[str] = []
        entered = threading.Event()

        async def hang() -> None:
            entered.set()
            try:
                await asyncio.Event().wait()
            finally:
                await asyncio.sleep(0)
                log.append("cleaned up")

        with ThreadPoolExecutor(1) as pool:
            future = pool.submit(portal.call, hang)
            entered.wait()
            portal.close()
            with pytest.raises(ClientClosed, match="during this call"):
                future.result()
        assert log == ["cleaned up"]

    def test_releases_the_caller_of_a_coroutine_that_refuses_to_end(
        self, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        monkeypatch.setattr(_loop, "GRACE", 0.05)
        portal = Portal()
        entered = threading.Event()

        tasks: list[weakref.ref[Any]] = []

        async def stubborn() -> None:
            tasks.append(weakref.ref(asyncio.current_task()))
            entered.set()
            while True:
                with contextlib.suppress(asyncio.CancelledError):
                    await asyncio.Event().wait()

        with ThreadPoolExecutor(1) as pool:
            future = pool.submit(portal.call, stubborn)
            entered.wait()
            portal.close()
            with pytest.raises(ClientClosed, match="during this call"):
                future.result()
        with caplog.at_level("CRITICAL", logger="asyncio"):  # it says, rightly, that a pending task was destroyed
            gc.collect()
            assert tasks[0]() is None, "not even the error that the caller got keeps the call"

    def test_from_two_threads(self) -> None:
        portal = Portal()
        portal.call(answer)
        both = threading.Barrier(2)

        def close() -> None:
            both.wait()
            portal.close(answer)

        with ThreadPoolExecutor(2) as pool:
            for future in [pool.submit(close) for _ in range(2)]:
                future.result()

    def test_racing_calls_end_one_way_or_the_other(self) -> None:
        for _ in range(50):
            portal = Portal()
            portal.call(answer)

            def call_until_refused(portal: Portal = portal) -> None:
                with contextlib.suppress(ClientClosed):
                    while True:
                        portal.call(answer)

            with ThreadPoolExecutor(2) as pool:
                futures = [pool.submit(call_until_refused) for _ in range(2)]
                portal.close()
                for future in futures:
                    future.result()


class TestGarbageCollection:
    def test_stops_in_order(self) -> None:
        log: list[str] = []
        generators: list[AsyncIterator[None]] = []

        async def say_goodbye() -> None:
            await asyncio.sleep(0)
            log.append("at_stop")

        async def serve() -> None:
            try:
                await asyncio.Event().wait()
            finally:
                await asyncio.sleep(0)
                log.append("task cancelled")

        async def generate() -> AsyncIterator[None]:
            try:
                yield
            finally:
                log.append("generator closed")

        async def begin() -> asyncio.Task[None]:
            task = asyncio.create_task(serve())
            generators.append(generate())
            await anext(generators[0])
            return task

        portal = Portal(say_goodbye)
        task = portal.call(begin)
        thread = io_thread(portal)
        del portal
        assert not thread.is_alive()
        assert log == ["at_stop", "task cancelled", "generator closed"]
        assert task.cancelled()

    def test_is_silent_about_a_failing_at_stop(self, caplog: pytest.LogCaptureFixture) -> None:
        portal = Portal(lambda: fail(ConnectionResetError("server gone")))
        thread = io_thread(portal)
        del portal
        assert not thread.is_alive()
        assert [record for record in caplog.records if record.levelname != "DEBUG"] == []

    def test_on_the_io_thread_itself_does_not_deadlock(self) -> None:
        async def loop() -> asyncio.AbstractEventLoop:
            return asyncio.get_running_loop()

        box = [Portal()]
        thread = io_thread(box[0])
        box[0].call(loop).call_soon_threadsafe(box.clear)
        thread.join(DEADLINE_S)
        assert not thread.is_alive()

    def test_ends_without_its_finalizer(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Which Python does not call again after a signal handler has raised in it."""
        monkeypatch.setattr(_loop, "_OWNER_CHECK_S", 0.01)
        said: list[str] = []

        async def say_goodbye() -> None:
            said.append("goodbye")

        portal = Portal(say_goodbye)
        thread = io_thread(portal)
        assert portal._finalizer is not None
        portal._finalizer.detach()
        del portal
        thread.join(DEADLINE_S)
        assert not thread.is_alive()
        assert said == ["goodbye"]

    def test_a_background_task_does_not_keep_the_portal_alive(self) -> None:
        tasks: list[asyncio.Task[object]] = []

        async def begin() -> None:
            tasks.append(asyncio.create_task(asyncio.Event().wait()))

        portal = Portal()
        portal.call(begin)
        alive = weakref.ref(portal)
        del portal
        assert alive() is None
        assert tasks[0].cancelled()


def child(script: str) -> Program | subprocess.Popen[str]:
    prelude = """
        import asyncio, logging, os, signal, sys, threading
        from urlab_client.errors import ClientClosed, ForkedError
        from urlab_client.sync import _facade, _loop
        from urlab_client.sync._portal import Portal

        # A busy machine: in development mode asyncio says so, and clean-up takes longer than it is given.
        logging.getLogger("asyncio").addFilter(lambda record: not record.getMessage().startswith("Executing "))
        _loop.GRACE = 30

        def say(*words):
            print(*words, flush=True)

        async def answer():
            await asyncio.sleep(0)
            return 42
    """
    source = textwrap.dedent(prelude) + textwrap.dedent(script)
    flags = ("-X", "dev", "-W", "error", "-W", "ignore:This process:DeprecationWarning")  # 3.12: a fork with threads
    return program(source, flags=flags)


def outcome(process: Program | subprocess.Popen[str]) -> tuple[int, list[str], str]:
    out, err = process.communicate(timeout=60)
    return process.returncode, out.splitlines(), err


def interrupt_when_ready(process: Program | subprocess.Popen[str]) -> None:
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    process.send_signal(signal.SIGINT)


class TestInterrupt:
    def test_cleans_up_before_the_caller_does_and_leaves_the_portal_usable(self) -> None:
        process = child("""
            async def hang():
                say("ready")
                try:
                    await asyncio.Event().wait()
                finally:
                    await asyncio.sleep(0.01)
                    say("op cleaned up")

            portal = Portal()
            try:
                try:
                    portal.call(hang)
                finally:
                    say("caller cleans up")
            except KeyboardInterrupt:
                say("interrupted")
            say(portal.call(answer))
            portal.close()
        """)
        interrupt_when_ready(process)
        assert outcome(process) == (0, ["op cleaned up", "caller cleans up", "interrupted", "42"], "")

    def test_is_deferred_until_it_is_let_in_or_the_block_ends(self) -> None:
        class Struck(Exception):
            pass

        def strike(number: int, frame: object) -> None:
            raise Struck

        seen: list[bool] = []

        def late() -> None:
            with DeferredSignals() as signals:
                signal.raise_signal(signal.SIGTERM)
                seen.append(bool(signals.arrived))

        before = signal.signal(signal.SIGTERM, strike)
        try:
            with DeferredSignals() as signals:
                signals.on_arrival = lambda: seen.append(bool(signals.arrived))
                signal.raise_signal(signal.SIGTERM)
                assert seen == [True]
                assert isinstance(signals.let_in(), Struck)
                assert (signals.arrived, signals.let_in()) == ([], None)
            with pytest.raises(Struck):
                late()
            assert seen == [True, True]
            assert signal.getsignal(signal.SIGTERM) is strike
        finally:
            signal.signal(signal.SIGTERM, before)

    def test_ends_a_call_that_runs_in_the_tests_own_process(self, portal: Portal) -> None:
        class Struck(Exception):
            pass

        def strike(number: int, frame: object) -> None:
            raise Struck

        async def struck() -> None:
            signal.raise_signal(signal.SIGTERM)
            await asyncio.Event().wait()

        before = signal.signal(signal.SIGTERM, strike)
        try:
            with pytest.raises(Struck):
                portal.call(struck)
        finally:
            signal.signal(signal.SIGTERM, before)
        assert portal.call(answer) == 42

    def test_unhandled_ends_the_process_with_one_portal_frame(self) -> None:
        process = child("""
            async def hang():
                say("ready")
                await asyncio.Event().wait()

            portal = Portal()
            portal.call(hang)
        """)
        interrupt_when_ready(process)
        code, out, err = outcome(process)
        assert code == -signal.SIGINT
        assert out == []
        assert err.rstrip().endswith("KeyboardInterrupt")
        frames = [line for line in err.splitlines() if line.startswith("  File ")]
        assert [frame.rpartition(" in ")[2] for frame in frames] == ["<module>", "call", "run"]

    def test_does_not_wait_for_a_coroutine_that_ignores_it(self) -> None:
        process = child("""
            logging.getLogger("urlab_client").addHandler(logging.StreamHandler(sys.stdout))
            _loop.GRACE = 0.05

            async def stubborn():
                say("ready")
                with __import__("contextlib").suppress(asyncio.CancelledError):
                    await asyncio.Event().wait()
                await finish.wait()
                say("ended by itself")

            async def make():
                return asyncio.Event()

            async def let_go():
                finish.set()
                await asyncio.sleep(0.01)

            portal = Portal()
            finish = portal.call(make)
            try:
                portal.call(stubborn)
            except KeyboardInterrupt:
                say("interrupted")
            portal.call(let_go)
            portal.close()
        """)
        interrupt_when_ready(process)
        code, out, err = outcome(process)
        assert (code, err) == (0, "")
        assert out == ["stubborn is still running 0.05 s after it was interrupted", "interrupted", "ended by itself"]

    def test_works_inside_a_running_loop(self) -> None:
        process = child("""
            async def hang():
                say("ready")
                try:
                    await asyncio.Event().wait()
                finally:
                    say("op cleaned up")

            async def notebook():
                signal.signal(signal.SIGINT, signal.default_int_handler)  # as a kernel does for a cell
                try:
                    portal.call(hang)
                except KeyboardInterrupt:
                    say("interrupted")
                say(portal.call(answer))

            portal = Portal()
            asyncio.run(notebook())
        """)
        interrupt_when_ready(process)
        assert outcome(process) == (0, ["op cleaned up", "interrupted", "42"], "")

    def test_a_signal_handler_may_close_the_client(self) -> None:
        process = child("""
            async def hang():
                say("ready")
                await asyncio.Event().wait()

            async def farewell():
                say("closing")

            portal = Portal()
            signal.signal(signal.SIGINT, lambda *_: portal.close(farewell))
            try:
                portal.call(hang)
            except ClientClosed as error:
                say(error)
        """)
        interrupt_when_ready(process)
        assert outcome(process) == (
            0,
            ["closing", "The client was closed during this call. Create a new one."],
            "",
        )

    def test_of_several_signals_each_has_its_effect(self) -> None:
        process = child("""
            class First(Exception):
                pass

            class Second(Exception):
                pass

            def raising(error):
                def handler(*_):
                    handled.append(error)
                    raise error
                return handler

            async def strike_twice():
                signal.raise_signal(signal.SIGUSR1)
                signal.raise_signal(signal.SIGUSR2)
                try:
                    await asyncio.Event().wait()
                finally:
                    await asyncio.sleep(0)
                    cleaned_up.append(None)

            handled, cleaned_up = [], []
            signal.signal(signal.SIGUSR1, raising(First))
            signal.signal(signal.SIGUSR2, raising(Second))
            portal = Portal()
            for _ in range(30):
                try:
                    try:
                        portal.call(strike_twice)
                    except First:
                        say("not broken off")  # so the second has struck by then
                except Second:
                    pass
            say(len(handled), len(set(handled)), len(cleaned_up), portal.call(answer))
            portal.close()
        """)
        code, out, err = outcome(process)
        assert (code, out, err) == (0, ["60 2 30 42"], "")

    def test_a_handler_that_does_not_raise_breaks_nothing_off(self) -> None:
        process = child("""
            async def wait_for_the_handler():
                global handled
                handled = asyncio.Event()
                signal.raise_signal(signal.SIGUSR1)
                await handled.wait()
                return "handled"

            async def tell():
                handled.set()

            portal = Portal()
            signal.signal(signal.SIGUSR1, lambda *_: portal.call(tell))
            say([portal.call(wait_for_the_handler) for _ in range(3)])
            portal.close()
        """)
        assert outcome(process) == (0, ["['handled', 'handled', 'handled']"], "")

    def test_breaks_off_a_call_that_a_handler_makes_and_the_one_around_it(self) -> None:
        process = child("""
            async def hang(name):
                os.kill(os.getpid(), signals.pop(0))  # for the main thread, whichever runs this
                try:
                    await asyncio.Event().wait()
                finally:
                    say(name, "cleaned up")

            signals = [signal.SIGUSR1, signal.SIGINT]
            portal = Portal()
            signal.signal(signal.SIGUSR1, lambda *_: portal.call(hang, "inner"))
            try:
                portal.call(hang, "outer")
            except KeyboardInterrupt:
                say("interrupted", portal.call(answer))
            portal.close()
        """)
        assert outcome(process) == (0, ["inner cleaned up", "outer cleaned up", "interrupted 42"], "")

    @pytest.mark.skipif(sys.platform == "win32", reason="signals interrupt no wait there")
    def test_is_seen_even_if_it_did_not_interrupt_the_wait(self) -> None:
        process = child("""
            async def hang():
                signal.siginterrupt(signal.SIGINT, False)  # as if it had arrived just before the caller blocked
                os.kill(os.getpid(), signal.SIGINT)
                await asyncio.Event().wait()

            async def struck():
                signal.raise_signal(signal.SIGUSR1)
                await asyncio.Event().wait()

            portal = Portal()
            signal.signal(signal.SIGUSR1, lambda *_: portal.call(hang))
            try:
                portal.call(struck)
            except KeyboardInterrupt:
                say("interrupted")
            portal.close()
        """)
        assert outcome(process) == (0, ["interrupted"], "")

    def test_before_the_coroutine_has_run_leaves_it_closed(self) -> None:
        process = child("""
            def interrupted_at_once():
                signal.raise_signal(signal.SIGINT)
                return answer()

            portal = Portal()
            for _ in range(10):
                try:
                    portal.call(interrupted_at_once)
                except KeyboardInterrupt:
                    pass
            say(portal.call(answer))
            portal.close()
        """)
        assert outcome(process) == (0, ["42"], "")

    def test_during_closing_cuts_the_last_coroutine_short_and_closes_all_the_same(self) -> None:
        process = child("""
            async def linger():
                say("ready")
                try:
                    await asyncio.Event().wait()
                finally:
                    say("cut short")

            portal = Portal()
            thread = portal.call(answer) and portal._io._thread
            try:
                portal.close(linger)
            except KeyboardInterrupt:
                say("interrupted", thread.is_alive(), portal.is_open)
        """)
        interrupt_when_ready(process)
        assert outcome(process) == (0, ["cut short", "interrupted False False"], "")

    def test_restores_the_handlers_that_were_there_and_not_those_that_were_replaced(self) -> None:
        process = child("""
            def own(*_):
                pass

            async def replace():
                signal.signal(signal.SIGUSR2, own)

            portal = Portal()
            signal.signal(signal.SIGUSR1, own)
            before = [signal.getsignal(number) for number in signal.valid_signals()]
            portal.call(answer)
            say(before == [signal.getsignal(number) for number in signal.valid_signals()])
            portal.call(replace)
            say(signal.getsignal(signal.SIGUSR2) is own)
            portal.close()
        """)
        assert outcome(process) == (0, ["True", "True"], "")

    @pytest.mark.parametrize("loops", ["asyncio", "uvloop"])
    def test_signals_of_an_event_loop_interrupt_no_system_call_after_a_call_either(self, loops: str) -> None:
        process = child(f"""
            import ctypes, {loops}, os, time
            read = ctypes.CDLL(None, use_errno=True).read
            reading, writing = os.pipe()

            def signals(thread):
                for _ in range(100):
                    signal.pthread_kill(thread, signal.SIGUSR1)
                    time.sleep(0)  # the other thread has its turn
                os.write(writing, b"x")

            async def main():
                got = asyncio.Event()
                asyncio.get_running_loop().add_signal_handler(signal.SIGUSR1, got.set)
                portal = Portal()
                portal.call(answer)
                sending = threading.Thread(target=signals, args=[threading.get_ident()])
                sending.start()
                say(read(reading, ctypes.create_string_buffer(1), 1))
                sending.join()
                await got.wait()
                say("got")
                portal.close()

            loop = {loops}.new_event_loop()
            loop.run_until_complete(main())
            loop.close()
        """)
        assert outcome(process) == (0, ["1", "got"], "")

    def test_at_any_moment_leaves_the_portal_usable(self) -> None:
        # An exception may strike between any two instructions of the portal; hundreds of timer signals try.
        process = child("""
            import gc
            gc.disable()  # an exception that strikes in a collector's callback is printed, whoever runs it

            class Struck(Exception):
                pass

            def strike(*_):
                raise Struck

            async def op():
                for _ in range(3):
                    await asyncio.sleep(0)

            portal = Portal()
            portal.call(answer)
            signal.signal(signal.SIGALRM, strike)
            struck = 0
            for i in range(600):
                try:
                    signal.setitimer(signal.ITIMER_REAL, 1e-6 * (1 + i % 300))
                    try:
                        portal.call(op)
                    finally:
                        signal.setitimer(signal.ITIMER_REAL, 0)
                except Struck:
                    struck += 1
            say(struck > 20, portal.call(answer), len(portal._io._jobs))
            portal.close()
        """)
        assert outcome(process) == (0, ["True 42 0"], "")


class TestFork:
    def test_a_child_gets_advice_and_the_parent_goes_on(self) -> None:
        process = child("""
            portal = Portal()
            portal.call(answer)
            pid = os.fork()
            if pid == 0:
                try:
                    portal.call(answer)
                except ForkedError as error:
                    say(error)
                portal.close(answer)
                sys.exit(7)
            say(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
            say(portal.call(answer))
        """)
        code, out, err = outcome(process)
        assert (code, err) == (0, "")
        assert "spawn" in out[0]
        assert "in the child" in out[0]
        assert out[1:] == ["7", "42"]

    def test_a_child_forked_while_locks_are_held_does_not_hang(self) -> None:
        process = child("""
            class Twin(_facade.Facade, twin=object):
                pass

            portal = Portal()
            portal.call(answer)
            held = threading.Event()
            release = threading.Event()

            def hold():
                with portal._lock, portal._io._lock:
                    held.set()
                    release.wait()

            holder = threading.Thread(target=hold)
            holder.start()
            held.wait()
            pid = os.fork()
            if pid == 0:
                for attempt in (lambda: portal.call(answer), lambda: _facade.wrap(portal, Twin, object())):
                    try:
                        attempt()
                    except ForkedError:
                        say("refused")
                portal.close()
                del portal
                sys.exit(0)
            say(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
            release.set()
            holder.join()
            say(portal.call(answer))
        """)
        assert outcome(process) == (0, ["refused", "refused", "0", "42"], "")

    def test_a_child_leaving_a_with_block_keeps_its_exit_code(self) -> None:
        process = child("""
            class Twin:
                async def close(self):
                    say("closed")

            class Client(_facade.FacadeRoot):
                def __enter__(self):
                    self._portal.call(answer)
                    return self
                def __exit__(self, *exc):
                    self._portal.close(self._aio.close)

            with Client(Twin()):
                pid = os.fork()
                if pid == 0:
                    sys.exit(5)
                say(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
        """)
        # "closed" twice: by the last coroutine and, idempotently, by at_stop; both in the parent.
        assert outcome(process) == (0, ["5", "closed", "closed"], "")

    def test_the_error_pickles(self) -> None:
        assert isinstance(pickle.loads(pickle.dumps(ForkedError("x"))), ForkedError)


class TestExit:
    def test_cleans_up_silently(self) -> None:
        process = child("""
            async def at_stop():
                await asyncio.sleep(0)
                say("at_stop")

            async def serve():
                try:
                    await asyncio.Event().wait()
                finally:
                    await asyncio.sleep(0)
                    say("task cancelled")

            async def begin():
                return asyncio.create_task(serve())

            portal = Portal(at_stop)
            task = portal.call(begin)
            say("main ends")
        """)
        assert outcome(process) == (0, ["main ends", "at_stop", "task cancelled"], "")

    def test_keeps_the_exit_code_while_another_thread_waits(self) -> None:
        process = child("""
            entered = threading.Event()

            async def hang():
                entered.set()
                try:
                    await asyncio.Event().wait()
                finally:
                    say("op cleaned up")

            def wait():
                try:
                    portal.call(hang)
                except ClientClosed:
                    pass

            portal = Portal()
            threading.Thread(target=wait, daemon=True).start()
            entered.wait()
            sys.exit(3)
        """)
        assert outcome(process) == (3, ["op cleaned up"], "")

    def test_shows_only_the_users_own_error(self) -> None:
        process = child("""
            portal = Portal()
            portal.call(answer)
            raise ValueError("mine")
        """)
        code, out, err = outcome(process)
        assert (code, out) == (1, [])
        lines = err.splitlines()
        assert lines[0] == "Traceback (most recent call last):"
        assert lines[-1] == "ValueError: mine"
        assert sum(line.startswith("  File ") for line in lines) == 1

    def test_an_unclosed_client_is_closed_without_a_warning(self) -> None:
        process = child("""
            class Twin:
                async def close(self):
                    say("closed")

            class Client(_facade.FacadeRoot):
                def use(self):
                    return self._portal.call(answer)

            client = Client(Twin())
            say(client.use())
        """)
        assert outcome(process) == (0, ["42", "closed"], "")


class Robot:
    def __init__(self, name: str = "arm") -> None:
        self.name = name

    def __repr__(self) -> str:
        return f"Robot({self.name!r})"


class WalkingRobot(Robot):
    pass


class Plain:
    pass


class RobotTwin(Facade, twin=Robot):
    __slots__ = ()


class WalkingRobotTwin(RobotTwin, twin=WalkingRobot):
    __slots__ = ()


class PlainTwin(Facade, twin=Plain):
    __slots__ = ()


class Fleet:
    def __init__(self) -> None:
        self.robots = NameMap({"arm_1": Robot(), "dog": WalkingRobot()}, {"arm": ["arm_1"]}, "robot")


class FleetTwin(Facade, twin=Fleet):
    __slots__ = ()

    @property
    def robots(self) -> NameMap[RobotTwin]:
        return self._map("robots", RobotTwin, self._aio.robots)


class TestTwins:
    def test_are_the_same_while_held(self, portal: Portal) -> None:
        robot = Robot()
        twin = wrap(portal, RobotTwin, robot)
        assert wrap(portal, RobotTwin, robot) is twin
        assert wrap(portal, RobotTwin, Robot()) is not twin

    def test_of_none_is_none(self, portal: Portal) -> None:
        assert wrap(portal, FleetTwin, Fleet())._wrap(RobotTwin, None) is None

    def test_have_the_most_derived_class(self, portal: Portal) -> None:
        class Unlisted(WalkingRobot):
            pass

        assert type(wrap(portal, RobotTwin, WalkingRobot())) is WalkingRobotTwin
        assert type(wrap(portal, RobotTwin, Unlisted())) is WalkingRobotTwin

    def test_are_those_of_a_thread_that_was_quicker(self, portal: Portal, monkeypatch: pytest.MonkeyPatch) -> None:
        robot, lock = Robot(), portal._lock
        made: list[Facade] = []

        @contextlib.contextmanager
        def after_another() -> Iterator[None]:
            monkeypatch.setattr(portal, "_lock", lock)
            made.append(wrap(portal, RobotTwin, robot))
            yield

        monkeypatch.setattr(portal, "_lock", after_another())
        assert wrap(portal, RobotTwin, robot) is made[0]

    def test_are_made_once_under_races(self, portal: Portal) -> None:
        with ThreadPoolExecutor(8) as pool:
            for _ in range(50):
                robot = Robot()
                ready = threading.Barrier(8)

                def get(_: int, robot: Robot = robot, ready: threading.Barrier = ready) -> Facade:
                    ready.wait()
                    return wrap(portal, RobotTwin, robot)

                assert len(set(pool.map(get, range(8)))) == 1

    def test_keep_neither_themselves_nor_the_portal_alive(self) -> None:
        robot = Robot()
        portal = Portal()
        twin = wrap(portal, RobotTwin, robot)
        dead = [weakref.ref(twin), weakref.ref(portal)]
        del portal
        assert dead[1]() is not None, "a twin in use keeps its connection"
        del twin
        assert [ref() for ref in dead] == [None, None]

    def test_of_a_map_keep_identity_and_aliases(self, portal: Portal) -> None:
        fleet = Fleet()
        twin = wrap(portal, FleetTwin, fleet)
        assert twin.robots is twin.robots
        assert twin.robots["arm"] is twin.robots["arm_1"] is wrap(portal, RobotTwin, fleet.robots["arm"])
        assert type(twin.robots["dog"]) is WalkingRobotTwin
        with pytest.raises(KeyError, match=r"no robot 'dgo'\. Did you mean 'dog'"):
            twin.robots["dgo"]

    def test_of_a_map_follow_its_replacement(self, portal: Portal) -> None:
        fleet = Fleet()
        twin = wrap(portal, FleetTwin, fleet)
        arm = twin.robots["arm"]
        fleet.robots = NameMap({"arm": fleet.robots["arm"]}, {}, "robot")
        assert list(twin.robots) == ["arm"]
        assert twin.robots["arm"] is arm

    def test_of_a_map_do_not_keep_the_portal_alive(self) -> None:
        fleet = Fleet()
        portal = Portal()
        alive = weakref.ref(portal)
        twin = wrap(portal, FleetTwin, fleet)
        assert len(twin.robots) == 2
        del portal, twin
        assert alive() is None

    def test_refuse_attributes_that_do_not_exist(self, portal: Portal) -> None:
        twin = wrap(portal, RobotTwin, Robot())
        with pytest.raises(AttributeError):
            twin.contrl_mode = "raw"  # pyright: ignore[reportAttributeAccessIssue]

    def test_show_what_they_stand_for(self, portal: Portal) -> None:
        assert repr(wrap(portal, RobotTwin, Robot("arm"))) == "Robot('arm')"
        assert "PlainTwin" in repr(wrap(portal, PlainTwin, Plain()))

    @pytest.mark.parametrize("action", [pickle.dumps, copy.copy, copy.deepcopy])
    def test_cannot_be_pickled_or_copied(self, portal: Portal, action: Callable[[object], object]) -> None:
        with pytest.raises(TypeError, match="RobotTwin cannot be pickled"):
            action(wrap(portal, RobotTwin, Robot()))


class AioClient:
    def __init__(self, address: str = "tcp://localhost") -> None:
        if "://" not in address:
            raise ValueError(f"{address!r} is not an address")
        self.address = address
        self.closed = 0

    def __repr__(self) -> str:
        return f"Client({self.address!r})"

    async def ping(self) -> int:
        return 1

    async def close(self) -> None:
        self.closed += 1


class Client(FacadeRoot, twin=AioClient):
    __slots__ = ()

    def __init__(self, address: str = "tcp://localhost") -> None:
        super().__init__(AioClient(address))

    def run(self, make: Callable[[AioClient], Awaitable[object]]) -> object:
        async def call() -> object:
            return await make(self._aio)

        return self._portal.call(call)

    def close(self) -> None:
        self._portal.close(self._aio.close)


class TestRoot:
    def test_warns_of_an_unclosed_client_with_the_line_that_opened_it(self) -> None:
        client = Client("tcp://robot")
        line = Client.__init__.__code__.co_firstlineno + 1  # this class is the user's own
        client.run(AioClient.ping)
        twin = client._aio
        with pytest.warns(ResourceWarning) as caught:
            del client
        assert f"unclosed Client('tcp://robot'), opened at {__file__}:{line};" in str(caught[0].message)
        assert (caught[0].filename, caught[0].lineno) == (__file__, line)
        assert twin.closed == 1

    def test_is_silent_when_closed_or_never_used(self) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            client = Client()
            client.run(AioClient.ping)
            client.close()
            del client
            unused = Client()
            del unused
            gc.collect()

    def test_a_failing_constructor_leaves_nothing(self) -> None:
        with pytest.raises(ValueError, match="not an address"):
            Client("robot")
        gc.collect()

    def test_is_the_twin_of_its_own_async_client(self) -> None:
        client = Client()
        assert wrap(client._portal, Client, client._aio) is client
