"""The publishing endpoints of one client's server, and the sources that receive from them."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence

import numpy as np

from urlab_client.aio.defaults import Timeout
from urlab_client.aio.session.session import Session
from urlab_client.aio.streams.camera_switch import CameraSwitch
from urlab_client.aio.streams.events import EventBus
from urlab_client.aio.streams.sources import Camera, CameraSource, OwnSteps, RowFilter, RowSource, StateSource
from urlab_client.aio.transport.connection import ClientKeys
from urlab_client.aio.transport.shm_regions import ServerRegions
from urlab_client.aio.transport.shm_streams import Regions
from urlab_client.aio.transport.subscriber import Subscriptions, client_closed
from urlab_client.enums import CameraMode
from urlab_client.errors import URLabError
from urlab_client.protocol.messages.streams import CameraSample, StreamPolicy
from urlab_client.values.pictures import Pixels


class SharedFrame:
    """A zero-copy view of the newest picture of a camera in the server's shared memory.

    The server overwrites the picture when it starts to publish the next but one. Compute from `pixels`, then call
    `valid()`: if it returns False, the computation mixed two pictures and its result is invalid. The pixels have the
    wire's format. Do not access them after play has stopped or when the server may have exited: the memory is then
    released.

    Attributes:
        pixels: Read-only view: uint8 (H, W, 4) BGRA; for depth float32 (H, W), centimetres.
        sequence: Sequence number of the picture in its region.
    """

    def __init__(self, pixels: Pixels, sequence: int, valid: Callable[[], bool]) -> None:
        self.pixels = pixels
        self.sequence = sequence
        self._valid = valid

    def valid(self) -> bool:
        """Return whether everything read from `pixels` so far belongs to a single picture."""
        return self._valid()


class Publishers:
    """The publishing side of a server. Sockets and regions are opened only when something is received.

    Attributes:
        default_timeout: The session's.
        subscriptions: Active subscriptions.
        events: Events of the client.
        regions: Active shared memory regions; None if the client does not use shared memory.
        camera_switch: Switch that turns cameras on and off.
        capture: Callback that takes pictures without a step; set by the client.
        own_steps: Delivers the client's own steps to receivers of snapshots.
    """

    capture: Callable[[Sequence[Camera], Timeout], Awaitable[list[CameraSample]]]

    def __init__(
        self,
        session: Session,
        state_port: Callable[[], int],
        *,
        live: Callable[[], bool],
        keys: ClientKeys | None = None,
        memory: ServerRegions | None = None,
    ) -> None:
        self.default_timeout: float | None = session.default_timeout
        self.subscriptions: Subscriptions = Subscriptions(keys)
        self.events: EventBus = EventBus()
        self.camera_switch: CameraSwitch = CameraSwitch(session, self.subscriptions.refresh)
        self.own_steps: OwnSteps = OwnSteps()
        self.regions: Regions | None = None if memory is None else Regions(memory, self.subscriptions)
        self._session = session
        self._state_port = state_port
        self._live = live

    def state(self, policy: str = StreamPolicy.LATEST) -> StateSource:
        """Return the source of snapshots for a stream of that policy."""
        return StateSource(
            self.subscriptions,
            self._state_endpoint,
            self.own_steps,
            regions=self._regions_for(policy),
            only_own=self._only_own,
        )

    def _regions_for(self, policy: str) -> Regions | None:
        return None if policy == StreamPolicy.ALL else self.regions  # a region keeps only the newest

    def _only_own(self) -> bool:
        return not (self._session.features.publishes_steps or self._live())

    def rows(self, wanted: RowFilter) -> RowSource:
        return RowSource(self.subscriptions, self._state_endpoint, wanted)

    def camera(self, camera: Camera, policy: str = StreamPolicy.LATEST, *, asked: bool = True) -> CameraSource:
        """Return the source of a camera's pictures for a stream of that policy; see `CameraSource`."""
        return CameraSource(
            self.subscriptions,
            camera,
            self._host,
            regions=self._regions_for(policy),
            live=self._live,
            switch=self.camera_switch,
            asked=asked,
        )

    def shared_frame(self, camera: Camera) -> SharedFrame | None:
        """Return a camera's newest picture in shared memory, or None if there is none. Call from any thread."""
        if self.regions is None:
            return None
        found = self.regions.view(CameraSource(self.subscriptions, camera, self._host).place())
        width, height = camera.info.resolution
        if found is None or len(found[0].payload) < width * height * 4:
            return None
        publication, valid = found
        slot = publication.payload[-width * height * 4 :]  # newer servers put a header in front
        pixels = (
            np.frombuffer(slot, "<f4").reshape(height, width)
            if camera.mode == CameraMode.DEPTH
            else np.frombuffer(slot, np.uint8).reshape(height, width, 4)
        )
        return SharedFrame(pixels, publication.sequence, valid)

    def refresh(self) -> None:
        """Reconnect after a handshake, or after the server has returned: publishers may have moved."""
        self.subscriptions.refresh()
        if self.regions is not None:
            self.regions.refresh()

    def release_regions(self) -> None:
        """Release the shared memory of a play session that ends or of a server that has gone."""
        if self.regions is not None:
            self.regions.release()

    def check_open(self) -> None:
        """Raise `ClientClosed` if the client was closed."""
        if self.subscriptions.closed:
            raise client_closed()

    def close(self) -> None:
        """End every stream with `ClientClosed`. Call from the event loop. Idempotent."""
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
        endpoint = self._session.transport.endpoint
        scheme, _, rest = endpoint.partition("://")
        if scheme not in {"tcp", "ipc"}:
            raise URLabError(f"{endpoint} has not been started yet.", hint="Call discover() first.")
        return scheme, rest.rpartition(":")[0]
