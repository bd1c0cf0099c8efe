"""The physics of one play session: a thread, its clock, the step modes and what they do to `mjData`.

For the op handlers, which call the methods here and hold `Engine.lock` while they touch the data themselves. Knows
nothing of sessions, replies or transports.
"""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from collections.abc import Callable, Collection, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Final, TypeVar

import mujoco

from urlab_client.enums import StepMode
from urlab_client.protocol.messages.session import Step
from urlab_client.server.compile.scene import CompiledScene
from urlab_client.server.dialects import ALPHA, Dialect
from urlab_client.server.physics.articulations import Articulations
from urlab_client.server.physics.controllers import ArticulationControl
from urlab_client.server.physics.replay import Player
from urlab_client.server.physics.scheduling import (
    GIVE_WAY_S,
    IDLE_S,
    DataLock,
    LivePacing,
    MujocoCall,
    Overdue,
    PhysicsThread,
    QueuedStep,
    busy,
    shutting_down,
)
from urlab_client.server.physics.variation import SceneVariation
from urlab_client.server.refusal import Refusal
from urlab_client.server.system.threads import Health
from urlab_client.simulation.controller_config import ControllerConfig

logger: logging.Logger = logging.getLogger("urlab_client.server")

T = TypeVar("T")

Hook = Callable[[], None]

SLICE_S: Final = 0.05
"""About how long a direct request integrates between two looks at the stop flag."""

MAX_SLICE: Final = 1000
"""Sub-steps in such a slice at most, for models that get slower while they run."""

INLINE_SHARE: Final = 0.02
"""A direct step expected to take less than this share of the step timeout runs on the calling thread."""


def call_hooks(hooks: list[Hook]) -> None:
    """Call each hook; one that raises is logged and removed."""
    for hook in tuple(hooks):
        try:
            hook()
        except Exception:
            logger.exception("%r failed and will not be called again", hook)
            if hook in hooks:
                hooks.remove(hook)


@dataclass(eq=False)
class Snapshots:
    """Numbers the snapshots of the state.

    Attributes:
        number: Number of the newest snapshot.
        episode: Number of resets so far.
        hooks: Called for each snapshot and at each reset. One that raises is logged and removed.
    """

    number: int = 0
    episode: int = 0
    hooks: list[Hook] = field(default_factory=list[Hook])

    def take(self) -> None:
        self.number += 1
        call_hooks(self.hooks)

    def restart(self) -> None:
        self.episode += 1
        call_hooks(self.hooks)


