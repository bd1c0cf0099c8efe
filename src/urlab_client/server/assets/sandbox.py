"""Compiling models that clients name, in a child process with limits.

For `ContentRoot`. MuJoCo's compiler uses all the memory and time that a file demands, cannot be interrupted, and may
crash: so it runs where that does no harm. A child is started with the first such model, with MuJoCo loaded, and
kept; for each model it forks a grandchild, which lives under the limits and sees no other model. Where there is no
`fork` (Windows) the child does the work itself and is replaced after each model; there the limits are wall time and
what the operating system gives. Both are killed together, and nobody waits for their pipes beyond a model's time.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import queue
import select
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Final

import msgspec
import mujoco

from urlab_client._platform.children import APART
from urlab_client._platform.threads import daemon
from urlab_client._sandbox.confined import limit_process
from urlab_client._sandbox.landlock import confine_files
from urlab_client.server.assets.confinement import Outside, check_references
from urlab_client.server.assets.importer import Compiled, build_snapshot, mujoco_messages, one_line
from urlab_client.server.limits import Limits
from urlab_client.server.refusal import Refusal

_GRACE_S: Final = 5.0 if hasattr(os, "fork") else 30.0
"""Extra time for the child's answer, seconds. Without `fork` it includes the start of the child."""

_END_S: Final = 1.0
"""Time for a killed process to end, seconds."""

_REPLY_BYTES: Final = 64 * 2**20


class _SandboxJob(msgspec.Struct):
    """An order to the child, one line."""

    file: str
    snapshot: str
    roots: list[str]
    limits: Limits


class _Outcome(msgspec.Struct):
    """The child's answer: the result, or the reason for the refusal and its subject."""

    done: Compiled | None = None
    refused: str = ""
    subject: str = ""


_ORDER: Final = msgspec.json.Decoder(_SandboxJob)
_OUTCOME: Final = msgspec.json.Decoder(_Outcome)


