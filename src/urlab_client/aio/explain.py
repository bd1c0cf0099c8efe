"""`client.explain()`: why is my robot not moving?

The checks go from the outside in, from sockets to set-points, and report findings as sentences. They change nothing on
the server. Values that the wire cannot report without a change (step mode, control source) are those that this client
knows.
"""

from __future__ import annotations

import asyncio
import itertools
import os
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from typing import TypeVar

import numpy as np

from urlab_client.aio.background import running_loop
from urlab_client.aio.client_types import ClientConfig, Diagnosis, Finding, Verdict
from urlab_client.aio.launch import LaunchedTransport
from urlab_client.aio.session.session import Session
from urlab_client.aio.state.sim_state import SimState
from urlab_client.enums import ControlMode, PIEState, StepMode
from urlab_client.errors import RPC_ERRORS, SessionTakenOver, URLabError
from urlab_client.protocol.messages.session import Meta
from urlab_client.protocol.messages.sim import PieStatus, PieStatusOk
from urlab_client.values.types import PIEStatus

_CONNECT_S = 2.0
_POLLS = 5
_POLL_S = 0.05
_LISTED = 8
_CHANGED = "the mode was changed. Call runtime.set_mode() or discover()."


S = TypeVar("S", PieStatusOk, PIEStatus)


async def watched(look: Callable[[], Awaitable[S]], first: S) -> S:
    """Poll the state of play until simulation time has advanced or seems to stand still; return the last state.

    The limit counts polls, not seconds, because a server that waits for its processor also answers late.
    """
    last = first
    for _ in range(_POLLS):
        await asyncio.sleep(_POLL_S)
        last = await look()
        if last.sim_time != first.sim_time:
            break
    return last


async def diagnose(config: ClientConfig, session: Session, state: SimState, state_port: int) -> Diagnosis:
    """Examine a client's server, play session and articulations."""
    return Diagnosis([finding async for finding in _examine(config, session, state, state_port)])


async def _examine(config: ClientConfig, session: Session, state: SimState, state_port: int) -> AsyncIterator[Finding]:
    loop = running_loop()
    async for finding in _reachability(config, session, state_port):
        yield finding
        if finding.verdict is Verdict.PROBLEM:
            return  # whoever accepts no connection answers nothing
    before = loop.time()
    try:
        ops = (await session.call(Meta())).ops
    except URLabError as error:
        yield Finding(Verdict.PROBLEM, "server", f"It does not answer: {error}")
        return
    yield Finding(
        Verdict.OK, "server", f"It answers in {1e3 * (loop.time() - before):.1f} ms and offers {len(ops)} ops."
    )
    if config.read_only:
        text = "This client is read-only. Call explain() of the client that drives to find out why robots do not move."
        yield Finding(Verdict.NOTE, "session", text)
        return
    hello = state.hello
    if hello is None or not session.session_id:
        yield Finding(Verdict.PROBLEM, "session", "No session is open. Call discover() first.")
        return
    yield _versions(session, state)
    finding, playing = await _play(session, state)
    yield finding
    if not playing:
        return
    robots = _articulations(state), _control(config, session, state), _cameras(session, state)
    for finding in itertools.chain(_physics(session, state), _modes(config, state), *robots):
        yield finding


def _cameras(session: Session, state: SimState) -> Iterator[Finding]:
    """Check which cameras stream, on a server where they are off by default."""
    switch = state.publishers.camera_switch
    if not session.features.camera_switch:
        return
    silent = [
        f"{art.prefix}/{name}"
        for art in state.objects.articulations.values()
        for name, view in art.cameras.items()
        if not switch.is_on(view.info)
    ]
    if silent:
        more = f" and {len(silent) - _LISTED} more" if len(silent) > _LISTED else ""
        text = f"This client has not switched on {', '.join(silent[:_LISTED])}{more}, so they may not stream. "
        yield Finding(
            Verdict.NOTE, "cameras", text + "Iterating over frames() switches a camera on; capture() works either way."
        )


