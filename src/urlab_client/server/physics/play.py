"""The lifecycle of a play session: off, compiling, ready or failed, and the simulation while it is ready.

For the `sim` handlers, which start and stop it, and for the handlers that need a running simulation. Compilation runs
in a separate thread, so that the caller can stop waiting for it.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import CancelledError, Future
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from urlab_client.enums import PIEState
from urlab_client.errors import UNCLAIMED
from urlab_client.protocol.messages.cameras import CameraDelayInForce
from urlab_client.server.compile.scene import CompiledScene
from urlab_client.server.limits import Limits
from urlab_client.server.physics.engine import Engine
from urlab_client.server.physics.observe import Observer, UserChannels
from urlab_client.server.physics.options import OptionOverrides
from urlab_client.server.physics.replay import ReplaySessions
from urlab_client.server.physics.reply_template import StepReplies
from urlab_client.server.refusal import CompileFailed, Refusal
from urlab_client.server.render.camera_renderer import CameraRenderer
from urlab_client.server.system.threads import Health


@dataclass(slots=True)
class _Claim:
    owner: str
    ttl_s: float
    touched: float


class ControlClaims:
    """The owners of the robots, by key. Robots are unclaimed at first, and unclaimed robots accept no writes."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._claims: dict[str, _Claim] = {}

    def owner(self, key: str) -> str:
        claim = self._claims.get(key)
        if claim is not None and 0 < claim.ttl_s < self._clock() - claim.touched:
            del self._claims[key]
            claim = None
        return UNCLAIMED if claim is None else claim.owner

    def claim(self, key: str, owner: str, ttl_s: float, *, force: bool) -> None:
        holder = self.owner(key)
        if holder not in (UNCLAIMED, owner) and not force:
            raise Refusal("control_claimed", f"'{key}' belongs to '{holder}'", owner=holder)
        self._claims[key] = _Claim(owner, ttl_s, self._clock())

    def release(self, key: str, owner: str) -> None:
        """Release the claim on a robot."""
        self.check(key, owner)
        del self._claims[key]

    def check(self, key: str, owner: str) -> None:
        """Refuse a write to a robot by anybody but its owner, and renew the claim."""
        holder = self.owner(key)
        if holder != owner:
            status = "is unclaimed: claim it first" if holder == UNCLAIMED else f"belongs to '{holder}'"
            raise Refusal("not_control_owner", f"articulation '{key}' {status}", owner=holder)
        self._claims[key].touched = self._clock()

    def check_all(self, keys: Iterable[str], owner: str) -> None:
        """Refuse a write to robots of which another client owns one."""
        for key in keys:
            holder = self.owner(key)
            if holder not in (UNCLAIMED, owner):
                raise Refusal("not_control_owner", f"articulation '{key}' belongs to '{holder}'", owner=holder)


logger: logging.Logger = logging.getLogger("urlab_client.server")

MAX_WAIT_S: Final = 86400.0


class Running:
    """A simulation that is ready."""

    def __init__(
        self,
        engine: Engine,
        cameras: CameraRenderer,
        channels: UserChannels,
        files: Sequence[Path],
        limits: Limits,
    ) -> None:
        self.engine: Engine = engine
        self.cameras: CameraRenderer = cameras
        self.channels: UserChannels = channels
        self.scene: CompiledScene = engine.scene
        controls, dialect = engine.articulations.controls, engine.dialect
        self.observer: Observer = Observer(self.scene, controls, channels)
        self.claims: ControlClaims = ControlClaims()
        self.step_replies: StepReplies = StepReplies(self.scene, controls, dialect)
        self.options: OptionOverrides = OptionOverrides(self.scene.model, limits, dialect)
        self.sessions: ReplaySessions = ReplaySessions(self.scene, files, limits)

    def mjb(self) -> bytes:
        """Return the model in MuJoCo's binary format, without variations. The caller holds the engine's lock."""
        variation = self.engine.variation
        return self.scene.mjb() if variation is None else variation.mjb()

    def delay_cameras(self, wanted: Mapping[str, tuple[CameraDelayInForce, int]]) -> None:
        """Set latencies of cameras, with the seeds of their jitter, by `ARTICULATION/CAMERA`."""
        hooks = self.engine.snapshots.hooks
        with self.engine.lock:
            for key, (settings, seed) in wanted.items():
                self.cameras.delay(key, settings, seed)
            if self._see in hooks:
                hooks.remove(self._see)
            if self.cameras.delays:
                hooks.append(self._see)
                self._see()

    def _see(self) -> None:
        self.cameras.see(self.engine.snapshots.number, self.engine.snapshots.episode)

    def close(self, timeout: float = 1.0) -> bool:
        """Stop within about `timeout` seconds; return False if a thread was still busy then."""
        deadline = time.monotonic() + timeout
        drawn = self.cameras.close(timeout / 2.0)
        ended = self.engine.close(max(0.0, deadline - time.monotonic()))
        if ended and self.engine.variation is not None:
            self.engine.variation.restore()  # the same scene may be played again
        return ended and drawn


