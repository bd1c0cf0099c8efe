"""Faults on purpose: what a `SimulatedServer` is told to do wrong, so that programs can test how they take it.

For users' tests, which add and remove faults while the server runs, and for the server, whose sockets ask the
`Injector` what becomes of a message.
"""

from __future__ import annotations

import enum
import logging
import math
import random
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, ClassVar, Final, Self, get_type_hints

import msgspec
import zmq

from urlab_client.protocol.registry import OPS
from urlab_client.server.transport.endpoint import RpcEndpoint

__all__ = [
    "ActiveFault",
    "Corrupt",
    "Cut",
    "Delay",
    "Drop",
    "Fault",
    "Faults",
    "FaultyEndpoint",
    "Injector",
    "Loss",
    "Refuse",
]

logger: logging.Logger = logging.getLogger("urlab_client.server")

_KINDS: Final = "a Delay, Drop, Cut, Corrupt or Refuse"

NEVER_USED: Final = 0xC1
"""A byte that starts no msgpack value and occurs in no UTF-8 text."""


@dataclass(frozen=True)
class Fault:
    """Something that goes wrong, and which messages it happens to; one of the classes below.

    A fault concerns requests: those of one op, or all. With `topic` it concerns published messages instead.

    Attributes:
        op: Name of the op whose requests are concerned; None for every op.
        topic: How the topics of the published messages start that are concerned; None for requests.
        executed: Whether a request is executed although its reply is lost, late or an error.
        after: How many messages pass unharmed first.
        times: How many messages are harmed in all; None for no end.
        probability: Share of the messages that are harmed, 0 to 1; the seed decides which.
    """

    op: str | None = None
    topic: str | None = field(default=None, kw_only=True)
    executed: bool = field(default=True, kw_only=True)
    after: int = field(default=0, kw_only=True)
    times: int | None = field(default=None, kw_only=True)
    probability: float = field(default=1.0, kw_only=True)

    def __post_init__(self) -> None:
        if type(self) is Fault:
            raise TypeError(f"a fault is {_KINDS}")
        for name, kind in get_type_hints(type(self)).items():
            try:
                msgspec.convert(getattr(self, name), kind)
            except msgspec.ValidationError as error:
                raise TypeError(f"{type(self).__name__}: {name}: {error}") from None
        if self.op is not None and self.op not in OPS:
            raise ValueError(f"no op is called {self.op!r}")
        if self.topic is not None and self.op is not None:
            raise ValueError("a fault concerns the requests of an op or the messages of a topic, not both")
        if self.after < 0 or (self.times is not None and self.times < 1):
            raise ValueError(f"after must be at least 0 and times at least 1, not {self.after} and {self.times}")
        if not 0.0 <= self.probability <= 1.0:
            raise ValueError(f"probability must be a number from 0 to 1, not {self.probability}")

    def concerns_request(self, op: str) -> bool:
        """Whether requests of this op are concerned."""
        return self.topic is None and (self.op is None or self.op == op)

    def concerns_message(self, topic: bytes) -> bool:
        """Whether published messages of this topic are concerned."""
        return self.topic is not None and topic.startswith(self.topic.encode())


@dataclass(frozen=True)
class Delay(Fault):
    """Answer late. Meanwhile the server answers nobody else, and with `topic` publishes nothing else on that socket.

    Attributes:
        seconds: How late.
    """

    seconds: float = field(kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.seconds >= 0.0 and math.isfinite(self.seconds)):
            raise ValueError(f"a delay must be a finite number of seconds, at least 0, not {self.seconds}")


@dataclass(frozen=True)
class Drop(Fault):
    """Answer never, and leave the connection as it is; with `topic`, do not publish."""


