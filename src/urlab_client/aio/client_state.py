"""What a client knows without asking: how it was made, the server, the model and the mirrored state."""

from __future__ import annotations

from threading import RLock
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace

from urlab_client.aio.articulation import URLabArticulation, URLabEntity
from urlab_client.aio.cameras import URLabCameraView
from urlab_client.aio.model.mirror import binary_model
from urlab_client.aio.session import Session
from urlab_client.aio.state.sim_state import SimState
from urlab_client.aio.transport.base import TransportStats
from urlab_client.protocol.client_types import ClientConfig, ServerInfo
from urlab_client.protocol.codec import encode_message
from urlab_client.protocol.descriptions import ArticulationDescription, EntityDescription, SceneDescription
from urlab_client.protocol.enums import StepMode
from urlab_client.protocol.errors import NoSession
from urlab_client.protocol.messages.session import NOT_SENT
from urlab_client.protocol.messages.streams import StateSnapshot
from urlab_client.protocol.names import NameMap, unknown_name
from urlab_client.protocol.observer import ClientObserver

if TYPE_CHECKING:
    from urlab_client.protocol.mujoco_types import MjData, MjModel

__all__ = ["ClientState"]


class ClientState:
    """The attributes of a client; reading them sends nothing and waits for nothing."""

    def __init__(self, config: ClientConfig, session: Session, state: SimState) -> None:
        self._config = config
        self._session = session
        self._state = state

    @property
    def address(self) -> str:
        """The address the client was made with."""
        return self._config.address

    @property
    def config(self) -> ClientConfig:
        """What the client was made with: picklable and JSON-able, so that an equal client can be made elsewhere."""
        return self._config

    @property
    def connected(self) -> bool:
        """Whether a server is on the line right now."""
        return self._session.transport.connected

    @property
    def transport_stats(self) -> TransportStats:
        """Counters of requests, replies and connections, and of what went which way with `transport="shm"`."""
        return self._session.transport.stats

    @property
    def session_id(self) -> str:
        """RPC session id; empty before `discover()`."""
        return self._session.session_id

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
        """What the server is and can do, as far as its answers have shown."""
        hello = self._state.hello
        return ServerInfo(
            features=self._session.features,
            instance=None if hello is None else hello.instance,
            urlab_version=self.urlab_version,
            mujoco_version=self.mujoco_version,
            step_mode=self._state.mode_word,
        )

    @property
    def user(self) -> dict[str, Any]:
        """Values of the user channels that the level declares for the scene, by name, from the last snapshot."""
        return dict(self._state.user)

    @property
    def manager_present(self) -> bool:
        """Whether a play session runs, as far as this client knows."""
        return self._state.hello is not None and self._state.hello.manager_present

    @property
    def step_mode(self) -> StepMode:
        """Step mode in force, as far as this client knows."""
        return self._state.mode

    @property
    def model(self) -> MjModel | None:
        """The compiled model, or None before play or with local_model=False."""
        return self._state.mirror.model

    @property
    def data(self) -> MjData | None:
        """Local state that mirrors the server's after each reply, or None without a model.

        Poses and velocities that follow from the state (`xpos`, `site_xpos`, `cvel`, …) are computed when this is read
        after a reply, so read it again after each step; whoever does not read it pays nothing. Forces and contacts are
        not computed: use `mujoco.mj_forward` on a copy, or `runtime.get_contacts()`.
        """
        return self._state.mirror.current_data()

    @property
    def model_is_approximate(self) -> bool:
        """True when the model was compiled here because the server runs another MuJoCo build."""
        return self._state.mirror.approximate

    @property
    def articulations(self) -> NameMap[URLabArticulation]:
        """Articulations by key. An actor id or a class name is found, too, where it means one of them."""
        return self._state.objects.articulations

    @property
    def articulations_by_id(self) -> dict[str, URLabArticulation]:
        """Articulations that have an actor id, by that id."""
        return self._state.objects.articulations_by_id

    @property
    def entities(self) -> NameMap[URLabEntity]:
        """Every dynamic body by name, articulations included."""
        return self._state.objects.entities

    @property
    def global_cameras(self) -> NameMap[URLabCameraView]:
        """Scene-level cameras by name."""
        return self._state.objects.global_cameras

    @property
    def step_count(self) -> int:
        """Steps since `discover()` or `reset()`, as the server counts; constant in live mode."""
        return self._state.step_count

    @property
    def reset_seed(self) -> int | None:
        """The seed that the last `reset()` gave, which decides what a server varies; None without one."""
        return self._state.reset_seed

    @property
    def sim_time(self) -> float:
        """Simulation time of the last reply, seconds."""
        return self._state.sim_time

    @property
    def sim_time_sec(self) -> int:
        """Whole seconds of the simulation time."""
        return self._state.sim_time_sec

    @property
    def sim_time_nsec(self) -> int:
        """Nanoseconds within the second of the simulation time."""
        return self._state.sim_time_nsec

    @property
    def wall_time_sec(self) -> int:
        """Whole seconds of the server's UTC clock when the last reply was built."""
        return self._state.wall_time_sec

    @property
    def wall_time_nsec(self) -> int:
        """Nanoseconds within the second of the server's UTC clock when the last reply was built."""
        return self._state.wall_time_nsec

    @property
    def recv_wall_time_ns(self) -> int:
        """This machine's UTC clock when the last reply arrived, nanoseconds."""
        return self._state.recv_wall_time_ns

    def describe(self) -> SceneDescription:
        """Return everything that moves, as of the last reply: robots, other bodies, cameras of the scene.

        Sends nothing. `to_dict()` and `to_json()` of the result make plain data of it.
        """
        with self._state.mirror.lock:
            described = [entity.describe() for entity in self.entities.values()]
            model = self.model
            return SceneDescription(
                address=self.address,
                playing=self.manager_present,
                step_mode=str(self.step_mode),
                sim_time=self.sim_time,
                timestep=None if model is None else float(model.opt.timestep),
                articulations=[one for one in described if isinstance(one, ArticulationDescription)],
                entities=[one for one in described if isinstance(one, EntityDescription)],
                cameras=[camera.describe() for camera in self.global_cameras.values()],
            )

    def handshake(self) -> bytes:
        """Return what a client with `read_only=True` has to know: names, limits, cameras and the model.

        For another process or machine, which passes it to its own client's `discover(handshake=…)`. It describes the
        play session of the last handshake, and does not let anybody into this client's session.

        Raises:
            NoSession: `discover()` was not called.
        """
        hello, mirror = self._state.hello, self._state.mirror
        if hello is None:
            raise NoSession("handshake: discover() was not called.")
        with mirror.lock:
            model = None if mirror.model is None or mirror.approximate else binary_model(mirror.model)
        shared = replace(hello, session_id="", mjb=model, mjb_base64=NOT_SENT, shm_session_dir=None)
        return encode_message(shared)

    def camera(self, name: str) -> URLabCameraView:
        """Return a camera by `<articulation>/<camera>`, or by `<camera>` where that means one of them.

        Raises:
            UnknownName: A `KeyError`: there is no such camera, or there are several.
        """
        objects = self._state.objects
        view = objects.camera(name)
        if view is None:
            raise unknown_name("camera", name, objects.camera_names())
        return view

    def matches(self, snapshot: StateSnapshot) -> bool:
        """Return whether a published state is of the world that the last handshake described, as far as it shows.

        Right after play began anew, a stream may bring states of a world that `discover()` has not been told of.
        """
        return self._state.matches(snapshot)

    def add_observer(self, observer: ClientObserver) -> None:
        """Tell `observer` of each handshake and state from now on, until `remove_observer()`. Idempotent."""
        if observer not in self._state.observers:
            self._state.observers = (*self._state.observers, observer)

    def remove_observer(self, observer: ClientObserver) -> None:
        """Tell `observer` nothing more. Idempotent."""
        self._state.observers = tuple(known for known in self._state.observers if known is not observer)

    @property
    def _data_lock(self) -> RLock:
        """Reentrant lock to hold while reading state from a thread other than the one that steps."""
        return self._state.mirror.lock
