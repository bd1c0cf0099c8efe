"""One step: its request in each step mode and the handling of its reply, all within the caller's turn."""

from __future__ import annotations

import warnings
from collections.abc import Mapping

from urlab_client.aio.arguments import mapping
from urlab_client.aio.model.articulation_state import Carried, give_back
from urlab_client.aio.session.session import Turn, leaves_open
from urlab_client.aio.state.sim_state import SimState
from urlab_client.aio.state.step_commands import direct_commands, live_commands, take_wrenches
from urlab_client.aio.state.step_mode import settle_mode
from urlab_client.aio.state.step_pictures import StepPictures
from urlab_client.enums import CameraTiming, StepMode
from urlab_client.errors import StepTimeout, URLabError
from urlab_client.protocol.codec import check_finite, op_of
from urlab_client.protocol.messages.session import Step, StepOk

Cameras = bool | Mapping[str, "str | CameraTiming"]


async def take_steps(state: SimState, turn: Turn, n_steps: int, cameras: Cameras, asked: str | None) -> StepOk:
    """Advance physics according to the step mode and apply the new state."""
    state.require_handshake("step")
    await settle_mode(state, turn)
    mode = state.mode
    if n_steps < (0 if mode is StepMode.PUPPET else 1):
        raise ValueError(_too_few(n_steps, mode))
    pictures = await _pictures(state, turn, cameras, n_steps) if state.observers or cameras is not False else None
    if mode is StepMode.LIVE and not state.mode_assumed:
        return await _live_step(state, turn, pictures)
    request, carried = _puppet_step(state, n_steps) if mode is StepMode.PUPPET else _direct_step(state, n_steps)
    if pictures is not None:
        pictures.ask(request)
    assumed, before, session = state.mode_assumed, state.step_count, state.session.session_id
    level = asked or state.level
    request.observations = None if level == state.sent_level else level
    state.sent_level = ""  # unknown until the reply arrives
    try:
        reply = await turn.call(request, takes=_seconds(pictures))
        if state.session.session_id == session:  # otherwise an abandoned handshake set the level
            state.sent_level = level if state.session.features.level_sticks else state.level
        if pictures is not None:
            await pictures.complete(turn, reply)
        state.absorb(reply, "step", into_mirror=mode is not StepMode.PUPPET)
    except BaseException as error:
        _note_failure(state, turn, error, 1 if mode is StepMode.PUPPET else n_steps, carried)
        raise
    if state.pending:
        state.pending.clear()
    if assumed:
        # If an abandoned handshake was answered meanwhile, the server's counter started anew.
        _learn_mode(state, request, reply, reply.step - (before if state.session.session_id == session else 0))
        if state.mode is StepMode.PUPPET and mode is not StepMode.PUPPET and not (pictures and pictures.interruption):
            return await take_steps(state, turn, n_steps, cameras, asked)  # the request has only set the clock
    if state.mode is StepMode.PUPPET:
        with state.mirror.lock:
            state.mirror.perturb(reply.perturbation)
    if pictures is not None:
        pictures.account(reply, came=state.mode is not StepMode.LIVE)
    return reply


async def send_step(state: SimState, turn: Turn, request: Step) -> StepOk:
    """Send a step as it is, within a turn, in which nobody else changes the mode."""
    check_finite(request)  # a hot op: its request is not checked again before it is sent
    await settle_mode(state, turn)
    if request.n_steps < 1 and state.mode is StepMode.DIRECT:
        raise ValueError(_too_few(request.n_steps, state.mode))  # the server would take one
    return await turn.call(request)


def _note_failure(state: SimState, turn: Turn, error: BaseException, steps: int, carried: Carried) -> None:
    if turn.sent and leaves_open(error):
        state.pending.add_steps(state, error, steps, carried)
    else:
        give_back(carried)
    if isinstance(error, StepTimeout):
        state.mode = StepMode.DIRECT  # only direct mode lets a step wait


