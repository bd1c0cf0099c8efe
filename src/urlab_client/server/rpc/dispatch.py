"""From a request frame to a reply frame: the order of checks, the handlers and their errors.

For the transports, which call a `Dispatcher`, and for the handler modules, which register with `handles`. A `Watchdog`
keeps the server answering while MuJoCo does not return.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from typing import Any, Final, TypeVar, get_args, get_type_hints

import msgspec
from msgspec import Struct

from urlab_client.enums import Transport
from urlab_client.protocol.base import Effect, Needs, Op, Reply, Request
from urlab_client.protocol.codec import encode_reply
from urlab_client.protocol.messages.jobs import OpStarted
from urlab_client.protocol.messages.session import ErrorReply
from urlab_client.protocol.registry import OPS
from urlab_client.server.core import ServerCore
from urlab_client.server.refusal import Refusal
from urlab_client.server.rpc.requests import Incoming, RequestReader
from urlab_client.server.system.threads import Health, ServedThread, ServingThread

logger: logging.Logger = logging.getLogger("urlab_client.server")

Q = TypeVar("Q", bound=Request[Any])
A = TypeVar("A", bound=Reply | bytes)
Handler = Callable[[ServerCore, Any], Reply | bytes]
"""Returns the reply, or its msgpack frame if that is faster; a session in JSON gets replies only."""

_WITHOUT_SESSION: Final = frozenset({"hello", "meta"})
_NO_SIGN_OF_USE: Final = frozenset({"hello", "meta", "pie_status", "op_status", "acquire_lease", "release_lease"})
_BESIDE_JOBS: Final = frozenset({"op_status", "pie_status"})
"""Editor ops that do not wait for earlier jobs."""

BARE_NAMES: Final = ("recording", "replay")
"""Namespaces whose ops are looked up case-insensitively but recognise only their exact name."""


RENEWED_S: Final = 0.25
"""How often a waiting request checks whether the lock has been replaced."""

INTERVAL_S: Final = 0.25


class ServedRequest(Struct, frozen=True, kw_only=True):
    """An answered request; see `SimulatedServer.add_request_callback`.

    Attributes:
        op: Its op; `unknown` if the server does not have it.
        error: Code of the error reply; empty if there was no error.
        seconds: Time from its turn to the reply.
        request_bytes: Size of the request.
        reply_bytes: Size of the reply.
    """

    op: str
    error: str
    seconds: float
    request_bytes: int
    reply_bytes: int


class HandlerTable:
    """The handlers of all ops.

    Attributes:
        handlers: Handler by op name.
        structs: Struct that a handler reads, by op name, if it has more fields than the declared one.
    """

    def __init__(self) -> None:
        self.handlers: dict[str, Handler] = {}
        self.structs: dict[str, type[Request[Any]]] = {}

    def handles(self, request: type[Q]) -> Callable[[Callable[[ServerCore, Q], A]], Callable[[ServerCore, Q], A]]:
        """Register the decorated function for an op.

        Args:
            request: The op's request struct, or a struct derived from it that reads more fields than clients send.

        Raises:
            TypeError: No op has such a request, the op has a handler, or the function does not return its reply.
        """
        op = OPS.get(str(request.__struct_config__.tag))
        if op is None or not issubclass(request, op.request):
            raise TypeError(f"{request.__name__} is not the request of an op")

        def register(handler: Callable[[ServerCore, Q], A]) -> Callable[[ServerCore, Q], A]:
            annotation = get_type_hints(handler)["return"]
            for returned in get_args(annotation) or (annotation,):
                if returned is not bytes and not issubclass(returned, op.reply):
                    raise TypeError(
                        f"{handler.__qualname__} returns {returned.__name__}, {op.name} wants {op.reply.__name__}"
                    )
            if op.name in self.handlers:
                raise TypeError(f"{op.name} has two handlers")
            self.handlers[op.name] = handler
            if request is not op.request:
                self.structs[op.name] = request
            return handler

        return register


HANDLERS: Final = HandlerTable()
"""The handlers of this package; filled when `urlab_client.server.handlers` is imported."""

handles: Final = HANDLERS.handles


class Dispatcher:
    """Answers requests one at a time, from all transports.

    Attributes:
        served: The threads that call `answer`.
        callbacks: Called with each answered request, on the thread that answers, before the next request.
    """

    served: list[ServingThread]
    callbacks: list[Callable[[ServedRequest], None]]

    def __init__(self, core: ServerCore, table: HandlerTable) -> None:
        self._core = core
        self._handlers: Mapping[str, Handler] = table.handlers
        self._reader = RequestReader(ops=core.dialect.ops, structs=table.structs, limits=core.world.content.limits)
        self._lock = threading.Lock()
        self._name = ""
        self.served = []
        self.callbacks = []

    def answer(
        self, frame: bytes, transport: Transport = Transport.ZMQ, *, max_reply_bytes: int | None = None
    ) -> bytes:
        """Return the reply to a request; errors become error replies.

        Args:
            transport: Transport of the request; editor ops are refused over shared memory.
            max_reply_bytes: Longest reply that can be sent. A request whose reply cannot be shorter is not executed.
        """
        lock = self._enter()
        try:
            self._name = name = "request"
            began = time.perf_counter()
            error = ""
            try:
                incoming = self._reader.read(frame)
                self._name = name = incoming.name or name
                reply = _fitting(
                    self._encoded(self._serve(incoming, transport, max_reply_bytes)), incoming, max_reply_bytes
                )
            except Exception as failure:  # noqa: BLE001 - whatever happens, there is an answer
                refused = _error(name, failure)
                error = refused.code
                reply = encode_reply(refused, json=self._core.session.json)
            if self.callbacks:
                self._tell(name, error, time.perf_counter() - began, frame, reply)
            return reply
        finally:
            lock.release()

    def _tell(self, name: str, error: str, seconds: float, frame: bytes, reply: bytes) -> None:
        served = ServedRequest(
            op=name if name in self._core.dialect.ops else "unknown",
            error=error,
            seconds=seconds,
            request_bytes=len(frame),
            reply_bytes=len(reply),
        )
        for callback in self.callbacks:
            try:
                callback(served)
            except Exception:
                logger.exception("%r failed on a request of %s", callback, served.op)

    def _encoded(self, reply: Reply | bytes) -> bytes:
        core = self._core
        return reply if isinstance(reply, bytes) else encode_reply(core.dialect.shaped(reply), json=core.session.json)

    @contextmanager
    def standstill(self, timeout: float) -> Generator[bool]:
        """Pause answering; yields False if the request in progress did not finish within `timeout` seconds."""
        lock = self._lock
        idle = lock.acquire(timeout=timeout)
        try:
            yield idle
        finally:
            if idle:
                lock.release()

    def relieve(self, thread: threading.Thread) -> bool:
        """Answer the request whose thread does not return, and let another thread serve.

        The request continues and takes effect when MuJoCo returns, like a queued step.

        Returns:
            False if the thread serves no request, or has returned.
        """
        error = ErrorReply(
            code="step_timeout",
            message=f"{self._name}: MuJoCo has not returned yet; the request takes effect when it does, "
            "unless stop_pie ends play first",
        )
        reply = encode_reply(error, json=self._core.session.json)
        return any(serving.relieve(thread, reply, self._renew) for serving in self.served)

    def _renew(self) -> None:
        """Leave the lock to the thread that does not return, and create another one."""
        self._lock = threading.Lock()

    def _enter(self) -> threading.Lock:
        """Wait for the turn of this request and return the lock to release afterwards."""
        while True:
            lock = self._lock
            if lock.acquire(blocking=False) or lock.acquire(timeout=RENEWED_S):
                if lock is self._lock:
                    return lock
                lock.release()

    def _serve(self, incoming: Incoming, transport: Transport, max_reply_bytes: int | None) -> Reply | bytes:
        core, request = self._core, incoming.request
        op = self._admitted(incoming, transport)
        handler = self._handlers.get(op.name)
        if handler is None:
            raise Refusal("unsupported", f"op '{op.name}' is not implemented by this simulated server")
        if max_reply_bytes is not None and core.least_reply_bytes(request) > max_reply_bytes:
            raise Refusal(
                "wrong_transport", f"the reply to '{op.name}' would not fit into shared memory: send it over ZMQ"
            )
        if op.job and core.dialect.jobs:
            return OpStarted(job_id=core.jobs.start(lambda: self._job(op.name, handler, request)))
        if op.needs is Needs.EDITOR and op.name not in _BESIDE_JOBS:
            with core.jobs.alone():
                return handler(core, request)
        return handler(core, request)

    def _admitted(self, incoming: Incoming, transport: Transport) -> Op:
        """Make the checks that precede every handler, in the plugin's order, and return the op."""
        op, name = incoming.op, incoming.name
        if self._core.health.failure is not None:
            raise Refusal("internal_error", f"{self._core.health.failure}; start the server again")
        if transport is Transport.SHM and op is not None and op.needs is Needs.EDITOR:
            raise Refusal("wrong_transport", f"op '{name}' is not served over shared memory: send it over ZMQ")
        if name is None:
            raise Refusal("missing_op", "the request has no field 'op' that reads as a string")
        if name not in _NO_SIGN_OF_USE:
            self._core.lease.touch()
        needs_session = op is None or op.name not in _WITHOUT_SESSION
        if needs_session and not self._core.session.accepts(incoming.session_id):
            raise Refusal("session_expired", f"session '{incoming.session_id}' is not the active one: send hello first")
        if op is None:
            raise Refusal("unknown_op", f"this server has no op '{name}'")
        if incoming.missing:
            raise Refusal("missing_field", f"{op.name}: required field '{incoming.missing[0]}' is missing")
        if op.needs is Needs.MANAGER and not self._core.play.manager_present:
            raise Refusal("no_active_manager", f"op '{op.name}' needs a running play session: call begin_pie first")
        if op.ns in BARE_NAMES and name != op.name:
            raise Refusal("unknown_op", name)
        return op

    def _job(self, name: str, handler: Handler, request: Any) -> dict[str, Any]:
        try:
            reply: Any = handler(self._core, request)
            frame = encode_reply(reply)
        except Exception as failure:  # noqa: BLE001 - whoever asks for the job must hear of it
            frame = encode_reply(_error(name, failure))
        return msgspec.msgpack.decode(frame)


