"""Types around a client: its configuration, its server, its diagnoses, and the objects that follow it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from enum import StrEnum
from typing import Any, Final

from msgspec import Struct
from msgspec.structs import asdict

from urlab_client.aio.features import Features
from urlab_client.enums import CameraTiming, EncodingName, StepMode, Transport
from urlab_client.protocol.messages.session import InstanceInfo, StateReply
from urlab_client.protocol.messages.streams import StateSnapshot
from urlab_client.values.html import bold, table
from urlab_client.values.plain import Serializable


class Verdict(StrEnum):
    """Severity of a finding."""

    OK = "ok"
    NOTE = "note"
    PROBLEM = "problem"


_COLOURS: Final = {Verdict.OK: "#2e7d32", Verdict.NOTE: "#b26a00", Verdict.PROBLEM: "#c62828"}


class Finding(Serializable, Struct, frozen=True):
    """One result of `client.explain()`.

    Attributes:
        verdict: `OK`, `NOTE` (worth knowing) or `PROBLEM` (keeps robots from moving).
        subject: Subject of the finding: `server`, `play`, an articulation's key, …
        text: Description of the state, and what to do about it.
    """

    verdict: Verdict
    subject: str
    text: str


class Diagnosis(Serializable, Struct, frozen=True):
    """The findings of `client.explain()`, from the sockets inwards; `print()` shows one per line.

    Attributes:
        findings: The findings, in the order in which they were checked.
    """

    findings: list[Finding]

    @property
    def healthy(self) -> bool:
        """Whether nothing prevents the robots from moving."""
        return all(finding.verdict is not Verdict.PROBLEM for finding in self.findings)

    def __repr__(self) -> str:
        counts = Counter(finding.verdict for finding in self.findings)
        said = ", ".join(f"{counts[verdict]} {verdict}" for verdict in reversed(Verdict) if counts[verdict])
        problems = [f"{one.subject}: {one.text}" for one in self.findings if one.verdict is Verdict.PROBLEM]
        return f"<Diagnosis {said or 'empty'}{'; ' if problems else ''}{' '.join(problems)}>"

    def _repr_html_(self) -> str:
        rows = [(bold(one.verdict, _COLOURS[one.verdict]), bold(one.subject), one.text) for one in self.findings]
        return table(rows, caption="Nothing keeps the robots from moving." if self.healthy else "Robots cannot move.")

    def __str__(self) -> str:
        return "\n".join(f"{finding.verdict:<8}{finding.subject}: {finding.text}" for finding in self.findings)


class Resync(Serializable, Struct, frozen=True, kw_only=True):
    """The result of `client.resync()`.

    Attributes:
        session_held: Whether the session was still valid: the server was neither restarted nor taken over.
        session_renewed: Whether a new session was opened, because the old one was lost, or so that the server refuses a
            request that may still arrive.
        playing: Whether a play session is running. Without one there is no state: `step` and `time` are 0.
        step: The server's step counter since the beginning of play or the last reset.
        time: Simulation time, seconds.
        steps_sent: Number of steps with an unknown outcome, whose replies were lost. Pushes in puppet mode.
        steps_applied: Number of these that were executed; None if unknown, because the session was lost or something
            else also changed the counter.
        reset_applied: Whether a reset with an unknown outcome was executed; None if there was none, or if unknown.
        settled: Whether none of the requests in doubt can still take effect. False if the server has queued steps, as
            after `StepTimeout`.
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
    """Outcome of a request."""

    OK = "ok"
    REFUSED = "refused"
    """The server answered with an error."""
    TIMEOUT = "timeout"
    """No reply, or no turn, in time; `sent_bytes` distinguishes the two."""
    LOST = "lost"
    """No connection, or it was lost."""
    CANCELLED = "cancelled"
    FAILED = "failed"
    """The request or the reply was malformed."""


