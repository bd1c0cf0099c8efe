"""Interrupts at random moments: nothing is left behind, nothing is lost, and the next call works."""

from __future__ import annotations

import sys

import pytest
from forked import program

PROGRAM = """
import asyncio, collections, contextlib, gc, logging, os, random, signal, sys, threading, time, warnings
from urlab_client import SessionTakenOver, URLabClient
from urlab_client.server import SimulatedServer
from urlab_client.sync import _loop

_loop.GRACE = 60  # what waits for it, does so for a reason that is told

class Struck(Exception):
    pass

def strike(*_):
    raise Struck

def interrupted(work, longest):
    "Do the work, and strike at a random moment; return whether that came in time."
    try:
        try:
            signal.setitimer(signal.ITIMER_REAL, random.uniform(1e-6, longest))
            work()
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
    except Struck:
        return True
    return False

def is_ours(problem):
    "Whether somebody but the collector was struck: what strikes in its callbacks and in `__del__` is printed and gone."
    return not isinstance(problem.exc_value, Struck)

def interrupted_often(work):
    "Do it again and again; the moments follow how long it takes, so that about half of them come in time."
    struck, longest = 0, 0.01
    for _ in range(MOMENTS):
        in_time = interrupted(work, longest)
        struck += in_time
        longest *= 1.2 if in_time else 1 / 1.2
    return struck > MOMENTS / 10

problems = []
sys.unraisablehook = lambda problem: is_ours(problem) and problems.append(repr(problem))
threading.excepthook = lambda problem: problems.append(repr(problem))
warnings.showwarning = lambda message, *_, **__: "unclosed" in str(message) or problems.append(str(message))
logging.getLogger("urlab_client.sync").addFilter(lambda record: problems.append(record.getMessage()))
warnings.simplefilter("always")
signal.signal(signal.SIGALRM, strike)

def make_use_and_close():
    # The hello of the client before, which was interrupted, may come after this one's.
    with URLabClient(**options) as client, contextlib.suppress(SessionTakenOver):
        client.discover()
        client.step()

def held():
    gc.collect()
    return len(os.listdir("/proc/self/fd")), threading.active_count()

def left(before):
    "What is held beyond that, once clients that the collector closes have had their time, and ZeroMQ to close sockets."
    deadline = time.monotonic() + 20
    while (now := held()) != before and time.monotonic() < deadline:
        threading.Event().wait(0.05)
    if now == before:
        return "nothing"
    loops = [one for one in gc.get_objects() if isinstance(one, _loop.CallerDrivenLoop) and not one._loop.is_closed()]
    return before, now, [(vars(one), one._owner(), asyncio.all_tasks(one._loop)) for one in loops]

with SimulatedServer("ball", play=True) as server:
    options = {**server.client_options(), "step_mode": "direct", "local_model": False}
    make_use_and_close()
    before = held()
    print("made and closed:", interrupted_often(make_use_and_close), "left:", left(before), flush=True)

    with URLabClient(**options) as client:
        client.discover()
        with client.state_stream() as states:
            def read():
                client.step()
                next(states)
            read()
            print("read:", interrupted_often(read), flush=True)
            client.resync()
            client.step()
            print("usable:", next(states) is not None, flush=True)
print("problems:", collections.Counter(problems))
"""

EXPECTED = """\
made and closed: True left: nothing
read: True
usable: True
problems: Counter()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="descriptors are counted in /proc")
@pytest.mark.parametrize("moments", [60, pytest.param(3000, marks=[pytest.mark.long, pytest.mark.timeout(600)])])
def test_at_random_moments(moments: int) -> None:
    running = program(f"MOMENTS = {moments}\n{PROGRAM}")
    out, err = running.communicate(timeout=600)
    assert (out, err) == (EXPECTED, "")


NOTED = """
import asyncio, gc, os, signal
from urlab_client.aio import URLabClient
from urlab_client.server import SimulatedServer

async def use():
    async with URLabClient(**options) as client:
        await client.discover()
        async with client.state_stream(), client.row_stream():
            pass

async def often():
    for _ in range(60):
        await use()

with SimulatedServer("ball", play=True) as server:
    options = {**server.client_options(), "step_mode": "live", "local_model": False}
    asyncio.run(use())
    signal.signal(signal.SIGALRM, lambda *_: None)
    before = len(os.listdir("/proc/self/fd"))
    signal.setitimer(signal.ITIMER_REAL, 5e-5, 5e-5)
    asyncio.run(often())
    signal.setitimer(signal.ITIMER_REAL, 0)
    gc.collect()
    print(len(os.listdir("/proc/self/fd")) - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="descriptors are counted in /proc")
def test_signals_that_a_program_only_notes_break_no_connection() -> None:
    running = program(NOTED)
    assert running.communicate(timeout=280) == ("0\n", "")
