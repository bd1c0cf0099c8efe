"""The driver lease, by which clients announce that a server is in use. It is advisory."""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Callable

from urlab_client.server.refusal import Refusal

__all__ = ["DriverLease"]


class DriverLease:
    """One lease at a time, which expires after some time without requests.

    Args:
        clock: Returns the time, seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._id = ""
        self._ttl_s = 0.0
        self._touched = 0.0

    @property
    def held(self) -> bool:
        """Whether it is held."""
        with self._lock:
            return self._holds()

    def acquire(self, ttl_s: float) -> str:
        """Take it and return its id.

        Raises:
            Refusal: `busy`.
        """
        with self._lock:
            if self._holds():
                # As the plugin does, although with the id anybody can release the lease. No message and no log has it.
                raise Refusal("busy", "another client holds the driver lease", lease_id=self._id)
            self._id, self._ttl_s, self._touched = str(uuid.uuid4()).upper(), ttl_s, self._clock()
            return self._id

    def release(self, lease_id: str) -> None:
        """Give it back.

        Raises:
            Refusal: `bad_request` for any id but the holder's.
        """
        with self._lock:
            if not self._holds() or lease_id != self._id:
                raise Refusal("bad_request", "lease_id is not the id of the lease that is held")
            self._id = ""

    def touch(self) -> None:
        """Renew the lease: the server is in use."""
        if self._id:
            with self._lock:
                if self._holds():
                    self._touched = self._clock()

    def _holds(self) -> bool:
        return bool(self._id) and self._clock() - self._touched <= self._ttl_s and self._ttl_s > 0
