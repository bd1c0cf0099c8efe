"""One step or reset: its request in each step mode and the handling of its reply, all within the caller's turn."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping

from urlab_client.aio.arguments import finite, mapping, text
from urlab_client.aio.articulation import compiled_prefixes
from urlab_client.aio.model.articulation_state import MirroredArticulation, SentWrenches, restore_wrenches
from urlab_client.aio.model.layout import compiled_ids
from urlab_client.aio.model.mirror import require_local
from urlab_client.aio.session.session import leaves_open
from urlab_client.aio.session.turn import Turn
from urlab_client.aio.state.sim_state import SimState
from urlab_client.aio.state.step_pictures import StepPictures
from urlab_client.enums import CameraTiming, StepMode
from urlab_client.errors import StepTimeout, UnknownKeyframe, URLabError
from urlab_client.protocol.codec import check_finite, op_of
from urlab_client.protocol.messages.session import ArticulationCommand, Reset, ResetOk, Step, StepOk
from urlab_client.values.names import UnknownName, unknown_name

Cameras = bool | Mapping[str, "str | CameraTiming"]


async def take_steps(state: SimState, turn: Turn, n_steps: int, cameras: Cameras, asked: str | None) -> StepOk:
    """Advance physics according to the step mode and apply the new state."""
    state.require_handshake("step")
    session, modes = state.session, state.mode
    if modes.unsettled is not None or modes.pause_unsettled:
        await modes.settle(turn)
    mode = modes.current
    puppet, assumed = mode is StepMode.PUPPET, modes.assumed
    if n_steps < (0 if puppet else 1):
        raise ValueError(_too_few(n_steps, mode))
    pictures = await _pictures(state, turn, cameras, n_steps) if state.observers or cameras is not False else None
    if mode is StepMode.LIVE and not assumed:
        return await _live_step(state, turn, pictures)
    request, wrenches = _puppet_step(state, n_steps) if puppet else _direct_step(state, n_steps)
    if pictures is not None:
        pictures.ask(request)
    before, began, sent_in = state.clocks.step_count, state.clocks.sim_time, session.session_id
    request.observations = asked or state.level_to_restore
    # On some servers, the level of a step holds for later ones, too.
    state.level_to_restore = request.observations and state.level
    try:
        reply = await turn.call(request, takes=None if pictures is None else _seconds(pictures))
        if asked is None and session.session_id == sent_in:  # otherwise an abandoned handshake set the level
            state.level_to_restore = None
        if pictures is not None:
            await pictures.complete(turn, reply)
        state.absorb(reply, "step", into_mirror=not puppet)
    except BaseException as error:
        _note_failure(state, turn, error, 1 if puppet else n_steps, wrenches)
        raise
    _settle(state, reply, None if puppet or assumed else began)
    if assumed:
        # If an abandoned handshake was answered meanwhile, the server's counter started anew.
        _learn_mode(state, request, reply, reply.step - (before if session.session_id == sent_in else 0))
        if modes.puppet and not puppet and not (pictures and pictures.interruption):
            return await take_steps(state, turn, n_steps, cameras, asked)  # the request has only set the clock
    if modes.current is StepMode.PUPPET:
        with state.mirror.lock:
            state.mirror.perturb(reply.perturbation)
    if pictures is not None:
        pictures.account(reply, came=not modes.live)
    return reply


async def send_step(state: SimState, turn: Turn, request: Step) -> StepOk:
    """Send a step as it is, within a turn, in which nobody else changes the mode."""
    check_finite(request)  # a hot op: its request is not checked again before it is sent
    if state.mode.unsettled is not None or state.mode.pause_unsettled:
        await state.mode.settle(turn)
    if request.n_steps < 1 and state.mode.current is StepMode.DIRECT:
        raise ValueError(_too_few(request.n_steps, state.mode.current))  # the server would take one
    return await turn.call(request)


def _settle(state: SimState, reply: StepOk, began: float | None) -> None:
    """Note that nothing is pending, and whether a step that began at this time, seconds, has set the time back."""
    if state.pending:
        state.pending.clear()
    elif began is not None and reply.time < began and reply.replay is None:
        state.clocks.note_set_back(began)


def _note_failure(state: SimState, turn: Turn, error: BaseException, steps: int, wrenches: SentWrenches) -> None:
    if turn.sent and leaves_open(error):
        state.pending.add_steps(state.clocks, state.session.transport.stats.connects, error, steps, wrenches)
    else:
        restore_wrenches(wrenches)
    if isinstance(error, StepTimeout):
        state.mode.note(StepMode.DIRECT)  # only direct mode lets a step wait


async def _live_step(state: SimState, turn: Turn, pictures: StepPictures | None) -> StepOk:
    ours = _ours(state)
    wrenches = _take_wrenches(state, ours)  # without effect on servers that ignore them in this mode
    try:
        if state.session.features.live_pictures_in_steps:
            commands = _direct_commands(state, ours, wrenches)
        else:
            commands = {record.name: record.live_command() for record in ours}
        request = Step(per_articulation=commands or None)
        if pictures is not None:
            pictures.ask(request)
        reply = await turn.call(request, takes=None if pictures is None else _seconds(pictures))
        if pictures is not None:
            await pictures.complete(turn, reply)
        state.absorb(reply, "step")
    except BaseException as error:
        if not (turn.sent and leaves_open(error)):
            restore_wrenches(wrenches)
        raise
    if pictures is not None:
        pictures.account(reply, came=True)
    return reply


def _direct_step(state: SimState, n_steps: int) -> tuple[Step, SentWrenches]:
    ours = _ours(state)
    wrenches = _take_wrenches(state, ours)
    try:
        commands = _direct_commands(state, ours, wrenches)
    except ValueError:
        restore_wrenches(wrenches)
        raise
    # While the mode is only assumed, the server may be in puppet mode, in which it sets its clock from the request.
    time = state.local_time if state.mode.assumed else None
    return Step(n_steps=n_steps, per_articulation=commands or None, time=time), wrenches


def _puppet_step(state: SimState, n_steps: int) -> tuple[Step, SentWrenches]:
    mirror = state.mirror
    model = require_local(mirror.model, "step: puppet mode", op="step")
    data = require_local(mirror.data, "step: puppet mode", op="step")
    if _take_wrenches(state, _ours(state)):
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
    expected = state.mode.current
    if advanced == 0:
        state.mode.note(StepMode.LIVE)
        state.level_to_restore = state.level  # the server ignores the level in this mode
    elif advanced == 1 and reply.time == request.time and state.mirror.model is not None:
        state.mode.note(StepMode.PUPPET)
    elif advanced == request.n_steps:
        state.mode.note(StepMode.DIRECT)
    if state.mode.current is not expected and state.mode.wanted is not StepMode.AUTO:
        raise URLabError(
            f"step: the server handled this step in step mode {state.mode.current}, not in {expected}.",
            op="step",
            hint=f"Call runtime.set_mode({str(expected)!r}), or leave auto_promote_step_mode on.",
        )


async def _pictures(state: SimState, turn: Turn, cameras: Cameras, n_steps: int) -> StepPictures | None:
    """Return the pictures to request with a step, or None. Waits until the observers can accept more data."""
    if not state.mode.live:
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
        state.mode.live and not state.mode.assumed and not state.session.features.live_pictures_in_steps
    ):
        return None
    await pictures.listen(turn)
    return pictures


def _too_few(n_steps: int, mode: StepMode) -> str:
    if mode is StepMode.PUPPET:
        return f"step: n_steps must be at least 0, got {n_steps}."
    return f"step: n_steps must be at least 1 in step mode {mode}, got {n_steps}. Only a puppet step may take 0."


def _seconds(pictures: StepPictures) -> float | None:
    """Return the seconds that a step with pictures may take; None for the default of a step."""
    return (op_of(Step).timeout or 0.0) + pictures.seconds if pictures.seconds else None


def _direct_commands(
    state: SimState, ours: Collection[MirroredArticulation], wrenches: SentWrenches
) -> dict[str, ArticulationCommand]:
    """Return the commands of a step, including its wrenches."""
    if not wrenches:  # true for nearly every step
        return {record.name: record.direct_command(None) for record in ours}
    commands = {record.name: record.direct_command(wrenches.get(record)) for record in ours}
    for name, record in state.objects.entity_records.items():
        if record not in wrenches:
            continue
        if not state.session.features.claims:
            # Use the entity's own name: the server tries `<key>_<body>` first and then the bare name of the body.
            commands[name] = record.wrench_command(wrenches[record])
        else:
            # An entity has no owner, so the command of a robot carries its wrenches.
            key = next(iter(commands or state.objects.records))
            carrier = commands.setdefault(key, ArticulationCommand())
            carrier.xfrc_applied = {**(carrier.xfrc_applied or {}), **wrenches[record]}
    return commands


def _ours(state: SimState) -> Collection[MirroredArticulation]:
    # A server whose robots have owners rejects a step that writes to another client's robots, so send only our own.
    records = state.objects.records.values()
    return [record for record in records if record.driven] if state.session.features.claims else records


def _take_wrenches(state: SimState, ours: Collection[MirroredArticulation]) -> SentWrenches:
    """Return the wrenches for the step being built and clear their buffers."""
    wrenches: SentWrenches = {}
    for record in ours:
        if record.wrenches:
            wrenches[record] = record.take_wrenches()
    for entity in state.objects.entity_records.values():
        if entity.wrenches and (state.objects.records or not state.session.features.claims):
            wrenches[entity] = entity.take_wrenches()
    return wrenches


async def take_reset(
    state: SimState, turn: Turn, keyframe: str | None, seed: int | None, qpos: Mapping[str, Mapping[str, float]]
) -> ResetOk:
    """Reset the simulation and apply the new state."""
    state.require_handshake("reset")
    articulations = state.objects.articulations
    given = mapping("reset: per_articulation_qpos", qpos, "articulation keys to joint positions")
    overrides = {articulations[key].prefix: _joint_values(state, key, values) for key, values in given.items()}
    request = Reset(
        keyframe_name=None if keyframe is None else _compiled_keyframe(state, keyframe),
        seed=seed,
        per_articulation_qpos=overrides or None,
    )
    try:
        reply = await turn.call(request)
        state.reset_seed = seed
        state.absorb_reset(reply, request.keyframe_name)
    except BaseException as error:
        if turn.sent and leaves_open(error):
            state.pending.add_reset(state.clocks, state.session.transport.stats.connects, request.keyframe_name, seed)
        raise
    state.pending.clear()
    return reply


def _joint_values(state: SimState, key: str, values: Mapping[str, float]) -> dict[str, float]:
    joints = state.objects.articulations[key].joints
    given = mapping(f"reset: per_articulation_qpos of {key!r}", values, "joint names to numbers")
    live = {(joints[name].name if joints else name): value for name, value in given.items()}
    return {name: finite(f"reset: joint {name!r} of {key!r}", value) for name, value in live.items()}


def _compiled_keyframe(state: SimState, name: str) -> str:
    """Return the compiled name, which is the only one that the server knows."""
    text("reset: keyframe_name", name)
    model = state.mirror.model
    if model is None:
        return name
    names = compiled_ids(model, "key", compiled_prefixes(state.objects.articulations))
    try:
        return names.key(name)
    except UnknownName as error:
        reason = error if error.matches else unknown_name("keyframe", name, names.shortest())
        raise UnknownKeyframe("unknown_keyframe", f"{reason} Nothing was sent.", op="reset") from None
