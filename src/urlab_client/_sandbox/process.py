"""Work on a stranger's model, done in a process where it does no harm.

MuJoCo's compiler uses all the memory and time that a model demands, reads the files that it names, cannot be
interrupted, and may crash. A child process, with MuJoCo loaded, forks a grandchild for each job, which lives under the
job's limits and sees no other model. Where there is no `fork` (Windows) the child does the work itself and is replaced
after each job; there the limits are wall time and what the operating system gives. Both are killed together, and nobody
waits for their pipes beyond a job's time.
"""

from __future__ import annotations

import atexit
import contextlib
import importlib
import os
import queue
import select
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, Final

import msgspec

from urlab_client._platform.signals import APART
from urlab_client._platform.threads import daemon
from urlab_client._sandbox.confinement import confine_files, limit_process

_GRACE_S: Final = 5.0 if hasattr(os, "fork") else 30.0
"""Extra time for the child's answer, seconds. It includes the start of the child."""

_END_S: Final = 1.0
"""Time for a killed process to end, seconds."""

_LOOK_S: Final = 0.1
_SIZE: Final = struct.Struct(">Q")


class ProcessLimits(msgspec.Struct, frozen=True, kw_only=True):
    """What a job may use. Messages name a limit by `prefix` and its own name, or describe it if nobody can set it."""

    memory_bytes: int
    cpu_s: int
    wall_s: int
    prefix: str = ""

    @property
    def memory(self) -> str:
        """The limit of memory, for a message."""
        if not self.prefix:
            return f"{self.memory_bytes >> 20} MiB"
        return f"the limit {self.prefix}memory_bytes, {self.memory_bytes}"

    def time(self, name: str) -> str:
        """Return the limit `cpu_s` or `wall_s`, for a message."""
        seconds = getattr(self, name)
        if self.prefix:
            return f"the limit {self.prefix}{name}, {seconds} s"
        return f"{seconds} s of processor time" if name == "cpu_s" else f"{seconds} s"


class Job(msgspec.Struct, kw_only=True):
    """Work for the process.

    Attributes:
        work: `MODULE:FUNCTION`. It takes the argument and returns the result; what it raises is refused with its text.
        argument: Bytes for the function.
        limits: What it may use.
        folder: The working folder, in which files may be written.
        readable: Folders below which files may be read, too. No other file or socket can be opened.
        modules: What is imported before that, as the process can import nothing afterwards.
    """

    work: str
    argument: bytes
    limits: ProcessLimits
    folder: str
    readable: list[str] = []
    modules: list[str] = []


class Refused(ValueError):
    """The work refused what it was given; the text is its own."""


class Failed(ValueError):
    """The process exceeded a limit, crashed or could not be started; the text says which."""


class _Answer(msgspec.Struct):
    result: bytes | None = None
    refused: str = ""
    failed: str = ""


_JOB: Final = msgspec.msgpack.Decoder(Job)
_ANSWER: Final = msgspec.msgpack.Decoder(_Answer)


def _framed(message: msgspec.Struct) -> bytes:
    content = msgspec.msgpack.encode(message)
    return _SIZE.pack(len(content)) + content


def _read_frame(stream: IO[bytes], most: float) -> bytes:
    """Return the content of a frame of at most `most` bytes; nothing at the end of the stream."""
    head = stream.read(_SIZE.size)
    if len(head) < _SIZE.size or _SIZE.unpack(head)[0] > most:
        return b""
    content = stream.read(_SIZE.unpack(head)[0])
    return content if len(content) == _SIZE.unpack(head)[0] else b""


