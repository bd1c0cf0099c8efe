"""The lifecycle of a play session: off, compiling, ready or failed, and the simulation while it is ready.

For the `sim` handlers, which start and stop it, and for the handlers that need a running simulation. Compilation runs
in a separate thread, so that the caller can stop waiting for it.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
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
_DEFAULT_LIMITS: Final = Limits()


@dataclass(frozen=True)
class Running:
    """A simulation that is ready."""

    scene: CompiledScene
    engine: Engine
    observer: Observer
    cameras: CameraRenderer
    recordings: Sequence[Path] = ()
    limits: Limits = _DEFAULT_LIMITS
    channels: UserChannels = field(default_factory=lambda: UserChannels({}))

    def mjb(self) -> bytes:
        """Return the model in MuJoCo's binary format, without variations. The caller holds the engine's lock."""
        variation = self.engine.variation
        return self.scene.mjb() if variation is None else variation.mjb()

    @cached_property
    def claims(self) -> ControlClaims:
        return ControlClaims()

    @cached_property
    def step_replies(self) -> StepReplies:
        return StepReplies(self.scene, self.engine.articulations.controls, self.engine.dialect)

    @cached_property
    def options(self) -> OptionOverrides:
        return OptionOverrides(self.scene.model, self.limits, self.engine.dialect)

    @cached_property
    def sessions(self) -> ReplaySessions:
        return ReplaySessions(self.scene, self.recordings, self.limits)

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


class _Attempt:
    """One start of play, from the request to its end."""

    def __init__(self) -> None:
        self.running: Running | None = None
        self.error: str | None = None
        self.abandoned = False

    @property
    def state(self) -> PIEState:
        if self.running is not None:
            return PIEState.READY
        return PIEState.COMPILING if self.error is None else PIEState.COMPILE_FAILED


class Play:
    """The play session of a server: at most one at a time. Safe to use from several threads.

    Attributes:
        listeners: Callbacks invoked in order, with the simulation when it is ready and with None when it ends; they
            must not block.
    """

    def __init__(self, health: Health) -> None:
        self._health = health
        self.listeners: list[Callable[[Running | None], None]] = []
        self._changed = threading.Condition()
        self._attempt: _Attempt | None = None
        self._closing = False

    @property
    def state(self) -> PIEState:
        """`OFF`, `COMPILING`, `COMPILE_FAILED` or `READY`."""
        attempt = self._attempt
        return PIEState.OFF if attempt is None else attempt.state

    @property
    def compile_error(self) -> str:
        attempt = self._attempt
        return "" if attempt is None or attempt.error is None else attempt.error

    @property
    def manager_present(self) -> bool:
        """Whether a play session runs, compiled or not."""
        return self._attempt is not None

    @property
    def current(self) -> Running | None:
        attempt = self._attempt
        return None if attempt is None else attempt.running

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
        attempt = _Attempt()

        def die(reason: str) -> None:
            with self._changed:
                attempt.error = reason
                self._changed.notify_all()

        with self._changed:
            self._attempt = attempt
        self._health.thread("urlab-compile", self._build, attempt, build, on_death=die).start()

    def wait(self, timeout_s: float) -> PIEState:
        """Wait until compilation has ended and return the state.

        Args:
            timeout_s: Seconds to wait; afterwards the state is `TIMEOUT`, and compilation continues.
        """
        # NaN compares false, so it does not wait.
        wait_s = min(timeout_s, MAX_WAIT_S) if timeout_s > 0.0 else 0.0
        with self._changed:
            self._changed.wait_for(lambda: self._closing or self.state is not PIEState.COMPILING, wait_s)
            if self._closing:
                raise Refusal("shutting_down", "the server is stopping")
            return PIEState.TIMEOUT if self.state is PIEState.COMPILING else self.state

    def stop(self) -> None:
        """End play; a compilation in progress finishes in the background, and its result is discarded."""
        with self._changed:
            attempt, self._attempt = self._attempt, None
            if attempt is not None:
                attempt.abandoned = True
                self._announce(None)
        if attempt is not None and attempt.running is not None:
            attempt.running.close()

    def close(self, timeout: float) -> bool:
        """End play permanently and refuse waiting callers with `shutting_down`.

        Returns:
            False if it was still busy then.
        """
        with self._changed:
            self._closing = True
            attempt = self._attempt
            if attempt is not None:
                attempt.abandoned = True
            self._changed.notify_all()
        running = self.current
        return running is None or running.close(timeout)

    def _build(self, attempt: _Attempt, build: Callable[[], Running]) -> None:
        running: Running | None = None
        error = ""
        try:
            running = build()
        except CompileFailed as failure:
            error = failure.message
        except BaseException as failure:  # noqa: BLE001 - a caller that waits for the start must not hang
            error = _unexpected(failure)
        try:
            with self._changed:
                if not attempt.abandoned:
                    if running is not None:
                        try:
                            self._announce(running)
                        except Exception as failure:  # noqa: BLE001 - likewise
                            error = _unexpected(failure)
                            self._announce(None)
                        else:
                            attempt.running, running = running, None
                    if attempt.running is None:
                        attempt.error = error
                self._changed.notify_all()
        finally:
            if running is not None:
                running.close()

    def _announce(self, running: Running | None) -> None:
        for listener in self.listeners:
            listener(running)


def _unexpected(failure: BaseException) -> str:
    """Log why play could not be started, and return the message for clients."""
    logger.error("play could not be started", exc_info=failure)
    return f"the server failed with {type(failure).__name__}: {failure}; its log has the details"