def _control(config: ClientConfig, session: Session, state: SimState) -> Iterator[Finding]:
    """Check which client may write to the robots, on a server where each robot has one owner."""
    if not session.features.claims:
        return
    for key, record in state.objects.records.items():
        owner = session.control.owner_of(key)
        if owner == session.control.owner:
            yield Finding(Verdict.OK, key, "This client controls it.")
        elif owner is not None:
            text = f"{owner!r} controls it, so writes to it are refused. articulation.claim(force=True) takes it over."
            yield Finding(Verdict.PROBLEM, key, text)
        elif record.driven and not config.claim_control:
            text = "No client controls it, as far as this client knows, so writes to it are refused. "
            yield Finding(Verdict.PROBLEM, key, text + "Call articulation.claim(), or leave claim_control on.")
        else:
            yield Finding(Verdict.NOTE, key, "This client does not control it yet. The first write claims it.")


async def _reachability(config: ClientConfig, session: Session, state_port: int) -> AsyncIterator[Finding]:
    scheme, _, rest = session.transport.endpoint.partition("://")
    host = rest.rpartition(":")[0]
    if scheme != "tcp":
        return
    ports = {"RPC": int(rest.rpartition(":")[2])}
    if config.step_mode in (StepMode.LIVE, StepMode.AUTO) and config.address.startswith("tcp://"):
        ports |= {"state stream": state_port}
    for what, port in ports.items():
        problem = await connection_problem(host, port)
        if problem is None:
            yield Finding(Verdict.OK, what, f"{host}:{port} accepts connections.")
        else:
            need = Verdict.PROBLEM if what == "RPC" else Verdict.NOTE
            start = " Start play in the editor, or run `urlab serve`." if what == "RPC" else ""
            yield Finding(need, what, f"{host}:{port}: {problem}{start}")


async def connection_problem(host: str, port: int, within: float = _CONNECT_S) -> str | None:
    """Return why a port accepts no connection, or None if it does."""
    try:
        async with asyncio.timeout(within):
            _, writer = await asyncio.open_connection(host, port)
    except TimeoutError:
        return f"no answer within {within:g} s; is a firewall in between?"
    except OSError as error:
        return f"{_reason(error)}; is the server running, and on this port?"
    writer.close()
    return None


def _reason(error: OSError) -> str:
    if isinstance(error, ConnectionRefusedError):
        return "Connection refused"
    # Errors of the Proactor loop have Windows error numbers; `errno` is then EINVAL, and only the text is right.
    if getattr(error, "winerror", None) is not None:
        return error.strerror or str(error)
    return os.strerror(error.errno) if error.errno else str(error)


def _versions(session: Session, state: SimState) -> Finding:
    hello, mirror = state.hello, state.mirror
    assert hello is not None  # noqa: S101  # checked by the caller
    generation = session.features.generation
    which = f"{hello.urlab_version}, generation {generation}," if generation else hello.urlab_version
    server = f"{which} with MuJoCo {hello.mujoco_version}"
    if mirror.approximate:
        text = f"The server runs {server}; the local model was compiled here and only approximates the server's."
        return Finding(Verdict.NOTE, "versions", text)
    if mirror.model is None:
        return Finding(Verdict.NOTE, "versions", f"The server runs {server}; there is no local model.")
    return Finding(Verdict.OK, "versions", f"The server runs {server}; the local model is of the same build.")


async def _play(session: Session, state: SimState) -> tuple[Finding, bool]:
    steps = state.clocks.step_count
    try:
        first = await session.call(PieStatus())
        second = await watched(lambda: session.call(PieStatus()), first)
    except URLabError as error:  # including no answer: the editor's main thread may be stuck
        if isinstance(error, RPC_ERRORS["unknown_op"]):
            return Finding(Verdict.NOTE, "play", "A packaged build: it does not report its play state."), True
        subject = "session" if isinstance(error, SessionTakenOver) else "play"
        return Finding(Verdict.PROBLEM, subject, str(error)), False
    if second.state != PIEState.READY:
        advice = {
            PIEState.OFF: "Call sim.start().",
            PIEState.COMPILING: "Wait, or check that the level has a manager: scene.ensure_manager().",
            PIEState.COMPILE_FAILED: f"MuJoCo says: {second.compile_error}",
        }.get(second.state, "")
        return Finding(Verdict.PROBLEM, "play", f"Play is {second.state}. {advice}".strip()), False
    runs = second.sim_time != first.sim_time
    if state.mode.live and not runs:
        text = f"Physics stands still at {second.sim_time or 0:g} s: it is paused. "
        text += "Call runtime.set_paused(False), or start `urlab serve` with --unpaused."
        return Finding(Verdict.PROBLEM, "play", text), True
    if not state.mode.live and runs and state.clocks.step_count == steps:  # otherwise this client steps meanwhile
        text = f"Time passes without steps although this client expects mode {state.mode.current}: "
        return Finding(Verdict.PROBLEM, "play", text + _CHANGED), True
    how = "running" if runs else "waiting for step()"
    return Finding(Verdict.OK, "play", f"Play is ready, physics {how} at {second.sim_time or 0:g} s."), True


