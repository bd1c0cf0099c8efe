"""Fault injection: make a `SimulatedServer` misbehave deliberately, to test how programs react.

Users' tests add and remove faults while the server runs. The server's transports pass each message through the
`Injector`.
"""

from __future__ import annotations

import logging
import math
import random
import socket
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from types import TracebackType
from typing import Any, ClassVar, Final, Self, get_type_hints

import msgspec
import zmq

from urlab_client.protocol.registry import OPS
from urlab_client.server.transport.endpoint import RpcEndpoint

logger: logging.Logger = logging.getLogger("urlab_client.server")

_KINDS: Final = "a Delay, Drop, Cut, Corrupt or Refuse"

NEVER_USED: Final = 0xC1
"""A byte that starts no msgpack value and occurs in no UTF-8 text."""


@dataclass(frozen=True)
class Fault:
    """Base class of the faults below: what goes wrong, and which messages are affected.

    A fault affects requests, of one op or of all. With `topic` it affects published messages instead. A subclass whose
    methods raise ends the thread of the server that asks it, and clients are told so.

    Attributes:
        op: Name of the op whose requests are affected; None for every op.
        topic: Prefix of the topics of affected published messages; None for requests.
        executed: Whether a request is executed even though its reply is lost, late or an error.
        after: Number of messages that pass unharmed first.
        times: Number of messages that are affected; None for no limit.
        probability: Fraction of the messages that are affected, 0 to 1; the seed determines which.
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
        if self.topic is not None and isinstance(self, (Cut, Refuse)):
            raise ValueError(f"{type(self).__name__} concerns requests; published messages are delayed or dropped")
        if self.after < 0 or (self.times is not None and self.times < 1):
            raise ValueError(f"after must be at least 0 and times at least 1, not {self.after} and {self.times}")
        if not 0.0 <= self.probability <= 1.0:
            raise ValueError(f"probability must be a number from 0 to 1, not {self.probability}")

    def concerns_request(self, op: str) -> bool:
        """Whether requests of this op are affected."""
        return self.topic is None and (self.op is None or self.op == op)

    def concerns_message(self, topic: bytes) -> bool:
        """Whether published messages of this topic are affected."""
        return self.topic is not None and topic.startswith(self.topic.encode())


@dataclass(frozen=True)
class Delay(Fault):
    """Answer late.

    Until then the server answers no other request of that transport, or with `topic` publishes nothing else on that
    socket.

    Attributes:
        seconds: Duration of the delay.
    """

    seconds: float = field(kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.seconds >= 0.0 and math.isfinite(self.seconds)):
            raise ValueError(f"a delay must be a finite number of seconds, at least 0, not {self.seconds}")


@dataclass(frozen=True)
class Drop(Fault):
    """Never answer, and leave the connection open; with `topic`, do not publish."""


@dataclass(frozen=True)
class Cut(Fault):
    """Close the connection of the client instead of sending the reply. It may reconnect.

    Shared memory has no connection, so a reply over shared memory is lost as with `Drop`.
    """


@dataclass(frozen=True)
class Corrupt(Fault):
    """Change bytes of the reply: the first, so that it cannot be decoded, and some others.

    With `topic`, changes the payload of published messages. Binary rows have no checksum, so a receiver may accept
    them.

    Attributes:
        flips: Number of changed bytes besides the first; the seed determines which.
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
        if not self.code:
            raise ValueError("a refusal needs a code, for example 'internal_error'")


class ActiveFault:
    """A fault that a server applies. Leaving it as a context manager removes it.

    Attributes:
        fault: The fault.
        seen: Number of messages that it could have been applied to.
        applied: Number of messages that it was applied to.
    """

    def __init__(self, faults: Faults, fault: Fault, seed: str) -> None:
        """Start counting; created by `Faults.add`."""
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
        """Stop applying it; a delay in progress ends."""
        self._faults.remove(self)

    def wait(self, times: int = 1, timeout: float = 5.0) -> bool:
        """Wait until it has been applied.

        Args:
            times: Number of applications to wait for.
            timeout: Longest wait, seconds.

        Returns:
            Whether it was applied that often in time.
        """
        return self._faults.wait_for(lambda: self.applied >= times, timeout)

    def due(self) -> bool:
        """Count a message and return whether it is affected. `Faults` holds its lock."""
        fault = self.fault
        self.seen += 1
        if self.seen <= fault.after or (fault.times is not None and self.applied >= fault.times):
            return False
        if fault.probability < 1.0 and self.random.random() >= fault.probability:
            return False
        self.applied += 1
        return True