def _error(name: str, failure: Exception) -> ErrorReply:
    if isinstance(failure, Refusal):
        return ErrorReply(code=failure.code, message=failure.message, **failure.details)
    logger.error("%s failed", name, exc_info=failure)
    return ErrorReply(
        code="internal_error",
        message=f"{name}: the server failed with {type(failure).__name__}; its log has the details",
    )


def _fitting(reply: bytes, incoming: Incoming, limit: int | None) -> bytes:
    if limit is None or len(reply) <= limit:
        return reply
    executed = ""
    if incoming.op is not None and incoming.op.effect is not Effect.READ:
        executed = " It was executed: do not send it again."
    raise Refusal("reply_too_large", f"{incoming.name}: the reply has {len(reply)} bytes, {limit} fit.{executed}")


class Watchdog(ServedThread):
    """Checks the physics of a server a few times a second.

    A short step runs on the thread that serves requests. If MuJoCo holds that thread for longer than the step timeout,
    the client gets an error, and another thread serves. Meanwhile the engine's lock refuses requests that need physics;
    others, such as `hello`, `meta` and `stop_pie`, do not wait for it.
    """

    def __init__(self, core: ServerCore, dispatcher: Dispatcher, health: Health) -> None:
        super().__init__(health.thread("urlab-watchdog", self._run))
        self._core = core
        self._dispatcher = dispatcher

    def _run(self) -> None:
        told: object = None
        while not self._stopping.wait(INTERVAL_S):
            running = self._core.play.current
            overdue = None if running is None else running.engine.overdue
            if overdue is None:
                continue
            if overdue.began_at != told:
                told = overdue.began_at
                logger.warning("physics has not returned from MuJoCo for %.1f s; stop_pie ends it", overdue.seconds)
            self._dispatcher.relieve(overdue.thread)