async def _live_step(state: SimState, turn: Turn, pictures: StepPictures | None) -> StepOk:
    carried = take_wrenches(state)  # without effect on servers that ignore them in this mode
    try:
        request = Step(per_articulation=live_commands(state, carried) or None)
        if pictures is not None:
            pictures.ask(request)
        reply = await turn.call(request, takes=_seconds(pictures))
        if pictures is not None:
            await pictures.complete(turn, reply)
        state.absorb(reply, "step")
    except BaseException as error:
        if not (turn.sent and leaves_open(error)):
            give_back(carried)
        raise
    if pictures is not None:
        pictures.account(reply, came=True)
    return reply


def _direct_step(state: SimState, n_steps: int) -> tuple[Step, Carried]:
    carried = take_wrenches(state)
    try:
        commands = direct_commands(state, carried)
    except ValueError:
        give_back(carried)
        raise
    # While the mode is only assumed, the server may be in puppet mode, in which it sets its clock from the request.
    time = state.local_time if state.mode_assumed else None
    return Step(n_steps=n_steps, per_articulation=commands or None, time=time), carried


def _puppet_step(state: SimState, n_steps: int) -> tuple[Step, Carried]:
    mirror = state.mirror
    model, data = mirror.model, mirror.data
    if model is None or data is None:
        raise URLabError(
            "step: puppet mode integrates the local model, which this client does not have.",
            op="step",
            hint="Create the client with local_model=True and call discover() during play.",
        )
    if take_wrenches(state):
        warnings.warn("apply_xfrc() is inert in puppet mode: write client.data.xfrc_applied instead.", stacklevel=4)
    with mirror.lock:
        for record in state.objects.records.values():
            record.write_set_points()
        mirror.check_finite()
        if n_steps > 0:
            import mujoco

            mujoco.mj_step(model, data, n_steps)
        return Step(qpos=data.qpos.copy(), qvel=data.qvel.copy(), ctrl=data.ctrl.copy(), time=data.time), {}


def _learn_mode(state: SimState, request: Step, reply: StepOk, advanced: int) -> None:
    """Infer the step mode from a reply if possible: in each mode the server counts steps differently.

    In live mode it does not count. In puppet mode it counts each request once and its clock has the requested time.

    Raises:
        URLabError: The mode differs from the one that the client was created with, and the client must not switch.
    """
    expected = state.mode
    if advanced == 0:
        state.mode = StepMode.LIVE
        state.sent_level = ""  # the server ignores the level in this mode
    elif advanced == 1 and reply.time == request.time and state.mirror.model is not None:
        state.mode = StepMode.PUPPET
    elif advanced == request.n_steps:
        state.mode = StepMode.DIRECT
    if state.mode is not expected and state.wanted_mode is not StepMode.AUTO:
        raise URLabError(
            f"step: the server handled this step in step mode {state.mode}, not in {expected}.",
            op="step",
            hint=f"Call runtime.set_mode({str(expected)!r}), or leave auto_promote_step_mode on.",
        )


async def _pictures(state: SimState, turn: Turn, cameras: Cameras, n_steps: int) -> StepPictures | None:
    """Return the pictures to request with a step, or None. Waits until the observers can accept more data."""
    if state.mode is not StepMode.LIVE:
        for observer in state.observers:
            await observer.ready()
    asked: bool | dict[str, str | None]
    if isinstance(cameras, bool):
        asked = cameras
    else:
        given = mapping("step: include_cameras", cameras, "camera names to 'latest' or 'sync', or a bool")
        asked = {name: str(CameraTiming(how)) for name, how in given.items()}
    if state.observers:
        asked = state.objects.with_cameras(asked, state.observed_cameras(n_steps))
    pictures = StepPictures(state, asked)
    if not pictures or (
        state.mode is StepMode.LIVE and not state.mode_assumed and not state.session.features.live_pictures_in_steps
    ):
        return None
    await pictures.listen(turn)
    return pictures


def _too_few(n_steps: int, mode: StepMode) -> str:
    if mode is StepMode.PUPPET:
        return f"step: n_steps must be at least 0, got {n_steps}."
    return f"step: n_steps must be at least 1 in step mode {mode}, got {n_steps}. Only a puppet step may take 0."


def _seconds(pictures: StepPictures | None) -> float | None:
    """Return the seconds that a step with pictures may take; None for the default of a step."""
    return None if pictures is None or not pictures.seconds else (op_of(Step).timeout or 0.0) + pictures.seconds
