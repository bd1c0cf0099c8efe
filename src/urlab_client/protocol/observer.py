"""What a client tells those who look on while it works, such as recorders and views."""

from __future__ import annotations

from collections.abc import Mapping

from urlab_client.protocol.enums import CameraTiming
from urlab_client.protocol.messages.session import StateReply
from urlab_client.protocol.messages.streams import StateSnapshot

__all__ = ["ClientObserver"]


class ClientObserver:
    """Base of what looks on while a client works: derive from it, override what is needed, `client.add_observer()` it.

    Its methods are called on the client's event loop, which a blocking client runs in the calling thread or in one of
    its own. So they must be quick and must not call the client's ops; what they raise is logged and changes nothing.
    `ready` alone may take its time.
    """

    def on_handshake(self) -> None:
        """Note that a handshake was taken over: `model`, robots, entities and cameras may be others than before."""

    def on_state(self, state: StateReply | StateSnapshot) -> None:
        """Take note of a state, which the client's attributes show from now on.

        Args:
            state: The reply to a `step()` (`StepOk`, with its pictures in `cameras`), to a `reset()` (`ResetOk`) or to
                a `forward()`, or in live mode the newest snapshot. Its arrays go on to the caller of the op, who may
                write to them: copy what is kept.
        """

    async def ready(self) -> None:
        """Return when there is room for a further state: a step in `direct` or `puppet` mode waits for that.

        It must end by itself; cancelling the step cancels it, and what it raises, the step raises.
        """

    def step_cameras(self, n_steps: int) -> Mapping[str, str | CameraTiming]:
        """Return the cameras whose pictures the next step is to bring besides those that its caller asks for.

        Args:
            n_steps: As given to `step()`.

        Returns:
            Camera name to `sync` (rendered after the step) or `latest`. Names that mean no camera are left out.
        """
        return {}
