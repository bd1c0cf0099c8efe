"""Faults on purpose, as a user's test meets them: through the client, and for the rest over a bare socket."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st
from waiting import attempts, eventually
from wire import Wire

from urlab_client import OutcomeUnknown, SessionTakenOver, URLabClient, URLabTimeoutError
from urlab_client.errors import ProtocolError, StepTimeout
from urlab_client.server import Corrupt, Cut, Delay, Drop, Fault, Faults, Refuse, SimulatedServer


@pytest.fixture(scope="module")
def server(models: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimulatedServer]:
    shm_dir = tmp_path_factory.mktemp("shm")
    with SimulatedServer(models / "bot.xml", play=True, faults=FAULTS, shm_dir=shm_dir) as server:
        yield server


FAULTS = Faults(seed=7)


@pytest.fixture
def faults(server: SimulatedServer) -> Iterator[Faults]:
    yield FAULTS
    FAULTS.clear()


@pytest.fixture
def client(server: SimulatedServer, faults: Faults, request: pytest.FixtureRequest) -> Iterator[URLabClient]:
    options = server.client_options() | {"transport": getattr(request, "param", "zmq")}
    with URLabClient(**options, step_mode="direct", rcv_timeout_ms=30_000) as client:
        client.discover()
        client.reset()
        yield client


either_transport = pytest.mark.parametrize("client", ["zmq", "shm"], indirect=True)


def step_in_vain(client: URLabClient, timeout: float = 0.05) -> None:
    """Send a step and give up on it. On a busy machine the deadline may pass before it is sent: then once more."""
    sent = client.transport_stats.sent
    for _ in attempts("no step was sent"):
        with pytest.raises(URLabTimeoutError):
            client.step(timeout=timeout)
        if client.transport_stats.sent > sent:
            break


@either_transport
def test_a_late_reply_runs_into_the_timeout_and_the_next_step_works(client: URLabClient, faults: Faults) -> None:
    late = faults.add(Delay("step", seconds=60.0, after=1, times=1))
    client.step()
    step_in_vain(client)
    assert late.wait(timeout=30.0)
    late.remove()
    assert client.step().step == 3, "the late step was executed"
    assert (late.seen, late.applied) == (2, 1)


@either_transport
@pytest.mark.parametrize("executed", [True, False])
def test_a_lost_step(client: URLabClient, faults: Faults, executed: bool) -> None:
    with faults.add(Drop("step", times=1, executed=executed)) as lost:
        step_in_vain(client)
        assert lost.wait(timeout=30.0)
    assert lost.applied == 1
    assert faults.active == ()
    assert client.connected
    assert client.step().step == (2 if executed else 1)


@pytest.mark.parametrize("executed", [True, False])
def test_a_cut_connection(client: URLabClient, faults: Faults, executed: bool) -> None:
    with faults.add(Cut("step", executed=executed, times=1)), pytest.raises(OutcomeUnknown):
        client.step()
    with faults.add(Cut("list_keyframes", times=1)) as cut:
        client.runtime.list_keyframes()  # reads are asked again
    assert cut.seen == 2
    assert client.step().step == (2 if executed else 1)
    assert client.transport_stats.connects == 3


@pytest.mark.parametrize("client", ["shm"], indirect=True)
def test_without_a_connection_to_cut_the_reply_is_lost(client: URLabClient, faults: Faults) -> None:
    with faults.add(Cut("step", times=1)) as cut:
        step_in_vain(client)
        assert cut.wait(timeout=30.0)
    assert client.step().step == 2
    assert client.transport_stats.connects == 1


def test_others_keep_their_connection(server: SimulatedServer, client: URLabClient, faults: Faults) -> None:
    with URLabClient(**server.client_options(), step_mode="direct") as other:
        other.discover()
        with faults.add(Cut("list_keyframes", times=1)) as cut, pytest.raises(SessionTakenOver):
            client.runtime.list_keyframes()
        assert cut.seen == 2
        assert client.transport_stats.connects == 2
        other.step()
        assert other.transport_stats.connects == 1


@either_transport
@pytest.mark.parametrize("flips", [0, 1000])
def test_a_corrupt_reply(client: URLabClient, faults: Faults, flips: int) -> None:
    with faults.add(Corrupt("step", times=1, flips=flips)), pytest.raises(ProtocolError):
        client.step(timeout=10.0)
    assert client.step().step == 2


@either_transport
@pytest.mark.parametrize("executed", [True, False])
def test_a_refusal(client: URLabClient, faults: Faults, executed: bool) -> None:
    faults.add(Refuse("step", code="step_timeout", message="too slow", executed=executed, times=1))
    with pytest.raises(StepTimeout, match="too slow"):
        client.step()
    assert client.step().step == (2 if executed else 1)


def test_a_fault_passes_by_what_comes_first_and_tells_how_often_it_struck(client: URLabClient, faults: Faults) -> None:
    busy = Refuse("step", code="step_timeout", message="too slow", after=1, times=2)
    with faults.add(busy) as refusal:
        client.step()
        for _ in range(2):
            with pytest.raises(StepTimeout, match="too slow"):
                client.step()
        assert client.step().step == 2
        assert (refusal.applied, repr(refusal)) == (2, f"<{busy} applied 2 of {refusal.seen} times>")


@either_transport
def test_a_delay_and_a_loss_add_up(client: URLabClient, faults: Faults) -> None:
    slow, lost, never = (faults.add(fault) for fault in (Delay(seconds=0.01), Drop("step"), Cut("step")))
    step_in_vain(client)
    assert lost.wait(timeout=30.0)
    assert (slow.applied, lost.applied, never.seen) == (1, 1, 0)


def test_waiting_for_a_fault(client: URLabClient, faults: Faults) -> None:
    lost = faults.add(Drop("step", times=1))
    assert not lost.wait(timeout=0.0)
    step_in_vain(client, timeout=0.01)
    assert lost.wait(timeout=30.0)


def test_closing_ends_a_delay(models: Path) -> None:
    faults = Faults(Delay(seconds=3600.0))
    with SimulatedServer(models / "bot.xml", faults=faults) as server, zmq.Context() as context:
        asking = context.socket(zmq.REQ)
        asking.linger = 0
        asking.connect(f"{server.address}:{server.step_port}")
        asking.send(b"\x80")
        (delay,) = faults.active
        assert delay.wait(timeout=30.0)
        server.close()  # or this test runs into its time limit
        asking.close()


def test_published_messages_get_lost_late_or_corrupt(server: SimulatedServer, faults: Faults) -> None:
    topic = "state/full"
    with zmq.Context() as context, context.socket(zmq.SUB) as stream:
        stream.linger = 0
        stream.rcvhwm = 0
        stream.subscribe(topic)
        stream.connect(f"{server.address}:{server.state_port}")
        assert stream.poll(30_000)
        lost = faults.add(Drop(topic=topic, times=3))
        assert lost.wait(3, timeout=30.0)
        late = faults.add(Delay(topic=topic, seconds=0.001, times=1))
        assert late.wait(timeout=30.0)
        broken = faults.add(Corrupt(topic=topic, times=1))
        assert broken.wait(timeout=30.0)
        eventually(lambda: stream.poll(30_000) and stream.recv_multipart()[1][0] == 0xC1, look=0)


def run(seed: int) -> list[bool]:
    faults = Faults(seed=seed)
    fault = faults.add(Drop("step", probability=0.5, after=2, times=5))
    return [faults.take(lambda each: each.concerns_request("step"))[1] is fault for _ in range(40)]


@given(st.integers())
def test_a_seed_decides(seed: int) -> None:
    assert run(seed) == run(seed)
    assert not any(run(seed)[:2])
    assert sum(run(seed)) <= 5


def test_seeds_differ() -> None:
    assert len({tuple(run(seed)) for seed in range(5)}) > 1


@pytest.mark.parametrize(
    ("kind", "options", "complaint"),
    [
        (Drop, {"op": "fly"}, "no op is called 'fly'"),
        (Drop, {"op": "step", "topic": "state/full"}, "not both"),
        (Cut, {"topic": "state/full"}, "Cut concerns requests"),
        (Refuse, {"code": ""}, "needs a code"),
        (Delay, {"seconds": -1.0}, "seconds"),
        (Delay, {"seconds": float("nan")}, "seconds"),
        (Drop, {"probability": 2.0}, "probability"),
        (Drop, {"times": 0}, "times"),
        (Corrupt, {"executed": False}, "executed"),
        (Corrupt, {"flips": -1}, "flips"),
    ],
)
def test_faults_that_are_none(kind: type[Fault], options: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        kind(**options)


def test_a_fault_is_of_some_kind() -> None:
    with pytest.raises(TypeError, match="Delay, Drop"):
        Fault()


@pytest.mark.parametrize(
    ("kind", "options", "complaint"),
    [
        (Drop, {"op": 3}, "op: Expected `str | null`"),
        (Drop, {"topic": b"state/full"}, "topic: Expected `str | null`"),
        (Drop, {"after": 0.5}, "after: Expected `int`"),
        (Corrupt, {"flips": 2.5}, "flips: Expected `int`"),
        (Delay, {"seconds": "1"}, "seconds: Expected `float`"),
        (Refuse, {"code": 7}, "code: Expected `str`"),
    ],
)
def test_what_describes_a_fault_has_its_types(kind: type[Fault], options: dict[str, Any], complaint: str) -> None:
    with pytest.raises(TypeError, match=f"{kind.__name__}: {re.escape(complaint)}"):
        kind(**options)


def test_what_is_not_a_fault_is_refused_and_harms_nobody(client: URLabClient, faults: Faults) -> None:
    for nonsense in ("step", None, Drop):
        with pytest.raises(TypeError, match=re.escape("is not a fault: make a Delay, Drop")):
            faults.add(nonsense)  # type: ignore[arg-type]
        with pytest.raises(TypeError, match="is not a fault"):
            Faults(nonsense)  # type: ignore[arg-type]
    assert client.step().step == 1


def test_a_request_too_deep_to_read_meets_no_fault(server: SimulatedServer, faults: Faults) -> None:
    deep = b'{"op": "step", "x": ' + b"[" * 100_000
    with faults.add(Drop("step")), zmq.Context() as context, context.socket(zmq.REQ) as socket:
        socket.connect(f"{server.address}:{server.step_port}")
        socket.send(deep)
        assert socket.poll(60_000)
        assert b"bad_request" in socket.recv()


def test_shared_memory_gets_what_subscribers_do_not(models: Path, tmp_path: Path) -> None:
    faults = Faults(Drop(topic="state/full"), Corrupt(topic="bot/camera"))
    options: dict[str, Any] = {"play": True, "faults": faults, "shm_dir": tmp_path}
    with (
        SimulatedServer(models / "bot.xml", **options) as server,
        URLabClient(**server.client_options(), transport="shm") as near,
        URLabClient(**server.client_options()) as far,
    ):
        far.discover()
        near.discover()
        with near.state_stream() as states, far.state_stream() as lost:
            assert lost.receive_nowait() is None
            assert states.receive(timeout=30.0).time == 0.0
            with pytest.raises(URLabTimeoutError):
                lost.receive(timeout=0.05)
            (drop, _) = faults.active
            assert drop.wait(timeout=30.0)
            assert states.receive(timeout=30.0).per_articulation


def test_a_missed_deadline_costs_these_tests_no_other_request(server: SimulatedServer, faults: Faults) -> None:
    with Wire(server) as wire, faults.add(Drop("hello", times=1)):
        wire._socket.rcvtimeo = 10
        with pytest.raises(AssertionError, match=r"no reply within 30 s to .*hello"):
            wire.hello()
        assert wire.hello()["session_id"]