class CallRecord(Serializable, Struct, frozen=True, kw_only=True):
    """One finished request of a client, as passed to `observe=`.

    One method call may send several requests: `discover()` sends `hello` and `meta`, and an editor's job is polled with
    `op_status`.

    Attributes:
        op: Name of the op.
        endpoint: The server's address.
        started_ns: UTC clock of this machine when the request was made, nanoseconds.
        queued_s: Time spent waiting for other requests of this client, seconds.
        round_trip_s: Time from sending to the reply, including the wait for a connection, seconds; 0 if it was not
            sent.
        sent_bytes: Size of the request, including repetitions after a lost connection; 0 if it was not sent.
        received_bytes: Size of the reply; 0 without one.
        outcome: Outcome of the request.
        error: The server's code if it refused the request, otherwise the name of the exception; empty on success.
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


class DefaultPort(int):
    """Type of `STATE_PORT`, which tells the default of a port from the same number given by the user."""


STATE_PORT: Final = DefaultPort(5555)
"""Port of the state stream, unless the server announces another one."""


class ClientConfig(Serializable, Struct, frozen=True, kw_only=True):
    """The arguments of a client; see `URLabClient`. `state_port` is None if it was not given."""

    address: str = "tcp://localhost"
    step_mode: StepMode = StepMode.AUTO
    step_port: int = 5559
    state_port: int | None = None
    ctrl_port: int = 5556
    info_port: int = 5557
    mujoco_version_check: bool = True
    local_model: bool = True
    rcv_timeout_ms: int = 5000
    auto_promote_step_mode: bool = True
    transport: Transport = Transport.ZMQ
    shm_dir: str | None = None
    encoding: EncodingName = "msgpack"
    server_key: str | None = None
    client_key: str | None = None
    trust_server: bool = False
    live_pictures: bool = True
    claim_control: bool = True
    keep_session: bool = False
    read_only: bool = False

    def options(self) -> dict[str, Any]:
        """Return the constructor's arguments: `URLabClient(**config.options())`."""
        return {name: value for name, value in asdict(self).items() if value is not None}


class ServerInfo(Serializable, Struct, frozen=True, kw_only=True):
    """Identity and features of a server; see `client.server`.

    Attributes:
        features: What the server supports. `generation` is only for display.
        instance: Identity among several servers; None before play, and if the server does not send it.
        urlab_version: Version of the plugin, for display only.
        mujoco_version: Version of the server's MuJoCo.
        step_mode: The server's name of the step mode when the mode was last set; empty before that.
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


class ClientObserver:
    """Base class for observers of a client. Override the methods that you need, and pass it to `client.add_observer()`.

    The methods are called on the client's event loop, which a blocking client runs in the calling thread or in one of
    its own. So they must return quickly and must not call the client's ops. Exceptions are logged and otherwise
    ignored. Only `ready` may take its time.
    """

    def on_handshake(self) -> None:
        """Called after a handshake: `model`, robots, entities and cameras may have changed."""

    def on_state(self, state: StateReply | StateSnapshot) -> None:
        """Called with each new state, after the client's attributes show it.

        Args:
            state: The reply to a `step()` (`StepOk`, with its pictures in `cameras`), to a `reset()` (`ResetOk`) or to
                a `forward()`, or in live mode the newest snapshot. The caller of the op gets the same arrays and may
                write to them: copy what you keep.
        """

    async def ready(self) -> None:
        """Return when the observer can take another state; a step in `direct` or `puppet` mode waits for that.

        It must return eventually. Cancelling the step cancels it, and the step raises what it raises.
        """

    def step_cameras(self, n_steps: int) -> Mapping[str, str | CameraTiming]:
        """Return the cameras whose pictures the next step requests, in addition to those that its caller requests.

        Args:
            n_steps: As given to `step()`.

        Returns:
            `sync` (rendered after the step) or `latest` by camera name. Unknown names are ignored.
        """
        return {}
