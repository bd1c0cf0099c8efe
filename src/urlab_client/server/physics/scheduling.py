"""When physics runs, and who waits for it: the lock around model and data, queued steps, the thread and its pace.

The lock distinguishes a busy physics thread from one that is stuck inside MuJoCo.
"""

from __future__ import annotations

import atexit
import logging
import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import Final, Generic, TypeVar

import mujoco

from urlab_client.enums import StepMode
from urlab_client.protocol.messages.session import Step
from urlab_client.server.refusal import Refusal
from urlab_client.server.system.threads import Health, ended, within
from urlab_client.simulation.controllers import float32

MIN_TIMEOUT_S: Final = 1.0
"""Shortest duration of an overdue MuJoCo call; a slice of a long request may take a while on a busy machine."""


T = TypeVar("T")

logger: logging.Logger = logging.getLogger("urlab_client.server")

MIN_SPEED: Final = 5.0

MAX_SPEED: Final = 100.0

IDLE_S: Final = 0.1
"""Longest sleep of the physics thread while nothing integrates."""

MAX_LAG_S: Final = 0.02
"""A live step later than this counts as a stall and is not caught up; smaller delays are jitter."""

MIN_PERIOD_S: Final = 1e-5

MAX_PERIOD_S: Final = 3600.0

HOLD_S: Final = 0.005
"""Interval at which a live loop that runs late, and so never sleeps, releases the lock for `GIVE_WAY_S`."""

GIVE_WAY_S: Final = 0.0005


@dataclass(frozen=True)
class Overdue:
    """A MuJoCo call that has exceeded the step timeout.

    Attributes:
        thread: The calling thread.
        began_at: Start of the call, seconds of `time.perf_counter`.
        seconds: Time since then.
    """

    thread: threading.Thread
    began_at: float
    seconds: float


class MujocoCall:
    """The MuJoCo call in progress, if any. Entered under the engine's lock, read without it."""

    __slots__ = ("_timeout_s", "_under_way")

    def __init__(self, timeout_s: float) -> None:
        self._timeout_s = max(timeout_s, MIN_TIMEOUT_S)
        self._under_way: tuple[threading.Thread, float] | None = None

    def __enter__(self) -> None:
        self._under_way = threading.current_thread(), time.perf_counter()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._under_way = None

    @property
    def overdue(self) -> Overdue | None:
        """The call in progress if it has exceeded the step timeout, otherwise None."""
        under_way = self._under_way
        if under_way is None:
            return None
        thread, began_at = under_way
        seconds = time.perf_counter() - began_at
        return Overdue(thread, began_at, seconds) if seconds > self._timeout_s else None


class DataLock:
    """A re-entrant lock around model and data whose `with` gives up after a time.

    Attributes:
        inner: The lock itself, for the physics thread and for waits with deadlines of their own.
    """

    __slots__ = ("_call", "_timeout", "inner")

    def __init__(self, timeout: float, call: MujocoCall) -> None:
        """Create an unlocked lock.

        Args:
            timeout: Seconds after which entering raises `Refusal` with `not_ready`. A step request may legally keep
                physics busy for hours, and no other request may hang because of that.
            call: The MuJoCo call in progress; waiting is pointless while it is overdue.
        """
        self.inner: threading.RLock = threading.RLock()
        self._timeout = timeout
        self._call = call

    def acquire(self) -> bool:
        """Acquire the lock, or return False if it does not become free in time. Refuses while a call is overdue."""
        if self.inner.acquire(blocking=False):
            return True
        overdue = self._call.overdue
        if overdue is not None:
            raise Refusal(
                "not_ready",
                f"MuJoCo has not returned for {overdue.seconds:.0f} s: play continues when it returns, and "
                "stop_pie ends it",
            )
        return self.inner.acquire(timeout=self._timeout)

    @contextmanager
    def look(self) -> Generator[None]:
        """Hold the lock, or proceed without it while a MuJoCo call is overdue. For data that no step changes."""
        with ExitStack() as held:
            try:
                held.enter_context(self)
            except Refusal:
                if self._call.overdue is None:
                    raise
            yield

    def __enter__(self) -> None:
        if not self.acquire():
            raise busy()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.inner.release()


def shutting_down() -> Refusal:
    """Return the refusal of a step that the end of the simulation breaks off."""
    return Refusal("shutting_down", "the simulation is stopping")


def busy() -> Refusal:
    """Return the refusal for a caller that does not get the lock in time."""
    return Refusal("not_ready", "physics is busy with a step request that is still running; try again later")


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


class LivePacing:
    """Keeps the iterations of live mode on a grid of time slots."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._speed = MAX_SPEED
        self._slot = -math.inf
        self._last_rest = -math.inf

    @property
    def speed(self) -> float:
        """Speed in force, percent of real time, 5 to 100, a float32."""
        return float32(min(max(self._speed, MIN_SPEED), MAX_SPEED))

    @speed.setter
    def speed(self, percent: float) -> None:
        self._speed = float(percent)

    def restart(self) -> None:
        """Make the next iteration due immediately."""
        self._slot = -math.inf

    def take_slot(self, *, idle: bool) -> float:
        """Take the next slot if it is due.

        Returns:
            0 if the slot was taken, otherwise the seconds to wait before the next call.
        """
        now = time.perf_counter()
        due = self._slot + (IDLE_S if idle else self._period())
        if now < due:
            return min(due - now, IDLE_S)
        self._slot = now if now - due > MAX_LAG_S else due
        return 0.0

    @property
    def rest_due(self) -> bool:
        """Whether the loop has held the lock for so long that it should release it."""
        return time.perf_counter() - self._last_rest > HOLD_S

    def rested(self) -> None:
        """Note that the lock was free for a while."""
        self._last_rest = time.perf_counter()

    def _period(self) -> float:
        """Seconds between two live iterations."""
        period = float(self._model.opt.timestep) * 100.0 / self.speed
        return min(period, MAX_PERIOD_S) if period > MIN_PERIOD_S else MIN_PERIOD_S
