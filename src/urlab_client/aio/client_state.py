"""Local attributes of a client: its configuration, the server, the model and the mirrored state."""

from __future__ import annotations

from threading import RLock
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace

from urlab_client._mujoco import saved_model
from urlab_client.aio.client_types import ClientObserver, ServerInfo
from urlab_client.aio.state.sim_state import SimState
from urlab_client.aio.transport.base import TransportStats
from urlab_client.enums import StepMode
from urlab_client.errors import NoSession
from urlab_client.protocol.codec import encode_message
from urlab_client.protocol.messages.session import NOT_SENT
from urlab_client.protocol.messages.streams import StateSnapshot
from urlab_client.values.names import Local

if TYPE_CHECKING:
    from mujoco import MjData, MjModel


class ClientState(Local):
    """The attributes of a client. Reading them sends nothing and does not block. Both clients share them."""

    __slots__ = ()

    _state: SimState

    @property
    def connected(self) -> bool:
        """Whether the client is connected to a server at the moment."""
        return self._state.session.transport.connected

    @property
    def transport_stats(self) -> TransportStats:
        """Counters of requests, replies and connections, and with `transport="shm"` of the path that each took."""
        return self._state.session.transport.stats

    @property
    def session_id(self) -> str:
        """RPC session id; empty before `discover()`."""
        return self._state.session.session_id

    @property
    def urlab_version(self) -> str:
        """Version of the server; empty before `discover()`."""
        return "" if self._state.hello is None else self._state.hello.urlab_version

    @property
    def mujoco_version(self) -> str:
        """MuJoCo version of the server; empty before `discover()`."""
        return "" if self._state.hello is None else self._state.hello.mujoco_version

    @property
    def server(self) -> ServerInfo:
        """The server's versions and features, as far as its replies have shown them."""
        hello = self._state.hello
        return ServerInfo(
            features=self._state.session.features,
            instance=None if hello is None else hello.instance,
            urlab_version=self.urlab_version,
            mujoco_version=self.mujoco_version,
            step_mode=self._state.mode.word,
        )

    @property
    def user(self) -> dict[str, Any]:
        """Values of the user channels that the level declares for the scene, by name, from the last snapshot."""
        return dict(self._state.user)

    @property
    def manager_present(self) -> bool:
        """Whether a play session is running, as far as this client knows."""
        return self._state.playing

    @property
    def step_mode(self) -> StepMode:
        """Step mode in force, as far as this client knows."""
        return self._state.mode.current

    @property
    def model(self) -> MjModel | None:
        """The compiled model, or None before play or with local_model=False."""
        return self._state.mirror.model

    @property
    def data(self) -> MjData | None:
        """Local state that mirrors the server's after each reply, or None without a model.

        Reading this property computes the poses and velocities that follow from the state (`xpos`, `site_xpos`, `cvel`,
        …), so read it again after each step. A client that does not read it saves the computation. Forces and contacts
        are not computed: use `mujoco.mj_forward` on a copy, or `runtime.get_contacts()`.
        """
        return self._state.mirror.current_data()

    @property
    def model_is_approximate(self) -> bool:
        """True if this client compiled the model because the server runs another MuJoCo build."""
        return self._state.mirror.approximate

    @property
    def step_count(self) -> int:
        """Steps since `discover()` or `reset()`, as counted by the server; constant in live mode."""
        return self._state.clocks.step_count

    @property
    def reset_seed(self) -> int | None:
        """Seed of the last `reset()`, which determines what the server randomises; None if it had none."""
        return self._state.reset_seed

    @property
    def sim_time(self) -> float:
        """Simulation time of the last reply, seconds."""
        return self._state.clocks.sim_time

    @property
    def sim_time_sec(self) -> int:
        """Whole seconds of the simulation time."""
        return self._state.clocks.sim_clock.sec

    @property
    def sim_time_nsec(self) -> int:
        """Nanoseconds within the second of the simulation time."""
        return self._state.clocks.sim_clock.nsec

    @property
    def wall_time_sec(self) -> int:
        """Whole seconds of the server's UTC clock when the last reply was built."""
        return self._state.clocks.wall_clock.sec

    @property
    def wall_time_nsec(self) -> int:
        """Nanoseconds within the second of the server's UTC clock when the last reply was built."""
        return self._state.clocks.wall_clock.nsec

    @property
    def recv_wall_time_ns(self) -> int:
        """This machine's UTC clock when the last reply arrived, nanoseconds."""
        return self._state.clocks.recv_wall_time_ns

    def handshake(self) -> bytes:
        """Return the names, limits, cameras and the model that a client with `read_only=True` needs.

        Another process or machine passes the result to `discover(handshake=…)` of its own client. It describes the play
        session of the last handshake and gives no access to this client's session.

        Raises:
            NoSession: `discover()` was not called.
        """
        hello, mirror = self._state.hello, self._state.mirror
        if hello is None:
            raise NoSession("handshake: discover() was not called.")
        with mirror.lock:
            model = None if mirror.model is None or mirror.approximate else saved_model(mirror.model)
        shared = replace(hello, session_id="", mjb=model, mjb_base64=NOT_SENT, shm_session_dir=None)
        return encode_message(shared)

    def matches(self, snapshot: StateSnapshot) -> bool:
        """Return whether a published state belongs to the world of the last handshake, as far as its fields show.

        Right after play restarts, a stream may deliver states of a world that `discover()` has not seen yet.
        """
        return self._state.matches(snapshot)

    @property
    def observers(self) -> tuple[ClientObserver, ...]:
        """The observers that `add_observer()` has added."""
        return self._state.observers

    def add_observer(self, observer: ClientObserver) -> None:
        """Notify `observer` of each handshake and state from now on, until `remove_observer()`. Idempotent."""
        if observer not in self._state.observers:
            self._state.observers = (*self._state.observers, observer)

    def remove_observer(self, observer: ClientObserver) -> None:
        """Stop notifying `observer`. Idempotent."""
        self._state.observers = tuple(known for known in self._state.observers if known is not observer)

    @property
    def _data_lock(self) -> RLock:
        """Reentrant lock to hold while reading state from a thread other than the one that steps."""
        return self._state.mirror.lock