@dataclass(frozen=True)
class Cut(Fault):
    """Close the connection of whoever asked, in place of the reply. It may connect again.

    Shared memory has no connection: a reply that was to go there is lost, as by `Drop`.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        _refuse_topic(self)


@dataclass(frozen=True)
class Corrupt(Fault):
    """Change bytes of the reply: the first, so that it cannot be decoded, and some others.

    With `topic` the payload of published messages is changed. Binary rows have no checksum: a receiver may believe
    what it gets.

    Attributes:
        flips: How many bytes change besides the first; the seed decides which.
    """

    flips: int = field(default=8, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.executed:
            raise ValueError("a corrupt reply is that of an executed request")
        if self.flips < 0:
            raise ValueError(f"flips must be at least 0, not {self.flips}")


@dataclass(frozen=True)
class Refuse(Fault):
    """Answer with an error; the request is not executed unless `executed` says so.

    Attributes:
        code: Wire error code, such as `step_timeout`.
        message: Text of the error.
    """

    executed: bool = field(default=False, kw_only=True)
    code: str = field(kw_only=True)
    message: str = field(default="refused by a fault", kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        _refuse_topic(self)
        if not self.code:
            raise ValueError("a refusal needs a code, for example 'internal_error'")


def _refuse_topic(fault: Fault) -> None:
    if fault.topic is not None:
        raise ValueError(f"{type(fault).__name__} concerns requests; published messages are delayed or dropped")


class ActiveFault:
    """A fault that a server applies. As a context manager it is removed at the end.

    Attributes:
        fault: What goes wrong.
        seen: How many messages it could have been applied to.
        applied: How many it was applied to.
    """

    def __init__(self, faults: Faults, fault: Fault, seed: str) -> None:
        """Begin to count; `Faults.add` makes these."""
        self.fault = fault
        self.seen: int = 0
        self.applied: int = 0
        self.random: random.Random = random.Random(seed)  # noqa: S311 - reproducible on purpose
        self._faults = faults

    def __repr__(self) -> str:
        return f"<{self.fault} applied {self.applied} of {self.seen} times>"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.remove()

    def remove(self) -> None:
        """Apply it no longer; a delay under way ends."""
        self._faults.remove(self)

    def wait(self, times: int = 1, timeout: float = 5.0) -> bool:
        """Wait until it was applied.

        Args:
            times: How often.
            timeout: Longest wait, seconds.

        Returns:
            False when it was not applied so often in time.
        """
        return self._faults.wait_for(lambda: self.applied >= times, timeout)

    def due(self) -> bool:
        """Count a message and say whether it is harmed. `Faults` holds its lock."""
        fault = self.fault
        self.seen += 1
        if self.seen <= fault.after or (fault.times is not None and self.applied >= fault.times):
            return False
        if fault.probability < 1.0 and self.random.random() >= fault.probability:
            return False
        self.applied += 1
        return True


class Faults:
    """The faults of a server, which may change while it runs. Safe to use from several threads.

    ::

        faults = Faults()
        with SimulatedServer("arm", play=True, faults=faults) as server:
            ...
            with faults.add(Drop("step", times=1)) as lost:
                ...
            assert lost.applied == 1

    The same messages and the same seed give the same faults.
    """

    def __init__(self, *faults: Fault, seed: int = 0) -> None:
        """Start with some faults.

        Args:
            faults: Applied from the start.
            seed: Of the decisions that `probability` and `corrupt` leave open.

        Raises:
            TypeError: One of them is not a fault.
        """
        self._seed = seed
        self._made = 0
        self._changed = threading.Condition()
        self._active: tuple[ActiveFault, ...] = ()
        self._first = faults
        self.reset()

    @property
    def active(self) -> tuple[ActiveFault, ...]:
        """The faults that are applied, in the order in which they were added."""
        return self._active

    def add(self, fault: Fault) -> ActiveFault:
        """Apply a fault from now on.

        Of several that concern a message all delays are applied, and of the others the first that is due.

        Raises:
            TypeError: It is not a fault.
        """
        if not isinstance(fault, Fault):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise TypeError(f"{fault!r} is not a fault: make {_KINDS}, for example Drop('step')")
        with self._changed:
            added = ActiveFault(self, fault, f"{self._seed}/{self._made}")
            self._made += 1
            self._active = (*self._active, added)
        return added

    def remove(self, fault: ActiveFault) -> None:
        """Apply a fault no longer; without effect on one that is not applied."""
        with self._changed:
            self._active = tuple(other for other in self._active if other is not fault)
            self._changed.notify_all()

    def clear(self) -> None:
        """Apply no fault any more; delays under way end."""
        with self._changed:
            self._active = ()
            self._changed.notify_all()

    def reset(self) -> None:
        """Apply the faults it was made with and no others, with counters and chance as at the start."""
        with self._changed:
            self.clear()
            self._made = 0
            for fault in self._first:
                self.add(fault)

    def take(self, concerned: Callable[[Fault], bool]) -> tuple[list[ActiveFault], ActiveFault | None]:
        """Count a message and return the delays and the other fault that are due."""
        delays: list[ActiveFault] = []
        other: ActiveFault | None = None
        with self._changed:
            for active in self._active:
                if not self._concerned(active, concerned):
                    continue
                if isinstance(active.fault, Delay):
                    if active.due():
                        delays.append(active)
                elif other is None and active.due():
                    other = active
            self._changed.notify_all()
        return delays, other

    def _concerned(self, active: ActiveFault, concerned: Callable[[Fault], bool]) -> bool:
        try:
            return concerned(active.fault)
        except Exception:  # one of a user's own classes
            logger.exception("%r cannot tell what it concerns and is removed", active)
            self.remove(active)
            return False

    def wait_for(self, condition: Callable[[], bool], timeout: float) -> bool:
        """Wait until something that changes with the faults is true; return False if it is not in time."""
        with self._changed:
            return self._changed.wait_for(condition, timeout)

    def wake(self) -> None:
        """Have those who wait look again."""
        with self._changed:
            self._changed.notify_all()


class Loss(enum.Enum):
    """What becomes of a request that is not answered."""

    DROP = enum.auto()
    CUT = enum.auto()


class _Named(msgspec.Struct):
    op: str = ""


_JSON: Final = msgspec.json.Decoder(_Named)
_MSGPACK: Final = msgspec.msgpack.Decoder(_Named)


class Injector:
    """Applies faults to what a server's sockets receive and send."""

    def __init__(self, faults: Faults, refuse: Callable[[str, str], bytes]) -> None:
        """Stand between a server and its sockets.

        Args:
            faults: What goes wrong.
            refuse: Makes the frame of an error from its code and message.
        """
        self._faults = faults
        self._refuse = refuse
        self._closed = False

    def close(self) -> None:
        """End the delays under way and apply none any more."""
        self._closed = True
        self._faults.wake()

    def answer(self, frame: bytes, answer: Callable[[bytes], bytes]) -> bytes | Loss:
        """Answer a request, or say how its reply gets lost.

        Args:
            frame: The request's frame.
            answer: Turns it into the reply's.
        """
        if not self._faults.active:
            return answer(frame)
        op = _op_of(frame)
        delays, other = self._faults.take(lambda fault: fault.concerns_request(op))
        for delay in delays:
            if not delay.fault.executed:
                self._sleep(delay)
        reply = b"" if other is not None and not other.fault.executed else answer(frame)
        for delay in delays:
            if delay.fault.executed:
                self._sleep(delay)
        if other is None:
            return reply
        logger.debug("%s: %r", op, other)
        match other.fault:
            case Refuse(code=code, message=message):
                return self._refuse(code, message)
            case Corrupt(flips=flips):
                return _corrupted(reply, flips, other.random)
            case Cut():
                return Loss.CUT
            case _:
                return Loss.DROP

    def answer_in_memory(self, frame: bytes, answer: Callable[[bytes], bytes]) -> bytes:
        """Answer a request that came over shared memory; nothing when its reply gets lost, however that happens."""
        reply = self.answer(frame, answer)
        return b"" if isinstance(reply, Loss) else reply

    def publish(self, topic: bytes, payload: bytes) -> bytes | None:
        """Return what becomes of a published message: its payload, after a delay maybe, or None if it is dropped."""
        if not self._faults.active:
            return payload
        delays, other = self._faults.take(lambda fault: fault.concerns_message(topic))
        for delay in delays:
            self._sleep(delay)
        if other is None:
            return payload
        if isinstance(other.fault, Corrupt):
            return _corrupted(payload, other.fault.flips, other.random)
        return None

    def _sleep(self, delay: ActiveFault) -> None:
        """Wait until the delay is over, was removed, or the server closes."""
        if isinstance(delay.fault, Delay):
            self._faults.wait_for(lambda: self._closed or delay not in self._faults.active, delay.fault.seconds)


