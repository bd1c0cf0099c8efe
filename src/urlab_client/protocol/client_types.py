"""What a client says of itself: how it was made, its server, what it has found out."""

from __future__ import annotations

from collections import Counter
from enum import StrEnum
from typing import Any

from msgspec import Struct
from msgspec.structs import asdict

from urlab_client.protocol.enums import StepMode, Transport
from urlab_client.protocol.features import Features
from urlab_client.protocol.messages.session import InstanceInfo
from urlab_client.protocol.serializable import Serializable

__all__ = [
    "CallOutcome",
    "CallRecord",
    "ClientConfig",
    "Diagnosis",
    "Finding",
    "Resync",
    "ServerInfo",
    "Verdict",
]


class Verdict(StrEnum):
    """How serious a finding is."""

    OK = "ok"
    NOTE = "note"
    PROBLEM = "problem"


class Finding(Serializable, Struct, frozen=True):
    """One thing that `client.explain()` looked at.

    Attributes:
        verdict: `OK`, `NOTE` (worth knowing) or `PROBLEM` (keeps robots from moving).
        subject: What it is about: `server`, `play`, an articulation's key, …
        text: What is the case, and what to do about it.
    """

    verdict: Verdict
    subject: str
    text: str


class Diagnosis(Serializable, Struct, frozen=True):
    """What `client.explain()` found, from the sockets inwards; `print()` shows it line by line.

    Attributes:
        findings: In the order of examination.
    """

    findings: list[Finding]

    @property
    def healthy(self) -> bool:
        """Whether nothing keeps the robots from moving."""
        return all(finding.verdict is not Verdict.PROBLEM for finding in self.findings)

    def __repr__(self) -> str:
        counts = Counter(finding.verdict for finding in self.findings)
        said = ", ".join(f"{counts[verdict]} {verdict}" for verdict in reversed(Verdict) if counts[verdict])
        problems = [f"{one.subject}: {one.text}" for one in self.findings if one.verdict is Verdict.PROBLEM]
        return f"<Diagnosis {said or 'empty'}{'; ' if problems else ''}{' '.join(problems)}>"

    def __str__(self) -> str:
        return "\n".join(f"{finding.verdict:<8}{finding.subject}: {finding.text}" for finding in self.findings)


class Resync(Serializable, Struct, frozen=True, kw_only=True):
    """What `client.resync()` found out.

    Attributes:
        session_held: Whether the server still knew the session: it neither restarted nor was taken over.
        session_renewed: Whether a new session was opened: because the old one was gone, or so that a request which
            may still travel is refused when it arrives.
        playing: Whether a play session runs. Without one there is no state: `step` and `time` are 0.
        step: The server's step counter; counts from the session's beginning or the last reset.
        time: Simulation time, seconds.
        steps_sent: Steps in doubt: sent since the last reply, their own replies lost. Pushes in puppet mode.
        steps_applied: How many of those were executed; None where it cannot be known, because the session was gone or
            something else moved the counter as well.
        reset_applied: Whether a reset in doubt was executed; None if there was none, or it cannot be known.
        settled: Whether nothing that was in doubt can still take effect. False when the server has queued steps that it
            could not do yet, as after `StepTimeout`.
    """

    session_held: bool
    session_renewed: bool
    playing: bool
    step: int = 0
    time: float = 0.0
    steps_sent: int = 0
    steps_applied: int | None = None
    reset_applied: bool | None = None
    settled: bool = True


class CallOutcome(StrEnum):
    """What became of a request."""

    OK = "ok"
    REFUSED = "refused"
    """The server answered with an error."""
    TIMEOUT = "timeout"
    """No reply in time, or no turn: the bytes sent tell which."""
    LOST = "lost"
    """No connection, or it broke."""
    CANCELLED = "cancelled"
    FAILED = "failed"
    """The request was malformed, or the reply."""


class CallRecord(Serializable, Struct, frozen=True, kw_only=True):
    """One request of a client, as `observe=` is told of it when it is over.

    What follows from one call of a method may be several: `discover()` sends `hello` and `meta`, an editor's job is
    asked after with `op_status`.

    Attributes:
        op: Its op.
        endpoint: The server's address.
        started_ns: This machine's UTC clock when the request came up, nanoseconds.
        queued_s: Seconds that it waited for other requests of this client.
        round_trip_s: Seconds from sending to the reply, with the wait for a connection; 0 if it never got so far.
        sent_bytes: Size of the request; with each repetition after a lost connection. 0 if it never got so far.
        received_bytes: Size of the reply; 0 without one.
        outcome: What became of it.
        error: The server's code for what it refused, else the name of the exception; empty if all went well.
    """

    op: str
    endpoint: str
    started_ns: int
    queued_s: float
    round_trip_s: float
    sent_bytes: int
    received_bytes: int
    outcome: CallOutcome
    error: str = ""


class ClientConfig(Serializable, Struct, frozen=True, kw_only=True):
    """The arguments a client was made with; see `URLabClient` for their meaning."""

    address: str = "tcp://localhost"
    step_mode: StepMode = StepMode.AUTO
    step_port: int = 5559
    state_port: int = 5555
    ctrl_port: int = 5556
    info_port: int = 5557
    mujoco_version_check: bool = True
    local_model: bool = True
    rcv_timeout_ms: int = 5000
    auto_promote_step_mode: bool = True
    transport: Transport = Transport.ZMQ
    shm_dir: str | None = None
    encoding: str = "msgpack"
    server_key: str | None = None
    client_key: str | None = None
    trust_server: bool = False
    live_pictures: bool = True
    claim_control: bool = True
    keep_session: bool = False
    read_only: bool = False

    def options(self) -> dict[str, Any]:
        """Return the constructor's arguments: `URLabClient(**config.options())`."""
        return asdict(self)


class ServerInfo(Serializable, Struct, frozen=True, kw_only=True):
    """What a server is and can do; see `client.server`.

    Attributes:
        features: What it can do. Its `generation` is a name for people.
        instance: Which of several servers it is; None before play, and from servers that do not tell.
        urlab_version: Its version; not to be relied on.
        mujoco_version: Version of its MuJoCo.
        step_mode: What it called the step mode when the mode was last set; empty before.
    """

    features: Features
    instance: InstanceInfo | None = None
    urlab_version: str = ""
    mujoco_version: str = ""
    step_mode: str = ""

    @property
    def generation(self) -> str:
        """`alpha`, `june`, `beta`, `3`, or empty before `discover()`."""
        return self.features.generation
