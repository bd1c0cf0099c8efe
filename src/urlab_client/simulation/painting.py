"""The thread in which pictures of a scene are drawn, because an OpenGL context belongs to one thread."""

from __future__ import annotations

import atexit
import copy
import logging
import queue
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any, Final, Generic, NamedTuple, TypeVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client.simulation.drawing import Stage
from urlab_client.simulation.opengl import Backend, RenderingUnavailable

logger: logging.Logger = logging.getLogger("urlab_client.server")

T = TypeVar("T")
StageT = TypeVar("StageT", bound=Stage)

MAX_FAILED: Final = 3
"""After so many failures in a row drawing is given up."""

VISIBLE: Final = ("time", "qpos", "mocap_pos", "mocap_quat")
"""Fields of the state that pictures depend on, and the time, in MuJoCo's order."""

_STATE: Final = (
    mujoco.mjtState.mjSTATE_TIME.value
    | mujoco.mjtState.mjSTATE_QPOS.value
    | mujoco.mjtState.mjSTATE_MOCAP_POS.value
    | mujoco.mjtState.mjSTATE_MOCAP_QUAT.value
)


class Visible(NamedTuple):
    """What a picture depends on.

    Attributes:
        state: The fields `VISIBLE` of `MjData`, flattened and concatenated.
        look: Fields of the model that vary; the same fields each time.
    """

    state: NDArray[np.float64]
    look: Mapping[str, NDArray[Any]]


def visible_state(model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.float64]:
    """Return the state in which a picture shows some data."""
    state = np.empty(mujoco.mj_stateSize(model, _STATE))
    mujoco.mj_getState(model, data, state, _STATE)
    return state


class Painter(Generic[StageT]):
    """Draws one scene, one picture after another. Its methods may be called from any thread.

    Attributes:
        ready: Set when OpenGL has been found, or nothing is drawn any more.
        ended: Whether nothing is drawn any more.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        find_backend: Callable[[], Backend | None],
        make_stage: Callable[[mujoco.MjModel, Backend], StageT],
        make_thread: Callable[[Callable[[], None]], threading.Thread],
    ) -> None:
        """Prepare to draw. The thread begins with the first picture.

        Args:
            model: The scene; its fields are copied.
            find_backend: Searches for OpenGL, in the thread; None if there is none.
            make_stage: Creates the context for a model that nothing else uses, in the thread.
            make_thread: Returns a daemon thread, not started, that runs a function.
        """
        self.ready: threading.Event = threading.Event()
        self._model = copy.copy(model)  # its own visual settings, and no eye on changing options
        self._find_backend = find_backend
        self._make_stage = make_stage
        self._make_thread = make_thread
        self._thread: threading.Thread | None = None
        self._jobs: queue.SimpleQueue[tuple[Callable[[StageT, mujoco.MjData], Any], Visible, Future[Any]] | None] = (
            queue.SimpleQueue()
        )
        self._lock = threading.Lock()
        self._pending: set[Future[Any]] = set()
        self._drawing = False
        self.ended: bool = False
        self._failure: RenderingUnavailable | None = None

    def submit(self, draw: Callable[[StageT, mujoco.MjData], T], visible: Visible) -> Future[T]:
        """Have `draw` called in the thread, with the stage and a state.

        Returns:
            Its result. It is cancelled if nothing is drawn any more, or fails with what ended the thread.
        """
        drawn: Future[T] = Future()
        with self._lock:
            self._pending.add(drawn)
            if self.ended:
                self._release()
            else:
                self._jobs.put((draw, visible, drawn))
                if self._thread is None:
                    self._thread = self._make_thread(self._run)
                    self._thread.start()
        return drawn

    def close(self, timeout: float = 1.0) -> bool:
        """Stop drawing and release waiting callers. Idempotent.

        Returns:
            False if it was still drawing then.
        """
        with self._lock:
            self.ended = True
            self._release()
        if self._thread is None or not self._drawing:  # a search for OpenGL ends by itself
            return True
        atexit.unregister(self.close)
        self._jobs.put(None)
        for _ in range(2):  # a pause of the whole process, in which it cannot end, uses up one of them
            self._thread.join(timeout / 2.0)
        return not self._thread.is_alive()

    def _release(self) -> None:
        """Release who waits. Call under the lock, after the end."""
        self.ready.set()
        while self._pending:
            drawn = self._pending.pop()
            if self._failure is not None and not drawn.cancelled():
                drawn.set_exception(self._failure)
            elif drawn.cancel():
                drawn.set_running_or_notify_cancel()  # tells those who wait for several

    def _run(self) -> None:
        try:
            backend = self._find_backend()
            with self._lock:
                self._drawing = backend is not None and not self.ended
            if backend is not None and self._drawing:
                with self._make_stage(self._model, backend) as stage:
                    self._draw_all(stage)
        except BaseException as error:
            self._failure = RenderingUnavailable(f"nothing more is drawn: {error!r}")
            self._failure.__cause__ = error
            if not isinstance(error, Exception):
                raise
            logger.exception("no more pictures: drawing failed")
        finally:
            with self._lock:
                self.ended = True
                self._release()

    def _draw_all(self, stage: StageT) -> None:
        atexit.register(self.close)  # after the driver's own hook, so before it at the end
        self.ready.set()
        data, failed = mujoco.MjData(self._model), 0
        while (job := self._jobs.get()) is not None and not self.ended:
            draw, visible, drawn = job
            outcome: Any = None
            error: Exception | None = None
            try:
                for name, values in visible.look.items():
                    getattr(self._model, name)[...] = values
                mujoco.mj_setState(self._model, data, visible.state, _STATE)
                stage.prepare(data)
                outcome, failed = draw(stage, data), 0
            except Exception as failure:
                error, failed = failure, failed + 1
                if failed == MAX_FAILED:
                    raise
                logger.exception("a picture could not be drawn")
            with self._lock:
                self._pending.discard(drawn)
                if not drawn.cancelled() and error is None:
                    drawn.set_result(outcome)
                elif not drawn.cancelled():
                    drawn.set_exception(error)