class FaultyEndpoint(RpcEndpoint):
    """A request socket that may leave a request unanswered, which a REP socket cannot."""

    kind: ClassVar[int] = zmq.ROUTER

    def __init__(self, injector: Injector, answer: Callable[[bytes], bytes], **options: Any) -> None:
        """Bind the socket.

        Args:
            injector: Decides what goes wrong.
            answer: See `RpcEndpoint`, as for the options.
        """
        super().__init__(answer, **options)
        self._injector = injector
        self._envelope: list[bytes] = []

    def _exchange(self) -> bool:
        frames = self._socket.recv_multipart(copy=False)
        if self._stopping:
            return False
        # As a REP socket does: an empty frame ends the envelope, and what has none is ignored.
        parts = [frame.bytes for frame in frames]
        if b"" not in parts[1:]:
            return True
        end = parts.index(b"", 1) + 1
        self._envelope = envelope = parts[:end]
        self.serving.begin()
        reply = self._injector.answer(parts[end] if len(parts) == end + 1 else b"", self._answer)
        if not self.serving.finish():
            return False
        if reply is Loss.CUT:
            _shut(int(frames[end - 1].get(zmq.SRCFD)))
        elif reply is not Loss.DROP:
            self._socket.send_multipart([*envelope, reply])
        self._envelope = []
        return True

    def _send_owed(self, reply: bytes) -> None:
        envelope, self._envelope = self._envelope, []
        if envelope:
            self._socket.send_multipart([*envelope, reply])


def _shut(descriptor: int) -> None:
    """End the connection that a frame came by; its owner, ZeroMQ, sees it end and closes the descriptor."""
    connection = socket.socket(fileno=descriptor)
    try:
        connection.shutdown(socket.SHUT_RDWR)
    except OSError as error:  # the peer was faster
        logger.debug("the connection was gone already: %s", error)
    finally:
        connection.detach()


def _op_of(frame: bytes) -> str:
    try:
        return (_JSON if frame[:1] == b"{" else _MSGPACK).decode(frame).op
    except (msgspec.DecodeError, UnicodeDecodeError):
        return ""  # no request; the server will say so


def _corrupted(frame: bytes, flips: int, chance: random.Random) -> bytes:
    changed = bytearray(frame)
    for _ in range(flips if changed else 0):
        changed[chance.randrange(len(changed))] ^= chance.randrange(1, 256)
    changed[:1] = bytes([NEVER_USED])
    return bytes(changed)
