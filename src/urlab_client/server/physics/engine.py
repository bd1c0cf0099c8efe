"""The physics of one play session: a thread, its clock, the step modes and what they do to `mjData`.

For the op handlers, which call the methods here and hold `Engine.lock` while they touch the data themselves. Knows
nothing of sessions, replies or transports.
"""

from __future__ import annotations

import atexit
import logging
import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Container, Generator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from types import MappingProxyType, TracebackType
from typing import Any, Final, Generic, Self, TypeVar, cast

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client._mujoco import reset_controls
from urlab_client.protocol.dialects import ALPHA, Dialect
from urlab_client.protocol.enums import StepMode
from urlab_client.protocol.messages.session import ArticulationCommand, Step
from urlab_client.server.compile.scene import ArticulationIndex, CompiledScene
from urlab_client.server.physics.controllers import ArticulationControl, ControllerConfig, ControlSource, Twist, float32
from urlab_client.server.physics.replay import Player
from urlab_client.server.refusal import Refusal
from urlab_client.server.system.health import Health
from urlab_client.server.system.thread_join import ended, within

__all__ = ["DataLock", "Engine", "Overdue", "parse_control_source", "parse_mode"]

logger = logging.getLogger("urlab_client.server")

T = TypeVar("T")
Hook = Callable[[], None]
Floats = NDArray[np.float64]

MIN_SPEED: Final = 5.0
MAX_SPEED: Final = 100.0

IDLE_S: Final = 0.1
"""Longest sleep of the physics thread while nothing integrates."""

MAX_LAG_S: Final = 0.02
"""A live step later than this is a stall and is not caught up; less is jitter and evens out."""

MIN_PERIOD_S: Final = 1e-5
MAX_PERIOD_S: Final = 3600.0

HOLD_S: Final = 0.005
"""A live loop that never sleeps because it is late lets go of the lock this often, for `GIVE_WAY_S`."""

GIVE_WAY_S: Final = 0.0005

SLICE_S: Final = 0.05
"""About how long a direct request integrates between two looks at the stop flag."""

MAX_SLICE: Final = 1000
"""Sub-steps in such a slice at most, for models that get slower while they run."""

LEAST_PATIENCE_S: Final = 1.0
"""A call of MuJoCo does not count as overdue before; a slice of a long request may take a while on a busy machine."""

INLINE_SHARE: Final = 0.02
"""A direct step expected to take less than this share of the step timeout runs on the calling thread."""


def parse_mode(text: str, dialect: Dialect = ALPHA) -> StepMode:
    """Return the step mode called `text`, in any case; `streaming` is another name of live, `auto` in newer dialects.

    Raises:
        Refusal: `bad_mode`.
    """
    name = text.casefold()
    try:
        mode = StepMode.LIVE if name == "streaming" else StepMode(name)
    except ValueError:
        raise Refusal("bad_mode", f"unknown step mode '{text}': use live, direct, puppet or auto") from None
    return StepMode.LIVE if mode is StepMode.AUTO and not dialect.auto_mode else mode


def parse_control_source(text: str) -> ControlSource:
    """Return the control source called `text`, in any case.

    Raises:
        Refusal: `bad_value`.
    """
    try:
        return ControlSource(text.casefold())
    except ValueError:
        raise Refusal("bad_value", f"unknown control source '{text}': use zmq or ui") from None


