"""A direct step that waits for the physics thread, and the caller that waits for it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from urlab_client.enums import StepMode
from urlab_client.protocol.messages.session import Step
from urlab_client.server.refusal import Refusal

T = TypeVar("T")


class QueuedStep(Generic[T]):
    """A direct step that waits for the physics thread."""

    def __init__(self, request: Step, observe: Callable[[StepMode], T]) -> None:
        self._request = request
        self._observe = observe
        self._settled = threading.Event()
        self._abandoned = False
        self._begun = False
        self._dropped = False
        self._lock = threading.Lock()
        self._results: list[T] = []
        self._error: Exception | None = None

    def run(self, advance: Callable[[Step], None]) -> None:
        """Run the step, unless it was cancelled by its timeout; observe, and release the caller.

        Args:
            advance: Executes the request; called with the engine's lock held.
        """
        with self._lock:
            self._begun = True
            if self._dropped:
                return
        try:
            advance(self._request)
            if not self._abandoned:
                self._results.append(self._observe(StepMode.DIRECT))
        except Exception as error:  # noqa: BLE001 - raised again where the step was requested
            self.fail(error)
        else:
            self._settled.set()

    def fail(self, error: Exception) -> None:
        """Release the caller with an error."""
        self._error = error
        self._settled.set()

    def wait(self, remaining: float, timeout: float, *, runs_late: bool) -> T:
        """Return the observation, or raise what the step raised.

        Args:
            remaining: Seconds until `step_timeout` is raised.
            timeout: The whole step timeout, seconds, for the message.
        """
        if not self._settled.wait(max(0.0, remaining)):
            self._abandoned = True
            with self._lock:
                self._dropped = not (runs_late or self._begun)
            fate = "was cancelled" if self._dropped else "will still run to its end"
            raise Refusal("step_timeout", f"the step did not finish within {timeout:g} s; it {fate}")
        if self._error is not None:
            raise self._error
        return self._results[0]
