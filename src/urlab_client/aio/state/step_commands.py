"""What a step tells the articulations and entities: set-points, and the wrenches that it carries."""

from __future__ import annotations

from collections.abc import Iterable

from urlab_client.aio.model.articulation_state import Carried, MirroredArticulation
from urlab_client.aio.state.sim_state import SimState
from urlab_client.protocol.messages.session import ArticulationCommand

__all__ = ["direct_commands", "live_commands", "take_wrenches"]


def direct_commands(state: SimState, carried: Carried) -> dict[str, ArticulationCommand]:
    """Return what a step tells the articulations and entities, with the wrenches that it carries."""
    ours = _ours(state)
    if not carried:  # as nearly every step
        return {record.name: record.direct_command(None) for record in ours}
    commands = {record.name: record.direct_command(carried.get(record)) for record in ours}
    for name, record in state.objects.entity_records.items():
        if record not in carried:
            continue
        if not state.session.features.claims:
            # Under its own name: the server tries the body's name alone after `<key>_<body>`.
            commands[name] = record.wrench_command(carried[record])
        else:
            # An entity has no owner, so one of the robots takes it along.
            key = next(iter(commands or state.objects.records))
            carrier = commands.setdefault(key, ArticulationCommand())
            carrier.xfrc_applied = {**(carrier.xfrc_applied or {}), **carried[record]}
    return commands


def live_commands(state: SimState, carried: Carried) -> dict[str, ArticulationCommand]:
    """Return what a step in live mode tells the articulations."""
    if state.session.features.live_pictures_in_steps:
        return direct_commands(state, carried)
    return {record.name: record.live_command() for record in _ours(state)}


def _ours(state: SimState) -> Iterable[MirroredArticulation]:
    # A server whose robots have owners refuses a step that writes to others' robots, so it hears of ours only.
    records = state.objects.records.values()
    return [record for record in records if record.driven] if state.session.features.claims else records


def take_wrenches(state: SimState) -> Carried:
    """Take what the step that is being built carries out of its buffers."""
    carried: Carried = {}
    for record in _ours(state):
        if record.wrenches:
            carried[record] = record.take_wrenches()
    for entity in state.objects.entity_records.values():
        if entity.wrenches and (state.objects.records or not state.session.features.claims):
            carried[entity] = entity.take_wrenches()
    return carried