class Faults:
    """The faults of a server, which may change while it runs. Thread-safe.

    ::

        faults = Faults()
        with SimulatedServer("arm", play=True, faults=faults) as server:
            ...
            with faults.add(Drop("step", times=1)) as lost:
                ...
            assert lost.applied == 1

    The same messages and the same seed produce the same faults.
    """

    def __init__(self, *faults: Fault, seed: int = 0) -> None:
        """Set the faults to start with.

        Args:
            faults: Faults applied from the start.
            seed: Seed of the random choices of `probability` and `Corrupt`.

        Raises:
            TypeError: An argument is not a fault.
        """
        self._seed = seed
        self._made = 0
        self._changed = threading.Condition()
        self._active: tuple[ActiveFault, ...] = ()
        self._first = faults
        self.reset()

    @property
    def active(self) -> tuple[ActiveFault, ...]:
        """The active faults, in the order in which they were added."""
        return self._active

    def add(self, fault: Fault) -> ActiveFault:
        """Apply a fault from now on.

        If several affect a message, all delays are applied, and the first of the others.

        Raises:
            TypeError: The argument is not a fault.
        """
        if not isinstance(fault, Fault):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise TypeError(f"{fault!r} is not a fault: make {_KINDS}, for example Drop('step')")
        with self._changed:
            added = ActiveFault(self, fault, f"{self._seed}/{self._made}")
            self._made += 1
            self._active = (*self._active, added)
        return added

    def remove(self, fault: ActiveFault) -> None:
        """Stop applying a fault; no effect if it is not active."""
        with self._changed:
            self._active = tuple(other for other in self._active if other is not fault)
            self._changed.notify_all()

    def clear(self) -> None:
        """Remove all faults; delays in progress end."""
        with self._changed:
            self._active = ()
            self._changed.notify_all()

    def reset(self) -> None:
        """Restore the faults it was created with, their counters and the random state."""
        with self._changed:
            self.clear()
            self._made = 0
            for fault in self._first:
                self.add(fault)

    def take(self, concerned: Callable[[Fault], bool]) -> tuple[list[ActiveFault], ActiveFault | None]:
        """Count a message and return the delays and the other fault to apply."""
        delays: list[ActiveFault] = []
        other: ActiveFault | None = None
        with self._changed:
            for active in self._active:
                if not concerned(active.fault):
                    continue
                if isinstance(active.fault, Delay):
                    delays += [active] if active.due() else []
                elif other is None and active.due():
                    other = active
            self._changed.notify_all()
        return delays, other

    def wait_for(self, condition: Callable[[], bool], timeout: float) -> bool:
        """Wait for a condition that depends on the faults; return whether it became true in time."""
        with self._changed:
            return self._changed.wait_for(condition, timeout)

    def wake(self) -> None:
        """Make waiting threads check their conditions again."""
        with self._changed:
            self._changed.notify_all()


class _Named(msgspec.Struct):
    op: str = ""


_JSON: Final = msgspec.json.Decoder(_Named)
_MSGPACK: Final = msgspec.msgpack.Decoder(_Named)