class _Compiler:
    """A process that compiles one model at a time, and the pipes to it."""

    program: str = "from urlab_client.server.assets import sandbox; sandbox.serve()"
    """Not `-m`: importing the package imports this module, of which Python warns when it is to be run as well."""

    def __init__(self) -> None:
        self.process = subprocess.Popen(  # noqa: S603 - a script of this module
            [sys.executable, "-c", self.program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, **APART
        )
        self._asking: threading.Thread | None = None

    def ask(self, line: bytes, deadline: float) -> bytes | None:
        """Return the answer to a line, nothing if the process ended without one, or None if it is late.

        The caller waits for a thread and not for the pipe, whose end may never come: what the process has forked, or
        what any thread of this one forked meanwhile, may hold it open.
        """
        answers: queue.SimpleQueue[bytes | BaseException] = queue.SimpleQueue()
        self._asking = daemon("urlab-sandbox", self._ask, line, answers, failed=answers.put)
        self._asking.start()
        try:
            answer = answers.get(timeout=max(0.0, deadline - time.monotonic()))
        except queue.Empty:
            return None
        if isinstance(answer, BaseException):
            raise RuntimeError(f"urlab-sandbox died of {answer!r}") from answer  # noqa: TRY004
        return answer

    def _ask(self, line: bytes, answers: queue.SimpleQueue[bytes | BaseException]) -> None:
        answer = b""
        try:
            if self.process.stdin is not None and self.process.stdout is not None:
                self.process.stdin.write(line)
                self.process.stdin.flush()
                answer = self.process.stdout.readline(_REPLY_BYTES)
        except OSError:
            pass
        finally:
            if not answer.endswith(b"\n"):
                answer = b""
                self._close()
        answers.put(answer)

    def end(self) -> None:
        """Kill the process and everything that it has forked, within a bounded time."""
        if sys.platform != "win32":
            with contextlib.suppress(ProcessLookupError, PermissionError):
                # Before `kill`, after which the number may be reused.
                os.killpg(self.process.pid, signal.SIGKILL)
        self.process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(_END_S)
        if self._asking is not None:
            self._asking.join(_END_S)
        if self._asking is None or not self._asking.is_alive():  # otherwise it closes them when the pipe allows
            self._close()

    def _close(self) -> None:
        for stream in (self.process.stdin, self.process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()


class _Compilers:
    """The processes that compile, one for each model at the same time. One is kept for the next model."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._all: set[_Compiler] = set()
        self._idle: _Compiler | None = None
        self._pid = 0

    def build(self, order: _SandboxJob) -> _Outcome:
        """Compile a model in a process; there is a result in time, whatever happens to the process."""
        deadline = time.monotonic() + order.limits.model_wall_s + _GRACE_S
        for _ in range(2):  # a process that has ended meanwhile is replaced once
            try:
                compiler = self._take()
            except OSError as error:
                return _Outcome(refused=f"the process that compiles cannot be started: {one_line(error)}")
            answer = None
            try:
                answer = compiler.ask(msgspec.json.encode(order) + b"\n", deadline)
            finally:
                self._put_back(compiler, usable=bool(answer) and hasattr(os, "fork"))
            if answer:
                return _OUTCOME.decode(answer)
            if answer is None:
                return _took_too_long(order.limits)
        return _Outcome(refused="compilation ended without an answer: it exceeded its limits, or MuJoCo failed")

    def close(self) -> None:
        """End all of them."""
        with self._lock:
            ending = [*self._all] if self._pid == os.getpid() else []
            self._all, self._idle = set(), None
        for compiler in ending:
            compiler.end()

    def _take(self) -> _Compiler:
        with self._lock:
            if self._pid != os.getpid():  # a fork of this program has none of its own
                self._all, self._idle, self._pid = set(), None, os.getpid()
            compiler, self._idle = self._idle or _Compiler(), None
            self._all.add(compiler)
            return compiler

    def _put_back(self, compiler: _Compiler, *, usable: bool) -> None:
        with self._lock:
            if usable and self._idle is None and compiler in self._all:
                self._idle = compiler
                return
            self._all.discard(compiler)
        compiler.end()


_compilers = _Compilers()
atexit.register(_compilers.close)


def build_confined(file: Path, snapshot: Path, roots: tuple[Path, ...], limits: Limits) -> Compiled:
    """Call `build_snapshot` in a child process, for a file that may refer only to files below `roots`.

    Raises:
        Refusal: `import_failed`, with what was wrong or which limit was exceeded.
    """
    order = _SandboxJob(str(file), str(snapshot), [str(root) for root in roots], limits)
    outcome = _compilers.build(order)
    if outcome.done is None:
        raise Refusal("import_failed", f"{outcome.subject or file}: {outcome.refused}")
    return outcome.done


# The child.


def serve() -> None:
    """Serve orders from standard input until it ends."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # output of libraries is not an answer
    for signum in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signum, signal.SIG_IGN)  # they are meant for the server, which ends this process
    for line in sys.stdin.buffer:
        order = _ORDER.decode(line)
        outcome = _fork(order, answers.fileno()) if hasattr(os, "fork") else _work(order)
        answers.write(msgspec.json.encode(outcome) + b"\n")
        answers.flush()


def _fork(order: _SandboxJob, answers: int) -> _Outcome:
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            os.close(reading)
            os.close(answers)  # so that the end of this process's parent is noticed at once
            limit_process(order.limits.model_memory_bytes, order.limits.model_cpu_s)
            confine_files(map(Path, order.roots), (Path(order.snapshot).parent,))
            with os.fdopen(writing, "wb") as stream:
                stream.write(msgspec.json.encode(_work(order)))
        finally:
            os._exit(0)
    os.close(writing)
    try:
        answer, in_time = _read(reading, time.monotonic() + order.limits.model_wall_s)
    finally:
        os.close(reading)
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        status = os.waitpid(pid, 0)[1]
    if answer and in_time:
        return _OUTCOME.decode(answer)
    limits = order.limits
    if not in_time:
        return _took_too_long(limits)
    if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGXCPU:
        return _Outcome(refused=f"compilation took more than the limit model_cpu_s, {limits.model_cpu_s} s")
    return _Outcome(
        refused="MuJoCo failed on it, or compilation needs more memory than the limit model_memory_bytes, "
        f"{limits.model_memory_bytes}"
    )


def _took_too_long(limits: Limits) -> _Outcome:
    return _Outcome(refused=f"compilation took longer than the limit model_wall_s, {limits.model_wall_s} s")


def _read(descriptor: int, deadline: float) -> tuple[bytes, bool]:
    """Read to the end; return the data, and whether the end came before the deadline."""
    parts: list[bytes] = []
    while select.select([descriptor], [], [], max(0.0, deadline - time.monotonic()))[0]:
        part = os.read(descriptor, 1 << 16)
        if not part:
            return b"".join(parts), True
        parts.append(part)
    return b"", False


def _work(order: _SandboxJob) -> _Outcome:
    limits, stage = order.limits, f"cannot read {order.file}"
    try:
        check_references(Path(order.file), tuple(map(Path, order.roots)), limits)
        snapshot, stage = Path(order.snapshot), f"cannot store the snapshot of {order.file}"
        compiled, model = build_snapshot(Path(order.file), snapshot, limits)
        check_references(snapshot / "model.xml", (snapshot,), limits)  # the server reads it without restrictions
        exceeded = _exceeded(compiled, limits)
        if not exceeded:
            _simulate(model)
        return _Outcome(refused=exceeded) if exceeded else _Outcome(done=compiled)
    except (Outside, Refusal) as refusal:
        return _Outcome(refused=refusal.message)
    except OSError as error:
        return _Outcome(refused=one_line(error), subject=stage)
    except Exception as error:  # noqa: BLE001 - whatever it was, the server must hear of it
        if isinstance(error, MemoryError) or "allocate memory" in str(error):
            return _Outcome(
                refused=f"it needs more memory than the limit model_memory_bytes, {limits.model_memory_bytes}"
            )
        return _Outcome(refused=one_line(error), subject=f"MuJoCo rejects {order.file}")


def _simulate(model: mujoco.MjModel) -> None:
    """Step once, so that a crash or an endless step happens here and not in the server."""
    with mujoco_messages(), contextlib.suppress(mujoco.FatalError):  # play has other options, and its own errors
        mujoco.mj_step(model, mujoco.MjData(model))


def _exceeded(compiled: Compiled, limits: Limits) -> str:
    """Return which limit a compiled model exceeds, or nothing."""
    n_data_bytes = max(compiled.n_data_bytes, compiled.n_arena_bytes)
    for what, value, name, limit in (
        ("compiled it takes {} bytes", compiled.n_bytes, "model_bytes", limits.model_bytes),
        ("simulating it takes {} bytes", n_data_bytes, "data_bytes", limits.data_bytes),
        ("its sensors give {} numbers", compiled.n_sensor_values, "sensor_values", limits.sensor_values),
        ("it has a camera of {} pixels", compiled.largest_image, "camera_side", limits.camera_side),
    ):
        if value > limit:
            return f"{what.format(value)}, more than the limit {name}, {limit}"
    return compiled.options_problem