def _physics(session: Session, state: SimState) -> Iterator[Finding]:
    if state.clocks.set_back:
        text = f"Its time went back {state.clocks.set_back} times while this client stepped it. "
        text += "Unless another client did that, it has diverged: try a shorter timestep, or weaker gains."
        yield Finding(Verdict.PROBLEM, "physics", text)
    if state.mirror.model is not None:
        import mujoco

        options = state.mirror.model.opt
        integrator = mujoco.mjtIntegrator(options.integrator).name.removeprefix("mjINT_").lower()
        gravity = ", ".join(f"{value:g}" for value in options.gravity)
        text = f"A step takes {options.timestep:g} s; integrator {integrator}, gravity ({gravity}) m/s²."
        yield Finding(Verdict.OK, "physics", text)
    if isinstance(session.transport, LaunchedTransport):
        for warning in session.transport.scene_warnings:
            yield Finding(Verdict.NOTE, "physics", f"{warning[:1].upper()}{warning[1:]}.")


def _modes(config: ClientConfig, state: SimState) -> Iterator[Finding]:
    wanted = config.step_mode
    if wanted is StepMode.AUTO:
        known = "assumed until a step shows otherwise" if state.mode.assumed else "as the server reports"
        yield Finding(Verdict.OK, "step mode", f"{state.mode.current}, {known}.")
    elif state.mode.current is wanted:
        yield Finding(Verdict.OK, "step mode", f"{state.mode.current}, as requested.")
    else:
        text = f"{state.mode.current} instead of {wanted}. "
        text += "The project may be locked to it, or runtime.set_mode() changed it."
        yield Finding(Verdict.NOTE, "step mode", text)
    if state.clocks.step_count == 0 and not state.mode.live:
        yield Finding(Verdict.NOTE, "steps", "step() has not been called since discover(). Nothing moves without it.")


def _articulations(state: SimState) -> Iterator[Finding]:
    if not state.objects.records:
        yield Finding(Verdict.PROBLEM, "articulations", "The play session has none. Spawn a robot before sim.start().")
    for key, record in state.objects.records.items():
        if not len(record.ctrl):
            yield Finding(Verdict.NOTE, key, "It has no actuators, so only contacts and gravity move it.")
            continue
        controlled = record.controller is not None and record.control_mode is ControlMode.UE_CONTROLLER
        if controlled and record.controller is not None:
            limits = record.controller.params.get("torque_limit", {})
            dead = [name for name, limit in limits.items() if limit == 0]
            if dead:
                text = f"A torque limit of 0 means no torque at all: {', '.join(dead)}. Raise it with set_gains()."
                yield Finding(Verdict.PROBLEM, key, text)
        if not np.isfinite(record.qpos).all():
            text = "Its positions are not finite: the simulation has diverged. Call reset(); try a shorter timestep."
            yield Finding(Verdict.PROBLEM, key, text)
        if strange := record.not_finite():
            text = f"Set-points are not finite, so step() refuses them: {', '.join(strange)}."
            yield Finding(Verdict.PROBLEM, key, text)
            continue
        if outside := record.out_of_range():
            what = "targets beyond the limits of their joints" if controlled else "MuJoCo clamps them"
            yield Finding(Verdict.NOTE, key, f"Set-points out of range: {', '.join(outside)}; {what}.")
        if not np.any(record.ctrl):
            text = "All set-points are 0. Set them with set_ctrl() or ctrl_array before step()."
            yield Finding(Verdict.NOTE, key, text)
        elif not (controlled or state.clocks.set_back) and state.clocks.step_count and not np.any(record.applied):
            text = "Set-points are sent but not applied. Is the control source `ui`? "
            yield Finding(Verdict.PROBLEM, key, text + "Call runtime.set_control_source('zmq').")
        else:
            how = f"through its {record.controller.kind} controller" if controlled and record.controller else "directly"
            largest = float(np.max(np.abs(record.applied), initial=0.0))
            yield Finding(Verdict.OK, key, f"Set-points act {how}; the largest control applied last is {largest:.3g}.")
