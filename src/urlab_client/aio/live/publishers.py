"""Where one client's server publishes, and everything the client receives from there."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence

import numpy as np

from urlab_client.aio.deadline import Timeout
from urlab_client.aio.live.camera_source import CameraSource, HasCamera
from urlab_client.aio.live.camera_switch import CameraSwitch
from urlab_client.aio.live.derived_rows import DerivedRowSource, HasRows
from urlab_client.aio.live.event_bus import EventBus
from urlab_client.aio.live.row_source import RowSource
from urlab_client.aio.live.state_source import OwnSteps, StateSource
from urlab_client.aio.transport.curve import ClientKeys
from urlab_client.aio.transport.regions import Regions
from urlab_client.aio.transport.server_regions import SharedMemoryRegions
from urlab_client.aio.transport.subscriber import Subscriptions, client_closed
from urlab_client.protocol.enums import CameraMode
from urlab_client.protocol.errors import URLabError
from urlab_client.protocol.features import Features
from urlab_client.protocol.messages.streams import CameraSample, StreamPolicy
from urlab_client.protocol.pixels import Pixels
from urlab_client.protocol.topics import TopicKind

__all__ = ["Publishers", "SharedFrame"]


class SharedFrame:
    """The newest picture of a camera where it lies, in the server's shared memory.

    The server overwrites it as soon as the next picture but one begins to come out. Compute from `pixels`, then ask
    `valid()`: if it says no, what was computed is from a mixture of pictures and worth nothing. The pixels are as on
    the wire, and must not be touched any more once play has stopped or the server may be gone: the memory goes with it.

    Attributes:
        pixels: Read-only view: uint8 (H, W, 4) BGRA; for depth float32 (H, W), centimetres.
        sequence: The region's number of the picture.
    """

    def __init__(self, pixels: Pixels, sequence: int, valid: Callable[[], bool]) -> None:
        self.pixels = pixels
        self.sequence = sequence
        self._valid = valid

    def valid(self) -> bool:
        """Return whether everything read from `pixels` so far was one whole picture."""
        return self._valid()


class Publishers:
    """The publishing side of a server. Nothing is opened before something is received.

    Args:
        rpc_endpoint: Tells where requests go: the other ports are on the same host.
        state_port: Tells the port of the state stream.
        default_timeout: Seconds that a stream waits for its first item unless told otherwise; None waits.
        live: Tells whether the server is in live mode, as far as is known.
        features: Tells what the server can do.
        keys: What the publishers demand; None for nothing.
        memory: Where the regions are, for a client that receives from shared memory.

    Attributes:
        default_timeout: As given.
        subscriptions: What is being received.
        events: What happens to the client.
        regions: What is being received from shared memory; None for a client that does not.
        camera_switch: Switches cameras on and off; None where they stream anyway.
        capture: Takes pictures of cameras without a step; the client sets it.
        own_steps: Feeds those who receive snapshots from the client's own steps.
    """

    capture: Callable[[Sequence[HasCamera], Timeout], Awaitable[list[CameraSample]]]

    def __init__(
        self,
        rpc_endpoint: Callable[[], str],
        state_port: Callable[[], int],
        *,
        default_timeout: float | None,
        live: Callable[[], bool] = lambda: True,
        features: Callable[[], Features] = Features,
        keys: ClientKeys | None = None,
        memory: SharedMemoryRegions | None = None,
    ) -> None:
        self.default_timeout = default_timeout
        self.subscriptions: Subscriptions = Subscriptions(keys)
        self.events: EventBus = EventBus()
        self.camera_switch: CameraSwitch | None = None
        self.own_steps: OwnSteps = OwnSteps()
        self.regions: Regions | None = None if memory is None else Regions(memory, self.subscriptions)
        self._rpc_endpoint = rpc_endpoint
        self._state_port = state_port
        self._live = live
        self._features = features

    def state(self, policy: str = StreamPolicy.LATEST) -> StateSource:
        """Return what brings snapshots to a stream of that policy."""
        return StateSource(
            self.subscriptions,
            self._state_endpoint,
            self.own_steps,
            regions=self._regions_for(policy),
            only_own=self._only_own,
        )

    def _regions_for(self, policy: str) -> Regions | None:
        return None if policy == StreamPolicy.ALL else self.regions  # a region keeps the newest only

    def _only_own(self) -> bool:
        return not (self._features().publishes_steps or self._live())

    def rows(
        self,
        articulations: Collection[str],
        kinds: Collection[str | TopicKind],
        components: Collection[str],
        *,
        entities: bool,
        robots: Callable[[], Mapping[str, HasRows]],
    ) -> RowSource:
        """Return what brings rows; see `RowSource`, and `DerivedRowSource` for servers that publish none."""
        if self._features().publishes_rows:
            return RowSource(
                self.subscriptions, self._state_endpoint, articulations, kinds, components, entities=entities
            )
        # From the socket, which brings every snapshot: of a region, the newest counts.
        states = self.state(StreamPolicy.ALL)
        return DerivedRowSource(states, robots, articulations, kinds, components, entities=entities)

    def camera(self, view: HasCamera, policy: str = StreamPolicy.LATEST, *, asked: bool = True) -> CameraSource:
        """Return what brings a camera's pictures to a stream of that policy; see `CameraSource`."""
        return CameraSource(
            self.subscriptions,
            view,
            self._host,
            regions=self._regions_for(policy),
            live=self._live,
            switch=self.camera_switch,
            asked=asked,
        )

    def shared_frame(self, view: HasCamera) -> SharedFrame | None:
        """Return a camera's newest picture in shared memory, None where there is none. From any thread."""
        if self.regions is None:
            return None
        found = self.regions.view(CameraSource(self.subscriptions, view, self._host).place())
        width, height = view.info.resolution
        if found is None or len(found[0].payload) < width * height * 4:
            return None
        publication, valid = found
        slot = publication.payload[-width * height * 4 :]  # newer servers put a header in front
        pixels = (
            np.frombuffer(slot, "<f4").reshape(height, width)
            if view.mode == CameraMode.DEPTH
            else np.frombuffer(slot, np.uint8).reshape(height, width, 4)
        )
        return SharedFrame(pixels, publication.sequence, valid)

    def refresh(self) -> None:
        """Follow a handshake: publishers may be elsewhere than before."""
        self.subscriptions.refresh()
        if self.regions is not None:
            self.regions.refresh()

    def release_regions(self) -> None:
        """Let go of the shared memory of a play session that ends, or of a server that is gone."""
        if self.regions is not None:
            self.regions.release()

    def resume_regions(self) -> None:
        """Look for shared memory again: the server is back."""
        if self.regions is not None:
            self.regions.refresh()

    def check_open(self) -> None:
        """Raise `ClientClosed` once the client was closed."""
        if self.subscriptions.closed:
            raise client_closed()

    def close(self) -> None:
        """End every stream with `ClientClosed`, from the event loop. Idempotent."""
        if self.regions is not None:
            self.regions.close()
        self.subscriptions.close()
        self.events.close()

    def _state_endpoint(self) -> str:
        scheme, base = self._base()
        return f"{scheme}://{base}:{self._state_port()}"

    def _host(self) -> str:
        scheme, base = self._base()
        return base if scheme == "tcp" else "127.0.0.1"

    def _base(self) -> tuple[str, str]:
        endpoint = self._rpc_endpoint()
        scheme, _, rest = endpoint.partition("://")
        if scheme not in {"tcp", "ipc"}:
            raise URLabError(f"{endpoint} has not been started yet.", hint="Call discover() first.")
        return scheme, rest.rpartition(":")[0]
