"""Where the simulation is: the step counter and the clocks of the last state."""

from __future__ import annotations

from urlab_client.protocol.messages.session import StateReply
from urlab_client.protocol.messages.streams import StateSnapshot

# By the server's clock. A larger difference means that the clock was set, not that messages were reordered.
_OVERTAKEN_S = 1.0


class Clocks:
    """Step counter and clocks, as the attributes of the client show them; zero before the first state.

    Attributes:
        step_count: Steps since the last handshake or reset.
    """

    def __init__(self) -> None:
        self.step_count: int = 0
        self.sim_time: float = 0.0
        self.sim_time_sec: int = 0
        self.sim_time_nsec: int = 0
        self.wall_time_sec: int = 0
        self.wall_time_nsec: int = 0
        self.recv_wall_time_ns: int = 0

    def absorb(self, state: StateReply | StateSnapshot, received_ns: int) -> None:
        """Take counter and clocks from a state that was received at that time."""
        self.step_count = state.step
        self.sim_time = state.time
        self.recv_wall_time_ns = received_ns
        if state.sim_time is not None:
            self.sim_time_sec, self.sim_time_nsec = state.sim_time.sec, state.sim_time.nsec
        if state.wall_time is not None:
            self.wall_time_sec, self.wall_time_nsec = state.wall_time.sec, state.wall_time.nsec

    def overtook(self, snapshot: StateSnapshot) -> bool:
        """Return whether a snapshot was sent before the state that these clocks show, but received after it."""
        age = self.wall_time_sec - snapshot.wall_time.sec + (self.wall_time_nsec - snapshot.wall_time.nsec) / 1e9
        return 0 < age < _OVERTAKEN_S

    def restart(self) -> None:
        """Set counter and simulation time to zero, as a new play session does."""
        self.step_count = 0
        self.sim_time = 0.0
        self.sim_time_sec = self.sim_time_nsec = 0