class Injector:
    """Applies faults to what a server receives and sends."""

    def __init__(self, faults: Faults, refuse: Callable[[str, str], bytes]) -> None:
        """Put the injector between a server, whose `refuse` makes the frame of an error, and its transports."""
        self._faults = faults
        self._refuse = refuse
        self._closed = False

    def close(self) -> None:
        """End the delays in progress and apply no more."""
        self._closed = True
        self._faults.wake()

    def answer(self, frame: bytes, answer: Callable[[bytes], bytes]) -> bytes | Fault:
        """Return the frame of the reply, which `answer` makes, or the fault by which it is lost."""
        if not self._faults.active:
            return answer(frame)
        op = _op_of(frame)
        delays, other = self._faults.take(lambda fault: fault.concerns_request(op))
        self._sleep(delay for delay in delays if not delay.fault.executed)
        reply = b"" if other is not None and not other.fault.executed else answer(frame)
        self._sleep(delay for delay in delays if delay.fault.executed)
        if other is None:
            return reply
        logger.debug("%s: %r", op, other)
        match other.fault:
            case Refuse(code=code, message=message):
                return self._refuse(code, message)
            case Corrupt(flips=flips):
                return _corrupted(reply, flips, other.random)
            case lost:
                return lost

    def answer_in_memory(self, frame: bytes, answer: Callable[[bytes], bytes]) -> bytes:
        """Answer a request over shared memory; empty if the reply is lost in any way."""
        reply = self.answer(frame, answer)
        return reply if isinstance(reply, bytes) else b""

    def publish(self, topic: bytes, payload: bytes) -> bytes | None:
        """Return the payload of a published message, possibly delayed or changed; None if it is dropped."""
        if not self._faults.active:
            return payload
        delays, other = self._faults.take(lambda fault: fault.concerns_message(topic))
        self._sleep(delays)
        if other is None:
            return payload
        if isinstance(other.fault, Corrupt):
            return _corrupted(payload, other.fault.flips, other.random)
        return None

    def _sleep(self, delays: Iterable[ActiveFault]) -> None:
        """Wait until each delay is over or removed, or the server closes."""
        for delay in delays:
            if isinstance(delay.fault, Delay):
                self._faults.wait_for(partial(self._over, delay), delay.fault.seconds)

    def _over(self, delay: ActiveFault) -> bool:
        return self._closed or delay not in self._faults.active


class FaultyEndpoint(RpcEndpoint):
    """A request socket that may leave a request unanswered, unlike a REP socket."""

    kind: ClassVar[int] = zmq.ROUTER

    def __init__(self, injector: Injector, answer: Callable[[bytes], bytes], **options: Any) -> None:
        super().__init__(answer, **options)
        self._injector = injector
        self._envelope: list[bytes] = []

    def _exchange(self) -> bool:
        frames = self._socket.recv_multipart(copy=False)
        if self._stopping:
            return False
        # Like a REP socket: an empty frame ends the envelope, and messages without one are ignored.
        parts = [frame.bytes for frame in frames]
        if b"" not in parts[1:]:
            return True
        end = parts.index(b"", 1) + 1
        self._envelope = envelope = parts[:end]
        self.serving.begin()
        reply = self._injector.answer(parts[end] if len(parts) == end + 1 else b"", self._answer)
        if not self.serving.finish():
            return False
        if isinstance(reply, Cut):
            _shut(int(frames[end - 1].get(zmq.SRCFD)))
        elif isinstance(reply, bytes):
            self._socket.send_multipart([*envelope, reply])
        self._envelope = []
        return True

    def _send_owed(self, reply: bytes) -> None:
        envelope, self._envelope = self._envelope, []
        if envelope:
            self._socket.send_multipart([*envelope, reply])


def _shut(descriptor: int) -> None:
    """Shut down the connection that delivered a frame; ZeroMQ owns the descriptor and closes it."""
    connection = socket.socket(fileno=descriptor)
    try:
        connection.shutdown(socket.SHUT_RDWR)
    except OSError as error:  # the peer closed it first
        logger.debug("the connection was already closed: %s", error)
    finally:
        connection.detach()


def _op_of(frame: bytes) -> str:
    try:
        return (_JSON if frame[:1] == b"{" else _MSGPACK).decode(frame).op
    except (ValueError, RecursionError):
        return ""  # not a request; the server reports that


def _corrupted(frame: bytes, flips: int, chance: random.Random) -> bytes:
    changed = bytearray(frame)
    for _ in range(flips if changed else 0):
        changed[chance.randrange(len(changed))] ^= chance.randrange(1, 256)
    changed[:1] = bytes([NEVER_USED])
    return bytes(changed)
