"""When physics runs, and who waits for it: the lock around model and data, queued steps, the thread and its pace.

The lock distinguishes a busy physics thread from one that is stuck inside MuJoCo.
"""

from __future__ import annotations

import atexit
import logging
import math
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Generator
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager
from types import TracebackType
from typing import Final, NamedTuple, Self, TypeVar

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


class Overdue(NamedTuple):
    """A MuJoCo call that has exceeded the step timeout; it began at `began_at` of `time.perf_counter`."""

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
    return Refusal("shutting_down", "the simulation is stopping")


def busy() -> Refusal:
    return Refusal("not_ready", "physics is busy with a step request that is still running; try again later")


class QueuedStep(Future[T]):
    """A direct step that waits for the physics thread."""

    def __init__(self, request: Step, observe: Callable[[StepMode], T]) -> None:
        super().__init__()
        self._request = request
        self._observe = observe

    def run(self, advance: Callable[[Step], None]) -> None:
        """Run the step under the engine's lock, unless its timeout has cancelled it, and release the caller."""
        if not self.set_running_or_notify_cancel():
            return
        try:
            advance(self._request)
            self.set_result(self._observe(StepMode.DIRECT))
        except Exception as error:  # noqa: BLE001 - raised again where the step was requested
            self.set_exception(error)

    def drop(self, refusal: Refusal) -> None:
        if self.set_running_or_notify_cancel():
            self.set_exception(refusal)

    def wait(self, remaining: float, timeout: float, *, runs_late: bool) -> T:
        """Return the observation, or raise what the step raised; `step_timeout` after `remaining` seconds."""
        try:
            return self.result(max(0.0, remaining))
        except TimeoutError:
            if self.done():  # just now
                return self.result()
        fate = "was cancelled" if not runs_late and self.cancel() else "will still run to its end"
        raise Refusal("step_timeout", f"the step did not finish within {timeout:g} s; it {fate}")


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


class PhysicsThread(ABC):
    """Iterates under the lock of a simulation until it is closed; a subclass says what an iteration does.

    Attributes:
        lock: Guards the simulation; the thread holds it except while an iteration waits for `_wake`.
    """

    def __init__(self, model: mujoco.MjModel, lock: DataLock, health: Health) -> None:
        self.lock: DataLock = lock
        self._model = model
        self._wake = threading.Condition(lock.inner)
        self._stopping = False
        self._death: str | None = None
        self._thread = health.thread("urlab-physics", self._run, on_death=self._die)

    def start(self) -> Self:
        """Start the thread and return self."""
        _mujoco_warnings.acquire()
        atexit.register(self.close, 1.0)  # a thread inside MuJoCo must not meet the interpreter's end
        self._thread.start()
        return self

    def close(self, timeout: float = 1.0) -> bool:
        """End the thread between two sub-steps, and release every waiting step with `shutting_down`. Idempotent.

        Returns:
            False when physics was still busy after `timeout`, for example inside one very long `mj_step`.
        """
        first, self._stopping = not self._stopping, True
        deadline = time.monotonic() + timeout
        idle = within(timeout / 2.0, lambda seconds: self.lock.inner.acquire(timeout=seconds))
        if not idle:
            # The result is no longer needed, so the solver stops at its next iteration.
            self._model.opt.tolerance = self._model.opt.noslip_tolerance = math.inf
            idle = within(timeout / 2.0, lambda seconds: self.lock.inner.acquire(timeout=seconds))
        if idle:
            self._wake.notify_all()
            self.lock.inner.release()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            idle = ended(self._thread, deadline - time.monotonic()) and idle
        if first and self._thread.ident is not None:
            _mujoco_warnings.release()
            atexit.unregister(self.close)
        if not idle:
            logger.warning("physics did not stop within %g s", timeout)
        return idle

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    @abstractmethod
    def _iterate(self) -> None:
        """Do the pending work, or wait for `_wake`."""

    @abstractmethod
    def _fail(self, error: Exception) -> Refusal:
        """Note an error of an iteration, after which the thread continues, and return the refusal that reports it."""

    @abstractmethod
    def _drop_queue(self, refusal: Refusal) -> None:
        """Refuse the requests that still wait."""

    def _run(self) -> None:
        with self.lock.inner:
            while not self._stopping:
                try:
                    self._iterate()
                except Exception as error:  # noqa: BLE001 - the thread must outlive any error of a step
                    self._fail(error)
            self._drop_queue(shutting_down())

    def _die(self, reason: str) -> None:
        with self.lock.inner:
            self._death = reason
            self._drop_queue(Refusal("internal_error", reason))


class LivePacing:
    """Keeps the iterations of live mode on a grid of time slots."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._speed = MAX_SPEED
        self._slot = -math.inf
        self._last_rest = -math.inf

    @property
    def speed(self) -> float:
        return float32(min(max(self._speed, MIN_SPEED), MAX_SPEED))

    @speed.setter
    def speed(self, percent: float) -> None:
        self._speed = float(percent)

    def restart(self) -> None:
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
