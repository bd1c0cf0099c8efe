"""The state message for browsers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from urlab_client.protocol.messages.streams import StateSnapshot
from urlab_client.web.messages import ArticulationSample, EntitySample, State

__all__ = ["rounded", "state_message"]

_DIGITS = 5


def state_message(seq: int, snapshot: StateSnapshot, targets: Mapping[str, list[float] | None]) -> State:
    """Return the message of a state, with what viewers have commanded by articulation."""
    wall = snapshot.wall_time.sec + snapshot.wall_time.nsec / 1e9
    received = snapshot.recv_wall_time_ns / 1e9
    # The server's own clock where it can be the same as ours; else what we know, when it got here.
    made = wall if 0 <= received - wall < 10 else received
    return State(
        seq=seq,
        time=snapshot.time,
        step=snapshot.step,
        made=made * 1e3,
        articulations={
            key: ArticulationSample(
                qpos=rounded(state.qpos),
                qvel=rounded(state.qvel),
                ctrl=None if state.ctrl is None else rounded(state.ctrl),
                sensors={name: rounded(value) for name, value in (state.sensors or {}).items()},
                targets=targets.get(key),
            )
            for key, state in snapshot.per_articulation.items()
        },
        entities={name: EntitySample(rounded(pose.xpos)) for name, pose in snapshot.entities.items()},
    )


def rounded(values: Any) -> list[Any]:
    """Return numbers of as many digits as browsers are told."""
    return np.round(np.asarray(values, dtype=np.float64), _DIGITS).tolist()
