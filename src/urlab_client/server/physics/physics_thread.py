"""The thread that runs a simulation, and how it comes to its end."""

from __future__ import annotations

import atexit
import logging
import math
import threading
import time
from collections.abc import Callable

import mujoco

from urlab_client.server.physics.data_lock import DataLock
from urlab_client.server.physics.integrator import shutting_down
from urlab_client.server.physics.mujoco_warnings import mujoco_warnings
from urlab_client.server.refusal import Refusal
from urlab_client.server.system.health import Health
from urlab_client.server.system.thread_join import ended, within

__all__ = ["PhysicsThread"]

logger: logging.Logger = logging.getLogger("urlab_client.server")


class PhysicsThread:
    """Iterates under the lock of a simulation until it is stopped.

    Attributes:
        stopping: Whether it is to end.
        death: What it died of, or None.
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
        """Describe the thread; `start` sets it going.

        Args:
            model: The model; once stopping takes too long, its solvers are told to be content.
            lock: Guards the simulation; held but for the waits of `iterate`.
            iterate: Does what there is to do, or waits for `wake`.
            fail: Told of an error of `iterate`, after which the thread goes on.
            give_up: Told, at the end, with what to refuse requests that still wait.
            health: Told when the thread dies.
        """
        self._model = model
        self._lock = lock
        self._iterate = iterate
        self._fail = fail
        self._give_up = give_up
        self._health = health
        self.wake: threading.Condition = threading.Condition(lock.inner)
        self.stopping: bool = False
        self.death: str | None = None
        self._thread = threading.Thread(target=self._run, name="urlab-physics", daemon=True)

    @property
    def alive(self) -> bool:
        """Whether it runs."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Start the thread."""
        mujoco_warnings.acquire()
        atexit.register(self.stop, 1.0)  # a thread inside MuJoCo must not meet the interpreter's end
        self._thread.start()

    def stop(self, timeout: float) -> bool:
        """End the thread between two sub-steps, and release whoever waits for a step. Safe to call twice.

        Args:
            timeout: Seconds to wait.

        Returns:
            False when physics was still busy after `timeout`.
        """
        first, self.stopping = not self.stopping, True
        deadline = time.monotonic() + timeout
        idle = within(timeout / 2.0, lambda seconds: self._lock.inner.acquire(timeout=seconds))
        if not idle:
            # Whatever its solver still iterates for is no longer wanted: any improvement is too small to go on.
            self._model.opt.tolerance = self._model.opt.noslip_tolerance = math.inf
            idle = within(timeout / 2.0, lambda seconds: self._lock.inner.acquire(timeout=seconds))
        if idle:
            self.wake.notify_all()
            self._lock.inner.release()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            idle = ended(self._thread, deadline - time.monotonic()) and idle
        if first and self._thread.ident is not None:
            mujoco_warnings.release()
            atexit.unregister(self.stop)
        if not idle:
            logger.warning("physics did not stop within %g s", timeout)
        return idle

    def _run(self) -> None:
        with self._lock.inner:
            try:
                while not self.stopping:
                    try:
                        self._iterate()
                    except Exception as error:  # noqa: BLE001 - the thread must outlive any error of a step
                        self._fail(error)
                self._give_up(shutting_down())
            except BaseException as error:  # noqa: BLE001 - who waits for a step must not wait for ever
                self.death = self._health.report(error)
                self._give_up(Refusal("internal_error", self.death))
