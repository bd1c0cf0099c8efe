"""Callbacks for objects that follow a client, such as recorders and views."""

from __future__ import annotations

from collections.abc import Mapping

from urlab_client.enums import CameraTiming
from urlab_client.protocol.messages.session import StateReply
from urlab_client.protocol.messages.streams import StateSnapshot


class ClientObserver:
    """Base class for observers of a client. Override the methods that you need, and pass it to `client.add_observer()`.

    The methods are called on the client's event loop, which a blocking client runs in the calling thread or in one of
    its own. So they must return quickly and must not call the client's ops. Exceptions are logged and otherwise
    ignored. Only `ready` may take its time.
    """

    def on_handshake(self) -> None:
        """Called after a handshake: `model`, robots, entities and cameras may have changed."""

    def on_state(self, state: StateReply | StateSnapshot) -> None:
        """Called with each new state, after the client's attributes show it.

        Args:
            state: The reply to a `step()` (`StepOk`, with its pictures in `cameras`), to a `reset()` (`ResetOk`) or to
                a `forward()`, or in live mode the newest snapshot. The caller of the op gets the same arrays and may
                write to them: copy what you keep.
        """

    async def ready(self) -> None:
        """Return when the observer can take another state; a step in `direct` or `puppet` mode waits for that.

        It must return eventually. Cancelling the step cancels it, and the step raises what it raises.
        """

    def step_cameras(self, n_steps: int) -> Mapping[str, str | CameraTiming]:
        """Return the cameras whose pictures the next step requests, in addition to those that its caller requests.

        Args:
            n_steps: As given to `step()`.

        Returns:
            `sync` (rendered after the step) or `latest` by camera name. Unknown names are ignored.
        """
        return {}
