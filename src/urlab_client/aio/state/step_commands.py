"""Commands of a step to the articulations and entities: set-points and wrenches."""

from __future__ import annotations

from collections.abc import Iterable

from urlab_client.aio.model.articulation_state import Carried, MirroredArticulation
from urlab_client.aio.state.sim_state import SimState
from urlab_client.protocol.messages.session import ArticulationCommand


def direct_commands(state: SimState, carried: Carried) -> dict[str, ArticulationCommand]:
    """Return the commands of a step, including its wrenches."""
    ours = _ours(state)
    if not carried:  # true for nearly every step
        return {record.name: record.direct_command(None) for record in ours}
    commands = {record.name: record.direct_command(carried.get(record)) for record in ours}
    for name, record in state.objects.entity_records.items():
        if record not in carried:
            continue
        if not state.session.features.claims:
            # Use the entity's own name: the server tries `<key>_<body>` first and then the bare name of the body.
            commands[name] = record.wrench_command(carried[record])
        else:
            # An entity has no owner, so the command of a robot carries its wrenches.
            key = next(iter(commands or state.objects.records))
            carrier = commands.setdefault(key, ArticulationCommand())
            carrier.xfrc_applied = {**(carrier.xfrc_applied or {}), **carried[record]}
    return commands


def live_commands(state: SimState, carried: Carried) -> dict[str, ArticulationCommand]:
    """Return the commands of a step in live mode."""
    if state.session.features.live_pictures_in_steps:
        return direct_commands(state, carried)
    return {record.name: record.live_command() for record in _ours(state)}


def _ours(state: SimState) -> Iterable[MirroredArticulation]:
    # A server whose robots have owners rejects a step that writes to another client's robots, so send only our own.
    records = state.objects.records.values()
    return [record for record in records if record.driven] if state.session.features.claims else records


def take_wrenches(state: SimState) -> Carried:
    """Return the wrenches for the step being built and clear their buffers."""
    carried: Carried = {}
    for record in _ours(state):
        if record.wrenches:
            carried[record] = record.take_wrenches()
    for entity in state.objects.entity_records.values():
        if entity.wrenches and (state.objects.records or not state.session.features.claims):
            carried[entity] = entity.take_wrenches()
    return carried