class Engine:
    """Owns the stepping of a compiled scene.

    One thread integrates in live mode and serves queued direct steps. A direct step that is short and meets neither a
    queue nor a pause runs on the calling thread instead, under the same lock: the result is the same and two thread
    hand-overs are saved. Between requests a direct or puppet session changes nothing in the data, so replies depend on
    the requests alone.

    Attributes:
        scene: The scene.
        lock: Guards the model, the data and this object. Re-entrant. `with engine.lock` raises a `not_ready` refusal
            when physics keeps it for longer than the step timeout. Not to be held while calling `step` or `close`,
            which may have to wait for the physics thread.
        dialect: What the server says in the way of one generation of the plugin.
        controls: Set-points, controller and twist of each articulation, by what it is called in requests and replies.
        names: What each articulation is called in requests and replies, by the key of its compiled names.
        frame_id: Number of the newest snapshot of the state; grows with each request that steps, and in live mode with
            each iteration that moves.
        on_substep: Called under the lock after each integration step and each puppet push.
        on_tick: Called under the lock after each live iteration (also while paused) and each direct request, and about
            ten times a second while a stepped mode idles. A hook of either list that raises is logged and removed.
        seed: The last `reset` seed, or None; MuJoCo has no use for it.
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
        """Prepare a scene for stepping; `start` sets it going.

        Args:
            scene: Compiled scene; the engine steps its `data` in place.
            pinned_mode: Start in this mode and refuse `set_mode`; None or `auto` starts live and leaves it free.
            paused: Whether physics starts paused.
            controllers: Controller to attach by articulation key; `*` stands for all keys not listed.
            step_timeout_s: Seconds a direct step may take before its caller is told `step_timeout`.
            health: Told when the physics thread dies.
            dialect: Decides what articulations are called, and what steps do besides.
        """
        self.scene = scene
        self.dialect = dialect
        self._call = _MujocoCall(max(step_timeout_s, LEAST_PATIENCE_S))
        self.lock = DataLock(step_timeout_s, self._call)
        self.on_substep: list[Hook] = []
        self.on_tick: list[Hook] = []
        self.seed: int | None = None
        self._model = scene.model
        self._data = scene.data
        self._qpos = self._data.qpos
        self._qvel = self._data.qvel
        self._ctrl = self._data.ctrl
        self._xfrc = self._data.xfrc_applied
        neutral = self._neutral_ctrl()
        everyone = controllers.get("*")
        self.controls: Mapping[str, ArticulationControl] = MappingProxyType(
            {
                name: ArticulationControl(
                    self._model,
                    index,
                    neutral,
                    controllers.get(index.key, everyone),
                    exact=not dialect.controls_float32,
                )
                for name, index in _named(scene, dialect)
            }
        )
        self._folded = _folded(self.controls, dialect)
        self._names = {control: name for name, control in self.controls.items()}
        self.names: Mapping[str, str] = {control.index.key: name for name, control in self.controls.items()}
        self._pinned = None if pinned_mode is StepMode.AUTO else pinned_mode
        self._mode = self._pinned or StepMode.LIVE
        self._paused = paused
        self._speed = 100.0
        self._step_count = 0
        self.frame_id = 0
        self._live_pushed: list[int] = []
        self._fault: str | None = None
        self._death: str | None = None
        self._health = Health() if health is None else health
        self._player: Player | None = None
        self._step_timeout_s = step_timeout_s
        self._inline_budget_s = INLINE_SHARE * step_timeout_s
        self._substep_s = math.inf
        self._queue: deque[_QueuedStep[Any]] = deque()
        self._tick_due = False
        self._last_tick = -math.inf
        self._slot = -math.inf
        self._last_rest = -math.inf
        self._wake = threading.Condition(self.lock.inner)
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="urlab-physics", daemon=True)

    def _neutral_ctrl(self) -> Floats:
        kept = self._ctrl.copy()
        reset_controls(self._model, self._data)
        neutral = self._ctrl.copy()
        self._ctrl[:] = kept
        return neutral

    def start(self) -> Self:
        """Start the physics thread and return self."""
        _mujoco_warnings.acquire()
        atexit.register(self.close)  # a thread inside MuJoCo must not meet the interpreter's end
        self._thread.start()
        return self

    def close(self, timeout: float = 1.0) -> bool:
        """Stop the physics thread and release every waiting step with `shutting_down`.

        A request under way ends between two sub-steps. Safe to call twice.

        Args:
            timeout: Seconds to wait.

        Returns:
            False when physics was still busy after `timeout`, for example inside one very long `mj_step`.
        """
        first, self._stopping = not self._stopping, True
        deadline = time.monotonic() + timeout
        idle = within(timeout / 2.0, lambda seconds: self.lock.inner.acquire(timeout=seconds))
        if not idle:
            # Whatever its solver still iterates for is no longer wanted: any improvement is too small to go on.
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

    @property
    def mode(self) -> StepMode:
        """The active step mode."""
        return self._mode

    @property
    def pinned_mode(self) -> StepMode | None:
        """The mode the server is pinned to, or None when `set_mode` is allowed."""
        return self._pinned

    @property
    def paused(self) -> bool:
        """Whether physics is paused."""
        return self._paused

    @property
    def speed(self) -> float:
        """Pacing of live mode in force, percent of real time, 5 to 100, a float32."""
        return float32(min(max(self._speed, MIN_SPEED), MAX_SPEED))

    @property
    def time(self) -> float:
        """`mjData.time`, seconds."""
        return float(self._data.time)

    @property
    def step_count(self) -> int:
        """Sub-steps (direct) and pushes (puppet) since the last handshake or reset; live steps do not count."""
        return self._step_count

    @property
    def fault(self) -> str | None:
        """What stopped physics, or None. Cleared by a reset, by unpausing and by a change of mode."""
        return self._fault

    @property
    def overdue(self) -> Overdue | None:
        """The call of MuJoCo that has not come back for longer than a step may take, or None."""
        return self._call.overdue

    @contextmanager
    def look(self) -> Generator[None]:
        """Hold the lock, or go without it while MuJoCo does not come back: for what no step changes.

        Raises:
            Refusal: `not_ready` when physics is busy, but comes back.
        """
        with ExitStack() as held:
            try:
                held.enter_context(self.lock)
            except Refusal:
                if self.overdue is None:
                    raise
            yield

    @property
    def replay(self) -> Player | None:
        """What plays in place of physics in a stepped mode, or None."""
        return self._player

    def begin_replay(self, make: Callable[[], Player]) -> None:
        """Reset data and set-points, unpause, and from now on let steps play instead of integrating.

        Args:
            make: Makes the player once the data are reset.

        Raises:
            Refusal: `not_ready` with MuJoCo's text.
        """
        with self.lock:
            self.reset()
            for control in self.controls.values():
                control.set_points.network[:] = 0.0
                control.set_points.ui[:] = 0.0
            self._player = make()
            self._set_paused(False)

    def end_replay(self) -> None:
        """Let steps integrate again; the state stays where the replay left it."""
        with self.lock:
            self._player = None

    def find(self, key: str) -> ArticulationControl | None:
        """Return the articulation with this key, preferring the exact spelling to another case; None if unknown."""
        control = self.controls.get(key)
        return self._folded.get(key.casefold()) if control is None else control

    def control(self, key: str) -> ArticulationControl:
        """Return the articulation with this key, in any case.

        Raises:
            Refusal: `unknown_articulation`.
        """
        control = self.find(key)
        if control is None:
            raise Refusal("unknown_articulation", key)
        return control

    def step(self, request: Step, observe: Callable[[StepMode], T]) -> T:
        """Do what a `step` means in the active mode and return what `observe` makes of the state after it.

        Live and auto: stage the positional `ctrl` and observe at once. Direct: stage, apply the wrenches and integrate
        `n_steps` times without anything else coming between. Puppet: write the state and run `mj_forward`.

        Args:
            request: The request; its `observations` and `include_cameras` are the caller's affair.
            observe: Called with the mode in the same critical section, on whatever thread did the work.

        Raises:
            Refusal: `step_timeout` when a direct step did not finish in time (it stays queued and runs later),
                `shutting_down`, or `not_ready` with MuJoCo's text after a physics error.
        """
        deadline = time.monotonic() + self._step_timeout_s
        if not self.lock.acquire():
            if self._mode is not StepMode.DIRECT:
                raise _busy()
            queued = _QueuedStep(request, observe)
            self._queue.append(queued)
            return self._await(queued, 0.0)
        try:
            mode = self._mode
            if self._stopping:
                raise _shutting_down()
            if self._death is not None:
                raise Refusal("internal_error", self._death)
            if mode is StepMode.PUPPET:
                self._push(request)
                return observe(mode)
            if self._fault is not None:
                raise Refusal("not_ready", self._fault)
            if mode is not StepMode.DIRECT:
                self._stage_positional(request)
                if self.dialect.live_commands:
                    commands = request.per_articulation or {}
                    self._stage_named(commands)
                    self._live_pushed += self._apply_wrenches(commands)
                self._kick()
                return observe(mode)
            n_steps = max(1, request.n_steps)
            if not self._paused and not self._queue and n_steps * self._substep_s <= self._inline_budget_s:
                self._tick_if_due()
                self._run_direct(request)
                result = observe(mode)
                if self._tick_due:
                    self._wake.notify()
                return result
            queued = _QueuedStep(request, observe)
            self._queue.append(queued)
            self._wake.notify()
        finally:
            self.lock.inner.release()
        return self._await(queued, deadline - time.monotonic())

    def _await(self, queued: _QueuedStep[T], remaining: float) -> T:
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
            seed: Remembered, also when the keyframe turns out to be unknown.
            per_articulation_qpos: First coordinate of a joint (m or rad) by articulation key and joint name, with or
                without prefix; unknown keys and joints are ignored.

        Raises:
            Refusal: `unknown_keyframe`, or `not_ready` with MuJoCo's text.
        """
        with self.lock:
            if seed is not None:
                self.seed = seed
            key = -1
            if keyframe_name:
                key = self._id(mujoco.mjtObj.mjOBJ_KEY, keyframe_name)
                if key < 0:
                    raise Refusal("unknown_keyframe", keyframe_name)
            self._tick_if_due()
            try:
                if key < 0:
                    mujoco.mj_resetData(self._model, self._data)
                else:
                    mujoco.mj_resetDataKeyframe(self._model, self._data, key)
                self._override_joints(per_articulation_qpos or {})
                self._forward()
            except Exception as error:
                raise self._fail(error) from error
            self._step_count = 0
            self._fault = None
            self._kick()

    def forward(self) -> None:
        """Run `mj_forward`; time and step counter stay.

        Raises:
            Refusal: `not_ready` with MuJoCo's text.
        """
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

        Raises:
            Refusal: `mode_locked_by_server`.
        """
        with self.lock:
            if self._pinned is not None:
                raise Refusal("mode_locked_by_server", f"this server is pinned to step mode '{self._pinned}'")
            previous = self._mode
            if mode is not previous:
                self._tick_if_due()
                self._drop_queue(Refusal("step_timeout", f"the step was dropped by a switch to step mode '{mode}'"))
                self._mode = mode
                self._player = None
                if mode is not StepMode.LIVE:
                    self._set_paused(False)
                self._slot = -math.inf
                self._wake.notify()
            return previous, mode

    def set_paused(self, paused: bool) -> bool:
        """Pause or resume physics and return the state in force. Resuming retries after a fault."""
        with self.lock:
            self._set_paused(paused)
            return self._paused

    def set_sim_speed(self, percent: float) -> float:
        """Set the pacing of live mode, percent of real time, and return the value in force, clamped to 5..100."""
        with self.lock:
            self._speed = float(percent)
            self._wake.notify()
            return self.speed

    def set_control_source(self, source: ControlSource, key: str | None = None) -> None:
        """Choose which set-points drive the articulation `key`, or all when None.

        Raises:
            Refusal: `unknown_articulation`.
        """
        with self.lock:
            chosen = list(self.controls.values()) if key is None else [self.control(key)]
            for control in chosen:
                control.set_points.source = source
            self._kick()

    def set_twist(self, key: str, linear: Sequence[float], angular: Sequence[float]) -> Twist:
        """Store a commanded twist (m/s, rad/s, base frame) and return it as stored.

        Raises:
            Refusal: `unknown_articulation`.
        """
        with self.lock:
            twist = self.control(key).twist
            twist.set(linear, angular)
            return twist

    def configure_controller(self, key: str, params: object) -> dict[str, Any]:
        """Change controller parameters, switch the controller on and return all parameters.

        Args:
            key: Articulation key.
            params: Parameter names to values; anything but a mapping changes nothing.

        Raises:
            Refusal: `unknown_articulation`, `no_controller`.
        """
        with self.lock:
            controller = self.control(key).controller
            if controller is None:
                raise Refusal("no_controller", f"articulation '{key}' has no controller attached")
            if isinstance(params, Mapping):
                controller.configure(cast("Mapping[str, object]", params))
            self._kick()
            return controller.params()

    def reset_step_count(self) -> None:
        """Set the step counter to 0, as a handshake does."""
        with self.look():
            self._step_count = 0

    def name(self, control: ArticulationControl) -> str:
        """Return what an articulation is called in requests and replies."""
        return self._names[control]

    # What follows runs under the lock.

    def _set_paused(self, paused: bool) -> None:
        if self._paused and not paused:
            self._slot = -math.inf
            self._fault = None
        self._paused = paused
        self._wake.notify()

    def _kick(self) -> None:
        """Have a paused live loop, which may be asleep, take over changed set-points now."""
        if self._paused:
            self._slot = -math.inf
            self._wake.notify()

    def _stage_positional(self, request: Step) -> None:
        for key, command in (request.per_articulation or {}).items():
            control = self.find(key)
            if control is not None and command.ctrl is not None:
                control.set_points.stage(command.ctrl)

    def _stage_named(self, commands: Mapping[str, ArticulationCommand]) -> set[ArticulationControl]:
        """Stage `ctrl_map` and return the articulations whose controller the request bypasses."""
        raw: set[ArticulationControl] = set()
        for key, command in commands.items():
            control = self.find(key)
            if control is None:
                continue
            if command.ctrl_map:
                control.set_points.stage_named(command.ctrl_map)
            if command.control_mode is not None and command.control_mode.casefold() == "raw":
                raw.add(control)
        return raw

    def _apply_wrenches(self, commands: Mapping[str, ArticulationCommand]) -> list[int]:
        """Write `xfrc_applied` and return the bodies concerned."""
        bodies: list[int] = []
        for key, command in commands.items():
            for name, wrench in (command.xfrc_applied or {}).items():
                body = self._id(mujoco.mjtObj.mjOBJ_BODY, f"{key}_{name}")
                if body < 0:
                    body = self._id(mujoco.mjtObj.mjOBJ_BODY, name)
                if body >= 0 and len(wrench) == 6:
                    self._xfrc[body] = wrench
                    bodies.append(body)
        return bodies

    def _apply_controls(self, raw: Container[ArticulationControl] = ()) -> None:
        for control in self.controls.values():
            control.apply(self._qpos, self._qvel, self._ctrl, raw=control in raw)

    def _play(self, player: Player, n_steps: int) -> None:
        self._tick_if_due()
        n_steps = max(1, n_steps)
        try:
            with self._call:
                player.advance(n_steps)
        except Exception as error:
            raise self._fail(error) from error
        self._step_count += n_steps
        self.frame_id += 1
        self._tick_due = bool(self.on_tick)

    def _run_direct(self, request: Step) -> None:
        if self._player is not None:
            self._play(self._player, request.n_steps)
            return
        commands = request.per_articulation or {}
        self._stage_positional(request)
        raw = self._stage_named(commands)
        pushed = self._apply_wrenches(commands)
        n_steps = max(1, request.n_steps)
        try:
            self._integrate(n_steps, raw)
        except Refusal:
            raise
        except Exception as error:
            raise self._fail(error) from error
        finally:
            if pushed:
                self._xfrc[pushed] = 0.0
        self._step_count += n_steps
        self.frame_id += 1
        self._tick_due = bool(self.on_tick)

    def _integrate(self, n_steps: int, raw: Container[ArticulationControl]) -> None:
        mj_step, model, data = mujoco.mj_step, self._model, self._data
        every_substep = self.on_substep or any(c.controlled(raw=c in raw) for c in self.controls.values())
        if not every_substep:
            self._apply_controls(raw)
        while n_steps > 0:
            if self._stopping:
                raise _shutting_down()
            count = min(n_steps, MAX_SLICE, max(1, int(SLICE_S / self._substep_s)))
            started = time.perf_counter()
            with self._call:
                if every_substep:
                    for _ in range(count):
                        self._apply_controls(raw)
                        mj_step(model, data)
                        _call(self.on_substep)
                else:
                    mj_step(model, data, count)
            self._substep_s = max((time.perf_counter() - started) / count, 1e-9)
            n_steps -= count

    def _push(self, request: Step) -> None:
        if self._player is not None:
            self._play(self._player, request.n_steps)
            return
        self._tick_if_due()
        for values, target in ((request.qpos, self._qpos), (request.qvel, self._qvel), (request.ctrl, self._ctrl)):
            if values is not None and len(values) == len(target):
                target[:] = values
        self._data.time = request.time or 0.0
        try:
            self._forward()
        except Exception as error:
            raise self._fail(error) from error
        _call(self.on_substep)
        self._step_count += 1
        self.frame_id += 1

    def _forward(self) -> None:
        with self._call:
            mujoco.mj_forward(self._model, self._data)

    def _override_joints(self, overrides: Mapping[str, Mapping[str, float]]) -> None:
        for key, joints in overrides.items():
            control = self.find(key)
            if control is None:
                continue
            for name, value in joints.items():
                joint = self._id(mujoco.mjtObj.mjOBJ_JOINT, f"{control.index.prefix}{name}")
                if joint < 0:
                    joint = self._id(mujoco.mjtObj.mjOBJ_JOINT, name)
                if joint >= 0:
                    self._qpos[self._model.jnt_qposadr[joint]] = value

    def _id(self, kind: int, name: str) -> int:
        return mujoco.mj_name2id(self._model, kind, name)

    def _fail(self, error: Exception) -> Refusal:
        """Pause after a physics error and return the refusal that tells of it."""
        self._fault = f"physics stopped: {' '.join(str(error).split())}"  # MuJoCo's texts span lines
        self._paused = True
        logger.error("physics stopped and is paused: %s", error, exc_info=error)
        return Refusal("not_ready", self._fault)

    def _drop_queue(self, refusal: Refusal) -> None:
        while self._queue:
            self._queue.popleft().fail(refusal)

    def _tick_if_due(self) -> None:
        """Show the publishers the last direct step before its state is gone."""
        if self._tick_due:
            self._tick()

    def _tick(self) -> None:
        self._tick_due = False
        self._last_tick = time.perf_counter()
        _call(self.on_tick)

    # The physics thread.

    def _run(self) -> None:
        with self.lock.inner:
            try:
                while not self._stopping:
                    try:
                        self._iterate()
                    except Exception as error:  # noqa: BLE001 - the thread must outlive any error of a step
                        self._fail(error)
                self._drop_queue(_shutting_down())
            except BaseException as error:  # noqa: BLE001 - who waits for a step must not wait for ever
                self._death = self._health.report(error)
                self._drop_queue(Refusal("internal_error", self._death))

    def _iterate(self) -> None:
        if self._mode in (StepMode.LIVE, StepMode.AUTO):
            self._iterate_live()
        elif self._mode is StepMode.DIRECT and self._queue and not self._paused:
            self._tick_if_due()
            self._serve(self._queue.popleft())
        elif self._tick_due or (self.on_tick and time.perf_counter() - self._last_tick >= IDLE_S):
            self._tick()
        else:
            self._wake.wait(IDLE_S)

    def _serve(self, queued: _QueuedStep[Any]) -> None:
        if not queued.begin():
            return
        try:
            self._run_direct(queued.request)
            queued.succeed()
        except Exception as error:  # noqa: BLE001 - raised again where the step was requested
            queued.fail(error)

    def _iterate_live(self) -> None:
        now = time.perf_counter()
        due = self._slot + self._period()
        if now < due:
            self._wake.wait(min(due - now, IDLE_S))
            self._last_rest = time.perf_counter()
            return
        self._slot = now if now - due > MAX_LAG_S else due
        self._apply_controls()
        if not self._paused:
            with self._call:
                mujoco.mj_step(self._model, self._data)
                _call(self.on_substep)
            self.frame_id += 1
        if self._live_pushed:
            self._xfrc[self._live_pushed] = 0.0
            self._live_pushed.clear()
        self._tick()
        if time.perf_counter() - self._last_rest > HOLD_S:
            self._wake.wait(GIVE_WAY_S)
            self._last_rest = time.perf_counter()

    def _period(self) -> float:
        """Seconds between two live iterations."""
        if self._paused and not self.on_tick:
            return IDLE_S
        period = float(self._model.opt.timestep) * 100.0 / self.speed
        return min(period, MAX_PERIOD_S) if period > MIN_PERIOD_S else MIN_PERIOD_S


@dataclass(frozen=True)
class Overdue:
    """A call of MuJoCo that takes longer than a step may.

    Attributes:
        thread: The thread that is in it.
        began_at: When it began, seconds of `time.perf_counter`.
        seconds: How long ago that is.
    """

    thread: threading.Thread
    began_at: float
    seconds: float


class _MujocoCall:
    """Which thread is inside MuJoCo, and since when. Entered under the engine's lock, looked at by everybody."""

    __slots__ = ("_patience_s", "_under_way")

    def __init__(self, patience_s: float) -> None:
        self._patience_s = patience_s
        self._under_way: tuple[threading.Thread, float] | None = None

    def __enter__(self) -> None:
        self._under_way = threading.current_thread(), time.perf_counter()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._under_way = None

    @property
    def overdue(self) -> Overdue | None:
        under_way = self._under_way
        if under_way is None:
            return None
        thread, began_at = under_way
        seconds = time.perf_counter() - began_at
        return Overdue(thread, began_at, seconds) if seconds > self._patience_s else None


