"""One reset: its request and the handling of its reply, all within the caller's turn."""

from __future__ import annotations

from collections.abc import Mapping

from urlab_client.aio.arguments import mapping, text
from urlab_client.aio.model.mirror import model_names
from urlab_client.aio.model.numbers import finite
from urlab_client.aio.session.session import Turn, leaves_open
from urlab_client.aio.state.sim_state import SimState
from urlab_client.errors import UnknownKeyframe
from urlab_client.protocol.messages.session import Reset, ResetOk
from urlab_client.values.names import compiled_names


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
            state.pending.add_reset(state, request.keyframe_name, seed)
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
    compiled = [key for key in model_names(model, "key") if key]
    if name in compiled:
        return name
    prefixes = {key: art.compiled_prefix for key, art in state.objects.articulations.items()}
    wanted = compiled_names(name, prefixes)
    matches = [key for key in compiled if key in wanted]
    if len(matches) == 1:
        return matches[0]
    problem = (
        f"{name!r} could mean {', '.join(matches)}"
        if matches
        else f"no keyframe is called {name!r}; the keyframes are: {', '.join(compiled) or 'none'}"
    )
    raise UnknownKeyframe("unknown_keyframe", f"{problem}. Nothing was sent.", op="reset")
