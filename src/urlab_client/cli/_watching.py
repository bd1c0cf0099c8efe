"""Running a play session while a command watches, live or stepped by the command: for `record` and `view`."""

from __future__ import annotations

import asyncio
import contextlib
import math
import signal
import sys
from argparse import Namespace
from collections.abc import AsyncGenerator, Callable, Generator
from typing import TYPE_CHECKING, Any

from urlab_client.cli._arguments import cameras, make_client
from urlab_client.cli._common import CommandError, in_background, refusing
from urlab_client.enums import StepMode
from urlab_client.errors import OutcomeUnknown, UnknownOp, URLabError, URLabTimeoutError

if TYPE_CHECKING:
    from urlab_client.aio import Stream, URLabClient
    from urlab_client.events import ClientEvent
    from urlab_client.integrations.gym import Task, URLabEnv
    from urlab_client.integrations.record import AsyncRecorder

_LOOK_S = 0.05
_AT_ONCE_S = 0.5
_AWAY_S = 5.0
"""How long a server may be unreachable."""
_FIRST_STATE_S = 10.0


@contextlib.contextmanager
def interruptible() -> Generator[asyncio.Event]:
    """Yield an event that Ctrl-C or SIGTERM sets while the block runs, instead of interrupting it."""
    loop, stop = asyncio.get_running_loop(), asyncio.Event()
    # Event loops on Windows have no add_signal_handler.
    numbers = [signal.SIGTERM] if in_background() else [signal.SIGTERM, signal.SIGINT]
    before = [signal.signal(number, lambda _, __: loop.call_soon_threadsafe(stop.set)) for number in numbers]
    try:
        yield stop
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


@contextlib.contextmanager
def announced_wait(client: URLabClient) -> Generator[None]:
    """Say on standard error that the block waits for the server, unless that answers at once or starts with it."""

    def announce() -> None:
        if not client.connected and not client.address.startswith("sim://"):
            print(f"waiting for the server at {client.address} …", file=sys.stderr, flush=True)

    timer = asyncio.get_running_loop().call_later(_AT_ONCE_S, announce)
    try:
        yield
    finally:
        timer.cancel()


async def run_session(
    client: URLabClient,
    seconds: float | None,
    *,
    over: Callable[[], bool],
    progress: Callable[[float], None] = lambda _: None,
) -> None:
    """Let simulation time pass: unpause in live mode for as long as it takes, else step.

    Args:
        client: The client.
        seconds: Simulated seconds; None for no limit.
        over: Callback that returns whether to end early.
        progress: Callback invoked with the number of simulated seconds that have passed.

    Raises:
        CommandError: No state arrives, play has ended, or the server is gone or has restarted.
        URLabError: The server refused a request, or does not answer.
    """
    direct = client.step_mode is StepMode.DIRECT
    start = last = math.inf
    done = 0.0
    lost_at: float | None = None
    async with client.events() as events, contextlib.nullcontext() if direct else _running(client):
        state_due = asyncio.get_running_loop().time() + _FIRST_STATE_S
        while not over():
            if direct or client.recv_wall_time_ns:  # otherwise no state has come yet
                now = client.sim_time
                if now < last:  # the first state; or a reset puts the clock back, and what passed before counts too
                    start = now - done
                last, done = now, now - start
            progress(done)
            if seconds is not None and done >= seconds - 1e-9:
                return
            if direct:
                await _step(client)
            else:
                await asyncio.sleep(_LOOK_S)
                lost_at = _lost_at(events, lost_at)
                if not client.recv_wall_time_ns and asyncio.get_running_loop().time() > state_due:
                    raise CommandError(
                        f"no state arrived within {_FIRST_STATE_S:g} s; if the server's state stream has a port of its "
                        "own, pass --state-port (`urlab serve` prints it)"
                    )


@contextlib.asynccontextmanager
async def _running(client: URLabClient) -> AsyncGenerator[None]:
    """Let physics run; pause it at the end if it was paused, unless the server is this command's own."""
    from urlab_client.aio.explain import watched

    paused = False
    if not client.address.startswith("sim://"):
        with contextlib.suppress(UnknownOp):  # a packaged build does not tell
            first = await client.sim.status()
            after = await watched(client.sim.status, first)
            paused = after.sim_time is not None and after.sim_time == first.sim_time
    if paused:
        print("physics was paused: it runs until this command ends", file=sys.stderr, flush=True)
    await client.runtime.set_paused(False)
    try:
        yield
    finally:
        if paused:
            with contextlib.suppress(URLabError):  # the server may be gone
                await client.runtime.set_paused(True)


def recording_options(arguments: Namespace) -> dict[str, Any]:
    """Return the options of a recording that the arguments give."""
    names = {"camera_hz", "contacts", "overwrite"} & vars(arguments).keys()
    return {"cameras": cameras(arguments.camera), **{name: getattr(arguments, name) for name in names}}


@contextlib.asynccontextmanager
async def recorded(client: URLabClient, arguments: Namespace) -> AsyncGenerator[AsyncRecorder | None]:
    """Record while the block runs, if `--record` was given."""
    if arguments.record is None:
        yield None
        return
    from urlab_client.integrations.record import record

    recorder = record(client, arguments.record, **recording_options(arguments))
    async with contextlib.AsyncExitStack() as stack:
        with refusing(KeyError, option="--camera"):
            await stack.enter_async_context(recorder)
        yield recorder


@contextlib.contextmanager
def task_environment(arguments: Namespace, kind: type[Task], **options: Any) -> Generator[URLabEnv]:
    """Yield an environment of a task, over the server that the arguments name or else a simulated one."""
    from urlab_client.aio.launch import with_model_options
    from urlab_client.integrations.gym import URLabEnv
    from urlab_client.sync.client import URLabClient as BlockingClient

    address = arguments.address or with_model_options(kind.scene_address)
    with make_client(BlockingClient, address, arguments, step_mode="direct") as client:
        client.discover()
        with contextlib.closing(URLabEnv(client, task=kind(), **options)) as env:
            yield env


async def _step(client: URLabClient) -> None:
    try:
        await client.step()
    except (OutcomeUnknown, URLabTimeoutError):  # the connection broke, or the machine was suspended
        found = await client.resync()
        if not (found.session_held and found.playing):
            raise CommandError("the server restarted, or another client took the session over") from None


def _lost_at(events: Stream[ClientEvent], lost_at: float | None) -> float | None:
    """Return when the server was lost, unless it has come back.

    Raises:
        CommandError: No further state will arrive: a client that only watches would wait forever.
    """
    from urlab_client.events import PlayEnded, ServerLost, ServerReconnected, SessionLost

    now = asyncio.get_running_loop().time()
    while (event := events.receive_nowait()) is not None:
        match event:
            case ServerLost():
                lost_at = now
            case ServerReconnected():
                lost_at = None
            case PlayEnded():
                raise CommandError(f"play has ended: {event.reason}")
            case SessionLost():
                raise CommandError(f"the session is lost: {event.reason}")
            case _:
                pass
    if lost_at is not None and now - lost_at > _AWAY_S:
        raise CommandError(f"the server has been unreachable for {_AWAY_S:g} s")
    return lost_at