class DataLock:
    """A re-entrant lock around model and data whose `with` gives up after a time.

    Attributes:
        inner: The lock itself, for the physics thread and for waits with deadlines of their own.
    """

    __slots__ = ("_call", "_timeout", "inner")

    def __init__(self, timeout: float, call: _MujocoCall) -> None:
        """Make a lock that nobody holds.

        Args:
            timeout: Seconds after which entering raises `Refusal` with `not_ready`: a step request may legally keep
                physics busy for hours, and no other request may hang for that.
            call: Tells when there is nothing to wait for.
        """
        self.inner = threading.RLock()
        self._timeout = timeout
        self._call = call

    def acquire(self) -> bool:
        """Take the lock, if it becomes free in time.

        Raises:
            Refusal: `not_ready`, at once, while MuJoCo does not come back.
        """
        if self.inner.acquire(blocking=False):
            return True
        overdue = self._call.overdue
        if overdue is not None:
            raise Refusal(
                "not_ready",
                f"physics has not come back from MuJoCo for {overdue.seconds:.0f} s: play goes on when it does, and "
                "stop_pie ends it",
            )
        return self.inner.acquire(timeout=self._timeout)

    def __enter__(self) -> None:
        if not self.acquire():
            raise _busy()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.inner.release()


class _QueuedStep(Generic[T]):
    """A direct step that waits for the physics thread."""

    def __init__(self, request: Step, observe: Callable[[StepMode], T]) -> None:
        self.request = request
        self._observe = observe
        self._settled = threading.Event()
        self._abandoned = False
        self._begun = False
        self._dropped = False
        self._lock = threading.Lock()
        self._results: list[T] = []
        self._error: Exception | None = None

    def begin(self) -> bool:
        """Return whether it is to be done; its caller may have been told that it will not be."""
        with self._lock:
            self._begun = True
            return not self._dropped

    def succeed(self) -> None:
        """Observe for the caller, if it still waits, and release it. The engine's lock is held."""
        if not self._abandoned:
            self._results.append(self._observe(StepMode.DIRECT))
        self._settled.set()

    def fail(self, error: Exception) -> None:
        """Release the caller with an error."""
        self._error = error
        self._settled.set()

    def wait(self, remaining: float, timeout: float, *, runs_late: bool) -> T:
        """Return the observation, or raise what the step raised.

        Args:
            remaining: Seconds until `step_timeout` is raised.
            timeout: Seconds since the request came in by then.
            runs_late: Whether it stays queued then although it has not begun.
        """
        if not self._settled.wait(max(0.0, remaining)):
            self._abandoned = True
            with self._lock:
                self._dropped = not (runs_late or self._begun)
            fate = "is not done any more" if self._dropped else "runs to its end when physics gets to it"
            raise Refusal("step_timeout", f"the step did not finish within {timeout:g} s; it {fate}")
        if self._error is not None:
            raise self._error
        return self._results[0]