class Play:
    """The play session of a server: at most one at a time. Safe to use from several threads.

    Attributes:
        listeners: Callbacks invoked in order, with the simulation when it is ready and with None when it ends; they
            must not block.
        current: The running simulation, or None.
    """

    def __init__(self, health: Health) -> None:
        self._health = health
        self.listeners: list[Callable[[Running | None], None]] = []
        self._lock = threading.Lock()
        self.current: Running | None = None
        self._attempt: Future[None] | None = None
        self._closing = False

    @property
    def state(self) -> PIEState:
        """`OFF`, `COMPILING`, `COMPILE_FAILED` or `READY`."""
        attempt = self._attempt
        if attempt is None:
            return PIEState.OFF
        if self.current is not None:
            return PIEState.READY
        return PIEState.COMPILE_FAILED if attempt.done() else PIEState.COMPILING

    @property
    def compile_error(self) -> str:
        """MuJoCo's message in state `COMPILE_FAILED`, otherwise empty."""
        attempt = self._attempt
        error = None if attempt is None or not attempt.done() or attempt.cancelled() else attempt.exception()
        return "" if error is None else str(error)

    @property
    def manager_present(self) -> bool:
        """Whether a play session runs, compiled or not."""
        return self._attempt is not None

    def running(self) -> Running:
        """Return the simulation; refuse with `not_ready` and the reason if none is running."""
        running = self.current
        if running is None:
            error = self.compile_error
            why = f"the model did not compile: {error}" if error else "the model is still being compiled"
            raise Refusal("not_ready", why)
        return running

    def begin(self, build: Callable[[], Running]) -> None:
        """Start play in a separate thread, replacing the previous session.

        Args:
            build: Compiles and starts the simulation. Must not access state that the caller may change meanwhile.
        """
        self.stop()
        self._attempt = attempt = Future[None]()

        def die(reason: str) -> None:
            attempt.set_exception(CompileFailed(reason))

        self._health.thread("urlab-compile", self._build, attempt, build, on_death=die).start()

    def wait(self, timeout_s: float) -> PIEState:
        """Wait until compilation has ended and return the state.

        Args:
            timeout_s: Seconds to wait; afterwards the state is `TIMEOUT`, and compilation continues.
        """
        # NaN compares false, so it does not wait.
        wait_s = min(timeout_s, MAX_WAIT_S) if timeout_s > 0.0 else 0.0
        attempt = self._attempt
        if attempt is not None:
            with contextlib.suppress(TimeoutError, CancelledError):
                attempt.exception(wait_s)
        if self._closing:
            raise Refusal("shutting_down", "the server is stopping")
        state = self.state
        return PIEState.TIMEOUT if state is PIEState.COMPILING else state

    def stop(self) -> None:
        """End play; a compilation in progress finishes in the background, and its result is discarded."""
        with self._lock:
            attempt, self._attempt = self._attempt, None
            running, self.current = self.current, None
            if attempt is not None:
                attempt.cancel()
                self._announce(None)
        if running is not None:
            running.close()

    def close(self, timeout: float) -> bool:
        """End play permanently and refuse waiting callers with `shutting_down`; return False if it was still busy."""
        with self._lock:
            self._closing = True
            if self._attempt is not None:
                self._attempt.cancel()
        running = self.current
        return running is None or running.close(timeout)

    def _build(self, attempt: Future[None], build: Callable[[], Running]) -> None:
        running: Running | None = None
        failure: BaseException | None = None
        try:
            running = build()
        except BaseException as error:  # noqa: BLE001 - a caller that waits for the start must not hang
            failure = error
        try:
            with self._lock:
                if not attempt.set_running_or_notify_cancel():
                    return
                if running is not None:
                    try:
                        self._announce(running)
                    except Exception as error:  # noqa: BLE001 - likewise
                        failure = error
                        self._announce(None)
                if failure is None:
                    self.current, running = running, None
                elif not isinstance(failure, CompileFailed):
                    logger.error("play could not be started", exc_info=failure)
                    text = f"the server failed with {type(failure).__name__}: {failure}; its log has the details"
                    failure = CompileFailed(text)
                attempt.set_exception(failure)
        finally:
            if running is not None:
                running.close()

    def _announce(self, running: Running | None) -> None:
        for listener in self.listeners:
            listener(running)