class Engine(PhysicsThread):
    """Owns the stepping of a compiled scene.

    One thread integrates in live mode and serves queued direct steps. A direct step that is short and meets neither a
    queue nor a pause runs on the calling thread instead, under the same lock: the result is the same and two thread
    hand-overs are saved. Between requests a direct or puppet session changes nothing in the data, so replies depend on
    the requests alone.

    Attributes:
        lock: Guards the model, the data and this object. Re-entrant. `with engine.lock` raises a `not_ready` refusal
            when physics holds it for longer than the step timeout. Do not hold it while calling `step` or `close`,
            which may have to wait for the physics thread.
        mode: The active step mode. Call `set_mode` to change it.
        pinned_mode: The mode that cannot be left, or None.
        paused: Whether physics is paused. Call `set_paused` to change it.
        step_count: Sub-steps (direct) and pushes (puppet) since the last handshake or reset; live steps do not count.
        fault: What stopped physics, or None. Cleared by a reset, by unpausing and by a change of mode.
        replay: What plays in place of physics in a stepped mode, or None.
        articulations: The articulations with their set-points, by their names in requests and replies.
        snapshots: Numbers the states: one for each request that steps, and for each live iteration that moves.
        on_substep: Called under the lock after each integration step and each puppet push.
        on_tick: Called under the lock after each live iteration (also while paused) and each direct request, and about
            ten times a second while a stepped mode idles. A hook of either list that raises is logged and removed.
        step_wanted: Returns, after a direct request, whether to call `on_tick` for it; always True by default.
        seed: The last `reset` seed, or None; MuJoCo does not use it.
        variation: Variations applied at each reset, or None. Set before `start`.
    """

    def __init__(
        self,
        scene: CompiledScene,
        *,
        pinned_mode: StepMode | None = None,
        paused: bool = True,
        controllers: Mapping[str, ControllerConfig] = MappingProxyType({}),
        step_timeout_s: float = 5.0,
        health: Health | None = None,
        dialect: Dialect = ALPHA,
    ) -> None:
        """Prepare a scene for stepping; `start` starts the physics thread.

        Args:
            pinned_mode: Start in this mode and refuse `set_mode`; None or `auto` starts live and leaves it free.
            controllers: Controller to attach by articulation key; `*` means all keys not listed.
            step_timeout_s: Seconds after which a direct step that has not finished raises `step_timeout`.
        """
        self._call = MujocoCall(step_timeout_s)
        super().__init__(scene.model, DataLock(step_timeout_s, self._call), Health() if health is None else health)
        self.scene = scene
        self.dialect = dialect
        self.on_tick: list[Hook] = []
        self.step_wanted: Callable[[], bool] = lambda: True
        self.seed: int | None = None
        self._data = scene.data
        self.articulations: Articulations = Articulations(scene, controllers, dialect)
        self.variation: SceneVariation | None = None
        self.on_substep: list[Hook] = []
        self._substep_s = math.inf  # what a sub-step of the newest slice took
        self._pacing = LivePacing(scene.model)
        self.pinned_mode: StepMode | None = None if pinned_mode is StepMode.AUTO else pinned_mode
        self.mode: StepMode = self.pinned_mode or StepMode.LIVE
        self.paused: bool = paused
        self.step_count: int = 0
        self.snapshots: Snapshots = Snapshots()
        self._live_pushed: list[int] = []
        self.fault: str | None = None
        self.replay: Player | None = None
        self._step_timeout_s = step_timeout_s
        self._inline_budget_s = INLINE_SHARE * step_timeout_s
        self._queue: deque[QueuedStep[Any]] = deque()
        self._tick_due = False
        self._last_tick = -math.inf

    @property
    def speed(self) -> float:
        """Pacing of live mode in force, percent of real time, 5 to 100, a float32."""
        return self._pacing.speed

    @property
    def time(self) -> float:
        return float(self._data.time)

    @property
    def overdue(self) -> Overdue | None:
        return self._call.overdue

    def begin_replay(self, make: Callable[[], Player]) -> None:
        """Reset data and set-points, unpause, and from now on let steps play instead of integrating."""
        with self.lock:
            self.reset()
            self.articulations.zero_set_points()
            self.replay = make()
            self._set_paused(False)

    def end_replay(self) -> None:
        with self.lock:
            self.replay = None

    def step(self, request: Step, observe: Callable[[StepMode], T]) -> T:
        """Execute a `step` in the active mode and return the result of `observe` for the state after it.

        Live and auto: stage commands and observe immediately. Direct: stage, apply the wrenches and integrate
        `n_steps` times without interruption. Puppet: write the state and run `mj_forward`.

        Args:
            request: The request; the caller handles its `observations` and `include_cameras`.
            observe: Callback invoked with the mode in the same critical section, on the thread that did the work.

        Raises:
            Refusal: `step_timeout` if a direct step did not finish in time (it stays queued and runs later),
                `shutting_down`, or `not_ready` with MuJoCo's text after a physics error.
        """
        deadline = time.monotonic() + self._step_timeout_s
        if not self.lock.acquire():
            if self.mode is not StepMode.DIRECT:
                raise busy()
            return self._await(self._queued(request, observe), 0.0)
        try:
            mode = self.mode
            if self._stopping:
                raise shutting_down()
            if self._death is not None:
                raise Refusal("internal_error", self._death)
            if mode is StepMode.PUPPET:
                self._push(request)
                return observe(mode)
            if self.fault is not None:
                raise Refusal("not_ready", self.fault)
            if mode is not StepMode.DIRECT:
                commands = request.per_articulation or {}
                if self.dialect.live_commands:
                    self._live_pushed += self.articulations.apply_wrenches(commands)
                    commands = self.articulations.write_raw(commands)
                    self.articulations.stage_named(commands)
                self.articulations.stage_positional(commands)
                self._kick()
                return observe(mode)
            n_steps = max(1, request.n_steps)
            if not self.paused and not self._queue and n_steps * self._substep_s <= self._inline_budget_s:
                self._tick_if_due()
                self._run_direct(request)
                result = observe(mode)
                if self._tick_due:
                    self._wake.notify()
                return result
            queued = self._queued(request, observe)
            self._wake.notify()
        finally:
            self.lock.inner.release()
        return self._await(queued, deadline - time.monotonic())

    def _queued(self, request: Step, observe: Callable[[StepMode], T]) -> QueuedStep[T]:
        queued = QueuedStep(request, observe)
        self._queue.append(queued)
        return queued

    def _await(self, queued: QueuedStep[T], remaining: float) -> T:
        return queued.wait(remaining, self._step_timeout_s, runs_late=self.dialect.late_steps)

    def reset(
        self,
        *,
        keyframe_name: str | None = None,
        seed: int | None = None,
        per_articulation_qpos: Mapping[str, Mapping[str, float]] | None = None,
    ) -> None:
        """Reset the data, override joints, run `mj_forward` and set the step counter to 0.

        Staged set-points, twists, gains, mode and pause stay.

        Args:
            keyframe_name: Compiled keyframe name; None or empty resets to `qpos0`.
            seed: Remembered, also when the keyframe turns out to be unknown; decides what varies, if anything does.
            per_articulation_qpos: First coordinate of a joint (m or rad) by articulation key and joint name, with or
                without prefix; unknown keys and joints are ignored.
        """
        with self.lock:
            if seed is not None:
                self.seed = seed
            key = -1
            if keyframe_name:
                key = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_KEY, keyframe_name)
                if key < 0:
                    raise Refusal("unknown_keyframe", keyframe_name)
            self._tick_if_due()
            try:
                self._reset_data(key, seed)
                self.articulations.override_joints(per_articulation_qpos or {})
                self._forward()
            except Exception as error:
                raise self._fail(error) from error
            self.step_count = 0
            self.snapshots.restart()
            self.fault = None
            self._kick()

    def _reset_data(self, key: int, seed: int | None) -> None:
        """Reset the data to a keyframe; -1 stands for the reference. The seed decides what varies."""
        if self.variation is not None:
            self.variation.begin(seed)
        if key < 0:
            mujoco.mj_resetData(self._model, self._data)
        else:
            mujoco.mj_resetDataKeyframe(self._model, self._data, key)
        if self.variation is not None:
            self.variation.start()

    def forward(self) -> None:
        with self.lock:
            self._tick_if_due()
            try:
                self._forward()
            except Exception as error:
                raise self._fail(error) from error

    def set_mode(self, mode: StepMode) -> tuple[StepMode, StepMode]:
        """Switch the step mode and return the previous and the current one.

        The active mode again changes nothing. A real change drops queued steps, whose callers get `step_timeout`, and
        unpauses unless the new mode is live. `auto` behaves as live.
        """
        with self.lock:
            if self.pinned_mode is not None:
                raise Refusal("mode_locked_by_server", f"this server is pinned to step mode '{self.pinned_mode}'")
            previous = self.mode
            if mode is not previous:
                self._tick_if_due()
                self._drop_queue(Refusal("step_timeout", f"the step was dropped by a switch to step mode '{mode}'"))
                self.mode = mode
                self.replay = None
                if mode is not StepMode.LIVE:
                    self._set_paused(False)
                self._pacing.restart()
                self._wake.notify()
            return previous, mode

    def set_paused(self, paused: bool) -> bool:
        """Pause or resume physics and return the state in force. Resuming retries after a fault."""
        with self.lock:
            self._set_paused(paused)
            return self.paused

    def set_sim_speed(self, percent: float) -> float:
        """Set the pacing of live mode, percent of real time, and return the value in force, clamped to 5..100."""
        with self.lock:
            self._pacing.speed = percent
            self._wake.notify()
            return self.speed

    @contextmanager
    def commanding(self) -> Generator[Articulations]:
        """Hold the lock while set-points or controllers change; a paused live loop applies them immediately."""
        with self.lock:
            yield self.articulations
            self._kick()

    def reset_step_count(self) -> None:
        with self.lock.look():
            self.step_count = 0

    # What follows runs under the lock.

    def _set_paused(self, paused: bool) -> None:
        if self.paused and not paused:
            self._pacing.restart()
            self.fault = None
        self.paused = paused
        self._wake.notify()

    def _kick(self) -> None:
        """Have a paused live loop, which may be asleep, take over changed set-points now."""
        if self.paused:
            self._pacing.restart()
            self._wake.notify()

    def _play(self, player: Player, n_steps: int) -> None:
        self._tick_if_due()
        n_steps = max(1, n_steps)
        try:
            with self._call:
                player.advance(n_steps)
        except Exception as error:
            raise self._fail(error) from error
        self._count(n_steps)

    def _run_direct(self, request: Step) -> None:
        if self.replay is not None:
            self._play(self.replay, request.n_steps)
            return
        commands = request.per_articulation
        raw: Collection[ArticulationControl] = ()
        pushed: list[int] = []
        if commands:
            self.articulations.stage_positional(commands)
            raw = self.articulations.stage_named(commands)
            pushed = self.articulations.apply_wrenches(commands)
        n_steps = max(1, request.n_steps)
        try:
            self._advance(n_steps, raw)
        except Refusal:
            raise
        except Exception as error:
            raise self._fail(error) from error
        finally:
            self.articulations.clear_wrenches(pushed)
        self._count(n_steps)

    def _advance(self, n_steps: int, raw: Collection[ArticulationControl]) -> None:
        """Integrate a direct step, in slices short enough to stop between two of them."""
        mj_step, model, data = mujoco.mj_step, self._model, self._data
        apply_controls = self.articulations.apply_controls
        every_substep = self.on_substep or self.articulations.any_controlled(raw)
        if not every_substep:
            apply_controls(raw)
        while n_steps > 0:
            if self._stopping:
                raise shutting_down()
            count = min(n_steps, MAX_SLICE, max(1, int(SLICE_S / self._substep_s)))
            started = time.perf_counter()
            with self._call:
                if every_substep:
                    for _ in range(count):
                        apply_controls(raw)
                        mj_step(model, data)
                        call_hooks(self.on_substep)
                else:
                    mj_step(model, data, count)
            self._substep_s = max((time.perf_counter() - started) / count, 1e-9)
            n_steps -= count

    def _forward(self) -> None:
        with self._call:
            mujoco.mj_forward(self._model, self._data)

    def _count(self, n_steps: int) -> None:
        self.step_count += n_steps
        self.snapshots.take()
        self._tick_due = bool(self.on_tick) and self.step_wanted()

    def _push(self, request: Step) -> None:
        if self.replay is not None:
            self._play(self.replay, request.n_steps)
            return
        self._tick_if_due()
        data = self._data
        try:
            for values, target in ((request.qpos, data.qpos), (request.qvel, data.qvel), (request.ctrl, data.ctrl)):
                if values is not None and len(values) == len(target):
                    target[:] = values
            data.time = request.time or 0.0
            self._forward()
        except Exception as error:
            raise self._fail(error) from error
        call_hooks(self.on_substep)
        self.step_count += 1
        self.snapshots.take()

    def _fail(self, error: Exception) -> Refusal:
        """Pause after a physics error and return the refusal that reports it."""
        self.fault = f"physics stopped: {' '.join(str(error).split())}"  # MuJoCo's texts span lines
        self.paused = True
        logger.error("physics stopped and is paused: %s", error, exc_info=error)
        return Refusal("not_ready", self.fault)

    def _drop_queue(self, refusal: Refusal) -> None:
        while self._queue:
            self._queue.popleft().drop(refusal)

    def _tick_if_due(self) -> None:
        """Publish the last direct step before its state is overwritten."""
        if self._tick_due:
            self._tick()

    def _tick(self) -> None:
        self._tick_due = False
        self._last_tick = time.perf_counter()
        call_hooks(self.on_tick)

    # The physics thread.

    def _iterate(self) -> None:
        if self.mode in (StepMode.LIVE, StepMode.AUTO):
            self._iterate_live()
        elif self.mode is StepMode.DIRECT and self._queue and not self.paused:
            self._tick_if_due()
            self._queue.popleft().run(self._run_direct)
        elif self._tick_due or (self.on_tick and time.perf_counter() - self._last_tick >= IDLE_S):
            self._tick()
        else:
            self._wake.wait(IDLE_S)

    def _iterate_live(self) -> None:
        if wait_s := self._pacing.take_slot(idle=self.paused and not self.on_tick):
            self._wake.wait(wait_s)
            self._pacing.rested()
            return
        self.articulations.apply_controls()
        if not self.paused:
            with self._call:
                mujoco.mj_step(self._model, self._data)
                call_hooks(self.on_substep)
            self.snapshots.take()
        self.articulations.clear_wrenches(self._live_pushed)
        self._live_pushed.clear()
        self._tick()
        if self._pacing.rest_due:
            self._wake.wait(GIVE_WAY_S)
            self._pacing.rested()