class _WarningLog:
    """Sends MuJoCo's warnings to the log while an engine runs.

    MuJoCo has one handler per process and by default appends to a file in the current folder. A handler that somebody
    else installed stays.
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


_mujoco_warnings = _WarningLog()


def _named(scene: CompiledScene, dialect: Dialect) -> list[tuple[str, ArticulationIndex]]:
    """Return each articulation by what it is called; of two that would be called alike, the later by its actor."""
    named: dict[str, ArticulationIndex] = {}
    for index in scene.articulations:
        name = dialect.robot_key(index.actor_id, index.key)
        named[index.key if name in named else name] = index
    return list(named.items())


def _folded(controls: Mapping[str, ArticulationControl], dialect: Dialect) -> dict[str, ArticulationControl]:
    """Return the articulations by all that requests may call them, in one case; the first to claim a name has it."""
    folded = {name.casefold(): control for name, control in reversed([*controls.items()])}
    if dialect.public_names:
        for control in controls.values():
            for name in (control.index.key, control.index.actor_id):
                if name:
                    folded.setdefault(name.casefold(), control)
    return folded


def _call(hooks: list[Hook]) -> None:
    for hook in tuple(hooks):
        try:
            hook()
        except Exception:
            logger.exception("%r failed and is not called again", hook)
            if hook in hooks:
                hooks.remove(hook)


def _busy() -> Refusal:
    return Refusal("not_ready", "physics is busy with a step request that is still running; try again later")


def _shutting_down() -> Refusal:
    return Refusal("shutting_down", "the simulation is stopping")