class _Child:
    """A process that does one job at a time, and the pipes to it."""

    program: str = "from urlab_client._sandbox import process; process.serve()"
    """Not `-m`: importing the package may import this module, of which Python warns when it is to be run as well."""

    def __init__(self) -> None:
        self.process = subprocess.Popen(  # noqa: S603 - a script of this module
            [sys.executable, "-c", self.program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, **APART
        )
        self._asking: threading.Thread | None = None

    def ask(self, job: Job, deadline: float, progress: Callable[[int], object]) -> bytes | None:
        """Return the answer to a job, nothing if the process ended without one, or None if it is late.

        The caller waits for a thread and not for the pipe, whose end may never come: what the process has forked, or
        what any thread of this one forked meanwhile, may hold it open.
        """
        answers: queue.SimpleQueue[bytes | BaseException] = queue.SimpleQueue()
        self._asking = daemon("urlab-sandbox", self._ask, job, answers, failed=answers.put)
        self._asking.start()
        while True:
            try:
                answer = answers.get(timeout=max(0.0, min(_LOOK_S, deadline - time.monotonic())))
            except queue.Empty:
                if time.monotonic() >= deadline:
                    return None
                progress(0)
            else:
                break
        if isinstance(answer, BaseException):
            raise RuntimeError(f"urlab-sandbox died of {answer!r}") from answer  # noqa: TRY004
        return answer

    def _ask(self, job: Job, answers: queue.SimpleQueue[bytes | BaseException]) -> None:
        answer = b""
        try:
            if self.process.stdin is not None and self.process.stdout is not None:
                self.process.stdin.write(_framed(job))
                self.process.stdin.flush()
                answer = _read_frame(self.process.stdout, job.limits.memory_bytes)
        except OSError:
            pass
        finally:
            if not answer:
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


class _Children:
    """The processes, one for each job at the same time. One is kept for the next job."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._all: set[_Child] = set()
        self.idle: _Child | None = None
        self._pid = 0

    def answer(self, job: Job, progress: Callable[[int], object], *, keep: bool) -> _Answer:
        """Have a job done; there is an answer in time, whatever happens to the process."""
        deadline = time.monotonic() + job.limits.wall_s + _GRACE_S
        for _ in range(2):  # a process that has ended meanwhile is replaced once
            try:
                child = self._take()
            except OSError as error:
                return _Answer(failed=f"the process that compiles cannot be started: {error}")
            answer = None
            try:
                answer = child.ask(job, deadline, progress)
            finally:
                self._put_back(child, usable=keep and bool(answer) and hasattr(os, "fork"))
            if answer:
                return _ANSWER.decode(answer)
            if answer is None:
                return _took_too_long(job.limits)
        return _Answer(failed="compilation ended without an answer: it exceeded its limits, or MuJoCo failed")

    def close(self) -> None:
        """End all of them."""
        with self._lock:
            ending = [*self._all] if self._pid == os.getpid() else []
            self._all, self.idle = set(), None
        for child in ending:
            child.end()

    def _take(self) -> _Child:
        with self._lock:
            if self._pid != os.getpid():  # a fork of this program has none of its own
                self._all, self.idle, self._pid = set(), None, os.getpid()
            child, self.idle = self.idle or _Child(), None
            self._all.add(child)
            return child

    def _put_back(self, child: _Child, *, usable: bool) -> None:
        with self._lock:
            if usable and self.idle is None and child in self._all:
                self.idle = child
                return
            self._all.discard(child)
        child.end()


_children = _Children()
atexit.register(_children.close)


def run_confined(job: Job, progress: Callable[[int], object] = lambda _: None, *, keep: bool = False) -> bytes:
    """Have a job done, and return its result. Blocks for a bounded time.

    Args:
        progress: Callback invoked about ten times a second. If it raises, the work is broken off.
        keep: Whether the process stays for the next job, which then starts at once.

    Raises:
        Refused, Failed: What was wrong.
    """
    answer = _children.answer(job, progress, keep=keep)
    if answer.result is not None:
        return answer.result
    raise Failed(answer.failed) if answer.failed else Refused(answer.refused)


# The child.


def serve() -> None:
    """Do the jobs that come on standard input until it ends."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # output of libraries is not an answer
    for signum in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signum, signal.SIG_IGN)  # they are meant for the parent, which ends this process
    while frame := _read_frame(sys.stdin.buffer, float("inf")):
        job = _JOB.decode(frame)
        for module in (job.work.partition(":")[0], *job.modules):
            importlib.import_module(module)
        answers.write(_framed(_fork(job, answers.fileno()) if hasattr(os, "fork") else _work(job)))
        answers.flush()


def _fork(job: Job, answers: int) -> _Answer:
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            os.close(reading)
            os.close(answers)  # so that the end of this process's parent is noticed at once
            with os.fdopen(writing, "wb") as stream:
                stream.write(msgspec.msgpack.encode(_work(job)))
        finally:
            os._exit(0)
    os.close(writing)
    try:
        answer, in_time = _read(reading, time.monotonic() + job.limits.wall_s)
    finally:
        os.close(reading)
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        status = os.waitpid(pid, 0)[1]
    if answer and in_time:
        return _ANSWER.decode(answer)
    if not in_time:
        return _took_too_long(job.limits)
    if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGXCPU:
        return _Answer(failed=f"compilation took more than {job.limits.time('cpu_s')}")
    return _Answer(failed=f"MuJoCo failed on it, or compilation needs more memory than {job.limits.memory}")


def _took_too_long(limits: ProcessLimits) -> _Answer:
    return _Answer(failed=f"compilation took more than {limits.time('wall_s')}")


def _read(descriptor: int, deadline: float) -> tuple[bytes, bool]:
    """Read to the end; return the data, and whether the end came before the deadline."""
    parts: list[bytes] = []
    while select.select([descriptor], [], [], max(0.0, deadline - time.monotonic()))[0]:
        part = os.read(descriptor, 1 << 16)
        if not part:
            return b"".join(parts), True
        parts.append(part)
    return b"", False


def _work(job: Job) -> _Answer:
    """Do a job under its limits, which stay."""
    silence = os.open(os.devnull, os.O_WRONLY)
    for output in (1, 2):  # what MuJoCo prints about a stranger's model is not for the terminal
        os.dup2(silence, output)
    module, _, function = job.work.partition(":")
    try:
        os.chdir(job.folder)
        limit_process(job.limits.memory_bytes, job.limits.cpu_s)
        confine_files(map(Path, job.readable), (Path(job.folder),))
        return _Answer(result=getattr(sys.modules[module], function)(job.argument))
    except Exception as error:  # noqa: BLE001 - whatever it was, the parent must hear of it
        text = " ".join(str(error).split())
        if is_out_of_memory(error):
            said = f"; MuJoCo says: {text}" if text else ""
            return _Answer(failed=f"it needs more memory than {job.limits.memory}{said}")
        return _Answer(refused=text)


def is_out_of_memory(error: Exception) -> bool:
    """Whether an error, of Python or of MuJoCo, means that no memory is left."""
    return isinstance(error, MemoryError) or any(
        text in str(error) for text in ("allocate memory", "unknown exception")
    )
