"""Handlers of the `sim` ops: the life cycle of a play session."""

from __future__ import annotations

from urlab_client.enums import PIEState
from urlab_client.protocol.messages.sim import BeginPie, BeginPieOk, PieStatus, PieStatusOk, StopPie, StopPieOk
from urlab_client.server.core import ServerCore
from urlab_client.server.handlers.session import handshake
from urlab_client.server.rpc.dispatch import handles


@handles(BeginPie)
def begin_pie(server: ServerCore, request: BeginPie) -> BeginPieOk:
    play = server.play
    if request.level_path:
        _open_level(server, request.level_path)
    if play.state not in (PIEState.READY, PIEState.COMPILING):
        if not server.world.has_manager:
            return BeginPieOk(
                state=PIEState.TIMEOUT,
                compile_error=f"level {server.world.levels.package} has no manager actor: call ensure_manager first",
            )
        server.begin_play()
    state = play.wait(request.timeout_s)
    reply = BeginPieOk(state=state, compile_error=play.compile_error)
    if state is PIEState.READY:
        reply.handshake_payload = payload = handshake(server, request.session_id)
        payload.urlab_version = server.dialect.urlab_version_at_start
    return reply


def _open_level(server: ServerCore, path: str) -> None:
    """Open a level and end the current play session; if the level cannot be opened, nothing changes."""
    world = server.world
    was_running, world.pie_running = world.pie_running, False
    try:
        world.levels.load(path)
    except BaseException:
        world.pie_running = was_running
        raise
    server.stop_play()


@handles(StopPie)
def stop_pie(server: ServerCore, request: StopPie) -> StopPieOk:
    del request
    server.stop_play()
    return StopPieOk()


@handles(PieStatus)
def pie_status(server: ServerCore, request: PieStatus) -> PieStatusOk:
    del request
    play = server.play
    running = play.current
    return PieStatusOk(
        state=play.state, compile_error=play.compile_error, sim_time=None if running is None else running.engine.time
    )
