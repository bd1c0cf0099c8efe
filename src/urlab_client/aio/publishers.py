"""Where one client's server publishes, and everything the client receives from there."""

from __future__ import annotations

from collections.abc import Callable, Collection

from urlab_client.aio.sources import CameraSource, EventBus, HasCamera, RowSource, StateSource
from urlab_client.aio.transport.curve import ClientKeys
from urlab_client.aio.transport.subscriber import Subscriptions
from urlab_client.protocol.errors import URLabError
from urlab_client.protocol.rows import TopicKind

__all__ = ["Publishers"]


class Publishers:
    """The publishing side of a server. Nothing is opened before something is received.

    Args:
        rpc_endpoint: Tells where requests go: the other ports are on the same host.
        state_port: Tells the port of the state stream.
        default_timeout: Seconds that a stream waits for its first item unless told otherwise; None waits.
        keys: What the publishers demand; None for nothing.

    Attributes:
        default_timeout: As given.
        subscriptions: What is being received.
        events: What happens to the client.
    """

    def __init__(
        self,
        rpc_endpoint: Callable[[], str],
        state_port: Callable[[], int],
        *,
        default_timeout: float | None,
        keys: ClientKeys | None = None,
    ) -> None:
        self.default_timeout = default_timeout
        self.subscriptions = Subscriptions(keys)
        self.events = EventBus()
        self._rpc_endpoint = rpc_endpoint
        self._state_port = state_port

    def state(self) -> StateSource:
        """Return what brings snapshots."""
        return StateSource(self.subscriptions, self._state_endpoint)

    def rows(
        self,
        articulations: Collection[str],
        kinds: Collection[str | TopicKind],
        components: Collection[str],
        *,
        entities: bool,
    ) -> RowSource:
        """Return what brings rows; see `RowSource`."""
        return RowSource(self.subscriptions, self._state_endpoint, articulations, kinds, components, entities=entities)

    def camera(self, view: HasCamera) -> CameraSource:
        """Return what brings a camera's pictures."""
        return CameraSource(self.subscriptions, view, self._host)

    def close(self) -> None:
        """End every stream with `ClientClosed`, from the event loop. Idempotent."""
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
