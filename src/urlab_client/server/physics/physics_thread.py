"""The thread that runs a simulation, and its shutdown."""

from __future__ import annotations

import atexit
import logging
import math
import threading
import time
from collections import Counter
from collections.abc import Callable

import mujoco

from urlab_client.server.physics.data_lock import DataLock
from urlab_client.server.physics.integrator import shutting_down
from urlab_client.server.refusal import Refusal
from urlab_client.server.system.health import Health, ended, within

logger: logging.Logger = logging.getLogger("urlab_client.server")


class _WarningLog:
    """Sends MuJoCo's warnings to the log while an engine runs.

    MuJoCo has one handler per process and by default appends to a file in the current folder. A handler that the
    application installed stays.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users = 0
        self._counts: Counter[str] = Counter()

    def acquire(self) -> None:
        with self._lock:
            self._users += 1
            if self._users == 1 and mujoco.get_mju_user_warning() is None:
                mujoco.set_mju_user_warning(self._log)

    def release(self) -> None:
        with self._lock:
            self._users -= 1
            if self._users == 0 and mujoco.get_mju_user_warning() == self._log:
                mujoco.set_mju_user_warning(None)
                self._counts.clear()

    def _log(self, text: str) -> None:
        kind = text[:32]  # the rest carries numbers that differ each time
        self._counts[kind] += 1
        count = self._counts[kind]
        if count & (count - 1) == 0:  # an unstable model repeats itself at every step
            logger.warning("MuJoCo: %s%s", text, f" ({count} times so far)" if count > 1 else "")


_mujoco_warnings: _WarningLog = _WarningLog()


class PhysicsThread:
    """Iterates under the lock of a simulation until it is stopped.

    Attributes:
        stopping: Whether the thread has been asked to stop.
        death: Description of the error that ended the thread, or None.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        lock: DataLock,
        *,
        iterate: Callable[[], None],
        fail: Callable[[Exception], object],
        give_up: Callable[[Refusal], None],
        health: Health,
    ) -> None:
        """Create the thread; `start` starts it.

        Args:
            model: The model; if stopping takes too long, its solver tolerances are raised so that they finish early.
            lock: Guards the simulation; held except while `iterate` waits.
            iterate: Does the pending work, or waits for `wake`.
            fail: Callback invoked with an exception raised by `iterate`; the thread continues afterwards.
            give_up: Callback invoked at the end with the refusal for requests that still wait.
            health: Receives a report if the thread dies.
        """
        self._model = model
        self._lock = lock
        self._iterate = iterate
        self._fail = fail
        self._give_up = give_up
        self.wake: threading.Condition = threading.Condition(lock.inner)
        self.stopping: bool = False
        self.death: str | None = None
        self._thread = health.thread("urlab-physics", self._run, on_death=self._die)

    @property
    def alive(self) -> bool:
        """Whether the thread is running."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Start the thread."""
        _mujoco_warnings.acquire()
        atexit.register(self.stop, 1.0)  # a thread inside MuJoCo must not meet the interpreter's end
        self._thread.start()

    def stop(self, timeout: float) -> bool:
        """End the thread between two sub-steps, and release callers that wait for a step. Idempotent.

        Args:
            timeout: Seconds to wait.

        Returns:
            False when physics was still busy after `timeout`.
        """
        first, self.stopping = not self.stopping, True
        deadline = time.monotonic() + timeout
        idle = within(timeout / 2.0, lambda seconds: self._lock.inner.acquire(timeout=seconds))
        if not idle:
            # The result is no longer needed, so the solver stops at its next iteration.
            self._model.opt.tolerance = self._model.opt.noslip_tolerance = math.inf
            idle = within(timeout / 2.0, lambda seconds: self._lock.inner.acquire(timeout=seconds))
        if idle:
            self.wake.notify_all()
            self._lock.inner.release()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            idle = ended(self._thread, deadline - time.monotonic()) and idle
        if first and self._thread.ident is not None:
            _mujoco_warnings.release()
            atexit.unregister(self.stop)
        if not idle:
            logger.warning("physics did not stop within %g s", timeout)
        return idle

    def _run(self) -> None:
        with self._lock.inner:
            while not self.stopping:
                try:
                    self._iterate()
                except Exception as error:  # noqa: BLE001 - the thread must outlive any error of a step
                    self._fail(error)
            self._give_up(shutting_down())

    def _die(self, reason: str) -> None:
        with self._lock.inner:
            self.death = reason
            self._give_up(Refusal("internal_error", reason))
